"""What a step carries to the next, what it is shown, and what it reports."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from uwbslam_jax.estimator import match_fusion, ranging, state_vector
from uwbslam_jax.estimator.matching import View
from uwbslam_jax.mapping import Grid, grid as occupancy
from uwbslam_jax.measurements import Frame
from uwbslam_jax.numerics import Gaussian
from uwbslam_jax.settings import Config

_SEEN_M = 0.05
"""A match that tells the position no better than this in some direction does not observe it [m]."""


class State(NamedTuple):
    """All that a step carries to the next; n = 4 K + 5, see `state_vector`.

    Attributes:
      belief: over the state vector.
      active: (K,) slots in use, the robot's always.
      moving: (K,) nodes taken to be carried about.
      frame_slots: (2,) the beacons that make the published frame, for preset "paper".
      scatter: how much each pair's ranges scatter, see ranging.learn_scatter.
      grid: the map's window.
      drawn_pose: (3,) where the last scan was drawn.
      scans_drawn: how many were.
      map_spread: of the map's errors from place to place, see match_fusion.MapSpread.
      unrest: variance of the motion between two scans that no velocity explains [m^2, rad^2], see
        match_fusion.learn_unrest.
    """

    belief: Gaussian
    active: Bool[Array, "K"]
    moving: Bool[Array, "K"]
    frame_slots: Int[Array, "2"]
    scatter: ranging.Scatter
    grid: Grid
    drawn_pose: Float[Array, "3"]
    scans_drawn: Int[Array, ""]
    map_spread: match_fusion.MapSpread
    unrest: Float[Array, "2"]


class Seen(NamedTuple):
    """What a frame shows: its measurements, which of its ranges are used, and its scan without the robot's motion."""

    frame: Frame
    usable: Bool[Array, "M"]
    view: View


class Estimate(NamedTuple):
    """What a step reports, in the frame of the state.

    Attributes:
      pose, pose_cov: (3,), (3, 3) the robot [m, m, rad].
      velocity: (2,) [m/s]; yaw_rate [rad/s].
      beacons, beacon_covs: (K, 2), (K, 2, 2) [m]; slot 0 is the robot.
      active, moving: (K,).
      map_error: (3,) of the map where the robot is [m, m, rad].
      matched_pose: (3,) what the match reported, before the map's own error is taken off.
      information: (3, 3) what the match told about it [1/m^2 ...]; 0 where it told nothing.
      score, known: of the match, see Match.
      poor, searched, drawn: what happened to the scan.
      innovation, normalised, weight: (M,) of the ranges.
      log_likelihood: of the ranges; match_log_likelihood: of the match, 0 where there is no scan; None where
        nobody asks for it.
    """

    pose: Float[Array, "3"]
    pose_cov: Float[Array, "3 3"]
    velocity: Float[Array, "2"]
    yaw_rate: Float[Array, ""]
    beacons: Float[Array, "K 2"]
    beacon_covs: Float[Array, "K 2 2"]
    active: Bool[Array, "K"]
    moving: Bool[Array, "K"]
    map_error: Float[Array, "3"]
    matched_pose: Float[Array, "3"]
    information: Float[Array, "3 3"]
    score: Float[Array, ""]
    known: Float[Array, ""]
    poor: Bool[Array, ""]
    searched: Bool[Array, ""]
    drawn: Bool[Array, ""]
    innovation: Float[Array, "M"]
    normalised: Float[Array, "M"]
    weight: Float[Array, "M"]
    log_likelihood: Float[Array, ""]
    match_log_likelihood: Float[Array, ""] | None


def init(config: Config) -> State:
    """The robot at the origin of its own start frame, no beacon, no map."""
    n = state_vector.state_size(config.nodes)
    variance = jnp.ones(n, jnp.float32)
    pose = jnp.array(state_vector.pose_indices(config.nodes))
    error = jnp.array(state_vector.map_error_indices(config.nodes))
    # the frame is the start pose: known exactly, and so is the map drawn from it
    variance = variance.at[pose].set(1e-8).at[error].set(1e-8)
    return State(
        belief=Gaussian(jnp.zeros(n, jnp.float32), jnp.diag(variance)),
        active=jnp.zeros(config.nodes, bool).at[0].set(True),
        moving=jnp.zeros(config.nodes, bool),
        frame_slots=jnp.array([1, 2], jnp.int32),
        scatter=ranging.quiet(config.nodes),
        grid=occupancy.empty(config.cells, config.levels, config.resolution),
        drawn_pose=jnp.zeros(3, jnp.float32),
        scans_drawn=jnp.zeros((), jnp.int32),
        map_spread=match_fusion.even_map(),
        unrest=jnp.array(match_fusion.CALM, jnp.float32) ** 2,
    )


def widened(state: State, config: Config) -> State:
    """The state with the slots of a larger configuration, the new ones not in use."""
    old, wide = state.active.shape[0], init(config)
    k = config.nodes
    at = np.concatenate([np.arange(2 * old), 2 * k + np.arange(2 * old), 4 * k + np.arange(5)])  # see state_vector
    mean, cov = wide.belief.mean.at[at].set(state.belief.mean), wide.belief.cov.at[np.ix_(at, at)].set(state.belief.cov)
    grown = (new.at[:old, :old].set(leaf) for new, leaf in zip(wide.scatter, state.scatter, strict=True))
    return state._replace(
        belief=Gaussian(mean, cov),
        active=wide.active.at[:old].set(state.active),
        moving=wide.moving.at[:old].set(state.moving),
        scatter=ranging.Scatter(*grown),
    )


def map_pose(estimate: Estimate) -> np.ndarray:
    """(3,) where the map has the robot: the match, or what was expected of it where nothing matched [m, m, rad]."""
    if np.any(estimate.information):
        return np.asarray(estimate.matched_pose, float)
    return np.asarray(estimate.pose, float) + np.asarray(estimate.map_error, float)


def sight(estimate: Estimate) -> float:
    """What a match observed of the position: NaN for all of it, inf for nothing, else the direction that it does not
    observe, in the map's frame [rad]."""
    (xx, xy), (_, yy) = estimate.information[:2, :2].tolist()
    mean, spread = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)  # the eigenvalues are mean -+ spread
    if mean - spread > _SEEN_M**-2:
        return math.nan
    along = 0.5 * math.atan2(2 * xy, xx - yy)  # where it is observed best
    return along + 0.5 * math.pi if mean + spread > _SEEN_M**-2 else math.inf
