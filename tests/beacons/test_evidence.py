"""What a node's ranges say: places whose anchors err together, one or two of them, at rest or carried."""

from __future__ import annotations

import numpy as np
import pytest

from uwbslam_jax.beacons import evidence as s
from uwbslam_jax.numerics import multilateration as m

PLACES = np.array([[0.0, 0.0], [6.0, 0.0], [0.0, 7.0], [8.0, 6.0], [-4.0, 5.0]])
"""Slot 0 is the robot's and not used; slot 3 is a node that may have been moved."""


def known(now: float, *, variance: float = 1e-4, untrusted: int | None = None) -> s.Known:
    k = len(PLACES)
    variances = np.where(np.arange(k) == 0, 0.0, variance)
    return s.Known(PLACES, variances, np.arange(k) != untrusted, 0.1, np.full(k, 0.1), now)


def rows(node, robot, seconds: float, *, others=(1, 2), seed: int = 0) -> s.Sightings:
    """Ten rounds a second of a node at node(t) (2,) to a robot at robot(t) and to beacons."""
    rng, made = np.random.default_rng(seed), s.Sightings()
    table = []
    for t in np.arange(0.0, seconds, 0.1):
        for other in (0, *others):
            at = robot(t) if other == 0 else PLACES[other]
            distance = np.linalg.norm(node(t) - at) + 0.1 * rng.normal()
            table.append([t, other, *(at if other == 0 else (np.nan, np.nan)), distance, 0.0])
    made.add(np.array(table))
    return made


def round_a_corner(t: float) -> np.ndarray:
    """0.8 m/s along x, from 5 s on along y."""
    return np.array([min(0.8 * t, 4.0), max(0.8 * t - 4.0, 0.0)])


def straight(t: float) -> np.ndarray:
    return np.array([0.8 * t, 0.0])


def at_rest(t: float) -> np.ndarray:
    return np.array([3.0, 4.0])


def test_settling_with_independent_anchors_is_the_plain_fit():
    rng = np.random.default_rng(1)
    at = rng.uniform(-5, 5, (9, 2))
    distance, sigma = np.linalg.norm(at - [1.0, 2.0], axis=1) + 0.1 * rng.normal(size=9), np.full(9, 0.1)
    distance[3] += 2.0  # an outlier weighs as little in both
    plain = m.fit(np.array([[0.5, 1.0]]), np.zeros(9), at, distance, sigma, carried=False)[0]
    settled = m.settle(np.array([0.5, 1.0]), at, distance, sigma, np.zeros((9, 9)))
    np.testing.assert_allclose(settled.place, plain.place, atol=0.003)  # Gauss-Newton stops a little before
    np.testing.assert_allclose(settled.cost, plain.cost, atol=0.01)


def test_pull_says_how_a_place_follows_its_anchors():
    rng = np.random.default_rng(2)
    at = rng.uniform(-5, 5, (6, 2))
    distance, sigma = np.linalg.norm(at - [1.0, 2.0], axis=1), np.full(6, 0.1)
    common = 0.01 * (np.ones((6, 6)) + np.eye(6))
    spot = m.settle(np.array([1.1, 2.1]), at, distance, sigma, common)
    shift = 0.01 * rng.normal(size=at.shape)
    moved = m.settle(spot.place, at + shift, distance, sigma, common)
    np.testing.assert_allclose(moved.place - spot.place, np.einsum("rij,rj->i", spot.pull, shift)[:2], atol=5e-4)
    # as a whole: a node goes where all that it was ranged from goes
    np.testing.assert_allclose(spot.pull.sum(0)[:2], np.eye(2), atol=1e-6)


def test_a_place_whose_anchors_err_together_is_as_uncertain_as_they_are():
    rng = np.random.default_rng(3)
    at = np.stack([np.linspace(-4.0, 4.0, 30), np.zeros(30)], axis=1)
    distance, sigma = np.linalg.norm(at - [0.0, 5.0], axis=1), np.full(30, 0.05)
    common = np.full((30, 30), 0.2**2)
    score = []
    for _ in range(200):
        shift = 0.2 * rng.normal(size=2)
        ranges = distance + 0.05 * rng.normal(size=30)
        noisy = m.settle(np.array([0.2, 4.8]), at + shift, ranges, sigma, common)
        error = noisy.place - [0.0, 5.0]
        score.append(error @ np.linalg.solve(noisy.cov[:2, :2], error))
    assert 1.4 < np.mean(score) < 2.6  # two degrees of freedom, 200 trials: a standard deviation of 0.14


