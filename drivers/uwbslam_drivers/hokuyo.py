"""Hokuyo scanners that speak SCIP 2.x, over TCP (UTM-30LX-EW, UST) and serial or USB (URG, UTM-30LX).

Step range, resolution and speed are those the sensor reports. Its clock counts milliseconds in 24 bits; a stamp is of
the moment when the beam passes the rear (urg_node, getAngularTimeOffset), and the time of the first beam is reckoned
from there. A scan with damaged blocks is kept as far as it is intact.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from uwbslam_drivers import scip
from uwbslam_drivers.clock import host_time
from uwbslam_drivers.device import DeviceFailure, Measured, Option, Port, Session, read_until
from uwbslam_jax.measurements import NAN, ScanMessage
from uwbslam_jax.reasons import ScanLost

MS, WRAP = 1_000_000, (1 << 24) * 1_000_000
"""A millisecond, and the period of the sensor's clock, which counts them in 24 bits [ns] (SCIP 2.0, MD)."""
LEAST_INTACT = 0.1
"""A scan with a smaller share of intact beams is dropped: too few are left to be matched [dimensionless]."""
_HEAD = re.compile(rb"99b\n([0-o]{4})([0-o])\n")
"""Status 99 with its sum, then the stamp with its own [bytes]: how each scan begins (SCIP 2.0, MD)."""
_SLACK = 66
"""A reply that has lost its end is taken for complete after so many bytes too many: a block, its sum and LF [bytes]."""
_ATTEMPTS, _ANSWER = 8, 0.4
"""How often a command is sent at most, and how long its answer is waited for [s]: bytes are lost on serial lines."""
_FIELDS = ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")
"""Fields of PP that make a `Specification` [mm, mm, steps a turn, steps, steps, steps, turns a minute] (SCIP 2.0)."""


@dataclass(frozen=True)
class Specification:
    """What a sensor says of itself (PP).

    Attributes:
      first, last, front: steps of the first and last beam and of straight ahead.
      per_turn: steps a turn.
      nearest, farthest: limits of a distance [mm]; lower values are error codes.
      speed: turns a minute.
    """

    first: int
    last: int
    front: int
    per_turn: int
    nearest: int
    farthest: int
    speed: int

    @property
    def beams(self) -> int:
        return self.last - self.first + 1

    @property
    def turn(self) -> float:
        """Time of a turn [s]."""
        return 60.0 / self.speed

    @property
    def increment(self) -> float:
        """Angle between two beams [rad]."""
        return 2.0 * math.pi / self.per_turn

    @property
    def angle_min(self) -> float:
        return (self.first - self.front) * self.increment


UTM_30LX_EW = Specification(first=0, last=1080, front=540, per_turn=1440, nearest=23, farthest=60000, speed=2400)
"""What a UTM-30LX-EW answers to PP [steps, mm, turns a minute]: what emulator and tests take for a sensor."""


def parse_specification(lines: Mapping[str, str]) -> Specification | None:
    """Specification of the fields of a PP answer; None where one is missing or makes no sense."""
    try:
        nearest, farthest, per_turn, first, last, front, speed = (int(lines[name]) for name in _FIELDS)
    except (KeyError, ValueError):
        return None
    if not (0 <= first <= front <= last <= 9999 and last - first < per_turn and speed > 0 and 0 <= nearest < farthest):
        return None
    return Specification(first, last, front, per_turn, nearest, farthest, speed)


class HokuyoDecoder:
    """Replies to MD or ME (distances, or distances with intensities, 3 characters each) to scans."""

    def __init__(self, spec: Specification, dropped: Counter[str], intensities: bool = False):
        self._spec = spec
        self._dropped = dropped
        self._values = spec.beams * (2 if intensities else 1)
        self._length = scip.body_length(self._values)
        # A reply whose empty last line is damaged ends where the echo of the next begins.
        self._end = re.compile(b"\n\n|\nM[DE]%04d%04d" % (spec.first, spec.last))
        self._buffer = bytearray()

    def feed(self, data: bytes, received: int) -> list[Measured]:
        """Scans whose last byte is among these; stamped on the sensor's clock."""
        self._buffer += data
        found = []
        while (taken := self._take()) is not None:
            if (scan := self._scan(*taken)) is not None:
                found.append(scan)
        return found

    def _take(self) -> tuple[bytes, bytes] | None:
        """Stamp and blocks of the next reply in the buffer, and drops it there; None where none is complete."""
        head = _HEAD.search(self._buffer)
        if head is None:
            del self._buffer[: max(0, len(self._buffer) - _SLACK)]
            return None
        begin = head.end()
        end = self._end.search(self._buffer, begin, begin + self._length + _SLACK)
        if end is not None:
            stop = end.start() + 1
        elif len(self._buffer) - begin >= self._length + _SLACK:
            stop = begin + self._length
        else:
            del self._buffer[: head.start()]
            return None
        stamp, body = bytes(head[1] + head[2]), bytes(self._buffer[begin:stop])
        del self._buffer[:stop]
        return stamp, body

    def _scan(self, stamp: bytes, body: bytes) -> Measured | None:
        spec = self._spec
        if not scip.intact(stamp):
            self._dropped[ScanLost.STAMP_DAMAGED] += 1
            return None
        values, good, damaged = scip.decode_blocks(body, self._values)
        if damaged:
            self._dropped["scan: blocks damaged"] += damaged
        step = self._values // spec.beams
        values, good = values[::step], good[::step]
        if np.mean(good) < LEAST_INTACT:
            self._dropped[ScanLost.NOT_INTACT] += 1
            return None
        hit = values >= max(spec.nearest, 1)
        ranges = np.where(good, np.where(hit, values * np.float32(1e-3), np.inf), NAN).astype(np.float32)
        limits = (spec.nearest / 1e3, spec.farthest / 1e3)
        first_beam = round((spec.angle_min + math.pi) / (2.0 * math.pi) * spec.turn * 1e9)
        device = scip.decode(stamp[:4]) * MS + first_beam
        message = ScanMessage(0, spec.angle_min, spec.increment, spec.turn / spec.per_turn, *limits, ranges)
        return Measured(message, device)


