"""What happens to the state when a beacon enters, is carried, rests or leaves, and when the robot was put elsewhere.

Changes of mean, covariance and masks only; who decides is in `beacons`.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from uwbslam_jax.beacons.evidence import OTHER, X, Y
from uwbslam_jax.estimator import State, state_vector
from uwbslam_jax.numerics import RANGE_FLOOR_M, Gaussian, Spot

_RESTING_SPEED = 1e-4
"""Standard deviation of the velocity of a node at rest [m/s]."""


def place(state: State, slot: int, spot: Spot, rows: np.ndarray, *, moving: bool) -> State:
    """The state with a beacon put where its ranges say.

    Its place hangs on the nodes that it was ranged from: on the robot's track, which turns and shifts as a whole with
    the robot's present pose, and on the beacons. The covariance is carried along (the usual initialisation of a
    landmark): a beacon placed by a robot that has drifted shares the drift.

    Args:
      rows: (R, 6) of `sightings` that the spot was found from.
    """
    k = state.active.shape[0]
    own = _rows_of(slot, k)
    J = _follows(spot, rows, np.asarray(state_vector.robot_pose(state.belief.mean), float), k)
    J[:, own] = 0.0
    P = np.asarray(state.belief.cov, float)
    cov = spot.cov.copy()
    cov[:2, :2] += RANGE_FLOOR_M**2 * np.eye(2)
    velocity = spot.velocity if moving else np.zeros(2)
    if not moving:
        J[2:], cov[2:, :], cov[:, 2:] = 0.0, 0.0, 0.0
        cov[2:, 2:] = _RESTING_SPEED**2 * np.eye(2)
    mean = np.array(state.belief.mean, float)
    mean[own] = np.concatenate([spot.place, velocity])
    P[own, :] = P[:, own] = 0.0
    cross = J @ P
    cov = cov + cross @ J.T
    P[own, :], P[:, own] = cross, cross.T
    P[np.ix_(own, own)] = cov
    belief = Gaussian(jnp.asarray(mean, jnp.float32), jnp.asarray(P, jnp.float32))
    return _flagged(state._replace(belief=belief), slot, active=True, moving=moving)


def _follows(spot: Spot, rows: np.ndarray, robot: np.ndarray, k: int) -> np.ndarray:
    """J (4, n): how place and velocity follow the state that their anchors are part of."""
    J = np.zeros((4, state_vector.state_size(k)))
    by_robot = rows[:, OTHER] == 0
    for other in map(int, np.unique(rows[~by_robot, OTHER])):
        J[:, [2 * other, 2 * other + 1]] = spot.pull[rows[:, OTHER] == other].sum(axis=0)
    pull = spot.pull[by_robot]
    x, y, heading = state_vector.pose_indices(k)
    J[:, [x, y]] = pull.sum(axis=0)
    lever = rows[by_robot][:, [X, Y]] - robot[:2]
    J[:, heading] = np.einsum("rij,rj->i", pull, np.stack([-lever[:, 1], lever[:, 0]], axis=1))
    return J


def remove(state: State, slot: int) -> State:
    """The state without a beacon; its rows of the covariance become those of an empty slot."""
    own = _rows_of(slot, state.active.shape[0])
    mean, P = np.array(state.belief.mean), np.array(state.belief.cov)
    mean[own] = P[own, :] = P[:, own] = 0.0
    P[own, own] = [1.0, 1.0, _RESTING_SPEED**2, _RESTING_SPEED**2]
    belief = Gaussian(jnp.asarray(mean), jnp.asarray(P))
    return _flagged(state._replace(belief=belief), slot, active=False, moving=False)


def loosen(state: State, slot: int, variance: float) -> State:
    """The state with a beacon's place less certain by a variance in each direction [m^2]."""
    at, P = np.array([2 * slot, 2 * slot + 1]), np.array(state.belief.cov)
    P[at, at] += np.float32(variance)
    return state._replace(belief=state.belief._replace(cov=jnp.asarray(P)))


def put_robot(state: State, position: np.ndarray) -> State:
    """The state with the robot somewhere else: at rest, heading unknown, the map where it was."""
    k = state.active.shape[0]
    rows = np.array([0, 1, 2 * k, 2 * k + 1, 4 * k, 4 * k + 1, *state_vector.map_error_indices(k)])
    mean, P = np.array(state.belief.mean), np.array(state.belief.cov)
    heading = mean[4 * k]
    mean[rows] = P[rows, :] = P[:, rows] = 0.0
    mean[:2], mean[4 * k] = position, heading
    P[rows, rows] = [0.3**2, 0.3**2, 1.0, 1.0, 10.0, 1.0, 0.05**2, 0.05**2, 0.01**2]
    return state._replace(belief=Gaussian(jnp.asarray(mean), jnp.asarray(P)))


def _flagged(state: State, slot: int, *, active: bool, moving: bool) -> State:
    """The state with a slot in use or not, carried or at rest."""
    used, carried = np.array(state.active), np.array(state.moving)
    used[slot], carried[slot] = active, moving
    return state._replace(active=jnp.asarray(used), moving=jnp.asarray(carried))


def _rows_of(slot: int, k: int) -> np.ndarray:
    """Where a node's place and velocity stand in the state vector."""
    return np.array([2 * slot, 2 * slot + 1, 2 * (k + slot), 2 * (k + slot) + 1])
