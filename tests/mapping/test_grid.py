"""The occupancy grid against brute force: every cell and beam by itself in numpy, bilinear values by hand."""

from __future__ import annotations

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room
from derivatives import assert_gradient, double

from uwbslam_jax.mapping import grid as occupancy
from uwbslam_jax.mapping.grid import CLAMP, EPOCH_LEVEL, FREE, FREE_REACH_M, HIT, Grid
from uwbslam_jax.mapping.sweep import Sweep, undo_motion
from uwbslam_jax.numerics.se2 import transform_points

CELLS, LEVELS, RESOLUTION = 64, 2, 0.2

integrate = jax.jit(occupancy.integrate, static_argnums=3)


def sweep_of(scan, lidar=(0.0, 0.0, 0.0)) -> Sweep:
    """A scan taken at rest."""
    rest = jnp.zeros(2), jnp.zeros(())
    return undo_motion(jax.tree.map(jnp.asarray, scan), jnp.array(lidar), *rest)


def sweep_at(pose, beams: int = 90, lidar=(0.0, 0.0, 0.0)) -> Sweep:
    return sweep_of(room.scan(np.array(pose), beams, lidar=lidar), lidar)


def empty() -> Grid:
    return occupancy.empty(CELLS, LEVELS, RESOLUTION)


def drawn(grid: Grid, pose, sweep: Sweep) -> Grid:
    return integrate(grid, jnp.array(pose, jnp.float32), sweep, RESOLUTION)


