"""What the bytes of a message say: measurements out of ROS 2, ROS 1, JSON and foxglove messages.

Which layout a message has is read from the definition that its recording carries. Knows no files and does not
choose topics; what is written is `ros_types`.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.mcap_container import Channel
from uwbslam_jax.files.range_layouts import (
    Layout,
    described,
    fields_of_object,
    fields_of_type,
    find_layout,
    one_a_topic,
)
from uwbslam_jax.files.range_messages import Options, fast_range, range_taker
from uwbslam_jax.files.ros_types import STORE, UWB_RANGE
from uwbslam_jax.measurements import Message, OdometryMessage, ScanMessage, TruthMessage

Role = Literal["scan", "uwb", "odom", "truth"]
Decoder = Callable[[bytes, int], list[Message]]

_NAMES: dict[Role, str] = {
    "scan": r"LaserScan",
    "uwb": r"(?i).*(uwb|rang(e|ing)|linktrack|dwm|decawave|pozyx|anchor|distance).*",
    "odom": r"Odometry",
    "truth": r"PoseStamped|PointStamped",
}
"""What a type is called [role -> regex]; the package does not matter, since vendors have their own."""
SUPPORTED: dict[Role, str] = {
    "scan": "sensor_msgs/LaserScan, foxglove.LaserScan",
    "uwb": "UwbRange, LinkTrack frames, RangeStamped, messages with two ids and a range, or lists of them",
    "odom": "nav_msgs/Odometry",
    "truth": "geometry_msgs/PoseStamped, geometry_msgs/PointStamped",
}
"""Types that are read [role -> text], for an error about another one."""
_WORDS: dict[Role, str] = {"scan": "scan", "uwb": "range", "odom": "odometry", "truth": "ground truth"}
"""What messages call a role [role -> text]."""
_FIELDS: dict[Role, dict[str, set[str]]] = {
    "scan": {
        "ros": {"angle_min", "angle_increment", "time_increment", "range_min", "range_max", "ranges"},
        "foxglove": {"start_angle", "end_angle", "ranges"},
    },
    "odom": {"odom": {"pose", "child_frame_id"}},
    "truth": {"pose": {"header", "pose"}, "point": {"header", "point"}},
}
"""Layouts that are read, by the fields that they need [role -> layout -> fields]; of ranges see `range_layouts`."""
_RANGES_ONLY = r"UwbRange|LinktrackNodeframe[23]|.*RangeStamped"
"""Types that are ranges between nodes and nothing else, taken before others that may be [regex]."""
_RADIO = r"(?i).*(uwb|anchor|beacon|tag|dwm|dw[13]000|decawave|pozyx|linktrack|twr).*"
"""What the topic or type of a radio's ranges to one node says: sonars have the same messages [regex]."""
_MALFORMED = (
    *(SerdeError, struct.error, AttributeError, TypeError, ValueError, LookupError, ArithmeticError),
    RecursionError,
)
"""What decoding damaged bytes raises [exceptions]: rosbags passes on those of struct, numpy and the builtins."""


def plausible(channel: Channel, role: Role, options: Options) -> int | None:
    """How well the name of a channel's type suggests that it holds measurements of this role, the best 0; None: no."""
    if role == "uwb" and _is_described(channel, options):
        return 0
    if re.fullmatch(_NAMES[role], _base_name(channel.schema)) is None:
        return None
    return 1 if role != "uwb" or re.fullmatch(_RANGES_ONLY, _base_name(channel.schema)) else 2


def names_no_node(channel: Channel, options: Options) -> bool:
    """Whether a channel's ranges are to the one node that its topic, or its frame, names."""
    return channel.encoding in ("cdr", "ros1") and _range_layout(channel, options).target == "@topic"


def of_a_radio(channel: Channel) -> bool:
    """Whether the names of a channel's topic and type suggest a radio."""
    return re.fullmatch(_RADIO, f"{channel.topic} {channel.schema}") is not None


