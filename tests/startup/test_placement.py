"""The batch problem of start-up: multilateration, derivatives, covariance, and what one track can and cannot tell."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
import start_of_run
from derivatives import stacked
from scipy.optimize import least_squares

from uwbslam_jax.numerics import Stage, multilateration, robust
from uwbslam_jax.startup import hypotheses
from uwbslam_jax.startup.placement import Problem


def problem(poses=None, **options) -> Problem:
    found = Problem.build(start_of_run.buffer(start_of_run.with_a_turn() if poses is None else poses, **options))
    assert found is not None
    return found


def truth() -> np.ndarray:
    return np.array(list(start_of_run.BEACONS.values()))


@pytest.mark.parametrize("pairs", [True, False], ids=["beacons range to each other", "robot alone"])
def test_beacons_are_placed_to_a_decimetre_after_a_turn(pairs):
    p = problem(pairs=pairs)
    found = min((p.minimise(start) for start in hypotheses.track_sides(p)), key=lambda x: x.cost)
    assert found.slots == [1, 2, 3]
    np.testing.assert_allclose(found.beacons, truth(), atol=0.1)
    # four of the standard deviations that it states itself
    assert (np.linalg.norm(found.beacons - truth(), axis=1) < 4 * found.beacon_sigma()).all()
    np.testing.assert_allclose(found.poses[0], start_of_run.with_a_turn()[0], atol=1e-3)  # the start is held


def driven(p: Problem, beacons: np.ndarray, rng=None) -> np.ndarray:
    """The problem's vector of unknowns: the track, beacons and no bias; with noise where there is a generator."""
    x = np.concatenate([p.track.ravel(), beacons.ravel(), np.zeros(1 + len(beacons))])
    return x if rng is None else x + 0.03 * rng.normal(size=x.size)


