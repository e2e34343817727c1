"""Occupancy pyramid: bilinear lookup, and the update by one scan. Twin: mapping.grid.

A gather stands in a loop of its own: with it LLVM would vectorise nothing of the loop.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from uwbslam_jax.estimator.native.loops import loops, sums
from uwbslam_jax.estimator.native.sweep import Sweep
from uwbslam_jax.mapping import grid as twin

f32: Any = np.float32
i32: Any = np.int32
index: Any = np.uintp


class Window(NamedTuple):
    """Twin: Grid, its levels one after the other in one vector, the epochs last.

    Attributes:
      cells: log-odds. tables: bearing and distance of cells around a sensor, see `polar_tables`.
      side: cells along the finest level's side. levels: how many. size: of a finest cell [m]. x, y: of the corner [m].
    """

    cells: Float[ndarray, "_"]
    tables: Float[ndarray, "_"]
    side: int
    levels: int
    size: float
    x: float
    y: float


class Ends(NamedTuple):
    """Where beams end in a level.

    Attributes:
      rows: (10, B): x and y [m]; the place between the four cells around, twice in [0, 1]; 1 where there is a return
        inside the window; log-odds of the cells [row, col], [row, col + 1], [row + 1, col], [row + 1, col + 1];
        interpolated probability.
      cell: (B,) of [row, col] in the level.
    """

    rows: Float[ndarray, "10 B"]
    cell: Int[ndarray, "B"]


@loops
def level_of(window: Window, k: int) -> Float[ndarray, "c c"]:
    begin = 0
    for finer in range(k):
        begin += (window.side >> finer) ** 2
    side = window.side >> k
    return window.cells[begin : begin + side * side].reshape(side, side)


@loops
def epochs_of(window: Window) -> Float[ndarray, "e e"]:
    side = window.side >> twin.EPOCH_LEVEL
    return window.cells[window.cells.size - side * side :].reshape(side, side)


@loops
def size_of(window: Window, k: int) -> float:
    """Of a cell of a level [m]."""
    return f32(window.size * (1 << k))


@loops
def transform_points(pose: Float[ndarray, "3"], sweep: Sweep, ends: Ends) -> None:
    c, s, px, py = f32(math.cos(pose[2])), f32(math.sin(pose[2])), f32(pose[0]), f32(pose[1])
    from_x, from_y, x, y = sweep.rows[0], sweep.rows[1], ends.rows[0], ends.rows[1]
    for i in range(from_x.size):
        x[i] = px + (c * from_x[i] - s * from_y[i])
        y[i] = py + (s * from_x[i] + c * from_y[i])


@loops
def find_cells(window: Window, k: int, sweep: Sweep, ends: Ends) -> None:
    """Which four cells lie around each end. One that is nowhere (NaN) is taken to be in the corner, and not inside."""
    side, size = window.side >> k, size_of(window, k)
    zero, half, top, ox, oy = f32(0.0), f32(0.5), f32(side - 2), window.x, window.y
    x, y, at_x, at_y, inside = ends.rows[0], ends.rows[1], ends.rows[2], ends.rows[3], ends.rows[4]
    valid, cell, wide = sweep.rows[2], ends.cell, i32(side)
    for i in range(valid.size):
        u, v = (x[i] - ox) / size - half, (y[i] - oy) / size - half
        col, row = np.floor(u), np.floor(v)
        is_in = (col >= zero) & (col <= top) & (row >= zero) & (row <= top)
        inside[i] = valid[i] if is_in else zero
        at_x[i] = u - col if is_in else zero
        at_y[i] = v - row if is_in else zero
        cell[i] = i32(min(top, max(zero, row))) * wide + i32(min(top, max(zero, col)))


@loops
def corner_log_odds(window: Window, k: int, pose: Float[ndarray, "3"], sweep: Sweep, ends: Ends) -> None:
    transform_points(pose, sweep, ends)
    find_cells(window, k, sweep, ends)
    flat, side, cell = level_of(window, k).reshape(-1), window.side >> k, ends.cell
    a, b, c, d = ends.rows[5], ends.rows[6], ends.rows[7], ends.rows[8]
    for i in range(sweep.rows.shape[1]):
        at = index(cell[i])
        a[i] = flat[at]
        b[i] = flat[at + index(1)]
        c[i] = flat[at + index(side)]
        d[i] = flat[at + index(side + 1)]


@loops
def sigmoid(x: float) -> float:
    """1 / (1 + exp(-x)) with the exponential of Cephes, to float32's last digit or two."""
    x = min(max(-x, f32(-87.0)), f32(88.0))
    n = np.floor(x * f32(1.44269504) + f32(0.5))
    r = (x - n * f32(0.693359375)) - n * f32(-2.12194440e-4)
    p = (f32(1.9875691500e-4) * r + f32(1.3981999507e-3)) * r + f32(8.3334519073e-3)
    p = ((p * r + f32(4.1665795894e-2)) * r + f32(1.6666665459e-1)) * r + f32(5.0000001201e-1)
    power = i32((i32(n) + i32(127)) << i32(23)).view(np.float32)
    return f32(1.0) / (f32(1.0) + (p * r * r + r + f32(1.0)) * power)


