"""The graph of a whole run: keyframes, scans laid over older scans, and the ranges taken on the way.

Collected while the steps run, solved by `smoothing`. Host arrays; grows with the way, not with the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import numpy as np
from scipy import sparse

from uwbslam_jax.config import Config, Params
from uwbslam_jax.keyframes import turned
from uwbslam_jax.measurements import Scan, Snapshot, StampedFrame
from uwbslam_jax.range_means import RangeMeans
from uwbslam_jax.registration import register
from uwbslam_jax.slam import Estimate

_MOVED = (0.25, 0.2)
"""A keyframe every so much of way or turn [m, rad]."""
_BLIND_S = 0.5
_BLIND_M = 0.3
"""A keyframe also after this time where the scan tells the position no better than this."""
_SEEN_M = 0.05
"""A match that tells the position no better than this in some direction does not see it."""
_FEWEST_RETURNS = 20
"""A scan of fewer returns tells nothing."""
_ANCHOR_M = 2.0
"""A keyframe this far from every anchor is one: later scans are laid over anchors, so that a place that is passed
again hangs on the first time and not on the time before."""
_TURN_M = 1.0
"""A turn of one radian makes two scans see as little of the same as so much way [m]."""
_REACH_M = 10.0
"""Anchors farther off are not tried."""
_NEAREST = 2
_TIES = 2 + _NEAREST
"""A scan is laid over the one before, the nearest anchors, and the oldest one in reach."""
_SHARE = 0.5
"""Share of a scan's surfaces that have to lie on those of the older one."""
_BELIEVED = (0.6, 0.6, 0.2)
"""A scan that lies farther off than this from where the map has it was laid over something else [m, m, rad]."""
_HANG_TOGETHER = 8
"""So many keyframes whose scans lie over each other are a place."""
_FOUND_S = 5.0
"""A robot that was carried is found within so long."""
_MM = 1000.0
"""Scans are kept in whole millimetres."""


@dataclass(frozen=True)
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
        assert self.scan is not None
        reach = self.scan.ranges.astype(np.float32) / np.float32(_MM)
        scan = self.scan._replace(ranges=reach, valid=self.scan.ranges > 0)
        return Snapshot(scan, np.float32(self.drift), np.float32(self.yaw_rate))

    @property
    def blind(self) -> bool:
        """Whether its scan does not tell where it is in some direction."""
        return _blind(self.informed)


class Edge(NamedTuple):
    """A keyframe relative to an older one, by their scans.

    Attributes:
      old, new: numbers of the keyframes.
      between: (3,) pose of the new one in the frame of the old one [m, m, rad].
      information: (3, 3) of it, in that frame.
    """

    old: int
    new: int
    between: np.ndarray
    information: np.ndarray


