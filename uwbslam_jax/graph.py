"""The graph of a whole run: keyframes, which older ground each scan was matched with, and the ranges taken on the way.

Collected while the steps run, solved by `smoothing`. A match is against ground that older keyframes drew, so what it
measures is the pose relative to those: that is a loop closed, without any search. Host arrays; grows with the way.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import numpy as np

from uwbslam_jax.config import Config, Params
from uwbslam_jax.geometry import rotation
from uwbslam_jax.keyframes import mean_sigma, turned
from uwbslam_jax.measurements import Scan, Snapshot, StampedFrame
from uwbslam_jax.registration import register
from uwbslam_jax.slam import Estimate

_MOVED = (0.25, 0.2)
"""A keyframe every so much of way or turn [m, rad]."""
_BLIND_S = 0.5
_BLIND_M = 0.3
"""A keyframe also after this time where the scan tells the position no better than this."""
_SEEN_M = 0.05
"""A match that tells the position no better than this in some direction does not see it."""
_NEAREST = 2
_REACH_M = 10.0
_TURN_M = 1.0
_NEW_ANCHOR_M = 2.0
_TIES = 4
_FEWEST_RETURNS = 20
_SHARE = 0.5
_BELIEVED = (0.6, 0.6, 0.2)
_WINDOW = 21
_WILD_M = 0.5
"""A range this far from the median of its interval takes no part in the mean."""
_MOST_OF_PAIR = 400
_MM = 1000.0
"""Scans are kept in whole millimetres."""


@dataclass
class Keyframe:
    """One pose of the graph.

    Attributes:
      stamp: [ns]; frame: number of it in the history.
      pose: (3,) where the map has it: what its match reported, or what was expected where nothing matched [m, m, rad].
      informed: (3, 3) information of the match in the map's frame, 0 where there is none.
      scan: what it saw, None where there is nothing to see; lengths in millimetres.
      drift: (2,) velocity in the robot's frame [m/s]; yaw_rate [rad/s].
      wheels: (3,) motion since the keyframe before by odometry, None where it was not measured all the way.
      broken: whether the robot was carried on the way from the keyframe before.
    """

    stamp: int
    frame: int
    pose: np.ndarray
    informed: np.ndarray
    scan: Scan | None
    drift: np.ndarray
    yaw_rate: float
    wheels: np.ndarray | None
    broken: bool

    def snapshot(self) -> Snapshot:
        """Its scan as it was."""
        return Snapshot(_unpacked(self.scan), np.float32(self.drift), np.float32(self.yaw_rate))

    @property
    def blind(self) -> bool:
        """Whether its scan does not tell where it is in some direction."""
        return bool(np.linalg.eigvalsh(self.informed[:2, :2])[0] < _BLIND_M**-2)


class Edge(NamedTuple):
    """A keyframe relative to an older one, by a match with the ground that the older one drew.

    Attributes:
      old, new: numbers of the keyframes.
      between: (3,) pose of the new one in the frame of the old one [m, m, rad].
      information: (3, 3) of it, in that frame.
    """

    old: int
    new: int
    between: np.ndarray
    information: np.ndarray


class Mean(NamedTuple):
    """Ranges between the robot and a beacon at rest, averaged over half an interval between two keyframes.

    Attributes:
      at: keyframe before. node: (slot, number of its resting place). share: of the way to the next keyframe.
      before, after: (2,) the antenna in the frame of the keyframe before and of the one after [m].
      distance: as measured, sigma: its standard deviation [m].
      loud: whether the ranges scatter more than the radio does.
    """

    at: int
    node: tuple[int, int]
    share: float
    before: np.ndarray
    after: np.ndarray
    distance: float
    sigma: float
    loud: bool


class _Heard(NamedTuple):
    """One range of the robot: when [ns], the node, where the antenna was on the map (2,), distance, scatter [m]."""

    stamp: float
    node: tuple[int, int]
    antenna: np.ndarray
    distance: float
    scatter: float


@dataclass
class Graph:
    """What was collected so far.

    Attributes:
      keyframes, edges, means: see there.
      pairs: ranges between two beacons at rest, the newest; by their nodes.
    """

    sigma_n: float
    keyframes: list[Keyframe] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    means: list[Mean] = field(default_factory=list)
    pairs: dict[tuple[tuple[int, int], tuple[int, int]], deque[float]] = field(default_factory=dict)
    _rests: dict[int, int] = field(default_factory=dict)
    _newest: dict[int, deque[float]] = field(default_factory=dict)
    _open: list[_Heard] = field(default_factory=list)
    _wheels: np.ndarray | None = field(default_factory=lambda: np.zeros(3))
    _broken: bool = False
    _anchors: list[int] = field(default_factory=list)

    def copy(self) -> Graph:
        """What there is now; what is added later does not change it."""
        pairs = {pair: deque(kept) for pair, kept in self.pairs.items()}
        return Graph(self.sigma_n, list(self.keyframes), list(self.edges), list(self.means), pairs)

    def poses(self) -> np.ndarray:
        """(N, 3) where the map has the keyframes [m, m, rad]."""
        return np.array([key.pose for key in self.keyframes]).reshape(-1, 3)

    def stamps(self) -> np.ndarray:
        """(N,) of the keyframes [ns]."""
        return np.array([key.stamp for key in self.keyframes], np.int64)

    def seen(self, poses: np.ndarray, first: int = 0) -> list[tuple[np.ndarray, Snapshot]]:
        """What may be drawn, from a first keyframe on: the scans that were laid over others, at poses (N, 3)."""
        tied = {edge.old for edge in self.edges} | {edge.new for edge in self.edges}
        return [(poses[k], self.keyframes[k].snapshot()) for k in sorted(tied) if k >= first]

    def node(self, slot: int) -> tuple[int, int]:
        """The place where a beacon rests now."""
        return slot, self._rests.get(slot, 0)

    def placed(self, slot: int, since: int) -> None:
        """A beacon was found to rest where it was ranged from a time on [ns]; where it was before, nobody knows."""
        node = self.node(slot)
        self.means = [m for m in self.means if m.node != node or self.keyframes[m.at].stamp >= since]

    def moved(self, slot: int) -> None:
        """A beacon is, or the robot (slot 0) was, somewhere else from now on."""
        if slot == 0:
            self._broken = True
        self._rests[slot] = self._rests.get(slot, 0) + 1
        self._newest.pop(slot, None)

    def add(
        self,
        config: Config,
        params: Params,
        seen: list[tuple[int, StampedFrame, Estimate]],
    ) -> None:
        """Take in a few frames.

        Args:
          seen: number in the history, frame and estimate.
        """
        for number, frame, estimate in seen:
            pose = map_pose(estimate)
            self._hear(frame, estimate, pose, params, config.nlos_gap_db)
            self._roll(frame)
            informed = np.asarray(estimate.information, float)
            if self.keyframes and not self._far(pose, frame.stamp, informed):
                continue
            turn = turned(-pose[2], np.asarray(estimate.velocity, float))
            scan = _packed(frame.frame.scan) if _sees(frame) else None
            key = Keyframe(
                frame.stamp,
                number,
                pose,
                informed,
                scan,
                turn,
                float(estimate.yaw_rate),
                self._wheels,
                self._broken,
            )
            self._close(key)
            self.keyframes.append(key)
            self._wheels, self._broken = np.zeros(3), False
            if scan is not None:
                self._tie(params)

    def _far(self, pose: np.ndarray, stamp: int, informed: np.ndarray) -> bool:
        last = self.keyframes[-1]
        moved = relative(last.pose, pose)
        late = stamp - last.stamp > _BLIND_S * 1e9 and np.linalg.eigvalsh(informed[:2, :2])[0] < _BLIND_M**-2
        return bool(self._broken or np.hypot(*moved[:2]) > _MOVED[0] or abs(wrapped(moved[2])) > _MOVED[1] or late)

    def _roll(self, frame: StampedFrame) -> None:
        odometry = frame.frame.odometry
        if not bool(odometry.valid):
            self._wheels = None
        elif self._wheels is not None:
            step = np.asarray(odometry.increment, float)
            self._wheels = np.append(
                self._wheels[:2] + turned(self._wheels[2], step[:2]), self._wheels[2] + step[2]
            )

    def _hear(self, frame, estimate, pose, params, gap) -> None:
        r = frame.frame.ranges
        usable = np.asarray(r.valid) & ~(np.asarray(r.power_gap) > gap)
        moving = np.asarray(estimate.moving)
        usable &= ~(moving[r.i] | moving[r.j])
        lever = np.asarray(params.antenna, float)
        motion = np.append(np.asarray(estimate.velocity, float), float(estimate.yaw_rate))
        for k in np.flatnonzero(usable):
            i, j = sorted((int(r.i[k]), int(r.j[k])))
            distance = float(r.range[k])
            if i > 0:
                kept = self.pairs.setdefault((self.node(i), self.node(j)), deque(maxlen=_MOST_OF_PAIR))
                kept.append(distance)
                continue
            then = pose + float(r.age[k]) * motion
            antenna = then[:2] + turned(then[2], lever)
            stamp = frame.stamp + float(r.age[k]) * 1e9
            newest = self._newest.setdefault(j, deque(maxlen=_WINDOW))
            newest.append(distance)
            self._open.append(_Heard(stamp, self.node(j), antenna, distance, self._scatter(newest)))

    def _scatter(self, newest: deque[float]) -> float:
        """Standard deviation of a pair's newest ranges by their second differences, see keyframes."""
        if len(newest) < _WINDOW:
            return self.sigma_n
        d = np.array(newest)
        # the median of |x| of a normal x is 0.674 sigma, and a second difference has 6 sigma^2
        return float(np.median(np.abs(d[2:] - 2 * d[1:-1] + d[:-2])) / (0.674 * np.sqrt(6.0)))

    def _close(self, key: Keyframe) -> None:
        """Average what was heard between the last keyframe and this one."""
        heard, self._open = self._open, []
        if not self.keyframes or self._broken:
            return
        last, at = self.keyframes[-1], len(self.keyframes) - 1
        span = max(key.stamp - last.stamp, 1)
        groups: dict[tuple[tuple[int, int], bool], list[_Heard]] = {}
        for one in heard:
            groups.setdefault((one.node, one.stamp - last.stamp >= span / 2), []).append(one)
        for (node, _), mine in groups.items():
            distance = np.array([one.distance for one in mine])
            middle = np.sort(distance)[len(distance) // 2]  # one of them, so that at least one is near it
            ok = [one for one in mine if abs(one.distance - middle) < _WILD_M]
            share = np.clip((np.mean([one.stamp for one in ok]) - last.stamp) / span, 0.0, 1.0)
            antenna = np.mean([one.antenna for one in ok], axis=0)
            scatter = float(np.median([one.scatter for one in mine]))
            sigma = mean_sigma(len(ok), scatter, self.sigma_n)
            self.means.append(
                Mean(
                    at,
                    node,
                    float(share),
                    turned(-last.pose[2], antenna - last.pose[:2]),
                    turned(-key.pose[2], antenna - key.pose[:2]),
                    float(np.mean([one.distance for one in ok])),
                    sigma,
                    sigma > mean_sigma(1, self.sigma_n, self.sigma_n),
                )
            )

    def put(self, poses: np.ndarray, turn: float) -> None:
        """The map was drawn again: keyframes so far are at poses (N, 3) in it, turned by an angle [rad]."""
        R = np.eye(3)
        R[:2, :2] = np.array(rotation(turn))
        # new ones, not changed ones: a copy keeps what it has
        self.keyframes = [
            replace(key, pose=pose, informed=R @ key.informed @ R.T)
            for key, pose in zip(self.keyframes, poses, strict=True)
        ]

    def _tie(self, params: Params) -> None:
        """Edges from the newest keyframe to older ones whose scans it can be laid over."""
        new = len(self.keyframes) - 1
        key = self.keyframes[new]
        poses = np.array([self.keyframes[k].pose for k in self._anchors]).reshape(-1, 3)
        apart = np.linalg.norm(poses[:, :2] - key.pose[:2], axis=1)
        cost = apart + np.abs(wrapped(poses[:, 2] - key.pose[2])) * _TURN_M
        near = [self._anchors[k] for k in np.argsort(cost, kind="stable")[:_NEAREST] if apart[k] < _REACH_M]
        far = [self._anchors[k] for k in np.flatnonzero(apart < _REACH_M)[:1]]
        last = [new - 1] if new > 0 and self.keyframes[new - 1].scan is not None and not key.broken else []
        old = list(dict.fromkeys([*last, *near, *far]))
        if not len(cost) or cost.min() > _NEW_ANCHOR_M:
            self._anchors.append(new)
        if not old:
            return
        padded = (old * _TIES)[:_TIES]
        guess = np.array([relative(self.keyframes[k].pose, key.pose) for k in padded])
        snapshots = [self.keyframes[k].snapshot() for k in padded]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *snapshots)
        found = jax.device_get(register(params, stacked, key.snapshot(), np.float32(guess)))
        for k, target in enumerate(old):
            off = np.abs(found.pose[k] - guess[k])
            if found.share[k] > _SHARE and np.all(off < _BELIEVED):
                pose, information = (np.asarray(a[k], float) for a in (found.pose, found.information))
                self.edges.append(Edge(target, new, pose, information))


