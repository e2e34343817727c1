"""The whole run solved at once: the poses, resting beacons and range biases that explain scans, steps and ranges.

Sparse Gauss-Newton in float64 over the `graph`. The filter decides with what it knew at the time; this takes back what
the rest of the run tells about it (in the words of the field: the back end; for a linear problem, the smoother).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.backend.range_means import Node
from uwbslam_jax.backend.relative_motions import even_drive, steps
from uwbslam_jax.numerics import (
    DECIDED,
    Sink,
    between,
    blocks,
    covariance,
    elimination,
    mean_sigma,
    minimise,
    soften,
    transformed,
    wrapped,
)
from uwbslam_jax.settings import HostParams

CALIBRATED_M = 1e-3
"""Standard deviation of a node's bias when ranges are taken to be calibrated [m]."""
BIASED_M = 0.3
"""The same once they are not [m]."""
_STAGES = ((1000.0, 4.0), (30.0, 2.0), (5.0, 1.0))
"""One solution after the other: whitened length of an edge's residual from which on it counts less (Geman-McClure), and
how many times as much a range may err. The filter's track may be far off for what two scans tell, and nothing must be
an outlier only because the start is wrong."""
_HELD = 1e-4
_FEWEST_MEANS = 6
_MOVES = 25
_ENOUGH = 0.05


class Solution(NamedTuple):
    """What the whole run tells.

    Attributes:
      poses: (N, 3) of the keyframes [m, m, rad].
      nodes: resting places of the beacons; beacons: (B, 2) where they are [m].
      bias, bias_sigma: node slot -> bias beyond the configured one [m], about 0 where ranges are calibrated.
      biased: whether it has biases: they explain the ranges far better than none.
      cost: negative log-likelihood.
      cov: (3 + 2 B, 3 + 2 B) of the last pose and the beacons while the first pose is held.
    """

    poses: np.ndarray
    nodes: list[Node]
    beacons: np.ndarray
    bias: dict[int, float]
    bias_sigma: dict[int, float]
    biased: bool
    cost: float
    cov: np.ndarray


def solve(
    graph: Graph,
    poses: np.ndarray,
    places: dict[Node, np.ndarray],
    host: HostParams,
    *,
    biased: bool = False,
) -> Solution | None:
    """The run solved; None where there is nothing to solve.

    Args:
      poses: (N, 3) of the keyframes to start from [m, m, rad].
      places: resting place -> (2,) to start from [m]; others are left out.
      host: with biases and heights as configured.
      biased: whether biases were found before.
    """
    problem = Problem.build(graph, poses, places, host)
    if problem is None:
        return None
    x = problem.start(poses, places)
    calibrated = problem.minimise(x, CALIBRATED_M)
    freed = problem.minimise(calibrated[0], BIASED_M)
    biased = biased or calibrated[1] - freed[1] > DECIDED + 3.0 * len(problem.slots)
    return problem.solution(*(freed if biased else calibrated), BIASED_M if biased else CALIBRATED_M, biased)


