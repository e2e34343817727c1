"""The batch problem of start-up: keyframe poses, beacon positions and range biases from steps and ranges, in float64.

Chains of poses with millimetre steps are beyond float32, and the problem runs once a second for some seconds only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwbslam_jax.numerics import (
    DECIDED,
    LIDAR,
    WHEELS,
    Edges,
    Off,
    Pairs,
    PoseGraph,
    Stage,
    TrackRanges,
    between,
    cost_of,
    covariance,
    largest_sigma,
    median_range,
    multilaterate,
    rotation_matrix,
    tells_scale,
    wrapped,
)
from uwbslam_jax.startup.keyframe_buffer import Buffer, Keyframe, is_blind

_LOOSE_WHEELS = (0.03, 0.06, 0.02, 0.06)
"""Standard deviation of a step by wheels, see `step_sigma`."""
_LOOSE = (0.1, 0.2, 0.05, 0.1)
"""The same of a step that nothing measured, without what it may have driven in the time."""
_LONGEST_S = 3.0
"""So long at most counts with a metre a second."""
_DRIFT = (0.005, 0.01, 0.002, 0.003)
"""The same of what the map that a scan is matched with drifts on the step."""
_MOST_MOVES = 20
"""Of a stage at most [moves]: a bound on the time of a solve from a wrong hypothesis."""
_STAGES = (Stage(soft=np.inf, coarse=8.0), Stage(soft=np.inf, coarse=1.0))
"""The problem is solved twice: first a range may err by so many times as much, or where the start is wrong by more than
the radio errs all its ranges were outliers, and a beacon could as well be anywhere."""
LAST = _STAGES[-1]
"""The stage in which costs are compared."""
_FEWEST_MEANS = 3
"""A beacon ranged less takes no part: so many averages over half an interval between keyframes."""
_ENOUGH = 0.02
"""The batch problem is solved when a move gains less log-likelihood than this."""


@dataclass(frozen=True)
class Placement:
    """One explanation of the start: keyframe poses and beacon positions in the start frame, with their covariance.

    Attributes:
      poses: (N, 3); slots: placed beacons; beacons: (B, 2) [m]; cost: negative log-likelihood.
      cov: joint covariance of poses and beacons in that order (3 N + 2 B).
      off, off_sigma: what the ranges of the robot's node and the beacons' are off by, and how well that is known.
      drawn: number of the last pose whose scan is in the map, of the last one where there is no scan.
    """

    poses: np.ndarray
    slots: list[int]
    beacons: np.ndarray
    cost: float
    cov: np.ndarray
    off: Off
    off_sigma: Off
    drawn: int

    def beacon_sigma(self) -> np.ndarray:
        """(B,) largest standard deviation of each beacon's position in the start frame [m]."""
        return largest_sigma(self.cov[self.poses.size :, self.poses.size :])

    def strength(self, group: str) -> float:
        """See Off."""
        return self.off.strength(self.off_sigma, group)

    def only(self, kept: list[int]) -> Placement:
        """The same with some of the beacons, given by their index."""
        n = self.poses.size
        columns = np.concatenate([np.arange(n), *[n + 2 * b + np.arange(2) for b in kept]]).astype(int)
        nodes = np.array([0, *[1 + b for b in kept]])
        cov = self.cov[np.ix_(columns, columns)]
        slots = [self.slots[b] for b in kept]
        off, sigma = (o._replace(bias=o.bias[nodes], height=o.height[nodes]) for o in (self.off, self.off_sigma))
        return Placement(self.poses, slots, self.beacons[kept], self.cost, cov, off, sigma, self.drawn)

    def columns(self, *poses: int) -> np.ndarray:
        """Of some poses, given by their number, and of the beacons in the covariance."""
        n = self.poses.size
        return np.concatenate([*(3 * k + np.arange(3) for k in poses), np.arange(n, n + self.beacons.size)])

    def apart(self, other: Placement) -> np.ndarray:
        """(B,) how far the beacons of another explanation are from these [m]."""
        return np.linalg.norm(self.beacons - other.beacons, axis=1)


