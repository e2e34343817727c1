"""Aligning a scan with the map: Gauss-Newton coarse to fine, the score of a match, and the wide search."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

from uwbslam_jax import grid as occupancy
from uwbslam_jax.ekf import Gaussian, symmetric_root
from uwbslam_jax.geometry import rotation, safe_norm, transform_points, wrap_angle
from uwbslam_jax.grid import Grid, Sweep
from uwbslam_jax.objective import lidar_gram, lidar_residual, prior_residual

_MOVES = (6, 5, 5)
"""Gauss-Newton moves at the finest, middle and every coarser level."""
_NEIGHBOURS = (1, 2, 4, 8, 16)
_NORMAL_SPAN = (0.25, 1.0)
"""A normal needs neighbours this far apart [m]."""
_BLIND = (0.006, 0.02)
"""Share of normals in the least seen direction below which a scan is blind in it, and above which it is not."""
_SEARCH_HEADINGS = 120
_SEARCH_BEAMS = 180
_SEARCH_REFINED = 8
_UNLIKELY = 0.005
"""What a squared Mahalanobis distance of one costs a searched place, in mean Gamma: as if 100 beams were independent.
Headings cost nothing: the search is for a robot that turned."""


class Match(NamedTuple):
    """A scan aligned with the map.

    Attributes:
      pose: (3,) the robot's pose in the map [m, m, rad].
      information: (3, 3) Gram matrix of the residuals at that pose, unscaled (H^(LiD) of the paper).
      score: mean Gamma of the returns that fall on observed cells; about 0.8 when right, 0.4 when not.
      known: share of the returns that fall on observed cells.
    """

    pose: Float[Array, "3"]
    information: Float[Array, "3 3"]
    score: Float[Array, ""]
    known: Float[Array, ""]


class Blind(NamedTuple):
    """The direction in which a scan cannot tell where it is: along a corridor whose ends are out of reach.

    Attributes:
      direction: (2,) unit vector in the robot's frame.
      weight: 0 where the scan sees enough in every direction, 1 where it sees nothing in this one.
    """

    direction: Float[Array, "2"]
    weight: Float[Array, ""]


def blind_direction(sweep: Sweep) -> Blind:
    """From the scan alone: the least eigenvector of the mean n n^T of its surface normals (DESIGN 1.8).

    The map cannot tell. The cells of a straight wall form a pattern along it, to which a scan locks: HectorSLAM
    shortens corridors. A normal comes from the two neighbours of a beam that are far enough apart for range noise not
    to matter; where the three are not on one line there is no surface, and no normal.
    """
    # what is seen is a decision, held when the step is differentiated
    points, valid = jax.lax.stop_gradient(sweep.points), sweep.valid
    tangent = jnp.zeros_like(points)
    found = jnp.zeros_like(valid)
    for k in _NEIGHBOURS:
        before, after = jnp.roll(points, k, axis=0), jnp.roll(points, -k, axis=0)
        t = after - before
        span = safe_norm(t)
        index = jnp.arange(points.shape[0])
        ok = valid & jnp.roll(valid, k) & jnp.roll(valid, -k) & (index >= k) & (index < points.shape[0] - k)
        bend = safe_norm(after + before - 2 * points)
        ok = ok & (span > _NORMAL_SPAN[0]) & (span < _NORMAL_SPAN[1]) & (bend < 0.05 + 0.1 * span) & ~found
        tangent = jnp.where(ok[:, None], t / jnp.maximum(span, 1e-6)[:, None], tangent)
        found = found | ok
    T = tangent.T @ tangent  # of tangents: its largest eigenvector is where the walls run
    share, directions = jnp.linalg.eigh(T / jnp.maximum(jnp.sum(found), 1))
    weight = jnp.clip((_BLIND[1] - share[0]) / (_BLIND[1] - _BLIND[0]), 0.0, 1.0)
    return Blind(directions[:, 1], jnp.where(jnp.sum(found) > 20, weight, 0.0))


def seen(blind: Blind, heading: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Projector on what the scan sees, in the frame of a heading."""
    e = rotation(heading) @ blind.direction
    return jnp.eye(2) - blind.weight * e[:, None] * e[None, :]


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


def gauss_newton(residual, start, args, moves: int):
    """Least squares by `moves` Gauss-Newton moves of optimistix; never raises, returns the last iterate."""
    solver = optx.GaussNewton(rtol=1e-3, atol=1e-4, linear_solver=lx.Normal(lx.Cholesky()))
    solution = optx.least_squares(
        residual, solver, start, args=args, max_steps=moves + 1, throw=False, adjoint=optx.RecursiveCheckpointAdjoint()
    )
    return solution.value


