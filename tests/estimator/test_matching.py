"""Aligning scans of a known room: near starts, the prior where the scan says nothing, and the wide search."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room
from derivatives import assert_gradient, double

from uwbslam_jax.estimator import matching, wide_search
from uwbslam_jax.mapping import grid as occupancy
from uwbslam_jax.mapping.sweep import find_surface, undo_motion
from uwbslam_jax.numerics.gaussian import Gaussian

CELLS, LEVELS, RESOLUTION, BEAMS = 128, 3, 0.1, 180
SIGMA_L = 0.25


def view_of(sweep, sigma_l=SIGMA_L):
    return matching.view(sweep, jnp.asarray(sigma_l, sweep.points.dtype))


@partial(jax.jit, static_argnums=5)
def align(grid, sweep, start, prior, sigma_l, resolution):
    return matching.align(grid, view_of(sweep, sigma_l), start, prior, resolution)


@partial(jax.jit, static_argnums=3)
def assess(grid, sweep, pose, resolution):
    return matching.assess(grid, view_of(sweep), pose, resolution)


@partial(jax.jit, static_argnums=4)
def search(grid, sweep, prior, sigma_l, resolution):
    return wide_search.search(grid, view_of(sweep, sigma_l), prior, prior.mean, prior.mean, resolution)


def sweep_at(pose, beams=BEAMS, walls=room.WALLS):
    scan = jax.tree.map(jnp.asarray, room.scan(np.array(pose, float), beams, walls))
    return undo_motion(scan, jnp.zeros(3), jnp.zeros(2), jnp.zeros(()))


THREE_PLACES = [(0.0, 0.0, 0.0), (-2.0, 2.0, 1.0), (2.0, -1.5, -1.0)] * 3


def drawn(walls=room.WALLS, poses=THREE_PLACES):
    """The room as seen from some places, often enough to be sure of it."""
    grid = occupancy.empty(CELLS, LEVELS, RESOLUTION)
    draw = jax.jit(occupancy.integrate, static_argnums=3)
    for pose in poses:
        grid = draw(grid, jnp.array(pose, jnp.float32), sweep_at(pose, 720, walls), RESOLUTION)
    return grid


@pytest.fixture(scope="module")
def room_map():
    return drawn()


def wide(pose, sigma=0.5) -> Gaussian:
    return Gaussian(jnp.asarray(pose, jnp.float32), jnp.diag(jnp.full(3, sigma**2, jnp.float32)))


def aligned(grid, truth, start, prior=None, walls=room.WALLS):
    prior = wide(start) if prior is None else prior
    sweep = sweep_at(truth, walls=walls)
    return align(grid, sweep, jnp.asarray(start, jnp.float32), prior, jnp.float32(SIGMA_L), RESOLUTION)


@pytest.mark.parametrize("offset", [(0.2, -0.1, 0.1), (-0.15, 0.25, -0.12), (0.0, 0.0, 0.15), (0.0, 0.0, 0.0)])
def test_scan_is_aligned_from_a_start_nearby(room_map, offset):
    truth = np.array([0.33, -0.41, 0.6])
    pose = aligned(room_map, truth, truth + offset)
    # a map of 0.1 m cells holds a pose to a fifth of a cell and to that over the walls' distance
    np.testing.assert_allclose(pose[:2], truth[:2], atol=0.02)
    np.testing.assert_allclose(pose[2], truth[2], atol=0.006)


def test_along_a_corridor_the_prior_holds_what_the_scan_does_not_see():
    corridor = np.array([[[-30.0, -1.05], [30.0, -1.05]], [[30.0, 1.05], [-30.0, 1.05]]])
    # walls without gaps to hold on to: drawn from many places along it
    grid = drawn(corridor, [(x, 0.0, 0.0) for x in np.arange(-6.0, 6.1, 0.25)])
    start = np.array([0.1, 0.1, 0.02])
    pose = aligned(grid, np.array([0.0, 0.05, 0.0]), start, wide(start, 0.1), corridor)
    np.testing.assert_allclose(pose[1:], [0.05, 0.0], atol=0.02)
    np.testing.assert_allclose(pose[0], 0.1, atol=0.02)  # free to slide, and stays with the prior
    found = assess(grid, sweep_at((0.0, 0.05, 0.0), walls=corridor), pose, RESOLUTION)
    assert float(found.information[0, 0]) < 1e-6 * float(found.information[1, 1])


def test_a_map_that_pretends_to_know_the_way_along_a_corridor_is_not_believed():
    """Walls drawn in one place have a pattern along them, and a scan from elsewhere would lock to it."""
    corridor = np.array([[[-30.0, -1.05], [30.0, -1.05]], [[30.0, 1.05], [-30.0, 1.05]]])
    grid = drawn(corridor, [(0.0, 0.0, 0.0)] * 9)
    pose = aligned(grid, np.array([0.4, 0.0, 0.0]), np.array([0.4, 0.0, 0.0]), wide((0.4, 0.0, 0.0), 0.1), corridor)
    np.testing.assert_allclose(pose[0], 0.4, atol=1e-3)  # the solver's own tolerance


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.0])
def test_a_corridor_is_blind_along_its_walls_and_a_room_is_not(heading):
    corridor = np.array([[[-30.0, -1.05], [30.0, -1.05]], [[30.0, 1.05], [-30.0, 1.05]]])
    blind = view_of(sweep_at((0.0, 0.2, heading), walls=corridor)).blind
    assert float(blind.weight) == 1.0
    along = np.array([np.cos(heading), -np.sin(heading)])  # the x axis in the robot's frame
    np.testing.assert_allclose(abs(float(blind.direction @ along)), 1.0, atol=1e-3)  # 2.5 degrees
    assert float(view_of(sweep_at((0.3, 0.2, heading))).blind.weight) == 0.0


def test_the_end_of_a_corridor_tells_nothing_before_it_is_drawn():
    side = [[[-30.0, -1.05], [4.0, -1.05]], [[4.0, 1.05], [-30.0, 1.05]]]
    corridor, closed = np.array(side), np.array([*side, [[4.0, -1.05], [4.0, 1.05]]])
    sweep = sweep_at((0.0, 0.05, 0.0), walls=closed)
    before, after = (drawn(walls, [(x, 0.0, 0.0) for x in np.arange(-2.0, 0.1, 0.25)]) for walls in (corridor, closed))
    pose = jnp.array([0.0, 0.05, 0.0])
    unseen, known = assess(before, sweep, pose, RESOLUTION), assess(after, sweep, pose, RESOLUTION)
    # the beams that end in the corners are taken for known
    assert float(unseen.information[0, 0]) < 0.1 * float(known.information[0, 0])
    np.testing.assert_allclose(unseen.informed, np.diag([0.0, 1.0]), atol=0.1)
    np.testing.assert_allclose(known.informed, np.eye(2), atol=1e-6)


def share_of_walls(sweep, some, heading) -> np.ndarray:
    return np.asarray(matching.share_of_walls(find_surface(sweep), some, sweep.valid, jnp.float32(heading)))


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
def test_walls_along_x_tell_y_and_nothing_else_and_all_walls_tell_all(heading):
    """In the world's frame, whichever way the robot looks."""
    pose = np.array([0.33, -0.41, heading])
    sweep = sweep_at(pose)
    everything = share_of_walls(sweep, sweep.valid, heading)
    np.testing.assert_allclose(everything, np.eye(2), atol=0.03)  # what counts as few is 0.006 of a third to a half
    c, s = np.cos(heading), np.sin(heading)
    ends = np.asarray(sweep.points) @ np.array([[c, s], [-s, c]]) + pose[:2]
    ys = [wall[0, 1] for wall in room.WALLS if wall[0, 1] == wall[1, 1]]
    along_x = np.abs(ends[:, 1, None] - ys).min(axis=1) < 1e-3
    assert 0.3 < along_x.mean() < 0.7
    some = share_of_walls(sweep, jnp.asarray(along_x), heading)
    np.testing.assert_allclose(some, np.diag([0.0, 1.0]), atol=0.05)  # as above, and surfaces beside the corners
    rest = share_of_walls(sweep, jnp.asarray(~along_x), heading)
    np.testing.assert_allclose(some + rest, everything, atol=1e-5)  # float32
    np.testing.assert_array_equal(share_of_walls(sweep, jnp.zeros(BEAMS, bool), heading), 0.0)


