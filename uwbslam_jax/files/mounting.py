"""Where the sensors sit on the robot, as the transforms of a recording tell, and what the settings make of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from uwbslam_jax.files.bag import Bag
from uwbslam_jax.files.pose_messages import Transform, is_base, is_world, odometry_parts, transforms
from uwbslam_jax.files.range_messages import Options
from uwbslam_jax.files.scan_messages import frame_of
from uwbslam_jax.files.schemas import Role, plausible, unpacker
from uwbslam_jax.settings import RobotSettings, Settings

_LEVEL_RAD = math.radians(2.0)
"""A scanner tilted by less scans a plane [rad]: 1 m at 30 m, and no mounting is exact."""
_REPEATED = 500
"""Transforms at rest that are published again and again are among so many messages [messages]."""
_SAME = (0.03, 0.03)
"""A mounting that differs by less from the configured one is the same [m, rad]."""


@dataclass(frozen=True)
class LidarPlace:
    """Where a scanner sits.

    Attributes:
      frame, base: frame_id of the scanner and of the robot.
      pose: x, y, yaw on the robot [m, m, rad]; of one upside down the yaw of its bearing 0.
      flip: upside down.
      tilt: of its plane against the robot's [rad], >= 0.
    """

    frame: str
    base: str
    pose: tuple[float, float, float]
    flip: bool
    tilt: float

    def __str__(self) -> str:
        upside = ", upside down" if self.flip else ""
        return f"{self.frame} sits on {self.base} at {_text(self.pose)} (x, y [m], yaw [rad]){upside}"


@dataclass(frozen=True)
class Mounting:
    """What a recording tells, None for what it does not.

    Attributes:
      lidar: see there.
      antenna: x, y, z of the UWB radio on the robot [m].
    """

    lidar: LidarPlace | None = None
    antenna: tuple[float, float, float] | None = None

    def __str__(self) -> str:
        radio = f"the UWB radio sits at {_text(self.antenna)} (x, y, z [m])" if self.antenna else ""
        return "; ".join(filter(None, [str(self.lidar or ""), radio]))


class Frames:
    """Frames of a robot and how they hang together, gathered from transforms."""

    def __init__(self, robot: str | None):
        """robot: the robot's own frame where it is known."""
        self._robot = robot
        self._parents: dict[str, Transform] = {}
        self._moving: set[str] = set()

    def add(self, found: Iterable[Transform]) -> None:
        """Takes in transforms; a frame that moves counts as unknown."""
        for each in found:
            known = self._parents.setdefault(each.child, each)
            if not np.allclose(known.matrix, each.matrix, atol=1e-4):
                self._moving.add(each.child)

    def place(self, frame: str) -> tuple[str, np.ndarray] | None:
        """The robot's frame, and (4, 4) from a frame to it; None where no chain of resting frames leads there.

        The robot's frame is that of its odometry, else base_link or base_footprint, whichever is nearer, else the last.
        """
        chain, matrix, base = {frame}, np.eye(4), None
        while frame:
            if frame == self._robot:
                return frame, matrix
            if base is None and is_base(frame):
                base = frame, matrix
            up = self._parents.get(frame)
            if up is None or up.parent in chain or is_world(up.parent) or frame in self._moving:
                return base or ((frame, matrix) if len(chain) > 1 and up is None else None)
            chain.add(up.parent)
            frame, matrix = up.parent, up.matrix @ matrix
        return base


def read_mounting(recording: Bag, roles: Mapping[int, Role], scan_frame: str | None) -> Mounting:
    """Where the scanner of a frame_id and the radio sit, by the transforms of a recording.

    Args:
      roles: by channel, of those that are used.
    """
    radio_frames = {frame_of(message) for message in _first(recording, roles, "uwb", 20)}
    wheels = [part for message in _first(recording, roles, "odom", 1) for part in odometry_parts(message)]
    robot, radio = wheels[0].child_frame_id.lstrip("/") if wheels else "", max(radio_frames, default="")
    wanted = [frame for frame in {scan_frame, radio} if frame]
    frames = Frames(robot or None)
    of_tf = {n: "tf" for n, channel in recording.channels.items() if plausible(channel, "tf", Options()) is not None}
    static = {n for n in of_tf if recording.channels[n].topic.endswith("_static")}
    for numbers, most in ((static, sum(recording.counts[n] for n in static)), (set(of_tf) - static, _REPEATED)):
        missing = any(frames.place(frame) is None for frame in wanted)
        for message in _first(recording, dict.fromkeys(numbers, "tf"), "tf", most) if missing else ():
            frames.add(transforms(message))
    place = frames.place(scan_frame) if scan_frame else None
    at = frames.place(radio) if radio and len(radio_frames) == 1 else None
    antenna = at is not None and (is_base(at[0]) or at[0] == robot or (place is not None and at[0] == place[0]))
    return Mounting(
        lidar_place(scan_frame, *place) if scan_frame and place else None,
        antenna_place(at[1]) if at and antenna else None,
    )


