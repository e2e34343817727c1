"""The graph of a whole run: keyframes, scans laid over older scans, and the ranges taken on the way.

Collected while the steps run, solved by `smoothing`. Host arrays; grows with the way, not with the time, and its scans
with the ground that was covered.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

import jax
import numpy as np
from scipy import sparse

from uwbslam_jax.backend.range_means import RangeMeans
from uwbslam_jax.backend.registration import View, register, view
from uwbslam_jax.estimator import Estimate, map_pose
from uwbslam_jax.measurements import Scan, Snapshot, StampedFrame
from uwbslam_jax.numerics import Column, between, rotation_matrix, transformed, turned, wrapped
from uwbslam_jax.settings import HostParams
from uwbslam_jax.startup import is_blind, is_far

_FEWEST_RETURNS = 20
"""A scan of fewer returns tells nothing."""
_ANCHOR_M = 2.0
"""A keyframe this far from every anchor is one: later scans are laid over anchors, so that a place that is passed
again hangs on the first time and not on the time before."""
_TURN_M = 1.0
"""A turn of one radian makes two scans see as little of the same as so much way [m]."""
_REACH_M = 10.0
"""Anchors farther off are not tried."""
_NEAREST, _TIES = 2, 4
"""A scan is laid over the one before, the nearest anchors, and the oldest one in reach."""
_SHARE = 0.5
"""Share of a scan's surfaces that have to lie on those of the older one."""
_BELIEVED = (0.6, 0.6, 0.2)
"""A scan that lies farther off than this from where the map has it was laid over something else [m, m, rad]."""
_HANG_TOGETHER = 8
"""So many keyframes whose scans lie over each other are a place."""
_FOUND_S = 5.0
"""A robot that was carried is found within so long."""
_VIEWS = 64
"""Scans that were last laid over others are kept ready for the next: 3 MB."""
_SCANS_OF_A_PLACE, _PLACE = 8, (1.5, 0.8)
"""Scans taken so near to each other see the same [m, rad]; more than so many of them tell nothing new."""
_MM = 1000.0
"""Scans are kept in whole millimetres."""


KEYFRAME = np.dtype(
    [
        ("stamp", np.int64),
        ("frame", np.int32),
        ("pose", np.float64, 3),
        ("informed", np.float32, (3, 3)),
        ("drift", np.float32, 2),
        ("yaw_rate", np.float32),
        ("wheels", np.float64, 3),
        ("broken", np.bool_),
    ]
)
"""One pose of the graph.

stamp: [ns]; frame: number of it in the history. pose: where the map has it: what its match reported, or what was
expected where nothing matched [m, m, rad]. informed: information of the match in the map's frame, 0 where there is
none. drift: velocity in the robot's frame [m/s]; yaw_rate [rad/s]. wheels: motion since the keyframe before by
odometry, NaN where it was not measured all the way. broken: whether the robot was carried on the way from the keyframe
before.
"""

EDGE = np.dtype([("old", np.int32), ("new", np.int32), ("between", np.float64, 3), ("information", np.float32, (3, 3))])
"""A keyframe relative to an older one, by their scans.

old, new: numbers of the keyframes. between: pose of the new one in the frame of the old one [m, m, rad]. information:
of it, in that frame.
"""


