"""The map drawn again from scans at poses that are known better now."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from uwbslam_jax.mapping import grid as occupancy
from uwbslam_jax.estimator import step
from uwbslam_jax.settings import Config, Params
from uwbslam_jax.mapping.grid import Grid
from uwbslam_jax.measurements import Snapshot
from uwbslam_jax.mapping.tiled_map import Tiles


def redraw(
    config: Config,
    params: Params,
    tiles: Tiles,
    seen: Iterable[tuple[np.ndarray, Snapshot]],
    robot: np.ndarray,
    epoch: float = 1.0,
) -> Grid:
    """A fresh map of scans (pose (3,) [m, m, rad], snapshot), in their order; its window is over the robot (2,) [m] at
    the end, what lies outside it in the tiles. epoch: of the ground, see grid [m]."""
    tiles.clear()
    grid = tiles.recentre(occupancy.empty(config.cells, config.levels, config.resolution), robot)
    for pose, snapshot in seen:
        grid = draw_onto(config, params, tiles, grid, pose, snapshot, epoch)
    if tiles.needs_move(np.asarray(grid.origin, float), config.cells, robot):
        grid = tiles.recentre(grid, robot)
    return grid


def draw_onto(
    config: Config, params: Params, tiles: Tiles, grid: Grid, pose: np.ndarray, snapshot: Snapshot, epoch: float
) -> Grid:
    """The map with one more scan at a pose (3,) [m, m, rad]; the window follows it."""
    if tiles.needs_move(np.asarray(grid.origin, float), config.cells, pose[:2]):
        grid = tiles.recentre(grid, pose[:2])
    return _draw(config, params, grid, np.float32(pose), snapshot, np.float32(epoch))


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def _draw(config: Config, params: Params, grid: Grid, pose, snapshot: Snapshot, epoch) -> Grid:
    sweep = step.undo_motion(snapshot.scan, params.lidar, snapshot.drift, snapshot.yaw_rate)
    return occupancy.integrate(grid, jnp.asarray(pose), sweep, config.resolution, epoch)