def map_pose(estimate: Estimate) -> np.ndarray:
    """(3,) where the map has the robot: the match, or what was expected of it where nothing matched [m, m, rad]."""
    if np.any(estimate.information):
        return np.asarray(estimate.matched_pose, float)
    return np.asarray(estimate.pose, float) + np.asarray(estimate.map_error, float)


def sight(estimate: Estimate) -> float:
    """What a match told of the position: NaN for all of it, inf for nothing, else the direction that it cannot see, in
    the map's frame [rad]."""
    values, vectors = np.linalg.eigh(np.asarray(estimate.information, float)[:2, :2])
    if values[0] > _SEEN_M**-2:
        return float("nan")
    return float(np.arctan2(vectors[1, 0], vectors[0, 0])) if values[1] > _SEEN_M**-2 else float("inf")


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses b in the frames of poses a, both (..., 3); the angle is not wrapped."""
    return np.concatenate([turned(-a[..., 2], b[..., :2] - a[..., :2]), b[..., 2:] - a[..., 2:]], axis=-1)


def wrapped(angle):
    """The same angles in [-pi, pi) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _sees(frame: StampedFrame) -> bool:
    return bool(frame.frame.has_scan) and int(np.sum(frame.frame.scan.valid)) > _FEWEST_RETURNS


def _packed(scan: Scan) -> Scan:
    millimetres = np.where(scan.valid, np.round(np.asarray(scan.ranges) * _MM), 0).astype(np.uint16)
    return scan._replace(ranges=millimetres, valid=None)


def _unpacked(scan: Scan) -> Scan:
    return scan._replace(ranges=scan.ranges.astype(np.float32) / np.float32(_MM), valid=scan.ranges > 0)