@loops
def epoch_cells(window: Window, sweep: Sweep, ends: Ends) -> None:
    """Which patch each end lies on, and whether it is in the window."""
    side, size = window.side >> twin.EPOCH_LEVEL, f32(window.size * (1 << twin.EPOCH_LEVEL))
    zero, top, ox, oy = f32(0.0), f32(side - 1), window.x, window.y
    x, y, inside, cell, valid = ends.rows[0], ends.rows[1], ends.rows[4], ends.cell, sweep.rows[2]
    for i in range(valid.size):
        col, row = np.floor((x[i] - ox) / size), np.floor((y[i] - oy) / size)
        is_in = (col >= zero) & (col <= top) & (row >= zero) & (row <= top)
        inside[i] = valid[i] if is_in else zero
        cell[i] = i32(min(top, max(zero, row))) * i32(side) + i32(min(top, max(zero, col)))


@sums
def epoch_seen(window: Window, pose: Float[ndarray, "3"], sweep: Sweep, ends: Ends) -> float:
    transform_points(pose, sweep, ends)
    epoch_cells(window, sweep, ends)
    flat, total, count = epochs_of(window).reshape(-1), f32(0.0), f32(0.0)
    inside, cell = ends.rows[4], ends.cell
    for i in range(sweep.rows.shape[1]):
        epoch = flat[index(cell[i])] * inside[i]
        total += epoch
        count += f32(1.0) if epoch > f32(0.0) else f32(0.0)
    return float(total / max(count, f32(1.0)))