def test_walls_of_a_scan_without_beams_have_no_share():
    sweep = sweep_at((0.0, 0.0, 0.0))
    blind = sweep._replace(valid=jnp.zeros(BEAMS, bool))
    np.testing.assert_array_equal(share_of_walls(blind, blind.valid, 0.3), 0.0)


def test_a_scan_without_beams_stays_at_the_prior(room_map):
    sweep = sweep_at((0.0, 0.0, 0.0))
    blind = sweep._replace(valid=jnp.zeros(BEAMS, bool))
    prior = wide((0.3, 0.2, 0.1))
    pose = align(room_map, blind, jnp.zeros(3), prior, jnp.float32(SIGMA_L), RESOLUTION)
    np.testing.assert_allclose(pose, prior.mean, atol=1e-3)  # the solver's own tolerance
    found = assess(room_map, blind, pose, RESOLUTION)
    assert float(found.known) == float(found.score) == 0.0


def test_score_tells_a_right_pose_from_a_wrong_one(room_map):
    truth = jnp.array([0.33, -0.41, 0.6])
    sweep = sweep_at(truth)
    right = assess(room_map, sweep, truth, RESOLUTION)
    wrong = assess(room_map, sweep, truth + jnp.array([0.0, 0.0, 0.5]), RESOLUTION)
    assert float(right.score) > 0.75
    assert float(right.known) > 0.95
    assert float(wrong.score) < 0.5
    nowhere = assess(occupancy.empty(CELLS, LEVELS, RESOLUTION), sweep, truth, RESOLUTION)
    assert float(nowhere.known) == 0.0


