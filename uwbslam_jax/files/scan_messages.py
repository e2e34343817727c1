"""What a laser scan's message says, and what its driver means by it.

Which layout a message has is found by `schemas`. Drivers differ in units, in how they tell no return, and in how well
their bearings fit their readings: what cannot be is read as the one thing that it can be, and told.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from uwbslam_jax.files.sweep_parts import SweepJoiner, in_parts
from uwbslam_jax.measurements import Message, ScanMessage
from uwbslam_jax.reasons import ScanLost

FIRST_LOOK = 60
"""So many messages tell how a driver means what it says [scans]."""
_TURN, _TURN_SLACK = 2 * math.pi, 1.05
"""No scan spans more than a turn [rad], but drivers give the first bearing twice, or run on a little [ratio]."""
_END_SLACK = 1.5
"""The last reading may lie so far from angle_max [increments]: drivers count one more or less."""
_READINGS_VARY = 0.05
"""A number of readings that is off by up to this share is that of a motor whose speed varies: the ends hold. Beyond it
a driver may as well have cut the readings and left angle_max [ratio]."""
_SWEEP_SLACK = 1.5
"""A sweep lasts at most so many times the interval between scans [ratio]."""
_SWEEP_NEAR = 10.0
"""A unit of time_increment fits where the sweep then is within this factor of one turn a scan [ratio]."""
_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""What time_increment is given in by mistake [s]."""
_FEWEST_EQUAL, _SHARE_EQUAL, _SCANS_EQUAL = 10, 0.03, 3
"""So many readings of a scan, and this share, that are exactly its largest mean no return where so many scans agree:
noise and slope let no wall look so [readings, ratio, scans]."""
_MOST_EQUAL = 0.1
"""Such a share of a scan needs no other scan to agree [ratio]."""
_ROUNDING = 1e-6
"""Readings so close are the same [ratio]: single precision."""
_BLUR = 0.05
"""A no return at range_max that a simulator added noise to lies within this of it [ratio]."""
_NOISE_BELOW = 1.5
"""So far below the limit as the farthest reading lies beyond it the noise may reach [ratio]."""
_FARTHEST_M, _USUAL_M = 100.0, 5.0
"""Readings of which three quarters are larger are no metres: of the units below the one that brings them nearest to
the second [m]."""
_LENGTHS = {"cm": 0.01, "mm": 0.001}
"""What readings are given in by mistake [m]."""
_FEWEST_SCANS = 5
"""Fewer tell no interval [scans]."""
_RENAMED_S = 2.0
"""A scanner that is silent for so long while another frame_id goes on was renamed [s]."""


_VARINT_BYTES = 10
"""A number of 64 bits takes at most so many [bytes] (protobuf.dev/programming-guides/encoding)."""


class _Bearings(NamedTuple):
    """angle_min and angle_increment [rad]; what was amiss, a key of `_AMISS`, "" for nothing."""

    first: float
    increment: float
    amiss: str = ""


_AMISS = {
    "degrees": "bearings of the scans are in degrees: they are converted",
    "ends": "angle_increment of the scans does not fit angle_min, angle_max and the number of readings: they are taken "
    "as spread evenly from angle_min to angle_max",
    "sign": "angle_increment of the scans has the other sign than angle_max - angle_min: they are taken as spread from "
    "angle_min to angle_max; if the map is mirrored say --robot.lidar-flip",
    "header": "angle_max of the scans does not fit angle_min, angle_increment and the number of readings: angle_max is "
    "not used; see whether the map is bent or mirrored (--robot.lidar-flip)",
    "refused": "scans are left out: with their number of readings neither angle_increment nor angle_max stays within "
    "one turn, in radians or degrees; see the driver's settings",
}
"""What is told of bearings [text]."""


@dataclass
class _Facts:
    """What the first scans of a scanner said, one value each: stamp [ns], time [s] and bearing [rad] from the first
    reading to the last, what a quarter of the readings is below [m], whether none is within its limits, itself."""

    stamps: list[int] = field(default_factory=list)
    sweeps: list[float] = field(default_factory=list)
    spans: list[float] = field(default_factory=list)
    nearer: list[float] = field(default_factory=list)
    outside: list[bool] = field(default_factory=list)
    scans: list[ScanMessage] = field(default_factory=list)

    def interval(self) -> float | None:
        """Usual time between scans [s], None where there are too few."""
        apart = np.diff(np.sort(np.array(self.stamps, np.int64)))
        apart = apart[apart > 0]
        return float(np.median(apart)) / 1e9 if len(apart) >= _FEWEST_SCANS else None