def test_a_resting_node_is_found_and_its_place_stated_honestly():
    spot, groups = s.resting_place(rows(at_rest, round_a_corner, 10.0), known(9.9)) or pytest.fail("no place")
    assert np.linalg.norm(spot.place - [3.0, 4.0]) < 3 * spot.sigma
    # two beacons at rest have one distance, however often it is measured
    assert [int(np.sum(groups[:, s.OTHER] == other)) for other in (0, 1, 2)] == [20, 1, 1]


def test_a_straight_track_leaves_two_places_and_its_last_bit_does_not_decide():
    heard = rows(at_rest, straight, 20.0, others=())
    for now in np.arange(5.0, 20.0):
        part = s.Sightings()
        part.add(heard.since(0.0)[heard.since(0.0)[:, s.TIME] <= now])
        assert s.resting_place(part, known(now)) is None


def test_a_node_that_may_not_serve_is_not_asked():
    table = rows(at_rest, round_a_corner, 10.0).since(0.0)
    table[table[:, s.OTHER] == 2, s.DISTANCE] += 3.0
    heard = s.Sightings()
    heard.add(table)
    spot, groups = s.resting_place(heard, known(9.9, untrusted=2)) or pytest.fail("no place")
    assert set(groups[:, s.OTHER]) == {0, 1}
    assert np.linalg.norm(spot.place - [3.0, 4.0]) < 3 * spot.sigma


def test_the_word_of_one_other_node_does_not_choose_between_two_places():
    """It may be metres off; three of them are believed."""
    one, three = (rows(at_rest, straight, 10.0, others=others) for others in ((2,), (2, 3, 4)))
    assert s.resting_place(one, known(9.9)) is None
    assert s.resting_place(three, known(9.9)) is not None


def test_a_carried_node_does_not_rest_and_is_found_with_its_velocity():
    def carried(t):
        return np.array([1.0 + 0.9 * t, 5.0 - 0.4 * t])

    heard = rows(carried, round_a_corner, 4.0)
    assert s.resting_place(heard, known(3.9)) is None
    spot, _ = s.carried_place(heard, known(3.9)) or pytest.fail("no place")
    np.testing.assert_allclose(spot.place, carried(3.9), atol=4 * spot.sigma)
    np.testing.assert_allclose(spot.velocity, [0.9, -0.4], atol=4 * spot.speed_sigma)


def test_a_node_at_rest_is_not_taken_to_be_carried():
    assert s.carried_place(rows(at_rest, round_a_corner, 4.0), known(3.9)) is None


@pytest.mark.parametrize("seed", range(5))
def test_ranges_that_fit_leave_a_node_where_it_is(seed):
    heard = rows(lambda t: PLACES[3], round_a_corner, 4.0, seed=seed)
    verdict = s.judge(heard, known(3.9), 3, np.zeros(2))
    assert verdict.fits
    assert verdict.carried is None
    assert abs(verdict.bias) < 0.1  # the median of 30 ranges of 0.1 m


def test_one_node_whose_clock_is_off_does_not_make_another_look_carried():
    table = rows(lambda t: PLACES[3], round_a_corner, 4.0).since(0.0)
    table[table[:, s.OTHER] == 2, s.DISTANCE] += 1.0
    heard = s.Sightings()
    heard.add(table)
    assert s.judge(heard, known(3.9), 3, np.zeros(2)).fits


def test_a_bias_common_to_all_ranges_is_no_motion():
    table = rows(lambda t: PLACES[3], round_a_corner, 4.0).since(0.0)
    table[:, s.DISTANCE] += 0.5
    heard = s.Sightings()
    heard.add(table)
    verdict = s.judge(heard, known(3.9), 3, np.zeros(2))
    assert not verdict.fits
    assert verdict.carried is None
    assert verdict.bias == pytest.approx(0.5, abs=0.1)


def test_memory_is_bounded_and_one_node_can_be_forgotten():
    heard = rows(at_rest, straight, 10.0)
    heard.forget(before=20.0)
    assert len(heard.since(0.0)) == 0
    heard = rows(at_rest, straight, 10.0)
    heard.forget(other=1)
    assert set(heard.since(0.0)[:, s.OTHER]) == {0, 2}


