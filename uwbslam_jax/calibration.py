"""Range biases from the run itself: antenna delays that nobody configured, found once the robot has seen enough.

A short start cannot tell a bias from a beacon that stands a little elsewhere; a lap can. Ranges are averaged by where
the robot was, and beacons and biases solved with the track as it is, with and without biases: only where biases
explain the ranges far better are they believed.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uwbslam_jax.config import Params
from uwbslam_jax.heard import antenna_at
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.multilateration import DECIDED, soften
from uwbslam_jax.placement import CALIBRATED_M, largest_sigma
from uwbslam_jax.slam import Estimate

BIAS_M = 0.3
"""Prior spread of a node's bias [m]."""
_PLACE_M = 0.5
"""Ranges to one beacon taken within so much are one mean."""
_FLOOR_M = 0.05
"""However many ranges are averaged, and however well the robot is known there: the map bends."""
_FEWEST_PLACES = 12
"""A beacon ranged from fewer places tells nothing."""
_QUIET = 1.5
"""Pairs whose noise counts as more than this many times that of a radio are left out: they range through walls."""
_MOVES = 15
_COARSE = 4.0
_KNOWN_M = 0.1
"""A bias is known when its standard deviation is below this [m]."""

Place = tuple[int, int]


class Solution(NamedTuple):
    """Beacons and biases that explain the ranges of a run.

    Attributes:
      slots: of the beacons. beacons: (B, 2) [m]; bias, bias_sigma: (1 + B,) of the robot's node and theirs, in
        addition to what is configured [m].
      cov: (2 B, 2 B) of the beacons, biases marginalised.
      biased: whether it has biases: they explain the ranges far better than none, or did so before.
      gain: log-likelihood gained over what is known now.
    """

    slots: list[int]
    beacons: np.ndarray
    bias: np.ndarray
    bias_sigma: np.ndarray
    cov: np.ndarray
    biased: bool
    gain: float

    @property
    def known(self) -> bool:
        """Whether the ranges determine every one of them."""
        return bool(np.all(self.bias_sigma < _KNOWN_M) and largest_sigma(self.cov).max() < _KNOWN_M)


@dataclass
class _Mean:
    """Sums over ranges of one pair, from one place: count, x, y of the antenna, slant distance, variance of x."""

    count: int = 0
    x: float = 0.0
    y: float = 0.0
    distance: float = 0.0
    variance: float = 0.0