def make_decoder(channel: Channel, role: Role, options: Options) -> Decoder:
    """A function from the bytes and log time [ns] of a message of this channel to its measurements.

    The function never raises: what does not decode is counted in `options.dropped`.

    Raises:
      LogError: the type or encoding is not one we read; the message names both.
    """
    if role == "uwb":
        return _range_decoder(channel, options)
    unpack, fields = _unpacker(channel, role)
    layouts = [name for name, wanted in _FIELDS[role].items() if fields is None or wanted <= fields]
    if not layouts:
        raise LogError(
            f"topic {channel.topic}: schema {channel.schema!r} holds no {_WORDS[role]}; supported: {SUPPORTED[role]}"
        )
    take = _TAKE[role]

    def decode(data: bytes, log_time: int) -> list[Message]:
        try:
            return take(unpack(data), log_time, options)
        except _MALFORMED:
            options.dropped[f"{_WORDS[role]}: malformed"] += 1
            return []

    return decode


def _is_described(channel: Channel, options: Options) -> bool:
    wanted, own = (name.replace("/msg/", "/") for name in (options.message.type, channel.schema))
    return bool(wanted) and wanted in (own, _base_name(own))


def _range_layout(channel: Channel, options: Options) -> Layout:
    """The layout of a channel with a definition: the user's, or one that is told by the fields. Raises LogError."""
    store, name = _store_of(dataclasses.replace(channel, id=0))
    fields = fields_of_type(store.fielddefs, name)
    if _is_described(channel, options):
        layout = described(options.message)
        paths = layout.source, layout.target, layout.range, layout.stamp, *layout.powers
        absent = [
            path
            for path in paths
            if path and path[0] != "@" and not any(f"{f}.".startswith(f"{path}.") for f in fields)
        ]
        if absent:
            raise LogError(f"uwb.message: {channel.schema} has no {', '.join(absent)}; it has {', '.join(fields)}")
        return layout
    layout = find_layout(fields) or one_a_topic(fields)
    if layout is None:
        raise LogError(
            f"topic {channel.topic}: schema {channel.schema!r} holds no range that is found by its fields "
            f"({', '.join(list(fields)[:16])}); supported: {SUPPORTED['uwb']}; or describe it in [uwb.message]"
        )
    return layout


def _range_decoder(channel: Channel, options: Options) -> Decoder:
    """Decoder of a channel of ranges; the layout of one without a definition is found with its first message."""
    unpack, fields = _unpacker(channel, "uwb")
    if fields is not None and _is_our_range(channel):
        return fast_range(options)
    layout = described(options.message) if _is_described(channel, options) else None
    layout = layout if fields is None else _range_layout(channel, options)
    take = range_taker(layout, channel.topic, options) if layout else None

    def decode(data: bytes, log_time: int) -> list[Message]:
        nonlocal take
        try:
            message = unpack(data)
            if take is None and (found := find_layout(fields_of_object(message))):
                take = range_taker(found, channel.topic, options)
            if take is not None:
                return take(message, log_time, _stamp)
        except _MALFORMED:
            pass
        options.dropped["range: malformed"] += 1
        return []

    return decode


def _base_name(schema: str) -> str:
    return re.split(r"[/.]", schema)[-1]


def _unpacker(channel: Channel, role: Role) -> tuple[Callable[[bytes], Any], set[str] | None]:
    """From bytes to an object with the message's fields, and the names of these where there is a definition."""
    if channel.encoding in ("cdr", "ros1"):
        store, name = _store_of(dataclasses.replace(channel, id=0))
        fields = {field_name for field_name, _ in store.fielddefs[name][1]}
        decode = store.deserialize_cdr if channel.encoding == "cdr" else store.deserialize_ros1
        return (lambda data: decode(data, name)), fields
    if channel.encoding == "json" and (role == "uwb" or plausible(channel, role, Options())):
        return (lambda data: json.loads(data, object_hook=lambda d: SimpleNamespace(**d))), None
    if channel.encoding == "protobuf" and role == "scan" and channel.schema == "foxglove.LaserScan":
        return _foxglove_protobuf, None
    raise LogError(
        f"topic {channel.topic}: schema {channel.schema!r} in encoding {channel.encoding!r} is not supported for "
        f"a {_WORDS[role]}; supported: {SUPPORTED[role]} in cdr, ros1 or json, foxglove.LaserScan also in protobuf"
    )