@loops
def half_of(side: int, size: float) -> int:
    """Half the side of the square of cells that may be freed around the sensor."""
    return min(int(twin.FREE_REACH_M / size), side // 2)


def polar_tables(side: int, levels: int, size: float) -> Float[np.ndarray, "_"]:
    """For each level the bearings, then the distances, of the cells around a sensor. Twin: _polar_tables."""
    halves = [(min(int(twin.FREE_REACH_M / (size * 2**k)), (side >> k) // 2), size * 2**k) for k in range(levels)]
    return np.concatenate([table.ravel() for half in halves for table in twin._polar_tables(*half)])


class Square(NamedTuple):
    """The cells around a sensor that a scan may free.

    Attributes:
      bearing, distance: tables. row, col: of the level's cell at their corner.
    """

    bearing: Float[ndarray, "h h"]
    distance: Float[ndarray, "h h"]
    row: int
    col: int


@loops
def square_of(window: Window, k: int, row: int, col: int) -> Square:
    """Args: row, col: of the cell's corner that is next to the sensor."""
    begin = 0
    for finer in range(k):
        begin += 2 * (2 * half_of(window.side >> finer, window.size * (1 << finer))) ** 2
    half = half_of(window.side >> k, window.size * (1 << k))
    wide, count = 2 * half, (2 * half) ** 2
    bearing = window.tables[begin : begin + count].reshape(wide, wide)
    distance = window.tables[begin + count : begin + 2 * count].reshape(wide, wide)
    return Square(bearing, distance, row - half, col - half)


class Gaps(NamedTuple):
    """Of neighbouring beams.

    Attributes:
      pass_: (B,) how far both beams beside a gap pass, and the last beam nothing [m].
      base: bearing of the first beam in the map [rad]. sign: -1 where the beams run clockwise.
      per_step: 1 over the angle between two [1/rad]. beam, limit: (c,) work.
    """

    pass_: Float[ndarray, "B"]
    base: float
    sign: float
    per_step: float
    beam: Int[ndarray, "c"]
    limit: Float[ndarray, "c"]


@loops
def free_row(row: Float[ndarray, "c"], bearing: Float[ndarray, "c"], distance: Float[ndarray, "c"], gaps: Gaps) -> None:
    turn, per_turn, last = f32(2 * math.pi), f32(1 / (2 * math.pi)), f32(gaps.pass_.size - 1)
    base, sign, per_step, beam, limit, pass_ = gaps.base, gaps.sign, gaps.per_step, gaps.beam, gaps.limit, gaps.pass_
    for i in range(row.size):
        relative = (bearing[i] - base) * sign
        relative -= turn * np.floor(relative * per_turn)
        beam[i] = i32(min(last, max(f32(0.0), relative * per_step)))
    for i in range(row.size):
        limit[i] = pass_[index(beam[i])]
    free, low = f32(twin.FREE), f32(twin.CLAMP[0])
    for i in range(row.size):
        old = row[i]
        row[i] = max(old + free, low) if distance[i] < limit[i] else old


@loops
def free_square(level: Float[ndarray, "c c"], square: Square, gaps: Gaps, reach: int) -> None:
    """Frees what the beams pass, within so many cells of the sensor."""
    side, wide = level.shape[0], square.bearing.shape[0]
    half = wide // 2
    for r in range(max(0, half - reach, -square.row), min(wide, half + reach, side - square.row)):
        up = r - half + 0.5
        out = int(math.sqrt(max(reach * reach - up * up, 0.0))) + 1
        begin, end = max(0, half - out, -square.col), min(wide, half + out, side - square.col)
        if begin < end:
            cells = level[square.row + r, square.col + begin : square.col + end]
            free_row(cells, square.bearing[r, begin:end], square.distance[r, begin:end], gaps)


@loops
def passes(reach: Float[ndarray, "B"], size: float, pass_: Float[ndarray, "B"]) -> float:
    """How far beams pass, two by two, and the farthest of them [m]."""
    farthest, last = f32(0.0), reach.size - 1
    for i in range(last):
        pass_[i] = min(reach[i], reach[i + 1]) - size
        farthest = max(farthest, pass_[i])
    pass_[last] = f32(-1.0)
    return farthest


@loops
def hit(window: Window, k: int, sweep: Sweep, ends: Ends) -> int:
    """Which cells of a level are hit (ends.cell), and what they become (ends.rows[9]); how many there are."""
    flat, side, size = level_of(window, k).reshape(-1), window.side >> k, size_of(window, k)
    x, y, cell, struck, valid, hits = ends.rows[0], ends.rows[1], ends.cell, ends.rows[9], sweep.rows[2], 0
    for i in range(valid.size):
        if valid[i] > f32(0.0):
            col, row = np.floor((x[i] - window.x) / size), np.floor((y[i] - window.y) / size)
            if col >= f32(0.0) and row >= f32(0.0) and col < f32(side) and row < f32(side):
                cell[hits] = i32(row) * i32(side) + i32(col)
                more = flat[index(cell[hits])] + f32(twin.HIT)
                struck[hits] = min(max(more, f32(twin.CLAMP[0])), f32(twin.CLAMP[1]))
                hits += 1
    return hits


@loops
def integrate_level(window: Window, k: int, pose: Float[ndarray, "3"], sweep: Sweep, ends: Ends) -> None:
    """One level, in place. ends: x and y are the ends; the rest is work."""
    level, side, size = level_of(window, k), window.side >> k, size_of(window, k)
    hits, struck, flat, pass_ = hit(window, k, sweep, ends), ends.rows[9], level.reshape(-1), ends.rows[5]
    c, s, sensor = f32(math.cos(pose[2])), f32(math.sin(pose[2])), sweep.sensor
    x, y = f32(pose[0]) + (c * sensor[0] - s * sensor[1]), f32(pose[1]) + (s * sensor[0] + c * sensor[1])
    col, row = int(np.rint((x - window.x) / size)), int(np.rint((y - window.y) / size))
    if 0 <= row <= side and 0 <= col <= side:
        base, sign = f32(pose[2]) + sensor[2] + sweep.bearing0, f32(1.0 if sweep.bearing_step > 0 else -1.0)
        square = square_of(window, k, row, col)
        beam, limit = np.empty(square.bearing.shape[0], np.int32), np.empty(square.bearing.shape[0], np.float32)
        gaps = Gaps(pass_, base, sign, f32(1.0) / abs(sweep.bearing_step), beam, limit)
        reach = int(passes(sweep.rows[3], size, pass_) / size) + 2
        free_square(level, square, gaps, reach)
    for i in range(hits):
        flat[index(ends.cell[i])] = struck[i]


@loops
def integrate(window: Window, pose: Float[ndarray, "3"], sweep: Sweep, epoch: float, ends: Ends) -> None:
    """Draws a scan, in place. A pose that is nowhere draws nothing."""
    if not math.isfinite(pose[0] + pose[1] + pose[2]):
        return
    transform_points(pose, sweep, ends)
    for k in range(window.levels):
        integrate_level(window, k, pose, sweep, ends)
    epoch_cells(window, sweep, ends)
    flat, inside = epochs_of(window).reshape(-1), ends.rows[4]
    for i in range(sweep.rows.shape[1]):
        at = index(ends.cell[i])
        if inside[i] > f32(0.0) and not flat[at] > f32(0.0):
            flat[at] = epoch