@dataclass
class Graph:
    """What was collected so far.

    Attributes:
      ranges, keyframes, edges: see there.
    """

    ranges: RangeMeans
    keyframes: list[Keyframe] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    _wheels: np.ndarray | None = field(default_factory=lambda: np.zeros(3))
    _broken: bool = False
    _anchors: list[int] = field(default_factory=list)

    def copy(self) -> Graph:
        """What there is now; what is added later does not change it."""
        return Graph(self.ranges.copy(), list(self.keyframes), list(self.edges))

    def poses(self) -> np.ndarray:
        """(N, 3) where the map has the keyframes [m, m, rad]."""
        return np.array([key.pose for key in self.keyframes]).reshape(-1, 3)

    def stamps(self) -> np.ndarray:
        """(N,) of the keyframes [ns]."""
        return np.array([key.stamp for key in self.keyframes], np.int64)

    def seen(self, poses: np.ndarray, first: int = 0) -> list[tuple[np.ndarray, Snapshot]]:
        """What may be drawn, from a first keyframe on, at poses (N, 3): scans that hang together with many others.

        A few that hang only on each other were taken where nothing could be told: in somebody's arms, in smoke.
        """
        count = len(self.keyframes)
        ends = np.array([(edge.old, edge.new) for edge in self.edges], int).reshape(-1, 2)
        tied = sparse.coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
        _, part = sparse.csgraph.connected_components(tied, directed=False)
        size = np.bincount(part, minlength=1)
        kept = size >= min(_HANG_TOGETHER, size.max())
        drawn = [k for k in np.flatnonzero(kept[part]) if k >= first and self.keyframes[k].scan is not None]
        return [(poses[k], self.keyframes[k].snapshot()) for k in drawn]

    def placed(self, slot: int, since: int) -> None:
        """A beacon was found to rest where it was ranged from a time on [ns]; where it was before, nobody knows."""
        self.ranges.forget(slot, lambda mean: self.keyframes[mean.at].stamp < since)

    def moved(self, slot: int) -> None:
        """A beacon is, or the robot (slot 0) was, somewhere else from now on."""
        if slot == 0:
            self._broken = True
            self._doubt_last()
        else:
            self.ranges.moved(slot)

    def _doubt_last(self) -> None:
        """The robot was carried: its scans since one did not lie over the one before are not believed."""
        tied = {edge.new for edge in self.edges if edge.old == edge.new - 1}
        since = self.keyframes[-1].stamp - _FOUND_S * 1e9 if self.keyframes else 0
        loose = [k for k, key in enumerate(self.keyframes) if k > 0 and key.stamp > since and k not in tied]
        if loose:
            first = loose[0]
            self.edges = [edge for edge in self.edges if edge.new < first]
            self._anchors = [k for k in self._anchors if k < first]
            self.keyframes[first:] = [replace(key, scan=None) for key in self.keyframes[first:]]

    def put(self, poses: np.ndarray, turn: float) -> None:
        """The map was drawn again: keyframes so far are at poses (N, 3) in it, turned by an angle [rad]."""
        R = np.eye(3)
        c, s = np.cos(turn), np.sin(turn)
        R[:2, :2] = [[c, -s], [s, c]]
        # new ones, not changed ones: a copy keeps what it has
        self.keyframes = [
            replace(key, pose=pose, informed=R @ key.informed @ R.T)
            for key, pose in zip(self.keyframes, poses, strict=True)
        ]

    def add(self, config: Config, params: Params, seen: list[tuple[int, StampedFrame, Estimate]]) -> None:
        """Take in a few frames. seen: number in the history, frame and estimate of each."""
        for number, frame, estimate in seen:
            pose = map_pose(estimate)
            self.ranges.hear(frame, estimate, pose, params, config.nlos_gap_db)
            self._roll(frame)
            informed = np.asarray(estimate.information, float)
            if self.keyframes and not self._far(pose, frame.stamp, informed):
                continue
            drift = turned(-pose[2], np.asarray(estimate.velocity, float))
            scan = _packed(frame.frame.scan) if _sees(frame) else None
            turning = float(estimate.yaw_rate)
            key = Keyframe(frame.stamp, number, pose, informed, scan, drift, turning, self._wheels, self._broken)
            if self._broken or not self.keyframes:
                self.ranges.drop()
            else:
                last = self.keyframes[-1]
                self.ranges.close(len(self.keyframes) - 1, (last.stamp, key.stamp), (last.pose, key.pose))
            self.keyframes.append(key)
            self._wheels, self._broken = np.zeros(3), False
            if scan is not None:
                self._tie(params)

    def _far(self, pose: np.ndarray, stamp: int, informed: np.ndarray) -> bool:
        last = self.keyframes[-1]
        moved = relative(last.pose, pose)
        late = stamp - last.stamp > _BLIND_S * 1e9 and _blind(informed)
        return bool(self._broken or np.hypot(*moved[:2]) > _MOVED[0] or abs(wrapped(moved[2])) > _MOVED[1] or late)

    def _roll(self, frame: StampedFrame) -> None:
        odometry = frame.frame.odometry
        if not bool(odometry.valid):
            self._wheels = None
        elif self._wheels is not None:
            step = np.asarray(odometry.increment, float)
            self._wheels = np.append(self._wheels[:2] + turned(self._wheels[2], step[:2]), self._wheels[2] + step[2])

    def _tie(self, params: Params) -> None:
        """Edges from the newest keyframe to older ones whose scans it can be laid over."""
        new = len(self.keyframes) - 1
        key, old = self.keyframes[new], self._candidates(new)
        if not old:
            return
        padded = (old * _TIES)[:_TIES]  # always as many: nothing is compiled again
        guess = np.array([relative(self.keyframes[k].pose, key.pose) for k in padded])
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *[self.keyframes[k].snapshot() for k in padded])
        found = jax.device_get(register(params, stacked, key.snapshot(), np.float32(guess)))
        for k, target in enumerate(old):
            pose, information = (np.asarray(a[k], float) for a in (found.pose, found.information))
            if found.share[k] > _SHARE and np.all(np.abs(pose - guess[k]) < _BELIEVED):
                self.edges.append(Edge(target, new, pose, information))

    def _candidates(self, new: int) -> list[int]:
        """Keyframes to lay the newest one over: the last one, the nearest anchors, the oldest anchor in reach."""
        key = self.keyframes[new]
        poses = np.array([self.keyframes[k].pose for k in self._anchors]).reshape(-1, 3)
        apart = np.linalg.norm(poses[:, :2] - key.pose[:2], axis=1)
        cost = apart + np.abs(wrapped(poses[:, 2] - key.pose[2])) * _TURN_M
        near = [self._anchors[k] for k in np.argsort(cost, kind="stable")[:_NEAREST] if apart[k] < _REACH_M]
        oldest = [self._anchors[k] for k in np.flatnonzero(apart < _REACH_M)[:1]]
        last = self._last_seen(new)
        if not len(cost) or cost.min() > _ANCHOR_M:
            self._anchors.append(new)
        return list(dict.fromkeys([*last, *near, *oldest]))

    def _last_seen(self, new: int) -> list[int]:
        """The keyframe with a scan before the newest one, where the robot was not carried since."""
        for k in range(new, 0, -1):
            if self.keyframes[k].broken:
                break
            if self.keyframes[k - 1].scan is not None:
                return [k - 1]
        return []


