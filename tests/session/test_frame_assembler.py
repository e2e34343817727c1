"""Messages to frames: nothing is lost without being counted, whatever order and quality they come in."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, strategies as st

from uwbslam_jax.measurements import OdometryMessage, RangeMessage, ScanMessage, StampedFrame, TruthMessage
from uwbslam_jax.session.frame_assembler import FrameAssembler, pad_scan
from uwbslam_jax.settings import LidarSettings, OdomSettings, Settings, UwbSettings

NAN, INF = float("nan"), float("inf")
START = 1_700_000_000_000_000_000
"""An epoch, which float32 cannot hold [ns]."""
MAX_RANGES = 4


def settings(**odom) -> Settings:
    return Settings(
        uwb=UwbSettings(max_beacons=2, max_range=50.0),
        lidar=LidarSettings(max_beams=8, min_range=0.2, max_range=20.0),
        odom=OdomSettings(**odom),
    )


def assembler(max_ranges: int = MAX_RANGES, **odom) -> FrameAssembler:
    return FrameAssembler(settings(**odom), max_ranges)


def at(seconds: float) -> int:
    return START + round(seconds * 1e9)


def scan(seconds: float, ranges=(1.0, 2.0, 3.0), increment: float = 0.1) -> ScanMessage:
    return ScanMessage(at(seconds), -0.5, increment, 1e-4, 0.1, 10.0, np.array(ranges, np.float32))


def ranged(seconds: float, a: int = 0, b: int = 1, distance: float = 5.0, **powers) -> RangeMessage:
    return RangeMessage(at(seconds), a, b, distance, **powers)


def odometry(seconds: float, x: float, y: float, yaw: float) -> OdometryMessage:
    return OdometryMessage(at(seconds), x, y, yaw)


def taken(frames: list[StampedFrame]) -> list[tuple[int, int, float]]:
    """Slots and distance of all ranges in frames."""
    found = []
    for f in frames:
        r = f.frame.ranges
        found += [(int(r.i[k]), int(r.j[k]), float(r.range[k])) for k in np.flatnonzero(r.valid)]
    return found


def test_a_scan_closes_a_frame_with_the_ranges_before_it():
    make = assembler()
    frames = list(
        make.frames(
            [
                ranged(0.0, 0, 7, 3.0, receive_power=-80.0, first_path_power=-92.5),
                ranged(0.03, 9, 7, 4.0),
                scan(0.1),
                ranged(0.12, 0, 7, 3.5),
                scan(0.2),
            ]
        )
    )
    assert [f.stamp for f in frames] == [at(0.1), at(0.2)]
    first, second = (f.frame for f in frames)
    assert taken(frames) == [(0, 1, 3.0), (2, 1, 4.0), (0, 1, 3.5)]
    assert make.slots == frames[-1].slots == {0: 0, 7: 1, 9: 2}
    np.testing.assert_allclose(first.ranges.age[:2], [-0.1, -0.07], atol=1e-7)  # float32
    assert float(first.ranges.power_gap[0]) == 12.5
    assert np.isnan(first.ranges.power_gap[1:]).all()
    assert bool(first.has_scan)
    assert float(first.dt) == 0.0
    np.testing.assert_allclose(second.dt, 0.1, rtol=1e-6)
    assert not make.dropped
    # empty slots name two different nodes
    assert (first.ranges.i[2:] != first.ranges.j[2:]).all()


def test_a_range_that_arrives_before_its_scan_waits_for_the_next():
    frames = list(assembler().frames([ranged(0.15), scan(0.1), scan(0.2)]))
    assert [len(taken([f])) for f in frames] == [0, 1]
    np.testing.assert_allclose(frames[1].frame.ranges.age[0], -0.05, atol=1e-7)


@pytest.mark.parametrize("distance", [NAN, INF, -INF, -1.0, 0.0, 50.1, 1e30])
def test_impossible_ranges_are_dropped_and_counted(distance):
    make = assembler()
    frames = list(make.frames([ranged(0.0, distance=distance), scan(0.1)]))
    assert taken(frames) == []
    assert make.dropped == {"range: not finite, not positive or too long": 1}
    assert make.slots == {0: 0}  # and give no slot to a node


def test_duplicates_are_dropped_and_counted_in_either_direction():
    make = assembler()
    frames = list(make.frames([ranged(0.0), ranged(0.0), ranged(0.0, 1, 0), scan(0.1), scan(0.1)]))
    assert len(taken(frames)) == 1
    assert make.dropped == {
        "range: a copy of one before": 2,
        "scan: stamp of the one before": 1,
    }


def test_stamps_out_of_order_are_dropped_and_counted():
    make = assembler()
    stream = [scan(1.0), scan(0.9), ranged(1.05), ranged(1.02), ranged(0.3, 0, 2), ranged(0.97, 1, 2), scan(1.1)]
    frames = list(make.frames(stream))
    assert [f.stamp for f in frames] == [at(1.0), at(1.1)]
    # a little late is still used, by its age
    assert taken(frames[1:]) == [(1, 2, 5.0), (0, 1, 5.0)]
    np.testing.assert_allclose(frames[1].frame.ranges.age[:2], [-0.13, -0.05], atol=1e-6)
    assert make.dropped == {
        "scan: stamp not after the one before": 1,
        "range: stamp not after the pair's one before": 1,
        "range: arrived too late": 1,
    }


def test_a_node_that_ranges_to_itself_is_dropped_and_counted():
    make = assembler()
    list(make.frames([ranged(0.0, 3, 3), scan(0.1)]))
    assert make.dropped == {"range: a node to itself": 1}


def test_beacons_beyond_max_beacons_get_room_once_they_are_heard_often():
    make = assembler()
    heard = [ranged(0.0, 0, 4_000_000_000), ranged(0.01, 0, 5), *(ranged(0.02 + k / 100, 0, 6) for k in range(6))]
    frames = list(make.frames([*heard, ranged(0.09, 0, 9), scan(0.1), ranged(0.15, 5, 6), scan(0.2)]))
    assert len(taken(frames)) == 2 + 2 + 1 + 1  # the last two of node 6; node 9 has room now
    assert make.slots == {0: 0, 4_000_000_000: 1, 5: 2, 6: 3, 9: 4}
    assert make.dropped == {"range: of a node heard too seldom, or more beacons than max_beacons": 4}
    assert make.warnings == [
        "more than 2 beacons were heard: room was made for 4 in the run, --uwb.max-beacons 4 makes it before"
    ]
    assert frames[-1].frame.ranges.i.shape == (32,)


def test_ids_that_are_heard_once_get_no_more_slots_than_there_are():
    make = assembler()
    junk = [ranged(0.001 * k, 0, 1000 + k) for k in range(50)]
    list(make.frames([*junk, scan(0.1)]))
    assert len(make.slots) == 3
    assert make.warnings == []


def test_a_robot_that_is_not_heard_is_told():
    make = assembler()
    list(make.frames([ranged(0.0, 5, 27), *(ranged(0.01 + k / 100, 6, 27) for k in range(6)), scan(0.1)]))
    assert make.missing() == [
        "robot.id = 0 is never heard among the nodes 5, 6, 27: name the robot's own, --robot.id ID"
    ]
    list(make.frames([ranged(0.2, 0, 5), scan(0.3)]))
    assert make.missing() == []
    without_scans = assembler()
    list(without_scans.frames([ranged(0.0, 5, 27), ranged(0.01, 5, 28)]))
    assert without_scans.missing() == []


def test_there_is_an_end_to_room(monkeypatch):
    monkeypatch.setattr("uwbslam_jax.settings.MOST_BEACONS", 3)
    make = assembler()
    heard = [ranged(0.01 * k + 0.001 * node, 0, node) for k in range(9) for node in range(1, 7)]
    list(make.frames([*heard, scan(0.2)]))
    assert len(make.slots) == 4
    told = "more than 3 beacons were heard: node {} is ignored, there is room for no more"
    assert make.warnings[1:] == [told.format(node) for node in range(1, 7) if node not in make.slots]


def test_more_ranges_than_a_frame_holds_make_more_frames_or_are_counted():
    make = assembler(max_ranges=2)
    many = [ranged(0.01 * k, *pair) for k, pair in enumerate([(0, 1), (0, 2), (1, 2), (1, 0), (2, 0)], start=1)]
    frames = list(make.frames([scan(0.0), *many, scan(0.1)]))
    assert len(taken(frames)) == 5
    assert max(len(taken([f])) for f in frames) <= 2
    assert not make.dropped
    # all at the stamp of the scan: there is no time for a frame before it
    at_once = [ranged(0.2, *pair) for pair in [(0, 1), (0, 2), (1, 2)]]
    frames = [f for m in [*at_once, scan(0.2)] for f in make.add(m)]
    assert len(taken(frames)) + make.dropped["range: more than one frame holds"] == 3


@pytest.mark.parametrize("bad", [scan(0.0, ()), scan(0.0, (1.0,)), scan(0.0, increment=NAN)])
def test_a_scan_without_beams_or_bearings_is_dropped_and_counted(bad):
    make = assembler()
    assert list(make.frames([bad])) == []
    assert make.dropped == {"scan: no beams or no bearings": 1}


def test_readings_outside_limits_are_no_return():
    readings = [0.0, NAN, INF, -1.0, 0.15, 0.25, 9.9, 10.1]
    padded = pad_scan(scan(0.0, readings), settings())  # 0.2 is the setting's limit, 10 the sensor's
    np.testing.assert_array_equal(padded.valid, [False] * 5 + [True, True, False])
    np.testing.assert_allclose(padded.ranges, [0, 0, 0, 0, 0, 0.25, 9.9, 0], rtol=1e-6)


@pytest.mark.parametrize("beams", [2, 7, 8, 9, 16, 17, 1081])
@pytest.mark.parametrize("increment", [0.01, -0.01], ids=["counter-clockwise", "upside down"])
def test_beams_keep_their_bearing_and_time_when_thinned(beams, increment):
    readings = 1.0 + 0.001 * np.arange(beams)
    message = scan(0.0, readings, increment)
    padded = pad_scan(message, settings())
    kept = np.flatnonzero(padded.valid)
    stride = -(-beams // 8)
    assert len(kept) == -(-beams // stride) <= 8
    original = np.round((padded.ranges[kept] - 1.0) / 0.001).astype(int)
    np.testing.assert_allclose(
        padded.angle_min + padded.angle_increment * kept, -0.5 + increment * original, rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(padded.time_increment * kept, 1e-4 * original, rtol=1e-5)
    assert np.sign(padded.angle_increment) == np.sign(increment)
    np.testing.assert_array_equal(original, np.arange(0, beams, stride))  # evenly over the whole sweep


def test_odometry_is_interpolated_between_its_stamps_and_put_into_the_robots_frame():
    """Heading +y, driving forward 1 m/s: the increment is along the robot's x."""
    stream = [odometry(0.04 * k, 3.0, 0.04 * k, np.pi / 2) for k in range(4)]
    make = assembler()
    frames = list(make.frames([*stream, scan(0.05), scan(0.1)]))
    assert not bool(frames[0].frame.odometry.valid)  # there is no frame before
    assert bool(frames[1].frame.odometry.valid)
    np.testing.assert_allclose(frames[1].frame.odometry.increment, [0.05, 0.0, 0.0], atol=1e-6)
    assert make.odometry_used


