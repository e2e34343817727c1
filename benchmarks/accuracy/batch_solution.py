"""The batch solution of a recording with odometry and ranges: what the estimator's figures stand beside.

All poses, beacons and biases at once by scipy.optimize.least_squares with a robust loss. It sees the whole recording
and starts from the true beacons, so that it shows what the measurements are worth, not how to get there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from uwbslam_jax import OdometryMessage, RangeMessage, Truth
from uwbslam_jax.evaluation import evaluate, rigid_fit
from uwbslam_jax.measurements import Message

_KNOT_S = 1.0
_MOST_KNOTS = 240
_STEP_SIGMA = (0.01, 0.02, 0.01, 0.02)
"""Error of a step between two knots: floor [m], a metre [m/m], floor [rad], a radian [rad/rad]."""
_OFFSET_SIGMA, _SCALE_SIGMA = 0.3, 0.1
"""Prior of each beacon's constant bias [m] and of the one that grows with the distance [m/m]."""


@dataclass(frozen=True)
class BatchProblem:
    """N knots, R ranges, B beacons.

    track (N, 3) dead reckoning at the knots; at (R,) knot before a range, local (R, 2) the robot then in the knot's
    frame, to (R,) beacon, distance (R,) [m]; sigma [m] of a range.
    """

    stamps: np.ndarray
    track: np.ndarray
    at: np.ndarray
    local: np.ndarray
    to: np.ndarray
    distance: np.ndarray
    sigma: float
    ids: list[int]

    @staticmethod
    def build(messages: list[Message], robot: int, sigma: float) -> BatchProblem:
        """Knots every second, or as often as their number allows; between knots the odometry is taken as it is."""
        wheels = [m for m in messages if isinstance(m, OdometryMessage)]
        stamps = np.array([m.stamp for m in wheels])
        poses = np.array([(m.x, m.y, m.yaw) for m in wheels])
        ranges = [m for m in messages if isinstance(m, RangeMessage) and stamps[0] <= m.stamp <= stamps[-1]]
        ids = sorted({m.source + m.target - robot for m in ranges})
        count = min(_MOST_KNOTS, max(int((stamps[-1] - stamps[0]) / (_KNOT_S * 1e9)), len(stamps) // 20))
        knots = np.unique(np.linspace(0, len(stamps) - 1, count).astype(int))
        when = np.array([m.stamp for m in ranges])
        at = np.clip(np.searchsorted(stamps[knots], when, side="right") - 1, 0, len(knots) - 1)
        then = np.column_stack([np.interp(when - stamps[0], stamps - stamps[0], poses[:, k]) for k in range(2)])
        track = poses[knots]
        u = then - track[at, :2]
        c, s = np.cos(track[at, 2]), np.sin(track[at, 2])
        local = np.column_stack([c * u[:, 0] + s * u[:, 1], -s * u[:, 0] + c * u[:, 1]])
        to = np.array([ids.index(m.source + m.target - robot) for m in ranges])
        return BatchProblem(stamps[knots], track, at, local, to, np.array([m.range for m in ranges]), sigma, ids)

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Poses (N, 3), beacons (B, 2), offsets (B,) and the scale."""
        n, b = self.track.size, len(self.ids)
        return x[:n].reshape(-1, 3), x[n : n + 2 * b].reshape(-1, 2), x[n + 2 * b : n + 3 * b], float(x[-1])

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Whitened: steps, ranges, priors of the biases, the first pose held."""
        poses, beacons, offsets, scale = self.split(x)
        e = _steps(poses) - _steps(self.track)
        gap = np.linalg.norm(self._robot(poses) - beacons[self.to], axis=1)
        ranges = ((1 + scale) * gap + offsets[self.to] - self.distance) / self.sigma
        held = (poses[0] - self.track[0]) / 1e-3
        return np.concatenate(
            [(e / self._step_sigma()).ravel(), ranges, offsets / _OFFSET_SIGMA, [scale / _SCALE_SIGMA], held]
        )

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Of the residuals."""
        poses, beacons, _, scale = self.split(x)
        n, b, m, r = self.track.size, len(self.ids), len(self.track) - 1, len(self.to)
        J = np.zeros((3 * m + r + b + 4, len(x)))
        k, sigma = np.arange(m), self._step_sigma()
        c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        e = _steps(poses)
        for row, (along_x, along_y) in enumerate([(c, s), (-s, c)]):
            for column, value in enumerate((along_x, along_y)):
                J[3 * k + row, 3 * k + column] = -value / sigma[:, row]
                J[3 * k + row, 3 * k + 3 + column] = value / sigma[:, row]
        J[3 * k, 3 * k + 2], J[3 * k + 1, 3 * k + 2] = e[:, 1] / sigma[:, 0], -e[:, 0] / sigma[:, 1]
        J[3 * k + 2, 3 * k + 2], J[3 * k + 2, 3 * k + 5] = -1 / sigma[:, 2], 1 / sigma[:, 2]
        rows, robot = 3 * m + np.arange(r), self._robot(poses)
        u = robot - beacons[self.to]
        gap = np.maximum(np.linalg.norm(u, axis=1), 1e-6)
        g = (1 + scale) * u / gap[:, None] / self.sigma
        lever = robot - poses[self.at, :2]
        for axis in range(2):
            J[rows, 3 * self.at + axis] = g[:, axis]
            J[rows, n + 2 * self.to + axis] = -g[:, axis]
        J[rows, 3 * self.at + 2] = g[:, 1] * lever[:, 0] - g[:, 0] * lever[:, 1]
        J[rows, n + 2 * b + self.to], J[rows, -1] = 1 / self.sigma, gap / self.sigma
        J[3 * m + r + np.arange(b), n + 2 * b + np.arange(b)] = 1 / _OFFSET_SIGMA
        J[3 * m + r + b, -1] = 1 / _SCALE_SIGMA
        J[-3 + np.arange(3), np.arange(3)] = 1e3
        return J

    def _robot(self, poses: np.ndarray) -> np.ndarray:
        c, s = np.cos(poses[self.at, 2]), np.sin(poses[self.at, 2])
        x, y = self.local.T
        return poses[self.at, :2] + np.column_stack([c * x - s * y, s * x + c * y])

    def _step_sigma(self) -> np.ndarray:
        steps = np.abs(_steps(self.track))
        length = np.hypot(steps[:, 0], steps[:, 1])
        xy, yaw = _STEP_SIGMA[0] + _STEP_SIGMA[1] * length, _STEP_SIGMA[2] + _STEP_SIGMA[3] * steps[:, 2]
        return np.column_stack([xy, xy, yaw])


def _steps(poses: np.ndarray) -> np.ndarray:
    """(N-1, 3) each pose in the frame of the one before; headings are not wrapped."""
    u = np.diff(poses, axis=0)
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.column_stack([c * u[:, 0] + s * u[:, 1], -s * u[:, 0] + c * u[:, 1], u[:, 2]])


def solve(messages: list[Message], truth: Truth, robot: int, sigma: float) -> dict[str, float]:
    """Figures of the batch solution: those of metrics.evaluate, the scale and the mean constant bias found."""
    problem = BatchProblem.build(messages, robot, sigma)
    known = truth.beacon_positions()
    true = np.array([known[node] for node in problem.ids])
    # the true beacons in the frame of the dead reckoning, by its first quarter, which has drifted little
    early = slice(0, max(len(problem.track) // 4, 3))
    at = truth.poses_at(problem.stamps[early])[:, :2]
    beacons = rigid_fit(at, problem.track[early, :2]).points(true)
    start = np.concatenate([problem.track.ravel(), beacons.ravel(), np.zeros(len(problem.ids) + 1)])
    found = least_squares(problem.residuals, start, problem.jacobian, loss="soft_l1", f_scale=2.0)  # pyright: ignore[reportArgumentType]
    poses, beacons, offsets, scale = problem.split(found.x)
    placed = dict(zip(problem.ids, beacons, strict=True))
    figures = evaluate(problem.stamps, poses, placed, truth)
    return figures | {"bias_scale": scale, "bias_m": float(np.mean(offsets)), "knots": len(poses)}
