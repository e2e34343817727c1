"""What a laser scan's message says.

Which layout a message has is found by `schemas`.
"""

from __future__ import annotations

import math
from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from uwbslam_jax.measurements import Message, ScanMessage


def take_scan(message: Any, stamp: int, dropped: Counter[str]) -> list[Message]:
    """The scan of a LaserScan, ROS's or Foxglove's; none, counted, where it holds no beams.

    Raises:
      ValueError: its bearings mean nothing.
    """
    ranges = np.array(message.ranges, dtype=np.float32).reshape(-1)
    if ranges.size == 0:
        dropped["scan: no beams"] += 1
        return []
    if hasattr(message, "start_angle"):  # foxglove: the sweep's two ends, no limits, taken at once
        angle_min, time_increment, limits = float(message.start_angle), 0.0, (0.0, math.inf)
        increment = (float(message.end_angle) - angle_min) / max(ranges.size - 1, 1)
    else:
        angle_min, increment = float(message.angle_min), float(message.angle_increment)
        time_increment, limits = float(message.time_increment), (float(message.range_min), float(message.range_max))
    if not limits[0] < limits[1]:  # drivers that leave both at 0 mean: no limits
        limits = (0.0, math.inf)
    if not all(map(math.isfinite, (angle_min, increment, time_increment))) or (increment == 0 and ranges.size > 1):
        raise ValueError("bearings are not finite or all the same")
    return [ScanMessage(stamp, angle_min, increment, time_increment, *limits, ranges)]


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        value |= (byte & 0x7F) << shift
        position, shift = position + 1, shift + 7
        if byte < 0x80:
            return value, position


def _wire_fields(data: bytes) -> dict[int, list[int | bytes]]:
    """Fields of a protobuf message by number, undecoded (protobuf.dev/programming-guides/encoding)."""
    fields: dict[int, list[int | bytes]] = {}
    position = 0
    while position < len(data):
        tag, position = _varint(data, position)
        if tag & 7 == 0:
            value, position = _varint(data, position)
        else:
            size, position = ({1: 8, 5: 4}[tag & 7], position) if tag & 7 != 2 else _varint(data, position)
            value, position = data[position : position + size], position + size
            if position > len(data):
                raise ValueError("cut off")
        fields.setdefault(tag >> 3, []).append(value)
    return fields


def _doubles(fields: dict[int, list[int | bytes]], number: int) -> np.ndarray:
    parts = fields.get(number, [])
    return np.frombuffer(b"".join(part for part in parts if isinstance(part, bytes)), "<f8")


def foxglove_protobuf(data: bytes) -> SimpleNamespace:
    """A foxglove.LaserScan: 1 timestamp, 4 start and 5 end angle, 6 ranges (double, packed or not)."""
    fields = _wire_fields(data)
    (time,) = fields.get(1, [b""])[-1:]
    time_fields = _wire_fields(time) if isinstance(time, bytes) else {}
    sec, nsec = (time_fields.get(number, [0])[-1] for number in (1, 2))
    angles = [[0.0, *_doubles(fields, number)][-1] for number in (4, 5)]
    ranges = _doubles(fields, 6)
    return SimpleNamespace(
        timestamp=SimpleNamespace(sec=sec, nsec=nsec), start_angle=angles[0], end_angle=angles[1], ranges=ranges
    )
