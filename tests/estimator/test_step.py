"""One step: what it does with each measurement, and its derivatives through all of it."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room
from derivatives import assert_reverse, double, value_and_gradient
from known_room import BEACONS, BEAMS, CONFIG, FLAT, PAIRS, PARAMS, POSE, drawn_map, knowing

from uwbslam_jax import estimator
from uwbslam_jax.estimator import state_vector
from uwbslam_jax.mapping import grid as occupancy, undo_motion
from uwbslam_jax.measurements import Odometry, Scan
from uwbslam_jax.settings import Params

step = jax.jit(estimator.step, static_argnums=0)


@pytest.fixture(scope="module")
def room_map():
    return drawn_map()


def measured(pose=POSE, dt=0.1, scan=True, noise=0.0, gap=np.nan, odometry=None, seed=0):
    points = np.vstack([pose[:2], BEACONS])
    z = room.distances(points, PAIRS) + noise * np.random.default_rng(seed).normal(size=6)
    ranges = room.ranges(PAIRS, z, CONFIG.max_ranges, gap=gap)
    return room.frame(CONFIG, dt, room.scan(pose, BEAMS) if scan else None, ranges, odometry)


def test_first_step_starts_at_the_origin_and_draws_the_first_scan():
    state, estimate = step(CONFIG, PARAMS, estimator.init(CONFIG), measured())
    np.testing.assert_allclose(estimate.pose, 0.0, atol=1e-4)
    assert bool(estimate.drawn)
    assert int(state.scans_drawn) == 1
    assert float(state.grid.levels[0].max()) > 0
    assert float(estimate.known) == 0.0
    np.testing.assert_array_equal(estimate.weight, 0.0)  # no beacon is in the state yet
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, estimate)))


def test_scan_and_ranges_pull_the_robot_to_where_it_is(room_map):
    truth = POSE + np.array([0.06, -0.04, 0.03])
    _, estimate = step(CONFIG, PARAMS, knowing(room_map), measured(truth))
    np.testing.assert_allclose(estimate.matched_pose, truth, atol=0.02)  # a fifth of a cell
    np.testing.assert_allclose(estimate.pose, truth, atol=0.03)
    np.testing.assert_allclose(estimate.beacons[1:], BEACONS, atol=0.03)
    assert float(estimate.score) > 0.7
    assert not bool(estimate.poor)
    assert not bool(estimate.searched)


def test_without_a_scan_only_ranges_move_the_state_and_nothing_is_drawn(room_map):
    truth = POSE + np.array([0.06, -0.04, 0.0])
    before = knowing(room_map)
    state, estimate = step(CONFIG, PARAMS, before, measured(truth, scan=False))
    assert np.linalg.norm(estimate.pose[:2] - truth[:2]) < np.linalg.norm(POSE[:2] - truth[:2])
    np.testing.assert_array_equal(estimate.information, 0.0)
    assert not any(bool(flag) for flag in (estimate.drawn, estimate.poor, estimate.searched))
    for a, b in zip(state.grid.levels, before.grid.levels, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_scan_without_any_return_changes_no_map_and_is_finite(room_map):
    frame = measured()
    blind = frame._replace(scan=frame.scan._replace(valid=np.zeros(BEAMS, bool)))
    before = knowing(room_map, pose=POSE + np.array([0.5, 0.0, 0.0]))
    state, estimate = step(CONFIG, PARAMS, before, blind)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, estimate)))
    np.testing.assert_array_equal(state.grid.levels[0], before.grid.levels[0])


def test_a_robot_that_was_turned_is_found_by_the_search(room_map):
    truth = POSE + np.array([0.0, 0.0, 2.0])
    state, estimate = step(CONFIG, PARAMS, knowing(room_map), measured(truth))
    assert bool(estimate.searched)
    np.testing.assert_allclose(np.exp(1j * float(estimate.matched_pose[2])), np.exp(1j * truth[2]), atol=0.02)
    assert np.isfinite(state.belief.cov).all()


def test_a_scan_of_another_room_is_not_believed_and_not_drawn(room_map):
    rng = np.random.default_rng(0)
    frame = measured()
    strange = frame._replace(scan=frame.scan._replace(ranges=rng.uniform(0.5, 2.5, BEAMS).astype(np.float32)))
    state, estimate = step(CONFIG, PARAMS, knowing(room_map), strange)
    assert bool(estimate.poor)
    assert not bool(estimate.drawn)
    np.testing.assert_array_equal(estimate.information, 0.0)
    np.testing.assert_allclose(estimate.pose, POSE, atol=0.02)  # the ranges hold it
    np.testing.assert_array_equal(state.grid.levels[0], room_map.levels[0])


@pytest.mark.slow
def test_lidar_only_ignores_ranges(room_map):
    config = dataclasses.replace(FLAT, lidar_only=True)
    finest = room_map._replace(levels=room_map.levels[:1])
    wild = measured(noise=5.0)
    state, estimate = step(config, PARAMS, knowing(finest), wild)
    none = wild._replace(ranges=wild.ranges._replace(valid=np.zeros(8, bool)))
    without, _ = step(config, PARAMS, knowing(finest), none)
    np.testing.assert_array_equal(estimate.weight, 0.0)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(without), strict=True):
        np.testing.assert_array_equal(a, b)


def test_ranges_to_nodes_that_are_not_active_or_not_in_sight_are_not_used(room_map):
    state = knowing(room_map)._replace(active=jnp.array([True, True, False, True]))
    _, estimate = step(CONFIG, PARAMS, state, measured())
    used = np.asarray(estimate.weight)[:6] > 0
    np.testing.assert_array_equal(used, [2 not in pair for pair in PAIRS])
    gaps = np.array([np.nan, 20.0, 3.0, 11.0, 10.0, np.nan])
    _, estimate = step(CONFIG, PARAMS, knowing(room_map), measured(gap=gaps))
    np.testing.assert_array_equal(np.asarray(estimate.weight)[:6] > 0, [True, False, True, False, True, True])
    np.testing.assert_array_equal(estimate.weight[6:], 0.0)


@pytest.mark.slow
def test_many_float32_steps_keep_the_covariance_healthy(room_map):
    finest = room_map._replace(levels=room_map.levels[:1])
    frame = jax.tree.map(jnp.asarray, measured())

    def one(state, _):
        state, _ = estimator.step(FLAT, PARAMS, state, frame)
        P = state.belief.cov
        scale = jnp.sqrt(jnp.diagonal(P))
        correlation = P / (scale[:, None] * scale[None, :])
        return state, (jnp.abs(correlation - correlation.T).max(), jnp.linalg.eigvalsh(correlation)[0])

    state, (skew, smallest) = jax.jit(lambda s: jax.lax.scan(one, s, None, length=1000))(knowing(finest))
    assert float(skew.max()) < 1e-5  # some float32 ulps
    # beacons at rest come to share the robot's error: nearly singular, never negative beyond rounding of n = 21
    assert float(smallest.min()) > -1e-5
    assert np.isfinite(state.belief.mean).all()
    np.testing.assert_allclose(state_vector.robot_pose(state.belief.mean), POSE, atol=0.03)


def test_each_beam_is_placed_at_its_own_time():
    """A robot that drives and turns during the sweep: end points against poses integrated in numpy."""
    beams, lidar = 40, np.array([0.2, -0.1, 0.3])
    velocity, yaw_rate, dt = np.array([0.8, -0.1]), 1.2, 2e-3
    rng = np.random.default_rng(0)
    scan = Scan(
        rng.uniform(1, 5, beams).astype(np.float32),
        rng.random(beams) < 0.9,
        np.float32(-1.0),
        np.float32(0.05),
        np.float32(dt),
    )
    as_jax = [jnp.asarray(x, jnp.float32) for x in (lidar, velocity, yaw_rate)]
    sweep = undo_motion(jax.tree.map(jnp.asarray, scan), *as_jax)
    for k in range(beams):
        t = k * dt
        a = lidar[2] - 1.0 + 0.05 * k
        reach = scan.ranges[k] if scan.valid[k] else 0.0
        p = lidar[:2] + reach * np.array([np.cos(a), np.sin(a)])
        turn = yaw_rate * t
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        np.testing.assert_allclose(sweep.points[k], R @ p + velocity * t, atol=1e-5)  # float32
        np.testing.assert_allclose(sweep.bearing0 + sweep.bearing_step * k + lidar[2], a + turn, atol=1e-5)
    np.testing.assert_array_equal(sweep.reach[~scan.valid], 0.0)


def test_the_whole_state_may_stand_anywhere(room_map):
    """Turned by a quarter and moved by whole cells, map, beacons and robot: the step moves with them."""
    truth = POSE + np.array([0.05, -0.03, 0.02])
    _, here = step(CONFIG, PARAMS, knowing(room_map), measured(truth))
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    state = knowing(room_map)
    s = state_vector.unpack(state.belief.mean)
    moved = s._replace(positions=s.positions @ turn.T.astype(np.float32), heading=s.heading + jnp.float32(np.pi / 2))
    block = np.eye(state_vector.state_size(4))
    block[:16, :16] = np.kron(np.eye(8), turn)
    block[18:20, 18:20] = turn
    block = block.astype(np.float32)
    cov = jnp.asarray(block @ np.asarray(state.belief.cov) @ block.T)
    grid = room_map._replace(levels=tuple(jnp.rot90(level, k=-1) for level in room_map.levels))
    state = state._replace(
        belief=state.belief._replace(mean=state_vector.pack(moved), cov=cov),
        grid=grid,
        drawn_pose=state_vector.robot_pose(state_vector.pack(moved)),
    )
    _, there = step(CONFIG, PARAMS, state, measured(truth))
    want = np.append(turn @ np.asarray(here.pose[:2]), float(here.pose[2]) + np.pi / 2)
    np.testing.assert_allclose(there.pose, want, atol=1e-4)  # the solver stops at 1e-4
    np.testing.assert_allclose(there.beacons, np.asarray(here.beacons) @ turn.T, atol=1e-4)


# Derivatives of the whole step. The decisions are held: no search, nothing near a threshold.

TUNABLE = ("sigma_n", "sigma_l", "sigma_w", "sigma_map", "independent_beams", "bias", "height", "antenna", "lidar")


@pytest.mark.usefixtures("x64")
def test_gradient_of_a_whole_step_agrees_with_finite_differences(room_map):
    """State and estimate after one step by parameters and by the state's mean and covariance. Without
    odometry, then with it."""
    truth = POSE + np.array([0.04, -0.03, 0.02])
    finest = room_map._replace(levels=room_map.levels[:1])
    state = knowing(finest, velocity=(0.3, 0.1), yaw_rate=0.1)
    # drawn 6 m of way after the ground in view, so that the map's random walk counts
    spread = state.map_spread._replace(apart=1e-4 * jnp.eye(3), way=jnp.array(9.0), epoch=jnp.array(7.0))
    state = double(state._replace(map_spread=spread))
    params: Params = double(PARAMS)
    params = params._replace(height=jnp.array([0.5, 0.7, 0.3, 0.9]), bias=jnp.array([0.01, 0.02, 0.0, -0.01]))
    weights = jnp.asarray(np.random.default_rng(0).normal(size=state_vector.state_size(4)))

    def value(at, frame):
        tunable, mean, root = at
        start = state._replace(belief=state.belief._replace(mean=mean, cov=root @ root.T))
        after, estimate = estimator.step(FLAT, params._replace(**tunable), start, frame)
        spread = weights @ after.belief.cov @ weights
        decided = estimate.searched | estimate.poor
        total = weights @ after.belief.mean + spread + 0.1 * estimate.log_likelihood + estimate.score
        return jnp.where(decided, jnp.nan, total)  # neither happens here

    root = jnp.linalg.cholesky(state.belief.cov)
    at = ({name: getattr(params, name) for name in TUNABLE}, state.belief.mean, root)
    both = value_and_gradient(value)
    for valid in (False, True):
        odometry = Odometry(np.array([0.03, 0.01, 0.02], np.float32), np.bool_(valid))
        frame = double(measured(truth, noise=0.1, odometry=odometry))
        # a difference over 2e-8 keeps clear of the borders of cells; its own rounding is then some 1e-7 of the values
        gradient = assert_reverse(both, at, frame, rtol=1e-4, atol=1e-5, step=1e-8)
        for name, leaf in gradient[0].items():
            # with odometry the acceleration noise plays no part
            assert (np.abs(leaf).max() > 0) == (not (valid and name == "sigma_w")), name


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_gradient_through_a_first_scan_that_is_drawn_is_finite():
    """No map to match, no beam with a gradient: nothing may divide by that."""
    frame, params = double(measured(noise=0.1)), double(PARAMS)
    state = double(knowing(occupancy.empty(FLAT.cells, FLAT.levels, FLAT.resolution)))
    state = state._replace(scans_drawn=jnp.int32(0))

    def value(at):
        tunable, mean = at
        start = state._replace(belief=state.belief._replace(mean=mean))
        after, estimate = estimator.step(FLAT, params._replace(**tunable), start, frame)
        total = jnp.sum(after.belief.mean) + jnp.sum(after.grid.levels[0]) - estimate.log_likelihood
        return jnp.where(estimate.drawn, total, jnp.nan)  # it is drawn

    at = ({name: getattr(params, name) for name in TUNABLE}, state.belief.mean)
    total, gradient = value_and_gradient(value)(at)
    assert np.isfinite(total)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert float(jnp.abs(gradient[0]["sigma_n"])) > 0
