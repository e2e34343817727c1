"""Odometry whose origin jumps goes on; what a robot can do is passed on as it is."""

from __future__ import annotations

import numpy as np
import pytest

from uwbslam_jax.measurements import OdometryMessage
from uwbslam_jax.numerics import between, wrapped
from uwbslam_jax.session.odometry_track import OdometryTrack

START = 1_700_000_000_000_000_000
EVERY = 0.05


def drive(seconds: np.ndarray) -> np.ndarray:
    """(n, 3) an arc of 1 m radius at 0.8 m/s, away from zero at first [m, m, rad]."""
    angle = 0.8 * seconds
    return np.stack([np.sin(angle), 1.0 - np.cos(angle), wrapped(angle)], axis=-1)


def messages(poses: np.ndarray, seconds: np.ndarray) -> list[OdometryMessage]:
    return [OdometryMessage(START + round(t * 1e9), *p) for t, p in zip(seconds.tolist(), poses.tolist(), strict=True)]


def joined(stream: list[OdometryMessage]) -> tuple[np.ndarray, np.ndarray, OdometryTrack]:
    """Poses (n, 3), whether an increment leads to each, and the track."""
    track = OdometryTrack()
    found = [track.join(m) for m in stream]
    return np.array([(m.x, m.y, m.yaw) for m, _ in found]), np.array([ok for _, ok in found]), track


def steps(poses: np.ndarray) -> np.ndarray:
    found = between(poses[:-1], poses[1:])
    found[:, 2] = wrapped(found[:, 2])
    return found


TIMES = np.arange(0.0, 20.0, EVERY)


@pytest.mark.parametrize("every", [1, 2, 20])
@pytest.mark.parametrize("late", [0.0, 0.04])
def test_a_drive_is_passed_on_as_it_is(every: int, late: float) -> None:
    """However slow the odometry, however late its stamps, whatever is missing of it, and fast as a robot starts."""
    rng = np.random.default_rng(2)
    times = TIMES[::every]
    stamps = np.maximum.accumulate(times + late * rng.random(len(times))) + 1e-4 * np.arange(len(times))
    stream = messages(drive(times), stamps)
    kept = [m for k, m in enumerate(stream) if not 50 // every < k < 90 // every]
    track = OdometryTrack()
    assert all(track.join(m)[0] is m for m in kept)
    assert not track.told()
    fast = messages(np.stack([3.0 * times, 0 * times, 0 * times], axis=-1), times)
    track = OdometryTrack()
    assert all(track.join(m)[0] is m for m in fast)


@pytest.mark.parametrize("at", [3.0, 7.4, 15.0])
def test_a_restart_at_zero_goes_on_from_where_it_was(at: float) -> None:
    poses = drive(TIMES)
    k = round(at / EVERY)
    poses[k:] = between(np.broadcast_to(poses[k], poses[k:].shape), poses[k:])
    found, ok, track = joined(messages(poses, TIMES))
    assert ok[1:].all()
    assert track.jumps == 1
    assert f"after {at:.1f} s" in track.told()[0]
    np.testing.assert_allclose(steps(found), steps(drive(TIMES)), atol=1e-3)


def test_a_jump_anywhere_and_back_goes_on() -> None:
    poses = drive(TIMES)
    poses[200] += (5.0, 0.0, 0.0)
    found, _, track = joined(messages(poses, TIMES))
    assert track.jumps == 2
    np.testing.assert_allclose(steps(found), steps(drive(TIMES)), atol=2e-3)


def test_a_restart_after_a_pause_begins_a_new_track() -> None:
    poses = drive(TIMES)
    poses[260:] = between(np.broadcast_to(poses[260], poses[260:].shape), poses[260:])
    stream = messages(poses, TIMES)
    _, ok, track = joined(stream[:200] + stream[260:])
    assert track.jumps == 1
    assert np.flatnonzero(~ok).tolist() == [0, 200]


def test_millimetres_are_told_as_such() -> None:
    _, _, track = joined(messages(drive(TIMES) * (1000.0, 1000.0, 1.0), TIMES))
    assert "are its positions in m" in track.told()[0]


def test_of_positions_in_centimetres_no_increment_is_left() -> None:
    _, ok, track = joined(messages(drive(TIMES) * [100.0, 100.0, 1.0], TIMES))
    assert not ok[10:].any()
    assert "are its positions in m" in track.told()[0]
