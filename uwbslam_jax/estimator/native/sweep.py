"""A scan as points in the robot's frame, and the surfaces that it meets. Twin: mapping.sweep.

All in float32, x and y apart, a flag as 1 or 0: so the loops over beams are vectorised.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from uwbslam_jax.estimator.native.loops import loops
from uwbslam_jax.estimator.native.records import Measured, Record
from uwbslam_jax.mapping import sweep as twin

f32: Any = np.float32
Surface = np.ndarray
"""(3, B), twin: Surface: x and y of the tangent, and 1 where there is a return but no surface. [1]"""


class Sweep(NamedTuple):
    """Twin: Sweep.

    Attributes:
      rows: (4, B) x, y, valid and reach. sensor: the LiDAR's pose on the robot.
      bearing0, bearing_step: of its beams [rad].
    """

    rows: Float[ndarray, "4 B"]
    sensor: tuple[float, float, float]
    bearing0: float
    bearing_step: float


@loops
def cosine(x: float) -> float:
    """Of an angle of at most half a radian, to float32's last digit."""
    q = x * x
    return f32(1.0) + q * (f32(-1 / 2) + q * (f32(1 / 24) + q * (f32(-1 / 720) + q * f32(1 / 40320))))


@loops
def sine(x: float) -> float:
    q = x * x
    return x * (f32(1.0) + q * (f32(-1 / 6) + q * (f32(1 / 120) + q * (f32(-1 / 5040) + q * f32(1 / 362880)))))


@loops
def aim(frame: Record, yaw: float, x: Float[ndarray, "B"], y: Float[ndarray, "B"]) -> None:
    """Which way the beams point in the robot's frame."""
    start, step = frame.scan_angle_min, frame.scan_angle_increment
    for i in range(x.size):
        bearing = f32(start + step * f32(i)) + yaw
        x[i] = math.cos(bearing)
        y[i] = math.sin(bearing)


@loops
def place(measured: Measured, sweep: Sweep) -> None:
    """Points of the beams without the robot's motion; x and y hold which way the beams point."""
    zero, ranges, returned = f32(0.0), measured.beams[0], measured.beams[1]
    x, y, valid, reach = sweep.rows[0], sweep.rows[1], sweep.rows[2], sweep.rows[3]
    lidar_x, lidar_y = sweep.sensor[0], sweep.sensor[1]
    for i in range(x.size):
        valid[i] = returned[i]
        far = ranges[i] if returned[i] > zero else zero
        reach[i] = far
        x[i] = lidar_x + far * x[i]
        y[i] = lidar_y + far * y[i]


@loops
def carry_on(sweep: Sweep, time: float, velocity_x: float, velocity_y: float, yaw_rate: float) -> None:
    """Points of the beams, each placed at its own time. time: between two beams [s]."""
    x, y = sweep.rows[0], sweep.rows[1]
    if abs(yaw_rate * time * f32(x.size)) < f32(0.5):
        for i in range(x.size):
            age = time * f32(i)
            turn = yaw_rate * age
            c, s = cosine(turn), sine(turn)
            a, b = x[i], y[i]
            x[i] = c * a - s * b + velocity_x * age
            y[i] = s * a + c * b + velocity_y * age
    else:
        for i in range(x.size):
            age = time * f32(i)
            c, s = f32(math.cos(yaw_rate * age)), f32(math.sin(yaw_rate * age))
            a, b = x[i], y[i]
            x[i] = c * a - s * b + velocity_x * age
            y[i] = s * a + c * b + velocity_y * age


@loops
def undo_motion(
    measured: Measured,
    lidar: Float[ndarray, "3"],
    velocity: tuple[float, float],
    rate: float,
    rows: Float[ndarray, "4 B"],
) -> Sweep:
    """Args: velocity: in the robot's own frame [m/s]; rate: of its yaw [rad/s]. rows: get the sweep."""
    frame, spin = measured.frame, f32(rate)
    step = frame.scan_angle_increment + spin * frame.scan_time_increment
    sweep = Sweep(rows, (lidar[0], lidar[1], lidar[2]), frame.scan_angle_min, step)
    aim(frame, lidar[2], rows[0], rows[1])
    place(measured, sweep)
    carry_on(sweep, frame.scan_time_increment, f32(velocity[0]), f32(velocity[1]), spin)
    return sweep