def align(
    grid: Grid,
    sweep: Sweep,
    blind: Blind,
    start: Float[Array, "3"],
    prior: Gaussian,
    sigma_l: Float[Array, ""],
    resolution: float,
) -> Float[Array, "3"]:
    """Pose that minimises 1/2 sum (1 - Gamma)^2 / sigma_l^2 + the prior's quadratic, coarse to fine (DESIGN 1.4)."""
    root = jnp.linalg.inv(symmetric_root(prior.cov))
    projector = seen(blind, start[2])
    pose = start
    for k in reversed(range(len(grid.levels))):
        size = jnp.asarray(resolution * 2**k, pose.dtype)
        scan = (grid.levels[k], grid.origin, size, sweep.points, sweep.valid)
        args = _LidarAndPrior(*scan, prior.mean, root, sigma_l, projector)
        pose = gauss_newton(_residual, pose, args, _MOVES[min(k, 2)])
    return pose


def assess(grid: Grid, sweep: Sweep, blind: Blind, pose: Float[Array, "3"], resolution: float) -> Match:
    """Score and information of a pose against the finest level; no information where the scan is blind."""
    level, origin = grid.levels[0], grid.origin
    gram = lidar_gram(pose, level, origin, resolution, sweep.points, sweep.valid)
    ends = transform_points(pose, sweep.points)
    corners, at, inside = occupancy.corner_log_odds(level, origin, resolution, ends)
    value, _ = occupancy.interpolate(jax.nn.sigmoid(corners), at, resolution)
    observed = sweep.valid & inside & jnp.any(corners != 0, axis=(1, 2))
    count = jnp.sum(observed)
    score = jnp.sum(jnp.where(observed, value, 0.0)) / jnp.maximum(count, 1)
    projector = jnp.eye(3).at[:2, :2].set(seen(blind, pose[2]))
    return Match(pose, projector @ gram[:3, :3] @ projector, score, count / jnp.maximum(jnp.sum(sweep.valid), 1))


def search(
    grid: Grid,
    sweep: Sweep,
    blind: Blind,
    prior: Gaussian,
    last: Float[Array, "3"],
    sigma_l: Float[Array, ""],
    resolution: float,
) -> Float[Array, "3"]:
    """Best pose over the full circle of headings and two patches of positions (DESIGN 1.8): around the prior's mean,
    and around the last pose, because a robot that turned has often driven less far than its velocity said.

    Every heading and position is scored at the middle level; the best of each peak over the headings is aligned and
    scored at the finest.
    """
    k = min(1, len(grid.levels) - 1)
    size = resolution * 2**k
    stride = max(1, sweep.points.shape[0] // _SEARCH_BEAMS)
    points, valid = sweep.points[::stride], sweep.valid[::stride]
    spread = jnp.clip(1.5 * jnp.sqrt(jnp.maximum(prior.cov[0, 0], prior.cov[1, 1])), 0.05, 0.6)
    axis = jnp.linspace(-1.0, 1.0, 5)
    patch = jnp.stack(jnp.meshgrid(axis, axis), axis=-1).reshape(-1, 2) * spread
    centres = jnp.stack([prior.mean[:2], last[:2]])
    places = (centres[:, None] + patch[None]).reshape(-1, 2)
    headings = prior.mean[2] + jnp.linspace(-jnp.pi, jnp.pi, _SEARCH_HEADINGS, endpoint=False)

    def scores(heading):
        c, s = jnp.cos(heading), jnp.sin(heading)
        turned = jnp.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=-1)
        ends = (turned[None] + places[:, None]).reshape(-1, 2)
        corners, at, inside = occupancy.corner_log_odds(grid.levels[k], grid.origin, size, ends)
        value, _ = occupancy.interpolate(jax.nn.sigmoid(corners), at, size)
        gain = jnp.where(inside, value - 0.5, 0.0).reshape(places.shape[0], -1)
        return jnp.sum(jnp.where(valid, gain, 0.0), axis=1)

    table = jax.lax.map(scores, headings, batch_size=8)  # (headings, places)
    best_place = jnp.argmax(table, axis=1)
    value = jnp.max(table, axis=1)
    peak = (value >= jnp.roll(value, 1)) & (value >= jnp.roll(value, -1))
    _, best = jax.lax.top_k(jnp.where(peak, value, -jnp.inf), _SEARCH_REFINED)
    starts = jnp.concatenate([places[best_place[best]], headings[best, None]], axis=1)

    def refine(start):
        wide = Gaussian(start, prior.cov * 0 + jnp.diag(jnp.array([0.3, 0.3, 0.3]) ** 2))
        pose = align(grid, sweep, blind, start, wide, sigma_l, resolution)
        m = assess(grid, sweep, blind, pose, resolution)
        away = pose[None, :2] - centres
        unlikely = jnp.sum(away * jnp.linalg.solve(prior.cov[:2, :2], away.T).T, axis=1)
        return pose, (m.score - 0.5) * m.known - _UNLIKELY * jnp.min(unlikely)

    poses, values = jax.lax.map(refine, starts)
    pose = poses[jnp.argmax(values)]
    return pose.at[2].set(prior.mean[2] + wrap_angle(pose[2] - prior.mean[2]))