class ScanReader:
    """Scans out of the messages of a recording. The first of them are read twice: until `settle` is called they only
    tell how their driver means what it says, and what it says of times once `settle_time` is.

    Attributes:
      frame: frame_id of the scanner that is used; None while none is known.
      frames: messages by frame_id, used or not.
      told: what was found and how it is taken, one line each, by what it is about.
      noted: what is worth knowing though nothing is wrong, "" for nothing.
    """

    def __init__(self, frame: str = ""):
        """frame: of the scanner to use where one topic carries several; "" for the one with most scans."""
        self.frame: str | None = frame or None
        self.frames: Counter[str] = Counter()
        self.told: dict[str, str] = {}
        self._chosen = bool(frame)
        self._facts: defaultdict[str, _Facts] | None = defaultdict(_Facts)
        self._own = _Facts()
        self._last = 0
        self._interval, self._time_scale, self._scale, self._limited = 0.0, 1.0, 1.0, True
        self.noted = ""
        self._joiner: SweepJoiner | None = None
        self._equal: Counter[float] = Counter()
        self._no_return: list[float] = []

    def settle(self) -> None:
        """The first look is over."""
        facts, self._facts = self._facts, None
        if not facts:
            return
        if self.frame is None:
            self.frame = self.frames.most_common(1)[0][0]
        if len(self.frames) > 1 and not self._chosen:
            self._tell_scanners()
        if self.frame not in self.frames:
            names = ", ".join(name or "none" for name in sorted(self.frames))
            self.told["scanners"] = f"no scan has the frame_id {self.frame} of --lidar.frame: there are {names}"
        self.frames.clear()
        self._own = facts.get(self.frame, _Facts())
        self._learn_lengths(self._own)
        if in_parts(self._own.scans):
            degrees = math.degrees(float(np.median(self._own.spans)))
            self._joiner = SweepJoiner()
            self.noted = f"scans of {degrees:.0f} deg are parts of a sweep, and put together"
        self._own.scans.clear()

    def settle_time(self, rate: float) -> None:
        """Settles what time_increment is given in, once it is known how many times as fast as time stamps pass; 0 where
        they do not tell."""
        interval = self._own.interval()
        if interval is not None and rate > 0.0:
            self._learn_time(self._own, interval / rate)

    def take(self, message: Any, stamp: int, dropped: Counter[str]) -> list[Message]:
        """The scan of a LaserScan, ROS's or Foxglove's; none, counted, where there is none to be used."""
        ranges = np.array(message.ranges, dtype=np.float32).reshape(-1)
        if ranges.size == 0:
            dropped[ScanLost.NO_BEAMS] += 1
            return []
        if not self._is_own(frame := frame_of(message), stamp):
            dropped[ScanLost.OTHER_SCANNER] += 1
            return []
        time_increment, limits = 0.0, (0.0, math.inf)
        if hasattr(message, "start_angle"):  # foxglove: the sweep's two ends, no limits, taken at once
            first, last = float(message.start_angle), float(message.end_angle)
            bearings = _bearings(first, last, (last - first) / max(ranges.size - 1, 1), ranges.size)
        else:
            first, last = float(message.angle_min), float(getattr(message, "angle_max", math.nan))
            bearings = _bearings(first, last, float(message.angle_increment), ranges.size)
            time_increment, limits = float(message.time_increment), (float(message.range_min), float(message.range_max))
        if not limits[0] < limits[1]:  # drivers that leave both at 0 mean: no limits
            limits = (0.0, math.inf)
        if not math.isfinite(time_increment):
            raise ValueError("no time")
        if bearings is None:
            self.told["refused"] = _AMISS["refused"]
            dropped[ScanLost.IMPOSSIBLE] += 1
            return []
        if bearings.amiss:
            self.told[bearings.amiss] = _AMISS[bearings.amiss]
        if self._facts is not None:
            self._look(self._facts[frame], stamp, bearings, ranges.size, time_increment)
            self._look_at_lengths(self._facts[frame], ranges, limits)
        else:
            time_increment = self._timed(time_increment, bearings.increment)
        if self._scale != 1.0:
            ranges = ranges * np.float32(self._scale)
            limits = (limits[0] * self._scale, limits[1] * self._scale) if limits[1] > _FARTHEST_M else limits
        limits = limits if self._limited else (0.0, math.inf)
        ranges = self._returns(ranges, limits)
        scan = ScanMessage(stamp, bearings.first, bearings.increment, time_increment, *limits, ranges)
        if self._facts is not None:
            self._facts[frame].scans.append(scan)
        return [scan] if self._joiner is None else [*self._joiner.take(scan)]

    def _is_own(self, frame: str, stamp: int) -> bool:
        """Whether a scan is of the scanner that is used."""
        self.frames[frame] += 1
        if self._facts is not None or self.frame is None or frame == self.frame:
            self._last = stamp
            return True
        if not self._chosen and stamp - self._last > _RENAMED_S * 1e9:
            self.told["renamed"] = (
                f"the scans' frame_id changes from {self.frame or 'none'} to {frame or 'none'}: taken as one scanner, "
                "mounted as before; with --lidar.frame FRAME only those of one frame are used"
            )
            self.frame, self._last = frame, stamp
            return True
        if not self._chosen:
            self._tell_scanners()
        return False

    def _tell_scanners(self) -> None:
        names = " and ".join(name or "none" for name in sorted(self.frames))
        self.told["scanners"] = (
            f"several scanners on one topic, frame_id {names}: only {self.frame or 'none'} is used; choose with "
            "--lidar.frame FRAME"
        )

    def _look(self, facts: _Facts, stamp: int, bearings: _Bearings, readings: int, time_increment: float) -> None:
        facts.stamps.append(stamp)
        facts.sweeps.append(abs(time_increment) * (readings - 1))
        facts.spans.append(abs(bearings.increment) * (readings - 1))

    def _look_at_lengths(self, facts: _Facts, ranges: np.ndarray, limits: tuple[float, float]) -> None:
        seen = ranges[(ranges > 0.0) & (ranges < math.inf)]
        seen = seen[seen < seen.max()] if seen.size else seen  # the largest may mean no return
        if 2 * seen.size > ranges.size:
            facts.nearer.append(float(np.quantile(seen, 0.25)))
            facts.outside.append(not ((seen > limits[0]) & (seen < limits[1])).any())

    def _learn_lengths(self, facts: _Facts) -> None:
        """Finds the unit of readings that are no metres, and limits that no reading keeps."""
        if len(facts.nearer) < _FEWEST_SCANS:
            return
        typical = float(np.median(facts.nearer))
        if typical > _FARTHEST_M:
            unit = min(_LENGTHS, key=lambda name: abs(math.log(typical * _LENGTHS[name] / _USUAL_M)))
            self._scale = _LENGTHS[unit]
            self._equal.clear()
            self._no_return.clear()
            self.told.pop("no return", None)
            self.told["lengths"] = (
                f"readings of the scans, {typical:.0f} as a rule, are taken for {unit}, so for "
                f"{typical * self._scale:.1f} m; see the LiDAR's driver"
            )
        elif all(facts.outside):
            self._limited = False
            self.told["limits"] = (
                "no reading of the scans is between their range_min and range_max: these are not used; see the LiDAR's "
                "driver, or say --lidar.min-range and --lidar.max-range"
            )

    def _learn_time(self, facts: _Facts, interval: float) -> None:
        """Finds what time_increment is given in, where a sweep would last longer than the time between scans."""
        sweep = float(np.median(facts.sweeps))
        if not sweep > _SWEEP_SLACK * interval:
            return
        turn = interval * min(float(np.median(facts.spans)) / _TURN, 1.0)
        says = f"time_increment of the scans makes a sweep of {sweep:.3g} s, but they come every {interval:.3g} s"
        unit = min(_UNITS, key=lambda name: abs(math.log(sweep * _UNITS[name] / turn)))
        if abs(math.log(sweep * _UNITS[unit] / turn)) < math.log(_SWEEP_NEAR):
            self._time_scale = _UNITS[unit]
            self.told["time"] = f"{says}: taken as {unit}"
        else:
            self._interval = interval
            self.told["time"] = f"{says}: not used, the mirror is taken to turn once a scan; see the driver's settings"

    def _timed(self, time_increment: float, increment: float) -> float:
        """time_increment as it is meant [s]."""
        if self._interval > 0.0:
            return math.copysign(self._interval * min(abs(increment) / _TURN, 1.0), time_increment)
        return time_increment * self._time_scale if self._time_scale != 1.0 else time_increment

    def _returns(self, ranges: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
        """Readings (n,) [m], inf where one between the limits [m] means no return all the same."""
        low, high = limits
        enough = max(_FEWEST_EQUAL, math.ceil(_SHARE_EQUAL * ranges.size))
        rising, edges = np.sort(ranges), np.array([low, high, math.inf], np.float32)  # NaN come last
        first, below, finite = rising.searchsorted(edges).tolist()
        if below >= enough and rising[below - enough] == rising[below - 1] > low:
            top = float(rising[below - 1])
            if top not in self._no_return:
                count = below - int(rising.searchsorted(rising[below - 1]))
                self._equal[top] += 1
                if self._equal[top] >= _SCANS_EQUAL or count >= _MOST_EQUAL * ranges.size:
                    self._no_return.append(top)
                    self.told["no return"] = (
                        f"many readings of the scans are exactly {top:g} m, the largest there is: taken as no return; "
                        "with --lidar.max-range the driver's limit can be given"
                    )
        for value in self._no_return:
            ranges = np.where(np.abs(ranges - value) <= _ROUNDING * value, np.float32(math.inf), ranges)
        if finite - below >= enough:
            beyond = ranges[(ranges >= high) & (ranges < math.inf)]
            if beyond.size >= enough and (edge := float(beyond.max()) - high) <= _BLUR * high:
                near = (ranges > high - _NOISE_BELOW * edge) & (ranges < high)
                ranges = np.where(near, np.float32(math.inf), ranges)
        if low > 0.0 and first + enough <= ranges.size and rising[first + enough - 1] == edges[0]:
            ranges = np.where(ranges == edges[0], np.float32(math.inf), ranges)
        return ranges


def frame_of(message: Any) -> str:
    """frame_id of a message without a leading slash, "" where it has none."""
    name = getattr(getattr(message, "header", message), "frame_id", "")
    return name.lstrip("/") if isinstance(name, str) else ""


@lru_cache(maxsize=16)
def _bearings(first: float, last: float, increment: float, readings: int) -> _Bearings | None:
    """Bearings of a scan's readings out of angle_min, angle_max and angle_increment; None where they cannot be.

    The increment holds where the last reading then lies at angle_max, whole turns aside, or angle_max is not given.
    """
    steps = max(readings - 1, 1)
    if readings == 1:
        return _Bearings(first, increment) if math.isfinite(first) else None
    if not math.isfinite(first):
        return None
    told = math.isfinite(last) and last != 0.0
    fits = _within_a_turn(increment * steps)
    if fits and (not told or _ends_at(first, increment, steps, last)):
        return _Bearings(first, increment)
    for of_ends, of_step in ((True, True), (True, False), (False, True)) if told else ():
        a, b = (math.radians(x) if of_ends else x for x in (first, last))
        step = math.radians(increment) if of_step else increment
        if _within_a_turn(step * steps) and abs(a + step * steps - b) <= _END_SLACK * abs(step):
            return _Bearings(a, step, "degrees")
    span = last - first
    if not _within_a_turn(span):
        return _Bearings(first, increment, "header") if fits else None
    if fits and abs(span + increment * steps) <= _END_SLACK * abs(increment):
        return _Bearings(first, span / steps, "sign")
    if fits:
        ratio = span / (increment * steps)
        thinned = ratio > 1.5 and abs(ratio - round(ratio)) < 0.02 * ratio
        if abs(ratio - 1.0) > _READINGS_VARY and not thinned:
            return _Bearings(first, increment, "header")
    return _Bearings(first, span / steps, "ends")


def _within_a_turn(span: float) -> bool:
    return 0.0 < abs(span) <= _TURN * _TURN_SLACK


def _ends_at(first: float, increment: float, steps: int, last: float) -> bool:
    """Whether the last of so many steps leads to a bearing, whole turns aside [rad]."""
    return abs(math.remainder(first + increment * steps - last, _TURN)) <= _END_SLACK * abs(increment) + 1e-4


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 7 * _VARINT_BYTES, 7):
        byte = data[position]
        value |= (byte & 0x7F) << shift
        position += 1
        if byte < 0x80:
            return value, position
    raise ValueError("a number without end")


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
