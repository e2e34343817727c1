"""Ranges between nodes: the model, the NLOS power rule and the robust weights."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from uwbslam_jax import ekf, layout
from uwbslam_jax.config import Params
from uwbslam_jax.geometry import rotation, safe_norm
from uwbslam_jax.measurements import Ranges

_SOFT = 3.0
"""Normalised innovation at which a range weighs a quarter (Geman-McClure)."""


class RangeUpdate(NamedTuple):
    """What one frame's ranges did.

    Attributes:
      innovation: (M,) measured minus predicted [m], 0 where there is no range.
      normalised: (M,) innovation over its predicted standard deviation.
      weight: (M,) robust weight in [0, 1]; 0 where a range is not used.
      log_likelihood: of the innovations, each pair by itself, under the robust model.
    """

    innovation: Float[Array, "M"]
    normalised: Float[Array, "M"]
    weight: Float[Array, "M"]
    log_likelihood: Float[Array, ""]


def predicted_ranges(vector: Float[Array, "n"], ranges: Ranges, params: Params) -> Float[Array, "M"]:
    """h = |p_i - p_j| + biases, at the time of each exchange [m] (paper, "dynamical and observational models").

    The antenna's lever arm on the robot, the difference of antenna heights and the motion between exchange and
    frame are part of the model; two nodes at one place give a finite gradient.
    """
    s = layout.unpack(vector)

    def at_exchange(slot, age):
        lever = rotation(s.heading + s.yaw_rate * age) @ params.antenna[:2]
        return s.positions[slot] + age * s.velocities[slot] + jnp.where(slot == 0, 1.0, 0.0) * lever

    def one(i, j, age):
        flat = safe_norm(at_exchange(i, age) - at_exchange(j, age))
        rise = params.height[i] - params.height[j]
        return safe_norm(jnp.stack([flat, rise])) + params.bias[i] + params.bias[j]

    return jax.vmap(one)(ranges.i, ranges.j, ranges.age)


def line_of_sight(ranges: Ranges, nlos_gap_db: float) -> Bool[Array, "M"]:
    """False where the power rule says NLOS: receive - first-path power > 10 dB (paper, "Detection/removal of ranging
    outliers"). A radio that does not report powers is given the benefit of the doubt."""
    return ~(ranges.power_gap > nlos_gap_db)


def robust_weight(normalised: Float[Array, "*m"]) -> Float[Array, "*m"]:
    """Geman-McClure weight of a normalised innovation, for both signs; never 0, so that no pair can starve itself."""
    return (1.0 / (1.0 + (normalised / _SOFT) ** 2)) ** 2


def update(
    belief: ekf.Gaussian, ranges: Ranges, usable: Bool[Array, "M"], params: Params, *, robust: bool
) -> tuple[ekf.Gaussian, RangeUpdate]:
    """EKF update by all usable ranges of a frame in information form (paper, "EKF update")."""
    h = predicted_ranges(belief.mean, ranges, params)
    H = jax.jacfwd(predicted_ranges)(belief.mean, ranges, params)
    H = jnp.where(usable[:, None], H, 0.0)
    innovation = jnp.where(usable, ranges.range - h, 0.0)
    S = jnp.sum((H @ belief.cov) * H, axis=1) + params.sigma_n**2
    normalised = innovation / jnp.sqrt(S)
    weight = jnp.where(usable, robust_weight(normalised) if robust else 1.0, 0.0)
    scaled = H * (weight / params.sigma_n**2)[:, None]
    log_likelihood = jnp.sum(jnp.where(usable, _log_density(normalised, S, robust), 0.0))
    after = ekf.update_information(belief, H.T @ scaled, scaled.T @ innovation)
    return after, RangeUpdate(innovation, normalised, weight, log_likelihood)


def _log_density(normalised, S, robust):
    square = normalised**2
    loss = square / (1.0 + square / _SOFT**2) if robust else square
    return -0.5 * (loss + jnp.log(2 * jnp.pi * S))