@dataclass(frozen=True)
class Problem(PoseGraph):
    """The batch problem in arrays.

    Attributes:
      slots: (B,) of the beacons. track: (N, 3) the keyframes as the track has them [m, m, rad]. drawn: see Placement.
    """

    slots: list[int]
    track: np.ndarray
    drawn: int

    @staticmethod
    def build(buffer: Buffer) -> Problem | None:
        """Arrays of what was buffered, with the beacons ranged often enough; None where these are not two."""
        keys = buffer.track()
        seen = [means for means in buffer.averages(keys) if len(means.at) >= _FEWEST_MEANS]
        index = {int(means.to[0]): b for b, means in enumerate(seen)}
        if len(seen) < 2:
            return None
        seen = [means._replace(to=np.full(len(means.at), b)) for b, means in enumerate(seen)]
        pairs = [
            (index[i], index[j], middle, float(buffer.host.rise(i, j)), sigma)
            for (i, j), kept in buffer.pairs.items()
            if i in index and j in index
            for middle, sigma, _ in [median_range(np.array(kept), buffer.host.sigma_n)]
        ]
        return Problem(
            count=len(keys),
            bias_of=1 + np.arange(len(index)),
            edges=_steps(keys),
            ranges=TrackRanges(*(np.concatenate(column) for column in zip(*seen, strict=True))),
            pairs=Pairs.of(pairs),
            open=np.array([1 + b for slot, b in index.items() if not buffer.host.surveyed[slot]], int),
            scaled=tells_scale(
                np.array([not is_blind(key.information) for key in keys if key.information.any()], bool)
            ),
            slots=list(index),
            track=np.array([key.pose for key in keys]),
            drawn=max((k for k, key in enumerate(keys) if key.matched), default=len(keys) - 1),
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

    def minimise(self, beacons: np.ndarray, poses: np.ndarray | None = None, off: Off | None = None) -> Placement:
        """Levenberg-Marquardt from given beacons and the track as it was driven; the first pose is held.

        Args:
          beacons: (B, 2) [m]. poses: (N, 3) to start from instead of the track.
          off: what ranges are off by to start from.
        """
        x = self.risen(self.joined(self.track if poses is None else poses, beacons, off))
        x, cost = self.descend(x, _STAGES, moves=_MOST_MOVES, enough=_ENOUGH, damping=1e-3)
        cov = covariance(self.rows(x[:3], LAST), self.risen(x), self.rank, np.arange(len(x)))
        poses, beacons, off = self.split(x)
        m = self.first_bias
        sigma = self.off(np.sqrt(np.diag(cov)[m:]))
        return Placement(poses, self.slots, beacons, cost, cov[:m, :m], off, sigma, self.drawn)

    def misfit(self, placement: Placement) -> float:
        """Median of how far the robot's ranges are off in a placement, in standard deviations."""
        off, to = placement.off, self.ranges.to
        apart = np.linalg.norm(self.ranges.antenna(placement.poses) - placement.beacons[to], axis=1)
        slant = np.hypot(apart, self.ranges.rise - off.height[1 + to])
        expected = (1.0 + off.scale) * slant + off.bias[0] + off.bias[1 + to]
        return float(np.median(np.abs(expected - self.ranges.distance) / self.ranges.sigma))

    def keep_unique(self, best: Placement) -> Placement:
        """The placement without the beacons that have a second place which explains the ranges as well."""
        antenna, sigma = self.ranges.antenna(best.poses), best.beacon_sigma()
        rows = self.rows(best.poses[0], LAST)
        unique = []
        for b in range(len(self.slots)):
            mine = self.ranges.to == b
            slant = (self.ranges.distance[mine] - best.off.bias[0] - best.off.bias[1 + b]) / (1.0 + best.off.scale)
            distance = np.sqrt(np.maximum(slant**2 - best.off.height[1 + b] ** 2, 0.01))
            spots = np.stack(multilaterate(antenna[mine], distance, self.ranges.sigma[mine]))
            away = spots[np.argmax(np.linalg.norm(spots - best.beacons[b], axis=1))]
            moved = best.beacons.copy()
            moved[b] = away
            there = cost_of(rows, self.joined(best.poses, moved, best.off))
            near = np.linalg.norm(away - best.beacons[b]) < max(4 * sigma[b], 0.3)
            unique.append(near or there - best.cost > DECIDED)
        return best.only([b for b, ok in enumerate(unique) if ok])


def _steps(keys: list[Keyframe]) -> Edges:
    """Relative poses of consecutive keyframes, then of each scan that follows on keyframes by wheels alone to the scan
    before them: what its match tells holds the whole way from there."""
    matched, poses = np.array([key.matched for key in keys]), np.array([key.pose for key in keys])
    stamps = np.array([key.frame.stamp for key in keys])
    scans, next_one = np.flatnonzero(matched), np.arange(1, len(keys))
    apart = np.flatnonzero(np.diff(scans) > 1)
    old, new = np.append(next_one - 1, scans[apart]), np.append(next_one, scans[apart + 1])
    told = matched[old] & matched[new]
    rolled = np.array([key.rolled for key in keys])[new] & (new == old + 1)
    by_wheels = (rolled & ~told)[:, None]
    steps = np.where(by_wheels, np.array([key.wheels for key in keys])[new], between(poses[old], poses[new]))
    # where the match says nothing, wheels or the motion model still bound the step; where it says much, the map it was
    # matched with has its own drift
    loose = loose_sigma(steps, (stamps[new] - stamps[old]) / 1e9, rolled)
    turn = np.array([rotation_matrix(-heading, 3) for heading in poses[old, 2]]).reshape(-1, 3, 3)
    information = np.array([key.information for key in keys])[new] * told[:, None, None]
    cov = np.linalg.inv(turn @ information @ turn.swapaxes(1, 2) + diagonal(loose**-2))
    roots = np.linalg.cholesky(np.linalg.inv(cov + diagonal(step_sigma(steps, _DRIFT) ** 2))).swapaxes(1, 2)
    return Edges(old, new, steps, roots, np.zeros(len(new), bool), np.where(by_wheels[:, 0], WHEELS, LIDAR))


def loose_sigma(steps: np.ndarray, elapsed: np.ndarray, rolled: np.ndarray) -> np.ndarray:
    """(n, 3) standard deviation of steps (n, 3) between keyframes by wheels, where these measured them (n,), or by
    nothing, where the robot may have driven for the time that elapsed (n,) [s]."""
    driven = np.minimum(elapsed, _LONGEST_S)[:, None] * np.array([1.0, 1.0, 0.0])
    return np.where(rolled[:, None], step_sigma(steps, _LOOSE_WHEELS), step_sigma(steps, _LOOSE) + driven)


def step_sigma(steps: np.ndarray, loose: tuple[float, float, float, float]) -> np.ndarray:
    """(n, 3) standard deviation of steps by their lengths and turns [m, m, rad].

    Args:
      loose: floor and share of the way [m], floor and share of the turn [rad].
    """
    floor, share, floor_yaw, share_yaw = loose
    along = floor + share * np.hypot(steps[:, 0], steps[:, 1])
    return np.stack([along, along, floor_yaw + share_yaw * np.abs(wrapped(steps[:, 2]))], axis=-1)


def diagonal(values: np.ndarray) -> np.ndarray:
    """Diagonal matrices (n, 3, 3) of rows (n, 3)."""
    return values[:, :, None] * np.eye(3)
