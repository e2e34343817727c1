"""What the bytes of a message say: measurements out of ROS 2, ROS 1, JSON and foxglove messages.

Which layout a message has is read from the definition that its recording carries, see `definitions`. Knows no files
and does not choose topics; what is written is `ros_types`.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Literal

from rosbags.serde import SerdeError

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.definitions import store_of
from uwbslam_jax.files.mcap_container import Channel
from uwbslam_jax.files.pose_messages import odometry_parts, take_odometry, take_truth
from uwbslam_jax.files.range_layouts import (
    Layout,
    described,
    fields_of_object,
    fields_of_type,
    find_layout,
    one_a_topic,
)
from uwbslam_jax.files.range_messages import Options, fast_range, nanoseconds, range_taker
from uwbslam_jax.files.ros_types import STORE, UWB_RANGE
from uwbslam_jax.files.scan_messages import foxglove_protobuf
from uwbslam_jax.measurements import Message
from uwbslam_jax.reasons import OdometryLost, RangeLost, ScanLost

Role = Literal["scan", "uwb", "odom", "truth", "tf"]
Decoder = Callable[[bytes, int], list[Message]]

_NAMES: dict[Role, str] = {
    "scan": r"LaserScan",
    "uwb": r"(?i).*(uwb|rang(e|ing)|linktrack|dwm|decawave|pozyx|anchor|distance).*",
    "odom": r"Odometry",
    "truth": r"PoseStamped|PointStamped",
    "tf": r"(?i:tfMessage)",
}
"""What a type is called [role -> regex]; the package does not matter, since vendors have their own."""
SUPPORTED: dict[Role, str] = {
    "scan": "sensor_msgs/LaserScan, foxglove.LaserScan",
    "uwb": "UwbRange, LinkTrack frames, RangeStamped, messages with two ids and a range, or lists of them",
    "odom": "nav_msgs/Odometry, tf2_msgs/TFMessage",
    "truth": "geometry_msgs/PoseStamped, geometry_msgs/PointStamped",
    "tf": "tf2_msgs/TFMessage, tf/tfMessage",
}
"""Types that are read [role -> text], for an error about another one."""
_WORDS: dict[Role, str] = {
    "scan": "scan",
    "uwb": "range",
    "odom": "odometry",
    "truth": "ground truth",
    "tf": "transforms",
}
"""What messages call a role [role -> text]."""
_MALFORMED_AS: dict[Role, str] = {
    "scan": ScanLost.MALFORMED,
    "uwb": RangeLost.MALFORMED,
    "odom": OdometryLost.MALFORMED,
    "truth": "ground truth: malformed",
    "tf": "transforms: malformed",
}
"""How a message that does not decode is counted [role -> reason]."""
_FIELDS: dict[Role, dict[str, set[str]]] = {
    "scan": {
        "ros": {"angle_min", "angle_increment", "time_increment", "range_min", "range_max", "ranges"},
        "foxglove": {"start_angle", "end_angle", "ranges"},
    },
    "odom": {"odom": {"pose", "child_frame_id"}, "tf": {"transforms"}},
    "truth": {"pose": {"header", "pose"}, "point": {"header", "point"}},
    "tf": {"tf": {"transforms"}},
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
    take, malformed = _TAKE[role], _MALFORMED_AS[role]

    def decode(data: bytes, log_time: int) -> list[Message]:
        try:
            return take(unpack(data), options)
        except _MALFORMED:
            options.dropped[malformed] += 1
            return []

    return decode


def unpacker(channel: Channel, role: Role) -> Callable[[bytes], Any]:
    """From the bytes of a message of this channel to an object with its fields, None where it cannot be read."""
    try:
        unpack = _unpacker(channel, role)[0]
    except LogError:
        return lambda _: None

    def read(data: bytes) -> Any:
        try:
            return unpack(data)
        except _MALFORMED:
            return None

    return read


def _is_described(channel: Channel, options: Options) -> bool:
    wanted, own = (name.replace("/msg/", "/") for name in (options.message.type, channel.schema))
    return bool(wanted) and wanted in (own, _base_name(own))


def _range_layout(channel: Channel, options: Options) -> Layout:
    """The layout of a channel with a definition: the user's, or one that is told by the fields. Raises LogError."""
    store, name = store_of(channel)
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
                return take(message, _stamp)
        except _MALFORMED:
            pass
        options.dropped[RangeLost.MALFORMED] += 1
        return []

    return decode


def _base_name(schema: str) -> str:
    return re.split(r"[/.]", schema)[-1]


def _unpacker(channel: Channel, role: Role) -> tuple[Callable[[bytes], Any], set[str] | None]:
    """From bytes to an object with the message's fields, and the names of these where there is a definition."""
    if channel.encoding in ("cdr", "ros1"):
        store, name = store_of(channel)
        fields = {field_name for field_name, _ in store.fielddefs[name][1]}
        decode = store.deserialize_cdr if channel.encoding == "cdr" else store.deserialize_ros1
        return (lambda data: decode(data, name)), fields
    if channel.encoding == "json" and (role == "uwb" or plausible(channel, role, Options())):
        return (lambda data: json.loads(data, object_hook=lambda d: SimpleNamespace(**d))), None
    if channel.encoding == "protobuf" and role == "scan" and channel.schema == "foxglove.LaserScan":
        return foxglove_protobuf, None
    raise LogError(
        f"topic {channel.topic}: schema {channel.schema!r} in encoding {channel.encoding!r} is not supported for "
        f"a {_WORDS[role]}; supported: {SUPPORTED[role]} in cdr, ros1 or json, foxglove.LaserScan also in protobuf"
    )


def _is_our_range(channel: Channel) -> bool:
    """Whether a channel holds CDR messages laid out exactly as UwbRange, whatever their name."""
    if channel.encoding != "cdr":
        return False
    store, name = store_of(channel)
    pairs = [(name, UWB_RANGE)] + [(t, t) for t in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")]
    return all(t in store.fielddefs and store.fielddefs[t][1] == STORE.fielddefs[own][1] for t, own in pairs)


def _stamp(message: Any, otherwise: int = 0) -> int:
    """Time of a message [ns]: its header's, or its own; another where it has neither, or 0. Raises OverflowError."""
    time = getattr(message, "header", message)
    time = getattr(time, "stamp", None) or getattr(time, "timestamp", None)
    return otherwise if time is None else nanoseconds(time) or otherwise


_TAKE: dict[Role, Callable[[Any, Options], list[Message]]] = {
    "scan": lambda message, options: options.scans.take(message, _stamp(message), options.dropped),
    "odom": lambda message, options: [
        found
        for part in odometry_parts(message)
        for found in take_odometry(part, _stamp(part), options.dropped, options.told)
    ],
    "truth": lambda message, _: take_truth(message, _stamp(message)),
}
"""From an unpacked message to its measurements [role -> function]."""
