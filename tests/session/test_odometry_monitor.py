"""Odometry that contradicts the scans for seconds is left out and told with its cause; a moment's slip is not."""

from __future__ import annotations

import numpy as np
import pytest
import room_drive
from room_drive import Drive

from uwbslam_jax.measurements import Odometry
from uwbslam_jax.numerics import between, wrapped
from uwbslam_jax.session.odometry_monitor import OdometryMonitor
from uwbslam_jax.session.session import CONTROL_EVERY, Session

TRUE = np.array([0.72, 0.3, 0.8])
"""Motion of a second by the scans [m, m, rad]."""


def show(monitor: OdometryMonitor, wheels: list[np.ndarray], dt: float = 1.0) -> None:
    for k, motion in enumerate(wheels):
        monitor.judge(np.stack([motion, TRUE]) * min(dt, 1.0), dt, round(k * dt * 1e9))


@pytest.mark.parametrize("dt", [0.7, 1.0, 2.0])
@pytest.mark.parametrize(
    ("factor", "cause"),
    [
        ((0.0, 0.0, 0.0), "frozen"),
        ((1.0, 1.0, -1.0), "--robot.lidar-flip"),
        ((-1.0, -1.0, 1.0), "--robot.lidar 0 0 "),
        ((2.0, 2.0, 1.0), "2 times"),
        ((1.0, 1.0, 0.0), "heading never changes"),
        ((0.01, 0.01, 1.0), "units"),
    ],
)
def test_a_contradiction_of_seconds_is_left_out(factor: tuple[float, float, float], cause: str, dt: float) -> None:
    monitor = OdometryMonitor()
    show(monitor, [TRUE] * 4, dt)
    assert monitor.trusted
    show(monitor, [TRUE * factor] * 6, dt)
    assert not monitor.trusted
    (told,) = monitor.told()
    assert cause in told


def test_the_turn_of_a_lidar_is_named() -> None:
    monitor = OdometryMonitor()
    c, s = np.cos(0.8), np.sin(0.8)  # scans of a LiDAR turned by 0.8 rad show the robot's ways turned back
    show(monitor, [np.array([c * TRUE[0] - s * TRUE[1], s * TRUE[0] + c * TRUE[1], TRUE[2]])] * 6)
    assert "--robot.lidar 0 0 0.80" in monitor.told()[0]


@pytest.mark.parametrize("factor", [1.0, 1.2, 0.8])
def test_wheels_that_err_are_used(factor: float) -> None:
    rng = np.random.default_rng(1)
    monitor = OdometryMonitor()
    show(monitor, [TRUE * factor + 0.03 * rng.normal(size=3) for _ in range(60)])
    assert monitor.trusted
    assert not monitor.told()


def test_a_moments_slip_is_none_and_it_is_used_again_once_it_agrees() -> None:
    monitor = OdometryMonitor()
    none = np.zeros(3)
    show(monitor, [none] * 2 + [TRUE] * 2 + [none] * 2)
    assert monitor.trusted
    show(monitor, [none] * 6)
    assert not monitor.trusted
    show(monitor, [TRUE] * 9)
    assert monitor.trusted
    assert "used again" in monitor.told()[0]


def test_a_robot_at_rest_tells_nothing() -> None:
    monitor = OdometryMonitor()
    for k in range(20):
        monitor.judge(np.array([[0.0, 0.0, 0.0], [0.02, 0.01, 0.05]]), 1.0, k)
    assert monitor.trusted


@pytest.mark.slow
def test_a_run_steps_without_the_odometry_that_it_does_not_trust() -> None:
    """The same frame by frame and in groups."""

    def run(groups: bool) -> Session:
        session = Session(room_drive.SETTINGS)
        frames = Drive(session).frames(8 * CONTROL_EVERY, list(room_drive.BEACONS))
        wrong = Odometry(np.array([0.0, 0.0, 0.0], np.float32), np.bool_(True))
        frames = [type(f)(f.stamp, f.frame._replace(odometry=wrong), f.slots) for f in frames]
        for k in range(0, len(frames), CONTROL_EVERY):
            if groups:
                session.steps(frames[k : k + CONTROL_EVERY])
            else:
                for frame in frames[k : k + CONTROL_EVERY]:
                    session.step(frame)
        return session

    together, single = run(True), run(False)
    assert not together.odometry.trusted
    assert "frozen" in together.odometry.told()[0]
    room_drive.assert_same_bits(together.state, single.state)
    truth = [room_drive.pose_at(t) for t in (0.0, 7.5)]
    moved = between(np.asarray(together.history.poses)[5], np.asarray(together.history.poses)[-1])
    assert np.hypot(*(moved[:2] - between(*truth)[:2])) < 0.3
    assert abs(wrapped(moved[2] - between(*truth)[2])) < 0.1
