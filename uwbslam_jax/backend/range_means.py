"""Ranges of a run, averaged between keyframes, by the place where each beacon rests. Host arrays; bounded by the way.

Raw ranges wait until the next keyframe is there: only then is it known where on the way they were taken.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from uwbslam_jax.estimator import Estimate
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.numerics import Column, mean_sigma, near_middle, scatter_along, turned
from uwbslam_jax.settings import HostParams

_NEWEST = 21
"""So many ranges of a pair tell how much they scatter."""
_MOST = 400
"""Newest ranges of a pair that are kept: of two beacons, or while the robot rests."""

Node = tuple[int, int]
"""A beacon at one of its resting places: slot, number of the place."""


MEAN = np.dtype(
    [
        ("at", np.int32),
        ("slot", np.int32),
        ("place", np.int32),
        ("share", np.float32),
        ("before", np.float32, 2),
        ("after", np.float32, 2),
        ("distance", np.float32),
        ("sigma", np.float32),
        ("loud", np.bool_),
        ("stamp", np.float64),
    ]
)
"""Ranges between the robot and a beacon at rest, averaged over half an interval between two keyframes.

at: keyframe before. slot, place: the node. share: of the way to the next keyframe. before, after: the antenna in the
frame of the keyframe before and of the one after [m]. distance: as measured, sigma: its standard deviation [m]. loud:
whether the ranges scatter more than the radio does. stamp: of the exchanges in the mean [ns]; they may be from before
the keyframe.
"""


class _Heard(NamedTuple):
    """One range of the robot: when [ns], where the antenna was on the map [m], distance [m]."""

    stamp: float
    x: float
    y: float
    distance: float


@dataclass
class RangeMeans:
    """What was ranged so far.

    Attributes:
      means: rows of MEAN. pairs: newest ranges between two beacons at rest, by their nodes.
    """

    means: Column = field(default_factory=lambda: Column(dtype=MEAN))
    pairs: dict[tuple[Node, Node], deque[float]] = field(default_factory=dict)
    _places: dict[int, int] = field(default_factory=dict)
    _newest: dict[int, deque[float]] = field(default_factory=dict)
    _open: dict[Node, deque[_Heard]] = field(default_factory=dict)

    def copy(self) -> RangeMeans:
        """The means and pairs there are now; what is added later does not change them."""
        pairs = {pair: deque(kept) for pair, kept in self.pairs.items()}
        return RangeMeans(self.means.copy(), pairs)

    def node(self, slot: int) -> Node:
        """The place where a beacon rests now."""
        return slot, self._places.get(slot, 0)

    def moved(self, slot: int) -> None:
        """A beacon is somewhere else from now on."""
        self._places[slot] = self._places.get(slot, 0) + 1
        self._newest.pop(slot, None)

    def forget(self, slot: int, before: int) -> None:
        """Leave out the means of a beacon's present place from before a keyframe: it may have been elsewhere then."""
        rows, (_, place) = self.means.values, self.node(slot)
        self.means.keep((rows["slot"] != slot) | (rows["place"] != place) | (rows["at"] >= before))

    def hear(self, frame: StampedFrame, estimate: Estimate, pose: np.ndarray, host: HostParams) -> None:
        """Take in one frame's ranges between nodes at rest, or that are not known to move. pose: (3,) on the map."""
        r = frame.frame.ranges
        moving = np.asarray(estimate.moving)
        usable = host.usable(r) & ~(moving[r.i] | moving[r.j])
        # plain numbers: a hundred of these ranges a frame are handled one by one
        ahead, left = host.antenna.tolist()
        (x, y, yaw), (vx, vy), turning = pose.tolist(), estimate.velocity.tolist(), float(estimate.yaw_rate)
        columns = (np.asarray(column)[usable].tolist() for column in (r.i, r.j, r.range, r.age))
        for a, b, distance, age in zip(*columns, strict=True):
            i, j = min(a, b), max(a, b)
            if i > 0:
                self.pairs.setdefault((self.node(i), self.node(j)), deque(maxlen=_MOST)).append(distance)
                continue
            c, s = math.cos(yaw + age * turning), math.sin(yaw + age * turning)
            place = x + age * vx + c * ahead - s * left, y + age * vy + s * ahead + c * left
            self._newest.setdefault(j, deque(maxlen=_NEWEST)).append(distance)
            heard = _Heard(frame.stamp + age * 1e9, *place, distance)
            self._open.setdefault(self.node(j), deque(maxlen=_MOST)).append(heard)

    def close(self, at: int, stamps: tuple[int, int], poses: tuple[np.ndarray, np.ndarray], sigma_n: float) -> None:
        """Average what was heard on the way from one keyframe to the next.

        Args:
          at: number of the first. stamps [ns], poses (3,) of both. sigma_n: standard deviation of a range [m].
        """
        span = max(stamps[1] - stamps[0], 1)
        for node, heard in self._open.items():
            newest = np.array(self._newest.get(node[0], ()))
            scatter = float(scatter_along(newest, sigma_n)[-1]) if len(newest) else sigma_n
            # two means in each interval: one would leave the keyframes free to move to and fro between their middles
            halves: dict[bool, list[_Heard]] = defaultdict(list)
            for one in heard:
                halves[one.stamp - stamps[0] >= span / 2].append(one)
            for some in halves.values():
                self.means.append((at, *node, *_mean(stamps[0], span, poses, (scatter, sigma_n), some)))
        self.drop()

    def drop(self) -> None:
        """Leave out what was heard since the last keyframe."""
        self._open.clear()


def _mean(
    start: int, span: int, poses: tuple[np.ndarray, np.ndarray], noise: tuple[float, float], heard: list[_Heard]
) -> tuple:
    """The fields of MEAN from the share on. noise: scatter of the pair's ranges, and sigma_n [m]."""
    rows = np.array(heard)
    rows = rows[near_middle(rows[:, 3])]
    stamp, x, y, distance = rows.mean(0).tolist()
    share = min(max((stamp - start) / span, 0.0), 1.0)
    before, after = (turned(-pose[2], np.array([x, y]) - pose[:2]) for pose in poses)
    sigma = mean_sigma(len(rows), *noise)
    return share, before, after, distance, sigma, sigma > mean_sigma(1, noise[1], noise[1]), stamp