def brute_force(level: np.ndarray, origin: np.ndarray, size: float, pose, sweep: Sweep):
    """One level after a scan, cell by cell and beam by beam; and where rounding cannot decide the other way.

    A cell is freed when the two beams on either side of its bearing both pass it by more than a cell.
    """
    pose, lidar = np.asarray(pose, float), np.asarray(sweep.sensor, float)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    sensor = pose[:2] + np.array([c * lidar[0] - s * lidar[1], s * lidar[0] + c * lidar[1]])
    yaw, step, reach = pose[2] + lidar[2], float(sweep.bearing_step), np.asarray(sweep.reach, float)
    cells, half = len(level), min(int(FREE_REACH_M / size), len(level) // 2)
    out, sure = np.array(level, float), np.ones(level.shape, bool)
    for row in range(cells):
        for col in range(cells):
            d = origin + (np.array([col, row]) + 0.5) * size - sensor
            if np.abs(d).max() > half * size:
                continue
            turned = (np.arctan2(d[1], d[0]) - yaw - float(sweep.bearing0)) * np.sign(step)
            index = (turned % (2 * np.pi)) / abs(step)
            sure[row, col] = abs(index - round(index)) > 1e-3
            b = int(index)
            if b + 1 < len(reach):
                margin = min(reach[b], reach[b + 1]) - size - np.hypot(*d)
                sure[row, col] &= abs(margin) > 1e-4
                out[row, col] += FREE * (margin > 0)
    ends = (np.asarray(sweep.points, float) @ np.array([[c, s], [-s, c]])) + pose[:2]
    for end, valid in zip(ends, np.asarray(sweep.valid), strict=True):
        at = (end - origin) / size
        col, row = np.floor(at).astype(int)
        if valid and 0 <= row < cells and 0 <= col < cells:
            if np.abs(at - np.round(at)).min() < 1e-3:  # on a border: either side may have it
                sure[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2] = False
            out[row, col] = level[row, col] + HIT
    return np.clip(out, *CLAMP), sure


def assert_as_brute_force(before: Grid, pose, sweep: Sweep) -> Grid:
    after = drawn(before, pose, sweep)
    for k, level in enumerate(after.levels):
        size = RESOLUTION * 2**k
        want, sure = brute_force(np.asarray(before.levels[k]), np.asarray(before.origin, float), size, pose, sweep)
        assert sure.mean() > 0.75
        np.testing.assert_allclose(np.asarray(level)[sure], want[sure], atol=1e-5)  # float32 sums of log-odds
    return after


# A sensor on the corner of a cell of both levels, where the table of bearings is exact.
ON_CORNERS = [(0.0, 0.0, 0.3), (1.6, -0.8, -2.0), (-2.4, 2.0, 3.0)]


@pytest.mark.parametrize("pose", ON_CORNERS)
def test_scan_frees_what_beams_pass_and_hits_where_they_end(pose):
    after = assert_as_brute_force(empty(), pose, sweep_at(pose))
    for level in after.levels:
        # unknown behind the walls, free inside, hit at the walls: all three are there
        assert {-1, 0, 1} == set(np.unique(np.sign(level)))


def test_second_scan_adds_to_the_first_and_a_hit_is_counted_once_a_scan():
    first = drawn(empty(), ON_CORNERS[0], sweep_at(ON_CORNERS[0]))
    after = assert_as_brute_force(first, ON_CORNERS[1], sweep_at(ON_CORNERS[1]))
    once = drawn(empty(), ON_CORNERS[0], sweep_at(ON_CORNERS[0], beams=720))  # many beams a cell
    np.testing.assert_allclose(once.levels[0].max(), HIT, rtol=1e-6)
    assert float(after.levels[0].max()) > HIT


def test_lidar_with_an_extrinsic_pose_draws_from_where_it_sits():
    lidar = (0.4, -0.4, 0.5)
    pose = (-0.8, 0.4, 0.0)
    assert_as_brute_force(empty(), pose, sweep_at(pose, lidar=lidar))


def test_sensor_anywhere_differs_from_brute_force_only_beside_the_borders_of_what_is_free():
    """The table of bearings is centred on a cell's corner, up to 0.7 cells off the sensor."""
    pose = (0.67, 0.35, 1.1)
    sweep = sweep_at(pose, beams=360)
    after = drawn(empty(), pose, sweep)
    want, _ = brute_force(np.zeros((CELLS, CELLS)), np.asarray(after.origin, float), RESOLUTION, pose, sweep)
    got = np.asarray(after.levels[0])
    wrong = np.argwhere(np.abs(got - want) > 1e-5)
    assert 0 < len(wrong) < 0.1 * (want < 0).sum()
    free, other = np.argwhere(want < 0), np.argwhere(want >= 0)
    for side in (free, other):
        assert np.abs(wrong[:, None] - side).max(axis=2).min(axis=1).max() <= 1
    # no wall is lost or made
    np.testing.assert_array_equal(got > 0, want > 0)


@pytest.mark.parametrize("corner", [(-1, -1), (1, -1), (1, 1)])
def test_near_the_windows_border_the_block_is_not_centred_and_still_right(corner):
    half = CELLS * RESOLUTION / 2
    pose = (corner[0] * (half - 1.6), corner[1] * (half - 0.8), 0.4)
    beams = 90
    # a square room around the sensor that reaches beyond the window
    scan = room.scan(np.array([0.0, 0.0, 0.4]), beams, walls=0.6 * room.WALLS)
    assert_as_brute_force(empty(), pose, sweep_of(scan))


def test_sensor_far_outside_the_window_draws_nothing():
    after = drawn(empty(), (40.0, 40.0, 0.0), sweep_at((0.0, 0.0, 0.0)))
    for level in after.levels:
        np.testing.assert_array_equal(level, 0.0)


def test_beams_without_return_draw_nothing():
    scan = room.scan(np.zeros(3), 90)
    none = scan._replace(valid=np.zeros(90, bool))
    after = drawn(empty(), (0.0, 0.0, 0.0), sweep_of(none))
    for level in after.levels:
        np.testing.assert_array_equal(level, 0.0)
    # half the beams: the other half of the room stays unknown
    half = scan._replace(valid=np.arange(90) < 45)  # bearings -180 to 0 degrees: y < 0
    after = assert_as_brute_force(empty(), (0.0, 0.0, 0.0), sweep_of(half))
    np.testing.assert_array_equal(np.asarray(after.levels[0])[CELLS // 2 + 2 :], 0.0)


def test_scan_upside_down_draws_the_same_room():
    scan = room.scan(np.array(ON_CORNERS[1]), 90)
    last = scan.angle_min + scan.angle_increment * np.float32(89)
    mirrored = scan._replace(
        ranges=scan.ranges[::-1], valid=scan.valid[::-1], angle_min=last, angle_increment=-scan.angle_increment
    )
    upright = drawn(empty(), ON_CORNERS[1], sweep_of(scan))
    turned = assert_as_brute_force(empty(), ON_CORNERS[1], sweep_of(mirrored))
    for a, b in zip(upright.levels, turned.levels, strict=True):
        assert (np.abs(np.asarray(a - b)) > 1e-5).mean() < 0.01  # cells that a beam's edge only just touches


def test_log_odds_are_clamped_at_both_ends():
    grid, sweep = empty(), sweep_at((0.0, 0.0, 0.0))
    for _ in range(12):
        grid = drawn(grid, (0.0, 0.0, 0.0), sweep)
    assert float(grid.levels[0].max()) == CLAMP[1]
    assert float(grid.levels[0].min()) == CLAMP[0]
    # HIT is 5.4 times FREE: what was free long is hit after two scans
    assert CLAMP[0] + 2 * HIT > 0


# The grid's ground has patches of 3.2 m, from corners at -6.4, -3.2, 0 and 3.2 m: 4 x 4 of them.

PATCH = RESOLUTION * 2**EPOCH_LEVEL


def patches(grid: Grid, points, inside=True) -> set[tuple[int, int]]:
    """Rows and columns of the ground's patches that points lie on."""
    at = np.floor((np.asarray(points, float) - np.asarray(grid.origin, float)) / PATCH).astype(int)
    return {(int(row), int(col)) for col, row in at[np.broadcast_to(inside, len(at))]}


def seen(grid: Grid, points, valid=True) -> float:
    points = jnp.asarray(points, jnp.float32)
    return float(occupancy.epoch_seen(grid, points, jnp.broadcast_to(jnp.asarray(valid), len(points)), RESOLUTION))


def test_ground_keeps_the_epoch_when_it_was_first_drawn():
    east, west = (sweep_of(half) for half in (facing(0.0), facing(np.pi)))
    first = integrate(empty(), jnp.zeros(3), east, RESOLUTION, 5.0)
    after = integrate(first, jnp.zeros(3), west, RESOLUTION, 9.0)
    again = integrate(after, jnp.zeros(3), east, RESOLUTION, 30.0)
    in_east = patches(first, east.points, np.asarray(east.valid))
    in_west = patches(first, west.points, np.asarray(west.valid))
    assert in_east & in_west  # where both were drawn, the first counts
    assert in_west - in_east
    for row in range(len(after.epochs)):
        for col in range(len(after.epochs)):
            want = 5.0 if (row, col) in in_east else 9.0 if (row, col) in in_west else 0.0
            assert float(after.epochs[row, col]) == want
    np.testing.assert_array_equal(again.epochs, after.epochs)


def facing(bearing: float):
    """A scan of the half of the room in a direction."""
    scan = room.scan(np.zeros(3), 90)
    bearings = scan.angle_min + scan.angle_increment * np.arange(90)
    return scan._replace(valid=np.cos(bearings - bearing) > -0.2)


def test_epoch_seen_is_the_mean_over_beams_that_end_on_drawn_ground():
    grid = empty()._replace(epochs=jnp.zeros((4, 4), jnp.float32).at[0, 1].set(4.0).at[2, 3].set(10.0))
    a, b, never, outside = (-1.0, -5.0), (5.0, 1.0), (1.0, 1.0), (50.0, 0.0)
    assert seen(grid, [a, a, a, b]) == pytest.approx(5.5)
    assert seen(grid, [a, b, never, never, outside]) == pytest.approx(7.0)
    assert seen(grid, [a, b], [True, False]) == pytest.approx(4.0)
    assert seen(grid, [never, outside]) == 0.0
    assert seen(grid, [a, b], False) == 0.0


def test_what_ends_outside_the_window_gives_no_ground_an_epoch():
    after = integrate(empty(), jnp.array([40.0, 40.0, 0.0]), sweep_at((0.0, 0.0, 0.0)), RESOLUTION, 5.0)
    np.testing.assert_array_equal(after.epochs, 0.0)


def random_grid(seed: int = 0) -> Grid:
    rng = np.random.default_rng(seed)
    levels = tuple(jnp.asarray(rng.normal(size=(CELLS >> k, CELLS >> k)), jnp.float32) for k in range(LEVELS))
    return empty()._replace(levels=levels, origin=jnp.array([-5.0, 2.0], jnp.float32))


def bilinear(grid: Grid, point, level: int) -> float:
    """The four nearest cell centres weighted by hand."""
    size = RESOLUTION * 2**level
    u = (np.asarray(point, float) - np.asarray(grid.origin, float)) / size - 0.5
    col, row = np.floor(u).astype(int)
    fx, fy = u - [col, row]
    g = 1 / (1 + np.exp(-np.asarray(grid.levels[level], float)[row : row + 2, col : col + 2]))
    return (1 - fy) * ((1 - fx) * g[0, 0] + fx * g[0, 1]) + fy * ((1 - fx) * g[1, 0] + fx * g[1, 1])


@pytest.mark.parametrize("level", range(LEVELS))
def test_lookup_is_bilinear_by_hand(level):
    grid = random_grid()
    rng = np.random.default_rng(1)
    points = np.asarray(grid.origin) + rng.uniform(0.3, CELLS * RESOLUTION - 0.3, (50, 2))
    got = occupancy.lookup(grid, jnp.asarray(points, jnp.float32), RESOLUTION, level)
    want = [bilinear(grid, p, level) for p in points]
    np.testing.assert_allclose(got, want, atol=2e-5)  # a place in the window is right to 1e-6 m, 1e-5 of a cell


def test_lookup_at_a_cells_centre_is_the_cell_and_outside_is_unknown():
    grid = random_grid()
    centre = np.asarray(grid.origin) + RESOLUTION * (np.array([[7, 3], [20, 50]]) + 0.5)
    got = occupancy.lookup(grid, jnp.asarray(centre, jnp.float32), RESOLUTION)
    np.testing.assert_allclose(got, jax.nn.sigmoid(grid.levels[0])[jnp.array([3, 50]), jnp.array([7, 20])], atol=2e-5)
    outside = jnp.array([[-6.0, 3.0], [100.0, 100.0], [0.0, -1e6]])
    np.testing.assert_array_equal(occupancy.lookup(grid, outside, RESOLUTION), 0.5)
    assert float(jnp.abs(jax.grad(lambda x: occupancy.lookup(grid, x, RESOLUTION).sum())(outside)).max()) == 0.0


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("level", range(LEVELS))
def test_gradient_of_lookup_agrees_with_finite_differences(level):
    """With respect to points, cells and the window's corner; no point within the step of a border."""
    grid = double(random_grid())
    rng = np.random.default_rng(2)
    points = jnp.asarray(np.array([-5.0, 2.0]) + rng.uniform(0.3, CELLS * RESOLUTION - 0.3, (20, 2)))
    weights = jnp.asarray(rng.normal(size=20))

    def value(at):
        points, level_values, origin = at
        levels = (*grid.levels[:level], level_values, *grid.levels[level + 1 :])
        return weights @ occupancy.lookup(grid._replace(levels=levels, origin=origin), points, RESOLUTION, level)

    gradient = assert_gradient(value, (points, grid.levels[level], grid.origin))
    assert int((gradient[1] != 0).sum()) > 60  # four cells a point


@pytest.mark.usefixtures("x64")
def test_interpolate_reports_the_gradient_that_differentiation_finds():
    grid = double(random_grid())
    rng = np.random.default_rng(3)
    points = jnp.asarray(np.array([-5.0, 2.0]) + rng.uniform(0.3, CELLS * RESOLUTION - 0.3, (20, 2)))
    corners, at, inside = occupancy.corner_log_odds(grid.levels[0], grid.origin, RESOLUTION, points)
    _, slope = occupancy.interpolate(jax.nn.sigmoid(corners), at, RESOLUTION)
    value = partial(occupancy.lookup, grid, resolution=RESOLUTION)
    assert bool(inside.all())
    np.testing.assert_allclose(slope, jax.grad(lambda x: value(x).sum())(points), rtol=1e-9, atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_gradient_of_a_drawn_map_with_respect_to_what_it_adds_to():
    """Drawing adds constants to cells: its derivative is 1 where nothing was clamped; poses only decide which cells."""
    sweep = double(sweep_at((0.0, 0.0, 0.0), beams=30))
    before = double(random_grid())
    before = double(empty())._replace(levels=tuple(0.1 * level for level in before.levels))
    weights = jnp.asarray(np.random.default_rng(4).normal(size=(CELLS, CELLS)))

    def value(at):
        levels, pose = at
        after = integrate(before._replace(levels=(levels, before.levels[1])), pose, sweep, RESOLUTION)
        return jnp.sum(weights * after.levels[0])

    gradient = assert_gradient(value, (before.levels[0], jnp.array([0.01, 0.02, 0.03])), count=3)
    np.testing.assert_allclose(gradient[0], weights, rtol=1e-12)
    np.testing.assert_array_equal(gradient[1], 0.0)


def test_end_points_fall_where_the_room_is():
    """The generator of these tests and the grid agree: all returns of a scan lie on walls."""
    pose = np.array([0.4, -0.3, 0.8])
    ends = np.asarray(transform_points(jnp.asarray(pose), sweep_at(pose).points))
    a, b = room.WALLS[:, 0], room.WALLS[:, 1]
    t = np.clip(((ends[:, None] - a) * (b - a)).sum(2) / ((b - a) ** 2).sum(1), 0, 1)
    off = np.linalg.norm(ends[:, None] - (a + t[..., None] * (b - a)), axis=2).min(axis=1)
    np.testing.assert_allclose(off, 0.0, atol=1e-5)


def test_a_scan_is_drawn_in_place_also_where_it_may_not_be_drawn() -> None:
    """As in a step: no level of the map is copied, whose memory is reused."""
    grid = occupancy.empty(256, 3, 0.05)
    beams = jnp.zeros(64)
    sweep = occupancy.Sweep(
        jnp.zeros((64, 2)), beams > -1, jnp.zeros(3), jnp.float32(0.0), jnp.float32(0.1), beams + 1.0
    )

    def drawn(grid, wanted, pose):
        return jax.lax.cond(wanted, lambda g: occupancy.integrate(g, pose, sweep, 0.05), lambda g: g, grid)

    compiled = jax.jit(drawn, donate_argnums=0).lower(grid, jnp.bool_(True), jnp.zeros(3)).compile().as_text()
    sizes = "|".join(f"{n},{n}" for n in (256, 128, 64))
    assert re.search(rf"f32\[({sizes})\]\S* scatter\(", compiled)
    assert not re.findall(rf"f32\[({sizes})\]\S* copy\(", compiled)
