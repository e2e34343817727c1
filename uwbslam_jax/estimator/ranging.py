"""Ranges between nodes: the model, the NLOS power rule and the robust weights."""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from uwbslam_jax.estimator import state_vector
from uwbslam_jax.measurements import Leaf, Ranges
from uwbslam_jax.numerics import gaussian, perpendicular
from uwbslam_jax.settings import Params

_SOFT = 3.0
"""Normalised innovation at which a range weighs a quarter (Geman-McClure)."""
_QUIET = 1.6
"""A pair that scatters less than this many times as much as its radios should is taken to be quiet."""
_LEARN = 0.1
"""Logarithm by which a pair's scatter moves with one range, at most twice that apart: some 40 ranges for a factor 8."""
_NORMAL_MEDIAN = 0.674
"""Median of |x| for a standard normal x."""
_SCATTER_LIMITS = (-0.7, 2.5)
"""Of the logarithm: half as much as expected, and twelve times as much."""
_ASTRAY, _ASTRAY_M = 0.02, 20.0
"""For the likelihood: so many ranges are anything within so many metres of what was expected."""
_LOUDEST = 10.0
"""However much a pair scatters, its noise counts as this many times that of a quiet one at most."""


class RangeUpdate(NamedTuple):
    """What one frame's ranges did.

    Attributes:
      innovation: (M,) measured minus predicted [m], 0 where there is no range.
      normalised: (M,) innovation over its predicted standard deviation, the pair's own scatter included.
      weight: (M,) robust weight in [0, 1]; 0 where a range is not used.
      log_likelihood: of the innovations, each pair by itself, under the robust model.
    """

    innovation: Float[Array, "M"]
    normalised: Float[Array, "M"]
    weight: Float[Array, "M"]
    log_likelihood: Float[Array, ""]


def predicted_ranges(vector: Float[Array, "n"], ranges: Ranges, params: Params) -> Float[Array, "M"]:
    """h = |p_i - p_j| (1 + scale) + biases, at the time of each exchange [m] (paper, "dynamical and observational
    models").

    The antenna's lever arm on the robot, the difference of antenna heights and the motion between exchange and
    frame are part of the model; two nodes at one place give a finite gradient.
    """
    return _geometry(vector, ranges, params).predicted


class _Geometry(NamedTuple):
    """Of every exchange: its predicted range, unit vector in the plane, lever arm, and whose: +1 i's, -1 j's."""

    predicted: Float[Array, "M"]
    direction: Float[Array, "M 2"]
    lever: Float[Array, "M 2"]
    ends: Float[Array, "M K"]


def _geometry(vector: Float[Array, "n"], ranges: Ranges, params: Params) -> _Geometry:
    s = state_vector.unpack(vector)
    slot = jnp.arange(s.positions.shape[0])
    i, j = ranges.i[:, None] == slot[None, :], ranges.j[:, None] == slot[None, :]
    ends = i.astype(vector.dtype) - j.astype(vector.dtype)
    angle = s.heading + s.yaw_rate * ranges.age
    c, sn = jnp.cos(angle), jnp.sin(angle)
    x, y = params.antenna[0], params.antenna[1]
    lever = jnp.stack([c * x - sn * y, sn * x + c * y], axis=-1)
    # differences of what every node has, one product for all of it
    nodes = jnp.concatenate([s.positions, s.velocities, params.height[:, None]], axis=1)
    apart = ends @ nodes
    flat = apart[:, :2] + ranges.age[:, None] * apart[:, 2:4] + ends[:, :1] * lever
    square = jnp.sum(flat**2, axis=-1) + apart[:, 4] ** 2
    apart_at_all = square > 0
    slant = jnp.where(apart_at_all, jnp.sqrt(jnp.where(apart_at_all, square, 1.0)), 0.0)
    direction = jnp.where(apart_at_all[:, None], flat / jnp.where(apart_at_all, slant, 1.0)[:, None], 0.0)
    bias = jnp.sum(jnp.where(i | j, params.bias[None, :], 0.0), axis=1)
    return _Geometry((1.0 + params.bias_scale) * slant + bias, direction, lever, ends)


def linearised_ranges(
    vector: Float[Array, "n"], ranges: Ranges, params: Params
) -> tuple[Float[Array, "M"], Float[Array, "M n"]]:
    """Predicted ranges and their Jacobian H, written out: a range depends on its own two nodes and on no other."""
    g = _geometry(vector, ranges, params)
    m, age = ranges.i.shape[0], ranges.age[:, None]
    direction = (1.0 + params.bias_scale) * g.direction
    places = (g.ends[:, :, None] * direction[:, None, :]).reshape(m, -1)
    turning = g.ends[:, :1] * jnp.sum(direction * perpendicular(g.lever), axis=1, keepdims=True)
    nothing = jnp.zeros((m, 3), vector.dtype)
    return g.predicted, jnp.concatenate([places, age * places, turning, age * turning, nothing], axis=1)


def line_of_sight(ranges: Ranges, nlos_gap_db: float) -> Bool[Array, "M"]:
    """False where the power rule says NLOS: receive - first-path power > 10 dB (paper, "Detection/removal of ranging
    outliers"). A radio that does not report powers is given the benefit of the doubt."""
    return ~(ranges.power_gap > nlos_gap_db)


