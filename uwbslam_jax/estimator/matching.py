"""Aligning a scan with the map: Gauss-Newton coarse to fine, and the score of a match."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from uwbslam_jax.estimator.lidar_objective import lidar_gram, lidar_residual, prior_residual
from uwbslam_jax.mapping import Grid, Surface, Sweep, find_surface, grid as occupancy
from uwbslam_jax.numerics import Gaussian, rotation, symmetric_root, transform_points

_STEPS = (6, 5, 5)
"""Gauss-Newton steps at the finest, middle and every coarser level, at most."""
_CONVERGED = 0.005
"""A level has converged when a step is shorter than this many of its cells [cells of m or rad]."""
_NEARBY_BEAMS = 540
"""A scan that is nearly in place needs no more beams than this: neighbours hit the same cell."""
_NEARBY_STEPS, _NEARBY_CONVERGED = 3, 0.02
"""Nor more steps, nor a last one as short as from afar [cells of m or rad]."""
_CHECKED_BEAMS = 360
"""So many beams score the expected pose as well as all of them do."""
_BLIND = (0.006, 0.02)
"""Share of normals in the least seen direction below which a scan is blind in it, and above which it is not."""
_FEW_SURFACES = 20
"""So few beams with a surface do not tell in which direction a scan is blind."""


class Match(NamedTuple):
    """A scan aligned with the map.

    Attributes:
      pose: (3,) the robot's pose in the map [m, m, rad].
      information: (3, 3) Gram matrix of the residuals at that pose, unscaled (H^(LiD) of the paper).
      informed: (2, 2) projector on the directions in which it tells the position.
      score: mean Gamma of the returns that fall on observed cells; about 0.8 when right, 0.4 when not, and 0.6 when
        right where the walls were drawn from few scans, dotted.
      known: share of the returns that fall on observed cells.
      blurred: the score against the middle level, whose cells a dotted wall fills: 0.8 and 0.35.
    """

    pose: Float[Array, "3"]
    information: Float[Array, "3 3"]
    informed: Float[Array, "2 2"]
    score: Float[Array, ""]
    known: Float[Array, ""]
    blurred: Float[Array, ""]


class Blind(NamedTuple):
    """The direction in which a scan cannot tell where it is: along a corridor whose ends are out of reach.

    Attributes:
      direction: (2,) unit vector in the robot's frame.
      weight: 0 where the scan sees enough in every direction, 1 where it sees nothing in this one.
    """

    direction: Float[Array, "2"]
    weight: Float[Array, ""]


def blind_direction(surface: Surface, counted: Bool[Array, "B"]) -> Blind:
    """From the scan alone: the least eigenvector of the mean n n^T of its surface normals.

    The map cannot tell. The cells of a straight wall form a pattern along it, to which a scan locks: HectorSLAM
    shortens corridors.

    Args:
      counted: beams that take part.
    """
    counted = counted & surface.found
    tangent, count = jnp.where(counted, surface.tangent, 0.0), jnp.sum(counted)
    # of tangents: the larger eigenvector of [[a, b], [b, c]] is where the walls run
    T = tangent @ tangent.T / jnp.maximum(count, 1)
    a, b, c = T[0, 0], T[0, 1], T[1, 1]
    angle = 0.5 * jnp.arctan2(2 * b, a - c)
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    least = jnp.maximum(0.5 * (a + c - jnp.sqrt((a - c) ** 2 + 4 * b**2)), 0.0)
    weight = jnp.clip((_BLIND[1] - least) / (_BLIND[1] - _BLIND[0]), 0.0, 1.0)
    return Blind(direction, jnp.where(count > _FEW_SURFACES, weight, 0.0))


def seen(blind: Blind, heading: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Projector on what the scan sees, in the frame of a heading."""
    e = rotation(heading) @ blind.direction
    return jnp.eye(2) - blind.weight * e[:, None] * e[None, :]


def share_of_walls(
    surface: Surface, some: Bool[Array, "B"], counted: Bool[Array, "B"], heading: Float[Array, ""]
) -> Float[Array, "2 2"]:
    """By how much each direction of a matched position is told by some of a scan's walls: G_all^-1 G_some of their
    normals, in the frame of a heading. A match then is (1 - share) what the other walls say + share what these say.

    Args:
      some: beams on the walls asked about, a part of those `counted`.
    """

    def gram(beams: Bool[Array, "B"]) -> Float[Array, "2 2"]:
        t = jnp.where(beams & surface.found, surface.tangent, 0.0)
        normal = jnp.stack([t[1], -t[0]])
        return normal @ normal.T

    R = rotation(heading)
    few = _BLIND[0] * jnp.maximum(jnp.sum(counted), 1)
    return R @ jnp.linalg.solve(gram(counted) + few * jnp.eye(2), gram(some & counted)) @ R.T


class View(NamedTuple):
    """A scan as it is matched.

    Attributes:
      sweep: in the robot's frame; surface: what it meets.
      blind: the direction in which it does not tell the position.
      sigma_l: standard deviation of a beam's residual 1 - Gamma.
    """

    sweep: Sweep
    surface: Surface
    blind: Blind
    sigma_l: Float[Array, ""]


