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
    between,
    largest_sigma,
    multilaterate,
    rotation_matrix,
    soften,
    transformed,
)
from uwbslam_jax.startup.keyframe_buffer import Buffer, Keyframe

_MOST_MOVES = 20
_COARSE = (8.0, 1.0)
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
class Problem:
    """The batch problem in arrays. N keyframes, B beacons, R averaged ranges, E pairs of beacons.

    steps (N-1, 3) relative poses with roots (N-1, 3, 3) of their information; at, after (R,) keyframes before and
    after a range, share (R,) of the way between them, local_at, local_after (R, 2) the antenna in their frames, to
    (R,) beacon index, distance, sigma (R,); pair (E, 2) beacon indices, pair_distance, pair_sigma (E,).
    """

    slots: list[int]
    track: np.ndarray
    steps: np.ndarray
    roots: np.ndarray
    at: np.ndarray
    after: np.ndarray
    share: np.ndarray
    local_at: np.ndarray
    local_after: np.ndarray
    to: np.ndarray
    distance: np.ndarray
    sigma: np.ndarray
    pair: np.ndarray
    pair_distance: np.ndarray
    pair_sigma: np.ndarray

    @staticmethod
    def build(buffer: Buffer) -> Problem:
        """Arrays of what was buffered; only beacons ranged from at least three intervals take part."""
        keys = buffer.track()
        seen = buffer.averages(keys)
        slots = [int(s) for s, count in zip(*np.unique(seen.to, return_counts=True), strict=True) if count >= 3]
        index = {slot: b for b, slot in enumerate(slots)}
        ok = np.isin(seen.to, slots)
        pairs = [(index[i], index[j], *m) for (i, j), m in buffer.pair_medians().items() if i in index and j in index]
        steps, roots = _steps(keys)
        return Problem(
            slots=slots,
            track=np.array([key.pose for key in keys]),
            steps=steps,
            roots=roots,
            at=seen.at[ok],
            after=np.minimum(seen.at[ok] + 1, len(keys) - 1),
            share=seen.share[ok],
            local_at=seen.before[ok],
            local_after=seen.after[ok],
            to=np.array([index[int(s)] for s in seen.to[ok]], int),
            distance=seen.distance[ok],
            sigma=seen.sigma[ok],
            pair=np.array([p[:2] for p in pairs], int).reshape(-1, 2),
            pair_distance=np.array([p[2] for p in pairs]),
            pair_sigma=np.array([p[3] for p in pairs]),
        )

    def antenna(self, poses: np.ndarray) -> np.ndarray:
        """(R, 2) where the robot's antenna was when each range was taken, between its two keyframes [m]."""
        ends = self._antenna_ends(poses)
        return (1 - self.share)[:, None] * ends[0] + self.share[:, None] * ends[1]

    def _antenna_ends(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same as either keyframe alone would have it."""
        return transformed(poses[self.at], self.local_at), transformed(poses[self.after], self.local_after)

    def images(self, placement: Placement) -> list[tuple[np.ndarray, np.ndarray]]:
        """Beacons and poses of a placement mirrored along, across and through the start of the line that the robot's
        antenna drove best along: a straight drive leaves the first one open, a blind corridor the others as well."""
        antenna = self.antenna(placement.poses)
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
        n, m = self.track.size, self.track.size + 2 * len(self.slots)
        start = self.track if poses is None else poses
        x = np.concatenate([start.ravel(), beacons.ravel(), np.zeros(1 + len(self.slots))])
        for coarse in _COARSE:
            x, J, cost = self._descend(x, bias_sigma, coarse)
        cov = np.linalg.inv(J.T @ J + 1e-9 * np.eye(J.shape[1]))
        return Placement(
            x[:n].reshape(-1, 3),
            self.slots,
            x[n:m].reshape(-1, 2),
            cost,
            cov[:m, :m],
            x[m:],
            np.sqrt(np.diag(cov)[m:]),
        )

    def _descend(self, x: np.ndarray, bias_sigma: float, coarse: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Unknowns, their Jacobian and the cost where a descent from x ends."""
        damping = 1e-3
        J, r = self._linearise(x, bias_sigma, coarse)
        cost = 0.5 * r @ r
        for _ in range(_MOST_MOVES):
            A, g = J.T @ J, J.T @ r
            moved = x - np.linalg.solve(A + damping * np.diag(np.diag(A) + 1e-9), g)
            new_J, new_r = self._linearise(moved, bias_sigma, coarse)
            new_cost = 0.5 * new_r @ new_r
            if new_cost < cost:
                done = cost - new_cost < _ENOUGH
                x, J, r, cost = moved, new_J, new_r, new_cost
                damping = max(damping / 5, 1e-9)
                if done:
                    break
            else:
                damping *= 10
                if damping > 1e6:
                    break
        return x, J, float(cost)

    def _linearise(self, x: np.ndarray, bias_sigma: float, coarse: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Whitened Jacobian (rows, 3 N + 2 B + 1 + B) and residuals of held start, steps, ranges, pairs and biases."""
        n, m = self.track.size, self.track.size + 2 * len(self.slots)
        poses, beacons, bias = x[:n].reshape(-1, 3), x[n:m].reshape(-1, 2), x[m:]
        blocks = [self._hold_start(poses, len(x)), self._step_rows(poses, len(x))]
        blocks += [self._range_rows(poses, beacons, bias, coarse)]
        blocks += [self._pair_rows(beacons, bias, coarse, len(x))]
        prior = np.zeros((len(bias), len(x)))
        prior[:, m:] = np.eye(len(bias)) / bias_sigma
        blocks.append((prior, bias / bias_sigma))
        return np.concatenate([J for J, _ in blocks]), np.concatenate([r for _, r in blocks])

    def _hold_start(self, poses, columns):
        J = np.zeros((3, columns))
        J[:, :3] = 1e4 * np.eye(3)
        return J, 1e4 * (poses[0] - self.track[0])

    def _step_rows(self, poses, columns):
        a, b = poses[:-1], poses[1:]
        m = len(a)
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        R = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], 1)  # (m, 2, 2), world to the earlier pose
        u = b[:, :2] - a[:, :2]
        moved = np.einsum("mij,mj->mi", R, u)
        e = np.column_stack([moved, b[:, 2] - a[:, 2]]) - self.steps
        local = np.zeros((m, 3, 6))
        local[:, :2, :2], local[:, :2, 3:5] = -R, R
        local[:, :2, 2] = -np.einsum("mij,mj->mi", R, np.stack([-u[:, 1], u[:, 0]], -1))
        local[:, 2, 2], local[:, 2, 5] = -1.0, 1.0
        J = np.zeros((m, 3, columns))
        rows = np.arange(m)
        for k in range(6):
            J[rows, :, 3 * rows + k] = np.einsum("mij,mj->mi", self.roots, local[:, :, k])
        return J.reshape(-1, columns), np.einsum("mij,mj->mi", self.roots, e).ravel()

    def _range_rows(self, poses, beacons, bias, coarse):
        ends = self._antenna_ends(poses)
        antenna = (1 - self.share)[:, None] * ends[0] + self.share[:, None] * ends[1]
        u = antenna - beacons[self.to]
        d = np.maximum(np.linalg.norm(u, axis=1), 1e-6)
        unit = u / d[:, None]
        sigma = coarse * self.sigma
        r, scale = soften((d + bias[0] + bias[1 + self.to] - self.distance) / sigma)
        weight = scale / sigma
        n, m = poses.size, poses.size + beacons.size
        rows, J = np.arange(len(d)), np.zeros((len(d), m + len(bias)))
        for key, end, part in ((self.at, ends[0], 1 - self.share), (self.after, ends[1], self.share)):
            lever = end - poses[key, :2]
            for axis in range(2):
                J[rows, 3 * key + axis] += part * weight * unit[:, axis]
            J[rows, 3 * key + 2] += part * weight * (unit[:, 1] * lever[:, 0] - unit[:, 0] * lever[:, 1])
        for axis in range(2):
            J[rows, n + 2 * self.to + axis] = -weight * unit[:, axis]
        J[rows, m], J[rows, m + 1 + self.to] = weight, weight
        return J, r

    def _pair_rows(self, beacons, bias, coarse, columns):
        i, j = self.pair.T
        u = beacons[i] - beacons[j]
        d = np.maximum(np.linalg.norm(u, axis=1), 1e-6)
        sigma = coarse * self.pair_sigma
        r, scale = soften((d + bias[1 + i] + bias[1 + j] - self.pair_distance) / sigma)
        weight = scale / sigma
        n, m = self.track.size, self.track.size + beacons.size
        rows, J = np.arange(len(d)), np.zeros((len(d), columns))
        for axis in range(2):
            J[rows, n + 2 * i + axis] = weight * u[:, axis] / d
            J[rows, n + 2 * j + axis] = -weight * u[:, axis] / d
        J[rows, m + 1 + i], J[rows, m + 1 + j] = weight, weight
        return J, r

    def keep_unique(self, best: Placement, bias_sigma: float = CALIBRATED_M) -> Placement:
        """The placement without the beacons that have a second place which explains the ranges as well."""
        antenna, sigma = self.antenna(best.poses), best.beacon_sigma()
        unique = []
        for b in range(len(self.slots)):
            mine = self.to == b
            distance = self.distance[mine] - best.bias[0] - best.bias[1 + b]
            spots = np.stack(multilaterate(antenna[mine], distance, self.sigma[mine]))
            away = spots[np.argmax(np.linalg.norm(spots - best.beacons[b], axis=1))]
            moved = best.beacons.copy()
            moved[b] = away
            _, r = self._linearise(np.concatenate([best.poses.ravel(), moved.ravel(), best.bias]), bias_sigma)
            near = np.linalg.norm(away - best.beacons[b]) < max(4 * sigma[b], 0.3)
            unique.append(near or 0.5 * r @ r - best.cost > DECIDED)
        return best.only([b for b, ok in enumerate(unique) if ok])


def _steps(keys: list[Keyframe]) -> tuple[np.ndarray, np.ndarray]:
    """Relative poses of consecutive keyframes and the roots of their information, in the earlier one's frame."""
    steps, roots = np.zeros((len(keys) - 1, 3)), np.zeros((len(keys) - 1, 3, 3))
    for k, (a, b) in enumerate(pairwise(keys)):
        steps[k] = between(a.pose, b.pose)
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
    return steps, roots
