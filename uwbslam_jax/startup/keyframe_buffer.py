"""What start-up remembers: keyframes of the LiDAR's (or the odometry's) track, and the ranges taken along it.

Bounded in size; the ranges are kept raw, each with its own time, because where LiDAR sees nothing along a corridor the
track between two keyframes is not to be trusted and a range belongs to a place between the two.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from uwbslam_jax.estimator import Estimate, Moved
from uwbslam_jax.measurements import Odometry, Snapshot, StampedFrame
from uwbslam_jax.numerics import (
    TrackRanges,
    compose,
    mean_sigma,
    median_range,
    near_middle,
    scatter_along,
    transformed,
    turned,
    widened,
)
from uwbslam_jax.settings import HostParams

_MOVED = (0.25, 0.2)
"""A keyframe every so much of path or turn [m, rad]."""
_BLIND_S, _BLIND_M = 0.5, 0.3
"""A keyframe also after this time where the scan cannot tell the position to this standard deviation: the track then
says little about how far the robot has moved."""
_MOST_KEYFRAMES = 64
"""A longer start is thinned: every other keyframe goes."""
_MOST_SIGHTINGS, _MOST_OF_PAIR = 3000, 400
"""Ranges that are kept, of the robot to a beacon and of two beacons: a minute at 50 Hz; more only fill memory."""
_LATEST = 42
"""So many of a pair's newest ranges tell how much they scatter when start-up ends."""


def is_blind(information: np.ndarray) -> np.ndarray:
    """(...) whether scans with some information about the pose (..., 3, 3) do not tell where they are."""
    return np.asarray(np.linalg.eigvalsh(information[..., :2, :2])[..., 0] < _BLIND_M**-2)


def is_far(pose: np.ndarray, last: np.ndarray, elapsed: int, blind: Callable[[], bool]) -> bool:
    """Whether a pose (3,) is to be a keyframe, so long after the last one [ns] and perhaps blind."""
    # plain numbers: asked for every frame
    (x, y, yaw), (x0, y0, yaw0) = pose.tolist(), last.tolist()
    turn = math.remainder(yaw - yaw0, 2 * math.pi)
    moved = math.hypot(x - x0, y - y0) > _MOVED[0] or abs(turn) > _MOVED[1]
    return moved or (elapsed > _BLIND_S * 1e9 and blind())


def rolled_on(wheels: np.ndarray, odometry: Odometry) -> np.ndarray:
    """(3,) motion by wheels (3,) with one more increment; NaN from the first on that is missing [m, m, rad]."""
    return compose(wheels, np.asarray(odometry.increment, float)) if bool(odometry.valid) else np.full(3, np.nan)


@dataclass(frozen=True)
class Keyframe:
    """One pose of the start-up track.

    Attributes:
      frame: its measurements; the scan is drawn again when the frame is decided.
      pose: (3,) in the start frame [m, m, rad].
      information: (3, 3) of its match, in the start frame; 0 where LiDAR said nothing.
      velocity, yaw_rate: of the robot then, to undo the sweep [m/s, rad/s].
      matched: whether a scan tells where it is in the map, or began the map.
      wheels: (3,) motion since the keyframe before by odometry, NaN where it was not measured all the way [m, m, rad].
    """

    frame: StampedFrame
    pose: np.ndarray
    information: np.ndarray
    velocity: np.ndarray
    yaw_rate: float
    matched: bool = True
    wheels: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))

    def snapshot(self) -> Snapshot:
        """Its scan and how the robot moved."""
        drift = turned(-self.pose[2], self.velocity).astype(np.float32)
        return Snapshot(self.frame.frame.scan, drift, np.float32(self.yaw_rate))

    @property
    def rolled(self) -> bool:
        """Whether wheels measured the whole way from the keyframe before."""
        return bool(np.isfinite(self.wheels[0]))

    @property
    def blind(self) -> bool:
        """Whether nothing told how far the robot moved in some direction."""
        return not self.rolled and bool(is_blind(self.information))


class Sighting(NamedTuple):
    """One range between the robot and a beacon: time [ns], pose of the track then (3,), distance in the plane [m]."""

    stamp: int
    pose: np.ndarray
    distance: float