@dataclass
class Graph:
    """What was collected so far.

    Attributes:
      ranges: see there. keyframes: rows of KEYFRAME; edges: rows of EDGE.
      scans: of each keyframe what it saw, lengths in millimetres; None where there was nothing to see, or others saw
        the same.
    """

    ranges: RangeMeans = field(default_factory=RangeMeans)
    keyframes: Column = field(default_factory=lambda: Column(dtype=KEYFRAME))
    edges: Column = field(default_factory=lambda: Column(dtype=EDGE))
    scans: list[Scan | None] = field(default_factory=list)
    _wheels: np.ndarray = field(default_factory=lambda: np.zeros(3))
    _broken: bool = False
    _anchors: list[int] = field(default_factory=list)
    _settled: int = 0
    _kept: list[int] = field(default_factory=list)
    _views: dict[int, View] = field(default_factory=dict)

    def copy(self) -> Graph:
        """What there is now; what is added later does not change it."""
        return Graph(self.ranges.copy(), self.keyframes.copy(), self.edges.copy(), list(self.scans))

    def poses(self) -> np.ndarray:
        """(N, 3) where the map has the keyframes [m, m, rad]."""
        return self.keyframes["pose"].copy()

    def stamps(self) -> np.ndarray:
        """(N,) of the keyframes [ns]."""
        return self.keyframes["stamp"].copy()

    def blind(self) -> np.ndarray:
        """(N,) whether a keyframe's scan does not tell where it is in some direction."""
        return is_blind(self.keyframes["informed"])

    def hangs_on(self) -> np.ndarray:
        """(N,) whether a keyframe is known relative to the one before: its scan was matched, or wheels measured."""
        return self.matched() | self.rolled()

    def matched(self) -> np.ndarray:
        """(N,) whether a keyframe's scan was matched with the map."""
        return np.any(self.keyframes["informed"] != 0, axis=(1, 2))

    def rolled(self) -> np.ndarray:
        """(N,) whether wheels measured all the way from the keyframe before."""
        return np.isfinite(self.keyframes["wheels"][:, 0])

    def snapshot(self, number: int) -> Snapshot:
        """The scan of a keyframe that has one, as it was."""
        packed, key = self.scans[number], self.keyframes[number]
        assert packed is not None
        reach = packed.ranges.astype(np.float32) / np.float32(_MM)
        return Snapshot(packed._replace(ranges=reach, valid=packed.ranges > 0), key["drift"].copy(), key["yaw_rate"])

    def seen(self, poses: np.ndarray, first: int = 0) -> Iterator[tuple[np.ndarray, Snapshot]]:
        """What may be drawn, from a first keyframe on, at poses (N, 3): scans that hang together with many others.

        A few that hang only on each other were taken where nothing could be told: in somebody's arms, in smoke. Unless
        they are the newest and match the map: others are yet to come, and the robot stands on this ground.
        """
        count, old, new = len(self.keyframes), self.edges["old"], self.edges["new"]
        tied = sparse.coo_array((np.ones(len(old)), (old, new)), shape=(count, count))
        _, part = sparse.csgraph.connected_components(tied, directed=False)
        size = np.bincount(part, minlength=1)
        kept = size >= min(_HANG_TOGETHER, size.max())
        kept[part[-1:]] |= self.matched()[-1:]
        drawn = [k for k in np.flatnonzero(kept[part]).tolist() if k >= first and self.scans[k] is not None]
        return ((poses[k], self.snapshot(k)) for k in drawn)

    def placed(self, slot: int, since: int) -> None:
        """A beacon was found to rest where it was ranged from a time on [ns]; where it was before, nobody knows."""
        self.ranges.forget(slot, int(np.searchsorted(self.keyframes["stamp"], since)))

    def moved(self, slot: int) -> None:
        """A beacon is, or the robot (slot 0) was, somewhere else from now on."""
        if slot == 0:
            self._broken = True
            self._doubt_last()
        else:
            self.ranges.moved(slot)

    def _doubt_last(self) -> None:
        """The robot was carried: its scans since one did not lie over the one before are not believed."""
        if not len(self.keyframes):
            return
        loose = self.keyframes["stamp"] > self.keyframes["stamp"][-1] - _FOUND_S * 1e9
        loose[0] = False
        loose[self.edges["new"][self.edges["old"] == self.edges["new"] - 1]] = False
        if loose.any():
            first = int(np.argmax(loose))
            self.edges.keep(self.edges["new"] < first)
            self._anchors = [k for k in self._anchors if k < first]
            self.scans[first:] = [None] * (len(self.scans) - first)

    def put(self, poses: np.ndarray, turn: float) -> None:
        """The map was drawn again: keyframes so far are at poses (N, 3) in it, turned by an angle [rad]."""
        R = rotation_matrix(turn, 3)
        self.keyframes["pose"][:] = poses
        self.keyframes["informed"][:] = R @ self.keyframes["informed"] @ R.T

    def add(self, host: HostParams, number: int, frame: StampedFrame, estimate: Estimate) -> None:
        """Take in one frame. number: in the history."""
        pose = map_pose(estimate)
        self.ranges.hear(frame, estimate, pose, host)
        self._roll(frame)
        informed = np.asarray(estimate.information, float)
        if not len(self.keyframes):
            self.ranges.drop()
        else:
            last = self.keyframes[-1]
            stamps = int(last["stamp"]), frame.stamp
            far = self._is_far(-1, pose, frame.stamp, informed)
            if not far and _sees(frame) and self.scans[-1] is None:  # wheels alone have been here, no scan has
                scans = (k for k in range(len(self.scans) - 1, -1, -1) if self.scans[k] is not None)
                far = all(self._is_far(k, pose, frame.stamp, informed) for k in itertools.islice(scans, 1))
            if self._broken:
                self.ranges.drop()
            elif far:
                self.ranges.close(len(self.keyframes) - 1, stamps, (last["pose"], pose), host.sigma_n)
            else:
                return
        drift = turned(-pose[2], np.asarray(estimate.velocity, float))
        told = pose, informed, drift, estimate.yaw_rate, self._wheels, self._broken
        self.keyframes.append((frame.stamp, number, *told))
        self.scans.append(_packed(frame.frame.scan) if _sees(frame) else None)
        self._wheels, self._broken = np.zeros(3), False
        if self.scans[-1] is not None:
            self._tie(host)
        self._thin()

    def _is_far(self, number: int, pose: np.ndarray, stamp: int, informed: np.ndarray) -> bool:
        """Whether a pose is far from a keyframe."""
        key = self.keyframes[number]
        return is_far(pose, key["pose"], stamp - int(key["stamp"]), lambda: bool(is_blind(informed)))

    def _roll(self, frame: StampedFrame) -> None:
        odometry = frame.frame.odometry
        if not bool(odometry.valid):
            self._wheels = np.full(3, np.nan)
        elif np.isfinite(self._wheels[0]):
            step = np.asarray(odometry.increment, float)
            self._wheels = np.append(transformed(self._wheels, step[:2]), self._wheels[2] + step[2])

    def _tie(self, host: HostParams) -> None:
        """Edges from the newest keyframe to older ones whose scans it can be laid over."""
        new = len(self.keyframes) - 1
        old = self._candidates(new)
        if not old:
            return
        padded = (old * _TIES)[:_TIES]  # always as many: nothing is compiled again
        guess = between(self.keyframes["pose"][padded], self.keyframes["pose"][new])
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(self._view(host, k) for k in padded))
        found = jax.device_get(register(stacked, self._view(host, new), np.float32(guess)))
        believed = np.all(np.abs(found.pose - guess) < _BELIEVED, axis=1) & (found.share > _SHARE)
        for k in np.flatnonzero(believed[: len(old)]):
            self.edges.append((old[k], new, found.pose[k], found.information[k]))

    def _view(self, host: HostParams, number: int) -> View:
        """The scan of a keyframe, made ready."""
        made = self._views.pop(number, None)
        self._views[number] = made or jax.device_get(view(np.float32(host.lidar), self.snapshot(number)))
        if len(self._views) > _VIEWS:
            del self._views[next(iter(self._views))]
        return self._views[number]

    def _candidates(self, new: int) -> list[int]:
        """Keyframes to lay the newest one over: the last one, the nearest anchors, the oldest anchor in reach."""
        poses, pose = self.keyframes["pose"][self._anchors], self.keyframes["pose"][new]
        apart = np.linalg.norm(poses[:, :2] - pose[:2], axis=1)
        cost = apart + np.abs(wrapped(poses[:, 2] - pose[2])) * _TURN_M
        near = [self._anchors[k] for k in np.argsort(cost, kind="stable")[:_NEAREST] if apart[k] < _REACH_M]
        oldest = [self._anchors[k] for k in np.flatnonzero(apart < _REACH_M)[:1]]
        last = self._last_seen(new)
        if not len(cost) or cost.min() > _ANCHOR_M:
            self._anchors.append(new)
        return list(dict.fromkeys([*last, *near, *oldest]))

    def _last_seen(self, new: int) -> list[int]:
        """The keyframe with a scan before the newest one, where the robot was not carried since."""
        for k in range(new, 0, -1):
            if self.keyframes["broken"][k]:
                break
            if self.scans[k - 1] is not None:
                return [k - 1]
        return []

    def _thin(self) -> None:
        """Leave out the oldest scan of a place that enough others were taken at, but not an anchor's.

        So the scans of a run are bounded by the ground, and the map is drawn from the newest. What may still be found
        to have been taken in somebody's arms covers nothing.
        """
        poses, newest = self.keyframes["pose"], self.keyframes["stamp"][-1]
        while self.keyframes["stamp"][self._settled] <= newest - _FOUND_S * 1e9:
            k, self._settled = self._settled, self._settled + 1
            if self.scans[k] is None:
                continue
            off = poses[self._kept] - poses[k]
            same = (np.hypot(*off[:, :2].T) < _PLACE[0]) & (np.abs(wrapped(off[:, 2])) < _PLACE[1])
            others = [self._kept[n] for n in np.flatnonzero(same)]
            self._kept.append(k)
            spare = [other for other in others if other not in self._anchors]
            if len(others) >= _SCANS_OF_A_PLACE and spare:
                self.scans[spare[0]] = None
                self._kept.remove(spare[0])


def _sees(frame: StampedFrame) -> bool:
    return bool(frame.frame.has_scan) and int(np.sum(frame.frame.scan.valid)) > _FEWEST_RETURNS


def _packed(scan: Scan) -> Scan:
    millimetres = np.where(scan.valid, np.round(np.asarray(scan.ranges, float) * _MM), 0)
    # what is farther off than 16 bits can tell is farther off than the map's window
    return scan._replace(ranges=np.where(millimetres < 2**16, millimetres, 0).astype(np.uint16), valid=None)