def linearised(p: Problem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whitened Jacobian and residuals of the problem as it is solved last."""
    return stacked(p.rows(p.track[0], Stage(soft=np.inf, coarse=1.0)), x)


def test_jacobian_of_the_problem_agrees_with_finite_differences():
    kept = start_of_run.buffer(start_of_run.with_a_turn()[::4])
    for sightings in kept.sightings.values():  # between the keyframes as well
        sightings.extend([s._replace(stamp=s.stamp + 10**8, pose=s.pose + 0.05) for s in sightings])
    p = Problem.build(kept)
    assert (p.ranges.share[p.ranges.at < p.ranges.at.max()] > 0).all()
    p = p.freed(("bias", "height", "scale"))
    rng, h = np.random.default_rng(0), 1e-6
    x = np.concatenate([driven(p, truth(), rng), [0.4, 1.5, -0.2, 0.07, 0.002]])  # heights, scales of ranges and LiDAR
    J, _ = linearised(p, x)

    def residual(x):
        return linearised(p, x)[1]

    numeric = np.stack([(residual(x + h * e) - residual(x - h * e)) / (2 * h) for e in np.eye(len(x))], axis=1)
    np.testing.assert_allclose(J, numeric, rtol=1e-5, atol=1e-4)  # the start is held with a weight of 1e4


@pytest.mark.parametrize("groups", [(), ("bias",)])
def test_minimum_is_the_one_that_scipy_finds(groups):
    p = problem(start_of_run.with_a_turn()[::4]).freed(groups)
    start = truth() + 0.2
    n, m = p.track.size, p.track.size + start.size

    def residual(x):
        return linearised(p, x)[1]

    want = least_squares(residual, driven(p, start), x_scale="jac")
    found = p.minimise(start)
    assert found.cost <= want.cost + 0.02  # it stops when a move gains less than that
    np.testing.assert_allclose(found.beacons.ravel(), want.x[n:m], atol=0.01)  # far below their 0.03 m


BIAS = {0: 0.1, 1: -0.2, 2: 0.15, 3: 0.25}


def test_biases_are_found_where_the_track_and_the_beacons_tell_them():
    p = problem(bias=BIAS, each=10)
    found = p.freed(("bias",)).minimise(truth())
    error = found.off.bias - np.array(list(BIAS.values()))
    assert (np.abs(error) < 4 * found.off_sigma.bias).all()
    # what a short track tells is the robot's bias; a beacon's own is much the same as a place farther away
    assert found.off_sigma.bias[0] < 0.02
    assert found.cost < p.minimise(truth()).cost - 10
    assert (np.linalg.norm(found.beacons - truth(), axis=1) < 4 * found.beacon_sigma()).all()


def test_ranges_between_keyframes_hold_a_track_that_LiDAR_could_not_see():
    """Along a blind corridor the track stands still; each range then belongs to a place between two keyframes."""
    poses = start_of_run.with_a_turn()[::3]
    kept = start_of_run.buffer(poses, each=1)
    dense = start_of_run.buffer(poses, each=30)
    blind = np.diag([0.0, 1e4, 1e6])
    kept.keyframes = [replace(k, pose=k.pose * [0.0, 0, 0], information=0 * blind) for k in kept.keyframes]
    for slot, seen in dense.sightings.items():
        kept.sightings[slot] = deque(s._replace(pose=np.zeros(3)) for s in seen)
    p = Problem.build(kept)
    headings = poses.copy()
    headings[:, :2] = p.track[:, :2]
    found = p.minimise(truth(), np.column_stack([poses[:, :2], p.track[:, 2]]))
    apart = np.linalg.norm(found.poses[:, :2] - poses[:, :2], axis=1)
    assert np.median(apart) < 0.1


def test_stated_covariance_is_that_of_repeated_noise():
    runs = [problem(start_of_run.with_a_turn()[::2], seed=seed) for seed in range(60)]
    found = [p.minimise(truth()) for p in runs]
    errors = np.array([(f.beacons - truth()).ravel() for f in found])
    n = found[0].poses.size
    squared = [e @ np.linalg.solve(f.cov[n:, n:], e) for e, f in zip(errors, found, strict=True)]
    # 6 by chi-square if the tracks were noisy too; here only the ranges are, so it may be less, never much more
    assert 1.5 < np.mean(squared) < 6 + 4 * np.sqrt(12 / 60)


def test_mirror_of_a_straight_track_explains_the_ranges_as_well():
    p = problem(start_of_run.straight(), antenna=(0.0, 0.0))
    found = p.minimise(truth())
    mirrored = p.minimise(*p.images(found)[0])
    np.testing.assert_allclose(mirrored.beacons, truth() * [1, -1], atol=0.3)
    assert abs(found.cost - mirrored.cost) < robust.DECIDED


def test_mirror_of_a_track_with_a_turn_does_not():
    p = problem()
    found = p.minimise(truth())
    assert p.minimise(*p.images(found)[0]).cost - found.cost > 10 * robust.DECIDED


def test_starts_put_all_beacons_on_consistent_sides():
    """On a straight track each beacon has two places; the ranges between beacons tie their sides together."""
    p = problem(start_of_run.straight(), antenna=(0.0, 0.0))
    starts = hypotheses.track_sides(p)
    sides = [tuple(np.sign(start[:, 1])) for start in starts]
    want = tuple(np.sign(truth()[:, 1]))
    assert {sides[0], sides[-1]} == {want, tuple(-s for s in want)}


def test_a_beacon_ranged_from_few_places_takes_no_part():
    kept = start_of_run.buffer(start_of_run.with_a_turn())
    start_of_run.forget(kept, 2, since=2)
    assert Problem.build(kept).slots == [1, 3]


def test_a_beacon_with_two_places_is_not_kept():
    """One beacon is heard on the straight part only and ranges to no other: its side is open."""
    kept = start_of_run.buffer(start_of_run.with_a_turn(), antenna=(0.0, 0.0), pairs=False)
    start_of_run.forget(kept, 1, since=14)
    p = Problem.build(kept)
    unique = p.keep_unique(p.minimise(truth()))
    assert unique.slots == [2, 3]
    assert unique.cov.shape == (unique.poses.size + 4,) * 2
    assert unique.off.bias.shape == (3,)


@pytest.mark.parametrize("error", [3.0, -3.0], ids=["too long", "too short"])
def test_a_fifth_of_wild_ranges_does_not_move_the_beacons(error):
    kept = start_of_run.buffer(start_of_run.with_a_turn(), each=5)
    for slot, seen in kept.sightings.items():
        kept.sightings[slot] = deque(
            s._replace(distance=max(s.distance + error, 0.1)) if k % 5 == 0 else s for k, s in enumerate(seen)
        )
    p = Problem.build(kept)
    np.testing.assert_allclose(p.minimise(truth() + 0.1).beacons, truth(), atol=0.1)


RING = 4.0 * np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))], axis=1)


def test_multilateration_finds_a_place_from_exact_ranges():
    spot = np.array([1.3, -2.1])
    distance = np.linalg.norm(RING - spot, axis=1)
    best, second = multilateration.multilaterate(RING, distance, np.full(8, 0.1))
    np.testing.assert_allclose(best, spot, atol=1e-3)
    assert second.shape == (2,)


def test_multilateration_from_a_line_finds_both_places():
    line, spot = np.stack([np.arange(6.0), np.zeros(6)], axis=1), np.array([2.0, 3.0])
    places = multilateration.multilaterate(line, np.linalg.norm(line - spot, axis=1), np.full(6, 0.1))
    np.testing.assert_allclose(sorted(p[1] for p in places), [-3.0, 3.0], atol=1e-3)
    np.testing.assert_allclose([p[0] for p in places], [2.0, 2.0], atol=1e-3)


def test_locate_states_a_place_only_where_there_is_one():
    rng = np.random.default_rng(0)
    spot, sigma = np.array([1.3, -2.1]), np.full(8, 0.1)
    noisy = np.linalg.norm(RING - spot, axis=1) + 0.1 * rng.normal(size=8)
    found = multilateration.locate(RING, noisy, sigma)
    assert found is not None
    place, cov = found
    assert (place - spot) @ np.linalg.solve(cov, place - spot) < 13.8  # chi-square of 2, 1 in 1000
    line = np.stack([np.arange(8.0), np.zeros(8)], axis=1)
    assert multilateration.locate(line, np.linalg.norm(line - spot, axis=1), sigma) is None  # either side
    near = 0.05 * RING
    assert multilateration.locate(near, np.linalg.norm(near - [9.0, 9.0], axis=1), sigma) is None  # not certain enough
    carried = np.linalg.norm(RING - spot, axis=1) + np.array([2.0, -2.0] * 4)
    assert multilateration.locate(RING, carried, sigma) is None  # no one place


@pytest.mark.parametrize("away", [1e6, 12.0], ids=["out of the world", "elsewhere"])
def test_a_beacon_that_slid_away_alone_is_brought_back(away):
    """Its ranges are outliers there and pull no more: nothing but a look at where they meet finds it."""
    p = problem()
    found = p.minimise(truth())
    beacons = np.vstack([found.beacons[:2], found.beacons[2] + away])
    lost = replace(found, beacons=beacons, cost=found.cost + 100.0)
    mended = hypotheses._mended(p, lost)
    assert mended.cost < found.cost + 0.1
    np.testing.assert_allclose(mended.beacons, found.beacons, atol=0.02)
