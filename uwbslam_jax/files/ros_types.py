"""ROS 2 messages being written: types, their definitions, small builders, and measurements as CDR.

What foreign messages say when read is `schemas`; topics and files are `mcap_log`.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage, ScanMessage

UWB_RANGE = "uwbslam_msgs/msg/UwbRange"
"""Type of a range [ROS type]: no standard one is of two nodes."""
UWB_RANGE_TEXT = """\
std_msgs/Header header        # stamp of the exchange
uint32 source                 # node that started it
uint32 target                 # node that answered
float32 range                 # m
float32 receive_power         # dBm, NaN where the radio does not say
float32 first_path_power      # dBm, NaN where the radio does not say
"""
"""Its definition [ros2msg], which a recording carries; its comments give the units."""
_SEPARATOR = "=" * 80 + "\n"
"""What stands between two definitions of a ros2msg text [text] (MCAP specification, Well-known schema encodings)."""
CDR = b"\x00\x01\x00\x00"
"""Head of plain CDR, little-endian [bytes] (DDSI-RTPS 2.3, 10.5)."""
_RANGE, _SCAN = struct.Struct("<4siII4sIIfff"), struct.Struct("<4siII8s7fI")
"""Head, stamp, "uwb", five fields; head, stamp, "laser" padded to 8, seven scalars, number of ranges [bytes]."""


def _make_store() -> Typestore:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(UWB_RANGE_TEXT, UWB_RANGE))
    return store


STORE = _make_store()
"""Humble's types and UwbRange [ROS types]: what is written, and what a recording without definitions is read with."""


def definition(schema: str) -> bytes:
    """The ros2msg text of a type with all the types it uses, as recordings carry it."""
    text, _ = STORE.generate_msgdef(schema, ros_version=2)
    if schema == UWB_RANGE:  # with its comments, which say the units
        text = UWB_RANGE_TEXT + text[text.index(_SEPARATOR) :]
    return text.encode()


def build(schema: str, **fields: Any) -> Any:
    """A message of that type ("geometry_msgs/msg/Pose"); every field must be given."""
    return STORE.types[schema](**fields)


def serialize(message: Any) -> bytes:
    """CDR bytes of a built message, little-endian."""
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=True))


def time(stamp: int) -> Any:
    """builtin_interfaces/Time of a stamp [ns]."""
    sec, nanosec = divmod(int(stamp), 1_000_000_000)
    return build("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header(stamp: int, frame: str) -> Any:
    """std_msgs/Header of a stamp [ns]."""
    return build("std_msgs/msg/Header", stamp=time(stamp), frame_id=frame)


def vector(schema: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    """geometry_msgs/Point or Vector3 ("Point", "Vector3")."""
    return build(f"geometry_msgs/msg/{schema}", x=float(x), y=float(y), z=float(z))


def quaternion(yaw: float) -> Any:
    """geometry_msgs/Quaternion of a rotation about z [rad]."""
    return build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def pose(x: float, y: float, yaw: float) -> Any:
    """geometry_msgs/Pose in the plane [m, m, rad]."""
    return build("geometry_msgs/msg/Pose", position=vector("Point", x, y), orientation=quaternion(float(yaw)))


def encode(message: Message) -> tuple[str, bytes]:
    """Type and CDR bytes of a measurement; frames laser, uwb, odom, and world for truth.

    Scans and ranges are packed by hand: they are nearly all of a recording.

    Raises:
      struct.error: a stamp or id that its field cannot hold.
    """
    sec, nanosec = divmod(message.stamp, 1_000_000_000)
    if isinstance(message, RangeMessage):
        ends = message.source, message.target
        values = message.range, message.receive_power, message.first_path_power
        return UWB_RANGE, _RANGE.pack(CDR, sec, nanosec, 4, b"uwb", *ends, *values)
    if isinstance(message, ScanMessage):
        ranges = np.ascontiguousarray(message.ranges, dtype="<f4")
        step, between, beams = message.angle_increment, message.time_increment, ranges.size
        angles = message.angle_min, message.angle_min + step * max(beams - 1, 0), step
        rest = between, between * beams, message.range_min, message.range_max, beams
        head = _SCAN.pack(CDR, sec, nanosec, 6, b"laser", *angles, *rest)
        return "sensor_msgs/msg/LaserScan", head + ranges.tobytes() + bytes(4)  # no intensities
    if isinstance(message, OdometryMessage):
        filled = _odometry(message)
    elif message.node is None:
        place = pose(message.x, message.y, message.yaw)
        filled = build("geometry_msgs/msg/PoseStamped", header=header(message.stamp, "world"), pose=place)
    else:
        point = vector("Point", message.x, message.y)
        filled = build("geometry_msgs/msg/PointStamped", header=header(message.stamp, "world"), point=point)
    return filled.__msgtype__, serialize(filled)


def recorded(message: Message) -> Message:
    """A range or a scan as a recording gives it back: its numbers rounded to single precision."""
    if not isinstance(message, (RangeMessage, ScanMessage)):
        return message
    names = [field.name for field in dataclasses.fields(message) if field.name not in ("stamp", "source", "target")]
    values = {name: getattr(message, name) for name in names}
    rounded = {k: np.float32(v) if np.ndim(v) else float(np.float32(v)) for k, v in values.items()}
    return dataclasses.replace(message, **rounded)


def _odometry(message: OdometryMessage) -> Any:
    """nav_msgs/Odometry with unknown (zero) covariances and velocities."""
    at = build(
        "geometry_msgs/msg/PoseWithCovariance", pose=pose(message.x, message.y, message.yaw), covariance=np.zeros(36)
    )
    twist = build("geometry_msgs/msg/Twist", linear=vector("Vector3"), angular=vector("Vector3"))
    return build(
        "nav_msgs/msg/Odometry",
        header=header(message.stamp, "odom"),
        child_frame_id="base_link",
        pose=at,
        twist=build("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )
