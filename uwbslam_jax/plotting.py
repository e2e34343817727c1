"""Maps, runs and the matching objective as pictures on matplotlib axes; needs the extra `plot`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from uwbslam_jax.mapping import Grid, Sweep, grid as occupancy
from uwbslam_jax.numerics import transform_points
from uwbslam_jax.result import MapImage, Result, trinary

TRACK, BEACON, END = "tab:blue", "tab:red", "tab:green"
"""Colors of track, beacons and the track's end [matplotlib's names]: distinct on a gray map."""


def show_map(axes: Any, image: MapImage) -> None:
    """The observed part of a map in its own frame [m]: walls black, free white, unknown grey."""
    rows, columns = image.log_odds.shape
    (x, y), size = image.origin, image.resolution
    extent = (x, x + columns * size, y, y + rows * size)
    axes.imshow(trinary(image.log_odds), origin="lower", cmap="gray", vmin=0, vmax=255, extent=extent)
    seen = np.argwhere(image.log_odds != 0)
    if len(seen):
        (r0, c0), (r1, c1) = seen.min(0), seen.max(0) + 1
        axes.set(xlim=(x + c0 * size, x + c1 * size), ylim=(y + r0 * size, y + r1 * size))
    axes.set_aspect("equal")


def show_run(axes: Any, result: Result, title: str = "") -> None:
    """Map, track as published and beacons of a run [m]."""
    show_map(axes, result.map)
    show_track(axes, result.online, {beacon.id: beacon.position for beacon in result.beacons})
    axes.set(title=title, xlabel="x [m]", ylabel="y [m]")


def show_track(axes: Any, poses: np.ndarray, beacons: dict[int, np.ndarray]) -> None:
    """A track (T, 3) with a cross at its end, and beacons by id [m]."""
    axes.plot(poses[:, 0], poses[:, 1], color=TRACK, lw=0.8)
    axes.plot(*poses[-1, :2], "+", color=END, ms=10, mew=2)
    for node, place in beacons.items():
        axes.plot(*place, "^", color=BEACON, ms=6)
        axes.annotate(str(node), place, (4, 4), textcoords="offset points", color=BEACON, fontsize=8)


def lidar_surface(
    grid: Grid,
    sweep: Sweep,
    pose: Float[Array, "3"],
    offsets: Float[np.ndarray, "n"],
    resolution: float,
    level: int = 0,
) -> Float[np.ndarray, "n n"]:
    """LiDAR term of the paper's eq. (opt), half the sum of (1 - Gamma)^2, on a level of the pyramid, the pose moved
    by offsets in y (rows) and x (columns) [m]."""

    def term(dx: Float[Array, ""], dy: Float[Array, ""]) -> Float[Array, ""]:
        ends = transform_points(pose + jnp.stack([dx, dy, jnp.zeros(())]), sweep.points)
        gamma = occupancy.lookup(grid, ends, resolution, level)
        return 0.5 * jnp.sum(jnp.where(sweep.valid, (1.0 - gamma) ** 2, 0.0))

    steps = jnp.asarray(offsets, jnp.float32)
    rows = jax.jit(jax.vmap(lambda dy: jax.lax.map(lambda dx: term(dx, dy), steps)))
    return np.asarray(rows(steps))
