"""The batch problem of start-up: keyframe poses and beacon positions from steps and ranges, in float64 on the host.

Chains of poses with millimetre steps are beyond float32, and the problem runs once a second for some seconds only.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.multilateration import DECIDED, RANGE_FLOOR_M, multilaterate, soften

_MOST_MOVES = 20
_ENOUGH = 0.02
"""The batch problem is solved when a move gains less log-likelihood than this."""


@dataclass
class Keyframe:
    """One pose of the start-up track and the ranges taken near it.

    Attributes:
      frame: its measurements; the scan is drawn again when the frame is decided.
      pose: (3,) in the start frame [m, m, rad].
      information: (3, 3) of its match, in the start frame.
      velocity, yaw_rate: of the robot then, to undo the sweep [m/s, rad/s].
      seen: slot -> list of (antenna position relative to the pose, range), robot to beacon [m].
    """

    frame: StampedFrame
    pose: np.ndarray
    information: np.ndarray
    velocity: np.ndarray
    yaw_rate: float
    seen: dict[int, list[tuple[np.ndarray, float]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Placement:
    """One explanation of the start: keyframe poses and beacon positions in the start frame, with their covariance.

    Attributes:
      poses: (N, 3); slots: placed beacons; beacons: (B, 2) [m]; cost: negative log-likelihood.
      cov: joint covariance of poses and beacons in that order (3 N + 2 B).
    """

    poses: np.ndarray
    slots: list[int]
    beacons: np.ndarray
    cost: float
    cov: np.ndarray

    def beacon_sigma(self) -> np.ndarray:
        """(B,) largest standard deviation of each beacon's position in the start frame [m]."""
        return largest_sigma(self.cov[self.poses.size :, self.poses.size :])

    def only(self, kept: list[int]) -> Placement:
        """The same with some of the beacons, given by their index."""
        n = self.poses.size
        columns = np.concatenate([np.arange(n), *[n + 2 * b + np.arange(2) for b in kept]]).astype(int)
        cov = self.cov[np.ix_(columns, columns)]
        return Placement(self.poses, [self.slots[b] for b in kept], self.beacons[kept], self.cost, cov)


def largest_sigma(cov: np.ndarray) -> np.ndarray:
    """(B,) largest standard deviation of each of B points with joint covariance (2 B, 2 B)."""
    blocks = [cov[2 * b : 2 * b + 2, 2 * b : 2 * b + 2] for b in range(len(cov) // 2)]
    return np.array([np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0)) for block in blocks])


