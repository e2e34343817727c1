"""Process model: how the state moves between two frames, with or without odometry."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from uwbslam_jax import ekf, layout
from uwbslam_jax.config import Params
from uwbslam_jax.geometry import perpendicular, rotation, safe_norm
from uwbslam_jax.layout import Nodes
from uwbslam_jax.measurements import Odometry

_COAST_S = 1.5
"""A robot that is not seen keeps its velocity about this long; a longer gap adds no more motion."""
_ACCELERATION = (5.0, 15.0)
"""Change of velocity that an increment of the odometry is taken for at most [m/s^2, rad/s^2]: a displacement over a
few milliseconds tells that the stamps are late, not that the robot is fast."""
_FASTEST = (1.5, 2.0, 2.0)
"""However long the robot was not seen, its velocity, yaw rate and heading are not less certain than this
[m/s, rad/s, rad]."""


def transition(
    vector: Float[Array, "n"], dt: Float[Array, ""], odometry: Odometry, moving: Bool[Array, "K"]
) -> Float[Array, "n"]:
    """State after dt [s]: coordinated turn of the robot, or the odometry's increment; constant velocity of a node
    that moves, none of one at rest. The map error is a rigid motion of the map, so it turns with the lever arm that
    the robot drives."""
    s = layout.unpack(vector)
    coast = _COAST_S * (1.0 - jnp.exp(-dt / _COAST_S))
    safe_dt = jnp.maximum(dt, 1e-3)
    turn = s.yaw_rate * coast
    coasted = rotation(turn / 2) @ s.velocities[0] * coast
    driven = rotation(s.heading) @ odometry.increment[:2]
    step = jnp.where(odometry.valid, driven, coasted)
    slower = jnp.exp(-dt / (4 * _COAST_S))
    gain = jnp.array(_ACCELERATION) * dt
    faster = driven / safe_dt - s.velocities[0]
    faster = faster * jnp.minimum(1.0, gain[0] / jnp.maximum(safe_norm(faster), 1e-9))
    velocity = jnp.where(odometry.valid, s.velocities[0] + faster, rotation(turn) @ s.velocities[0] * slower)
    yaw_step = jnp.where(odometry.valid, odometry.increment[2], turn)
    spun = s.yaw_rate + jnp.clip(odometry.increment[2] / safe_dt - s.yaw_rate, -gain[1], gain[1])
    yaw_rate = jnp.where(odometry.valid, spun, s.yaw_rate * slower)
    velocities = jnp.where(moving[:, None], s.velocities, 0.0).at[0].set(velocity)
    steps = (velocities * coast).at[0].set(step)
    map_step = s.map_error[2] * perpendicular(step)
    return layout.pack(
        Nodes(
            positions=s.positions + steps,
            velocities=velocities,
            heading=s.heading + yaw_step,
            yaw_rate=yaw_rate,
            map_error=s.map_error.at[:2].add(map_step),
        )
    )


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
    safe_dt = jnp.maximum(dt, 1e-3)
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
    resting = jnp.stack([params.sigma_w_beacon**2 * dt, 0.0 * dt, 1e-10 + 0.0 * dt])
    nodes = jnp.where(moving[:, None], carried, resting).at[0].set(robot)  # (K, 3): position, coupling, velocity
    p, c, v = (jnp.repeat(nodes[:, m], 2) for m in range(3))
    diagonal = jnp.concatenate([p, v, yaw[:1], yaw[2:], jnp.zeros(3)])
    coupling = jnp.concatenate([c, jnp.zeros(2 * k), yaw[1:2], jnp.zeros(4)])
    return diagonal, coupling


def predict(
    belief: ekf.Gaussian,
    params: Params,
    dt: Float[Array, ""],
    odometry: Odometry,
    moving: Bool[Array, "K"],
    unrest: Float[Array, "2"],
) -> ekf.Gaussian:
    """Belief dt [s] later.

    Args:
      moving: (K,) which nodes are carried; the robot's entry is ignored.
      unrest: variance of a displacement and of a turn between two frames that no velocity explains [m^2, rad^2].
    """
    k = moving.shape[0]
    mean = transition(belief.mean, dt, odometry, moving)
    F = jax.jacfwd(transition)(belief.mean, dt, odometry, moving)
    diagonal, coupling = process_noise(params, dt, odometry, moving)
    pose = jnp.array(layout.pose_indices(k))
    jump = jnp.where(odometry.valid, 0.0, unrest)
    diagonal = diagonal.at[pose].add(jump[jnp.array([0, 0, 1])])
    rows = jnp.array(layout.map_error_indices(k))
    Q = jnp.diag(diagonal.at[rows].add(1e-12))
    at = jnp.concatenate([jnp.arange(2 * k), jnp.array([4 * k])])
    to = jnp.concatenate([jnp.arange(2 * k, 4 * k), jnp.array([4 * k + 1])])
    Q = Q.at[at, to].add(coupling[at]).at[to, at].add(coupling[at])
    return _bounded(ekf.predict(belief, mean, F, Q), k)


def _bounded(belief: ekf.Gaussian, k: int) -> ekf.Gaussian:
    """The robot's velocity, yaw rate and heading at most as uncertain as such a robot's can be."""
    rows = jnp.array([2 * k, 2 * k + 1, 4 * k + 1, 4 * k])
    most = jnp.array([_FASTEST[0], *_FASTEST]) ** 2
    shrink = jnp.sqrt(jnp.minimum(1.0, most / jnp.diagonal(belief.cov)[rows]))
    scale = jnp.ones(belief.cov.shape[0]).at[rows].set(shrink)
    return ekf.Gaussian(belief.mean, belief.cov * (scale[:, None] * scale[None, :]))