@pytest.mark.parametrize("turn", [0.8, 1.6, -2.5, np.pi])
def test_search_finds_the_heading_over_the_full_circle(room_map, turn):
    truth = np.array([0.33, -0.41, 0.6])
    off = truth + np.array([0.1, -0.15, turn])
    prior = Gaussian(jnp.asarray(off, jnp.float32), jnp.diag(jnp.array([0.02, 0.02, 10.0])))
    pose = np.asarray(search(room_map, sweep_at(truth), prior, jnp.float32(SIGMA_L), RESOLUTION), float)
    np.testing.assert_allclose(pose[:2], truth[:2], atol=0.02)  # as above
    np.testing.assert_allclose(np.exp(1j * pose[2]), np.exp(1j * truth[2]), atol=0.006)
    assert abs(pose[2] - float(prior.mean[2])) <= np.pi + 1e-5  # the branch nearest to the prior


@pytest.mark.usefixtures("x64")
def test_one_move_of_gauss_newton_solves_a_linear_problem():
    rng = np.random.default_rng(0)
    A, b = jnp.asarray(rng.normal(size=(9, 4))), jnp.asarray(rng.normal(size=9))
    x = matching.gauss_newton(lambda x, args: args[0] @ x - args[1], jnp.zeros(4), (A, b), 1)
    np.testing.assert_allclose(x, np.linalg.lstsq(A, b)[0], rtol=1e-9)


def test_a_problem_that_cannot_be_solved_does_not_raise():
    x = matching.gauss_newton(lambda x, _: jnp.array([0.0, 1.0]) + 0 * x, jnp.ones(2), None, 3)
    assert x.shape == (2,)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_gradient_of_an_alignment_agrees_with_finite_differences(room_map):
    """Through all moves of all levels, as many as are made: by prior, start, map and sigma_l."""
    grid = double(room_map._replace(levels=room_map.levels[:2]))
    sweep = double(sweep_at((0.33, -0.41, 0.6), 60))
    weights = jnp.array([1.0, -2.0, 0.5])

    def value(at):
        mean, start, level, sigma_l = at
        changed = grid._replace(levels=(level, *grid.levels[1:]))
        prior = Gaussian(mean, jnp.diag(jnp.array([0.1, 0.1, 0.05]) ** 2))
        return weights @ align(changed, sweep, start, prior, sigma_l, RESOLUTION)

    truth = jnp.array([0.33, -0.41, 0.6])
    at = (truth + 0.05, truth + jnp.array([0.06, -0.03, 0.02]), grid.levels[0], jnp.array(SIGMA_L))
    assert_gradient(value, at, rtol=1e-4, atol=1e-7, step=1e-7, count=4)


def test_from_nearby_fewer_beams_and_moves_find_the_same_place(room_map):
    truth = np.array([0.33, -0.41, 0.6])
    sweep, start = sweep_at(truth, 1081), jnp.asarray(truth + np.array([0.02, -0.015, 0.004]), jnp.float32)
    found = [matching.align(room_map, view_of(sweep), start, wide(start), RESOLUTION, near) for near in (False, True)]
    for pose in found:
        np.testing.assert_allclose(pose, truth, atol=0.01)  # a tenth of a cell, half of what is asked from afar
    assert len(matching.thinned(sweep, 540).valid) < 600


def test_a_search_takes_the_place_that_was_expected_and_not_the_last_one_where_walls_tell_neither():
    corridor = np.array([[[-30.0, -1.05], [30.0, -1.05]], [[30.0, 1.05], [-30.0, 1.05]]])
    grid, sweep = (
        drawn(corridor, [(x, 0.0, 0.0) for x in (-3.0, -2.0, -1.0)]),
        sweep_at((0.0, 0.0, 0.0), walls=corridor),
    )
    expected = Gaussian(jnp.zeros(3, jnp.float32), jnp.diag(jnp.array([0.1, 0.1, 1.4], jnp.float32) ** 2))
    last = jnp.array([-1.0, 0.0, 0.0])
    view = view_of(sweep)
    pose = wide_search.search(grid, view, expected, last, jnp.zeros(3), RESOLUTION)
    assert np.linalg.norm(np.asarray(pose)[:2]) < 0.3
    assert abs(float(pose[2])) < 0.1
    # half a turn fits as well: what turns less is taken
    turned = wide_search.search(grid, view, expected._replace(mean=jnp.array([0.0, 0.0, 0.3])), last, last, RESOLUTION)
    assert np.linalg.norm(np.asarray(turned)[:2]) < 0.3
    assert abs(float(turned[2])) < 0.1
