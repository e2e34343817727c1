"""Host messages to frames: what arrived between two scans becomes one padded set of measurements.

The assembler closes a frame when a scan arrives (ranges and odometry up to its stamp belong to it). While no scan comes
the odometry's stamps make the frames, and where there is no odometry either, ranges that have waited long enough. It
gives every node id a slot, checks stamps and counts what it drops.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from operator import attrgetter

import numpy as np

from uwbslam_jax.measurements import (
    Frame,
    Message,
    Odometry,
    OdometryMessage,
    RangeMessage,
    Ranges,
    Scan,
    ScanMessage,
    StampedFrame,
    TruthMessage,
)
from uwbslam_jax.numerics import between, wrapped
from uwbslam_jax.reasons import OdometryLost, RangeLost, ScanLost, Sensor
from uwbslam_jax.session.odometry_track import OdometryTrack
from uwbslam_jax.session.recent import Recent
from uwbslam_jax.settings import Settings, make_config, with_room

_SCANLESS_S = 1.0
"""Ranges wait this long for a scan before they make a frame of their own."""
_PAUSE = 2_000_000_000
"""Ranges that came so long before a scan [ns] make a frame of their own: by its time the robot is elsewhere."""
_FAILS = 500_000_000
"""A scan without a return so soon after one that had some [ns] is a failure of the scanner; later it sees nothing."""
_BLIND_S, _BLIND_SCANS = 0.2, 2
"""Once a LiDAR has fallen silent they wait only so long, or so many of its usual intervals where those are longer: no
velocity predicts a turning robot for a second, but a slow scanner is not a silent one."""
_OFTEN = 5
"""An id that would need more slots gets one once it was heard so often: single ones are errors of a radio [ranges]."""
_TELLING_PAIRS = 2
"""Where so many pairs of nodes were heard and the robot in none, its id may be another [pairs]."""
_INTERVALS = 9
"""So many intervals between scans tell the usual one."""
_WITHOUT_SCAN_S = 3.0
"""After so long without a scan the odometry makes the frames."""
_ODOMETRY_EVERY_S = 0.08
"""Frames made by the odometry are at least so far apart."""
_ODOMETRY_LAGS_S = 15.0
"""Ranges wait this long for odometry that has come before."""
_LATEST = 500_000_000
"""Ranges from so long before the last frame are too late, the radio's latency aside [ns]."""
_LONGEST_S = 3600.0
"""No time between two frames is taken for longer: a clock that was set by years does not make beacons wander."""
_ODOMETRY_HOLD_S = 0.3
"""The last odometry is extrapolated at most this far."""
_ROUNDING = 1e-6
"""A reading so close to the sensor's limit is at it [ratio]: single precision."""


