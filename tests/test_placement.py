"""The batch problem of start-up: multilateration, derivatives, covariance, and what one track can and cannot tell."""

from __future__ import annotations

import numpy as np
import pytest
import start_of_run
from scipy.optimize import least_squares

from uwbslam_jax import multilateration
from uwbslam_jax.placement import Problem


def problem(poses=None, **options) -> Problem:
    kept = start_of_run.buffer(start_of_run.with_a_turn() if poses is None else poses, **options)
    return Problem.build(kept.keyframes, kept.pairs, kept.sigma_n)


def truth() -> np.ndarray:
    return np.array(list(start_of_run.BEACONS.values()))


@pytest.mark.parametrize("pairs", [True, False], ids=["beacons range to each other", "robot alone"])
def test_beacons_are_placed_to_a_decimetre_after_a_turn(pairs):
    p = problem(pairs=pairs)
    found = min((p.minimise(start) for start in p.starts()), key=lambda x: x.cost)
    assert found.slots == [1, 2, 3]
    np.testing.assert_allclose(found.beacons, truth(), atol=0.1)
    # four of the standard deviations that it states itself
    assert (np.linalg.norm(found.beacons - truth(), axis=1) < 4 * found.beacon_sigma()).all()
    np.testing.assert_allclose(found.poses[0], start_of_run.with_a_turn()[0], atol=1e-3)  # the start is held


def test_jacobian_of_the_problem_agrees_with_finite_differences():
    p = problem(start_of_run.with_a_turn()[::4])
    rng = np.random.default_rng(0)
    poses, beacons = p.track + 0.03 * rng.normal(size=p.track.shape), truth() + 0.1 * rng.normal(size=(3, 2))
    J, _ = p._linearise(poses, beacons)
    x, n, h = np.concatenate([poses.ravel(), beacons.ravel()]), poses.size, 1e-6

    def residual(x):
        return p._linearise(x[:n].reshape(-1, 3), x[n:].reshape(-1, 2))[1]

    numeric = np.stack([(residual(x + h * e) - residual(x - h * e)) / (2 * h) for e in np.eye(len(x))], axis=1)
    np.testing.assert_allclose(J, numeric, rtol=1e-5, atol=1e-4)  # the start is held with a weight of 1e4


def test_minimum_is_the_one_that_scipy_finds():
    p = problem(start_of_run.with_a_turn()[::4])
    start = truth() + 0.2
    n = p.track.size

    def residual(x):
        return p._linearise(x[:n].reshape(-1, 3), x[n:].reshape(-1, 2))[1]

    want = least_squares(residual, np.concatenate([p.track.ravel(), start.ravel()]), x_scale="jac")
    found = p.minimise(start)
    assert found.cost <= want.cost + 1e-3  # it stops when a move gains less than 1e-4
    np.testing.assert_allclose(found.beacons.ravel(), want.x[n:], atol=0.005)  # far below their 0.03 m


def test_stated_covariance_is_that_of_repeated_noise():
    runs = [problem(start_of_run.with_a_turn()[::2], seed=seed) for seed in range(60)]
    found = [p.minimise(truth()) for p in runs]
    errors = np.array([(f.beacons - truth()).ravel() for f in found])
    n = found[0].poses.size
    squared = [e @ np.linalg.solve(f.cov[n:, n:], e) for e, f in zip(errors, found, strict=True)]
    # 6 by chi-square if the tracks were noisy too; here only the ranges are, so it may be less, never much more
    assert 2.0 < np.mean(squared) < 6 + 4 * np.sqrt(12 / 60)


def test_mirror_of_a_straight_track_explains_the_ranges_as_well():
    p = problem(start_of_run.straight(), antenna=(0.0, 0.0))
    found = p.minimise(truth())
    mirrored = p.minimise(p.mirror(found))
    np.testing.assert_allclose(mirrored.beacons, truth() * [1, -1], atol=0.3)
    assert abs(found.cost - mirrored.cost) < multilateration.DECIDED


def test_mirror_of_a_track_with_a_turn_does_not():
    p = problem()
    found = p.minimise(truth())
    assert p.minimise(p.mirror(found)).cost - found.cost > 10 * multilateration.DECIDED


def test_starts_put_all_beacons_on_consistent_sides():
    """On a straight track each beacon has two places; the ranges between beacons tie their sides together."""
    p = problem(start_of_run.straight(), antenna=(0.0, 0.0))
    starts = p.starts()
    sides = {tuple(np.sign(start[:, 1])) for start in starts}
    want = tuple(np.sign(truth()[:, 1]))
    assert sides == {want, tuple(-s for s in want)}


def test_a_beacon_ranged_from_few_places_takes_no_part():
    kept = start_of_run.buffer(start_of_run.with_a_turn())
    for key in kept.keyframes[2:]:
        del key.seen[2]
    assert Problem.build(kept.keyframes, kept.pairs, kept.sigma_n).slots == [1, 3]


def test_a_beacon_with_two_places_is_not_kept():
    """One beacon is heard on the straight part only and ranges to no other: its side is open."""
    kept = start_of_run.buffer(start_of_run.with_a_turn(), antenna=(0.0, 0.0), pairs=False)
    for key in kept.keyframes[14:]:
        del key.seen[1]
    p = Problem.build(kept.keyframes, kept.pairs, kept.sigma_n)
    found = p.minimise(truth())
    assert p.keep_unique(found).slots == [2, 3]
    kept = p.keep_unique(found)
    assert kept.cov.shape == (kept.poses.size + 4,) * 2


@pytest.mark.parametrize("error", [3.0, -3.0], ids=["too long", "too short"])
def test_a_fifth_of_wild_ranges_does_not_move_the_beacons(error):
    kept = start_of_run.buffer(start_of_run.with_a_turn(), each=5)
    for key in kept.keyframes[::5]:
        for slot, seen in key.seen.items():
            key.seen[slot] = [(local, max(d + error, 0.1)) for local, d in seen]
    p = Problem.build(kept.keyframes, kept.pairs, kept.sigma_n)
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
