"""The published frame: one beacon at the origin, another on +x; state and covariance carried into it."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import jax.numpy as jnp
import numpy as np

from uwbslam_jax.estimator import state_vector
from uwbslam_jax.numerics import Gaussian, compose, rotation_matrix


def frame_motion(beacons: np.ndarray, slots: Sequence[Hashable], frame_slots: Sequence[Hashable]) -> np.ndarray:
    """(3,) the rigid motion that puts one of the beacons (B, 2) at the origin and another on +x."""
    origin, along = (beacons[slots.index(s)] for s in frame_slots)
    theta = -np.arctan2(along[1] - origin[1], along[0] - origin[0])
    return np.append(-rotation_matrix(theta) @ origin, theta)


def published(
    x: np.ndarray, *, slots: Sequence[Hashable], frame_slots: Sequence[Hashable], onward: np.ndarray
) -> np.ndarray:
    """Robot pose now and beacons in the published frame (3 + 2 B,), from the last keyframe and beacons in the start
    frame; onward: (3,) the robot's motion since [m, m, rad]."""
    beacons = x[3:].reshape(-1, 2)
    motion = frame_motion(beacons, slots, frame_slots)
    robot = compose(motion, compose(x[:3], onward))
    return np.concatenate([robot, (beacons @ rotation_matrix(motion[2]).T + motion[:2]).ravel()])


def anchored(
    belief: Gaussian,
    values: np.ndarray,
    cov: np.ndarray,
    slots: Sequence[int],
    apart: Sequence[int] = (),
    error_cov: np.ndarray | None = None,
) -> Gaussian:
    """State vector and covariance from robot pose and beacons (3 + 2 B,); velocities turn with the frame.

    The map is drawn at the estimated poses, so its error is that of the pose with the other sign: a match then
    reports what the track already says, and only the ranges can tell the two apart.

    Args:
      values, cov: (3 + 2 B,), (3 + 2 B, 3 + 2 B). slots: of the beacons. apart: slots that are to stay as they are.
      error_cov: (3, 6 + 2 B) covariance of the map's error with robot and beacons and with itself, where the pose was
        not told by a match.
    """
    mean, P = np.array(belief.mean, float), np.array(belief.cov, float)
    nodes = state_vector.node_count(len(mean))
    pose, error = np.array(state_vector.pose_indices(nodes)), np.array(state_vector.map_error_indices(nodes))
    velocity, beacon_velocities = np.arange(2 * nodes, 2 * nodes + 2), np.arange(2 * nodes + 2, 4 * nodes)
    placed = np.array([[2 * s, 2 * s + 1] for s in slots], int).ravel()
    R = rotation_matrix(values[2] - mean[pose[2]])
    mean[velocity] = R @ mean[velocity]
    moving = np.append(velocity, 4 * nodes + 1)
    motion_cov = P[np.ix_(moving, moving)]
    motion_cov[:2] = R @ motion_cov[:2]
    motion_cov[:, :2] = motion_cov[:, :2] @ R.T
    own = P
    P = np.eye(len(mean))
    P[beacon_velocities, beacon_velocities] = 1e-8
    P[np.ix_(moving, moving)] = motion_cov
    for slot in apart:  # what is not among the beacons keeps what is known of it by itself
        rows = np.array([2 * slot, 2 * slot + 1, 2 * (nodes + slot), 2 * (nodes + slot) + 1])
        P[np.ix_(rows, rows)] = own[np.ix_(rows, rows)]
    known = np.concatenate([pose, placed])
    P[np.ix_(known, known)] = cov
    if error_cov is None:
        error_cov = np.column_stack([-cov[:3], cov[:3, :3]])
    P[np.ix_(error, known)], P[np.ix_(known, error)] = error_cov[:, :-3], error_cov[:, :-3].T
    P[np.ix_(error, error)] = error_cov[:, -3:]
    mean[pose], mean[placed], mean[error] = values[:3], values[3:], 0.0
    return Gaussian(jnp.asarray(mean, jnp.float32), jnp.asarray(P, jnp.float32))