def robust_weight(normalised: Float[Array, "*m"]) -> Float[Array, "*m"]:
    """Geman-McClure weight of a normalised innovation, for both signs; never 0, so that no pair can starve itself."""
    return (1.0 / (1.0 + (normalised / _SOFT) ** 2)) ** 2


class Scatter(NamedTuple):
    """What each pair's ranges did so far; symmetric.

    Attributes:
      log: (K, K) log of how many times as much its innovations jump from one range to the next as its noise lets them.
      last: (K, K) the last innovation over its standard deviation.
      heard: (K, K) whether there was one.
    """

    log: Float[Array, "K K"]
    last: Float[Array, "K K"]
    heard: Bool[Array, "K K"]


def quiet(nodes: int) -> Scatter:
    """Scatter before anything was heard."""
    # an array of its own for each: the step donates its state, and no buffer can be donated twice
    return Scatter(*(jnp.zeros((nodes, nodes), dtype) for dtype in (jnp.float32, jnp.float32, bool)))


def loudness(log: Float[Leaf, "*m"], xp: ModuleType = jnp) -> Float[Leaf, "*m"]:
    """How many times sigma_n the noise of a pair is by the log of its scatter; 1 for a quiet pair. xp: numpy where the
    host asks.

    It grows with the square of the scatter: what makes ranges jump (walls in between) also makes them too long, by
    an amount that nobody knows.
    """
    return xp.clip((xp.exp(log) / _QUIET) ** 2, 1.0, _LOUDEST)


def learn_scatter(scatter: Scatter, ranges: Ranges, usable: Bool[Array, "M"], normalised: Float[Array, "M"]) -> Scatter:
    """Scatter of each pair after a frame: log of the median |jump| of its innovations over what noise should give.

    Ranges through walls are too long by amounts that vary, mostly by much and sometimes by little; their robust
    weight alone would let the small ones pull for ever to one side. A running median (Robbins-Monro, its sign
    smoothed so that it can be differentiated) makes the whole pair weigh what it is worth, and forgets when the wall
    is passed. Only jumps count: where the state is wrong, innovations are large but smooth, and ranges must not be
    silenced by the very error that they are there to mend (paper, Remark on innovation gates).

    Args:
      normalised: innovations over their standard deviation for quiet pairs.
    """
    jump = (normalised - scatter.last[ranges.i, ranges.j]) / jnp.sqrt(2.0)
    known = usable & scatter.heard[ranges.i, ranges.j]
    median = _NORMAL_MEDIAN * jnp.exp(scatter.log[ranges.i, ranges.j])
    square = jnp.where(known, jump / median, 1.0) ** 2
    move = jnp.where(known, _LEARN * (1.0 - 2.0 / (1.0 + square**2)), 0.0)
    log = scatter.log.at[ranges.i, ranges.j].add(move).at[ranges.j, ranges.i].add(move)
    # a slot without a range must not overwrite a pair that has one
    i, j = (jnp.where(usable, slot, scatter.log.shape[0]) for slot in (ranges.i, ranges.j))
    last = scatter.last.at[i, j].set(normalised, mode="drop").at[j, i].set(normalised, mode="drop")
    heard = scatter.heard.at[i, j].set(True, mode="drop").at[j, i].set(True, mode="drop")
    return Scatter(jnp.clip(log, *_SCATTER_LIMITS), last, heard)


def update(
    belief: gaussian.Gaussian,
    ranges: Ranges,
    usable: Bool[Array, "M"],
    params: Params,
    scatter: Scatter,
    *,
    robust: bool,
) -> tuple[gaussian.Gaussian, RangeUpdate, Scatter]:
    """EKF update by all usable ranges of a frame in information form (paper, "EKF update").

    Args:
      scatter: of each pair, see learn_scatter; without `robust` it stays as it is and is not used.
    """
    h, H = linearised_ranges(belief.mean, ranges, params)
    H = jnp.where(usable[:, None], H, 0.0)
    innovation = jnp.where(usable, ranges.range - h, 0.0)
    spread = jnp.sum((H @ belief.cov) * H, axis=1)
    variance = params.sigma_n**2
    if robust:
        quiet = innovation / jnp.sqrt(spread + variance)
        variance = variance * loudness(scatter.log[ranges.i, ranges.j]) ** 2
        scatter = learn_scatter(scatter, ranges, usable, quiet)
    S = spread + variance
    normalised = innovation / jnp.sqrt(S)
    weight = jnp.where(usable, robust_weight(normalised) if robust else 1.0, 0.0)
    scaled = H * (weight / variance)[:, None]
    log_likelihood = jnp.sum(jnp.where(usable, log_density(innovation, S, robust), 0.0))
    after = gaussian.update_information(belief, H.T @ scaled, scaled.T @ innovation)
    return after, RangeUpdate(innovation, normalised, weight, log_likelihood), scatter


def log_density(innovation: Float[Array, "*m"], S: Float[Array, "*m"], robust: bool) -> Float[Array, "*m"]:
    """Log density of innovations [1/m]. The robust one is a normal one for most ranges and an even one for the rest: it
    integrates to one. What the weights belong to does not (their loss is bounded), and would have sigma_n go to 0."""
    normal = -0.5 * (innovation**2 / S + jnp.log(2 * jnp.pi * S))
    return jnp.logaddexp(normal + math.log1p(-_ASTRAY), math.log(_ASTRAY / _ASTRAY_M)) if robust else normal
