"""Two scans laid over each other: point to line, by the bearing under which the older scan saw each point.

The map has no part in it, so what the map errs by has none either. One compiled function of fixed shape.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from uwbslam_jax.config import Params
from uwbslam_jax.geometry import perpendicular, rotation, transform_points
from uwbslam_jax.grid import Sweep
from uwbslam_jax.measurements import Snapshot
from uwbslam_jax.slam import undo_motion
from uwbslam_jax.surfaces import Surface, stand_ins, surface

_POINTS = 361
"""So many points of the newer scan take part at most."""
_SCALES = (0.3, 0.3, 0.3, 0.2, 0.2, 0.1, 0.1, 0.05, 0.05, 0.03, 0.03, 0.03)
"""Distance from a line at which a point counts a quarter, move by move [m]."""
_SIGMA = 0.02
"""Standard deviation of a point's distance from its line [m]."""
_FLOOR = (0.003, 0.003, 0.0004)
"""However many points agree [m, m, rad]."""
_INDEPENDENT = 50.0
"""So many points count as independent, however many there are."""
_SPURIOUS = 0.001
"""Share of normals along a corridor that the noise of its walls alone makes up."""
_CORNER_M = 0.5
"""A point farther than this from the one it is paired with is paired by mistake."""


_COMPARED = 0.4
"""At least this share of the newer scan's surfaces has to fall where the older one has returns."""


class View(NamedTuple):
    """A scan made ready: its sweep in the robot's frame, its surfaces, and for each beam the one that stands in for it
    where it has no return, if there is one."""

    sweep: Sweep
    surface: Surface
    nearest: Int[Array, "B"]
    near: Bool[Array, "B"]


class Registration(NamedTuple):
    """One scan laid over another.

    Attributes:
      pose: (3,) of the newer one in the frame of the older one [m, m, rad].
      information: (3, 3) of it; 0 in the directions in which the scans do not tell.
      share: of the newer scan's surfaces, where the older one has returns, that lie on one of it.
    """

    pose: Float[Array, "3"]
    information: Float[Array, "3 3"]
    share: Float[Array, ""]


@jax.jit
def register(params: Params, old: Snapshot, new: Snapshot, guess: Float[Array, "n 3"]) -> Registration:
    """A scan laid over each of n older ones (leading axis of `old`, and of what comes back).

    Args:
      guess: poses of the newer one in the frames of the older ones, right to some decimetres and degrees.
    """
    newer = _view(params, new)
    return lax.map(lambda pair: _register(_view(params, pair[0]), newer, pair[1]), (old, guess))


def _view(params: Params, snapshot: Snapshot) -> View:
    sweep = undo_motion(snapshot.scan, params.lidar, snapshot.drift, snapshot.yaw_rate)
    walls = surface(sweep)
    # a beam with a return speaks for itself, also where no surface was found; one without leaves it to a surface nearby
    nearest, near = stand_ins(walls.found)
    own = jnp.arange(nearest.shape[0])
    return View(sweep, walls, jnp.where(sweep.valid, own, nearest), sweep.valid | near)


def _register(old: View, new: View, guess: Float[Array, "3"]) -> Registration:
    some, valid = _some(new.sweep.valid)
    points = new.sweep.points[some]

    def move(pose, scale):
        r, J, weight, *_ = _residuals(old, points, valid, pose, scale)
        A = jnp.einsum("bi,b,bj->ij", J, weight, J)
        step = jnp.linalg.solve(A + jnp.diag(jnp.array([1.0, 1.0, 10.0])), J.T @ (weight * r))
        return pose - jnp.clip(step, -0.3, 0.3), None

    pose, _ = lax.scan(move, guess, jnp.array(_SCALES))
    _, J, weight, near, facing = _residuals(old, points, valid, pose, _SCALES[-1])
    count = jnp.sum(near)
    normal = jnp.where(near[:, None], J[:, :2], 0.0)
    spread, direction = jnp.linalg.eigh(normal.T @ normal / jnp.maximum(count, 1))
    told = jnp.sqrt(jnp.clip(1.0 - _SPURIOUS / jnp.maximum(spread[0], 1e-9), 0.0, 1.0))
    e = direction[:, 0]
    seen = jnp.eye(3).at[:2, :2].add(-(1.0 - told) * e[:, None] * e[None, :])
    independent = jnp.minimum(1.0, _INDEPENDENT / jnp.maximum(count, 1))
    Y = seen @ (jnp.einsum("bi,b,bj->ij", J, jnp.where(near, weight, 0.0), J) * (independent / _SIGMA**2)) @ seen
    Y = jnp.linalg.solve(jnp.eye(3) + Y @ jnp.diag(jnp.array(_FLOOR) ** 2), Y)
    surfaces = valid & new.surface.found[some]
    compared = jnp.maximum(jnp.sum(surfaces & facing), _COMPARED * jnp.sum(surfaces))
    return Registration(pose, 0.5 * (Y + Y.T), jnp.sum(near & surfaces) / jnp.maximum(compared, 1))


def _some(valid: Bool[Array, "B"]) -> tuple[Int[Array, "n"], Bool[Array, "n"]]:
    """Beams that take part, evenly from those with a return, and which of them have one."""
    most, count = min(_POINTS, valid.shape[0]), jnp.sum(valid)
    with_return = jnp.nonzero(valid, size=valid.shape[0], fill_value=0)[0]
    rank = (jnp.arange(most) * jnp.maximum(count, most)) // most
    return with_return[rank], rank < count


def _residuals(old: View, points, valid, pose, scale):
    """Distances of points (b, 2) from the lines they fall on [m], their derivatives by the pose, their weights, and
    which are on one, and which fall where the older scan has returns."""
    sweep = old.sweep
    p = transform_points(pose, points)
    ray = (p - sweep.sensor[None, :2]) @ rotation(sweep.sensor[2])
    bearing = jnp.arctan2(ray[:, 1], ray[:, 0]) - sweep.bearing0
    turn = 2 * jnp.pi
    direction = jnp.sign(sweep.bearing_step)
    bearing = bearing * direction
    # the first beam's bearing is 0; half a step below it still is its own
    half = 0.5 * jnp.abs(sweep.bearing_step)
    bearing = bearing - turn * jnp.floor((bearing + half) / turn)
    index = jnp.round(bearing / jnp.abs(sweep.bearing_step)).astype(jnp.int32)
    inside = index < sweep.points.shape[0]
    beam = jnp.clip(index, 0, sweep.points.shape[0] - 1)
    index, inside = old.nearest[beam], inside & old.near[beam]
    normal = perpendicular(old.surface.tangent[:, index].T)
    apart = p - sweep.points[index]
    r = jnp.sum(normal * apart, axis=1)
    ok = valid & inside & old.surface.found[index]
    close = jnp.sum(apart**2, axis=1) < (_CORNER_M + 2 * scale) ** 2
    ok = ok & close
    weight = jnp.where(ok, 1.0 / (1.0 + (r / scale) ** 2) ** 2, 0.0)
    lever = p - pose[None, :2]
    J = jnp.column_stack([normal, jnp.sum(normal * perpendicular(lever), axis=1)])
    return r, J, weight, ok & (jnp.abs(r) < 2 * scale), inside & (sweep.valid[beam] | close)
