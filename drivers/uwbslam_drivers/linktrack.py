"""Nooploop LinkTrack, NodeFrame2 (55 04) and NodeFrame3 (55 05) of the NLink protocol.

Little-endian; a frame ends with the sum of its bytes. Distances are 24-bit millimetres, powers minus half a byte in
dBm (NLink protocol, LinkTrack user manual V2). NodeFrame2 gives a time for each range, NodeFrame3 one for all.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping

from uwbslam_drivers.device import Measured, Port, SerialRadio, Session
from uwbslam_jax.measurements import RangeMessage
from uwbslam_jax.reasons import RangeLost

MS, WRAP = 1_000_000, (1 << 32) * 1_000_000
"""A millisecond, and the period of the system time, which counts them in 32 bits [ns]."""
FRAME2, FRAME3 = b"\x55\x04", b"\x55\x05"
"""Frame header and function mark that a frame begins with [bytes] (NLink protocol)."""
FIXED2, FIXED3 = 119, 21
"""Length of a frame before its nodes, of which the last byte is their number [bytes] (NLink protocol)."""
NODE2, NODE3 = struct.Struct("<BB3sBBI2x"), struct.Struct("<BB3sBB")
"""Role, id, distance [mm], powers [-0.5 dBm] and, in NodeFrame2, system time [ms] of a node (NLink protocol)."""


class LinkTrackDecoder:
    """Frames to ranges from the node that is connected to every node that it hears."""

    def __init__(self, dropped: Counter[str]):
        self._dropped = dropped
        self._buffer = b""

    def feed(self, data: bytes, received: int) -> list[Measured]:
        """Ranges of the frames that these bytes complete."""
        buffer, at = self._buffer + data, 0
        found: list[Measured] = []
        while (at := _begin(buffer, at)) + FIXED3 < len(buffer):
            length = _frame_length(buffer, at)
            if length is None:
                at += 1
            elif len(buffer) - at < length:
                break
            elif sum(buffer[at : at + length - 1]) & 0xFF != buffer[at + length - 1]:
                self._dropped[RangeLost.WRONG_SUM] += 1
                at += 1
            else:
                found += _ranges(buffer[at : at + length])
                at += length
        self._buffer = buffer[at:]
        return found


def _begin(buffer: bytes, at: int) -> int:
    """Where the next frame may begin; the end, or a last lone 55, where none does."""
    marks = [k for k in (buffer.find(FRAME2, at), buffer.find(FRAME3, at)) if k >= 0]
    if marks:
        return min(marks)
    return len(buffer) - 1 if buffer.endswith(b"\x55") and len(buffer) > at else len(buffer)


def _frame_length(buffer: bytes, at: int) -> int | None:
    """Length in the frame's own field, None where it is impossible or contradicts its number of nodes [bytes]."""
    fixed, size = (FIXED2, NODE2.size) if buffer[at + 1] == FRAME2[1] else (FIXED3, NODE3.size)
    length = buffer[at + 2] | buffer[at + 3] << 8
    count, rest = divmod(length - fixed - 1, size)
    if rest or not 0 <= count <= 255:
        return None
    number = at + fixed - 1
    return length if number >= len(buffer) or buffer[number] == count else None


def _ranges(frame: bytes) -> list[Measured]:
    second = frame[1] == FRAME2[1]
    fixed, node = (FIXED2, NODE2) if second else (FIXED3, NODE3)
    role, own = frame[4], frame[5]
    found = []
    for fields in node.iter_unpack(frame[fixed:-1]):
        its_role, its_id, distance, first_path, receive = fields[:5]
        system = fields[5] if second else int.from_bytes(frame[10:14], "little")
        # Tags and anchors count apart: one that shares the frame's own id gets role * 256 + id, as in recordings.
        target = its_id if its_id != own or its_role == role else its_role * 256 + its_id
        metres = int.from_bytes(distance, "little", signed=True) / 1000.0
        message = RangeMessage(0, own, target, metres, receive / -2.0, first_path / -2.0)
        found.append(Measured(message, system * MS))
    return found


class LinkTrack(SerialRadio):
    """Sends by itself what it was set up for (NodeFrame2 or NodeFrame3 in NAssistant)."""

    bauds = (921600,)

    def start(self, port: Port, options: Mapping[str, str], dropped: Counter[str]) -> Session:
        return Session(LinkTrackDecoder(dropped), b"", WRAP)