def test_odometry_turn_goes_the_short_way_round():
    stream = [odometry(0.0, 0.0, 0.0, 3.1), odometry(0.1, 0.0, 0.0, -3.1), odometry(0.2, 0.0, 0.0, -3.0)]
    frames = list(assembler().frames([*stream, scan(0.0), scan(0.05), scan(0.15)]))
    turn = 2 * np.pi - 6.2
    np.testing.assert_allclose(frames[1].frame.odometry.increment[2], turn / 2, atol=1e-6)
    np.testing.assert_allclose(frames[2].frame.odometry.increment[2], turn / 2 + 0.05, atol=1e-6)


def test_odometry_that_lags_is_held_for_a_moment_and_then_not_used():
    stream = [odometry(0.1 * k, 0.1 * k, 0.0, 0.0) for k in range(4)]  # up to 0.3 s
    frames = list(assembler().frames([*stream, scan(0.2), scan(0.5), scan(0.7)]))
    valid = [bool(f.frame.odometry.valid) for f in frames]
    assert valid == [False, True, False]
    np.testing.assert_allclose(frames[1].frame.odometry.increment, [0.3, 0.0, 0.0], atol=1e-6)  # at the last speed


def test_bad_odometry_is_dropped_and_counted_and_may_be_switched_off():
    bad = [odometry(0.0, 0, 0, 0), odometry(0.0, 1, 0, 0), odometry(0.1, NAN, 0, 0), odometry(0.2, 0, 0, INF)]
    make = assembler()
    list(make.frames(bad))
    assert make.dropped == {"odometry: stamp of the one before": 1, "odometry: not finite": 2}
    off = assembler(use=False)
    stream = [odometry(0.05 * k, 0.1 * k, 0.0, 0.0) for k in range(5)]
    frames = list(off.frames([*stream, scan(0.1), scan(0.2)]))
    assert not any(bool(f.frame.odometry.valid) for f in frames)
    assert not off.odometry_used


