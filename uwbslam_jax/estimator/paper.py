"""Preset "paper": the paper's own steps as printed, with errata 1-4 of docs/estimator.md mended.

One process noise for every node, heading from the robot's velocity, a frame pinned to two beacons in every step, the
joint objective without prior, and a correction of the means. `step` puts these in place of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from uwbslam_jax.estimator import matching, ranging, state_vector
from uwbslam_jax.estimator.lidar_objective import lidar_residual
from uwbslam_jax.estimator.matching import Match
from uwbslam_jax.estimator.state import Seen, State
from uwbslam_jax.measurements import Ranges
from uwbslam_jax.numerics import Gaussian, gauge_pose, gaussian, rotation
from uwbslam_jax.settings import Params

_HELD = 1e3
"""Weight that keeps the frame's three coordinates and empty slots where they are [1/m]."""
_LOOSE = 1e-3
"""Weight that keeps a node without any range from making the normal equations singular [1/m]."""


def predict(belief: Gaussian, params: Params, dt: Float[Array, ""]) -> Gaussian:
    """Constant velocity of every node, Q = sigma_w^2 G G^T with G = [dt I; I] ("dynamical and observational models").

    Heading and map error have no place in the paper's state: the heading is set from the velocity afterwards.
    """
    s = state_vector.unpack(belief.mean)
    k = s.positions.shape[0]
    n = belief.mean.shape[0]
    at = jnp.arange(2 * k)
    F = jnp.eye(n).at[at, at + 2 * k].set(dt)
    G = jnp.zeros((n, 2 * k)).at[at, at].set(dt).at[at + 2 * k, at].set(1.0)
    rest = jnp.zeros(n).at[4 * k :].set(1e-8)
    mean = state_vector.pack(s._replace(positions=s.positions + dt * s.velocities, yaw_rate=jnp.zeros_like(s.yaw_rate)))
    return gaussian.predict(belief, mean, F, params.sigma_w_paper**2 * G @ G.T + jnp.diag(rest))


def to_frame(vector: Float[Array, "n"], frame_slots: Int[Array, "2"]) -> Float[Array, "n"]:
    """The gauge map on the whole state: one beacon at the origin, another on +x, both at rest.

    Rotation and translation act on every node's 2-vectors, I (x) R on the stacked state (the paper prints R (x) I).
    """
    s = state_vector.unpack(vector)
    motion = gauge_pose(s.positions[frame_slots[0]], s.positions[frame_slots[1]])
    R = rotation(motion[2])
    velocities = (s.velocities @ R.T).at[frame_slots].set(0.0)
    return state_vector.pack(
        s._replace(positions=s.positions @ R.T + motion[None, :2], velocities=velocities, heading=s.heading + motion[2])
    )


def pin_frame(belief: Gaussian, frame_slots: Int[Array, "2"]) -> Gaussian:
    """The belief in the two beacons' frame; the covariance is carried along by the Jacobian of the gauge map."""
    J = jax.jacfwd(to_frame)(belief.mean, frame_slots)
    cov = J @ belief.cov @ J.T
    return Gaussian(to_frame(belief.mean, frame_slots), (cov + cov.T) / 2)


def heading_from_velocity(belief: Gaussian) -> Gaussian:
    """Heading = arctan2 of the robot's velocity (section "Map Update"); the old one where the robot rests exactly."""
    s = state_vector.unpack(belief.mean)
    v = s.velocities[0]
    rests = jnp.all(v == 0)
    heading = jnp.where(rests, s.heading, jnp.arctan2(v[1], jnp.where(rests, 1.0, v[0])))
    return Gaussian(state_vector.pack(s._replace(heading=heading)), belief.cov)


class _Joint(NamedTuple):
    """What the residual of the joint objective needs, at one level."""

    level: Float[Array, "c c"]
    origin: Float[Array, "2"]
    size: Float[Array, ""]
    points: Float[Array, "B 2"]
    valid: Bool[Array, "B"]
    vector: Float[Array, "n"]
    ranges: Ranges
    usable: Bool[Array, "M"]
    free: Float[Array, "d"]
    params: Params


