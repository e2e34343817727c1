"""What the messages of odometry and ground truth say."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from uwbslam_jax.measurements import Message, OdometryMessage, TruthMessage


def _yaw(q: Any) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def take_odometry(message: Any, stamp: int, dropped: Counter[str]) -> list[Message]:
    """The pose of an Odometry; none, counted, where it is not finite."""
    pose = message.pose.pose
    x, y, yaw = float(pose.position.x), float(pose.position.y), _yaw(pose.orientation)
    if not all(map(math.isfinite, (x, y, yaw))):
        dropped["odometry: not finite"] += 1
        return []
    return [OdometryMessage(stamp, x, y, yaw)]


def take_truth(message: Any, stamp: int) -> list[Message]:
    """A pose, or the point of a node that the topic names and `mcap_log` fills in."""
    if hasattr(message, "pose"):
        p = message.pose.position
        return [TruthMessage(stamp, None, float(p.x), float(p.y), _yaw(message.pose.orientation))]
    return [TruthMessage(stamp, None, float(message.point.x), float(message.point.y))]