class Calibration:
    """What was ranged so far, by place; bounded by the ground that the robot covers."""

    def __init__(self, sigma_n: float):
        self._sigma_n = sigma_n
        self._robot: dict[int, dict[Place, _Mean]] = defaultdict(lambda: defaultdict(_Mean))
        self._pairs: dict[tuple[int, int], _Mean] = defaultdict(_Mean)

    def forget(self, slot: int) -> None:
        """A beacon that is elsewhere now."""
        self._robot.pop(slot, None)
        for pair in [pair for pair in self._pairs if slot in pair]:
            del self._pairs[pair]

    def hear(self, frame: StampedFrame, estimate: Estimate, params: Params, loudness: np.ndarray) -> None:
        """One frame's ranges that were used. loudness: (K, K) of the pairs, see ranging."""
        r = frame.frame.ranges
        resting = np.asarray(estimate.active) & ~np.asarray(estimate.moving)
        sigma = float(np.trace(estimate.pose_cov[:2, :2])) / 2
        for k in np.flatnonzero(np.asarray(estimate.weight) > 0):
            i, j = sorted((int(r.i[k]), int(r.j[k])))
            if not (resting[j] and (i == 0 or resting[i])) or loudness[i, j] > _QUIET:
                continue
            distance = float(r.range[k]) / (1.0 + float(params.bias_scale))
            if i > 0:
                _add(self._pairs[i, j], np.zeros(2), distance, 0.0)
                continue
            at = antenna_at(estimate, np.asarray(r.age[k : k + 1], float), params)[0]
            key = int(at[0] // _PLACE_M), int(at[1] // _PLACE_M)
            _add(self._robot[j][key], at, distance, sigma)

    def solve(self, places: np.ndarray, found: dict[int, float], configured: Params) -> Solution | None:
        """Beacons, and biases where those explain the ranges far better than none; None where too little was ranged.

        Args:
          places: (K, 2) of the nodes to start from [m]. found: slot -> bias to start from [m].
          configured: with the biases that the user gave.
        """
        slots = sorted(slot for slot, means in self._robot.items() if len(means) >= _FEWEST_PLACES)
        if len(slots) < 2:
            return None
        problem = self._rows(slots, configured)
        bias = np.array([found.get(slot, 0.0) for slot in (0, *slots)])
        start = np.concatenate([places[slots].ravel(), bias])
        calibrated = problem.minimise(start, CALIBRATED_M)
        biased = problem.minimise(start, BIAS_M)
        better = calibrated[1] - biased[1] > DECIDED + 3.0 * len(bias)
        x, cost, cov = biased if better or found else calibrated
        m = 2 * len(slots)
        sigma = np.sqrt(np.diag(cov)[m:])
        gain = problem.cost(start, BIAS_M if found else CALIBRATED_M) - cost
        return Solution(slots, x[:m].reshape(-1, 2), x[m:], sigma, cov[:m, :m], better or bool(found), gain)

    def _rows(self, slots: list[int], configured: Params) -> _Problem:
        index = {slot: b for b, slot in enumerate(slots)}
        height, bias = np.asarray(configured.height, float), np.asarray(configured.bias, float)
        rows, pairs = [], []
        for slot in slots:
            for mean in self._robot[slot].values():
                n = mean.count
                sigma = np.sqrt(self._sigma_n**2 / n + mean.variance / n + _FLOOR_M**2)
                known = bias[0] + bias[slot]
                rise = height[0] - height[slot]
                rows.append((index[slot], mean.x / n, mean.y / n, mean.distance / n - known, rise, sigma))
        for (i, j), mean in self._pairs.items():
            if i in index and j in index:
                distance = mean.distance / mean.count - bias[i] - bias[j]
                sigma = np.sqrt(self._sigma_n**2 / mean.count + _FLOOR_M**2)
                pairs.append((index[i], index[j], distance, height[i] - height[j], sigma))
        return _Problem(len(slots), np.array(rows), np.array(pairs).reshape(-1, 5))


def _add(mean: _Mean, at: np.ndarray, distance: float, variance: float) -> None:
    mean.count += 1
    mean.x, mean.y = mean.x + at[0], mean.y + at[1]
    mean.distance, mean.variance = mean.distance + distance, mean.variance + variance


class _Problem(NamedTuple):
    """Means in arrays [m].

    rows (R, 6): beacon, antenna x, y, distance, rise, sigma; pairs (E, 5): two beacons, distance, rise, sigma.
    """

    count: int
    rows: np.ndarray
    pairs: np.ndarray

    def minimise(self, x: np.ndarray, bias_sigma: float) -> tuple[np.ndarray, float, np.ndarray]:
        """Beacons and biases (2 B + 1 + B,), their cost and covariance, by Levenberg-Marquardt from x.

        First with coarse ranges, so that none is an outlier only because the start is wrong.
        """
        x = self._coarser(_COARSE)._descend(x, bias_sigma)
        x = self._descend(x, bias_sigma)
        J, _ = self._linearise(x, bias_sigma)
        return x, self.cost(x, bias_sigma), np.linalg.inv(J.T @ J + 1e-9 * np.eye(len(x)))

    def cost(self, x: np.ndarray, bias_sigma: float) -> float:
        """Negative log-likelihood of beacons and biases."""
        _, r = self._linearise(x, bias_sigma)
        return float(0.5 * r @ r)

    def _coarser(self, factor: float) -> _Problem:
        rows, pairs = self.rows.copy(), self.pairs.copy()
        rows[:, 5] *= factor
        pairs[:, 4] *= factor
        return self._replace(rows=rows, pairs=pairs)

    def _descend(self, x: np.ndarray, bias_sigma: float) -> np.ndarray:
        damping = 1e-3
        J, r = self._linearise(x, bias_sigma)
        for _ in range(_MOVES):
            A = J.T @ J
            moved = x - np.linalg.solve(A + damping * np.diag(np.diag(A) + 1e-9), J.T @ r)
            new_J, new_r = self._linearise(moved, bias_sigma)
            if new_r @ new_r < r @ r:
                done = r @ r - new_r @ new_r < 1e-3
                x, J, r, damping = moved, new_J, new_r, max(damping / 5, 1e-9)
                if done:
                    break
            else:
                damping *= 10
        return x

    def _linearise(self, x: np.ndarray, bias_sigma: float) -> tuple[np.ndarray, np.ndarray]:
        m = 2 * self.count
        beacons, bias = x[:m].reshape(-1, 2), x[m:]
        b = self.rows[:, 0].astype(int)
        u = beacons[b] - self.rows[:, 1:3]
        i, j = self.pairs[:, 0].astype(int), self.pairs[:, 1].astype(int)
        v = beacons[i] - beacons[j]
        first, to_first = self._whitened(u, self.rows[:, 4], bias[0] + bias[1 + b] - self.rows[:, 3], self.rows[:, 5])
        second, to_second = self._whitened(
            v, self.pairs[:, 3], bias[1 + i] + bias[1 + j] - self.pairs[:, 2], self.pairs[:, 4]
        )
        J = np.zeros((len(b) + len(i), len(x)))
        k, n = np.arange(len(b)), len(b) + np.arange(len(i))
        for axis in range(2):
            J[k, 2 * b + axis] = to_first[:, axis]
            J[n, 2 * i + axis], J[n, 2 * j + axis] = to_second[:, axis], -to_second[:, axis]
        J[k, m] = J[k, m + 1 + b] = to_first[:, 2]
        J[n, m + 1 + i], J[n, m + 1 + j] = to_second[:, 2], to_second[:, 2]
        prior = np.zeros((len(bias), len(x)))
        prior[:, m:] = np.eye(len(bias)) / bias_sigma
        return np.concatenate([J, prior]), np.concatenate([first, second, bias / bias_sigma])

    @staticmethod
    def _whitened(u, rise, offset, sigma) -> tuple[np.ndarray, np.ndarray]:
        """Robust residuals (R,) of |u| + offset, and their derivatives (R, 3) by u and by a bias."""
        d = np.maximum(np.sqrt((u**2).sum(1) + rise**2), 1e-6)
        r, scale = soften((d + offset) / sigma)
        weight = scale / sigma
        return r, np.column_stack([weight[:, None] * u / d[:, None], weight])
