"""Recordings as the field has them: a good one with one thing wrong, from the file up to the frames that are stepped.

What can be mended gives the frames of the good recording. What is wrong is told once, by a run and by `inspect`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import field_log
import numpy as np
import pytest
from field_faults import (
    ALL,
    Fault,
    both_ends,
    called,
    clockwise,
    copied,
    each,
    every,
    fields,
    in_bursts,
    in_halves,
    in_transforms,
    invalid,
    looped,
    nanosec_counts_us,
    no_quaternion,
    no_stamp_at_first,
    of_the_robot,
    on_other_topics_too,
    one,
    own_posts,
    readings,
    restarted,
    shuffled,
    simulated,
    standing,
    thinned,
    times,
    turned_back,
    twice,
    unchanged,
    upside_down,
)
from field_formats import FORMATS, published
from field_log import BEAMS, HALF, ODOM, SCAN, T0, UWB, Heard, S, drive, hear, points, still

import uwbslam_jax as us
from uwbslam_jax.result import Result
from uwbslam_jax.settings import LidarSettings, Settings, UwbSettings

HOUR = 3600 * S
RUN_S = 24
"""So long a drive decides where its beacons are [s]."""
DEFAULTS = Settings()


def same(found: Heard, good: Heard) -> None:
    """Frames bit for bit, whatever their stamps count from."""
    assert len(found.frames) == len(good.frames)
    for a, b in zip(found.frames, good.frames, strict=True):
        _same_frame(a.frame, b.frame)


def _same_frame(a: Any, b: Any, but: tuple[str, ...] = ()) -> None:
    for name, x, y in zip(a._fields, a, b, strict=True):
        if name in but:
            continue
        if isinstance(x, tuple):
            _same_frame(x, y, but)
        else:
            np.testing.assert_array_equal(x, y, err_msg=name)


def but_one_gap(found: Heard, good: Heard) -> None:
    """The same frames, of which one comes later after the one before."""
    assert len(found.frames) == len(good.frames)
    late = [k for k, (a, b) in enumerate(zip(found.frames, good.frames, strict=True)) if a.frame.dt != b.frame.dt]
    assert len(late) == 1
    for k, (a, b) in enumerate(zip(found.frames, good.frames, strict=True)):
        _same_frame(a.frame, b.frame, ("dt", "odometry", "age") if k in late else ())


def near(found: Heard, good: Heard) -> None:
    """The same measurements; times to what the log times tell, scans' bearings and ranges' units to what floats do."""
    assert abs(len(found.frames) - len(good.frames)) <= 1
    scans = [[f for f in heard.frames if f.frame.has_scan] for heard in (found, good)]
    assert len(scans[0]) == len(scans[1])
    spans = [(heard.frames[-1].stamp - heard.frames[0].stamp) / S for heard in (found, good)]
    assert spans[0] == pytest.approx(spans[1], abs=0.15)
    for a, b in zip(*scans, strict=True):
        np.testing.assert_allclose(points(found, a), points(good, b), atol=2e-5)
        assert abs(float(a.frame.dt) - float(b.frame.dt)) < 0.11
    ranges = [np.concatenate([f.frame.ranges.range[f.frame.ranges.valid] for f in h.frames]) for h in (found, good)]
    assert abs(len(ranges[0]) - len(ranges[1])) <= 6
    n = min(map(len, ranges))
    np.testing.assert_allclose(np.sort(ranges[0])[:n], np.sort(ranges[1])[:n], atol=0.1)


def rested(found: Heard, good: Heard) -> None:
    assert len(found.frames) == len(good.frames) + 30
    for a, b in zip(found.frames[31:], good.frames[1:], strict=True):
        _same_frame(a.frame, b.frame)


def one_scan_less(found: Heard, good: Heard) -> None:
    assert sum(found.dropped.values()) == 1
    assert len(found.frames) == len(good.frames) - 1
    seen = {f.frame.scan.ranges.tobytes() for f in good.frames}
    assert all(f.frame.scan.ranges.tobytes() in seen for f in found.frames)


def fewer_scans(found: Heard, good: Heard) -> None:
    seen = {f.frame.scan.ranges.tobytes() for f in good.frames}
    assert 0 < len(found.frames) < len(good.frames)
    assert all(f.frame.scan.ranges.tobytes() in seen for f in found.frames)


def fewer_readings(found: Heard, good: Heard) -> None:
    """Every reading is one of the good recording's."""
    assert len(found.frames) == len(good.frames)
    for a, b in zip(found.frames, good.frames, strict=True):
        if not b.frame.has_scan:
            continue
        few, all_of = points(found, a), points(good, b)
        at = np.abs(few[:, :1] - all_of[None, :, 0]).argmin(axis=1)
        assert len(few) >= BEAMS // 4
        np.testing.assert_allclose(few[:, :2], all_of[at, :2], atol=2e-5)


