"""What drivers mean by their scans: bearings, times and no returns that cannot be are mended, refused or told."""

from __future__ import annotations

import math
from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from uwbslam_jax.files.scan_messages import FIRST_LOOK, ScanReader
from uwbslam_jax.measurements import ScanMessage

T0 = 1_700_000_000_000_000_000
BEAMS = 541
FIRST, LAST = -0.75 * math.pi, 0.75 * math.pi
STEP = (LAST - FIRST) / (BEAMS - 1)
ROOM = np.random.default_rng(3).uniform(1.0, 9.0, BEAMS).astype(np.float32)


def message(k: int = 0, frame: str = "laser", **fields: Any) -> SimpleNamespace:
    """The k-th of ten LaserScans a second; fields in place of the good ones."""
    good = {"angle_min": FIRST, "angle_max": LAST, "angle_increment": STEP, "time_increment": 0.075 / BEAMS}
    good |= {"range_min": 0.1, "range_max": 30.0, "ranges": ROOM + np.float32(0.001 * k)}
    return SimpleNamespace(header=SimpleNamespace(frame_id=frame), stamp=T0 + k * 10**8, **(good | fields))


def read(messages: list[SimpleNamespace], frame: str = "") -> tuple[list[ScanMessage], ScanReader, Counter[str]]:
    """What a reader makes of messages, which are all of a recording."""
    reader, dropped = ScanReader(frame), Counter[str]()
    for m in messages[:FIRST_LOOK]:
        reader.take(m, m.stamp, Counter())
    reader.settle()
    reader.settle_time(1.0)
    scans = [scan for m in messages for scan in reader.take(m, m.stamp, dropped)]
    return [scan for scan in scans if isinstance(scan, ScanMessage)], reader, dropped


def series(count: int = 20, **fields: Any) -> list[SimpleNamespace]:
    return [message(k, **fields) for k in range(count)]


def test_a_good_scan_is_passed_on_bit_for_bit() -> None:
    scans, reader, dropped = read(series(80))
    assert not reader.told
    assert not dropped
    assert len(scans) == 80
    for k, scan in enumerate(scans):
        assert (scan.angle_min, scan.angle_increment, scan.time_increment) == (FIRST, STEP, 0.075 / BEAMS)
        np.testing.assert_array_equal(scan.ranges, ROOM + np.float32(0.001 * k))


DEGREE = math.degrees(1.0)


@pytest.mark.parametrize(
    ("fields", "key"),
    [
        ({"angle_increment": 0.0}, "ends"),
        ({"angle_increment": math.nan}, "ends"),
        ({"angle_increment": STEP * 456 / 451}, "ends"),
        ({"angle_increment": STEP * 3.0}, "ends"),  # beyond a turn
        ({"angle_increment": STEP / 4.0}, "ends"),  # three of four readings left out
        ({"angle_increment": -STEP}, "sign"),
        ({"angle_increment": STEP * DEGREE}, "degrees"),
        ({"angle_min": FIRST * DEGREE, "angle_max": LAST * DEGREE}, "degrees"),
        ({"angle_min": FIRST * DEGREE, "angle_max": LAST * DEGREE, "angle_increment": STEP * DEGREE}, "degrees"),
        ({"angle_max": LAST * DEGREE}, "header"),
        ({"angle_max": -LAST / 2}, "header"),
        ({"angle_max": 0.0}, ""),  # never filled in
        ({"angle_max": math.inf}, ""),
        ({"angle_max": LAST + STEP}, ""),  # one more than there are
        ({"angle_max": LAST - 2 * math.pi}, ""),
    ],
)
def test_bearings_are_read_as_what_they_can_be(fields: dict[str, float], key: str) -> None:
    scans, reader, dropped = read(series(3, **fields))
    assert not dropped
    assert list(reader.told) == ([key] if key else [])
    for scan in scans:
        assert (scan.angle_min, scan.angle_increment) == pytest.approx((FIRST, STEP))


