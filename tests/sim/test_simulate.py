"""The simulator against analytic cases, slow second implementations and the statistics that its knobs promise.

Tolerances in sigma are four standard errors: one false alarm in 16 000, and the seeds are fixed.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from uwbslam_jax.measurements import OdometryMessage, RangeMessage, ScanMessage, TruthMessage
from uwbslam_jax.sim import (
    SCENARIOS,
    START_NS,
    Scenario,
    beacon_positions,
    make_scenario,
    rays,
    scan_ranges,
    settings_overrides,
    simulate,
    worlds,
)
from uwbslam_jax.sim.paths import Along, Carried, Path, Rest, Track, Turn

ready = cache(make_scenario)
WITHOUT_SCANS = 1e-3
"""A scan rate [Hz] at which tests of the ranges do not wait for ray casting."""


def ranges_of(made: Scenario) -> list[RangeMessage]:
    made = replace(made, lidar=replace(made.lidar, rate=WITHOUT_SCANS))
    return [m for m in simulate(made) if isinstance(m, RangeMessage)]


def seconds(stamps: list[int]) -> np.ndarray:
    return np.array([(s - START_NS) / 1e9 for s in stamps])


def true_distances(made: Scenario, messages: list[RangeMessage]) -> np.ndarray:
    """Distance between the antennas of each exchange [m], by complex numbers instead of the simulator's matrices."""
    t = seconds([m.stamp for m in messages])
    x, y, z = made.uwb.antenna
    px, py, yaw = made.path.pose(t).T
    robot = (px + 1j * py + complex(x, y) * np.exp(1j * yaw), z)
    places = {made.uwb.robot_id: robot}
    for b in made.beacons:
        places[b.id] = (beacon_positions(made, b, t) @ np.array([1.0, 1.0j]), b.height)
    result = []
    for k, m in enumerate(messages):
        (source, low), (target, high) = places[m.source], places[m.target]
        result.append(np.hypot(abs(source[k] - target[k]), high - low))
    return np.array(result)