@functools.lru_cache(maxsize=64)
def _store_of(channel: Channel) -> tuple[Typestore, str]:
    """The types that a channel's definition defines, and the full name of its own."""
    name = re.sub(r"^([^/]+)/([^/]+)$", r"\1/msg/\2", channel.schema)
    text = channel.definition.decode("utf-8", "replace")
    try:
        if not text.strip():
            return STORE, STORE.get_msgdef(name).name
        store = get_typestore(Stores.EMPTY)
        if channel.schema_encoding in ("ros2idl", "omgidl"):
            types = {}
            for part in re.split(r"^=+\s*\n", text, flags=re.MULTILINE):
                part = re.sub(r"^(#.*|IDL: .*)$", "", part, flags=re.MULTILINE)  # rosbags' grammar has no #include
                types |= get_types_from_idl(part) if part.strip() else {}
        else:
            types = get_types_from_msg(text, name)
        if channel.encoding == "ros1":  # there time is a type of the language, in no definition
            types |= get_types_from_msg("uint32 sec\nuint32 nanosec\n", "builtin_interfaces/msg/Time")
        known = {key: value for key, value in types.items() if key not in store.fielddefs}
        store.register(known)
        store.get_msgdef(name)
    except (TypesysError, KeyError, ValueError, SyntaxError, RecursionError) as error:
        reason = " ".join([type(error).__name__, *str(error).splitlines()[:1]])
        raise LogError(f"topic {channel.topic}: unreadable definition of {channel.schema!r}: {reason}") from None
    return store, name


def _is_our_range(channel: Channel) -> bool:
    """Whether a channel holds CDR messages laid out exactly as UwbRange, whatever their name."""
    if channel.encoding != "cdr":
        return False
    store, name = _store_of(dataclasses.replace(channel, id=0))
    pairs = [(name, UWB_RANGE)] + [(t, t) for t in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")]
    return all(t in store.fielddefs and store.fielddefs[t][1] == STORE.fielddefs[own][1] for t, own in pairs)


def _stamp(message: Any, log_time: int) -> int:
    """Time of a message [ns]: its header's, or its own, or the log time where it has neither or zero."""
    time = getattr(message, "header", message)
    time = getattr(time, "stamp", None) or getattr(time, "timestamp", None)
    if time is None:
        return log_time
    nanosec = getattr(time, "nanosec", None)
    return int(time.sec) * 1_000_000_000 + int(time.nsec if nanosec is None else nanosec) or log_time


def _take_scan(message: Any, log_time: int, options: Options) -> list[Message]:
    ranges = np.array(message.ranges, dtype=np.float32).reshape(-1)
    if ranges.size == 0:
        options.dropped["scan: no beams"] += 1
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
    return [ScanMessage(_stamp(message, log_time), angle_min, increment, time_increment, *limits, ranges)]


def _yaw(q: Any) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def _take_odometry(message: Any, log_time: int, options: Options) -> list[Message]:
    pose = message.pose.pose
    x, y, yaw = float(pose.position.x), float(pose.position.y), _yaw(pose.orientation)
    if not all(map(math.isfinite, (x, y, yaw))):
        options.dropped["odometry: not finite"] += 1
        return []
    return [OdometryMessage(_stamp(message, log_time), x, y, yaw)]


def _take_truth(message: Any, log_time: int, options: Options) -> list[Message]:
    """A pose, or the point of a node that the topic names and `mcap_log` fills in."""
    del options
    stamp = _stamp(message, log_time)
    if hasattr(message, "pose"):
        p = message.pose.position
        return [TruthMessage(stamp, None, float(p.x), float(p.y), _yaw(message.pose.orientation))]
    return [TruthMessage(stamp, None, float(message.point.x), float(message.point.y))]


_TAKE: dict[Role, Callable[[Any, int, Options], list[Message]]] = {
    "scan": _take_scan,
    "odom": _take_odometry,
    "truth": _take_truth,
}
"""From an unpacked message to its measurements [role -> function]."""


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


def _foxglove_protobuf(data: bytes) -> SimpleNamespace:
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
