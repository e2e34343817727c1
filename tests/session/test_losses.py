"""What was lost is told once, with its likely cause; a run that was shown no motion does not call its robot at rest."""

from __future__ import annotations

import ast
import pickle
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from uwbslam_jax.measurements import RangeMessage, ScanMessage
from uwbslam_jax.reasons import OdometryLost, RangeLost, ScanLost, Sensor, StartUpLacks
from uwbslam_jax.session.frame_assembler import FrameAssembler
from uwbslam_jax.session.losses import blank_scans, ended, losses, unmatched, unplaced
from uwbslam_jax.session.result_builder import Facts, to_result
from uwbslam_jax.session.session import Session
from uwbslam_jax.settings import LidarSettings, MapSettings, Settings
from uwbslam_jax.startup import Links

SMALL = Settings(map=MapSettings(size_m=6.4), lidar=LidarSettings(max_beams=30))
PACKAGE = Path(__file__).parents[2] / "uwbslam_jax"


def test_a_reason_is_its_text_and_knows_its_sensor() -> None:
    why = RangeLost.LINE_DAMAGED
    assert why == "line: damaged"
    assert {why: 3} == {"line: damaged": 3}
    again = pickle.loads(pickle.dumps(why))
    assert (again, again.sensor, again.advice) == (why, Sensor.RANGE, why.advice)
    assert RangeLost.over(200.0) == "range: over 200 m"


def test_no_module_counts_a_loss_by_a_bare_text() -> None:
    """It would be of no sensor, and its loss never told."""
    bare = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant | ast.JoinedStr):
                name = node.value.attr if isinstance(node.value, ast.Attribute) else ""
                bare += [f"{path.name}:{node.lineno}"] if name.strip("_") == "dropped" else []
    assert not bare


@pytest.mark.parametrize(
    ("used", "dropped", "says"),
    [
        ({Sensor.SCAN: 400}, {}, None),
        ({Sensor.SCAN: 400}, {ScanLost.STAMP: 90}, None),
        (
            {Sensor.SCAN: 400},
            {ScanLost.STAMP: 110},
            "110 of 510 scans were left out (110 x stamp not after the one before)",
        ),
        ({Sensor.SCAN: 400}, {ScanLost.STAMP: 60, ScanLost.NO_BEAMS: 70}, "(70 x no beams, 60 x stamp not after"),
        ({Sensor.RANGE: 8}, {RangeLost.LINE_DAMAGED: 3}, None),
        ({}, {RangeLost.over(200.0): 3}, "all 3 ranges were left out (3 x over 200 m): are they in mm or cm?"),
        ({Sensor.ODOMETRY: 10}, {OdometryLost.STAMP: 9}, "9 of 19 odometry poses"),
        ({Sensor.SCAN: 1}, {"node: bytes skipped": 99}, None),  # no scans: bytes
    ],
)
def test_more_than_a_fifth_is_told(used: dict[Sensor, int], dropped: dict[str, int], says: str | None) -> None:
    told = losses(used, dropped)
    assert len(told) == (says is not None)
    assert says is None or says in next(iter(told.values()))


def test_scans_without_a_return_are_told_where_they_are_most() -> None:
    frames = FrameAssembler(SMALL, max_ranges=2)
    for k, reading in enumerate([2.0, np.inf, np.inf]):
        frames.add(ScanMessage((1 + k) * 1_000_000_000, 0.0, 0.1, 0.0, 0.1, 30.0, np.full(20, reading, np.float32)))
    assert (frames.used[Sensor.SCAN], frames.blank) == (3, 2)
    assert blank_scans(3, 2)[0].startswith("2 of 3 scans hold no return")
    assert not blank_scans(0, 0) + blank_scans(4, 2)


def test_scans_that_did_not_fit_the_map_are_told_where_they_are_many() -> None:
    assert not unmatched(2000, 400, 0.1)
    assert not unmatched(10, 4, 0.1)
    (told,) = unmatched(440, 117, 2.433)
    assert told.startswith("117 of 440 scans")
    assert "less than 2.4 s apart" in told


def test_what_is_not_placed_has_its_own_cause() -> None:
    told = [
        unplaced(StartUpLacks.MOTION, ranges=0, seen=True),
        unplaced(StartUpLacks.MOTION, ranges=9, seen=False),
        unplaced(StartUpLacks.MOTION, ranges=9, seen=True),
        unplaced(StartUpLacks.RANGES, ranges=9, seen=True),
        unplaced(StartUpLacks.SIDE, ranges=9, seen=True),
    ]
    assert ["moved" in line for line in told] == [False, False, True, False, False]
    assert "--robot.id" in told[3]
    assert len(set(told)) == 5


def warnings(used: dict[Sensor, int], dropped: dict[str, int], settings: Settings = SMALL) -> tuple[list[str], str]:
    """Warnings and status of a run without a frame."""
    facts = Facts(used=Counter(used), dropped=Counter(dropped))
    summary = to_result(Session(settings), facts).summary
    assert all(warning in summary["warnings"] for warning in losses(facts.used, facts.dropped).values())
    return summary["warnings"], summary["status"]


def test_a_run_whose_scans_were_lost_says_so_and_not_that_its_robot_rested() -> None:
    told, status = warnings({Sensor.RANGE: 5000}, {ScanLost.STAMP: 399})
    assert status == "motion not known"
    assert [text for text in told if text.startswith("all 399 scans were left out")]
    assert not [text for text in told if "has not moved" in text or "waiting for motion" in text]
    assert "neither scans nor odometry show how the robot moves" in told[-1]


def test_what_is_told_is_told_once() -> None:
    told, _ = warnings({Sensor.SCAN: 10}, {RangeLost.over(200.0): 30})
    assert len([text for text in told if "range" in text]) == 1  # not also that no range was heard
    told, _ = warnings({Sensor.SCAN: 10}, {})
    assert "no range was heard" in told[-1]


@pytest.mark.parametrize(("speed", "moving"), [(0.0, False), (0.3, True)])
def test_ranges_tell_whether_the_robot_rests(speed: float, moving: bool) -> None:
    rng, places = np.random.default_rng(0), np.array([[0.0, 0.0], [8.0, 0.0], [3.0, 6.0], [7.0, 5.0]])
    links, robot = Links(), 31
    for k in range(100):
        ends = {1 + b: place for b, place in enumerate(places)} | {robot: np.array([2.0 + 0.1 * k * speed, 2.0])}
        for a, b in ((a, b) for a in ends for b in ends if a < b):
            wrong = 10.0 * (rng.uniform() < 0.05)  # gross outliers are not motion
            distance = float(np.hypot(*(ends[a] - ends[b])) + 0.1 * rng.normal()) + wrong
            links.add(a, b, distance)
    assert links.moving(robot) is moving
    assert links.moving(99) is moving  # the robot's id is wrong, so any node may be it
    assert not links.moving(1)


def test_a_range_message_that_is_counted_is_either_used_or_lost() -> None:
    frames, second = FrameAssembler(SMALL, max_ranges=2), 1_000_000_000
    for k in range(40):
        list(frames.add(RangeMessage(second + k // 4, 0, 1 + k % 4, 2.0)))
    frames.flush()
    assert frames.used[Sensor.RANGE] + sum(frames.dropped.values()) == 40


@pytest.mark.parametrize(("after", "duration", "tells"), [(20.0, 40.0, True), (35.0, 40.0, False), (2.0, 6.0, False)])
def test_scans_that_end_long_before_the_run_are_told(after: float, duration: float, tells: bool) -> None:
    assert [line.split(" s of")[0] for line in ended(after, duration)] == [f"no scan came after {after:.1f}"] * tells
