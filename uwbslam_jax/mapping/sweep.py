"""A scan as points in the robot's frame, and the surfaces that it meets: which way they run, and what stands in for
beams without a return."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from uwbslam_jax.measurements import Scan

_NEIGHBOURS = (1, 2, 4, 8, 16)
"""Distances to the neighbours that a normal is tried with, the nearest first [beams]."""
_GAPS = (1, 2, 4, 8, 16)
"""A gap is closed from either side in such strides: up to 31 beams of it [beams]."""
_NORMAL_SPAN = (0.25, 1.0)
"""A normal needs neighbours this far apart [m]."""
_OFF_LINE = (0.025, 0.05)
"""How far a beam's end may be off the line through its neighbours: so much [m], and so much of their distance."""
_LOPSIDED = 0.4
"""Where a neighbour is a stand-in, the beam may be so far off their middle, as a share of their distance."""


class Surface(NamedTuple):
    """Where the beams of a scan meet surfaces whose direction can be told.

    Attributes:
      tangent: (2, B) unit vectors along the surface in the robot's frame, 0 where there is none.
      found: (B,) whether there is one.
    """

    tangent: Float[Array, "2 B"]
    found: Bool[Array, "B"]


def find_surface(sweep: Sweep) -> Surface:
    """Surface directions from two neighbours of a beam that are far enough apart for range noise not to matter, one on
    either side, with the next return in place of one that is missing. Where the three are not on one line there is no
    surface.
    """
    # what is seen is a decision, held when the step is differentiated
    points, valid = jax.lax.stop_gradient(sweep.points), sweep.valid
    beams, most = valid.shape[0], _NEIGHBOURS[-1]
    own = points.T
    (before, before_valid), (after, after_valid) = (_continued(own, valid, way) for way in (1, -1))
    pad = ((0, 0), (most, most))
    before, after = jnp.pad(before, pad), jnp.pad(after, pad)
    before_valid, after_valid, wide_valid = (jnp.pad(a, most) for a in (before_valid, after_valid, valid))

    def shifted(a: Shaped[Array, "*d P"], k: int) -> Shaped[Array, "*d B"]:
        return a[..., most + k : most + k + beams]

    tangent, found = jnp.zeros_like(own), jnp.zeros_like(valid)
    for k in _NEIGHBOURS:
        a, b = shifted(before, -k), shifted(after, k)
        (dx, dy), (x, y) = b - a, own - a
        span = jnp.sqrt(dx**2 + dy**2)
        scale = 1.0 / jnp.maximum(span, 1e-6)
        share = (dx * x + dy * y) * scale**2
        off = jnp.abs(dx * y - dy * x) * scale
        ok = valid & shifted(before_valid, -k) & shifted(after_valid, k) & ~found
        ok = ok & (span > _NORMAL_SPAN[0]) & (span < _NORMAL_SPAN[1])
        tolerance = _OFF_LINE[0] + _OFF_LINE[1] * span
        # where neither is a stand-in, they are also as far to either side: no wall seen at a grazing angle, whose
        # direction a step in it would turn
        own_two = shifted(wide_valid, -k) & shifted(wide_valid, k)
        uneven = jnp.where(own_two, jnp.sqrt(jnp.maximum(tolerance**2 - off**2, 0.0)), _LOPSIDED * span)
        even = jnp.abs(share - 0.5) * span < uneven
        ok = ok & even & (off < tolerance)
        tangent = jnp.where(ok[None], jnp.stack([dx * scale, dy * scale]), tangent)
        found = found | ok
    return Surface(tangent, found)


def stand_ins(valid: Bool[Array, "B"]) -> tuple[Int[Array, "B"], Bool[Array, "B"]]:
    """For each beam itself, or where it has no return the nearest one that has; and whether there is one in reach."""
    own = jnp.arange(valid.shape[0])
    ((before,), has_before), ((after,), has_after) = (_continued(own[None], valid, way) for way in (1, -1))
    nearer = has_before & (~has_after | (own - before <= after - own))
    return jnp.where(nearer, before, after), has_before | has_after


def _continued(
    values: Shaped[Array, "d B"], valid: Bool[Array, "B"], way: int
) -> tuple[Shaped[Array, "d B"], Bool[Array, "B"]]:
    """Values with the last valid one carried on into gaps, towards higher beams (way 1) or lower (way -1), and
    where they are valid then."""
    for stride in (stride for stride in _GAPS if stride < valid.shape[0]):
        values = jnp.where(valid[None], values, jnp.roll(values, way * stride, axis=-1))
        none = jnp.zeros(stride, bool)
        moved = jnp.append(none, valid[:-stride]) if way > 0 else jnp.append(valid[stride:], none)
        valid = valid | moved
    return values, valid


class Sweep(NamedTuple):
    """A scan in the robot's frame at the frame's stamp.

    Attributes:
      points: (B, 2) end points, each placed at its own time [m].
      valid: (B,).
      sensor: (3,) the LiDAR's pose [m, m, rad].
      bearing0, bearing_step: bearing of beam i in the sensor's frame after the sweep is undone [rad].
      reach: (B,) length of each beam, 0 where there is no return [m].
    """

    points: Float[Array, "B 2"]
    valid: Bool[Array, "B"]
    sensor: Float[Array, "3"]
    bearing0: Float[Array, ""]
    bearing_step: Float[Array, ""]
    reach: Float[Array, "B"]


def undo_motion(scan: Scan, lidar: Float[Array, "3"], velocity: Float[Array, "2"], yaw_rate: Float[Array, ""]) -> Sweep:
    """The scan in the robot's frame at its stamp: each beam placed at its own time.

    Args:
      lidar: pose of the LiDAR on the robot [m, m, rad].
      velocity: in the robot's own frame [m/s]; yaw_rate [rad/s].
    """
    index = jnp.arange(scan.ranges.shape[0], dtype=scan.ranges.dtype)
    bearing = scan.angle_min + scan.angle_increment * index
    age = scan.time_increment * index
    reach = jnp.where(scan.valid, scan.ranges, 0.0)
    turn = yaw_rate * age
    c, sn = jnp.cos(bearing + lidar[2]), jnp.sin(bearing + lidar[2])
    x, y = lidar[0] + reach * c, lidar[1] + reach * sn
    ct, st = jnp.cos(turn), jnp.sin(turn)
    points = jnp.stack([ct * x - st * y + velocity[0] * age, st * x + ct * y + velocity[1] * age], axis=-1)
    step = scan.angle_increment + yaw_rate * scan.time_increment
    return Sweep(points, scan.valid, lidar, scan.angle_min, step, reach)