def offset(vector: Float[Array, "n"], delta: Float[Array, "d"]) -> Float[Array, "n"]:
    """The state with positions and heading moved by delta = (positions (2 K), heading)."""
    k = state_vector.node_count(vector.shape[0])
    return vector.at[: 2 * k].add(delta[: 2 * k]).at[4 * k].add(delta[2 * k])


def joint_residual(delta: Float[Array, "d"], a: _Joint) -> Float[Array, "r"]:
    """Residuals whose half squared norm is the paper's eq. (opt): LiDAR, sqrt(gamma) times ranges, held coordinates."""
    moved = offset(a.vector, delta * a.free)
    lidar = lidar_residual(state_vector.robot_pose(moved), a.level, a.origin, a.size, a.points, a.valid)
    range_residual = ranging.predicted_ranges(moved, a.ranges, a.params) - a.ranges.range
    uwb = jnp.sqrt(a.params.gamma) * jnp.where(a.usable, range_residual, 0.0)
    return jnp.concatenate([lidar, uwb, (_HELD * (1 - a.free) + _LOOSE) * delta])


def free_coordinates(active: Bool[Array, "K"], frame_slots: Int[Array, "2"]) -> Float[Array, "d"]:
    """1 for each coordinate of delta that may move, 0 for empty slots and the frame's own three (second Remark)."""
    free = jnp.repeat(active, 2).astype(jnp.float32)
    free = free.at[2 * frame_slots[0]].set(0.0).at[2 * frame_slots[0] + 1].set(0.0).at[2 * frame_slots[1] + 1].set(0.0)
    return jnp.append(free, 1.0)


def joint_match(params: Params, state: State, belief: Gaussian, seen: Seen, resolution: float) -> Float[Array, "d"]:
    """The offset that minimises eq. (opt), coarse to fine from the EKF's estimate.

    Each move is (H_lid + gamma H_uwb)^-1 (M_lid - gamma M_uwb); the paper's eq. (delta_opt) has both signs of gamma
    flipped (erratum 1).
    """
    free = free_coordinates(state.active, state.frame_slots)
    delta = jnp.zeros(free.shape[0], belief.mean.dtype)
    sweep, ranges = seen.view.sweep, seen.frame.ranges
    for k, level in reversed(list(enumerate(state.grid.levels))):
        size = jnp.asarray(resolution * 2**k, belief.mean.dtype)
        lidar = (level, state.grid.origin, size, sweep.points, sweep.valid)
        args = _Joint(*lidar, belief.mean, ranges, seen.usable, free, params)
        delta = matching.gauss_newton(joint_residual, delta, args, 5)
    return delta * free


def log_likelihood(match: Match, params: Params, valid: Bool[Array, "B"]) -> Float[Array, ""]:
    """Log density of a scan's residuals 1 - Gamma under N(0, sigma_l^2), for as many beams as count as independent."""
    count = jnp.minimum(jnp.sum(valid), params.independent_beams)
    square = ((1.0 - match.score) / params.sigma_l) ** 2
    return -0.5 * count * (square + jnp.log(2 * jnp.pi * params.sigma_l**2))


def correct(belief: Gaussian, delta: Float[Array, "d"]) -> Gaussian:
    """The offset put back: positions move, the robot's velocity turns with the heading.

    The paper adds |v| (cos dtheta, sin dtheta), which doubles the speed at dtheta = 0 (erratum 2).
    """
    k = state_vector.node_count(belief.mean.shape[0])
    s = state_vector.unpack(offset(belief.mean, delta))
    velocity = rotation(delta[2 * k]) @ s.velocities[0]
    return Gaussian(state_vector.pack(s._replace(velocities=s.velocities.at[0].set(velocity))), belief.cov)