class FrameAssembler:
    """Turns messages, in recording order, into frames.

    Attributes:
      slots: node id -> slot, the robot 0; filled as ids are heard.
      dropped: what was not used, by reason. used: what was, by sensor. blank: scans of these without a return.
      warnings: one line each; that there are more beacons than slots is told once for each time.
      wheels: the odometry's poses so far, as one track.
      odometry_used: whether any frame carried an increment.
    """

    def __init__(self, settings: Settings, max_ranges: int):
        self.slots: dict[int, int] = {settings.robot.id: 0}
        self.dropped: Counter[str] = Counter()
        self.used: Counter[Sensor] = Counter()
        self.blank = 0
        self.warnings: list[str] = []
        self.wheels = OdometryTrack()
        self.odometry_used = False
        self._settings = settings
        self._max_range = settings.uwb.max_range
        self._latency = round(settings.uwb.latency * 1e9)
        self._max_ranges = max_ranges
        self._seldom: Counter[int] = Counter()  # ids without a slot
        self._ranges: list[RangeMessage] = []
        self._newest_range: dict[tuple[int, int], int] = {}
        self._recent = Recent()
        self._odometry: list[OdometryMessage] = []
        self._last: int | None = None
        self._scan_at: int | None = None
        self._seen_at = -_FAILS  # stamp of the last scan with a return
        self._wait_s = _SCANLESS_S
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)  # between scans [ns]

    def frames(self, messages: Iterable[Message]) -> Iterator[StampedFrame]:
        """Frames of a whole stream of messages."""
        for message in messages:
            yield from self.add(message)
        yield from self.flush()

    def add(self, message: Message) -> list[StampedFrame]:
        """Frames that a message completes: none, a scan's, or those of odometry and ranges that waited too long."""
        match message:
            case RangeMessage():  # first: they are nearly all
                return self._add_range(message)
            case ScanMessage():
                return self._add_scan(message)
            case OdometryMessage():
                return self._add_odometry(message)
            case TruthMessage():
                pass
        return []

    def missing(self) -> list[str]:
        """One line where a robot that drives was not heard so far, though the others were."""
        pairs, robot = self._newest_range, self._settings.robot.id
        drives = self._scan_at is not None and len(pairs) >= _TELLING_PAIRS
        heard = any(robot in pair for pair in pairs)
        return [robot_unheard(robot, set(self.slots) - {robot})] if drives and not heard else []

    def flush(self) -> list[StampedFrame]:
        """Frames of the ranges and the odometry that no scan came for, at the end of a stream."""
        frames = self._by_odometry(self._odometry[-1].stamp + 1) if self._odometry else []
        return frames + (self._without_scan(before=None) if self._ranges else [])

    def _add_scan(self, scan: ScanMessage) -> list[StampedFrame]:
        if self._scan_at is not None and scan.stamp > self._scan_at:
            self._intervals.append(scan.stamp - self._scan_at)
        self._scan_at = max(scan.stamp, self._scan_at or scan.stamp)
        if self._last is not None and scan.stamp <= self._last:
            copy = ScanLost.COPY if self._recent.has(Sensor.SCAN, scan.stamp) else ScanLost.STAMP
            self.dropped[ScanLost.TWICE if scan.stamp == self._last else copy] += 1
            return []
        self._recent.add(Sensor.SCAN, scan.stamp)
        if scan.ranges.size < 2 or not (math.isfinite(scan.angle_min) and math.isfinite(scan.angle_increment)):
            self.dropped[ScanLost.NO_BEARINGS] += 1
            return []
        padded = pad_scan(scan, self._settings)
        if padded.valid.any() or ((scan.ranges > scan.range_min) & (scan.ranges < scan.range_max)).any():
            self._seen_at = scan.stamp
        elif scan.stamp - self._seen_at < _FAILS:
            self.dropped[ScanLost.FAILED] += 1
            return []
        self.used[Sensor.SCAN] += 1
        waiting = self._without_scan(before=scan.stamp)
        self._wait_s = _SCANLESS_S
        late = [m for m in self._ranges if m.stamp > scan.stamp]
        ready = [m for m in self._ranges if m.stamp <= scan.stamp]
        self._ranges = late
        return [*waiting, self._close(scan.stamp, ready, padded)]

    def _add_range(self, message: RangeMessage) -> list[StampedFrame]:
        if not 0.0 < message.range <= self._max_range:
            self.dropped[RangeLost.IMPOSSIBLE] += 1
            return []
        if self._latency:
            message = replace(message, stamp=message.stamp - self._latency)
        a, b, stamp = message.source, message.target, message.stamp
        if a == b:
            self.dropped[RangeLost.SELF] += 1
            return []
        pair = (a, b) if a < b else (b, a)
        if stamp <= self._newest_range.get(pair, -1):
            self.dropped[RangeLost.COPY if self._recent.has(pair, stamp) else RangeLost.STAMP] += 1
            return []
        if self._last is not None and stamp <= self._last - _LATEST - self._latency:
            self.dropped[RangeLost.LATE] += 1
            return []
        if (a not in self.slots and self._slot(a) is None) or (b not in self.slots and self._slot(b) is None):
            self.dropped[RangeLost.NO_SLOT] += 1
            return []
        self._newest_range[pair] = stamp
        self._recent.add(pair, stamp)
        self._ranges.append(message)
        # where there is odometry it makes the frames; one that lags is waited for, or they would lack its increment
        patience = _ODOMETRY_LAGS_S if self._odometry else 2 * self._wait_s
        if stamp - (self._last or self._ranges[0].stamp) > patience * 1e9:
            return self._without_scan(before=stamp)
        return []

    def _add_odometry(self, message: OdometryMessage) -> list[StampedFrame]:
        if not self._settings.odom.use:
            return []
        if not (math.isfinite(message.x) and math.isfinite(message.y) and math.isfinite(message.yaw)):
            self.dropped[OdometryLost.NOT_FINITE] += 1
            return []
        if self._odometry and message.stamp <= self._odometry[-1].stamp:
            copy = OdometryLost.COPY if self._recent.has(Sensor.ODOMETRY, message.stamp) else OdometryLost.STAMP
            self.dropped[OdometryLost.TWICE if message.stamp == self._odometry[-1].stamp else copy] += 1
            return []
        self._recent.add(Sensor.ODOMETRY, message.stamp)
        self.used[Sensor.ODOMETRY] += 1
        message, joined = self.wheels.join(message)
        if not joined:
            self._odometry.clear()
        self._odometry.append(message)
        return self._by_odometry(message.stamp)  # the newest waits for the ranges of its own time

    def _by_odometry(self, before: int) -> list[StampedFrame]:
        """Frames at the odometry's own stamps while no scan comes: the turn between two is then measured, not assumed
        to be even."""
        if self._scan_at is None:
            self._scan_at = self._odometry[0].stamp
        frames = []
        if self._odometry[-1].stamp - self._scan_at > _WITHOUT_SCAN_S * 1e9:
            for stamp in [m.stamp for m in self._odometry if m.stamp < before]:
                if self._last is None or stamp - self._last >= _ODOMETRY_EVERY_S * 1e9:
                    ready = [m for m in self._ranges if m.stamp <= stamp]
                    self._ranges = [m for m in self._ranges if m.stamp > stamp]
                    frames.append(self._close(stamp, ready, None))
        return frames

    def _slot(self, node: int) -> int | None:
        """The slot of a node; None for one that there is no slot for, as yet or at all."""
        if node not in self.slots:
            most = self._settings.uwb.max_beacons
            if len(self.slots) > most:
                self._seldom[node] += 1
                if self._seldom[node] < _OFTEN or not self._make_room(node):
                    return None
            self.slots[node] = len(self.slots)
        return self.slots[node]

    def _make_room(self, node: int) -> bool:
        """Whether there are more slots now."""
        most = self._settings.uwb.max_beacons
        self._settings = with_room(self._settings, most + 1)
        self._max_ranges = make_config(self._settings).max_ranges
        room = self._settings.uwb.max_beacons
        told = f"more than {most} beacons were heard: "
        if room > most:
            self.warnings.append(f"{told}room was made for {room} in the run, --uwb.max-beacons {room} makes it before")
        elif self._seldom[node] == _OFTEN:
            self.warnings.append(f"{told}node {node} is ignored, there is room for no more")
        return room > most

    def _without_scan(self, before: int | None) -> list[StampedFrame]:
        """Frames for ranges that have waited: one whenever they span too long or fill a frame."""
        self._ranges.sort(key=attrgetter("stamp"))
        frames: list[StampedFrame] = []
        while self._ranges:
            first = self._last if self._last is not None else self._ranges[0].stamp
            overdue = before is None or (before - first > self._wait_s * 1.5e9) or len(self._ranges) > self._max_ranges
            if not overdue:
                break
            ready = [m for m in self._ranges if m.stamp - first <= self._wait_s * 1e9 or m is self._ranges[0]][
                : self._max_ranges
            ]
            rest = self._ranges[len(ready) :]
            # the last ones belong to what comes next, unless that comes after a pause
            if before is not None and (ready[-1].stamp >= before or (not rest and before - ready[-1].stamp <= _PAUSE)):
                break
            self._ranges = rest
            self._wait_s = self._silent_wait()
            frames.append(self._close(max(ready[-1].stamp, (self._last or 0) + 1), ready, None))
        return frames

    def _silent_wait(self) -> float:
        """How long ranges wait while a LiDAR is silent [s]."""
        if not self._intervals:
            return _SCANLESS_S
        return min(max(_BLIND_SCANS * float(np.median(self._intervals)) / 1e9, _BLIND_S), _SCANLESS_S)

    def _close(self, stamp: int, ranges: list[RangeMessage], scan: Scan | None) -> StampedFrame:
        dt = 0.0 if self._last is None else min((stamp - self._last) / 1e9, _LONGEST_S)
        odometry = self._increment(stamp)
        if len(ranges) > self._max_ranges:
            self.dropped[RangeLost.FRAME_FULL] += len(ranges) - self._max_ranges
            ranges = ranges[-self._max_ranges :]
        self.used[Sensor.RANGE] += len(ranges)
        frame = Frame(
            dt=np.float32(dt),
            has_scan=np.bool_(scan is not None),
            scan=pad_scan(None, self._settings) if scan is None else scan,
            ranges=pad_ranges(ranges, self.slots, stamp, self._max_ranges),
            odometry=odometry,
        )
        self.blank += scan is not None and not scan.valid.any()
        self._last = stamp
        return StampedFrame(stamp, frame, dict(self.slots))

    def _increment(self, stamp: int) -> Odometry:
        track, last = self._odometry, self._last
        if last is None or len(track) < 2 or track[0].stamp > last or stamp - track[-1].stamp > _ODOMETRY_HOLD_S * 1e9:
            return Odometry(np.zeros(3, np.float32), np.bool_(False))
        a, b = _pose_at(track, last), _pose_at(track, stamp)
        keep = max(0, bisect_right([m.stamp for m in track], stamp) - 2)
        del track[:keep]
        self.odometry_used = True
        increment = between(np.array(a), np.array(b))
        increment[2] = wrapped(increment[2])
        return Odometry(increment.astype(np.float32), np.bool_(True))


