"""Whether ranges are stamped late: a range that belongs to a moment before its stamp is wrong by the way since then."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uwbslam_jax.backend.final_solution import Hindsight
from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.numerics import transformed, turned, wrapped
from uwbslam_jax.settings import HostParams

_NOTABLE_S, _SURE = 0.05, 10.0
"""Ranges are late if by more than this [s], and by so many standard deviations [1]: at a metre a second it is what a
good radio errs; walls that delay some ranges, and a drive in circles, look a little like it."""
_LONGEST_S = 1.5
"""No driver or serial line is taken to be later [s]: over a longer time any drive looks like some other."""
_FEWEST = 60
"""So many averaged ranges tell a time [means]."""
_DIFFERENCE_S = 0.05
"""Over so long before and after a range its distance changes evenly [s]."""
_ROUNDS, _BIAS_M = 12, 0.3
"""Steps of Gauss-Newton at most [steps], and what a node's ranges may be biased by [m, one standard deviation]."""


class Latency(NamedTuple):
    """How long after an exchange its stamp was taken, and its standard deviation [s]."""

    late: float
    sigma: float

    @property
    def notable(self) -> bool:
        """Whether it is worth an action."""
        return max(_NOTABLE_S, _SURE * self.sigma) < abs(self.late) < _LONGEST_S


class _Way:
    """The antenna on the solved track by time [s since the first frame]."""

    def __init__(self, hindsight: Hindsight, stamps: np.ndarray, host: HostParams):
        known = np.isfinite(hindsight.track).all(axis=1)
        self.start = int(stamps[0])
        self._time = (stamps[known] - self.start) / 1e9
        self._track = hindsight.track[known].copy()
        self._track[:, 2] = np.unwrap(self._track[:, 2])
        self._antenna = host.antenna

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """(n, 2) [m] at times (n,)."""
        pose = np.column_stack([np.interp(time, self._time, column) for column in self._track.T])
        return transformed(pose, self._antenna)


def find_latency(hindsight: Hindsight, graph: Graph, stamps: np.ndarray, host: HostParams) -> Latency | None:
    """How late the ranges are, with the places and biases of the beacons open again; None where too few tell.

    Args:
      stamps: (T,) of the frames of the track [ns]. host: with biases and heights as configured.
    """
    means, solution = graph.ranges.means.values, hindsight.solution
    number = {node: b for b, node in enumerate(solution.nodes)}
    to = np.array([number.get(node, -1) for node in means[["slot", "place"]].tolist()], int)
    means, to = means[to >= 0], to[to >= 0]
    if len(means) < _FEWEST:
        return None
    way, time = _Way(hindsight, stamps, host), (means["stamp"] - float(stamps[0])) / 1e9
    slot, sigma = means["slot"], np.maximum(means["sigma"].astype(float), 1e-3)
    host = host.beyond(solution.off)
    distance = host.slant(means["distance"].astype(float), 0, slot)
    rise = np.asarray(host.rise(0, slot), float)
    count, row = len(solution.nodes), np.arange(len(means))
    # unknowns: how late, then place and bias of each beacon
    x = np.concatenate([[0.0], solution.beacons.ravel(), np.zeros(count)])
    prior = np.concatenate([np.zeros(1 + 2 * count), np.full(count, _BIAS_M**-2)])

    def predicted(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        off = way(at) - x[1 : 1 + 2 * count].reshape(-1, 2)[to]
        return off, np.sqrt(np.sum(off**2, axis=1) + rise**2 + 1e-6)

    spread = 1.0
    for _ in range(_ROUNDS):
        moment = time - x[0]
        off, far = predicted(moment)
        rate = (predicted(moment + _DIFFERENCE_S)[1] - predicted(moment - _DIFFERENCE_S)[1]) / (2 * _DIFFERENCE_S)
        residual = (distance - far - x[1 + 2 * count :][to]) / sigma
        J = np.zeros((len(row), len(x)))
        J[:, 0] = -rate
        J[row, 1 + 2 * to], J[row, 2 + 2 * to] = -off[:, 0] / far, -off[:, 1] / far
        J[row, 1 + 2 * count + to] = 1.0
        spread = max(1.0, 1.4826 * float(np.median(np.abs(residual))))
        J *= (1.0 / sigma / (1.0 + (residual / (3.0 * spread)) ** 2))[:, None]
        A = J.T @ J + np.diag(prior) + 1e-9 * np.eye(len(x))
        b = J.T @ (residual / (1.0 + (residual / (3.0 * spread)) ** 2)) - prior * x
        step = np.linalg.solve(A, b)
        x = x + step
        if abs(step[0]) < 1e-4:
            break
    return Latency(float(x[0]), spread * float(np.sqrt(np.linalg.inv(A)[0, 0])))


def retimed(graph: Graph, hindsight: Hindsight, stamps: np.ndarray, host: HostParams, late: float) -> Graph:
    """The same with each range between the keyframes that it was measured between, late [s] before its stamp."""
    graph = graph.copy()
    keys, broken, poses = graph.stamps(), graph.keyframes["broken"], hindsight.solution.poses
    means, start = graph.ranges.means.values, int(stamps[0])
    time = (means["stamp"] - float(start)) / 1e9 - late
    place, key_time = _Way(hindsight, stamps, host)(time), (keys - start) / 1e9
    at = np.clip(np.searchsorted(key_time, time, side="right") - 1, 0, len(keys) - 2)
    means["share"] = np.clip((time - key_time[at]) / np.maximum(key_time[at + 1] - key_time[at], 1e-6), 0.0, 1.0)
    means["at"] = at
    for name, k in (("before", at), ("after", at + 1)):
        means[name] = turned(-wrapped(poses[k, 2]), place - poses[k, :2])
    graph.ranges.means.keep(~broken[at + 1])
    return graph
