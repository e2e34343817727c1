"""The batch problem of start-up: keyframe poses, beacon positions and range biases from steps and ranges, in float64.

Chains of poses with millimetre steps are beyond float32, and the problem runs once a second for some seconds only.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uwbslam_jax.numerics import (
    CALIBRATED_M,
    DECIDED,
    Edges,
    Pairs,
    PoseGraph,
    Stage,
    TrackRanges,
    between,
    cost_of,
    covariance,
    largest_sigma,
    multilaterate,
    rotation_matrix,
)
from uwbslam_jax.startup.keyframe_buffer import Buffer, Keyframe

_MOST_MOVES = 20
_STAGES = (Stage(soft=np.inf, coarse=8.0), Stage(soft=np.inf, coarse=1.0))
"""The problem is solved twice: first a range may err by so many times as much, or where the start is wrong by more than
the radio errs all its ranges were outliers, and a beacon could as well be anywhere."""
_ENOUGH = 0.02
"""The batch problem is solved when a move gains less log-likelihood than this."""


@dataclass(frozen=True)
class Placement:
    """One explanation of the start: keyframe poses and beacon positions in the start frame, with their covariance.

    Attributes:
      poses: (N, 3); slots: placed beacons; beacons: (B, 2) [m]; cost: negative log-likelihood.
      cov: joint covariance of poses and beacons in that order (3 N + 2 B).
      bias, bias_sigma: (1 + B,) of the robot's node and the beacons' [m].
    """

    poses: np.ndarray
    slots: list[int]
    beacons: np.ndarray
    cost: float
    cov: np.ndarray
    bias: np.ndarray
    bias_sigma: np.ndarray

    def beacon_sigma(self) -> np.ndarray:
        """(B,) largest standard deviation of each beacon's position in the start frame [m]."""
        return largest_sigma(self.cov[self.poses.size :, self.poses.size :])

    def only(self, kept: list[int]) -> Placement:
        """The same with some of the beacons, given by their index."""
        n = self.poses.size
        columns = np.concatenate([np.arange(n), *[n + 2 * b + np.arange(2) for b in kept]]).astype(int)
        nodes = np.array([0, *[1 + b for b in kept]])
        cov = self.cov[np.ix_(columns, columns)]
        slots = [self.slots[b] for b in kept]
        return Placement(
            self.poses, slots, self.beacons[kept], self.cost, cov, self.bias[nodes], self.bias_sigma[nodes]
        )

    def apart(self, other: Placement) -> np.ndarray:
        """(B,) how far the beacons of another explanation are from these [m]."""
        return np.linalg.norm(self.beacons - other.beacons, axis=1)