def robot_unheard(robot_id: int, nodes: Collection[int]) -> str:
    """Warning that the robot's node is none of those heard."""
    among = ", ".join(map(str, sorted(nodes)[:12])) + (" ..." if len(nodes) > 12 else "")
    return f"robot.id = {robot_id} is never heard among the nodes {among}: name the robot's own, --robot.id ID"


def _pose_at(track: list[OdometryMessage], stamp: int) -> tuple[float, float, float]:
    """Odometry pose at a stamp, between two messages or held at the rate of the last two."""
    at = min(max(bisect_right([m.stamp for m in track], stamp), 1), len(track) - 1)
    a, b = track[at - 1], track[at]
    f = min((stamp - a.stamp) / (b.stamp - a.stamp), 1.0 + _ODOMETRY_HOLD_S * 1e9 / (b.stamp - a.stamp))
    return a.x + f * (b.x - a.x), a.y + f * (b.y - a.y), a.yaw + f * wrapped(b.yaw - a.yaw)


def pad_scan(scan: ScanMessage | None, settings: Settings) -> Scan:
    """A scan in the slots of a frame; more beams than slots are thinned evenly, no return is 0 and not valid. Bearings
    of a LiDAR upside down are turned over."""
    beams = settings.lidar.max_beams
    ranges, valid = np.zeros(beams, np.float32), np.zeros(beams, bool)
    if scan is None:
        return Scan(ranges, valid, np.float32(0), np.float32(1e-3), np.float32(0))
    stride = -(-scan.ranges.size // beams)
    taken = np.asarray(scan.ranges[::stride], np.float32)
    low, high = max(scan.range_min, settings.lidar.min_range), settings.lidar.max_range
    limit = scan.range_max * (1.0 - _ROUNDING)  # many tell no return as their limit itself, or as inf
    ok = (taken >= low) & (taken < limit if limit <= high else taken <= high)  # neither is true of NaN
    if low <= 0.0:
        ok &= taken > 0.0
    np.copyto(ranges[: taken.size], taken, where=ok)
    valid[: taken.size] = ok
    turn = -1.0 if settings.robot.lidar_flip else 1.0
    return Scan(
        ranges,
        valid,
        np.float32(turn * scan.angle_min),
        np.float32(turn * scan.angle_increment * stride),
        np.float32(scan.time_increment * stride),
    )


def pad_ranges(messages: list[RangeMessage], slots: dict[int, int], stamp: int, size: int) -> Ranges:
    """Ranges in the slots of a frame, with their age relative to its stamp."""
    n = len(messages)
    i, j = np.zeros(size, np.int32), np.zeros(size, np.int32)
    j[:] = 1  # a pair of two nodes also where there is no range
    distance, age = np.zeros(size, np.float32), np.zeros(size, np.float32)
    gap, valid = np.full(size, np.nan, np.float32), np.zeros(size, bool)
    for k, m in enumerate(messages):
        i[k], j[k] = slots[m.source], slots[m.target]
        distance[k], age[k] = m.range, (m.stamp - stamp) / 1e9
        gap[k] = m.receive_power - m.first_path_power
    valid[:n] = True
    return Ranges(i, j, distance, age, gap, valid)
