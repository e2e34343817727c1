"""What the messages of UWB radios say: ranges between nodes, in metres, by the ids that the estimator counts with.

Where things stand in a message is `range_layouts`; which topic is read, and how bytes become fields, is not told here.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from uwbslam_jax.files.range_layouts import Layout
from uwbslam_jax.files.scan_messages import ScanReader
from uwbslam_jax.measurements import Message, RangeMessage
from uwbslam_jax.reasons import RangeLost
from uwbslam_jax.settings import RangeLayout, UwbSettings

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
"""Length of a unit [m]."""
_OTHER_NODE = 256
"""Numbers of nodes that a name does not give, and of an anchor that shares the number of the tag that ranges to it:
LinkTrack counts tags and anchors apart, 256 times a role and the number keeps them so [id]."""


StampOf = Callable[[Any, int], int]
"""From a message, or an element of its lists, and the time to go by where it tells none [ns], to its time [ns]."""


@dataclass
class Options:
    """How messages are taken.

    Attributes:
      robot_id: id of the robot's node, for messages that name only the other one.
      max_range: longer ranges are dropped [m].
      scans: reads the scans.
      dropped: what was left out, by reason.
      unit: of the ranges; "auto": what their message says, times scale.
      scale: what ranges are to be multiplied with besides, as found out from them; whole: whether messages count them
        in whole numbers, which are millimetres if nothing speaks against it; None where their unit is told.
      message: the user's description of a message, whose type is "" where there is none.
      joined: topics that are one radio's, each with the ranges to one node.
      names: node ids by the names that messages call them.
      told: what a user should know, one line each.
    """

    robot_id: int = 0
    max_range: float = 200.0
    scans: ScanReader = field(default_factory=ScanReader)
    dropped: Counter[str] = field(default_factory=Counter)
    unit: Literal["auto", "m", "cm", "mm", "ft", "in"] = "auto"
    scale: float = 1.0
    whole: bool | None = False
    message: RangeLayout = field(default_factory=RangeLayout)
    joined: list[str] = field(default_factory=list)
    names: dict[str, int] = field(default_factory=dict)
    told: list[str] = field(default_factory=list)

    @staticmethod
    def of(uwb: UwbSettings, robot_id: int, scan_frame: str = "") -> Options:
        """As the settings say; scan_frame: of the scanner to use, see ScanReader."""
        return Options(robot_id, uwb.max_range, ScanReader(scan_frame), unit=uwb.unit, message=uwb.message)

    def node(self, called: Any) -> int:
        """Id of a node that a message calls by a number, a text or the bytes of an address; the same whenever asked.

        Raises:
          ValueError, TypeError: it is none of these.
        """
        if isinstance(called, np.ndarray | list | bytes):
            called = bytes(called).hex()
        if not isinstance(called, str):
            number = int(called)
            if number != called or number < 0:
                raise ValueError("no node id")
            if number < 2**32:
                return number
            called = f"{number:#x}"
        called = called.strip().rstrip("\0")
        if called not in self.names:
            self.names[called] = self._number(called)
        return self.names[called]

    def _number(self, name: str) -> int:
        """The number that a name means, another one where that is taken: digits, an address in hex, or its last digits.
        Long addresses go by their last two bytes, as radios' short ones do."""
        if not name:
            raise ValueError("a node without a name")
        plain = re.sub(r"[:\-.\s]", "", name)
        hexadecimal = re.fullmatch(r"0[xX]([0-9a-fA-F]+)|([0-9a-fA-F]{4}|[0-9a-fA-F]{8}|[0-9a-fA-F]{16})", plain)
        if name.isascii() and name.isdigit():
            number: int | None = int(name)
        elif hexadecimal:
            number = int(hexadecimal[1] or hexadecimal[2], 16)
        else:
            last = re.findall(r"[0-9]+", name)
            number = int(last[-1]) if last else None
        if number is not None and number >= 2**32:
            number &= 0xFFFF
        taken = set(self.names.values())
        if number is None or number in taken:
            number = next(n for n in range(_OTHER_NODE, 2**32) if n not in taken)
        return number


def names_told(options: Options) -> list[str]:
    """One line that tells which numbers named nodes have, empty where they are called by their numbers."""
    names = {name: number for name, number in options.names.items() if name not in ("@robot", str(number))}
    told = [f"{number} is {name}" for name, number in sorted(names.items(), key=lambda item: item[1])]
    more = f" and {len(told) - 20} more" if len(told) > 20 else ""
    return [f"nodes have names, these are their ids: {', '.join(told[:20])}{more}"] if told else []


class _Place(NamedTuple):
    """One element of the list that holds the ranges: the message, the elements of its lists, the last one's place."""

    levels: list[Any]
    index: int


def _part(value: Any, path: str) -> Any:
    for name in filter(None, path.split(".")):
        value = getattr(value, name)
    return value


def _getter(path: str, lists: list[str]) -> Callable[[_Place], Any]:
    """Reads a path that goes through the lists of the range's own as far as it does, and through others beside them."""
    parts = [part.strip(".") for part in path.split("[]")]
    shared = 0
    while shared < min(len(lists), len(parts) - 1) and parts[shared] == lists[shared]:
        shared += 1
    first, *beside = parts[shared:]

    def get(place: _Place) -> Any:
        value = _part(place.levels[shared], first)
        for part in beside:
            value = _part(value[place.index], part)
        return value

    return get