@pytest.mark.parametrize(
    "fields",
    [
        {"angle_min": math.nan},
        {"angle_max": FIRST, "angle_increment": 0.0},
        {"angle_max": FIRST + 20.0, "angle_increment": STEP * 10},
        {"angle_min": FIRST * 1000, "angle_max": LAST * 1000, "angle_increment": STEP * 1000},
    ],
)
def test_bearings_that_cannot_be_are_refused_with_the_reason(fields: dict[str, float]) -> None:
    scans, reader, dropped = read(series(3, **fields))
    assert not scans
    assert dropped == {"scan: impossible bearings": 3}
    assert list(reader.told) == ["refused"]


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_a_sweep_cannot_last_longer_than_the_time_between_scans(unit: float, turn: int) -> None:
    scans, reader, _ = read(series(time_increment=turn * unit * 0.075 / BEAMS))
    assert list(reader.told) == ["time"]
    assert all(scan.time_increment == pytest.approx(turn * 0.075 / BEAMS) for scan in scans)


def test_a_sweep_of_no_known_unit_is_one_turn_a_scan() -> None:
    scans, reader, _ = read(series(time_increment=-30 * 0.075 / BEAMS))
    assert list(reader.told) == ["time"]
    assert scans[0].time_increment == pytest.approx(-0.1 * STEP / (2 * math.pi))


@pytest.mark.parametrize("time_increment", [0.0, 0.1 / BEAMS, -0.02 / BEAMS])
def test_a_sweep_that_can_be_is_left(time_increment: float) -> None:
    scans, reader, _ = read(series(time_increment=time_increment))
    assert not reader.told
    assert scans[0].time_increment == time_increment


def test_a_largest_value_that_many_readings_share_is_no_return() -> None:
    beyond = ROOM > 7.0
    messages = [message(k, ranges=np.where(beyond, np.float32(7.5), ROOM + np.float32(0.001 * k))) for k in range(20)]
    scans, reader, _ = read(messages)
    assert list(reader.told) == ["no return"]
    for scan in scans:
        np.testing.assert_array_equal(np.isinf(scan.ranges), beyond)


def test_scans_of_one_value_are_no_return() -> None:
    scans, _, _ = read(series(3, ranges=np.full(BEAMS, 5.0, np.float32)))
    assert all(np.isinf(scan.ranges).all() for scan in scans)


def test_no_return_with_noise_on_the_limit_is_none_on_either_side() -> None:
    rng = np.random.default_rng(0)
    far = ROOM > 6.0
    noisy = np.where(far, 6.0 + rng.normal(0.0, 0.02, BEAMS), ROOM).astype(np.float32)
    scans, _, _ = read(series(3, ranges=noisy, range_max=6.0))
    left = (scans[0].ranges > 5.9) & (scans[0].ranges < 6.0)
    assert np.count_nonzero(left & far) <= 1


@pytest.mark.parametrize("grain", [0.001, 0.01, 0.05])
def test_a_flat_wall_of_a_scanner_with_coarse_readings_stays(grain: float) -> None:
    """A robot at rest before a wall, the sides open: every scan is the same, the largest readings too."""
    bearing = np.linspace(-0.5, 0.5, BEAMS)
    wall = np.where(np.abs(bearing) < 0.4, 4.0 / np.cos(bearing), np.inf)
    scans, reader, _ = read(series(ranges=(np.round(wall / grain) * grain).astype(np.float32)))
    if grain <= 0.01:
        assert not reader.told
        assert all(np.isfinite(scan.ranges).sum() == np.isfinite(wall).sum() for scan in scans)


def test_two_scanners_on_one_topic_are_told_apart() -> None:
    both = [m for k in range(40) for m in (message(k, "front"), message(k, "rear"))] + [message(40, "/front")]
    scans, reader, dropped = read(both)
    assert len(scans) == 41
    assert dropped == {"scan: of another scanner": 40}
    assert "front and rear" in reader.told["scanners"]
    assert "--lidar.frame" in reader.told["scanners"]
    scans, reader, dropped = read(both, "rear")
    assert len(scans) == 40
    assert not reader.told
    assert dropped.total() == 41


def test_a_scanner_that_was_renamed_is_one() -> None:
    scans, reader, dropped = read([message(k, "laser" if k < 100 else "laser_link") for k in range(200)])
    assert len(scans) + dropped.total() == 200
    assert dropped.total() <= 21
    assert "renamed" in reader.told
