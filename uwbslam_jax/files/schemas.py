"""What the bytes of a message say: measurements out of ROS 2, ROS 1, JSON and foxglove messages.

Which layout a message has is read from the definition that its recording carries. Knows no files and does not
choose topics; what is written is `ros_types`.
"""

from __future__ import annotations

import functools
import json
import math
import re
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Literal

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.mcap_container import Channel
from uwbslam_jax.files.pose_messages import odometry_parts, take_odometry, take_truth
from uwbslam_jax.files.ros_types import STORE, UWB_RANGE
from uwbslam_jax.files.scan_messages import ScanReader, foxglove_protobuf
from uwbslam_jax.measurements import Message, RangeMessage
from uwbslam_jax.reasons import OdometryLost, RangeLost, ScanLost

Role = Literal["scan", "uwb", "odom", "truth", "tf"]
Decoder = Callable[[bytes, int], list[Message]]

_NAMES: dict[Role, str] = {
    "scan": r"LaserScan",
    "uwb": r"UwbRange|LinktrackNodeframe[23]|.*RangeStamped",
    "odom": r"Odometry",
    "truth": r"PoseStamped|PointStamped",
    "tf": r"(?i:tfMessage)",
}
"""What a type is called [role -> regex]; the package does not matter, since vendors have their own."""
SUPPORTED: dict[Role, str] = {
    "scan": "sensor_msgs/LaserScan, foxglove.LaserScan",
    "uwb": "UwbRange, LinktrackNodeframe2, LinktrackNodeframe3, RangeStamped",
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
    "uwb": {"range": {"source", "target", "range"}, "stamped": {"to_id", "range"}, "linktrack": {"id", "nodes"}},
    "odom": {"odom": {"pose", "child_frame_id"}, "tf": {"transforms"}},
    "truth": {"pose": {"header", "pose"}, "point": {"header", "point"}},
    "tf": {"tf": {"transforms"}},
}
"""Layouts that are read, by the fields that they need [role -> layout -> fields]."""
_MALFORMED = (SerdeError, struct.error, AttributeError, TypeError, ValueError, LookupError, ArithmeticError)
"""What decoding damaged bytes raises [exceptions]: rosbags passes on those of struct, numpy and the builtins."""


@dataclass
class Options:
    """How messages are taken.

    Attributes:
      robot_id: id of the robot's node, for messages that name only the other one.
      max_range: longer ranges are dropped [m].
      scans: reads the scans.
      dropped: what was left out, by reason.
      told: what a user should know of the poses, one line each, by what it is about.
    """

    robot_id: int = 0
    max_range: float = 200.0
    scans: ScanReader = field(default_factory=ScanReader)
    dropped: Counter[str] = field(default_factory=Counter)
    told: dict[str, str] = field(default_factory=dict)


def plausible(channel: Channel, role: Role) -> bool:
    """Whether the name of a channel's type suggests that it holds measurements of this role."""
    return re.fullmatch(_NAMES[role], _base_name(channel.schema)) is not None


def make_decoder(channel: Channel, role: Role, options: Options) -> Decoder:
    """A function from the bytes and log time [ns] of a message of this channel to its measurements.

    The function never raises: what does not decode is counted in `options.dropped`.

    Raises:
      LogError: the type or encoding is not one we read; the message names both.
    """
    unpack, fields = _unpacker(channel, role)
    layouts = [name for name, wanted in _FIELDS[role].items() if fields is None or wanted <= fields]
    if not layouts:
        raise LogError(
            f"topic {channel.topic}: schema {channel.schema!r} holds no {_WORDS[role]}; supported: {SUPPORTED[role]}"
        )
    if _is_our_range(channel):
        return _fast_range(options)
    take, malformed = _TAKE[role], _MALFORMED_AS[role]

    def decode(data: bytes, log_time: int) -> list[Message]:
        try:
            return take(unpack(data), log_time, options)
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


def _base_name(schema: str) -> str:
    return re.split(r"[/.]", schema)[-1]


def _unpacker(channel: Channel, role: Role) -> tuple[Callable[[bytes], Any], set[str] | None]:
    """From bytes to an object with the message's fields, and the names of these where there is a definition."""
    if channel.encoding in ("cdr", "ros1"):
        store, name = _store_of(channel)
        fields = {field_name for field_name, _ in store.fielddefs[name][1]}
        decode = store.deserialize_cdr if channel.encoding == "cdr" else store.deserialize_ros1
        return (lambda data: decode(data, name)), fields
    if channel.encoding == "json" and plausible(channel, role):
        return (lambda data: json.loads(data, object_hook=lambda d: SimpleNamespace(**d))), None
    if channel.encoding == "protobuf" and role == "scan" and channel.schema == "foxglove.LaserScan":
        return foxglove_protobuf, None
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
    except (TypesysError, KeyError, ValueError, SyntaxError) as error:
        reason = " ".join([type(error).__name__, *str(error).splitlines()[:1]])
        raise LogError(f"topic {channel.topic}: unreadable definition of {channel.schema!r}: {reason}") from None
    return store, name