def _places(lists: list[str], levels: list[Any], index: int) -> Iterator[_Place]:
    """Every element of the innermost list."""
    depth = len(levels) - 1
    if depth == len(lists):
        yield _Place(levels, index)
        return
    for k, element in enumerate(_part(levels[-1], lists[depth])):
        yield from _places(lists, [*levels, element], k)


def range_taker(layout: Layout, topic: str, options: Options) -> Callable[[Any, StampOf], list[Message]]:
    """A function from a message of a layout, its log time [ns] and what tells the time of a message, to its ranges.

    It raises what getattr, int, float and lists raise where a message is not so.
    """
    lists = [part.strip(".") for part in layout.range.split("[]")[:-1]]
    ends = [_end(path, lists, topic, options) for path in (layout.source, layout.target)]
    others = layout.range, layout.stamp, layout.valid, *layout.powers, *layout.roles
    get = {path: _getter(path, lists) for path in others if path}
    options.whole = None if layout.unit else layout.whole
    unit = layout.unit or ("mm" if layout.whole else "m")
    if layout.source == "@robot":
        options.names.setdefault("@robot", options.robot_id)  # no name of another node means this id

    def take(message: Any, stamp_of: StampOf) -> list[Message]:
        found: list[Message] = []
        stamp = stamp_of(message, 0)
        for place in _places(lists, [message], 0):
            measured = float(get[layout.range](place))
            if layout.target == "@index" and not measured > 0.0:
                continue  # nobody stands at this place of the list
            if layout.valid and not get[layout.valid](place):
                options.dropped[RangeLost.NOT_VALID] += 1
                continue
            source, target = (end(place) for end in ends)
            if source == target:
                own, other = (int(get[path](place)) if path else 0 for path in layout.roles)
                target += _OTHER_NODE * (other if other != own else int(layout.apart))
                if not 0 <= target < 2**32:
                    raise ValueError("no node id")
            metres = measured * METRES[unit if options.unit == "auto" else options.unit] * options.scale
            powers = [float(get[path](place)) if path else math.nan for path in layout.powers]
            at = nanoseconds(get[layout.stamp](place)) if layout.stamp else stamp_of(place.levels[-1], stamp)
            found += checked(RangeMessage(at or stamp, source, target, metres, *powers), options)
        return found

    return take


def _end(path: str, lists: list[str], topic: str, options: Options) -> Callable[[_Place], int]:
    """Reads the id of a node."""
    if path == "@robot":
        return lambda place: options.robot_id
    if path == "@index":
        return lambda place: place.index
    if path == "@topic":
        name = topic_name(topic, options.joined)
        return lambda place: options.node(name or _frame(place.levels[0]) or topic)
    get = _getter(path, lists)
    return lambda place: options.node(get(place))


def _frame(message: Any) -> str:
    return getattr(getattr(message, "header", None), "frame_id", "")


def topic_name(topic: str, topics: list[str]) -> str:
    """What a topic calls its node: where it differs from others of the same radio; "" where there is no other one."""
    steps, others = topic.split("/"), [other.split("/") for other in topics if other != topic]
    return "/".join(step for k, step in enumerate(steps) if any(other[k : k + 1] != [step] for other in others))


def nanoseconds(value: Any) -> int:
    """Nanoseconds of a ROS time, of seconds as a float, or of an integer of nanoseconds."""
    if isinstance(value, float | np.floating):
        return within_int64(round(float(value) * 1e9))
    if hasattr(value, "sec"):
        nanosec = getattr(value, "nanosec", None)
        return within_int64(int(value.sec) * 1_000_000_000 + int(value.nsec if nanosec is None else nanosec))
    return within_int64(int(value))


def within_int64(stamp: int) -> int:
    """A stamp [ns] as it is. Raises OverflowError where int64 cannot hold it: JSON and protobuf have longer numbers."""
    if not -(1 << 63) <= stamp < 1 << 63:
        raise OverflowError("no time")
    return stamp


def fast_range(options: Options) -> Callable[[bytes, int], list[Message]]:
    """Decoder of UwbRange without the generic machinery: recordings hold hundreds of them a second."""
    unit = METRES.get(options.unit, 1.0)

    def decode(data: bytes, log_time: int) -> list[Message]:
        try:
            if data[0] or data[1] > 1:
                raise ValueError("not plain CDR")
            name = len(data) - 36 & ~3  # what the message has room for: nothing comes after it
            sec, nanosec, length, source, target, measured, *powers = _layout(data[1], name).unpack_from(data, 4)
            if length + 3 & ~3 != name:
                layout = _layout(data[1], length + 3 & ~3)
                sec, nanosec, length, source, target, measured, *powers = layout.unpack_from(data, 4)
        except (struct.error, IndexError, ValueError):
            options.dropped[RangeLost.MALFORMED] += 1
            return []
        metres = measured * options.scale * unit
        return checked(RangeMessage(sec * 1_000_000_000 + nanosec, source, target, metres, *powers), options)

    return decode


@lru_cache(maxsize=64)
def _layout(little: int, name: int) -> struct.Struct:
    """Fields of a UwbRange behind its first four bytes. name: bytes that its frame_id takes, as padded."""
    return struct.Struct(f"{'><'[little]}iII{name}xIIfff")


def checked(found: RangeMessage, options: Options) -> list[Message]:
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