class Buffer:
    """Keyframes and ranges of the start.

    Attributes:
      keyframes: kept so far. sightings: slot -> ranges of the robot to it; pairs: (i, j) -> distances of two beacons'
        antennas in space [m].
      host: what a range is taken for; grows as ids get slots.
      taken: keyframes so far, those that were thinned out since as well.
    """

    def __init__(self, host: HostParams):
        self.keyframes: list[Keyframe] = []
        self.sightings: dict[int, deque[Sighting]] = {}
        self.pairs: dict[tuple[int, int], deque[float]] = {}
        self.host = host
        self.taken = 0
        self._latest: Keyframe | None = None
        self._wheels = np.zeros(3)

    @property
    def extent(self) -> float:
        """Largest distance from the first keyframe [m]."""
        if not self.keyframes:
            return 0.0
        return max(float(np.linalg.norm(k.pose[:2] - self.keyframes[0].pose[:2])) for k in self.keyframes)

    @property
    def newest(self) -> int:
        """Stamp of the newest keyframe [ns], 0 without any."""
        return self.keyframes[-1].frame.stamp if self.keyframes else 0

    def track(self) -> list[Keyframe]:
        """The keyframes and, after them, where the robot is now."""
        if self._latest is None or self._latest.frame.stamp <= self.newest:
            return list(self.keyframes)
        return [*self.keyframes, self._latest]

    def add(self, frame: StampedFrame, estimate: Estimate) -> None:
        """Take in one frame with the pose that LiDAR (and odometry) gave it."""
        pose = np.asarray(estimate.pose, float)
        matched = bool(frame.frame.has_scan) and not bool(estimate.poor)
        self._wheels = rolled_on(self._wheels, frame.frame.odometry)
        if matched or bool(frame.frame.odometry.valid) or not self.keyframes:
            self._latest = Keyframe(
                frame,
                pose,
                np.asarray(estimate.information, float),
                np.asarray(estimate.velocity, float),
                float(estimate.yaw_rate),
                matched,
                self._wheels,
            )
            self._keep(self._latest)
        for k in np.flatnonzero(self.host.usable(frame.frame.ranges)):
            self._add_range(frame, int(k), pose, np.asarray(estimate.velocity, float), float(estimate.yaw_rate))

    def _keep(self, key: Keyframe) -> None:
        """A keyframe far from the last one; a scan far from the last scan as well, in place of one by wheels alone that
        is near: what it tells holds the whole way from that scan, and wheels tell little of a heading."""
        if not self.keyframes or self._is_far(key, self.keyframes[-1]):
            self.keyframes.append(key)
        elif key.matched and not self.keyframes[-1].matched and len(self.keyframes) > 1 and self._is_news(key):
            self.keyframes[-1] = replace(key, wheels=compose(self.keyframes[-1].wheels, key.wheels))
        else:
            return
        self.taken += 1
        self._wheels = np.zeros(3)
        if len(self.keyframes) > _MOST_KEYFRAMES:
            self._thin()

    def _is_news(self, key: Keyframe) -> bool:
        """Whether a scan was not taken near the last one that was kept."""
        scans = (other for other in reversed(self.keyframes) if other.matched)
        return all(self._is_far(key, other) for other in itertools.islice(scans, 1))

    @staticmethod
    def _is_far(key: Keyframe, last: Keyframe) -> bool:
        return is_far(key.pose, last.pose, key.frame.stamp - last.frame.stamp, lambda: key.blind)

    def _add_range(self, frame: StampedFrame, k: int, pose: np.ndarray, velocity: np.ndarray, yaw_rate: float) -> None:
        r = frame.frame.ranges
        i, j = sorted((int(r.i[k]), int(r.j[k])))
        measured = float(r.range[k])
        if i > 0:
            self.pairs.setdefault((i, j), deque(maxlen=_MOST_OF_PAIR)).append(float(self.host.slant(measured, i, j)))
            return
        flat = float(self.host.flat(measured, i, j))
        age = float(r.age[k])
        then = pose + age * np.append(velocity, yaw_rate)
        kept = self.sightings.setdefault(j, deque())
        kept.append(Sighting(frame.stamp + round(age * 1e9), then, flat))
        if len(kept) > _MOST_SIGHTINGS:
            self.sightings[j] = deque(list(kept)[::2])

    def _thin(self) -> None:
        """Of each two keyframes one is left, with a scan where one has; what wheels measured adds up."""
        kept, wheels = [self.keyframes[0]], np.zeros(3)
        for first, second in zip(self.keyframes[1::2], self.keyframes[2::2], strict=False):
            if first.matched and not second.matched:
                kept.append(replace(first, wheels=compose(wheels, first.wheels)))
                wheels = second.wheels
            else:
                kept.append(replace(second, wheels=compose(compose(wheels, first.wheels), second.wheels)))
                wheels = np.zeros(3)
        if len(self.keyframes) % 2 == 0:
            last = self.keyframes[-1]
            kept.append(replace(last, wheels=compose(wheels, last.wheels)))
        self.keyframes = kept

    def averages(self, keys: list[Keyframe]) -> list[TrackRanges]:
        """The robot's ranges averaged over halves of the intervals between keyframes, of one slot each in order."""
        stamps = np.array([key.frame.stamp for key in keys], float)
        poses = np.array([key.pose for key in keys])
        return [self._average_slot(slot, stamps, poses) for slot in sorted(self.sightings)]

    def _average_slot(self, slot: int, stamps: np.ndarray, poses: np.ndarray) -> TrackRanges:
        kept = self.sightings[slot]
        stamp = np.array([s.stamp for s in kept], float)
        pose, distance = np.array([s.pose for s in kept]), np.array([s.distance for s in kept])
        at = np.clip(np.searchsorted(stamps, stamp, side="right") - 1, 0, len(stamps) - 1)
        after = np.minimum(at + 1, len(stamps) - 1)
        share = np.where(after > at, (stamp - stamps[at]) / np.maximum(stamps[after] - stamps[at], 1.0), 0.0)
        share = np.clip(share, 0.0, 1.0)
        antenna = transformed(pose, self.host.antenna)
        local = [turned(-poses[k, 2], antenna - poses[k, :2]) for k in (at, after)]
        scatter, sigma_n = scatter_along(distance, self.host.sigma_n), self.host.sigma_n
        # two means in each interval: one would leave the keyframes free to move to and fro between their middles
        halves = 2 * at + (share >= 0.5)
        groups = np.unique(halves)
        rows = []
        for k in groups:
            mine = np.flatnonzero(halves == k)
            ok = mine[near_middle(distance[mine])]
            sigma = mean_sigma(len(ok), float(np.median(scatter[mine])), sigma_n)
            rows.append((share[ok].mean(), local[0][ok].mean(0), local[1][ok].mean(0), distance[ok].mean(), sigma))
        share, before, after, distance, sigma = (np.array(column) for column in zip(*rows, strict=True))
        sigma = widened(sigma, sigma > mean_sigma(1, sigma_n, sigma_n), np.zeros(len(groups), int))
        at, to = groups // 2, np.full(len(groups), slot)
        next_one = np.minimum(at + 1, len(stamps) - 1)
        return TrackRanges(at, next_one, to, share, before, after, distance, 0.0 * distance, sigma)

    def heard(self, slot: int, moved: Moved) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stamps (R,) [ns], places (R, 2) of the antenna on the moved track and distances (R,) [m] of what was ranged
        to a beacon."""
        kept = self.sightings[slot]
        stamps, poses = np.array([s.stamp for s in kept], np.int64), np.array([s.pose for s in kept])
        return stamps, transformed(moved.carry(stamps, poses), self.host.antenna), np.array([s.distance for s in kept])

    def scatter(self, nodes: int) -> np.ndarray:
        """(K, K) log of how many times sigma_n each pair's latest ranges scatter, at least 0, see ranging."""
        found = np.zeros((nodes, nodes))
        for slot, kept in self.sightings.items():
            latest = np.array([s.distance for s in kept])[-_LATEST:]
            found[0, slot] = found[slot, 0] = scatter_along(latest, self.host.sigma_n)[-1]
        for (i, j), kept in self.pairs.items():
            latest = np.array(kept)[-_LATEST:]
            found[i, j] = found[j, i] = median_range(latest, self.host.sigma_n)[2]
        return np.log(np.maximum(found / self.host.sigma_n, 1.0))