def _is_our_range(channel: Channel) -> bool:
    """Whether a channel holds CDR messages laid out exactly as UwbRange, whatever their name."""
    if channel.encoding != "cdr":
        return False
    store, name = _store_of(channel)
    pairs = [(name, UWB_RANGE)] + [(t, t) for t in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")]
    return all(t in store.fielddefs and store.fielddefs[t][1] == STORE.fielddefs[own][1] for t, own in pairs)


def _fast_range(options: Options) -> Decoder:
    """Decoder of UwbRange without the generic machinery: recordings hold hundreds of them a second."""
    heads = [struct.Struct(order + "iII") for order in "><"]
    tails = [struct.Struct(order + "IIfff") for order in "><"]

    def decode(data: bytes, log_time: int) -> list[Message]:
        try:
            if data[0] or data[1] > 1:
                raise ValueError("not plain CDR")
            sec, nanosec, length = heads[data[1]].unpack_from(data, 4)
            source, target, *values = tails[data[1]].unpack_from(data, 16 + (length + 3 & ~3))
            stamp = sec * 1_000_000_000 + nanosec or log_time
        except (struct.error, IndexError, ValueError):
            options.dropped[RangeLost.MALFORMED] += 1
            return []
        return _checked(RangeMessage(stamp, source, target, *values), options)

    return decode


def _checked(found: RangeMessage, options: Options) -> list[Message]:
    """The one range as a list, empty and counted where it cannot be a distance between two nodes."""
    if not 0.0 < found.range < math.inf:
        options.dropped[RangeLost.NOT_POSITIVE] += 1
    elif found.range > options.max_range:
        options.dropped[RangeLost.over(options.max_range)] += 1
    elif found.source == found.target:
        options.dropped[RangeLost.FROM_SELF] += 1
    else:
        return [found]
    return []


def _stamp(message: Any, log_time: int) -> int:
    """Time of a message [ns]: its header's, or its own, or the log time where it has neither or zero."""
    time = getattr(message, "header", message)
    time = getattr(time, "stamp", None) or getattr(time, "timestamp", None)
    if time is None:
        return log_time
    nanosec = getattr(time, "nanosec", None)
    return int(time.sec) * 1_000_000_000 + int(time.nsec if nanosec is None else nanosec) or log_time


def _take_ranges(message: Any, log_time: int, options: Options) -> list[Message]:
    stamp = _stamp(message, log_time)
    if hasattr(message, "nodes"):
        found: list[Message] = []
        for node in message.nodes:
            measured = float(node.dis), float(node.rx_rssi), float(node.fp_rssi)
            found += _checked(RangeMessage(stamp, int(message.id), _linktrack_id(message, node), *measured), options)
        return found
    if hasattr(message, "to_id"):
        source = int(getattr(message, "from_id", options.robot_id))
        return _checked(RangeMessage(stamp, source, int(message.to_id), float(message.range)), options)
    powers = [float(getattr(message, name, math.nan)) for name in ("receive_power", "first_path_power")]
    nodes = int(message.source), int(message.target)
    return _checked(RangeMessage(stamp, *nodes, float(message.range), *powers), options)


def _linktrack_id(frame: Any, node: Any) -> int:
    """Id of a LinkTrack node. Tags and anchors count apart: one that shares the frame's own id gets role * 256 + id."""
    return int(node.id) if node.id != frame.id or node.role == frame.role else int(node.role) * 256 + int(node.id)


_TAKE: dict[Role, Callable[[Any, int, Options], list[Message]]] = {
    "scan": lambda message, log_time, options: options.scans.take(message, _stamp(message, log_time), options.dropped),
    "uwb": _take_ranges,
    "odom": lambda message, log_time, options: [
        found
        for part in odometry_parts(message)
        for found in take_odometry(part, _stamp(part, log_time), options.dropped, options.told)
    ],
    "truth": lambda message, log_time, _: take_truth(message, _stamp(message, log_time)),
}
"""From an unpacked message to its measurements [role -> function]."""