def same_wheels(found: Heard, good: Heard) -> None:
    """Increments that differ by what one interval at a constant speed does."""
    assert len(found.frames) == len(good.frames)
    for a, b in zip(found.frames, good.frames, strict=True):
        _same_frame(a.frame, b.frame, ("odometry",))
        assert a.frame.odometry.valid == b.frame.odometry.valid
        np.testing.assert_allclose(a.frame.odometry.increment, b.frame.odometry.increment, atol=0.01)


@dataclass(frozen=True)
class Case:
    """A fault, and what is right.

    Attributes:
      spoil: from the good recording's rows to those with the fault.
      right: compares what is heard with the good recording.
      told: what each warning says, in part; there are no others.
      noted: what `inspect` says where it is not what is told.
      good: changes the recording that it is compared with.
      wheels: whether there is odometry.
      settings: that a user who was told gives.
    """

    spoil: Fault
    right: Callable[[Heard, Heard], None] = same
    told: tuple[str, ...] = ()
    noted: str = ""
    good: Fault = unchanged
    wheels: bool = False
    settings: Settings = DEFAULTS


CASES: dict[str, Case] = {
    "clockwise": Case(each(SCAN, clockwise), near),
    "zero_first": Case(no_stamp_at_first, near, ("messages of /scan have no stamp", "messages of /uwb/ranges have no")),
    "sim_time": Case(lambda rows: simulated(rows, S)),
    "one_future_scan": Case(
        one(SCAN, lambda row: row.later(HOUR, log=False)), one_scan_less, noted="dropped: 1 x scan: stamp apart"
    ),
    "clock_back": Case(each(ALL, lambda row: row.later(-60 * S, log=False), HALF), near, ("jump back by 60.0",)),
    "clock_forward": Case(
        each(ALL, lambda row: row.later(HOUR), HALF), but_one_gap, noted="note: nothing was measured for 3600"
    ),
    "clock_1970": Case(
        each(ALL, lambda row: row.later(100 * S - T0), until=HALF), but_one_gap, ("was the clock set (from 1970, by",)
    ),
    "uwb_clock_off": Case(
        each(UWB, lambda row: row.later(-3 * HOUR, log=False)), near, ("/uwb/ranges are 3.0 h behind those of /scan",)
    ),
    "uwb_clock_ahead": Case(
        each(UWB, lambda row: row.later(3 * HOUR, log=False)), near, ("/uwb/ranges are 3.0 h ahead of those of /scan",)
    ),
    "uwb_late": Case(
        each(UWB, lambda row: row.later(S // 5)), settings=Settings(uwb=UwbSettings(latency=0.2)), right=near
    ),
    "bag_looped": Case(looped, same, ("messages of /scan come again", "messages of /uwb/ranges come again")),
    "gap_60": Case(each(ALL, lambda row: row.later(60 * S), HALF), but_one_gap, noted="note: nothing was measured for"),
    "gap_600": Case(
        each(ALL, lambda row: row.later(600 * S), HALF), but_one_gap, noted="note: nothing was measured for 600"
    ),
    "time_increment_ns": Case(each(SCAN, times(time_increment=1e9)), near, ("taken as ns",)),
    "time_increment_zero": Case(
        each(SCAN, fields(time_increment=0.0, scan_time=0.0)),
        noted="note: scans have no time_increment",
        good=each(SCAN, fields(time_increment=0.0)),
    ),
    "noreturn_is_max": Case(
        each(SCAN, lambda row: (readings(lambda r: np.minimum(r, 3.0))(row), fields(range_max=3.0)(row))),
        noted="note: no return is told as range_max, 3 m",
        good=each(SCAN, readings(lambda r: np.where(r < 3.0, r, np.inf))),
    ),
    "noreturn_is_inf": Case(
        each(SCAN, readings(lambda r: np.where(r < 3.0, r, np.inf))),
        good=each(SCAN, readings(lambda r: np.where(r < 3.0, r, np.nan))),
    ),
    "neg_inf": Case(each(SCAN, invalid), fewer_readings),
    "beams_vary": Case(each(SCAN, thinned), fewer_readings, noted="note: scans have 40 to 120 readings"),
    "increment_zero": Case(each(SCAN, fields(angle_increment=0.0)), near, ("spread evenly from angle_min",)),
    "increment_wrong": Case(each(SCAN, times(angle_increment=1.03)), near, ("spread evenly from angle_min",)),
    "own_posts": Case(
        own_posts,
        fewer_readings,
        noted="--lidar.min-range 0.3",
        settings=Settings(lidar=LidarSettings(min_range=0.3)),
    ),
    "standing": Case(standing, rested),
    "odom_child_laser_dup": Case(twice, same, ("50 of 100 messages of /scan have the stamp of the one before",)),
    "lidar_backwards": Case(
        lambda rows: [*each(SCAN, turned_back)(rows), still((0.0, 0.0, math.pi))],
        near,
        noted="mounting: laser sits on base_link at 0 0 3.142",
        wheels=True,
    ),
    "lidar_upside_down": Case(upside_down, near, noted="upside down"),
    "lidar_upside_down_odom": Case(upside_down, near, noted="upside down", wheels=True),
    "odom_ok": Case(unchanged, wheels=True),
    "odom_reset": Case(restarted, same_wheels, ("odometry jumps (1 times, first after 2.5 s)",), wheels=True),
    "odom_zero_quat": Case(
        each(ODOM, no_quaternion),
        told=("--no-odom",),
        good=lambda rows: [r for r in rows if r.topic != ODOM],
        wheels=True,
    ),
    "odom_tf_only": Case(each(ODOM, in_transforms), wheels=True),
    "uwb_mm": Case(each(UWB, times(range=1000.0)), near, ("--uwb.unit mm",)),
    "tag_27": Case(each(UWB, called({0: 27})), told=("--robot.id 27",)),
    "tag_27_robot_only": Case(
        lambda rows: each(UWB, called({0: 27}))(of_the_robot(rows)), told=("--robot.id 27",), good=of_the_robot
    ),
    "reboot_new_id": Case(each(UWB, called({20: 120}), HALF), near, noted="note: node 120 is first heard after 2."),
    "gap_2h": Case(each(ALL, lambda row: row.later(2 * HOUR), HALF), but_one_gap, noted="nothing was measured for 72"),
    "scans_fail_at_times": Case(
        every(SCAN, 3, readings(np.zeros_like)),
        told=("16 of 50 scans were left out",),
        right=fewer_scans,
        noted="note: 17 scans hold no return",
    ),
    "scan_mm": Case(each(SCAN, times(ranges=1000.0, range_min=1000.0, range_max=1000.0)), near, ("taken for mm",)),
    "scan_mm_limits_m": Case(each(SCAN, times(ranges=1000.0)), near, ("taken for mm",)),
    "scan_cm": Case(each(SCAN, times(ranges=100.0)), near, ("taken for cm",)),
    "scan_limits_wrong": Case(
        each(SCAN, fields(range_max=0.5)), same, ("range_min and range_max: these are not used",)
    ),
    "scan_limits_swapped": Case(each(SCAN, fields(range_min=30.0, range_max=0.1)), same),
    "stamps_us": Case(
        each(ALL, lambda row: row.later(row.stamp // 1000 - row.stamp, log=False)),
        near,
        ("stamps of /scan pass 0.001 times", "stamps of /uwb/ranges pass 0.001 times"),
    ),
    "uwb_stamps_us": Case(
        each(UWB, lambda row: row.later(row.stamp // 1000 - row.stamp, log=False)),
        near,
        ("stamps of /uwb/ranges pass 0.001 times",),
    ),
    "uwb_stamps_counter": Case(
        each(UWB, lambda row: row.later(T0 + 64 * (row.stamp - T0) - row.stamp, log=False)),
        near,
        ("stamps of /uwb/ranges pass 64 times",),
    ),
    "uwb_stamps_ms": Case(
        each(UWB, lambda row: row.later(1000 * (row.stamp - T0) - row.stamp + S, log=False)),
        near,
        ("stamps of /uwb/ranges pass 1e+03 times",),
    ),
    "stamps_whole_seconds": Case(
        each(UWB, lambda row: row.later(-(row.stamp % S), log=False)),
        near,
        ("stamps of /uwb/ranges are whole seconds",),
    ),
    "uwb_nanosec_is_us": Case(each(UWB, nanosec_counts_us), near, ("are whole seconds (or nanosec counts us",)),
    "scan_time_zone": Case(
        each(SCAN, lambda row: row.later(5 * HOUR + HOUR // 2, log=False)),
        near,
        ("/uwb/ranges are 5.5 h behind",),
    ),
    "log_shuffled": Case(shuffled, told=("s late and out of order",)),
    "scans_in_bursts": Case(in_bursts, told=("s late and out of order",)),
    "on_other_topics_too": Case(
        on_other_topics_too,
        told=("/scan_again holds scans too and is left out", "/uwb/ranges_again holds ranges too and is left out"),
    ),
    "scans_end": Case(
        lambda rows: [r for r in rows if r.topic != SCAN or r.stamp < HALF],
        fewer_scans,
        noted="note: scans end after 2.4 s",
    ),
    "uwb_before_1970": Case(
        each(UWB, lambda row: setattr(row, "stamp", -row.stamp)),
        near,
        ("150 of 150 messages of /uwb/",),
    ),
    "half_turns": Case(in_halves, near, noted="note: scans of 177 deg are parts of a sweep, and put together"),
    "copies_later": Case(
        copied(S // 5),
        told=("49 x a copy of one before", "a copy of one before"),
        noted="are copies of one before",
    ),
    "both_ends_tell": Case(both_ends, told=("a copy of one before",), noted="ranges are copies of one before"),
    "uwb_feet": Case(
        each(UWB, times(range=1 / 0.3048)), near, settings=Settings(uwb=UwbSettings(unit="ft")), noted="nodes heard"
    ),
    "increment_sign": Case(each(SCAN, times(angle_increment=-1.0)), same, ("if the map is mirrored",)),
    "log_all_zero": Case(each(ALL, lambda row: setattr(row, "log", 0))),
    "no_stamp_at_all": Case(each(ALL, lambda row: setattr(row, "stamp", 0)), near),
}


_GOODS: dict[tuple[Fault, bool], Heard] = {}


def _good(change: Fault, wheels: bool, path: Path) -> Heard:
    """What is heard of a good recording."""
    if (change, wheels) not in _GOODS:
        _GOODS[change, wheels] = hear(field_log.written(path, change(drive(with_wheels=wheels))))
        assert not _GOODS[change, wheels].told
    return _GOODS[change, wheels]


@pytest.mark.parametrize("name", CASES)
def test_what_is_wrong_is_mended_or_told(tmp_path: Path, name: str) -> None:
    case = CASES[name]
    good = _good(case.good, case.wheels, tmp_path / "good.mcap")
    found = hear(field_log.written(tmp_path / "a.mcap", case.spoil(drive(with_wheels=case.wheels))), case.settings)
    case.right(found, good)
    assert len(found.told) == len(case.told), found.told
    for line, part in zip(found.told, case.told, strict=True):
        assert part in line
    plain = hear(tmp_path / "a.mcap") if case.settings != DEFAULTS else found
    for part in (case.noted,) if case.noted else case.told:
        assert [line for line in plain.inspected.splitlines() if part in line], plain.inspected


TOLD = {
    "sensor_range": ("nodes have names",),
    "counter_of_the_radio": ("pass 64 times as fast",),
}
"""What is told of some formats."""


@pytest.mark.parametrize("name", FORMATS)
def test_ranges_in_other_packages_messages(tmp_path: Path, name: str) -> None:
    good = _good(of_the_robot, False, tmp_path / "good.mcap")
    rows, store = published(of_the_robot(drive()), name)
    found = hear(field_log.written(tmp_path / "a.mcap", rows, store))
    near(found, good)
    for line, part in zip(found.told, TOLD.get(name, ()), strict=True):
        assert part in line
        assert line in found.inspected


@pytest.fixture(scope="module")
def good_run(tmp_path_factory: pytest.TempPathFactory) -> Result:
    return us.run(field_log.written(tmp_path_factory.mktemp("good") / "a.mcap", drive(RUN_S)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["clock_back", "clock_1970", "gap_2h", "uwb_clock_off", "stamps_us", "scans_fail_at_times"]
)
def test_a_run_ends_where_that_of_the_good_recording_does(tmp_path: Path, good_run: Result, name: str) -> None:
    found = us.run(field_log.written(tmp_path / "a.mcap", CASES[name].spoil(drive(RUN_S))))
    found.save(tmp_path / "out")
    places = [{beacon.id: beacon.position for beacon in run.beacons} for run in (good_run, found)]
    assert sorted(places[0]) == sorted(places[1]) == [10, 20, 30]
    for a, b in ((10, 20), (10, 30), (20, 30)):
        apart = [np.linalg.norm(place[a] - place[b]) for place in places]
        assert apart[0] == pytest.approx(apart[1], abs=0.05)
    way = [np.linalg.norm(run.poses[-1, :2] - run.poses[0, :2]) for run in (good_run, found)]
    assert way[0] == pytest.approx(way[1], abs=0.1)