def test_ranges_without_scans_make_frames_of_about_a_second():
    make = assembler(max_ranges=32)
    stream = [ranged(0.1 * k, 0, 1 + k % 2, 1.0 + 0.1 * k) for k in range(100)]
    online = [f for m in stream for f in make.add(m)]
    frames = online + make.flush()
    assert len(taken(frames)) == 100
    assert not any(bool(f.frame.has_scan) or f.frame.scan.valid.any() for f in frames)
    assert len(online) >= 7  # they do not all wait for the end
    assert len(frames) <= 12
    assert not make.dropped
    for f in frames:
        assert f.frame.ranges.age[f.frame.ranges.valid].min() >= -1.0 - 1e-6


def test_ranges_make_a_frame_every_fifth_of_a_second_while_a_lidar_is_silent():
    """No velocity predicts a turning robot for a second. Once scans come again, ranges wait for them again."""
    make = assembler(max_ranges=32)
    ranges = [ranged(0.05 * k, 0, 1 + k % 2, 1.0) for k in range(1, 240)]
    scans = [scan(0.1 * k) for k in [*range(1, 20), *range(70, 100)]]
    stream = sorted([*ranges, *scans], key=lambda m: m.stamp)
    frames = [f for m in stream for f in make.add(m)]
    blind = [f for f in frames if at(2.0) < f.stamp < at(6.9)]
    assert not any(f.frame.has_scan for f in blind)
    assert max(float(f.frame.dt) for f in blind[1:]) <= 0.3
    assert blind[0].stamp - at(1.9) <= 2.5e9  # the first waits in vain
    seeing = [f for f in frames if at(7.0) <= f.stamp <= at(9.9)]
    assert all(f.frame.has_scan for f in seeing)
    assert len(seeing) == 30
    assert not make.dropped


