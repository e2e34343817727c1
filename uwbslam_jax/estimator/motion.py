"""Process model: how the state moves between two frames, with or without odometry."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from uwbslam_jax.estimator import state_vector
from uwbslam_jax.measurements import Odometry
from uwbslam_jax.numerics import gaussian, perpendicular, rotation, safe_norm
from uwbslam_jax.settings import Params

_COAST_S = 1.5
"""A robot that is not seen keeps its velocity about this long; a longer gap adds no more motion."""
_ACCELERATION = (5.0, 15.0)
"""Change of velocity that an increment of the odometry is taken for at most [m/s^2, rad/s^2]: a displacement over a
few milliseconds tells that the stamps are late, not that the robot is fast."""
_FASTEST = (1.5, 2.0, 2.0)
"""However long the robot was not seen, its velocity, yaw rate and heading are not less certain than this
[m/s, rad/s, rad]."""
_SHORTEST_S, _LEAST_NOISE = 1e-3, (1e-10, 1e-12)
"""A shorter time between frames is taken for so long [s]; what the velocity of a beacon at rest and the error of a map
gain in a frame, so that no variance is 0 [m^2/s^2; m^2, rad^2]."""
_WIDEST_MAP = (5.0, 1.0)
"""Nor does a map err by more [m, rad]: it is drawn where the robot was believed to be. Without a bound a robot that is
lost among ground of many epochs has a variance beside which float32 loses all the others."""


def transition(
    vector: Float[Array, "n"], dt: Float[Array, ""], odometry: Odometry, moving: Bool[Array, "K"]
) -> Float[Array, "n"]:
    """State after dt [s]: coordinated turn of the robot, or the odometry's increment; constant velocity of a node
    that moves, none of one at rest. The map error is a rigid motion of the map, so it turns with the lever arm that
    the robot drives."""
    s = state_vector.unpack(vector)
    coast = _coast(dt)
    velocities = jnp.where(moving[:, None], s.velocities, 0.0)
    beacons = s._replace(positions=s.positions + coast * velocities, velocities=velocities)
    return _put_robot(state_vector.pack(beacons), _robot_transition(_take_robot(vector), dt, odometry))


def _coast(dt: Float[Array, ""]) -> Float[Array, ""]:
    """Time for which the velocity counts as kept in a gap of dt [s]."""
    return _COAST_S * (1.0 - jnp.exp(-dt / _COAST_S))


def _take_robot(rows: Float[Array, "n *m"]) -> Float[Array, "9 *m"]:
    """The robot's own rows: place, velocity, heading, yaw rate and map error. How they move depends on no beacon."""
    k = state_vector.node_count(rows.shape[0])
    return jnp.concatenate([rows[:2], rows[2 * k : 2 * k + 2], rows[4 * k :]])


def _put_robot(rows: Float[Array, "n *m"], robot: Float[Array, "9 *m"]) -> Float[Array, "n *m"]:
    k = state_vector.node_count(rows.shape[0])
    return jnp.concatenate([robot[:2], rows[2 : 2 * k], robot[2:4], rows[2 * k + 2 : 4 * k], robot[4:]])


def _robot_transition(robot: Float[Array, "9"], dt: Float[Array, ""], odometry: Odometry) -> Float[Array, "9"]:
    place, speed, heading, rate, error = robot[:2], robot[2:4], robot[4], robot[5], robot[6:]
    coast, safe_dt = _coast(dt), jnp.maximum(dt, _SHORTEST_S)
    turn = rate * coast
    coasted = rotation(turn / 2) @ speed * coast
    driven = rotation(heading) @ odometry.increment[:2]
    step = jnp.where(odometry.valid, driven, coasted)
    slower = jnp.exp(-dt / (4 * _COAST_S))
    gain = jnp.array(_ACCELERATION) * dt
    faster = driven / safe_dt - speed
    faster = faster * jnp.minimum(1.0, gain[0] / jnp.maximum(safe_norm(faster), 1e-9))
    velocity = jnp.where(odometry.valid, speed + faster, rotation(turn) @ speed * slower)
    yaw_step = jnp.where(odometry.valid, odometry.increment[2], turn)
    spun = rate + jnp.clip(odometry.increment[2] / safe_dt - rate, -gain[1], gain[1])
    yaw_rate = jnp.where(odometry.valid, spun, rate * slower)
    moved_error = error[:2] + error[2] * perpendicular(step)
    turned = jnp.stack([heading + yaw_step, yaw_rate])
    return jnp.concatenate([place + step, velocity, turned, moved_error, error[2:]])