@dataclass(frozen=True)
class Problem(PoseGraph):
    """The batch problem in arrays.

    Attributes:
      slots: (B,) of the beacons. track: (N, 3) the keyframes as the track has them [m, m, rad].
    """

    slots: list[int]
    track: np.ndarray

    @staticmethod
    def build(buffer: Buffer) -> Problem:
        """Arrays of what was buffered; only beacons ranged from at least three intervals take part."""
        keys = buffer.track()
        seen = buffer.averages(keys)
        slots = [int(s) for s, count in zip(*np.unique(seen.to, return_counts=True), strict=True) if count >= 3]
        index = {slot: b for b, slot in enumerate(slots)}
        ok = np.isin(seen.to, slots)
        pairs = [
            (index[i], index[j], middle, 0.0, sigma)
            for (i, j), (middle, sigma) in buffer.pair_medians().items()
            if i in index and j in index
        ]
        at, to = seen.at[ok], np.array([index[int(s)] for s in seen.to[ok]], int)
        after, levers = np.minimum(at + 1, len(keys) - 1), (seen.before[ok], seen.after[ok])
        distance, sigma = seen.distance[ok], seen.sigma[ok]
        return Problem(
            count=len(keys),
            bias_of=1 + np.arange(len(slots)),
            edges=_steps(keys),
            ranges=TrackRanges(at, after, to, seen.share[ok], levers, distance, np.zeros(len(at)), sigma),
            pairs=Pairs.of(pairs),
            slots=slots,
            track=np.array([key.pose for key in keys]),
        )

    def images(self, placement: Placement) -> list[tuple[np.ndarray, np.ndarray]]:
        """Beacons and poses of a placement mirrored along, across and through the start of the line that the robot's
        antenna drove best along: a straight drive leaves the first one open, a blind corridor the others as well."""
        antenna = self.ranges.antenna(placement.poses)
        _, _, axes = np.linalg.svd(antenna - antenna.mean(0), full_matrices=False)
        found = []
        for along, across in ((1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
            turn = axes.T @ np.diag([along, across]) @ axes
            poses = placement.poses.copy()
            if along < 0:
                poses[:, :2] = (poses[:, :2] - poses[0, :2]) @ turn + poses[0, :2]
            centre = antenna.mean(0) if along > 0 else poses[0, :2]
            found.append(((placement.beacons - centre) @ turn + centre, poses))
        return found

    def minimise(
        self, beacons: np.ndarray, poses: np.ndarray | None = None, bias_sigma: float = CALIBRATED_M
    ) -> Placement:
        """Levenberg-Marquardt from given beacons and the track as it was driven; the first pose is held.

        Args:
          beacons: (B, 2) [m]. poses: (N, 3) to start from instead of the track.
          bias_sigma: prior spread of each node's range bias [m].
        """
        x = self.joined(self.track if poses is None else poses, beacons)
        x, cost = self.descend(x, bias_sigma, _STAGES, moves=_MOST_MOVES, enough=_ENOUGH, damping=1e-3)
        cov = covariance(self.rows(x[:3], bias_sigma, _STAGES[-1]), x, self.rank, np.arange(len(x)))
        poses, beacons, bias = self.split(x)
        m = self.first_bias
        return Placement(poses, self.slots, beacons, cost, cov[:m, :m], bias, np.sqrt(np.diag(cov)[m:]))

    def keep_unique(self, best: Placement, bias_sigma: float = CALIBRATED_M) -> Placement:
        """The placement without the beacons that have a second place which explains the ranges as well."""
        antenna, sigma = self.ranges.antenna(best.poses), best.beacon_sigma()
        rows = self.rows(best.poses[0], bias_sigma, _STAGES[-1])
        unique = []
        for b in range(len(self.slots)):
            mine = self.ranges.to == b
            distance = self.ranges.distance[mine] - best.bias[0] - best.bias[1 + b]
            spots = np.stack(multilaterate(antenna[mine], distance, self.ranges.sigma[mine]))
            away = spots[np.argmax(np.linalg.norm(spots - best.beacons[b], axis=1))]
            moved = best.beacons.copy()
            moved[b] = away
            there = cost_of(rows, np.concatenate([best.poses.ravel(), moved.ravel(), best.bias]))
            near = np.linalg.norm(away - best.beacons[b]) < max(4 * sigma[b], 0.3)
            unique.append(near or there - best.cost > DECIDED)
        return best.only([b for b, ok in enumerate(unique) if ok])


def _steps(keys: list[Keyframe]) -> Edges:
    """Relative poses of consecutive keyframes, with the roots of their information in the earlier one's frame."""
    new = np.arange(1, len(keys))
    poses = np.array([key.pose for key in keys])
    steps, roots = between(poses[:-1], poses[1:]), np.zeros((len(new), 3, 3))
    for k, (a, b) in enumerate(pairwise(keys)):
        turn = rotation_matrix(a.pose[2], 3).T
        length, angle = np.hypot(*steps[k, :2]), abs(steps[k, 2])
        elapsed = (b.frame.stamp - a.frame.stamp) / 1e9
        # where the match says nothing, wheels or the motion model still bound the step; where it says much, the map
        # it was matched with has its own drift
        if b.odometry:
            loose = np.diag([0.03 + 0.06 * length, 0.03 + 0.06 * length, 0.02 + 0.06 * angle]) ** 2
        else:
            pace = 0.1 + 0.2 * length + min(elapsed, 3.0)
            loose = np.diag([pace, pace, 0.05 + 0.1 * angle]) ** 2
        tight = np.diag([0.005 + 0.01 * length, 0.005 + 0.01 * length, 0.002 + 0.003 * angle]) ** 2
        cov = np.linalg.inv(turn @ b.information @ turn.T + np.linalg.inv(loose)) + tight
        roots[k] = np.linalg.cholesky(np.linalg.inv(cov)).T
    return Edges(new - 1, new, steps, roots, np.zeros(len(new), bool))