@dataclass(frozen=True)
class Problem:
    """The run in arrays. N keyframes, B resting places, S slots (the robot's first) with a bias each.

    edges: old, new (E,), between (E, 3), roots (E, 3, 3), soft (E,) whether it may be an outlier.
    steady: (T, 5) three keyframes over which the velocity changes little, see even_drive.
    means: at (R,), to (R,), share, before (R, 2), after (R, 2), distance, rise, sigma (R,), bias column (R,).
    pairs: (P, 2) resting places, distance, rise, sigma (P,).
    """

    count: int
    nodes: list[Node]
    slots: list[int]
    old: np.ndarray
    new: np.ndarray
    between: np.ndarray
    roots: np.ndarray
    soft: np.ndarray
    steady: np.ndarray
    at: np.ndarray
    to: np.ndarray
    share: np.ndarray
    before: np.ndarray
    after: np.ndarray
    distance: np.ndarray
    rise: np.ndarray
    sigma: np.ndarray
    pair: np.ndarray
    pair_numbers: np.ndarray

    @staticmethod
    def build(graph: Graph, poses: np.ndarray, places: dict[Node, np.ndarray], host: HostParams) -> Problem | None:
        means = graph.ranges.means.values
        found, which, heard = np.unique(means[["slot", "place"]], return_inverse=True, return_counts=True)
        number = np.full(len(found), -1)
        nodes: list[Node] = []
        for k, node in enumerate(found.tolist()):
            if heard[k] >= _FEWEST_MEANS and node in places:
                number[k] = len(nodes)
                nodes.append(node)
        if len(graph.keyframes) < 3 or not nodes:
            return None
        index = {node: b for b, node in enumerate(nodes)}
        slots = [0, *sorted({slot for slot, _ in nodes})]
        to = number[which]
        means, to = means[to >= 0], to[to >= 0]
        slot, loud = means["slot"], means["loud"]
        # a wall makes all of its ranges too long: many of them tell no more than one
        walled = np.bincount(to[loud], minlength=len(nodes))
        sigma = means["sigma"] * np.where(loud, np.sqrt(np.maximum(walled[to], 1)), 1.0)
        pairs = []
        for (a, b), kept in graph.ranges.pairs.items():
            if a in index and b in index and len(kept) >= 3:
                values = np.array(kept)
                middle = float(np.median(values))
                scatter = float(np.median(np.abs(values - middle))) / 0.674
                s = mean_sigma(0.64 * len(values), scatter, host.sigma_n)
                pairs.append((index[a], index[b], host.slant(middle, a[0], b[0]), host.rise(a[0], b[0]), s))
        return Problem(
            len(graph.keyframes),
            nodes,
            slots,
            *steps(graph, poses),
            even_drive(graph),
            means["at"],
            to,
            means["share"].astype(float),
            means["before"].astype(float),
            means["after"].astype(float),
            host.slant(means["distance"].astype(float), 0, slot),
            host.rise(0, slot),
            sigma,
            np.array([p[:2] for p in pairs], int).reshape(-1, 2),
            np.array([p[2:] for p in pairs]).reshape(-1, 3),
        )

    @property
    def size(self) -> int:
        """Unknowns: poses, places, a bias of each slot."""
        return self._first_bias + len(self.slots)

    @cached_property
    def rank(self) -> np.ndarray:
        """(size,) in which order the unknowns are eliminated: poses by what ties them to each other, then places and
        biases, on which every pose hangs."""
        middle = self.steady[:, 0].astype(int)
        i = np.concatenate([self.old, self.at, middle - 1, middle - 1, middle])
        j = np.concatenate([self.new, self.at + 1, middle, middle + 1, middle + 1])
        poses = 3 * elimination(i, j, self.count)[:, None] + np.arange(3)
        return np.append(poses.ravel(), np.arange(3 * self.count, self.size))

    @property
    def _first_bias(self) -> int:
        return 3 * self.count + 2 * len(self.nodes)

    def start(self, poses, places) -> np.ndarray:
        beacons = np.array([places[node] for node in self.nodes])
        return np.concatenate([poses.ravel(), beacons.ravel(), np.zeros(len(self.slots))])

    def bias_column(self, nodes: np.ndarray) -> np.ndarray:
        """Columns of the biases of resting places (n,)."""
        slots = np.array([self.slots.index(slot) for slot, _ in self.nodes])
        return self._first_bias + slots[nodes]

    def minimise(self, x: np.ndarray, bias_sigma: float) -> tuple[np.ndarray, float]:
        """Levenberg-Marquardt from x: unknowns and cost."""
        held, cost = x[:3].copy(), np.inf
        for stage in _STAGES:
            x, cost = minimise(self._rows(held, bias_sigma, stage), x, self.rank, moves=_MOVES, enough=_ENOUGH)
        return x, cost

    def solution(self, x: np.ndarray, cost: float, bias_sigma: float, biased: bool) -> Solution:
        n, m = 3 * self.count, self._first_bias
        cov = covariance(self._rows(x[:3], bias_sigma, _STAGES[-1]), x, self.rank, np.arange(n - 3, self.size))
        spread = np.sqrt(np.maximum(np.diag(cov)[m - n + 3 :], 0.0))
        return Solution(
            x[:n].reshape(-1, 3),
            self.nodes,
            x[n:m].reshape(-1, 2),
            dict(zip(self.slots, map(float, x[m:]), strict=True)),
            dict(zip(self.slots, map(float, spread), strict=True)),
            biased,
            cost,
            cov[: m - n + 3, : m - n + 3],
        )

    def _rows(self, held: np.ndarray, bias_sigma: float, stage: tuple[float, float]) -> Callable:
        """What puts whitened rows of held start, edges, steady velocity, ranges, pairs and biases into a sink."""

        def fill(x: np.ndarray, rows: Sink) -> None:
            poses = x[: 3 * self.count].reshape(-1, 3)
            rows.add((x[:3] - held) / _HELD, [(np.arange(3), np.full(3, 1 / _HELD))])
            for part in blocks(len(self.old)):
                self._edge_rows(rows, poses, stage[0], part)
            self._steady_rows(rows, poses)
            for part in blocks(len(self.at)):
                self._range_rows(rows, x, poses, stage[1], part)
            self.add_pairs(rows, x, stage[1])
            m = self._first_bias
            rows.add(x[m:] / bias_sigma, [(np.arange(m, self.size), np.full(len(self.slots), 1 / bias_sigma))])

        return fill

    def _edge_rows(self, rows: Sink, poses, soft: float, part: slice) -> None:
        old, new, roots = self.old[part], self.new[part], self.roots[part]
        a, b = poses[old], poses[new]
        e = between(a, b) - self.between[part]
        e[:, 2] = wrapped(e[:, 2])
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        zero, one = np.zeros_like(c), np.ones_like(c)
        moved = between(a, b)
        # derivatives of the relative pose by x, y, heading of the old and of the new keyframe
        by = [
            np.stack([-c, s, zero], -1),
            np.stack([-s, -c, zero], -1),
            np.stack([moved[:, 1], -moved[:, 0], -one], -1),
            np.stack([c, -s, zero], -1),
            np.stack([s, c, zero], -1),
            np.stack([zero, zero, one], -1),
        ]
        white = np.einsum("eij,ej->ei", roots, e)
        # Geman-McClure of the whole edge, as `soften` for a range
        inside = np.where(self.soft[part], 1.0 + np.sum(white**2, axis=1) / soft**2, 1.0)
        scaled = roots * inside[:, None, None] ** -1.5
        columns = [3 * old, 3 * old + 1, 3 * old + 2, 3 * new, 3 * new + 1, 3 * new + 2]
        parts = [(column, np.einsum("eij,ej->ei", scaled, d)) for column, d in zip(columns, by, strict=True)]
        for k in range(3):
            rows.add(white[:, k] / np.sqrt(inside), [(column, d[:, k]) for column, d in parts])

    def _steady_rows(self, rows: Sink, poses) -> None:
        if not len(self.steady):
            return
        k, before, after, turn, sigma = self.steady.T
        k = k.astype(int)
        c, s = np.cos(turn), np.sin(turn)
        first = (poses[k, :2] - poses[k - 1, :2]) / before[:, None]
        second = (poses[k + 1, :2] - poses[k, :2]) / after[:, None]
        # each row: what turns the earlier velocity into this component of the later one
        for axis, by in enumerate((np.stack([c, -s], -1), np.stack([s, c], -1))):
            r, scale = soften((second[:, axis] - np.sum(by * first, axis=1)) / sigma)
            scale = scale / sigma
            parts = [(3 * (k + 1) + axis, scale / after), (3 * k + axis, -scale / after)]
            for other in range(2):
                pull = scale * by[:, other] / before
                parts += [(3 * k + other, -pull), (3 * (k - 1) + other, pull)]
            rows.add(r, parts)

    def _range_rows(self, rows: Sink, x, poses, coarse: float, part: slice) -> None:
        n = 3 * self.count
        beacons = x[n : n + 2 * len(self.nodes)].reshape(-1, 2)
        at, to, share = self.at[part], self.to[part], self.share[part]
        levers = ((at, self.before[part]), (at + 1, self.after[part]))
        ends = [transformed(poses[k], lever) for k, lever in levers]
        antenna = (1 - share)[:, None] * ends[0] + share[:, None] * ends[1]
        u = antenna - beacons[to]
        d = np.maximum(np.sqrt((u**2).sum(1) + self.rise[part] ** 2), 1e-6)
        column = self.bias_column(to)
        robot = self._first_bias
        sigma = coarse * self.sigma[part]
        r, scale = soften((d + x[robot] + x[column] - self.distance[part]) / sigma)
        weight = scale / sigma
        unit = u / d[:, None]
        parts = []
        for key, end, near in ((at, ends[0], 1 - share), (at + 1, ends[1], share)):
            lever = end - poses[key, :2]
            parts += [(3 * key + axis, near * weight * unit[:, axis]) for axis in range(2)]
            parts.append((3 * key + 2, near * weight * (unit[:, 1] * lever[:, 0] - unit[:, 0] * lever[:, 1])))
        parts += [(n + 2 * to + axis, -weight * unit[:, axis]) for axis in range(2)]
        parts += [(np.full(len(d), robot), weight), (column, weight)]
        rows.add(r, parts)

    def add_pairs(self, rows: Sink, x: np.ndarray, coarse: float = 1.0) -> None:
        """Rows of the ranges between beacons; coarse: how many times as much they may err."""
        if not len(self.pair):
            return
        n = 3 * self.count
        beacons = x[n : n + 2 * len(self.nodes)].reshape(-1, 2)
        i, j = self.pair.T
        distance, rise, sigma = self.pair_numbers.T
        sigma = coarse * sigma
        u = beacons[i] - beacons[j]
        d = np.maximum(np.sqrt((u**2).sum(1) + rise**2), 1e-6)
        first, second = self.bias_column(i), self.bias_column(j)
        r, scale = soften((d + x[first] + x[second] - distance) / sigma)
        weight = scale / sigma
        parts = []
        for axis in range(2):
            pull = weight * u[:, axis] / d
            parts += [(n + 2 * i + axis, pull), (n + 2 * j + axis, -pull)]
        rows.add(r, [*parts, (first, weight), (second, weight)])
