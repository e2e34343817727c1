"""The map outside the window: nothing is lost when the window moves, and the picture of the whole is right."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from uwbslam_jax.mapping import grid as occupancy
from uwbslam_jax.mapping.grid import EPOCH_LEVEL, Grid
from uwbslam_jax.mapping.tiled_map import TILE, Tiles

CELLS, LEVELS, RESOLUTION = 4 * TILE, 3, 0.1
SIDE = TILE * RESOLUTION


def patterned(seed: int = 0) -> Grid:
    """A window at the origin with different log-odds in every cell and a different epoch in every patch."""
    rng = np.random.default_rng(seed)
    levels = tuple(jnp.asarray(rng.normal(size=(CELLS >> k, CELLS >> k)), jnp.float32) for k in range(LEVELS))
    epochs = jnp.asarray(rng.uniform(1, 100, (CELLS >> EPOCH_LEVEL, CELLS >> EPOCH_LEVEL)), jnp.float32)
    return Grid(levels, occupancy.empty(CELLS, LEVELS, RESOLUTION).origin, epochs)


def assert_same(a: Grid, b: Grid) -> None:
    np.testing.assert_allclose(a.origin, b.origin, atol=1e-5)  # float32 [m]
    for x, y in zip(a.levels, b.levels, strict=True):
        np.testing.assert_array_equal(x, y)
    np.testing.assert_array_equal(a.epochs, b.epochs)


@pytest.mark.parametrize("robot", [(20.0, 0.0), (-20.0, 7.0), (0.0, 16.0), (300.0, -200.0)])
def test_there_and_back_restores_every_cell(robot):
    tiles, grid = Tiles(RESOLUTION), patterned()
    away = tiles.recentre(grid, np.array(robot))
    assert len(tiles) > 0
    assert np.abs(np.asarray(away.origin + CELLS * RESOLUTION / 2) - robot).max() <= SIDE / 2 + 1e-3
    back = tiles.recentre(away, np.zeros(2))
    assert_same(back, grid)
    assert len(tiles) == 0


def test_many_moves_in_small_steps_restore_every_cell():
    tiles, grid = Tiles(RESOLUTION), patterned()
    moved = grid
    for x, y in [(7, 0), (14, 7), (21, 14), (40, 14), (40, -60), (-30, -60), (-30, 20), (0, 0)]:
        moved = tiles.recentre(moved, np.array([x, y], float))
    assert_same(moved, grid)


def test_cells_that_stay_in_the_window_keep_their_place_in_the_world():
    tiles, grid = Tiles(RESOLUTION), patterned()
    moved = tiles.recentre(grid, np.array([SIDE, -2 * SIDE]))
    np.testing.assert_allclose(moved.origin - grid.origin, [SIDE, -2 * SIDE], atol=1e-5)
    for k in range(LEVELS):
        t = TILE >> k
        np.testing.assert_array_equal(moved.levels[k][2 * t :, : 3 * t], grid.levels[k][: 2 * t, t:])
        np.testing.assert_array_equal(moved.levels[k][: 2 * t], 0.0)
        np.testing.assert_array_equal(moved.levels[k][:, 3 * t :], 0.0)
    t = TILE >> EPOCH_LEVEL
    np.testing.assert_array_equal(moved.epochs[2 * t :, : 3 * t], grid.epochs[: 2 * t, t:])
    assert np.count_nonzero(moved.epochs) == 6 * t**2
    points = jnp.array([[1.03, -3.01], [8.2, -11.7], [3.3, -7.7]])
    for k in range(LEVELS):
        before = occupancy.lookup(grid, points, RESOLUTION, k)
        np.testing.assert_allclose(occupancy.lookup(moved, points, RESOLUTION, k), before, atol=1e-4)  # float32 place


def test_window_moves_only_when_the_robot_is_well_off_its_middle():
    tiles, origin = Tiles(RESOLUTION), np.asarray(patterned().origin, float)
    assert not tiles.needs_move(origin, CELLS, np.zeros(2))
    assert not tiles.needs_move(origin, CELLS, np.array([2.4 * SIDE, -2.4 * SIDE]))
    assert tiles.needs_move(origin, CELLS, np.array([0.0, 2.6 * SIDE]))


def test_unseen_tiles_are_not_kept_and_clear_forgets():
    tiles, grid = Tiles(RESOLUTION), occupancy.empty(CELLS, LEVELS, RESOLUTION)
    tiles.recentre(grid, np.array([500.0, 0.0]))
    assert len(tiles) == 0
    tiles.recentre(patterned(), np.array([500.0, 0.0]))
    assert len(tiles) == 16
    tiles.clear()
    assert len(tiles) == 0


def test_image_shows_window_and_tiles_in_one_place_each():
    tiles, grid = Tiles(RESOLUTION), patterned()
    away = tiles.recentre(grid, np.array([20.0, -13.0]))
    # something new in the window, far from all that was seen
    row, col = CELLS - 5, CELLS - 9
    away = away._replace(levels=(away.levels[0].at[row, col].set(3.5), *away.levels[1:]))
    picture = tiles.image(away)
    assert picture.resolution == RESOLUTION

    def shown(cell_row, cell_col, origin):
        at = np.asarray(origin) + (np.array([cell_col, cell_row]) + 0.5) * RESOLUTION
        c, r = np.floor((at - picture.origin) / RESOLUTION).astype(int)
        return picture.log_odds[r, c]

    rng = np.random.default_rng(1)
    for r, c in rng.integers(0, CELLS, (50, 2)):
        assert shown(r, c, grid.origin) == grid.levels[0][r, c]
    assert shown(row, col, away.origin) == 3.5
    assert np.count_nonzero(picture.log_odds) == CELLS**2 + 1


def test_image_is_cropped_to_what_was_observed():
    grid = occupancy.empty(CELLS, LEVELS, RESOLUTION)
    assert Tiles(RESOLUTION).image(grid).log_odds.shape == (1, 1)
    grid = grid._replace(levels=(grid.levels[0].at[TILE + 3, 2 * TILE + 5].set(1.0), *grid.levels[1:]))
    picture = Tiles(RESOLUTION).image(grid)
    assert picture.log_odds.shape == (TILE, TILE)
    assert picture.log_odds[3, 5] == 1.0
    np.testing.assert_allclose(picture.origin, [0.0, -SIDE], atol=1e-6)


def test_a_robot_that_is_nowhere_moves_no_window() -> None:
    assert not Tiles(0.05).needs_move(np.zeros(2), 1024, np.array([np.nan, 3.0]))
    assert Tiles(0.05).needs_move(np.zeros(2), 1024, np.array([3.0, 60.0]))