def test_a_slow_scanner_is_not_a_silent_one():
    """A scan now and then that comes late makes no frames of ranges alone where scans are as far apart as that."""
    make = assembler(max_ranges=64)
    ranges = [ranged(0.1 * k, 0, 1 + k % 2, 1.0) for k in range(1, 300)]
    scans = [scan(0.6 * k) for k in range(1, 48) if k % 10 not in (7, 8, 9)]
    stream = sorted([*ranges, *scans], key=lambda m: m.stamp)
    frames = [f for m in stream for f in make.add(m)]
    alone = [f for f in frames if not f.frame.has_scan and f.stamp < at(0.6 * 46)]
    assert len(alone) <= 2 * 5  # five gaps of 2.4 s
    assert not make.dropped


def driven(seconds: np.ndarray) -> list[OdometryMessage]:
    return [odometry(t, 0.5 * t, 0.0, 0.3 * t) for t in seconds]


def test_without_scans_the_odometry_makes_the_frames():
    """A frame at its stamps, not at every one where they come fast, each with the ranges up to it and its turn."""
    make = assembler()
    wheels, ranges = driven(np.arange(0, 6, 0.05)), [ranged(t) for t in np.arange(0.02, 6, 0.2)]
    frames = list(make.frames(sorted([*wheels, *ranges], key=lambda m: m.stamp)))
    assert [f.stamp for f in frames] == [at(t) for t in np.arange(0, 6, 0.1)]
    assert not any(f.frame.has_scan for f in frames)
    assert all(f.frame.odometry.valid for f in frames[1:])
    np.testing.assert_allclose([f.frame.odometry.increment[2] for f in frames[1:]], 0.03, atol=1e-6)
    assert len(taken(frames)) == len(ranges)
    assert min(float(f.frame.ranges.age.min()) for f in frames) > -0.1 - 1e-6
    assert make.flush() == []
    assert make.odometry_used


def test_a_range_of_the_same_stamp_as_the_odometry_belongs_to_its_frame():
    make = assembler()
    wheels = driven(np.arange(0, 6, 0.1))
    frames = list(make.frames([m for wheel in wheels for m in (wheel, RangeMessage(wheel.stamp, 0, 1, 5.0))]))
    assert len(frames) == len(wheels)
    assert all(float(f.frame.ranges.age[0]) == 0.0 for f in frames)


def test_odometry_takes_over_when_scans_stop_and_hands_back_when_they_return():
    make = assembler()
    scans = [scan(t) for t in [*np.arange(0, 2, 0.1), *np.arange(8, 10, 0.1)]]
    frames = list(make.frames(sorted([*driven(np.arange(-0.1, 10, 0.1) + 0.001), *scans], key=lambda m: m.stamp)))
    with_scan = [f.stamp for f in frames if f.frame.has_scan]
    between = [f.stamp for f in frames if not f.frame.has_scan]
    assert len(with_scan) == 40
    assert len(between) == 59  # the last odometry before the scans is not waited for
    assert at(1.9) < min(between)
    assert max(between) < at(8.0)
    assert sum(float(f.frame.odometry.increment[2]) for f in frames) == pytest.approx(0.3 * 9.9, abs=1e-4)


