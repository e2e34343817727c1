"""Whitened residual blocks of the joint objective (paper eq. (opt)): LiDAR, UWB, prior."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from uwbslam_jax.mapping import grid as occupancy
from uwbslam_jax.numerics import transform_points

_JITTER = (1e-6, 1e-12)
"""Share of the diagonal that is added to a Gram matrix before its root is taken, and what the diagonal is at least."""


def lidar_gram(
    pose: Float[Array, "3"],
    level: Float[Array, "c c"],
    origin: Float[Array, "2"],
    size: float | Float[Array | np.ndarray, ""],
    points: Float[Array, "B 2"],
    valid: Bool[Array, "B"],
) -> Float[Array, "4 4"]:
    """Gram matrix of [dr/dx dr/dy dr/dtheta r] with r_i = 1 - Gamma(f_i(pose)).

    Its upper left block is H^(LiD) of the paper's eq. (delta_opt), the rest of its last column -M^(LiD), its last
    entry twice the LiDAR term. One product of a (4, B) by a (B, 4) matrix stands for B residuals of n unknowns.
    A beam without return or outside the window has residual 0.
    """
    ends = transform_points(pose, points)
    corners, at, inside = occupancy.corner_log_odds(level, origin, size, ends)
    value, slope = occupancy.interpolate(jax.nn.sigmoid(corners), at, size)
    gx, gy = slope[:, 0], slope[:, 1]
    dx, dy = ends[:, 0] - pose[0], ends[:, 1] - pose[1]
    rows = jnp.stack([-gx, -gy, gx * dy - gy * dx, 1.0 - value])
    rows = jnp.where(valid & inside, rows, 0.0)
    return rows @ rows.T


@jax.custom_jvp
def lidar_residual(
    pose: Float[Array, "3"],
    level: Float[Array, "c c"],
    origin: Float[Array, "2"],
    size: float | Float[Array | np.ndarray, ""],
    points: Float[Array, "B 2"],
    valid: Bool[Array, "B"],
) -> Float[Array, "4"]:
    """Four numbers with the squared norm, the gradient and the normal equations of all B residuals 1 - Gamma.

    With G the Gram matrix and G = R^T R, the last column of R is the residual and its other columns the Jacobian with
    respect to the pose, so Gauss-Newton sees 4 rows instead of B and makes the same move. Derivatives with respect to
    the map and the points are those of the residual column itself: the squared norm's gradient is exact for all.
    """
    return _root(lidar_gram(pose, level, origin, size, points, valid))[:, 3]


@partial(lidar_residual.defjvp, symbolic_zeros=True)
def _lidar_residual_jvp(
    primals: tuple[Any, ...], tangents: tuple[Any, ...]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    pose, *others = primals
    R = _root(lidar_gram(pose, *others))
    out = jnp.zeros_like(R[:, 3])
    if not isinstance(tangents[0], SymbolicZero):
        out = out + R[:, :3] @ tangents[0]
    level, origin, size, points, valid = others
    if all(isinstance(t, SymbolicZero) for t in tangents[1:5]):
        return R[:, 3], out

    def of_rest(
        level: Float[Array, "c c"], origin: Float[Array, "2"], points: Float[Array, "B 2"]
    ) -> Float[Array, "4"]:
        return _root(lidar_gram(pose, level, origin, size, points, valid))[:, 3]

    def dense(t: Array | SymbolicZero, x: Array) -> Array:
        return jnp.zeros_like(x) if isinstance(t, SymbolicZero) else t

    rest = (level, origin, points)
    rest_dot = tuple(dense(t, x) for t, x in zip((tangents[1], tangents[2], tangents[4]), rest, strict=True))
    return R[:, 3], out + jax.jvp(of_rest, rest, rest_dot)[1]


def _root(G: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """Upper triangular R with R^T R = G, safe where there is no beam or no gradient."""
    # scaled to unit diagonal so that the jitter is relative in every column
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(G), _JITTER[1]))
    unit = G / (scale[:, None] * scale[None, :]) + _JITTER[0] * jnp.eye(4, dtype=G.dtype)
    return jnp.linalg.cholesky(unit).T * scale[None, :]


def prior_residual(delta: Float[Array, "d"], mean: Float[Array, "d"], root: Float[Array, "d d"]) -> Float[Array, "d"]:
    """Whitened distance to a Gaussian prior: root (delta - mean) with root^T root the prior's information."""
    return root @ (delta - mean)