def slow_cast(segments: np.ndarray, origins: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Every ray against every segment, one 2 x 2 system each."""
    result = np.full(angles.size, np.inf)
    for k, (origin, angle) in enumerate(zip(origins, angles, strict=True)):
        direction = np.array([np.cos(angle), np.sin(angle)])
        for x1, y1, x2, y2 in segments:
            A = np.array([direction, [x1 - x2, y1 - y2]]).T
            if abs(np.linalg.det(A)) > 1e-12:
                r, u = np.linalg.solve(A, np.array([x1, y1]) - origin)
                if r > 0.0 and -1e-9 <= u <= 1.0 + 1e-9:
                    result[k] = min(result[k], r)
    return result


# LiDAR ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", [0.0, 0.04, 0.5])
def test_cast_equals_a_slow_one(spread: float) -> None:
    world = ready("hall", 3).world
    rng = np.random.default_rng(1)
    angles = 1.7 + np.sort(rng.uniform(0.0, 1.5 * np.pi, 60))
    origins = world.lap[0] + spread * rng.uniform(-1.0, 1.0, (60, 2))
    expected = slow_cast(world.segments, origins, angles)
    # The slow solver's own rounding at grazing incidence is below 1e-9 m.
    np.testing.assert_allclose(rays.cast(world.segments, origins, angles), expected, rtol=0, atol=1e-9)


def test_scan_noise_has_its_sigma() -> None:
    made = make_scenario("hall", 2, duration_s=3.0)
    scans = [m for m in simulate(made) if isinstance(m, ScanMessage)]
    assert len(scans) == 30
    error = np.concatenate([m.ranges - scan_ranges(made, float(seconds([m.stamp])[0])) for m in scans])
    error = error[np.isfinite(error)]
    assert abs(error.mean()) < 4 * 0.01 / np.sqrt(error.size)
    assert abs(error.std() - 0.01) < 4 * 0.01 / np.sqrt(2 * error.size)


def test_each_beam_of_a_sweep_is_cast_from_its_own_pose() -> None:
    made = ready("fast", 1)
    times = np.arange(4.0, 60.0, 0.1)
    pose = made.path.pose(times)
    t = float(times[np.argmax(np.abs(np.gradient(pose[:, 2])))])  # in a turn
    swept = scan_ranges(made, t)
    beams = np.arange(0, 1081, 27)
    own = made.path.pose(t + beams * made.lidar.time_increment)
    angles = own[:, 2] - 0.75 * np.pi + beams * np.deg2rad(0.25)
    np.testing.assert_allclose(swept[beams], slow_cast(made.world.segments, own[:, :2], angles), rtol=0, atol=1e-9)
    at_once = scan_ranges(replace(made, lidar=replace(made.lidar, time_increment=0.0)), t)
    assert np.median(np.abs(swept - at_once)) > 0.01


def test_lidar_is_mounted_where_it_says() -> None:
    made = ready("lever_arms", 1)
    x, y, yaw = made.path.pose(np.zeros(1))[0]
    at = complex(x, y) + 0.3 * np.exp(1j * yaw)
    origins = np.tile([at.real, at.imag], (40, 1))
    angles = yaw + np.deg2rad(10.0) - 0.75 * np.pi + np.arange(0, 1080, 27) * np.deg2rad(0.25)
    expected = slow_cast(made.world.segments, origins, angles)
    np.testing.assert_allclose(scan_ranges(made, 0.0)[np.arange(0, 1080, 27)], expected, rtol=0, atol=1e-9)


def test_reach_and_blinding_leave_no_return() -> None:
    made = make_scenario("corridor", 1, duration_s=1.0)
    made = replace(made, lidar=replace(made.lidar, blind=((0.5, 0.8),)))
    scans = [m for m in simulate(made) if isinstance(m, ScanMessage)]
    assert all(np.all((m.ranges <= 6.0) | np.isinf(m.ranges)) for m in scans)
    assert [bool(np.isinf(m.ranges).all()) for m in scans] == [k in (5, 6, 7) for k in range(10)]


def test_beams_are_lost_more_often_where_a_wall_is_seen_flat() -> None:
    made = make_scenario("corridor", 3, duration_s=6.0)
    made = replace(made, lidar=replace(made.lidar, reach=np.inf, dropout=0.02, grazing=0.2))
    lost, flat = [], []
    for m in simulate(made):
        if isinstance(m, ScanMessage):
            t = float(seconds([m.stamp])[0])
            pose = made.path.pose(np.array([t]))[0]  # at rest: a corridor's walls lie along it
            along = pose[2] + 0.75 * np.pi * np.linspace(-1.0, 1.0, 1081) - made.path.pose(np.zeros(1))[0, 2]
            lost.append(np.isinf(m.ranges))
            flat.append(np.abs(np.sin(along)))
            if len(lost) == 35:
                break
    share, angle = np.mean(lost, axis=0), flat[0]
    steep, shallow = (angle > 0.35) & (angle < 0.9), (angle > 0.08) & (angle < 0.14)
    assert abs(share[steep].mean() - 0.02) < 4 * np.sqrt(0.02 / (35 * steep.sum()))
    assert share[shallow].mean() > 0.3  # 1 - asin(0.11) / 0.2 = 0.45


def test_devices_count_in_steps_and_start_late_by_their_jitter() -> None:
    made = make_scenario("hall", 3, duration_s=3.0)
    stamps, readings = [], []
    for m in simulate(made):
        if isinstance(m, ScanMessage):
            stamps.append(m.stamp)
            readings.append(m.ranges[np.isfinite(m.ranges)])
        elif isinstance(m, RangeMessage):
            assert abs(m.range * 100 - round(m.range * 100)) < 1e-4
    counts = np.concatenate(readings).astype(float) * 1000
    assert np.abs(counts - np.round(counts)).max() < 2e-3  # float32 holds 15 m to 1 micrometre
    late = seconds(stamps) - np.arange(30) / 10
    assert 0.0 <= late.min() < 0.0005 < 0.0015 < late.max() < 0.002


def test_exchanges_fail_now_and_then() -> None:
    made = make_scenario("hall", 1, duration_s=30.0)
    whole = ranges_of(replace(made, uwb=replace(made.uwb, loss=0.0)))
    kept = len(ranges_of(made)) / len(whole)
    assert abs(kept - 0.98) < 4 * np.sqrt(0.98 * 0.02 / len(whole))


# UWB -----------------------------------------------------------------------------------------------------------------


def test_ranges_scatter_about_the_distance_between_antennas() -> None:
    made = make_scenario("lever_arms", 4, duration_s=30.0)
    messages = ranges_of(replace(made, uwb=replace(made.uwb, loss=0.0)))
    assert len(messages) == 15 * 299
    error = np.array([m.range for m in messages]) - true_distances(made, messages)
    assert abs(error.mean()) < 4 * 0.1 / np.sqrt(error.size)
    assert abs(error.std() - 0.1) < 4 * 0.1 / np.sqrt(2 * error.size)
    gap = np.array([m.receive_power - m.first_path_power for m in messages])
    assert np.mean(gap > 10.0) < 0.03


def test_pairs_of_a_round_are_3_ms_apart() -> None:
    made = make_scenario("hall", 1, duration_s=2.0)
    stamps = [m.stamp for m in ranges_of(replace(made, uwb=replace(made.uwb, jitter=0.0, loss=0.0)))]
    assert set(np.diff(stamps[:15])) == {3_000_000}
    assert stamps[15] - stamps[0] == 100_000_000


def test_walls_lengthen_only_what_they_block() -> None:
    blocked_made = make_scenario("nlos", 5, duration_s=40.0)
    # unrounded, so that the least excess shows
    blocked_made = replace(blocked_made, uwb=replace(blocked_made.uwb, quantum=0.0, nlos_detectable=0.95))
    clear_made = replace(blocked_made, uwb=replace(blocked_made.uwb, nlos=False))
    blocked, clear = ranges_of(blocked_made), ranges_of(clear_made)
    excess = np.array([b.range - c.range for b, c in zip(blocked, clear, strict=True)])
    beacons = {b.id: b.position for b in blocked_made.beacons}
    assert np.all(excess >= 0.0)
    wall = excess > 0.0
    for m, seen in list(zip(blocked, wall, strict=True))[::31]:  # by a ray from one end instead of the crossing test
        x, y, _ = blocked_made.path.pose(seconds([m.stamp]))[0]
        ends = [np.array(beacons.get(n, (x, y))) for n in (m.source, m.target)]
        to = ends[1] - ends[0]
        hit = rays.cast(blocked_made.world.segments, ends[0], np.array([np.arctan2(to[1], to[0])]))
        assert seen == (hit[0] < np.hypot(*to))
    assert 0.05 < wall.mean() < 0.9
    assert abs(excess[wall].mean() - 0.8) < 4 * 0.8 / np.sqrt(wall.sum())  # an exponential's std is its mean
    gap = np.array([m.receive_power - m.first_path_power for m in blocked])
    assert abs(np.mean(gap[wall] > 10.0) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / wall.sum())


def test_a_knob_leaves_the_other_numbers_alone() -> None:
    made = make_scenario("hall", 6, duration_s=3.0)

    def by_exchange(**knobs: object) -> dict[tuple[int, int, int], tuple[float, float]]:
        messages = ranges_of(replace(made, uwb=replace(made.uwb, **knobs)))
        return {(m.stamp, m.source, m.target): (m.range, m.receive_power) for m in messages}

    base = by_exchange()
    for knobs in ({"beacon_pairs": False}, {"reach": 8.0}, {"silent": ((1.0, 2.0),)}, {"outliers": 0.0}):
        fewer = by_exchange(**knobs)
        assert fewer.items() <= base.items()
        assert len(fewer) < len(base) or "outliers" in knobs
    long = by_exchange(outliers=0.3)
    changed = [long[k][0] - base[k][0] for k in base if long[k] != base[k]]
    assert 1.0 <= min(changed) <= max(changed) <= 10.0
    assert abs(len(changed) / len(base) - 0.3) < 4 * np.sqrt(0.3 * 0.7 / len(base))


@pytest.mark.parametrize("seed", [0, 1])
def test_early_locks_hit_one_beacon_in_its_stretches(seed: int) -> None:
    made = ready("early", seed)
    (begin, end), node, share = made.uwb.early[0], made.uwb.early_node, made.uwb.early_share
    messages = ranges_of(replace(made, duration=60.0))
    short = np.array([m.range for m in messages]) - true_distances(made, messages) < -0.6  # 6 sigma
    t = seconds([m.stamp for m in messages])
    suspect = np.array([node in (m.source, m.target) for m in messages]) & (t >= begin) & (t < end)
    assert end - begin == 30.0
    assert not short[~suspect].any()
    assert abs(short[suspect].mean() - share) <= 4 * np.sqrt(share * (1 - share) / suspect.sum())


def test_special_radios() -> None:
    assert all(np.isnan(m.receive_power) for m in ranges_of(make_scenario("nlos_silent", 1, 2.0)))
    assert all(m.source == 0 for m in ranges_of(make_scenario("robot_only", 1, 2.0)))
    t = seconds([m.stamp for m in ranges_of(replace(make_scenario("uwb_silent", 1), duration=92.0))])
    assert not np.any((t >= 60.0) & (t < 90.0))
    assert t.max() > 91.0
    biased = make_scenario("biased", 1, duration_s=30.0)
    assert np.sqrt(np.mean(np.square(list(biased.uwb.bias.values())))) == pytest.approx(0.15)
    messages = ranges_of(biased)
    error = np.array([m.range for m in messages]) - true_distances(biased, messages)
    expected = np.array([biased.uwb.bias[m.source] + biased.uwb.bias[m.target] for m in messages])
    assert abs(np.mean(error - expected)) < 4 * 0.1 / np.sqrt(error.size)
    scaled = make_scenario("scale", 1, duration_s=30.0)
    messages = ranges_of(scaled)
    ratio = np.array([m.range for m in messages]) / true_distances(scaled, messages)
    assert np.median(ratio) == pytest.approx(1.07, abs=0.003)
    office = ready("office", 1)
    messages = ranges_of(replace(office, duration=20.0))
    assert true_distances(office, messages).max() <= 25.0


def test_the_papers_schedule() -> None:
    made = ready("schedule", 2)
    t = defaultdict(list)
    for m in ranges_of(replace(made, duration=80.0)):
        t[m.source].append(m.stamp)
        t[m.target].append(m.stamp)
    t = {node: seconds(stamps) for node, stamps in t.items()}
    assert t[5].min() == pytest.approx(13.5, abs=0.11)
    assert not np.any((t[3] > 31.1) & (t[3] < 46.6))
    assert {1, 2, 4} <= t.keys()
    assert all(np.diff(np.unique(t[n])).max() < 0.11 for n in (1, 2, 4))
    beacons = {b.id: b for b in made.beacons}
    for number, begin, end in ((5, 13.5, 31.1), (3, 46.6, 62.6)):
        times = np.arange(begin, end, 0.05)
        carried, robot = beacon_positions(made, beacons[number], times), made.path.pose(times - 1.0)
        distance = np.hypot(*(carried - robot[:, :2]).T)
        assert distance.min() > 0.3
        assert distance.max() < 0.8
        assert np.hypot(*np.diff(carried, axis=0).T).max() < 0.15  # 3 m/s
        rest = beacon_positions(made, beacons[number], np.array([end, end + 0.01, 149.0]))
        np.testing.assert_allclose(rest, np.tile(rest[0], (3, 1)), atol=1e-12)


def test_frame_beacons_are_moved_then_switched_off() -> None:
    made = ready("frame_moved", 1)
    moved = [b for b in made.beacons if b.moves]
    first = min(made.beacons, key=lambda b: b.id)
    away = {b.id: float(np.hypot(*np.subtract(b.position, first.position))) for b in made.beacons}
    assert {b.id for b in moved} == {first.id, max(away, key=lambda node: away[node])}
    for beacon in moved:
        track = beacon_positions(made, beacon, np.arange(0.0, 150.0, 0.1))
        assert np.hypot(*(track[-1] - track[0])) > 0.5
        assert np.hypot(*np.diff(track, axis=0).T).max() < 0.4
        np.testing.assert_allclose(track[-1], beacon.moves[0].to, atol=1e-12)  # type: ignore[union-attr]


# Paths and worlds ----------------------------------------------------------------------------------------------------


def test_a_rounded_square_is_closed_and_smooth() -> None:
    track = Track(np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0]]), radius=1.0, closed=True)
    ends = track.pose(np.array([0.0, track.length]))
    np.testing.assert_allclose(ends[1] - ends[0], [0.0, 0.0, 2.0 * np.pi], atol=1e-9)
    s = np.linspace(0.0, 2.0 * track.length, 20_000)
    pose, ds = track.pose(s), s[1]
    curvature = np.diff(pose[:, 2]) / ds
    assert np.abs(curvature).max() <= 1.0 + 1e-6
    # A chord of the 5 mm table is shorter than its arc by 1e-6 of it.
    np.testing.assert_allclose(np.hypot(*np.diff(pose[:, :2], axis=0).T), ds, rtol=1e-4)
    along = np.arctan2(*np.diff(pose[:, :2], axis=0).T[::-1])
    off = np.angle(np.exp(1j * (along - 0.5 * (pose[1:, 2] + pose[:-1, 2]))))
    assert np.abs(off).max() < 0.01  # the robot faces where it drives


def test_speed_and_acceleration_keep_their_limits() -> None:
    track = Track(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]), radius=1.2)
    path = Path(
        [Rest(1.0), Along(track, 0.0, 0.5), Turn(1.0), Turn(-1.0), Along(track, 0.5, 12.0), Along(track, 12, 9)]
    )
    t = np.arange(0.0, path.duration + 1.0, 0.001)
    pose = path.pose(t)
    speed = np.hypot(*np.diff(pose[:, :2], axis=0).T) / 0.001
    assert speed.max() == pytest.approx(0.8, abs=1e-6)
    assert np.abs(np.diff(speed) / 0.001).max() < 1.01  # the table's chords wobble by 1e-5 m/s
    assert np.abs(np.diff(pose[:, 2])).max() / 0.001 < np.pi / 2 + 1e-6
    np.testing.assert_allclose(pose[-1], track.pose(np.array([9.0]))[0], atol=1e-9)
    with pytest.raises(ValueError, match="piece 1"):
        Path([Along(track, 0.0, 3.0), Along(track, 4.0, 5.0)])


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", SCENARIOS)
def test_ready_made_laps_are_free(name: str, seed: int) -> None:
    made = ready(name, seed)
    t = np.arange(0.0, made.duration, 0.2)
    pose = made.path.pose(t)
    starts = np.concatenate([[0.0], np.cumsum([p.duration for p in made.path.pieces])])
    on_wheels = np.ones(t.size, bool)
    for piece, begin in zip(made.path.pieces, starts, strict=False):
        if isinstance(piece, Carried):
            on_wheels &= (t < begin - 0.2) | (t > begin + piece.duration + 0.2)
            unseen = [*made.lidar.blind, *([made.pause[:2]] if made.pause else [])]
            assert any(b <= begin and begin + piece.duration <= e + 1e-9 for b, e in unseen)
    both = on_wheels[1:] & on_wheels[:-1]
    step = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    assert np.all(step[both] <= 0.2 * made.path.speed + 1e-9)
    assert np.abs(np.diff(pose[:, 2]))[both].max() < 0.2 * 2.0  # nobody turns faster than 115 degrees a second
    assert np.hypot(*np.ptp(pose[:, :2], axis=0)) > 5.0
    assert rays.point_segment_distance(pose[on_wheels, :2], made.world.segments).min() > 0.25
    assert not rays.blocked(made.world.segments, pose[:-1, :2][both], pose[1:, :2][both]).any()
    if name not in ("office", "large"):
        assert worlds.free(made.world, pose[on_wheels, :2]).all()
    places = np.concatenate([beacon_positions(made, b, t[::10]) for b in made.beacons])
    assert worlds.inside(made.world.outline, places).all()
    rest = pose[t < 0.5]
    np.testing.assert_array_equal(rest, np.tile(rest[0], (len(rest), 1)))


def test_seeds_make_different_places() -> None:
    for name in ("workshop", "hall", "corridor_recess", "office"):
        a, b = ready(name, 0), ready(name, 1)
        assert a.world.segments.shape != b.world.segments.shape or not np.allclose(a.world.segments, b.world.segments)
        assert a.beacons != b.beacons
    directions = set()
    for seed in range(2):
        yaw = ready("hall", seed).path.pose(np.array([0.0, 149.0]))[:, 2]
        directions.add(np.sign(yaw[1] - yaw[0]))
    assert directions == {-1.0, 1.0}


def test_a_swaying_driver_keeps_his_arc_length_and_faces_where_he_drives() -> None:
    square = np.array([[0.0, 0.0], [18.0, 0.0], [18.0, 12.0], [0.0, 12.0]])
    for straight in (Track(square, 1.2, closed=True), Track(square[:2], 1.0)):
        track = straight.swayed(0.2, np.random.default_rng(2))
        s = np.linspace(0.0, track.length, 4000)
        pose, step = track.pose(s), s[1]
        aside = pose[:, :2] - straight.pose(s * straight.length / track.length)[:, :2]
        assert np.hypot(*aside.T).max() > 0.15
        np.testing.assert_allclose(np.hypot(*np.diff(pose[:, :2], axis=0).T), step, rtol=1e-3)
        along = np.arctan2(*np.diff(pose[:, :2], axis=0).T[::-1])
        assert np.abs(np.angle(np.exp(1j * (along - 0.5 * (pose[1:, 2] + pose[:-1, 2]))))).max() < 0.02
        turned = straight.pose(np.array([0.0, straight.length]))
        np.testing.assert_allclose(np.diff(pose[[0, -1]], axis=0), np.diff(turned, axis=0), atol=1e-9)


def test_the_corridor_is_driven_swaying_over_its_whole_length() -> None:
    for seed in range(5):
        made = ready("corridor", seed)
        pose = made.path.pose(np.arange(0.0, made.duration, 0.1))
        wall = rays.point_segment_distance(pose[:, :2], made.world.segments).min(1)
        assert 0.15 < 1.2 - wall.min() < 0.31
        assert np.hypot(*np.ptp(pose[:, :2], axis=0)) > 19.5
        assert len(made.path.spans(Turn)) == 4


def test_twelve_metres_straight() -> None:
    made = ready("straight", 1)
    pose = made.path.pose(np.arange(0.0, 40.0, 0.02))
    turned = int(np.argmax(np.abs(pose[:, 2] - pose[0, 2]) > 1e-6))
    assert np.hypot(*(pose[turned, :2] - pose[0, :2])) == pytest.approx(12.0, abs=0.05)


def test_the_workshop_is_three_laps_in_150_s() -> None:
    made = ready("workshop", 1)
    turned = made.path.pose(np.array([0.0, 150.0]))[:, 2]
    assert abs(turned[1] - turned[0]) == pytest.approx(6.0 * np.pi, abs=1e-6)
    assert made.path.duration == pytest.approx(150.0, abs=2.0)


def test_kidnapped_is_turned_by_120_degrees_within_a_second() -> None:
    made = ready("kidnapped", 1)
    begin, end = made.lidar.blind[0]
    before, after = made.path.pose(np.array([begin, end]))
    assert end - begin == pytest.approx(1.0)
    assert np.hypot(*(after - before)[:2]) > 3.0
    assert after[2] - before[2] == pytest.approx(2.0 * np.pi / 3.0)


# Streams -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENARIOS)
def test_stamps_rise_on_each_topic(name: str) -> None:
    made = ready(name, 1)
    made = replace(made, duration=max(1.5, 1.1 / made.lidar.rate))
    stamps = defaultdict(list)
    for m in simulate(made):
        stamps[(type(m), m.node if isinstance(m, TruthMessage) else None)].append(m.stamp)
    assert all(type(s) is int for series in stamps.values() for s in series)
    assert all(np.all(np.diff(series) > 0) for series in stamps.values())
    assert stamps[(ScanMessage, None)] == stamps[(TruthMessage, None)]
    assert all(series[0] >= START_NS and series[-1] < START_NS + made.duration * 1e9 for series in stamps.values())
    assert ((OdometryMessage, None) in stamps) == (name in {"slow_lidar", "sparse"})
    for beacon in made.beacons:
        if beacon.alive[0][0] == 0.0:
            assert stamps[(TruthMessage, beacon.id)][0] == START_NS


def test_a_simulation_repeats_to_the_bit() -> None:
    first, again, other = (list(simulate(make_scenario("nlos", seed, duration_s=2.0))) for seed in (1, 1, 2))

    def flat(messages: list) -> list:
        return [(m.stamp, m.ranges.tobytes()) if isinstance(m, ScanMessage) else repr(m) for m in messages]

    assert flat(first) == flat(again)
    assert flat(first) != flat(other)


def test_truth_follows_the_path() -> None:
    made = make_scenario("hall", 3, duration_s=8.0)
    truths = [m for m in simulate(replace(made, lidar=replace(made.lidar, beams=3))) if isinstance(m, TruthMessage)]
    robot = [m for m in truths if m.node is None]
    pose = made.path.pose(seconds([m.stamp for m in robot]))
    np.testing.assert_allclose([(m.x, m.y) for m in robot], pose[:, :2], atol=1e-8)  # stamps are whole nanoseconds
    np.testing.assert_allclose(np.exp(1j * (np.array([m.yaw for m in robot]) - pose[:, 2])), 1.0, atol=1e-8)
    assert len([m for m in truths if m.node == made.beacons[0].id]) == 8


def test_odometry_drifts_by_its_scale() -> None:
    made = make_scenario("slow_lidar", 1, duration_s=90.0)
    odometry = [m for m in simulate(made) if isinstance(m, OdometryMessage)]
    xy = np.array([(m.x, m.y) for m in odometry])
    driven = np.hypot(*np.diff(xy, axis=0).T).sum()
    pose = made.path.pose(seconds([m.stamp for m in odometry]))
    true = np.hypot(*np.diff(pose[:, :2], axis=0).T).sum()
    # 5 % of noise on each of thousands of increments: along it averages to 0.1 %, across it adds 0.13 %.
    assert driven / true == pytest.approx(1.02, abs=0.005)


def test_what_a_user_would_configure() -> None:
    settings = settings_overrides(ready("lever_arms", 1))
    assert settings["robot"] == {"id": 0, "antenna": (0.0, 0.2, 0.6), "lidar": (0.3, 0.0, np.deg2rad(10.0))}
    assert settings["uwb"]["height"] == {str(b.id): 1.4 for b in ready("lever_arms", 1).beacons}
    assert settings_overrides(ready("biased", 1))["uwb"] == {"height": {}}


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="workshop"):
        make_scenario("wrokshop", 0)