def test_a_gap_between_scans_does_not_lose_its_ranges():
    make = assembler(max_ranges=32)
    stream = [scan(0.0), *[ranged(0.1 + 0.1 * k, 0, 1, 1.0 + k) for k in range(45)], scan(4.7), ranged(4.8), scan(4.9)]
    frames = list(make.frames(stream))
    assert len(taken(frames)) == 46
    assert sum(bool(f.frame.has_scan) for f in frames) == 3
    np.testing.assert_allclose(sum(float(f.frame.dt) for f in frames), 4.9, atol=1e-5)


def test_flush_hands_over_what_still_waits_and_only_once():
    make = assembler()
    assert make.add(scan(0.0))
    assert not make.add(ranged(0.1))
    assert len(taken(make.flush())) == 1
    assert make.flush() == []


def test_ground_truth_never_reaches_a_frame():
    make = assembler()
    stream = [TruthMessage(at(0.0), None, 9.0, 9.0, 9.0), TruthMessage(at(0.0), 1, 9.0, 9.0), scan(0.1)]
    frames = list(make.frames(stream))
    assert len(frames) == 1
    assert make.slots == {0: 0}
    assert not make.dropped


messages = st.one_of(
    st.builds(scan, st.floats(0, 8)),
    st.builds(ranged, st.floats(0, 8), st.integers(0, 3), st.integers(0, 3), st.floats(allow_nan=True)),
    st.builds(odometry, st.floats(0, 8), *[st.floats(-5, 5)] * 3),
)


@given(st.lists(messages, max_size=60), st.booleans())
def test_every_message_is_in_a_frame_or_counted(stream, in_order):
    if in_order:
        stream = sorted(stream, key=lambda m: m.stamp)
    make = assembler()
    frames = list(make.frames(stream))
    stamps = [f.stamp for f in frames]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    steps = np.diff(stamps) / 1e9
    np.testing.assert_allclose([f.frame.dt for f in frames[1:]], steps, rtol=1e-6)
    for name, kind, used in [
        ("range", RangeMessage, len(taken(frames))),
        ("scan", ScanMessage, sum(bool(f.frame.has_scan) for f in frames)),
    ]:
        lost = sum(count for reason, count in make.dropped.items() if reason.startswith(name))
        assert used + lost == sum(isinstance(m, kind) for m in stream)
    for f in frames:
        r = f.frame.ranges
        assert (r.age[r.valid] <= 0).all()
        assert (r.i < 3).all()
        assert (r.j < 3).all()
        assert (r.i[r.valid] != r.j[r.valid]).all()
        assert all(np.isfinite(leaf).all() for leaf in (r.range, r.age, f.frame.odometry.increment, f.frame.dt))


def test_no_time_between_frames_is_taken_for_years() -> None:
    frames = list(assembler().frames([scan(0.0), scan(0.1), scan(2e9), scan(2e9 + 0.1)]))
    assert [round(float(f.frame.dt), 3) for f in frames] == [0.0, 0.1, 3600.0, 0.1]


def test_ranges_that_are_stamped_late_are_put_back() -> None:
    late = dataclasses.replace(settings(), uwb=dataclasses.replace(settings().uwb, latency=0.7))
    make = FrameAssembler(late, MAX_RANGES)
    frames = list(make.frames([scan(0.0), ranged(0.5), scan(0.6), ranged(1.0), scan(1.1)]))
    ages = [f.frame.ranges.age[f.frame.ranges.valid].tolist() for f in frames]
    assert ages == [[], [pytest.approx(-0.8)], [pytest.approx(-0.8)]]
    assert not make.dropped


def test_ranges_before_a_pause_are_a_frame_of_their_own():
    frames = list(assembler().frames([scan(0.1), ranged(0.15), scan(7200.2), ranged(7200.25), scan(7200.3)]))
    assert [f.stamp for f in frames] == [at(0.1), at(0.15), at(7200.2), at(7200.3)]
    assert [bool(f.frame.has_scan) for f in frames] == [True, False, True, True]
    assert len(taken(frames[1:2])) == 1
    assert all(f.frame.ranges.age.min() > -1.0 for f in frames)


def test_a_scan_without_a_return_amid_others_is_a_failure_and_seeing_nothing_is_none():
    make, stream = assembler(), [scan(0.1 * k) for k in range(20)]
    for k in [3, 5, *range(10, 20)]:
        stream[k] = dataclasses.replace(stream[k], ranges=np.zeros_like(stream[k].ranges))
    frames = list(make.frames(stream))
    assert make.dropped == {"scan: no return right after some that had": 6}
    assert len(frames) == 14
    assert make.blank == 6