def _first(recording: Bag, roles: Mapping[int, Role], role: Role, most: int) -> Iterator[Any]:
    """The first messages of a role that can be read, unpacked."""
    unpack = {number: unpacker(recording.channels[number], role) for number in roles if roles[number] == role}
    spoken = {number for number in unpack if recording.counts[number]}
    for _, number, data in islice(recording.records(spoken) if spoken else (), most):
        message = unpack[number](data)
        if message is not None:
            yield message


def lidar_place(frame: str, base: str, matrix: np.ndarray) -> LidarPlace:
    """How a scanner scans whose frame is taken to the robot's by a (4, 4)."""
    x, y, yaw = matrix[0, 3], matrix[1, 3], math.atan2(matrix[1, 0], matrix[0, 0])
    tilt = math.acos(min(abs(float(matrix[2, 2])), 1.0))
    return LidarPlace(frame, base, (_rounded(x), _rounded(y), _rounded(yaw)), bool(matrix[2, 2] < 0.0), tilt)


def antenna_place(matrix: np.ndarray) -> tuple[float, float, float]:
    """Where a radio sits whose frame is taken to the robot's by a (4, 4) [m]."""
    return _rounded(matrix[0, 3]), _rounded(matrix[1, 3]), _rounded(matrix[2, 3])


def mounted(settings: Settings, mounting: Mounting) -> Settings:
    """Settings with what a recording tells of the sensors' places, where these are not configured."""
    robot, usual = settings.robot, RobotSettings()
    changed: dict[str, object] = {}
    if mounting.lidar is not None and (robot.lidar, robot.lidar_flip) == (usual.lidar, usual.lidar_flip):
        changed |= {"lidar": mounting.lidar.pose, "lidar_flip": mounting.lidar.flip}
    if mounting.antenna is not None and robot.antenna == usual.antenna:
        changed |= {"antenna": mounting.antenna}
    return dataclasses.replace(settings, robot=dataclasses.replace(robot, **changed)) if changed else settings


def contradictions(settings: Settings, mounting: Mounting) -> list[str]:
    """Where what is configured is not what a recording tells, and what no setting can express; one line each."""
    robot, found = settings.robot, []
    lidar = mounting.lidar
    if lidar is not None:
        apart = math.hypot(lidar.pose[0] - robot.lidar[0], lidar.pose[1] - robot.lidar[1])
        turned = abs(math.remainder(lidar.pose[2] - robot.lidar[2], 2 * math.pi))
        if apart > _SAME[0] or turned > _SAME[1] or lidar.flip != robot.lidar_flip:
            flip = "--robot.lidar-flip" if lidar.flip else "--robot.no-lidar-flip"
            found.append(
                f"the recording's transforms say that {lidar}, robot.lidar says {_text(robot.lidar)}"
                f"{', upside down' if robot.lidar_flip else ''}, which is used; else give "
                f"--robot.lidar {_text(lidar.pose)} {flip}"
            )
        if lidar.tilt > _LEVEL_RAD:
            found.append(
                f"{lidar.frame} is tilted by {math.degrees(lidar.tilt):.0f} deg against {lidar.base}: its scans are "
                "taken as level, walls come out too far; mount it level, or leave it out"
            )
    if mounting.antenna is not None and math.dist(mounting.antenna[:2], robot.antenna[:2]) > _SAME[0]:
        found.append(
            f"the recording's transforms say that the UWB radio sits at {_text(mounting.antenna)}, robot.antenna says "
            f"{_text(robot.antenna)}, which is used; else give --robot.antenna {_text(mounting.antenna)}"
        )
    return found


def _rounded(value: float) -> float:
    """Without what the arithmetic of rotations leaves [m, rad]."""
    return round(float(value), 6) + 0.0


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{value:.4g}" for value in values)
