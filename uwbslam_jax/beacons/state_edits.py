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
    active, walks = state.active.at[slot].set(True), state.moving.at[slot].set(moving)
    return state._replace(belief=belief, active=active, moving=walks)


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
    k = state.active.shape[0]
    own = jnp.asarray(_rows_of(slot, k))
    mean = state.belief.mean.at[own].set(0.0)
    variance = jnp.array([1.0, 1.0, _RESTING_SPEED**2, _RESTING_SPEED**2])
    P = state.belief.cov.at[own, :].set(0.0).at[:, own].set(0.0).at[own, own].set(variance)
    active, moving = state.active.at[slot].set(False), state.moving.at[slot].set(False)
    return state._replace(belief=Gaussian(mean, P), active=active, moving=moving)


def loosen(state: State, slot: int, variance: float) -> State:
    """The state with a beacon's place less certain by a variance in each direction [m^2]."""
    at = jnp.array([2 * slot, 2 * slot + 1])
    return state._replace(belief=state.belief._replace(cov=state.belief.cov.at[at, at].add(variance)))


def put_robot(state: State, position: np.ndarray) -> State:
    """The state with the robot somewhere else: at rest, heading unknown, the map where it was."""
    k = state.active.shape[0]
    rows = jnp.array([0, 1, 2 * k, 2 * k + 1, 4 * k, 4 * k + 1, *state_vector.map_error_indices(k)])
    variance = jnp.array([0.3**2, 0.3**2, 1.0, 1.0, 10.0, 1.0, 0.05**2, 0.05**2, 0.01**2])
    mean = state.belief.mean.at[rows].set(0.0).at[:2].set(jnp.asarray(position, jnp.float32))
    mean = mean.at[4 * k].set(state.belief.mean[4 * k])
    P = state.belief.cov.at[rows, :].set(0.0).at[:, rows].set(0.0).at[rows, rows].set(variance)
    return state._replace(belief=Gaussian(mean, P))


def _rows_of(slot: int, k: int) -> np.ndarray:
    """Where a node's place and velocity stand in the state vector."""
    return np.array([2 * slot, 2 * slot + 1, 2 * (k + slot), 2 * (k + slot) + 1])
