"""The part of the map outside the device's window: tiles on the host; and the map drawn again from scans.

The window follows the robot in whole tiles. A map is drawn again when the poses of its scans are known better.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from uwbslam_jax.mapping import grid as occupancy
from uwbslam_jax.mapping.grid import EPOCH_LEVEL, Grid
from uwbslam_jax.mapping.sweep import undo_motion
from uwbslam_jax.measurements import Snapshot
from uwbslam_jax.result import MapImage
from uwbslam_jax.settings import Config, Params

Posed = tuple[np.ndarray, Snapshot]
"""A scan to be drawn, and the pose (3,) that it is drawn at [m, m, rad]."""
TILE = 64
"""Finest cells along a tile's side."""
_EPOCHS = -1
"""Where the epochs stand among the layers of a tile, whose other keys are the pyramid's levels."""
_SLACK = 2
"""The window moves when the robot is more than this many tiles off its middle."""


class Tiles:
    """Tiles that left the window, by their (row, col) in the world; only what was ever observed is kept."""

    def __init__(self, resolution: float):
        self.resolution = resolution
        self._kept: dict[tuple[int, int], dict[int, np.ndarray]] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def clear(self) -> None:
        """Forget all: the map is drawn anew."""
        self._kept.clear()

    def copy(self) -> Tiles:
        """The same tiles, not changed by what happens to these."""
        other = Tiles(self.resolution)
        other._kept = dict(self._kept)
        return other

    def dump(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """All tiles as arrays: (n, 2) row and col, and of each layer (n, side, side), the epochs' last."""
        layers = sorted(next(iter(self._kept.values()), {}), key=lambda k: (k == _EPOCHS, k))
        places = np.array(list(self._kept), np.int64).reshape(-1, 2)
        return places, [np.stack([blocks[k] for blocks in self._kept.values()]) for k in layers]

    def load(self, places: np.ndarray, layers: list[np.ndarray]) -> None:
        """Take over what `dump` gave."""
        keys = [*range(len(layers) - 1), _EPOCHS]
        for n, (row, col) in enumerate(places.tolist()):
            self._kept[row, col] = {k: layer[n] for k, layer in zip(keys, layers, strict=True)}

    def needs_move(self, origin: np.ndarray, cells: int, robot: np.ndarray) -> bool:
        """Whether the robot (2,) [m] is too far off the middle of the window at origin (2,) [m]; one that is nowhere (a
        state that is not finite any more) is not."""
        return bool(np.isfinite(robot).all()) and bool(np.abs(self._offset(origin, cells, robot)).max() > _SLACK)

    def _offset(self, origin: np.ndarray, cells: int, robot: np.ndarray) -> np.ndarray:
        middle = origin + cells * self.resolution / 2
        return np.round((robot - middle) / (TILE * self.resolution)).astype(int)

    def recentre(self, grid: Grid, robot: np.ndarray) -> Grid:
        """The window moved over the robot: what leaves it is kept, what was kept comes back."""
        cells = grid.levels[0].shape[0]
        origin = np.asarray(grid.origin)
        shift = self._offset(origin, cells, robot)
        old = {k: np.asarray(level) for k, level in enumerate(grid.levels)}
        old[_EPOCHS] = np.asarray(grid.epochs)
        new = {k: np.zeros_like(layer) for k, layer in old.items()}
        count = cells // TILE
        first = np.round(origin / (TILE * self.resolution)).astype(int)
        for row in range(count):
            for col in range(count):
                r, c = row - shift[1], col - shift[0]
                blocks = {k: layer[_block(k, row, col)] for k, layer in old.items()}
                if 0 <= r < count and 0 <= c < count:
                    for k, block in blocks.items():
                        new[k][_block(k, r, c)] = block
                elif any(block.any() for block in blocks.values()):
                    self._kept[first[1] + row, first[0] + col] = {k: block.copy() for k, block in blocks.items()}
        first = first + shift
        for row in range(count):
            for col in range(count):
                for k, block in self._kept.pop((first[1] + row, first[0] + col), {}).items():
                    new[k][_block(k, row, col)] = block
        corner = first * (TILE * self.resolution)
        levels = tuple(jnp.asarray(new[k]) for k in range(len(grid.levels)))
        return Grid(levels, jnp.asarray(corner, jnp.float32), jnp.asarray(new[_EPOCHS]))

    def image(self, grid: Grid) -> MapImage:
        """The whole map at the finest level, window and tiles, cropped to what was observed."""
        side = TILE * self.resolution
        first = np.round(np.asarray(grid.origin) / side).astype(int)
        window = np.asarray(grid.levels[0])
        count = window.shape[0] // TILE
        every = {key: blocks[0] for key, blocks in self._kept.items()}
        for row in range(count):
            for col in range(count):
                block = window[_block(0, row, col)]
                if block.any():
                    every[first[1] + row, first[0] + col] = block
        if not every:
            return MapImage(np.zeros((1, 1), np.float32), self.resolution, np.zeros(2))
        rows, cols = np.array(list(every)).T
        low = np.array([rows.min(), cols.min()])
        shape = (np.array([rows.max(), cols.max()]) - low + 1) * TILE
        whole = np.zeros(shape, np.float32)
        for (row, col), block in every.items():
            whole[_block(0, row - low[0], col - low[1])] = block
        return MapImage(whole, self.resolution, low[::-1] * side)


def _block(layer: int, row: int | np.integer, col: int | np.integer) -> tuple[slice, slice]:
    size = TILE >> (EPOCH_LEVEL if layer == _EPOCHS else layer)
    return slice(row * size, (row + 1) * size), slice(col * size, (col + 1) * size)


def redraw(
    config: Config, params: Params, tiles: Tiles, seen: Iterable[Posed], robot: np.ndarray, epoch: float = 1.0
) -> Grid:
    """A fresh map of scans, in their order; its window is over the robot (2,) [m] at the end, what lies outside it in
    the tiles. epoch: of the ground, see grid [m]."""
    tiles.clear()
    grid = tiles.recentre(occupancy.empty(config.cells, config.levels, config.resolution), robot)
    grid = draw_onto(config, params, tiles, grid, seen, epoch)
    if tiles.needs_move(np.asarray(grid.origin, float), config.cells, robot):
        grid = tiles.recentre(grid, robot)
    return grid


def draw_onto(config: Config, params: Params, tiles: Tiles, grid: Grid, seen: Iterable[Posed], epoch: float) -> Grid:
    """The map with more scans, in their order; the window follows them."""
    for pose, snapshot in seen:
        if tiles.needs_move(np.asarray(grid.origin, float), config.cells, pose[:2]):
            grid = tiles.recentre(grid, pose[:2])
        grid = _draw(config, params, grid, np.float32(pose), snapshot, np.float32(epoch))
    return grid


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def _draw(
    config: Config, params: Params, grid: Grid, pose: Float[Array, "3"], snapshot: Snapshot, epoch: Float[Array, ""]
) -> Grid:
    sweep = undo_motion(snapshot.scan, params.lidar, snapshot.drift, snapshot.yaw_rate)
    return occupancy.integrate(grid, pose, sweep, config.resolution, epoch)