def view(sweep: Sweep, sigma_l: Float[Array, ""]) -> View:
    """What can be said of a scan without the map."""
    surface = find_surface(sweep)
    return View(sweep, surface, blind_direction(surface, sweep.valid), sigma_l)


class _LidarAndPrior(NamedTuple):
    """What the residual of a match needs, at one level."""

    level: Float[Array, "c c"]
    origin: Float[Array, "2"]
    size: Float[Array, ""]
    points: Float[Array, "B 2"]
    valid: Bool[Array, "B"]
    mean: Float[Array, "3"]
    root: Float[Array, "3 3"]
    sigma_l: Float[Array, ""]
    seen: Float[Array, "2 2"]


def _residual(pose: Float[Array, "3"], a: _LidarAndPrior) -> Float[Array, "7"]:
    # what the scan cannot see is left to the prior: the LiDAR block does not depend on it
    held = a.mean[:2] + a.seen @ (pose[:2] - a.mean[:2])
    lidar = lidar_residual(jnp.append(held, pose[2]), a.level, a.origin, a.size, a.points, a.valid) / a.sigma_l
    return jnp.concatenate([lidar, prior_residual(pose, a.mean, a.root)])


class _GaussNewton(optx.AbstractLeastSquaresSolver):
    """Gauss-Newton that stops by the length of a step alone, and does not take one that is not finite.

    That of optimistix also waits until no entry of the residual changes any more, which those of a Gram matrix's root
    never do: where the pose is right they pass through zero. And it evaluates once more after the last step.
    """

    atol: float
    rtol: float = 0.0
    norm: Callable[[Array], Array] = optx.max_norm

    def init(self, fn: Callable, y: Array, *_: Any) -> Array:
        return jnp.full_like(y, jnp.inf)

    def step(self, fn: Callable, y: Array, args: Any, *_: Any) -> tuple[Array, Array, Any]:
        residual, jacobian, aux = jax.linearize(lambda y: fn(y, args), y, has_aux=True)
        J = lx.FunctionLinearOperator(jacobian, jax.eval_shape(lambda: y))
        move = lx.linear_solve(J, residual, lx.Normal(lx.Cholesky()), throw=False).value
        move = jnp.where(jnp.all(jnp.isfinite(move)), move, 0.0)
        return y - move, move, aux

    def terminate(
        self, fn: Callable, y: Array, args: Any, options: dict, state: Array, tags: frozenset
    ) -> tuple[Array, optx.RESULTS]:
        return self.norm(state) < self.atol, optx.RESULTS.successful

    def postprocess(self, fn: Callable, y: Array, aux: Any, *_: Any) -> tuple[Array, Any, dict]:
        return y, aux, {}


def gauss_newton(
    residual: Callable[..., Float[Array, "r"]], start: Float[Array, "d"], args: Any, steps: int, still: float = 0.0
) -> Float[Array, "d"]:
    """Least squares by so many Gauss-Newton steps at most; never raises, returns the last iterate. A step of which
    every coordinate is shorter than `still` is the last.

    The derivative is that of the steps taken, one after the other over the iterates, which are kept: a derivative of
    the loop itself takes minutes to compile, and has no forward mode.

    Args:
      residual: of the unknowns (d,) and args; closes over no array.
    """
    solver = _GaussNewton(atol=still)

    def move(y: Float[Array, "d"], args: Any) -> tuple[Float[Array, "d"], Float[Array, "d"]]:
        return solver.step(lambda y, args: (residual(y, args), None), y, args)[:2]

    @jax.custom_jvp
    def solve(start: Float[Array, "d"], args: Any) -> Float[Array, "d"]:
        return optx.least_squares(residual, solver, start, args=args, max_steps=steps, throw=False).value

    @partial(solve.defjvp, symbolic_zeros=True)
    def derivative(at: tuple[Any, Any], along: tuple[Any, Any]) -> tuple[Any, Any]:
        fixed, (start, args) = jax.tree.map(lax.stop_gradient, at), at

        def one(carry: Any) -> Any:
            k, y, iterates, _ = carry
            after, step = move(y, fixed[1])
            return k + 1, after, iterates.at[k].set(y), jnp.max(jnp.abs(step)) < still

        first = 0, fixed[0], jnp.zeros((steps, *start.shape), start.dtype), False
        count, y, iterates, _ = lax.while_loop(lambda c: (c[0] < steps) & ~c[3], one, first)
        leaves, tree = jax.tree.flatten(args)
        dots = jax.tree.leaves(along[1], is_leaf=lambda x: isinstance(x, SymbolicZero))
        varied = [k for k, dot in enumerate(dots) if not isinstance(dot, SymbolicZero)]

        def of(y: Float[Array, "d"], values: list[Any]) -> Float[Array, "d"]:
            new = dict(zip(varied, values, strict=True))
            return move(y, tree.unflatten([new.get(k, leaf) for k, leaf in enumerate(leaves)]))[0]

        def through(y_dot: Float[Array, "d"], step: tuple[Any, Any]) -> tuple[Float[Array, "d"], None]:
            k, y = step
            at = y, [leaves[k] for k in varied]
            moved = jax.jvp(of, at, (y_dot, [dots[k] for k in varied]))[1]
            return jnp.where(k < count, moved, y_dot), None

        dot = along[0]
        dot = jnp.zeros_like(start) if isinstance(dot, SymbolicZero) else dot
        return y, lax.scan(through, dot, (jnp.arange(steps), iterates))[0]

    return solve(start, args)


