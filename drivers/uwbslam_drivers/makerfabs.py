"""Makerfabs MaUWB (ESP32 with AT firmware): AT+RANGE=tid:0,mask:01,seq:65,range:(92,0,..),rssi:(..),ancid:(0,-1,..).

Ranges are in centimetres, one for each bit of the mask; newer firmware names the anchors (ancid), older counts them.
Lines carry no time.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping

from uwbslam_drivers.device import Measured, Port, SerialRadio, Session
from uwbslam_drivers.lines import LineDecoder
from uwbslam_jax.measurements import NAN, RangeMessage

_LINE = re.compile(
    r"AT\+RANGE=tid:(\d{1,5}),\s*mask:([0-9A-Fa-f]{1,8}),\s*seq:\s*(\d{1,5}),\s*range:\s*\(([^()]*)\)(.*)"
)
"""A report up to its ranges [text]; numbers are bounded, so that a damaged one stays small."""
_RSSI, _ANCHORS = re.compile(r"rssi:\s*\(([^()]*)\)"), re.compile(r"ancid:\s*\(([^()]*)\)")
"""Fields of a report [text]: powers and anchors may be missing, as older firmware leaves them out."""


class MakerfabsDecoder(LineDecoder):
    """Lines to ranges of a tag; stamped with their arrival."""

    mark = sign = b"AT+RANGE="

    def ranges(self, line: bytes, received: int) -> list[Measured] | None:
        found = parse(line)
        return None if found is None else [Measured(RangeMessage(received, *fields), None) for fields in found]


def parse(line: bytes) -> list[tuple[int, int, float, float]] | None:
    """Tag, anchor, distance [m] and power [dBm] of each range of a line; None where the line is damaged.

    Tags and anchors count apart: an anchor with the tag's number gets 256 + number.
    """
    match = _LINE.match(line.decode("ascii", "replace"))
    if match is None:
        return None
    tag, mask, rest = int(match[1]), int(match[2], 16), match[5]
    try:
        ranges = [float(word) for word in match[4].split(",")]
        rssi, anchors = _RSSI.search(rest), _ANCHORS.search(rest)
        powers = [float(word) for word in rssi[1].split(",")] if rssi else [0.0] * len(ranges)
        ids = [int(word) for word in anchors[1].split(",")] if anchors else list(range(len(ranges)))
    except ValueError:
        return None
    if not (len(ranges) == len(powers) == len(ids) <= 32) or not all(map(math.isfinite, [*ranges, *powers])):
        return None
    found = []
    for k, (centimetres, power, anchor) in enumerate(zip(ranges, powers, ids, strict=True)):
        if mask >> k & 1 and centimetres > 0.0 and 0 <= anchor < 1 << 16:
            node = anchor + 256 if anchor == tag else anchor
            found.append((tag, node, centimetres / 100.0, power or NAN))
    return found


class Makerfabs(SerialRadio):
    """Sends by itself once AT+SETRPT=1 is set."""

    def start(self, port: Port, options: Mapping[str, str], dropped: Counter[str]) -> Session:
        port.write(b"AT+SETRPT=1\r\n")
        return Session(MakerfabsDecoder(dropped))
