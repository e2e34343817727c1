"""The scenario suite's checks: each passes what is right and fails what is wrong, on made-up runs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.accuracy import checks, consistency, intervals, sharpness
from benchmarks.accuracy.checks import Stay, Trial
from benchmarks.accuracy.scenarios import seed_table, summary_table, verdict, worst_and_median
from benchmarks.accuracy.suite import ROWS, Check, Row
from benchmarks.readme import section
from uwbslam_jax.evaluation import RigidMotion
from uwbslam_jax.measurements import ScanMessage
from uwbslam_jax.result import MapImage
from uwbslam_jax.sim import SCENARIOS, make_scenario
from uwbslam_jax.sim.paths import Turn

T = np.arange(0.0, 60.0, 0.1)
EXACT = 1e-9


def straight(**changes: object) -> Trial:
    """A run without error: 30 m along +x in a minute."""
    true = np.column_stack([0.5 * T, 0 * T, 0 * T])
    return replace(Trial(T, true.copy(), true, decided=20.0, hypotheses=np.where(T < 20.0, 2.0, 1.0)), **changes)


def shifted(by: float, begin: float, end: float) -> Trial:
    """The same, off to the side by so much [m] for a while [s]."""
    trial = straight()
    trial.poses[trial.within([(begin, end)]), 1] += by
    return trial


def test_rms_within_and_outside_an_interval() -> None:
    trial = shifted(0.3, 10.0, 20.0)
    assert checks.rms_within(trial, [(10.0, 20.0)]) == pytest.approx(0.3)
    assert checks.rms_within(trial, [(0.0, 10.0), (20.0, 60.0)]) == 0.0
    assert checks.rms_outside(trial, [(10.0, 20.0)]) == 0.0
    assert checks.rms_outside(trial, []) == pytest.approx(0.3 / math.sqrt(6))
    assert math.isnan(checks.rms_within(trial, [(90.0, 95.0)]))


def test_a_jump_is_told_from_motion() -> None:
    assert checks.largest_jump(straight()) < EXACT  # 5 cm a scan are driven
    assert checks.largest_jump(shifted(0.06, 30.0, 60.0)) == pytest.approx(0.06)


def test_time_lost_counts_to_the_last_scan_that_is_off_or_turned() -> None:
    assert checks.time_lost(straight(), 20.0) == 0.0
    assert checks.time_lost(shifted(0.2, 15.0, 23.0), 20.0) == pytest.approx(2.9)
    assert checks.time_lost(shifted(0.2, 5.0, 15.0), 20.0) == 0.0
    turned = straight()
    turned.poses[turned.within([(20.0, 24.0)]), 2] += math.radians(120)
    assert checks.time_lost(turned, 20.0) == pytest.approx(3.9)
    turned.poses[:, 2] += 2 * math.pi
    assert checks.time_lost(turned, 24.0) == 0.0
    assert math.isnan(checks.time_lost(straight(), 70.0))


def test_a_corridor_that_comes_out_short() -> None:
    trial = straight()
    assert checks.length_error(trial, [0.0, 40.0, 10.0]) < EXACT
    trial.poses[:, 0] *= 0.99
    assert checks.length_error(trial, [0.0, 40.0, 10.0]) == pytest.approx(0.2)
    assert math.isnan(checks.length_error(trial, [0.0]))


def test_the_reflection_has_to_be_told_as_undecided_until_the_turn() -> None:
    honest = straight()
    assert checks.told_too_early(honest, 18.0) == 0.0
    assert checks.decided_late(honest, 18.0) == pytest.approx(2.0)
    assert checks.told_too_early(honest, 25.0) == 1.0  # decided on the straight
    silent = straight(hypotheses=np.where(T < 16.5, 1.0, 2.0))
    assert checks.told_too_early(silent, 18.0) == pytest.approx(0.5)
    never = straight(decided=math.nan)
    assert not checks.decided_late(never, 18.0) <= 3.0


def test_what_was_before_the_decision_is_filled_in() -> None:
    assert checks.filled_in(straight()) == 0.0
    assert checks.filled_in(shifted(0.1, 0.0, 20.0)) == pytest.approx(0.1)
    missing = straight()
    missing.poses[3] = np.nan
    assert math.isnan(checks.filled_in(missing))
    assert math.isnan(checks.filled_in(straight(decided=math.nan)))


def published(error: float, begin: float, end: float) -> Trial:
    """Beacon 4 stands at (1, 2) until 30 s, is carried to (7, 2) until 40 s, and is published off by so much in y."""
    t = np.arange(0.0, 60.0, 1.0)
    true = np.column_stack([t, np.interp(t, [30.0, 40.0], [1.0, 7.0]), np.full(t.size, 2.0)])
    told = true + np.column_stack([0 * t, 0 * t, np.where((t >= begin) & (t < end), error, 0.0)])
    return straight(beacons={4: told}, true_beacons={4: true})


RESTS = [Stay(4, 0.0, 30.0), Stay(4, 40.0, 60.0)]


def test_a_resting_beacon_has_ten_seconds() -> None:
    assert checks.resting_error(published(0.4, 30.0, 50.0), RESTS) < EXACT
    assert checks.resting_error(published(0.4, 50.0, 51.0), RESTS) == pytest.approx(0.4)
    early = replace(published(0.4, 29.0, 30.0), decided=5.0)
    assert checks.resting_error(early, RESTS) == pytest.approx(0.4)
    assert checks.resting_error(replace(early, decided=20.0), RESTS) < EXACT  # ten seconds after the frame was decided
    assert math.isnan(checks.resting_error(replace(published(0.0, 0, 0), beacons={}), RESTS))
    assert math.isnan(checks.resting_error(replace(published(0.0, 0, 0), true_beacons={}), RESTS))


def test_a_carried_beacon_is_followed() -> None:
    carry = [Stay(4, 30.0, 40.0)]
    assert checks.carried_error(published(9.0, 30.0, 33.0), carry) < EXACT  # until it is known to be carried
    assert checks.carried_error(published(0.7, 36.0, 37.0), carry) == pytest.approx(0.7)
    silent = published(0.0, 0.0, 0.0)
    silent = replace(silent, beacons={4: silent.beacons[4][:34]})
    assert math.isnan(checks.carried_error(silent, carry))


def test_biased_ranges_have_to_be_told() -> None:
    assert checks.untold(straight(warnings=("ranges of beacon 3 are biased by 0.2 m",)), "biased") == 0.0
    assert checks.untold(straight(warnings=("the recording breaks off",)), "biased") == 1.0
    assert checks.untold(straight(), "biased") == 1.0


def test_memory_that_grows_in_the_second_half() -> None:
    loading = np.concatenate([np.linspace(100, 600, 50), np.full(50, 600)])
    assert checks.memory_growth(straight(memory=loading)) == 0.0
    assert checks.memory_growth(straight(memory=np.linspace(100, 600, 101))) == pytest.approx(250)
    assert math.isnan(checks.memory_growth(straight()))


# When what happens ---------------------------------------------------------------------------------------------------


def test_what_is_to_happen_to_the_robot() -> None:
    kidnapped = make_scenario("kidnapped", 1)
    (begin, end) = kidnapped.lidar.blind[0]
    assert intervals.carried(kidnapped) == [pytest.approx((begin, end))]
    assert intervals.disturbed(make_scenario("blind", 1)) == [(70.0, 77.0)]
    assert intervals.disturbed(make_scenario("hall", 1)) == []
    made = make_scenario("straight", 2)
    turn = intervals.first_turn(made)
    pose = made.path.pose(np.array([0.0, turn]))
    assert np.hypot(*(pose[1] - pose[0])[:2]) == pytest.approx(12.0, abs=0.3)  # a corner's curvature begins at zero
    assert intervals.first_turn(replace(made, duration=10.0)) == math.inf
    corridor = make_scenario("corridor", 0)
    at = corridor.path.pose(np.array(intervals.stops(corridor)))
    assert len(at) == 1 + len(corridor.path.spans(Turn))
    assert np.hypot(*np.diff(at[:, :2], axis=0).T) == pytest.approx(19.9, abs=0.05)


def test_when_beacons_rest_and_are_carried_in_the_papers_schedule() -> None:
    made = make_scenario("schedule", 0)
    assert intervals.carries(made) == [Stay(3, 46.6, 62.6), Stay(5, 13.5, 31.1)]
    rests = intervals.rests(made)
    assert [s for s in rests if s.node == 1] == [Stay(1, 0.0, made.duration)]
    assert [s for s in rests if s.node == 5] == [Stay(5, 31.1, made.duration)]
    assert [s for s in rests if s.node == 3] == [Stay(3, 0.0, 31.1), Stay(3, 62.6, made.duration)]
    short = replace(made, duration=40.0)
    assert [s.node for s in intervals.carries(short)] == [5]


# Maps ----------------------------------------------------------------------------------------------------------------

WALL = np.array([[0.0, 1.0, 4.0, 1.0]])


def drawn(*heights: float) -> MapImage:
    """A map with walls 4 m long at these y [m], seen free below 0.5 m."""
    odds = np.zeros((60, 80), np.float32)
    odds[:10] = -1.0
    for y in heights:
        odds[round(y / 0.05)] = 3.0
    return MapImage(odds, 0.05, np.zeros(2))


def distances(image: MapImage, aside: float = 0.0) -> np.ndarray:
    moved = RigidMotion(np.eye(2), np.array([0.0, aside]))
    return sharpness.wall_distances(sharpness.occupied(image, moved), WALL)


def test_a_doubled_wall_is_neither_sharp_nor_by_any_wall() -> None:
    once = distances(drawn(1.0))
    assert (sharpness.sharpness(once, 0.05), sharpness.stray(once)) == (1.0, 0.0)
    blurred = distances(drawn(1.0, 1.1))
    assert (sharpness.sharpness(blurred, 0.05), sharpness.stray(blurred)) == (0.5, 0.0)
    doubled = distances(drawn(1.0, 1.3))
    assert (sharpness.sharpness(doubled, 0.05), sharpness.stray(doubled)) == (0.5, 0.5)
    assert sharpness.stray(distances(drawn(1.0), aside=0.5)) == 1.0
    assert math.isnan(sharpness.sharpness(distances(drawn()), 0.05))


def test_a_map_that_is_off_as_a_whole_fits_by_itself_and_a_doubled_one_does_not() -> None:
    walls = np.concatenate([WALL, [[4.0, 1.0, 4.0, -3.0], [0.0, 1.0, 0.0, -2.0]]])
    along = np.linspace(0.0, 1.0, 100)[:, None]
    cells = np.concatenate([wall[:2] + along * (wall[2:] - wall[:2]) for wall in walls])
    c, s = np.cos(0.03), np.sin(0.03)
    turned = cells @ np.array([[c, s], [-s, c]]) + [0.1, -0.15]
    assert sharpness.stray(sharpness.wall_distances(turned, walls)) > 0.1
    own = sharpness.own_fit(turned, walls).points(turned)
    assert sharpness.wall_distances(own, walls).max() < 0.02
    both = np.concatenate([cells, cells[:100] - np.array([0.0, 0.4])])
    own = sharpness.own_fit(both, walls).points(both)
    assert sharpness.stray(sharpness.wall_distances(own, walls)) > 0.1


@pytest.mark.parametrize("increment", [0.0, 0.01])
def test_scans_against_their_own_map(increment: float) -> None:
    """A robot that drives along a wall at 2 m/s; each beam is placed at its own time."""
    stamps = np.array([0, 1_000_000_000])
    poses = np.array([[1.0, 0.5, 0.0], [3.0, 0.5, 0.0]])
    angles = np.deg2rad(60.0 + 10.0 * np.arange(7))
    ranges = (0.525 / np.sin(angles)).astype(np.float32)  # to the middle of the cells that are drawn
    ranges[2] = np.inf
    scan = ScanMessage(0, angles[0], np.deg2rad(10.0), increment, 0.1, 30.0, ranges)
    near = sharpness.scan_misfit(drawn(1.0), stamps, poses, [scan], (0.0, 0.0, 0.0), (0.1, 30.0))
    assert near == pytest.approx(1 - 1 / (1 + math.exp(-3.0)), abs=1e-3)
    nearer = sharpness.scan_misfit(drawn(1.0), stamps, poses - [0, 0.2, 0], [scan], (0.0, 0.2, 0.0), (0.1, 30.0))
    assert nearer == pytest.approx(near, abs=1e-6)
    assert sharpness.scan_misfit(drawn(1.1), stamps, poses, [scan], (0.0, 0.0, 0.0), (0.1, 30.0)) == pytest.approx(0.5)
    assert math.isnan(sharpness.scan_misfit(drawn(1.0), stamps, poses, [], (0.0, 0.0, 0.0), (0.1, 30.0)))


# The table -----------------------------------------------------------------------------------------------------------

GOOD = {
    "robot_rmse_m": 0.01,
    "robot_max_m": 0.02,
    "beacon_mean_m": 0.01,
    "beacon_max_m": 0.02,
    "heading_deg_median": 0.05,
    "decided_s": 9.0,
    "sharpness": 0.97,
    "own_sharpness": 0.98,
    "stray": 0.0,
    "covered": 1.0,
    "beacons_missing": [],
    "real_time_factor": 20.0,
    "pose_nees_ratio": 1.0,
    "beacon_nees_ratio": 1.0,
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, ""),
        ({"robot_rmse_m": 0.04}, "robot_rmse_m 0.04 > 0.03"),
        ({"beacon_mean_m": math.nan}, "beacon_mean_m nan > 0.02"),
        ({"heading_deg_median": 0.11}, "heading_deg_median 0.11 > 0.1"),
        ({"stray": 0.2}, "stray 0.2 > 0.03"),
        ({"covered": 0.9}, "covered 0.900 < 0.98"),
        ({"decided_s": math.nan}, "not decided"),
        ({"beacons_missing": [7, 9]}, "beacons not placed: 7, 9"),
    ],
)
def test_every_figure_can_fail_a_seed(change: dict, words: str) -> None:
    row = Row("made up", 0.03, 0.02, 0.1)
    assert "; ".join(row.shortfalls({**GOOD, **change}, {})) == words


def test_a_check_can_fail_a_seed() -> None:
    row = Row("made up", 0.03, checks=(Check("late [s]", 3.0, lambda trial, _: trial.decided),))
    assert row.shortfalls(GOOD, {"late [s]": 3.0}) == []
    assert row.shortfalls(GOOD, {"late [s]": 3.1}) == ["late [s] 3.1 > 3"]
    assert row.shortfalls(GOOD, {"late [s]": math.nan}) == ["late [s] nan > 3"]


def test_the_suite_has_a_row_for_every_scenario_but_the_demos() -> None:
    assert set(ROWS) == set(SCENARIOS) - {"workshop"}


def test_the_table_tells_worst_median_and_verdict() -> None:
    seeds = [
        {
            "seed": k,
            **GOOD,
            "robot_rmse_m": rms,
            "online_rmse_m": 2 * rms,
            "sharpness": 0.9 + rms,
            "load": 0.5,
            "checks": {},
            "failed": failed,
        }
        for k, (rms, failed) in enumerate([(0.012, []), (0.03, ["robot_rmse_m 0.03 > 0.015"]), (0.01, [])])
    ]
    assert worst_and_median(seeds, "robot_rmse_m") == (0.03, 0.012)
    assert worst_and_median(seeds, "sharpness") == pytest.approx((0.91, 0.912))
    assert worst_and_median([{"x": math.nan}, {"x": 1.0}, {"x": 2.0}], "x") == (math.inf, 2.0)
    assert verdict(seeds) == "FAIL, 2 of 3 hold"
    assert verdict(seeds[:1]) == "pass"
    text = summary_table({"hall": seeds}, {"commit": "abc"})
    assert "0.0300 / 0.0120" in text
    assert "FAIL, 2 of 3 hold" in text
    assert "robot_rmse_m 0.03 > 0.015" in seed_table({"hall": seeds})
    assert section(text + seed_table({"hall": seeds})).rstrip() == "##" + text.rstrip()


def test_consistency_has_to_lie_between_its_bounds() -> None:
    honest = [{"pose_nees_ratio": 0.4 + k, "beacon_nees_ratio": 1.9} for k in range(3)]
    assert consistency.holds(honest)
    assert "FAIL" not in consistency.table({"hall": honest}, {})
    for wrong in (0.2, 2.1, math.nan):
        runs = [{**run, "pose_nees_ratio": wrong} for run in honest]
        assert not consistency.holds(runs)
        assert "FAIL" in consistency.table({"hall": runs}, {})