def thinned(sweep: Sweep, most: int = _CHECKED_BEAMS) -> Sweep:
    """Every n-th beam, about as many as asked for."""
    n = max(1, sweep.valid.shape[0] // most)
    few = sweep._replace(points=sweep.points[::n], valid=sweep.valid[::n], reach=sweep.reach[::n])
    return few._replace(bearing_step=n * sweep.bearing_step)


def align(
    grid: Grid,
    view: View,
    start: Float[Array, "3"],
    prior: Gaussian,
    resolution: float,
    near: bool | Bool[Array, ""] = False,
) -> Float[Array, "3"]:
    """Pose that minimises 1/2 sum (1 - Gamma)^2 / sigma_l^2 + the prior's quadratic, coarse to fine
    (docs/estimator.md, "The step").

    Args:
      near: the start is within a cell of the answer: the coarser levels would only lead away from it and back, and
        fewer beams will do.
    """
    sweep = view.sweep
    root = solve_triangular(symmetric_root(prior.cov), jnp.eye(3, dtype=start.dtype), lower=True)
    projector = seen(view.blind, start[2])

    def at_level(k: int, beams: Sweep, pose: Float[Array, "3"], steps: int, converged: float) -> Float[Array, "3"]:
        size = jnp.asarray(resolution * 2**k, pose.dtype)
        # fewer beams weigh as much as all of them
        weight = jnp.sqrt(jnp.asarray(beams.valid.shape[0] / sweep.valid.shape[0], pose.dtype))
        scan = (grid.levels[k], grid.origin, size, beams.points, beams.valid)
        args = _LidarAndPrior(*scan, prior.mean, root, view.sigma_l * weight, projector)
        return gauss_newton(_residual, pose, args, steps, converged * resolution * 2**k)

    def from_nearby(pose: Float[Array, "3"]) -> Float[Array, "3"]:
        return at_level(0, thinned(sweep, _NEARBY_BEAMS), pose, _NEARBY_STEPS, _NEARBY_CONVERGED)

    def from_afar(pose: Float[Array, "3"]) -> Float[Array, "3"]:
        for k in reversed(range(len(grid.levels))):
            pose = at_level(k, sweep, pose, _STEPS[min(k, 2)], _CONVERGED)
        return pose

    return lax.cond(near, from_nearby, from_afar, start)


def assess(grid: Grid, view: View, pose: Float[Array, "3"], resolution: float) -> Match:
    """Score and information of a pose against the finest level.

    There is no information in the direction in which what the map has of the scan's walls is blind: the end of a
    corridor tells nothing before it is drawn.
    """
    sweep = view.sweep
    gram = lidar_gram(pose, grid.levels[0], grid.origin, resolution, sweep.points, sweep.valid)
    score, known = fit(grid, sweep, pose, resolution)
    level = middle(grid)
    blurred, _ = fit(grid, sweep, pose, resolution, level)
    ends = transform_points(pose, sweep.points)
    on_wall, _ = on_known_wall(grid, ends, resolution, level)
    informed = seen(blind_direction(view.surface, sweep.valid & on_wall), pose[2])
    projector = jnp.eye(3).at[:2, :2].set(informed)
    information = projector @ gram[:3, :3] @ projector
    return Match(pose, information, informed, score, known, blurred)


def middle(grid: Grid) -> int:
    """Number of the middle level."""
    return min(1, len(grid.levels) - 1)


def fit(
    grid: Grid, sweep: Sweep, pose: Float[Array, "3"], resolution: float, level: int = 0
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Score and known share of a scan at a pose, see Match, against a level."""
    size = resolution * 2**level
    ends = transform_points(pose, sweep.points)
    corners, at, inside = occupancy.corner_log_odds(grid.levels[level], grid.origin, size, ends)
    value, _ = occupancy.interpolate(jax.nn.sigmoid(corners), at, size)
    observed = sweep.valid & inside & jnp.any(corners != 0, axis=(1, 2))
    count = jnp.sum(observed)
    score = jnp.sum(jnp.where(observed, value, 0.0)) / jnp.maximum(count, 1)
    return score, count / jnp.maximum(jnp.sum(sweep.valid), 1)


def on_known_wall(
    grid: Grid, ends: Float[Array, "B 2"], resolution: float, level: int
) -> tuple[Bool[Array, "B"], Bool[Array, "B"]]:
    """Whether any of the four cells of a level around a place is a wall, and whether it is in the window."""
    size = resolution * 2**level
    corners, _, inside = occupancy.corner_log_odds(grid.levels[level], grid.origin, size, ends)
    return inside & jnp.any(corners > 0, axis=(1, 2)), inside
