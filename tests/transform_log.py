"""Small recordings with transforms: a scanner and a radio on a robot."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from uwbslam_jax.files import ros_types
from uwbslam_jax.files.mcap_container import RecordWriter
from uwbslam_jax.files.ros_types import build, header, vector
from uwbslam_jax.measurements import RangeMessage, ScanMessage

T0 = 1_700_000_000_000_000_000
SCAN = ScanMessage(T0, -1.0, 0.01, 1e-5, 0.1, 30.0, np.linspace(1.0, 3.0, 201, dtype=np.float32))
Turn = tuple[float, float, float]


def quaternion(roll: float, pitch: float, yaw: float) -> Any:
    (cr, cp, cy), (sr, sp, sy) = ([f(angle / 2) for angle in (roll, pitch, yaw)] for f in (math.cos, math.sin))
    return build(
        "geometry_msgs/msg/Quaternion",
        w=cr * cp * cy + sr * sp * sy,
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
    )


def transform(stamp: int, parent: str, child: str, place: Turn = (0, 0, 0), turn: Turn = (0, 0, 0)) -> Any:
    """A TFMessage of one TransformStamped; place [m], roll, pitch, yaw [rad]."""
    rigid = build("geometry_msgs/msg/Transform", translation=vector("Vector3", *place), rotation=quaternion(*turn))
    stamped = build(
        "geometry_msgs/msg/TransformStamped", header=header(stamp, parent), child_frame_id=child, transform=rigid
    )
    return build("tf2_msgs/msg/TFMessage", transforms=[stamped])


def write(path: Path, messages: list[tuple[str, int, Any]], store: Typestore = ros_types.STORE) -> Path:
    """A recording of (topic, log time [ns], built message or measurement); store: with the types of built messages."""
    with RecordWriter(path) as writer:
        channels: dict[str, int] = {}
        for topic, log_time, message in messages:
            if isinstance(message, ScanMessage | RangeMessage):
                schema, data = ros_types.encode(message)
            else:
                schema = message.__msgtype__
                data = bytes(store.serialize_cdr(message, schema, little_endian=True))
            if topic not in channels:
                text = store.generate_msgdef(schema, ros_version=2)[0]
                channels[topic] = writer.add_topic(topic, schema, text.encode())
            writer.write(channels[topic], data, log_time)
    return path


def measured() -> list[tuple[str, int, Any]]:
    """A scan in the frame laser and a range in the frame uwb."""
    return [("/scan", T0, SCAN), ("/uwb/ranges", T0 + 1, RangeMessage(T0 + 1, 0, 5, 2.0))]