@dataclass(frozen=True)
class Problem:
    """The batch problem in arrays. N keyframes, B beacons, R averaged ranges, E pairs of beacons.

    steps (N-1, 3) relative poses with roots (N-1, 3, 3) of their information; at (R,) keyframe, to (R,) beacon index,
    local (R, 2), distance (R,), sigma (R,); pair (E, 2) beacon indices, pair_distance (E,), pair_sigma (E,).
    """

    slots: list[int]
    track: np.ndarray
    steps: np.ndarray
    roots: np.ndarray
    at: np.ndarray
    to: np.ndarray
    local: np.ndarray
    distance: np.ndarray
    sigma: np.ndarray
    pair: np.ndarray
    pair_distance: np.ndarray
    pair_sigma: np.ndarray

    @staticmethod
    def build(keys: list[Keyframe], pairs: dict[tuple[int, int], list[float]], sigma_n: float) -> Problem:
        """Arrays of what was buffered; only beacons ranged from at least three keyframes take part."""
        heard: dict[int, int] = {}
        for key in keys:
            for slot in key.seen:
                heard[slot] = heard.get(slot, 0) + 1
        slots = sorted(slot for slot, count in heard.items() if count >= 3)
        index = {slot: b for b, slot in enumerate(slots)}
        rows = [
            (k, index[s], *_average(seen)) for k, key in enumerate(keys) for s, seen in key.seen.items() if s in index
        ]
        between = [(index[i], index[j], d) for (i, j), d in pairs.items() if i in index and j in index]
        track = np.array([key.pose for key in keys])
        steps, roots = _steps(keys)

        def sigma(count):
            return np.sqrt(sigma_n**2 / np.maximum(count, 1) + RANGE_FLOOR_M**2)

        return Problem(
            slots=slots,
            track=track,
            steps=steps,
            roots=roots,
            at=np.array([r[0] for r in rows], int),
            to=np.array([r[1] for r in rows], int),
            local=np.array([r[2] for r in rows]).reshape(-1, 2),
            distance=np.array([r[3] for r in rows]),
            sigma=sigma(np.array([r[4] for r in rows])),
            pair=np.array([p[:2] for p in between], int).reshape(-1, 2),
            pair_distance=np.array([np.median(p[2]) for p in between]),
            # a median of n is as good as a mean of 0.64 n
            pair_sigma=sigma(0.64 * np.array([len(p[2]) for p in between])),
        )

    def starts(self) -> tuple[np.ndarray, np.ndarray]:
        """Beacon positions (B, 2) to start from: the sides that fit the beacons' own ranges best, and the mirror."""
        antenna = self._antenna(self.track)
        near, far = np.zeros((2, len(self.slots), 2))
        for b in range(len(self.slots)):
            mine = self.to == b
            near[b], far[b] = multilaterate(antenna[mine], self.distance[mine], self.sigma[mine])
        choice = self._consistent_sides(near, far)
        return np.where(choice[:, None], far, near), np.where(choice[:, None], near, far)

    def _consistent_sides(self, near: np.ndarray, far: np.ndarray) -> np.ndarray:
        """For each beacon, whether its second candidate is the one that agrees with the ranges between beacons."""
        count = len(self.slots)
        if not len(self.pair):
            return np.zeros(count, bool)
        rng = np.random.default_rng(0)
        best, best_cost = np.zeros(count, bool), np.inf
        for trial in range(8):
            choice = np.zeros(count, bool) if trial == 0 else rng.random(count) < 0.5
            cost = self._pair_cost(np.where(choice[:, None], far, near))
            improved = True
            while improved:
                improved = False
                for b in range(count):
                    choice[b] ^= True
                    other = self._pair_cost(np.where(choice[:, None], far, near))
                    if other < cost - 1e-9:
                        cost, improved = other, True
                    else:
                        choice[b] ^= True
            if cost < best_cost:
                best, best_cost = choice.copy(), cost
        return best

    def _pair_cost(self, beacons: np.ndarray) -> float:
        d = np.linalg.norm(beacons[self.pair[:, 0]] - beacons[self.pair[:, 1]], axis=1)
        return float(np.abs(d - self.pair_distance).sum())

    def _antenna(self, poses: np.ndarray) -> np.ndarray:
        c, s = np.cos(poses[self.at, 2]), np.sin(poses[self.at, 2])
        x, y = self.local.T
        return poses[self.at, :2] + np.stack([c * x - s * y, s * x + c * y], -1)

    def mirror(self, placement: Placement) -> np.ndarray:
        """The beacons of a placement mirrored at the line that the robot's antenna drove best along."""
        antenna = self._antenna(placement.poses)
        _, _, axes = np.linalg.svd(antenna - antenna.mean(0), full_matrices=False)
        normal = axes[1]
        return placement.beacons - 2 * ((placement.beacons - antenna.mean(0)) @ normal)[:, None] * normal

    def minimise(self, beacons: np.ndarray) -> Placement:
        """Levenberg-Marquardt from given beacons and the track as it was driven; the first pose is held."""
        poses, damping = self.track.copy(), 1e-3
        J, r = self._linearise(poses, beacons)
        cost = 0.5 * r @ r
        for _ in range(_MOST_MOVES):
            A, g = J.T @ J, J.T @ r
            move = -np.linalg.solve(A + damping * np.diag(np.diag(A) + 1e-9), g)
            new_poses = poses + move[: poses.size].reshape(-1, 3)
            new_beacons = beacons + move[poses.size :].reshape(-1, 2)
            new_J, new_r = self._linearise(new_poses, new_beacons)
            new_cost = 0.5 * new_r @ new_r
            if new_cost < cost:
                done = cost - new_cost < _ENOUGH
                poses, beacons, J, r, cost = new_poses, new_beacons, new_J, new_r, new_cost
                damping = max(damping / 5, 1e-9)
                if done:
                    break
            else:
                damping *= 10
                if damping > 1e6:
                    break
        cov = np.linalg.inv(J.T @ J + 1e-9 * np.eye(J.shape[1]))
        return Placement(poses, self.slots, beacons, float(cost), cov)

    def _linearise(self, poses: np.ndarray, beacons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened Jacobian (rows, 3 N + 2 B) and residuals of held start, steps, ranges and pairs."""
        n, b = poses.size, beacons.size
        blocks = [self._hold_start(poses, n + b), self._step_rows(poses, n + b)]
        blocks += [self._range_rows(poses, beacons, n + b), self._pair_rows(poses, beacons, n + b)]
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

    def _range_rows(self, poses, beacons, columns):
        antenna = self._antenna(poses)
        u = antenna - beacons[self.to]
        d = np.maximum(np.linalg.norm(u, axis=1), 1e-6)
        unit = u / d[:, None]
        lever = antenna - poses[self.at, :2]
        r, scale = soften((d - self.distance) / self.sigma)
        weight = scale / self.sigma
        rows, J = np.arange(len(d)), np.zeros((len(d), columns))
        for axis in range(2):
            J[rows, 3 * self.at + axis] = weight * unit[:, axis]
            J[rows, poses.size + 2 * self.to + axis] = -weight * unit[:, axis]
        J[rows, 3 * self.at + 2] = weight * (unit[:, 1] * lever[:, 0] - unit[:, 0] * lever[:, 1])
        return J, r

    def _pair_rows(self, poses, beacons, columns):
        i, j = self.pair.T
        u = beacons[i] - beacons[j]
        d = np.maximum(np.linalg.norm(u, axis=1), 1e-6)
        r, scale = soften((d - self.pair_distance) / self.pair_sigma)
        weight = (scale / self.pair_sigma / d)[:, None] * u
        rows, J = np.arange(len(d)), np.zeros((len(d), columns))
        for axis in range(2):
            J[rows, poses.size + 2 * i + axis] = weight[:, axis]
            J[rows, poses.size + 2 * j + axis] = -weight[:, axis]
        return J, r

    def keep_unique(self, best: Placement) -> Placement:
        """The placement without the beacons that have a second place which explains the ranges as well."""
        antenna, sigma = self._antenna(best.poses), best.beacon_sigma()
        unique = []
        for b in range(len(self.slots)):
            mine = self.to == b
            spots = np.stack(multilaterate(antenna[mine], self.distance[mine], self.sigma[mine]))
            away = spots[np.argmax(np.linalg.norm(spots - best.beacons[b], axis=1))]
            moved = best.beacons.copy()
            moved[b] = away
            _, r = self._linearise(best.poses, moved)
            near = np.linalg.norm(away - best.beacons[b]) < max(4 * sigma[b], 0.3)
            unique.append(near or 0.5 * r @ r - best.cost > DECIDED)
        return best.only([b for b, ok in enumerate(unique) if ok])


def _average(seen: list[tuple[np.ndarray, float]]) -> tuple[np.ndarray, float, int]:
    """Mean place, distance and count of the ranges near one keyframe, without the ones far from their median."""
    local = np.array([s[0] for s in seen])
    distance = np.array([s[1] for s in seen])
    middle = np.sort(distance)[len(distance) // 2]  # one of them, so that at least one is near it
    ok = np.abs(distance - middle) < 0.5
    return local[ok].mean(0), float(distance[ok].mean()), int(ok.sum())


def _steps(keys: list[Keyframe]) -> tuple[np.ndarray, np.ndarray]:
    """Relative poses of consecutive keyframes and the roots of their information, in the earlier one's frame."""
    steps, roots = np.zeros((len(keys) - 1, 3)), np.zeros((len(keys) - 1, 3, 3))
    for k, (a, b) in enumerate(pairwise(keys)):
        R = rotation(a.pose[2]).T
        u = b.pose - a.pose
        steps[k] = np.append(R @ u[:2], u[2])
        turn = np.eye(3)
        turn[:2, :2] = R
        length = np.hypot(*u[:2])
        # where the match says nothing, the motion model still bounds the step; where it says much, the map it was
        # matched with has its own drift
        loose = np.diag([0.1 + 0.2 * length, 0.1 + 0.2 * length, 0.05 + 0.1 * abs(u[2])]) ** 2
        tight = np.diag([0.005 + 0.01 * length, 0.005 + 0.01 * length, 0.002 + 0.003 * abs(u[2])]) ** 2
        cov = np.linalg.inv(turn @ b.information @ turn.T + np.linalg.inv(loose)) + tight
        roots[k] = np.linalg.cholesky(np.linalg.inv(cov)).T
    return steps, roots


def rotation(theta: float) -> np.ndarray:
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])
