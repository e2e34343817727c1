"""The Gaussian belief and its update. Knows no sensor: matrices in, matrices out.

All updates go through a square root of the covariance, so that it stays symmetric and positive definite in
float32 for as long as one likes, and through the information of the measurements (n x n), so that the cost
grows with the state and not with the number of measurements.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

_LEAST_VARIANCE, _ROUNDINGS = 1e-16, 8
"""A smaller variance is none; a root is that of a matrix with so many roundings for each row added to its diagonal."""


class Gaussian(NamedTuple):
    """Mean (n,) and covariance (n, n); units are those of the state."""

    mean: Float[Array, "n"]
    cov: Float[Array, "n n"]


def symmetric_root(cov: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L with L L^T = cov for a positive semi-definite cov.

    Scaled by the standard deviations first: rounding then is relative to each state's own size, and a direction
    that is known exactly (variance 0) neither fails nor spoils the others.
    """
    std = jnp.sqrt(jnp.maximum(jnp.diagonal(cov), _LEAST_VARIANCE))
    eps = _ROUNDINGS * jnp.finfo(cov.dtype).eps * cov.shape[0]
    correlation = cov / (std[:, None] * std[None, :])
    return std[:, None] * jnp.linalg.cholesky(correlation + eps * jnp.eye(cov.shape[0], dtype=cov.dtype))


def predict(belief: Gaussian, mean: Float[Array, "n"], F: Float[Array, "n n"], Q: Float[Array, "n n"]) -> Gaussian:
    """Belief after a motion: the predicted mean, F P F^T + Q (paper, "EKF update")."""
    cov = F @ belief.cov @ F.T + Q
    return Gaussian(mean, (cov + cov.T) / 2)


def update_information(belief: Gaussian, information: Float[Array, "n n"], gradient: Float[Array, "n"]) -> Gaussian:
    """Belief after measurements whose information form is given.

    With Jacobian H, noise R and innovation nu: information = H^T R^-1 H and gradient = H^T R^-1 nu. The result is
    that of the textbook gain (P^-1 + H^T R^-1 H)^-1, evaluated as L (I + L^T A L)^-1 L^T with P = L L^T: no inverse
    of P and no matrix of the size of the measurements.
    """
    L = symmetric_root(belief.cov)
    n = L.shape[0]
    C = jnp.linalg.cholesky(jnp.eye(n, dtype=L.dtype) + L.T @ information @ L)
    root = solve_triangular(C, L.T, lower=True).T
    cov = root @ root.T
    return Gaussian(belief.mean + cov @ gradient, cov)


def inverse3(A: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse by cofactors: a dozen products instead of a call of LAPACK, which costs more than the step's own work."""
    a, b, c = A
    rows = jnp.stack([_cross(b, c), _cross(c, a), _cross(a, b)])
    return rows.T / (a @ rows[0])


def _cross(u: Float[Array, "3"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    return jnp.stack([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])


def update_projected(
    belief: Gaussian, C: Float[Array, "3 n"], information: Float[Array, "3 3"], innovation: Float[Array, "3"]
) -> Gaussian:
    """Belief after a measurement of C x whose information may be singular, in Joseph form.

    With G = P C^T (I + Y C P C^T)^-1 the gain is K = G Y and the result (I - K C) P (I - K C)^T + G Y G^T: the textbook
    update without the inverse of Y, and products of rank 3 only.
    """
    PC = belief.cov @ C.T
    G = PC @ inverse3(jnp.eye(3, dtype=PC.dtype) + information @ (C @ PC))
    K = G @ information
    left = belief.cov - K @ PC.T
    cov = left - (left @ C.T) @ K.T + K @ G.T
    return Gaussian(belief.mean + K @ innovation, (cov + cov.T) / 2)


def nees(error: Float[Array, "n"], cov: Float[Array, "n n"]) -> Float[Array, ""]:
    """Normalised estimation error squared, error^T P^-1 error; its mean is n for an honest filter."""
    half = solve_triangular(symmetric_root(cov), error, lower=True)
    return half @ half


def log_likelihood(innovation: Float[Array, "m"], S: Float[Array, "m m"]) -> Float[Array, ""]:
    """Log density of an innovation under N(0, S)."""
    L = jnp.linalg.cholesky(S)
    half = solve_triangular(L, innovation, lower=True)
    m = innovation.shape[0]
    return -0.5 * (half @ half) - jnp.sum(jnp.log(jnp.diagonal(L))) - 0.5 * m * jnp.log(2 * jnp.pi)
