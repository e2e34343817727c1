"""What the measurements of a recording say about it: nodes, pauses, and what is peculiar about scans and odometry."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage, ScanMessage, TruthMessage
from uwbslam_jax.session import OdometryTrack, Recent

_PAUSE_S = 10.0
"""Nothing measured for so long is a pause worth a word [s]."""
_AWAY = 0.2
"""A node that is heard neither in the first nor in the last such share of a recording comes or goes [ratio]."""
_THINGS: dict[type, str] = {ScanMessage: "scans", RangeMessage: "ranges", OdometryMessage: "odometry poses"}
"""What measurements are called [message type -> words]."""
_COPIED = 0.2
"""Copies of such a share of a sensor's measurements are worth a word [ratio]."""
_FEW = 20
"""What fewer scans or ranges show is chance [messages]."""
_OWN_M, _OWN_SPREAD_M, _WORLD_SPREAD_M = 0.7, 0.05, 0.5
"""A bearing whose readings are all this near and spread no more than that sees the robot itself, where half of the
others spread more than the last: the robot moved [m]."""
_AT_LIMIT = 0.01
"""So many of the readings that are the sensor's own limit mean no return [ratio]."""


@dataclass
class LogFacts:
    """Gathered message by message.

    Attributes:
      ids: exchanges each node took part in. pairs: exchanges by pair of ids, the smaller first.
      powers: whether ranges report both powers. beams: most beams of a scan.
    """

    ids: Counter[int] = field(default_factory=Counter)
    pairs: Counter[tuple[int, int]] = field(default_factory=Counter)
    powers: bool = False
    beams: int = 0
    _fewest: int = 0
    _copies: Counter[str] = field(default_factory=Counter)
    _recent: Recent = field(default_factory=Recent)
    _spans: dict[type, tuple[int, int]] = field(default_factory=dict)
    _ranges: dict[tuple[int, int], float] = field(default_factory=dict)
    _still: bool = True
    _heard: dict[int, tuple[int, int]] = field(default_factory=dict)
    _first: int | None = None
    _last: int = 0
    _pauses: list[tuple[float, float]] = field(default_factory=list)
    _scans: int = 0
    _timed: bool = False
    _readings: int = 0
    _blank: int = 0
    _at_limit: Counter[float] = field(default_factory=Counter)
    _least: np.ndarray = field(default_factory=lambda: np.zeros(0))
    _most: np.ndarray = field(default_factory=lambda: np.zeros(0))
    _wheels: OdometryTrack = field(default_factory=OdometryTrack)
    _odometry_at: int = -1

    def take(self, messages: list[Message]) -> None:
        """Takes in messages on one clock."""
        for message in messages:
            if self._is_copy(message):
                continue
            match message:
                case RangeMessage():
                    self._take_range(message)
                case ScanMessage():
                    self._take_scan(message)
                case OdometryMessage() if message.stamp > self._odometry_at:
                    self._odometry_at = message.stamp
                    self._wheels.join(message)
                case TruthMessage():
                    continue
            known = self._spans.setdefault(type(message), (message.stamp, message.stamp))
            self._spans[type(message)] = min(known[0], message.stamp), max(known[1], message.stamp)
            if self._first is None:
                self._first = self._last = message.stamp
            if message.stamp - self._last > _PAUSE_S * 1e9:
                self._pauses.append(((self._last - self._first) / 1e9, (message.stamp - self._last) / 1e9))
            self._last = max(self._last, message.stamp)

    def _is_copy(self, message: Message) -> bool:
        match message:
            case RangeMessage():
                kind, of = "ranges", (min(message.source, message.target), max(message.source, message.target))
            case ScanMessage():
                kind, of = "scans", (0, 0)
            case _:
                return False
        copy = self._recent.has((kind, of), message.stamp)
        self._copies[kind] += copy
        self._recent.add((kind, of), message.stamp)
        return copy

    def notes(self) -> list[str]:
        """What a user should know, one line each."""
        lines = [f"nothing was measured for {long:.1f} s after {after:.1f} s" for after, long in self._pauses[:5]]
        heard = {"ranges": self.pairs.total(), "scans": self._scans}
        lines += [
            f"{count} of {count + heard[kind]} {kind} are copies of one before, and count once: two recordings were "
            "merged, or both nodes tell of each exchange"
            for kind, count in self._copies.items()
            if count > _COPIED * (count + heard[kind])
        ]
        if self._still and self.pairs.total() >= _FEW * max(len(self.pairs), 1):
            lines.append("no range ever changes: the radio repeats one")
        lines += self._of_nodes() + self._of_scans() + self._wheels.told()
        return lines

    def _take_range(self, message: RangeMessage) -> None:
        pair = min(message.source, message.target), max(message.source, message.target)
        self.pairs[pair] += 1
        self._still = self._still and self._ranges.setdefault(pair, message.range) == message.range
        self.ids.update(pair)
        self.powers = self.powers or not math.isnan(message.receive_power - message.first_path_power)
        for node in pair:
            self._heard[node] = self._heard.get(node, (message.stamp, 0))[0], message.stamp

    def _take_scan(self, message: ScanMessage) -> None:
        size = message.ranges.size
        self._fewest = min(self._fewest or size, size)
        self.beams = max(self.beams, size)
        self._timed = self._timed or message.time_increment != 0
        self._scans += 1
        self._readings += size
        if math.isfinite(message.range_max):  # within the rounding of single precision
            at = int(np.count_nonzero(np.isclose(message.ranges, message.range_max, rtol=1e-6, atol=0.0)))
            self._at_limit[message.range_max] += at
        seen = np.isfinite(message.ranges) & (message.ranges > 0)
        self._blank += not seen.any()
        if len(self._least) != size:  # of several sizes only the first that stays is looked at
            if self._scans > _FEW:
                return
            self._least, self._most = np.full(size, np.inf), np.zeros(size)
        near = np.where(seen, message.ranges, np.inf)
        np.minimum(self._least, near, out=self._least)
        np.maximum(self._most, near, out=self._most)

    def _of_nodes(self) -> list[str]:
        if self._first is None:
            return []
        long = self._last - self._first
        lines = []
        for kind, things in _THINGS.items():
            first, last = self._spans.get(kind, (self._first, self._last))
            if first - self._first > _AWAY * long:
                lines.append(f"{things} begin after {(first - self._first) / 1e9:.1f} s")
            if self._last - last > _AWAY * long:
                lines.append(f"{things} end after {(last - self._first) / 1e9:.1f} s")
        often = {node: span for node, span in self._heard.items() if self.ids[node] >= _FEW}
        joins = {node: (a - self._first) / 1e9 for node, (a, _) in often.items() if a - self._first > _AWAY * long}
        ends = {node: (b - self._first) / 1e9 for node, (_, b) in often.items() if self._last - b > _AWAY * long}
        lines += [f"node {node} is first heard after {after:.1f} s" for node, after in sorted(joins.items())]
        lines += [f"node {node} is last heard after {after:.1f} s" for node, after in sorted(ends.items())]
        return lines[:10]

    def _of_scans(self) -> list[str]:
        if self._scans < _FEW:
            return []
        lines = []
        if self._fewest != self.beams:
            lines.append(f"scans have {self._fewest} to {self.beams} readings")
        lines += [f"{self._blank} scans hold no return"] if self._blank else []
        if not self._timed:
            lines.append("scans have no time_increment: if the LiDAR turns, its sweeps are bent by the robot's motion")
        for limit, count in self._at_limit.most_common(1):
            if count > _AT_LIMIT * self._readings:
                share = 100 * count / self._readings
                lines.append(f"no return is told as range_max, {limit:.4g} m ({share:.0f} % of the readings)")
        with np.errstate(invalid="ignore"):
            spread = self._most - self._least
            own = (self._most < _OWN_M) & (spread < _OWN_SPREAD_M)
            moved = np.sum(spread > _WORLD_SPREAD_M) + np.sum(np.isinf(self._most)) > len(spread) / 2
        if own.any() and moved:
            farthest = math.ceil(10 * float(self._most[own].max()) + 0.5) / 10
            lines.append(
                f"{own.sum()} bearings see the same {float(self._least[own].min()):.2f} to "
                f"{float(self._most[own].max()):.2f} m in every scan, the robot itself: --lidar.min-range {farthest:g}"
            )
        return lines
