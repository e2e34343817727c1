"""Two scans laid over each other: point to line, by the bearing under which the older scan saw each point.

The map has no part in it, so what the map errs by has none either. One compiled function of fixed shape.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from uwbslam_jax.mapping import find_surface, stand_ins, undo_motion
from uwbslam_jax.measurements import Snapshot
from uwbslam_jax.numerics import transform_points

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
    """A scan made ready to be laid over others, and others over it.

    Attributes:
      beams: of each beam, or of the surface nearby that stands in for one that has no return: end point and direction
        of the surface in the robot's frame [m], whether that surface was found, whether there is anything, and whether
        the beam itself has a return.
      sensor, bearing0, bearing_step: see Sweep.
      points: end points of those beams that take part when it is laid over another [m]; valid: which there are; walls:
        which are on a surface.
    """

    beams: Float[Array, "B 7"]
    sensor: Float[Array, "3"]
    bearing0: Float[Array, ""]
    bearing_step: Float[Array, ""]
    points: Float[Array, "n 2"]
    valid: Bool[Array, "n"]
    walls: Bool[Array, "n"]


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
def view(lidar: Float[Array, "3"], snapshot: Snapshot) -> View:
    """A scan made ready: done once, however often it is laid over others. lidar: its pose on the robot [m, m, rad]."""
    sweep = undo_motion(snapshot.scan, lidar, snapshot.drift, snapshot.yaw_rate)
    walls = find_surface(sweep)
    # a beam with a return speaks for itself, also where no surface was found; one without leaves it to a surface nearby
    nearest, near = stand_ins(walls.found)
    own = jnp.where(sweep.valid, jnp.arange(nearest.shape[0]), nearest)
    told = (walls.found[own], sweep.valid | near, sweep.valid)
    beams = jnp.concatenate([sweep.points.T[:, own], walls.tangent[:, own], jnp.stack(told)]).T
    some, valid = _some(sweep.valid)
    facing = sweep.sensor, sweep.bearing0, sweep.bearing_step
    return View(beams, *facing, sweep.points[some], valid, valid & walls.found[some])


@jax.jit
def register(old: View, new: View, guess: Float[Array, "n 3"]) -> Registration:
    """A scan laid over each of n older ones (leading axis of `old`, and of what comes back).

    Args:
      guess: poses of the newer one in the frames of the older ones, right to some decimetres and degrees.
    """
    return lax.map(lambda pair: _register(pair[0], new, pair[1]), (old, guess))


def _register(old: View, new: View, guess: Float[Array, "3"]) -> Registration:
    def move(pose: Float[Array, "3"], scale: Float[Array, ""]) -> tuple[Float[Array, "3"], None]:
        gram, *_ = _gram(old, new, pose, scale)
        A = gram[:3, :3] + jnp.diag(jnp.array([1.0, 1.0, 10.0]))
        # three unknowns by Cramer's rule: LAPACK would take longer than all the rest
        adjugate = jnp.stack([jnp.cross(A[1], A[2]), jnp.cross(A[2], A[0]), jnp.cross(A[0], A[1])])
        step = adjugate @ gram[:3, 3] / jnp.dot(A[0], adjugate[0])
        return pose - jnp.clip(step, -0.3, 0.3), None

    pose, _ = lax.scan(move, guess, jnp.array(_SCALES))
    _, J, weight, near, facing = _gram(old, new, pose, _SCALES[-1])
    count = jnp.sum(near)
    normal = jnp.where(near[None], J[:2], 0.0)
    spread, direction = jnp.linalg.eigh(normal @ normal.T / jnp.maximum(count, 1))
    told = jnp.sqrt(jnp.clip(1.0 - _SPURIOUS / jnp.maximum(spread[0], 1e-9), 0.0, 1.0))
    e = direction[:, 0]
    seen = jnp.eye(3).at[:2, :2].add(-(1.0 - told) * e[:, None] * e[None, :])
    independent = jnp.minimum(1.0, _INDEPENDENT / jnp.maximum(count, 1))
    Y = (J * jnp.where(near, weight, 0.0)[None]) @ J.T * (independent / _SIGMA**2)
    Y = seen @ Y @ seen
    Y = jnp.linalg.solve(jnp.eye(3) + Y @ jnp.diag(jnp.array(_FLOOR) ** 2), Y)
    compared = jnp.maximum(jnp.sum(new.walls & facing), _COMPARED * jnp.sum(new.walls))
    return Registration(pose, 0.5 * (Y + Y.T), jnp.sum(near & new.walls) / jnp.maximum(compared, 1))


def _some(valid: Bool[Array, "B"]) -> tuple[Int[Array, "n"], Bool[Array, "n"]]:
    """Beams that take part, evenly from those with a return, and which of them have one."""
    most, count = min(_POINTS, valid.shape[0]), jnp.sum(valid)
    with_return = jnp.nonzero(valid, size=valid.shape[0], fill_value=0)[0]
    rank = (jnp.arange(most) * jnp.maximum(count, most)) // most
    return with_return[rank], rank < count


def _gram(
    old: View, new: View, pose: Float[Array, "3"], scale: float | Float[Array, ""]
) -> tuple[Float[Array, "4 4"], Float[Array, "3 n"], Float[Array, "n"], Bool[Array, "n"], Bool[Array, "n"]]:
    """Weighted Gram matrix (4, 4) of derivatives by the pose and distances of points from the lines they fall on [m];
    the derivatives (3, n), the weights, which points are on a line, and which fall where the older scan has returns."""
    p = transform_points(pose, new.points)
    ray = transform_points(jnp.array([0.0, 0.0, -1.0]) * old.sensor, p - old.sensor[None, :2])
    step = jnp.abs(old.bearing_step)
    bearing = (jnp.arctan2(ray[:, 1], ray[:, 0]) - old.bearing0) * jnp.sign(old.bearing_step)
    # the first beam's bearing is 0; half a step below it still is its own
    turn = 2 * jnp.pi
    bearing = bearing - turn * jnp.floor((bearing + 0.5 * step) / turn)
    index = jnp.round(bearing / step).astype(jnp.int32)
    beams = old.beams.shape[0]
    met = old.beams.at[jnp.clip(index, 0, beams - 1)].get(mode="promise_in_bounds")
    inside = (index < beams) & (met[:, 5] > 0)
    apart, along, lever = p - met[:, :2], met[:, 2:4], p - pose[None, :2]
    close = jnp.sum(apart**2, axis=1) < (_CORNER_M + 2 * scale) ** 2
    ok = new.valid & inside & (met[:, 4] > 0) & close
    # by the normal, which is the direction turned by 90 degrees
    r = along[:, 0] * apart[:, 1] - along[:, 1] * apart[:, 0]
    J = jnp.stack([-along[:, 1], along[:, 0], jnp.sum(along * lever, axis=1)])
    weight = jnp.where(ok, 1.0 / (1.0 + (r / scale) ** 2) ** 2, 0.0)
    rows = jnp.concatenate([J, r[None]])
    facing = inside & ((met[:, 6] > 0) | close)
    return (rows * weight[None]) @ rows.T, J, weight, ok & (jnp.abs(r) < 2 * scale), facing
