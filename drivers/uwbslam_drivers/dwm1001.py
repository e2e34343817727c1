"""Qorvo DWM1001 modules in shell mode: the lines of `lec`, DIST,n,ANi,ID,x,y,z,distance,...,POS,x,y,z,quality.

The surveyed positions that they carry are not used. The lines carry neither time nor power (DWM1001 firmware API guide,
section 4, shell commands), nor the id of the module that is connected: that is the option `id`.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping

from uwbslam_drivers.device import DeviceFailure, Measured, Option, Port, SerialRadio, Session, read_until
from uwbslam_drivers.lines import LineDecoder
from uwbslam_jax.measurements import RangeMessage

_LISTEN, _ANSWER = 0.6, 1.5
"""Longest wait for a line of a module that sends several a second already, and for the shell's banner [s]."""

_TLV = b"\x40\x01"
"""What a module in generic mode answers to a request that it does not know [bytes] (firmware API guide, 5.2)."""


class Dwm1001Decoder(LineDecoder):
    """Lines to ranges from the module that is connected; stamped with their arrival."""

    mark = sign = b"DIST,"

    def __init__(self, own: int, dropped: Counter[str]):
        """own: node id of the module that is connected."""
        super().__init__(dropped)
        self._own = own

    def ranges(self, line: bytes, received: int) -> list[Measured] | None:
        found = parse(line)
        return (
            None if found is None else [Measured(RangeMessage(received, self._own, *fields), None) for fields in found]
        )


def parse(line: bytes) -> list[tuple[int, float]] | None:
    """Id and distance [m] of each anchor of a DIST line; None where its fields are not as they should be."""
    try:
        words = line.decode("ascii").split(",")
        count = int(words[1])
        rest = words[2 + 6 * count :]
        if not 0 <= count <= 64 or len(words) < 2 + 6 * count or rest[:1] not in ([], ["POS"]):
            return None
        found = []
        for k in range(count):
            name, node, *_, distance = words[2 + 6 * k : 8 + 6 * k]
            metres = float(distance)
            if name != f"AN{k}" or len(node) != 4 or not math.isfinite(metres):
                return None
            found.append((int(node, 16), metres))
        return found
    except (ValueError, IndexError):
        return None


class Dwm1001(SerialRadio):
    """Enters the shell with two Returns and starts `lec`, unless the module sends lines already."""

    options: Mapping[str, Option] = {"id": Option("0", r"\d{1,9}", "a whole number")}

    def start(self, port: Port, options: Mapping[str, str], dropped: Counter[str]) -> Session:
        session = Session(Dwm1001Decoder(int(options["id"]), dropped))
        # A second `lec` would end the first, and Return in the shell repeats the last command: listen before.
        if _hears(port, b"DIST", _LISTEN):
            return session
        port.write(b"\r")
        time.sleep(0.1)
        port.write(b"\r")
        if not _hears(port, b"dwm>", _ANSWER) and not _hears(port, b"DIST", _LISTEN):
            port.write(b"\r")
            if _hears(port, _TLV, _LISTEN):
                raise DeviceFailure(
                    "the module stays in generic (TLV) mode: its firmware (PANS R2) must offer the shell"
                )
            raise DeviceFailure("no shell: not a DWM1001 in UART shell mode, no power, or another baud than 115200")
        port.write(b"lec\r")
        return session


def _hears(port: Port, word: bytes, timeout: float) -> bool:
    """Whether a word arrives within a time [s]."""
    return read_until(port, lambda received: word in received or None, timeout) is not None