def test_several_nodes_are_looked_at_together_as_each_by_itself():
    places = PLACES[3]
    made = {
        3: rows(lambda t: places, at_rest, 1.0, seed=1),
        4: rows(lambda t: PLACES[4] + np.array([0.9 * t, 0.0]), at_rest, 1.0, seed=2),
        2: rows(lambda t: PLACES[2], at_rest, 0.1, others=(1,), seed=3),
        1: rows(lambda t: PLACES[1] + np.array([0.6, 0.0]), at_rest, 1.0, others=(2,), seed=4),
    }
    noise, velocities = np.full((5, 5), 0.1), np.zeros((5, 2))
    assert s.calm(made, known(1.0), noise, velocities) == {3, 2}  # of node 2 there is too little to tell
    velocities[4] = [0.9, 0.0]
    carried = {4: rows(lambda t: PLACES[4] + np.array([0.9 * (t - 1.0), 0.0]), at_rest, 1.0, seed=2)}
    assert s.calm(carried, known(1.0), noise, velocities) == {4}
    assert s.calm({}, known(1.0), noise, velocities) == set()


@pytest.mark.parametrize("seed", range(3))
def test_what_is_taken_for_noise_at_first_sight_would_be_found_to_fit(seed, monkeypatch):
    """The cheap question spares the dear one, and answers as it does; what moves or is biased is never noise."""
    resting = rows(lambda t: PLACES[3], at_rest, 1.0, seed=seed)
    carried = rows(lambda t: PLACES[3] + np.array([0.9 * t, 0.0]), at_rest, 1.0, seed=seed)
    late = rows(lambda t: PLACES[3] + np.array([0.6, 0.0]), at_rest, 1.0, seed=seed)
    asked = []
    dear = s._moving_fits
    monkeypatch.setattr(s, "_moving_fits", lambda *a: asked.append(1) or dear(*a))
    for made, noise in ((resting, True), (carried, False), (late, False)):
        asked.clear()
        verdict = s.judge(made, known(1.0), 3, np.zeros(2))
        assert (not asked) == noise
        assert verdict.fits or not noise
    monkeypatch.setattr(s, "_is_noise", lambda *a: [False])
    assert s.judge(resting, known(1.0), 3, np.zeros(2)).fits


def heard_in_passes(passes: int, *, place: tuple[float, float] = (3.0, 2.5), since: float = 0.0) -> s.Sightings:
    """One range a second for six seconds of each minute, while the robot passes on a line that is a little turned each
    time: too few in the newest 40 s to place a node."""
    rng, made = np.random.default_rng(3), s.Sightings()
    for k in range(passes):
        time = since + 60.0 * k + np.arange(6.0)
        along, turn = 0.8 * np.arange(6.0), 0.5 * k
        robot = np.column_stack([1.0 + np.cos(turn) * along, np.sin(turn) * along])
        distance = np.hypot(*(robot - place).T) + 0.1 * rng.normal(size=6)
        made.add(np.column_stack([time, np.zeros(6), robot, distance, np.zeros(6)]))
        made.condense(float(time[-1]))
    return made


def test_a_node_that_is_heard_now_and_then_is_placed_from_several_passes():
    assert s.resting_place(heard_in_passes(1), known(5.0)) is None
    found = s.resting_place(heard_in_passes(5), known(245.0))
    assert found is not None
    assert np.linalg.norm(found[0].place - [3.0, 2.5]) < 4 * found[0].sigma
    assert found[0].sigma < 0.15


def test_a_node_that_was_put_elsewhere_between_two_passes_is_not_placed_where_it_was():
    seen, later = heard_in_passes(4), heard_in_passes(2, place=(3.0, -4.0), since=240.0)
    seen.add(later.since(-np.inf))
    seen.condense(305.0)
    found = s.resting_place(seen, known(305.0))
    assert found is None or np.linalg.norm(found[0].place - [3.0, -4.0]) < 0.5


def test_a_long_memory_is_bounded_in_time_and_number_and_moves_with_the_track():
    made = rows(at_rest, lambda t: np.array([0.8 * t, 0.0]), 900.0, others=())
    made.condense(900.0)
    kept = made.since(-np.inf)
    older = kept[kept[:, s.TIME] < 900.0 - s.MEMORY_S]
    assert 40 <= len(older) <= 100
    assert older[0, s.TIME] >= 300.0
    made.carry(lambda time, places: places + np.array([1.0, 2.0]))
    np.testing.assert_allclose(made.since(-np.inf)[:, [s.X, s.Y]], kept[:, [s.X, s.Y]] + [1.0, 2.0])
    made.forget(other=0)  # the robot was carried
    assert len(made.since(-np.inf)) == 0