class Hokuyo:
    """Handshake: QT, SCIP2.0, VV, PP, II, TM for the clock, then MD or ME without end."""

    kind = "lidar"
    bauds = (115200,)
    dtr = True
    tcp_port = 10940
    silence = 2.0
    options: Mapping[str, Option] = {"mode": Option("md", "md|me", "md or me")}

    def start(self, port: Port, options: Mapping[str, str], dropped: Counter[str]) -> Session:
        mode = options["mode"]
        _ask(port, b"QT", attempts=3)
        _ask(port, b"SCIP2.0", attempts=1)  # old sensors start in SCIP 1; those in SCIP 2 answer with an error
        _ask(port, b"VV", attempts=2)
        spec = _specification(port)
        state = _ask(port, b"II", attempts=2)
        if state is not None and (broken := _malfunction(state)):
            raise DeviceFailure(f"the sensor reports {broken}")
        reference = _synchronise(port)
        # Single steps (01), every scan (0), without end (00).
        port.write(b"%s%04d%04d01000\n" % (mode.upper().encode(), spec.first, spec.last))
        least = round((spec.beams - 1) / spec.per_turn * spec.turn * 1e9)
        return Session(HokuyoDecoder(spec, dropped, mode == "me"), b"", WRAP, least, reference)


def _ask(port: Port, command: bytes, attempts: int = _ATTEMPTS) -> list[bytes] | None:
    """Lines of the answer to a command after echo and status, None where none came."""
    for _ in range(attempts):
        port.write(command + b"\n")
        answer = read_until(port, lambda received: _answer(received, command), _ANSWER)
        if answer is not None:
            return answer
    return None


def _answer(received: bytes, command: bytes) -> list[bytes] | None:
    begin = received.find(command + b"\n")
    end = received.find(b"\n\n", begin)
    return [line for line in received[begin:end].split(b"\n")[2:] if line] if min(begin, end) >= 0 else None


def _fields(lines: list[bytes]) -> dict[str, str]:
    """NAME:VALUE;sum lines whose sum is right; it is of what stands before the semicolon."""
    found = {}
    for line in lines:
        text, semicolon, total = line.rpartition(b";")
        if semicolon and len(total) == 1 and total[0] == scip.checksum(text):
            name, _, value = text.decode("ascii", "replace").partition(":")
            found[name] = value
    return found


def _specification(port: Port) -> Specification:
    fields: dict[str, str] = {}
    heard = False
    for _ in range(_ATTEMPTS):
        answer = _ask(port, b"PP", attempts=1)
        heard = heard or answer is not None
        fields |= _fields(answer or [])
        spec = parse_specification(fields)
        if spec is not None:
            return spec
    if heard and not fields:
        raise DeviceFailure("the sensor refuses PP: it speaks SCIP 1 only, update its firmware (URG-04LX: 3.3.00)")
    if heard:
        raise DeviceFailure(f"the answer to PP is damaged or incomplete, it has only {', '.join(fields)}")
    raise DeviceFailure("no answer to PP: not a SCIP 2 sensor, no power, or another program or speed at its port")


def _malfunction(lines: list[bytes]) -> str | None:
    state = _fields(lines).get("STAT", "")
    return state if "malfunction" in state.lower() or "failure" in state.lower() else None


def _synchronise(port: Port) -> tuple[int, int] | None:
    """Time on the sensor's clock and on ours [ns] of one moment, from the quickest of several exchanges."""
    if _ask(port, b"TM0", attempts=3) is None:
        return None
    best: tuple[int, int, int] | None = None
    for _ in range(_ATTEMPTS):
        sent = host_time()
        answer = _ask(port, b"TM1", attempts=1)
        took = host_time() - sent
        if answer and len(answer[0]) == 5 and scip.intact(answer[0]) and (best is None or took < best[0]):
            best = took, scip.decode(answer[0][:4]) * MS, sent + took // 2
    _ask(port, b"TM2", attempts=3)
    return None if best is None else best[1:]
