"""DWM1000 boards behind a microcontroller: our own line protocol, documented in drivers/README.md.

    $UWBD,time,source,target,range,prf,F1,F2,F3,C,N*CRC    with the DW1000's diagnostics
    $UWBP,time,source,target,range,receive,first*CRC       with powers, which may be left empty

time is the microcontroller's clock [us, 32 bits, wraps], range in mm, powers in dBm, CRC the CRC-16/CCITT-FALSE of the
characters between $ and * as four hexadecimal digits.
"""

from __future__ import annotations

import binascii
import math
import re
from collections import Counter
from collections.abc import Mapping

from uwbslam_drivers.device import Measured, Port, SerialRadio, Session
from uwbslam_drivers.lines import LineDecoder
from uwbslam_jax.measurements import NAN, RangeMessage

US, WRAP = 1000, (1 << 32) * 1000
"""A microsecond, and the period of the board's clock, which counts them in 32 bits [ns]."""
PRF_CONSTANT = {16: 113.77, 64: 121.74}
"""A of the power formulas by pulse repetition frequency [MHz -> dB] (DW1000 user manual, 4.7.1)."""
_LINE = re.compile(rb"\$(UWB[DP]),(\d{1,10}),(\d{1,10}),(\d{1,10}),(-?\d{1,8}),([-0-9.,]*)\*([0-9A-Fa-f]{4})$")
"""A line without its end [text]; what stands in its fields is checked after its CRC."""


def checksum(text: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 1021, start FFFF; that of b"123456789" is 29B1."""
    return binascii.crc_hqx(text, 0xFFFF)


def frame(text: str) -> bytes:
    """A line of the protocol around the text between $ and *."""
    return b"$%s*%04X\r\n" % (text.encode(), checksum(text.encode()))


def powers(prf: int, f1: int, f2: int, f3: int, c: int, n: int) -> tuple[float, float]:
    """Receive and first-path power [dBm] of the DW1000's diagnostics (user manual 4.7.1 and 4.7.2).

    Args:
      prf: pulse repetition frequency [MHz], 16 or 64.
      f1, f2, f3: FP_AMPL1, FP_AMPL2, FP_AMPL3. c: CIR_PWR. n: RXPACC.

    Returns:
      NaN for what is not known: an unknown prf, n = 0 or no amplitude.
    """
    constant = PRF_CONSTANT.get(prf, NAN)
    first, receive = f1 * f1 + f2 * f2 + f3 * f3, c << 17
    return _decibel(receive, n) - constant, _decibel(first, n) - constant


def _decibel(power: int, n: int) -> float:
    return 10.0 * math.log10(power / (n * n)) if power > 0 and n > 0 else NAN


class Dwm1000Decoder(LineDecoder):
    """Lines to ranges, stamped on the board's clock."""

    mark, sign = b"$UWB", b"*"

    def ranges(self, line: bytes, received: int) -> list[Measured] | None:
        measured = parse(line)
        return None if measured is None else [measured]


def parse(line: bytes) -> Measured | None:
    """The range of one line without its end; None where the line is damaged."""
    match = _LINE.match(line)
    if match is None or checksum(line[1:-5]) != int(match[7], 16):
        return None
    time, source, target, millimetres = (int(word) for word in match.groups()[1:5])
    words = match[6].decode().split(",")
    if max(time, source, target) >= 1 << 32:
        return None
    try:
        if match[1] == b"UWBD":
            prf, *diagnostics = (int(word) for word in words)
            if len(diagnostics) != 5 or not all(0 <= value <= 0xFFFF for value in diagnostics):
                return None
            receive, first = powers(prf, *diagnostics)
        else:
            receive, first = (_power(word) for word in words)
    except ValueError:
        return None
    return Measured(RangeMessage(0, source, target, millimetres / 1e3, receive, first), time * US)


def _power(word: str) -> float:
    if len(word) > 8:
        raise ValueError(word)
    return float(word) if word else NAN


class Dwm1000(SerialRadio):
    """Sends by itself."""

    def start(self, port: Port, options: Mapping[str, str], dropped: Counter[str]) -> Session:
        return Session(Dwm1000Decoder(dropped), b"", WRAP)
