"""The wide search: where a scan fits that alignment has not placed, over all headings."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from uwbslam_jax.estimator.matching import View, align, fit, middle
from uwbslam_jax.mapping import Grid, grid as occupancy
from uwbslam_jax.numerics import Gaussian, wrap_angle

_SEARCH_HEADINGS, _SEARCH_BEAMS, _SEARCH_REFINED = 120, 180, 8
"""Headings of a search, 3 degrees apart for an alignment to converge; beams that score them; best ones aligned."""
_UNLIKELY = 0.005
"""What a squared Mahalanobis distance of one costs a searched place, in mean Gamma: as if 100 beams were independent.
Headings cost little: the search is for a robot that turned."""
_TURN = 0.4
"""A turn that counts as a distance of one [rad]: in real corridors turns of up to 80 degrees between two scans are
found with it, and scans that would fit turned by half are not: on new ground, of which the map knows little, looking
back at known walls has to cost more than it gains."""
_PATCH_SIDE, _PATCH_SPREAD, _PATCH_M = 5, 1.5, (0.05, 0.6)
"""A patch of positions: so many along a side, over so many standard deviations of what is expected to either side, at
least and at most so far [m]."""
_REFINE_SPREAD = 0.3
"""Standard deviation of what holds a start where it is aligned [m, rad]."""


def search(
    grid: Grid,
    view: View,
    expected: Gaussian,
    last: Float[Array, "3"],
    found: Float[Array, "3"],
    resolution: float,
) -> Float[Array, "3"]:
    """Best pose over the full circle of headings and two patches of positions: around the mean of what is expected, and
    around the last pose, because a robot that turned has often driven less far than its velocity said.

    Every heading and position is scored at the middle level; the best of each peak over the headings is aligned and
    scored there again, where it has to be better than the pose that was found without searching. In real corridors
    with scans a metre apart a wrong heading then beats the right one in one scan of a hundred, at the finest level in
    one of forty.

    Args:
      expected: pose; its position weighs in the choice by its covariance, its heading by `_TURN` however certain.
      last: pose before this scan; found: pose without searching.
    """
    sweep = view.sweep
    k = middle(grid)
    size = resolution * 2**k
    stride = max(1, sweep.points.shape[0] // _SEARCH_BEAMS)
    points, valid = sweep.points[::stride], sweep.valid[::stride]
    spread = _PATCH_SPREAD * jnp.sqrt(jnp.maximum(expected.cov[0, 0], expected.cov[1, 1]))
    spread = jnp.clip(spread, *_PATCH_M)
    axis = jnp.linspace(-1.0, 1.0, _PATCH_SIDE)
    patch = jnp.stack(jnp.meshgrid(axis, axis), axis=-1).reshape(-1, 2) * spread
    centres = jnp.stack([expected.mean[:2], last[:2]])
    places = (centres[:, None] + patch[None]).reshape(-1, 2)
    headings = expected.mean[2] + jnp.linspace(-jnp.pi, jnp.pi, _SEARCH_HEADINGS, endpoint=False)

    def scores(heading: Float[Array, ""]) -> Float[Array, "p"]:
        c, s = jnp.cos(heading), jnp.sin(heading)
        turned = jnp.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=-1)
        ends = (turned[None] + places[:, None]).reshape(-1, 2)
        corners, at, inside = occupancy.corner_log_odds(grid.levels[k], grid.origin, size, ends)
        value, _ = occupancy.interpolate(jax.nn.sigmoid(corners), at, size)
        gain = jnp.where(inside, value - 0.5, 0.0).reshape(places.shape[0], -1)
        return jnp.sum(jnp.where(valid, gain, 0.0), axis=1)

    information = jnp.linalg.inv(expected.cov[:2, :2])
    directions = jnp.stack([expected.mean[2], last[2]])

    def unlikely(place: Float[Array, "2"], heading: Float[Array, ""]) -> Float[Array, ""]:
        away = place - expected.mean[:2]
        turned = wrap_angle(heading - directions) / _TURN
        return _UNLIKELY * (away @ information @ away + jnp.min(turned**2))

    # or the walls of a corridor, which fit the last place as well, would leave none of the starts to the expected one
    doubt = jax.vmap(jax.vmap(unlikely, (0, None)), (None, 0))(places, headings)
    table = lax.map(scores, headings, batch_size=8) / jnp.maximum(jnp.sum(valid), 1) - doubt  # (headings, places)
    best_place = jnp.argmax(table, axis=1)
    value = jnp.max(table, axis=1)
    peak = (value >= jnp.roll(value, 1)) & (value >= jnp.roll(value, -1))
    _, best = lax.top_k(jnp.where(peak, value, -jnp.inf), _SEARCH_REFINED)
    starts = jnp.concatenate([places[best_place[best]], headings[best, None]], axis=1)
    starts = jnp.concatenate([found[None], starts])

    def refine(start: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        wide = Gaussian(start, jnp.diag(jnp.full(3, _REFINE_SPREAD) ** 2))
        pose = align(grid, view, start, wide, resolution)
        score, known = fit(grid, sweep, pose, resolution, k)
        return pose, (score - 0.5) * known - unlikely(pose[:2], pose[2])

    poses, values = lax.map(refine, starts)
    pose = poses[jnp.argmax(values)]
    return pose.at[2].set(expected.mean[2] + wrap_angle(pose[2] - expected.mean[2]))