def process_noise(
    params: Params,
    dt: Float[Array, ""],
    odometry: Odometry,
    moving: Bool[Array, "K"],
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Diagonal of Q and its position-velocity (heading-rate) couplings, in the order of the state vector.

    White acceleration (Bar-Shalom, Li, Kirubarajan, eq. 6.2.3-7) for what moves, a random walk for beacons at rest,
    the error of the increment where there is odometry.
    """
    k = moving.shape[0]
    t = jnp.minimum(dt, _COAST_S)
    safe_dt = jnp.maximum(dt, _SHORTEST_S)
    length = jnp.sqrt(odometry.increment[0] ** 2 + odometry.increment[1] ** 2 + 1e-12)
    odo_xy = (params.odom_sigma_floor[0] + params.odom_sigma_xy * length) ** 2
    odo_yaw = (params.odom_sigma_floor[1] + params.odom_sigma_yaw * jnp.abs(odometry.increment[2])) ** 2
    w, w_yaw = params.sigma_w**2, params.sigma_w_yaw**2
    robot = jnp.where(
        odometry.valid,
        jnp.stack([odo_xy, odo_xy / safe_dt, odo_xy / safe_dt**2]),
        w * jnp.stack([t**3 / 3, t**2 / 2, t]),
    )
    yaw = jnp.where(
        odometry.valid,
        jnp.stack([odo_yaw, odo_yaw / safe_dt, odo_yaw / safe_dt**2]),
        w_yaw * jnp.stack([t**3 / 3, t**2 / 2, t]),
    )
    carried = params.sigma_w_carried**2 * jnp.stack([t**3 / 3, t**2 / 2, t])
    resting = jnp.stack([params.sigma_w_beacon**2 * dt, 0.0 * dt, _LEAST_NOISE[0] + 0.0 * dt])
    nodes = jnp.where(moving[:, None], carried, resting).at[0].set(robot)  # (K, 3): position, coupling, velocity
    p, c, v = (jnp.repeat(nodes[:, m], 2) for m in range(3))
    diagonal = jnp.concatenate([p, v, yaw[:1], yaw[2:], jnp.zeros(3)])
    coupling = jnp.concatenate([c, jnp.zeros(2 * k), yaw[1:2], jnp.zeros(4)])
    return diagonal, coupling


def predict(
    belief: gaussian.Gaussian,
    params: Params,
    dt: Float[Array, ""],
    odometry: Odometry,
    moving: Bool[Array, "K"],
    unrest: Float[Array, "2"],
) -> gaussian.Gaussian:
    """Belief dt [s] later.

    Args:
      moving: (K,) which nodes are carried; the robot's entry is ignored.
      unrest: variance of a displacement and of a turn between two frames that no velocity explains [m^2, rad^2].
    """
    k = moving.shape[0]
    mean = transition(belief.mean, dt, odometry, moving)
    F_robot = jax.jacfwd(_robot_transition)(_take_robot(belief.mean), dt, odometry)
    coast = _coast(dt)

    def carry(rows: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """F @ rows: a beacon's place moves by its velocity if it is carried, the robot's rows as its transition."""
        velocities = jnp.where(jnp.repeat(moving, 2)[:, None], rows[2 * k : 4 * k], 0.0)
        beacons = jnp.concatenate([rows[: 2 * k] + coast * velocities, velocities, rows[4 * k :]])
        return _put_robot(beacons, F_robot @ _take_robot(rows))

    cov = carry(carry(belief.cov).T)
    diagonal, coupling = process_noise(params, dt, odometry, moving)
    jump = jnp.where(odometry.valid, 0.0, unrest)
    every = jnp.arange(mean.shape[0])
    pose, error = state_vector.pose_indices(k), every > 4 * k + 1
    diagonal = (
        diagonal + jnp.where(every < 2, jump[0], jnp.where(every == pose[2], jump[1], 0.0)) + _LEAST_NOISE[1] * error
    )
    # a place is coupled to its velocity, which stands 2 K further on, the heading to the yaw rate next to it
    partner = jnp.where(every < 2 * k, every + 2 * k, jnp.where(every == 4 * k, 4 * k + 1, -1))
    pair = jnp.where(every[None, :] == partner[:, None], coupling[:, None], 0.0)
    Q = jnp.where(every[:, None] == every[None, :], diagonal[:, None], 0.0) + pair + pair.T
    return gaussian.Gaussian(mean, _bounded((cov + cov.T) / 2 + Q, k))


def _bounded(cov: Float[Array, "n n"], k: int) -> Float[Array, "n n"]:
    """The robot's velocity, yaw rate and heading, and the map's error, at most as uncertain as they can be."""
    most = np.zeros(cov.shape[0], np.float32)
    most[[2 * k, 2 * k + 1, 4 * k + 1, 4 * k]] = np.array([_FASTEST[0], *_FASTEST]) ** 2
    most[[*state_vector.map_error_indices(k)]] = np.array([_WIDEST_MAP[0], *_WIDEST_MAP]) ** 2
    ratio = jnp.where(most > 0, most / jnp.diagonal(cov), 1.0)
    scale = jnp.sqrt(jnp.minimum(1.0, ratio))
    return cov * (scale[:, None] * scale[None, :])
