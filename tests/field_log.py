"""A small recording of a robot in the small room, as messages whose every field a test can spoil, and its frames."""

from __future__ import annotations

import copy
import math
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import small_room as room
import transform_log
from room_drive import BEACONS, pose_at
from rosbags.typesys.store import Typestore

from uwbslam_jax import api
from uwbslam_jax.files import ros_types
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.session.frame_assembler import FrameAssembler
from uwbslam_jax.session.losses import losses
from uwbslam_jax.session.runner import fit_beams
from uwbslam_jax.settings import Settings, make_config

T0 = 1_700_000_000_000_000_000
S = 1_000_000_000
LONG = 5 * S
"""Of the drive [ns]."""
HALF = T0 + LONG // 2
"""Middle of the drive [ns]: most faults begin there."""
BEAMS = 120
SCAN, UWB, ODOM, STATIC = "/scan", "/uwb/ranges", "/odom", "/tf_static"


@dataclass
class Row:
    """A message as its driver publishes it.

    Attributes:
      log: what the recorder's clock says when it arrives [ns]. arrival: when it arrives [ns], which orders the file.
    """

    topic: str
    log: int
    message: Any
    arrival: int = 0

    def __post_init__(self) -> None:
        self.arrival = self.log

    @property
    def stamp(self) -> int:
        """Of its header [ns]."""
        time = self.message.header.stamp
        return time.sec * S + time.nanosec

    @stamp.setter
    def stamp(self, ns: int) -> None:
        self.message.header.stamp = ros_types.time(ns)

    def later(self, ns: int, log: bool = True) -> None:
        """Moves its stamp, and its log time."""
        self.stamp += ns
        self.log += ns * log


Rows = list[Row]


def of(rows: Rows, topic: str) -> Rows:
    return [row for row in rows if row.topic == topic]


def _scan(rng: np.random.Generator, pose: np.ndarray, stamp: int) -> Any:
    step = 2 * math.pi / BEAMS
    seen = room.cast(pose[:2], pose[2] - math.pi + step * np.arange(BEAMS))
    return ros_types.build(
        "sensor_msgs/msg/LaserScan",
        header=ros_types.header(stamp, "laser"),
        angle_min=-math.pi,
        angle_max=math.pi - step,
        angle_increment=step,
        time_increment=0.08 / BEAMS,
        scan_time=0.1,
        range_min=0.1,
        range_max=30.0,
        ranges=(seen + 0.01 * rng.normal(size=BEAMS)).astype(np.float32),
        intensities=np.zeros(0, np.float32),
    )


def odometry(stamp: int, pose: tuple[float, float, float]) -> Any:
    return ros_types.build(
        "nav_msgs/msg/Odometry",
        header=ros_types.header(stamp, "odom"),
        child_frame_id="base_link",
        pose=ros_types.build(
            "geometry_msgs/msg/PoseWithCovariance", pose=ros_types.pose(*pose), covariance=np.zeros(36)
        ),
        twist=ros_types.build(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=ros_types.build(
                "geometry_msgs/msg/Twist", linear=ros_types.vector("Vector3"), angular=ros_types.vector("Vector3")
            ),
            covariance=np.zeros(36),
        ),
    )


def wheels(t: float) -> tuple[float, float, float]:
    """Pose by odometry after a time [s]: its own frame begins where the robot does."""
    a, b = pose_at(0.0), pose_at(t)
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = (b - a)[:2].tolist()
    return c * dx + s * dy, c * dy - s * dx, math.remainder(float(b[2] - a[2]), 2 * math.pi)


@cache
def _drive(seconds: int) -> Rows:
    rng, rows = np.random.default_rng(4), []
    for k in range(10 * seconds):
        stamp = T0 + k * S // 10
        rows.append(Row(SCAN, stamp + 2_000_000, _scan(rng, pose_at(k / 10), stamp)))
        nodes = {0: pose_at(k / 10 + 0.05)[:2], **BEACONS} if k % 2 else {}
        for n, (a, b) in enumerate((a, b) for a in nodes for b in nodes if a < b):
            at = stamp + 50_000_000 + n * 1_000_000
            measured = float(np.hypot(*(nodes[a] - nodes[b])) + 0.03 * rng.normal())
            fields = {"source": a, "target": b, "range": measured, "receive_power": -80.0, "first_path_power": -81.0}
            message = ros_types.build(ros_types.UWB_RANGE, header=ros_types.header(at, "uwb"), **fields)
            rows.append(Row(UWB, at + 1_000_000, message))
    return sorted(rows, key=lambda row: row.log)


@cache
def _wheels() -> Rows:
    times = [T0 + k * S // 20 for k in range(100)]
    return [Row(ODOM, at + 500_000, odometry(at, wheels((at - T0) / S))) for at in times]


def drive(seconds: int = LONG // S, *, with_wheels: bool = False) -> Rows:
    """Scans at 10 Hz, ranges at 5 Hz of all pairs of the robot and three beacons, wheels at 20 Hz for the first five
    seconds if wanted; to be changed as one likes."""
    return copy.deepcopy(_drive(seconds) + (_wheels() if with_wheels else []))


def still(turn: transform_log.Turn, frame: str = "laser") -> Row:
    """/tf_static: a scanner on the robot's middle, turned by roll, pitch, yaw [rad]."""
    return Row(STATIC, T0, transform_log.transform(T0, "base_link", frame, (0.0, 0.0, 0.2), turn))


@dataclass
class Heard:
    """What reaches the estimator of a recording, and what a user is told.

    Attributes:
      settings: as the recording makes them.
      frames: in their order. told: warnings. dropped: losses by reason. inspected: what `inspect` says, as text.
    """

    settings: Settings
    frames: list[StampedFrame]
    told: list[str]
    dropped: Counter[str]
    inspected: str


def hear(path: Path, settings: Settings | None = None) -> Heard:
    """Reads a recording as a run does, up to its frames."""
    source, chosen = api._opened(path, settings or Settings())
    chosen = fit_beams(chosen, source)
    assembler = FrameAssembler(chosen, make_config(chosen).max_ranges)
    frames = list(assembler.frames(source))
    assert isinstance(source, api.Recording)
    dropped = source.dropped + assembler.dropped
    told = [*source.warnings, *assembler.warnings, *assembler.missing(), *assembler.wheels.told()]
    told += losses(assembler.used, dropped).values()
    return Heard(chosen, frames, told, dropped, str(api.inspect(path, settings)))


def written(path: Path, rows: Rows, store: Typestore = ros_types.STORE) -> Path:
    """A recording of these rows in the order of their arrival; store: with their types."""
    ordered = sorted(rows, key=lambda row: row.arrival)
    return transform_log.write(path, [(row.topic, row.log, row.message) for row in ordered], store)


def points(heard: Heard, frame: StampedFrame) -> np.ndarray:
    """(n, 3) of the readings that are valid, by bearing on the robot: bearing [rad], range [m], time about the sweep's
    middle [s]."""
    scan, robot = frame.frame.scan, heard.settings.robot
    k = np.arange(len(scan.ranges))
    turn = robot.lidar[2] + float(scan.angle_min) + float(scan.angle_increment) * k
    bearing = np.mod(turn + 1e-3, 2 * math.pi) - 1e-3
    time = float(scan.time_increment) * k
    rows = np.stack([bearing, scan.ranges, time - time.mean()], axis=-1)[scan.valid]
    return rows[np.argsort(rows[:, 0])]