def map_pose(estimate: Estimate) -> np.ndarray:
    """(3,) where the map has the robot: the match, or what was expected of it where nothing matched [m, m, rad]."""
    if np.any(estimate.information):
        return np.asarray(estimate.matched_pose, float)
    return np.asarray(estimate.pose, float) + np.asarray(estimate.map_error, float)


def sight(estimate: Estimate) -> float:
    """What a match told of the position: NaN for all of it, inf for nothing, else the direction that it cannot see, in
    the map's frame [rad]."""
    (xx, xy), (_, yy) = estimate.information[:2, :2].tolist()
    mean, spread = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)  # the eigenvalues are mean -+ spread
    if mean - spread > _SEEN_M**-2:
        return math.nan
    along = 0.5 * math.atan2(2 * xy, xx - yy)  # where most is seen
    return along + 0.5 * math.pi if mean + spread > _SEEN_M**-2 else math.inf


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses b in the frames of poses a, both (..., 3); the angle is not wrapped."""
    return np.concatenate([turned(-a[..., 2], b[..., :2] - a[..., :2]), b[..., 2:] - a[..., 2:]], axis=-1)


def wrapped(angle):
    """The same angles in [-pi, pi) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _blind(informed: np.ndarray) -> bool:
    return bool(np.linalg.eigvalsh(informed[:2, :2])[0] < _BLIND_M**-2)


def _sees(frame: StampedFrame) -> bool:
    return bool(frame.frame.has_scan) and int(np.sum(frame.frame.scan.valid)) > _FEWEST_RETURNS


def _packed(scan: Scan) -> Scan:
    millimetres = np.where(scan.valid, np.round(np.asarray(scan.ranges, float) * _MM), 0)
    # what is farther off than 16 bits can tell is farther off than the map's window
    return scan._replace(ranges=np.where(millimetres < 2**16, millimetres, 0).astype(np.uint16), valid=None)