@loops
def continued(sweep: Sweep, way: int, side: Float[ndarray, "3 B"]) -> None:
    """The last return carried on into gaps, towards higher beams (way 1) or lower (way -1): x, y, and where it is."""
    zero, one, x, y, valid = f32(0.0), f32(1.0), sweep.rows[0], sweep.rows[1], sweep.rows[2]
    beams, reach = valid.size, 0
    for stride in twin._GAPS:
        reach += stride
    last = -reach - 1
    for k in range(beams):
        i = k if way > 0 else beams - 1 - k
        if valid[i] > zero:
            last = k
        has = k - last <= reach
        j = (last if way > 0 else beams - 1 - last) if has else i
        side[0, i], side[1, i], side[2, i] = x[j], y[j], one if has else zero


@loops
def try_neighbours(
    k: int, sweep: Sweep, before: Float[ndarray, "3 B"], after: Float[ndarray, "3 B"], surface: Surface
) -> None:
    """Surfaces of the beams that have none yet, by the neighbours k beams away."""
    zero, half, one = f32(0.0), f32(0.5), f32(1.0)
    narrow, wide = f32(twin._NORMAL_SPAN[0]), f32(twin._NORMAL_SPAN[1])
    floor, slope, lopsided = f32(twin._OFF_LINE[0]), f32(twin._OFF_LINE[1]), f32(twin._LOPSIDED)
    rows, n = sweep.rows, sweep.rows.shape[1] - 2 * k
    ax, ay, a_has, a_own = before[0, :n], before[1, :n], before[2, :n], rows[2, :n]
    bx, by, b_has, b_own = after[0, 2 * k :], after[1, 2 * k :], after[2, 2 * k :], rows[2, 2 * k :]
    own_x, own_y = rows[0, k : k + n], rows[1, k : k + n]
    tx, ty, free = surface[0, k : k + n], surface[1, k : k + n], surface[2, k : k + n]
    for i in range(n):
        dx, dy, x, y = bx[i] - ax[i], by[i] - ay[i], own_x[i] - ax[i], own_y[i] - ay[i]
        span = np.sqrt(dx * dx + dy * dy)
        scale = one / max(span, f32(1e-6))
        share = (dx * x + dy * y) * scale * scale
        off = abs(dx * y - dy * x) * scale
        tolerance = floor + slope * span
        own_two = a_own[i] * b_own[i] > zero
        uneven = np.sqrt(max(tolerance * tolerance - off * off, zero)) if own_two else lopsided * span
        fits = (span > narrow) & (span < wide) & (abs(share - half) * span < uneven) & (off < tolerance)
        fits = fits & (free[i] * a_has[i] * b_has[i] > zero)
        tx[i] = dx * scale if fits else tx[i]
        ty[i] = dy * scale if fits else ty[i]
        free[i] = zero if fits else free[i]


@loops
def find_surface(sweep: Sweep, surface: Surface, before: Float[ndarray, "3 B"], after: Float[ndarray, "3 B"]) -> None:
    """Args: surface: is found. before, after: work."""
    valid = sweep.rows[2]
    continued(sweep, 1, before)
    continued(sweep, -1, after)
    for i in range(valid.size):
        surface[0, i] = surface[1, i] = f32(0.0)
        surface[2, i] = valid[i]
    for k in twin._NEIGHBOURS:
        if valid.size > 2 * k:
            try_neighbours(k, sweep, before, after, surface)


@loops
def thinned(sweep: Sweep, most: int) -> Sweep:
    """Every n-th beam, about as many as asked for. Twin: estimator.matching.thinned."""
    beams = sweep.rows.shape[1]
    n = max(1, beams // most)
    rows = np.empty((4, (beams + n - 1) // n), np.float32)
    for q in range(4):
        for i in range(rows.shape[1]):
            rows[q, i] = sweep.rows[q, i * n]
    return Sweep(rows, sweep.sensor, sweep.bearing0, sweep.bearing_step * f32(n))
