"""What the messages of odometry, ground truth and transforms say."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np

from uwbslam_jax.measurements import Message, OdometryMessage, TruthMessage
from uwbslam_jax.reasons import OdometryLost

BASES = ("base_link", "base_footprint")
"""What the robot's own frame is called (REP 105)."""
WORLDS = ("map", "odom", "odom_combined", "world", "earth", "utm")
"""Frames that are none of the robot's (REP 105)."""
_LENGTH_OFF = 0.1
"""Length by which a quaternion may differ from 1 and still be taken for a rotation."""


class Transform(NamedTuple):
    """Where a frame stands in its parent: (4, 4), which takes points of the child to the parent [m]."""

    parent: str
    child: str
    matrix: np.ndarray


_NO_ROTATION = (
    "odometry without an orientation is left out: its quaternion has not the length 1 (never filled in?); see "
    "the driver, or leave it out with --no-odom"
)
"""What a user is told of quaternions without a rotation [text]."""


def transforms(message: Any) -> list[Transform]:
    """Those of a TFMessage that are rigid motions."""
    found = []
    for each in message.transforms:
        t, q = each.transform.translation, each.transform.rotation
        place = [float(t.x), float(t.y), float(t.z)]
        if _is_rotation(q) and all(map(math.isfinite, place)):
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = _rotation(q), place
            found.append(Transform(_name(each.header.frame_id), _name(each.child_frame_id), matrix))
    return found


def odometry_parts(message: Any) -> list[Any]:
    """What of a message is odometry: an Odometry itself, of a TFMessage the transforms from odom to the robot."""
    if not hasattr(message, "transforms"):
        return [message]
    return [each for each in message.transforms if _leads_to_robot(each)]


def take_odometry(message: Any, stamp: int, dropped: Counter[str], told: list[str]) -> list[Message]:
    """The pose of an Odometry or of a transform; none, counted, where it is no pose.

    Args:
      told: what a user should know, one line each; added to.
    """
    if hasattr(message, "pose"):
        place, turn = message.pose.pose.position, message.pose.pose.orientation
    else:
        place, turn = message.transform.translation, message.transform.rotation
    x, y, yaw = float(place.x), float(place.y), _yaw(turn)
    if not all(map(math.isfinite, (x, y, yaw))):
        dropped[OdometryLost.NOT_FINITE] += 1
    elif not _is_rotation(turn):
        dropped[OdometryLost.NO_ROTATION] += 1
        if _NO_ROTATION not in told:
            told.append(_NO_ROTATION)
    else:
        return [OdometryMessage(stamp, x, y, yaw)]
    return []


def take_truth(message: Any, stamp: int) -> list[Message]:
    """A pose, or the point of a node that the topic names and `mcap_log` fills in."""
    if hasattr(message, "pose"):
        p = message.pose.position
        return [TruthMessage(stamp, None, float(p.x), float(p.y), _yaw(message.pose.orientation))]
    return [TruthMessage(stamp, None, float(message.point.x), float(message.point.y))]


def _leads_to_robot(transform: Any) -> bool:
    parent, child = (_last(_name(name)) for name in (transform.header.frame_id, transform.child_frame_id))
    return "odom" in parent and child not in WORLDS


def _name(frame: str) -> str:
    """A frame without the leading slash that old ROS gave."""
    return str(frame).lstrip("/")


def _last(name: str) -> str:
    """A frame's name without its robot's."""
    return name.rpartition("/")[2]


def is_base(name: str) -> bool:
    """Whether a frame is the robot's own by its name."""
    return _last(name) in BASES


def is_world(name: str) -> bool:
    """Whether a frame is none of the robot's by its name."""
    return _last(name) in WORLDS


def _is_rotation(q: Any) -> bool:
    return abs(math.hypot(q.x, q.y, q.z, q.w) - 1.0) <= _LENGTH_OFF


def _yaw(q: Any) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def _rotation(q: Any) -> np.ndarray:
    """(3, 3) of a quaternion."""
    x, y, z, w = np.array([q.x, q.y, q.z, q.w], float) / math.hypot(q.x, q.y, q.z, q.w)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
