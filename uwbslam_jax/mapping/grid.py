"""Occupancy pyramid: log-odds cells, bilinear lookup with its gradient, and the update by one scan.

A fixed window of the world on the device; what lies outside it is kept by `tiled_map`. Level l has cells of
resolution * 2^l and covers the same square. Cell (row, col) is centred at origin + ((col, row) + 0.5) * size.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from uwbslam_jax.mapping.sweep import Sweep

HIT = float(np.log(0.9 / 0.1))
"""Log-odds of a return in a cell (HectorSLAM's update factor 0.9)."""
FREE = float(np.log(0.4 / 0.6))
"""Log-odds of a beam through a cell (HectorSLAM's update factor 0.4)."""
CLAMP = (-2.5, 4.0)
"""Bounds of a cell, so that a door that closes is learnt within a few scans."""
EPOCH_LEVEL = 4
"""Epochs are kept by patches of 16 x 16 finest cells: drift differs from room to room, not from cell to cell."""
FREE_REACH_M = 12.8
"""Free space is carved this far from the sensor; returns are drawn as far as the window goes."""


class Grid(NamedTuple):
    """The window.

    Attributes:
      levels: log-odds of the pyramid's levels, finest first, each (cells, cells); 0 is unknown.
      origin: (2,) corner [m].
      epochs: when each patch of ground was first drawn, by the way driven until then [m]; 0 is never. Its cells are
        resolution * 2^EPOCH_LEVEL.
    """

    levels: tuple[Float[Array, "_ _"], ...]
    origin: Float[Array, "2"]
    epochs: Float[Array, "_ _"]


def empty(cells: int, levels: int, resolution: float) -> Grid:
    """A window without any observation, centred at (0, 0)."""
    half = cells * resolution / 2
    coarse = cells >> EPOCH_LEVEL
    return Grid(
        tuple(jnp.zeros((cells >> k, cells >> k), jnp.float32) for k in range(levels)),
        jnp.full(2, -half, jnp.float32),
        jnp.zeros((coarse, coarse), jnp.float32),
    )


_WINDOW = lax.GatherDimensionNumbers(offset_dims=(1, 2), collapsed_slice_dims=(), start_index_map=(0, 1))
"""Gathers the 2 x 2 cells that begin at [row, col]."""


def corner_log_odds(
    level: Float[Array, "c c"],
    origin: Float[Array, "2"],
    size: float | Float[Array | np.ndarray, ""],
    points: Float[Array, "n 2"],
) -> tuple[Float[Array, "n 2 2"], Float[Array, "n 2"], Bool[Array, "n"]]:
    """The four cells around each point [row, col], the point's place between them in [0, 1], and whether it is inside.

    One gather of 2 x 2 windows: on a CPU it is 3 to 4 times faster than four gathers.
    """
    cells = level.shape[0]
    u = (points - origin[None]) / size - 0.5
    corner = jnp.floor(u)
    inside = jnp.all((corner >= 0) & (corner <= cells - 2), axis=-1)
    corner = jnp.clip(corner, 0, cells - 2)
    start = corner[:, ::-1].astype(jnp.int32)
    return lax.gather(level, start, _WINDOW, (2, 2), mode="promise_in_bounds"), u - corner, inside


def interpolate(
    corners: Float[Array, "n 2 2"], at: Float[Array, "n 2"], size: float | Float[Array | np.ndarray, ""]
) -> tuple[Float[Array, "n"], Float[Array, "n 2"]]:
    """Bilinear value and its gradient [1/m] (paper, "LiDAR map matching"; HectorSLAM eq. 4-6)."""
    fx, fy = at[:, 0], at[:, 1]
    low = corners[:, 0, 0] + fx * (corners[:, 0, 1] - corners[:, 0, 0])
    high = corners[:, 1, 0] + fx * (corners[:, 1, 1] - corners[:, 1, 0])
    dx = (1 - fy) * (corners[:, 0, 1] - corners[:, 0, 0]) + fy * (corners[:, 1, 1] - corners[:, 1, 0])
    return low + fy * (high - low), jnp.stack([dx, high - low], axis=-1) / size


def lookup(grid: Grid, points: Float[Array, "n 2"], resolution: float, level: int = 0) -> Float[Array, "n"]:
    """Occupancy probability Gamma at points, 0.5 outside the window. Differentiable in points and cells."""
    size = resolution * 2**level
    corners, at, inside = corner_log_odds(grid.levels[level], grid.origin, size, points)
    value, _ = interpolate(jax.nn.sigmoid(corners), at, size)
    return jnp.where(inside, value, 0.5)


@cache
def _polar_tables(half: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Bearing and distance of every cell of a (2 half) square from its middle corner [rad, m]."""
    axis = (np.arange(2 * half) - half + 0.5) * size
    x, y = np.meshgrid(axis, axis)
    return np.arctan2(y, x).astype(np.float32), np.hypot(x, y).astype(np.float32)


def epoch_seen(grid: Grid, ends: Float[Array, "B 2"], valid: Bool[Array, "B"], resolution: float) -> Float[Array, ""]:
    """Mean epoch of the ground that beams end on, 0 where none of it was ever drawn."""
    row, col, inside = _epoch_cells(grid, ends, valid, resolution)
    epoch = jnp.where(inside, grid.epochs[row, col], 0.0)
    return jnp.sum(epoch) / jnp.maximum(jnp.sum(epoch > 0), 1)


def _epoch_cells(
    grid: Grid, ends: Float[Array, "B 2"], valid: Bool[Array, "B"], resolution: float
) -> tuple[Int[Array, "B"], Int[Array, "B"], Bool[Array, "B"]]:
    """Row and col of the patches that beams end on, and whether they are in the window."""
    cells = grid.epochs.shape[0]
    cell = jnp.floor((ends - grid.origin[None]) / (resolution * 2**EPOCH_LEVEL)).astype(jnp.int32)
    inside = valid & jnp.all((cell >= 0) & (cell < cells), axis=-1)
    cell = jnp.clip(cell, 0, cells - 1)
    return cell[:, 1], cell[:, 0], inside


def integrate(
    grid: Grid, pose: Float[Array, "3"], sweep: Sweep, resolution: float, epoch: float | Float[Array, ""] = 1.0
) -> Grid:
    """The map after one scan seen from a pose: HIT where beams end, FREE where they pass, clamped; ground that was
    never drawn gets the epoch.

    A cell is free when the two beams on either side of its bearing both pass it: a wall seen at grazing incidence
    is not eaten by its neighbour. A cell that is hit is not freed by the same scan.
    """
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x = pose[0] + c * sweep.points[:, 0] - s * sweep.points[:, 1]
    y = pose[1] + s * sweep.points[:, 0] + c * sweep.points[:, 1]
    ends = jnp.stack([x, y], axis=-1)
    sx, sy = c * sweep.sensor[0] - s * sweep.sensor[1], s * sweep.sensor[0] + c * sweep.sensor[1]
    sensor = jnp.stack([pose[0] + sx, pose[1] + sy, pose[2] + sweep.sensor[2]])
    placed = sweep._replace(points=ends, sensor=sensor)
    levels = [_integrate_level(x, grid.origin, resolution * 2**k, placed) for k, x in enumerate(grid.levels)]
    row, col, inside = _epoch_cells(grid, ends, sweep.valid, resolution)
    before = grid.epochs[row, col]
    first = jnp.where(before > 0, before, epoch)
    epochs = grid.epochs.at[jnp.where(inside, row, grid.epochs.shape[0]), col].set(first, mode="drop")
    return Grid(tuple(levels), grid.origin, epochs)


def _integrate_level(
    level: Float[Array, "c c"], origin: Float[Array, "2"], size: float, sweep: Sweep
) -> Float[Array, "c c"]:
    """One level after a scan given in the map's frame."""
    cells = level.shape[0]
    half = min(int(FREE_REACH_M / size), cells // 2)
    bearing, distance = _polar_tables(half, size)
    middle = jnp.round((sweep.sensor[:2] - origin) / size).astype(jnp.int32)
    start = jnp.clip(middle - half, 0, cells - 2 * half)
    cell = jnp.floor((sweep.points - origin[None]) / size).astype(jnp.int32)
    inside = sweep.valid & jnp.all((cell >= 0) & (cell < cells), axis=-1)
    clipped = jnp.clip(cell, 0, cells - 1)
    struck = jnp.clip(level[clipped[:, 1], clipped[:, 0]] + HIT, *CLAMP)
    block = lax.dynamic_slice(level, (start[1], start[0]), (2 * half, 2 * half))
    # near the window's edge the block cannot be centred; its tables are shifted by as many cells
    shift = start - (middle - half)
    bearing = _shifted(bearing, shift)
    distance = _shifted(distance, shift)
    # a sensor outside the window is beyond the shifted tables: it frees nothing
    free = _passed(bearing, distance, size, sweep) & jnp.all((middle >= 0) & (middle <= cells))
    block = jnp.where(free, jnp.maximum(block + FREE, CLAMP[0]), block)
    # adds nothing, but what is written now needs what was read of the level before: without, XLA keeps a copy for it
    block = block + 0.0 * struck[0]
    freed = lax.dynamic_update_slice(level, block, (start[1], start[0]))
    row, col = jnp.where(inside, cell[:, 1], cells), jnp.where(inside, cell[:, 0], cells)
    # many beams in one cell write the same value: once hit is once hit
    return freed.at[row, col].set(struck, mode="drop")


def _shifted(table: np.ndarray, shift: Int[Array, "2"]) -> Float[Array, "h h"]:
    h = table.shape[0]
    padded = jnp.asarray(np.pad(table, h // 2, constant_values=np.float32(1e6)))
    at = jnp.clip(shift + h // 2, 0, h)
    return lax.dynamic_slice(padded, (at[1], at[0]), (h, h))


def _passed(
    bearing: Float[Array, "h h"], distance: Float[Array, "h h"], size: float, sweep: Sweep
) -> Bool[Array, "h h"]:
    """Which cells, by their bearing and distance from the sensor [rad, m], both beams beside them pass."""
    beams = sweep.reach.shape[0]
    # a LiDAR mounted upside down sweeps clockwise: its bearings count the other way
    relative = (bearing - sweep.sensor[2] - sweep.bearing0) * jnp.sign(sweep.bearing_step)
    turn = 2 * jnp.pi
    # the first beam's bearing is 0; bearings just below it belong to no beam
    relative = relative - turn * jnp.floor(relative / turn)
    index = relative / jnp.abs(sweep.bearing_step)
    low = jnp.clip(index.astype(jnp.int32), 0, beams - 2)
    pair = jnp.minimum(sweep.reach[:-1], sweep.reach[1:])
    return (index < beams - 1) & (distance < pair[low] - size)
