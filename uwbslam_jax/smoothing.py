"""The whole run solved at once: keyframe poses, resting beacons and range biases that explain steps, matches and ranges.

Sparse Gauss-Newton in float64 over the `graph`. The filter decides with what it knew at the time; this takes back what
the rest of the run tells about it (in the words of the field: the back end; for a linear problem, the smoother).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from uwbslam_jax.graph import Graph, relative, wrapped
from uwbslam_jax.keyframes import mean_sigma, turned
from uwbslam_jax.multilateration import DECIDED, soften

CALIBRATED_M = 1e-3
"""Standard deviation of a node's bias when ranges are taken to be calibrated [m]."""
BIAS_M = 0.3
"""Prior spread of a node's bias once they are not [m]."""
_STAGES = ((1000.0, 4.0), (30.0, 2.0), (5.0, 1.0))
"""One solution after the other: whitened length of an edge's residual from which on it counts less (Geman-McClure), and
how many times as much a range may err. The filter's track may be far off for what two scans tell, and nothing must be an
outlier only because the start is wrong."""
_LOOSE_WHEELS = (0.03, 0.06, 0.02, 0.06)
"""Standard deviation of a step by wheels: floor and share of the way [m], floor and share of the turn [rad]."""
_LOOSE = (0.1, 0.2, 0.05, 0.1)
"""The same of a step that nothing measured."""
_LONGEST_S = 3.0
_UNSTEADY = (0.1, 1.0)
"""Acceleration noise that is learnt at least and at most [m/s^1.5]."""
_FEWEST_STEPS = 20
_HELD = 1e-4
_FEWEST_MEANS = 6
_MOVES = 25
_ENOUGH = 0.05

Node = tuple[int, int]


class Solution(NamedTuple):
    """What the whole run tells.

    Attributes:
      poses: (N, 3) of the keyframes [m, m, rad].
      nodes: resting places of the beacons; beacons: (B, 2) where they are [m].
      bias: node slot -> bias beyond the configured one [m]; zeros where ranges are calibrated.
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
    height: np.ndarray,
    bias: np.ndarray,
    bias_scale: float,
    *,
    biased: bool = False,
) -> Solution | None:
    """The run solved; None where there is nothing to solve.

    Args:
      poses: (N, 3) of the keyframes to start from [m, m, rad].
      places: resting place -> (2,) to start from [m]; others are left out.
      height, bias: (K,) of the slots, as configured [m]. bias_scale: share of a range that is bias [m/m].
      biased: whether biases were found before.
    """
    problem = _Problem.build(graph, places, height, bias, bias_scale)
    if problem is None:
        return None
    x = problem.start(poses, places)
    calibrated = problem.minimise(x, CALIBRATED_M)
    freed = problem.minimise(calibrated[0], BIAS_M)
    biased = biased or calibrated[1] - freed[1] > DECIDED + 3.0 * len(problem.slots)
    return problem.solution(*(freed if biased else calibrated), BIAS_M if biased else CALIBRATED_M, biased)


@dataclass(frozen=True)
class _Problem:
    """The run in arrays. N keyframes, B resting places, S slots (the robot's first) with a bias each.

    edges: old, new (E,), between (E, 3), roots (E, 3, 3), soft (E,) whether it may be an outlier.
    steady: (T, 5) three keyframes over which the velocity changes little, see `_steady`.
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
    def build(graph: Graph, places, height, bias, bias_scale) -> _Problem | None:
        heard: dict[Node, int] = {}
        for mean in graph.means:
            heard[mean.node] = heard.get(mean.node, 0) + 1
        nodes = sorted(node for node, n in heard.items() if n >= _FEWEST_MEANS and node in places)
        if len(graph.keyframes) < 3 or not nodes:
            return None
        index = {node: b for b, node in enumerate(nodes)}
        slots = [0, *sorted({slot for slot, _ in nodes})]
        means = [mean for mean in graph.means if mean.node in index]
        slot = np.array([mean.node[0] for mean in means])
        sigma = np.array([mean.sigma for mean in means])
        loud = np.array([mean.loud for mean in means])
        to = np.array([index[mean.node] for mean in means])
        # a wall makes all of its ranges too long: many of them tell no more than one
        walled = np.bincount(to[loud], minlength=len(nodes))
        sigma = np.where(loud, sigma * np.sqrt(np.maximum(walled[to], 1)), sigma)
        pairs = []
        for (a, b), kept in graph.pairs.items():
            if a in index and b in index and len(kept) >= 3:
                values = np.array(kept)
                middle = float(np.median(values))
                scatter = float(np.median(np.abs(values - middle))) / 0.674
                d = (middle - bias[a[0]] - bias[b[0]]) / (1 + bias_scale)
                s = mean_sigma(0.64 * len(values), scatter, graph.sigma_n)
                pairs.append((index[a], index[b], d, height[a[0]] - height[b[0]], s))
        old, new, between, roots, soft = _edges(graph)
        return _Problem(
            len(graph.keyframes),
            nodes,
            slots,
            old,
            new,
            between,
            roots,
            soft,
            _steady(graph),
            np.array([mean.at for mean in means]),
            to,
            np.array([mean.share for mean in means]),
            np.array([mean.before for mean in means]),
            np.array([mean.after for mean in means]),
            (np.array([mean.distance for mean in means]) - bias[0] - bias[slot]) / (1 + bias_scale),
            height[0] - height[slot],
            sigma,
            np.array([p[:2] for p in pairs], int).reshape(-1, 2),
            np.array([p[2:] for p in pairs]).reshape(-1, 3),
        )

    @property
    def size(self) -> int:
        return 3 * self.count + 2 * len(self.nodes) + len(self.slots)

    def start(self, poses, places) -> np.ndarray:
        beacons = np.array([places[node] for node in self.nodes])
        return np.concatenate([poses.ravel(), beacons.ravel(), np.zeros(len(self.slots))])

    def _bias_column(self, nodes: np.ndarray) -> np.ndarray:
        slots = np.array([self.slots.index(slot) for slot, _ in self.nodes])
        return 3 * self.count + 2 * len(self.nodes) + slots[nodes]

    def minimise(self, x: np.ndarray, bias_sigma: float) -> tuple[np.ndarray, float]:
        """Levenberg-Marquardt from x: unknowns and cost."""
        for stage in _STAGES:
            x, cost = self._descend(x, bias_sigma, stage)
        return x, cost

    def _descend(self, x: np.ndarray, bias_sigma: float, stage: tuple[float, float]) -> tuple[np.ndarray, float]:
        held = x[:3].copy()
        J, r = self._linearise(x, held, bias_sigma, stage)
        cost, damping = 0.5 * r @ r, 1e-6
        for _ in range(_MOVES):
            A = (J.T @ J).tocsc()
            step = _factor(A + damping * sparse.diags(A.diagonal() + 1e-9, format="csc")).solve(J.T @ r)
            moved = x - step
            new_J, new_r = self._linearise(moved, held, bias_sigma, stage)
            new_cost = 0.5 * new_r @ new_r
            if new_cost < cost:
                gain, x, J, r, cost = cost - new_cost, moved, new_J, new_r, new_cost
                damping = max(damping / 10, 1e-12)
                if gain < _ENOUGH:
                    break
            else:
                damping *= 10
                if damping > 1e8:
                    break
        return x, float(cost)

    def solution(self, x: np.ndarray, cost: float, bias_sigma: float, biased: bool) -> Solution:
        n, m = 3 * self.count, 3 * self.count + 2 * len(self.nodes)
        J, _ = self._linearise(x, x[:3], bias_sigma, _STAGES[-1])
        columns = np.arange(n - 3, self.size)
        unit = np.zeros((self.size, len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        A = (J.T @ J).tocsc()
        cov = _factor(A + 1e-9 * sparse.eye(self.size, format="csc")).solve(unit)[columns]
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

    def _linearise(self, x, held, bias_sigma, stage) -> tuple[sparse.csr_matrix, np.ndarray]:
        """Whitened Jacobian and residuals of held start, edges, steady velocity, ranges, pairs and biases."""
        rows = _Rows(self.size)
        poses = x[: 3 * self.count].reshape(-1, 3)
        rows.add((x[:3] - held)[:, None] / _HELD, [(np.arange(3), np.full(3, 1 / _HELD))])
        self._edge_rows(rows, poses, stage[0])
        self._steady_rows(rows, poses)
        self._range_rows(rows, x, poses, stage[1])
        self._pair_rows(rows, x, stage[1])
        m = self.size - len(self.slots)
        rows.add(x[m:] / bias_sigma, [(np.arange(m, self.size), np.full(len(self.slots), 1 / bias_sigma))])
        return rows.matrix(), rows.residuals()

    def _edge_rows(self, rows: _Rows, poses, soft: float) -> None:
        a, b = poses[self.old], poses[self.new]
        e = relative(a, b) - self.between
        e[:, 2] = wrapped(e[:, 2])
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        zero, one = np.zeros_like(c), np.ones_like(c)
        moved = relative(a, b)
        # derivatives of the relative pose by x, y, heading of the old and of the new keyframe
        by = [
            np.stack([-c, s, zero], -1),
            np.stack([-s, -c, zero], -1),
            np.stack([moved[:, 1], -moved[:, 0], -one], -1),
            np.stack([c, -s, zero], -1),
            np.stack([s, c, zero], -1),
            np.stack([zero, zero, one], -1),
        ]
        white = np.einsum("eij,ej->ei", self.roots, e)
        # Geman-McClure of the whole edge, as `soften` for a range
        inside = np.where(self.soft, 1.0 + np.sum(white**2, axis=1) / soft**2, 1.0)
        scaled = self.roots * inside[:, None, None] ** -1.5
        columns = [3 * self.old, 3 * self.old + 1, 3 * self.old + 2, 3 * self.new, 3 * self.new + 1, 3 * self.new + 2]
        parts = [(column, np.einsum("eij,ej->ei", scaled, d)) for column, d in zip(columns, by, strict=True)]
        for k in range(3):
            rows.add(white[:, k] / np.sqrt(inside), [(column, d[:, k]) for column, d in parts])

    def _steady_rows(self, rows: _Rows, poses) -> None:
        if not len(self.steady):
            return
        k, before, after, turn, sigma = self.steady.T
        k = k.astype(int)
        c, s = np.cos(turn), np.sin(turn)
        first, second = (poses[k, :2] - poses[k - 1, :2]) / before[:, None], (poses[k + 1, :2] - poses[k, :2]) / after[:, None]
        # each row: what turns the earlier velocity into this component of the later one
        for axis, by in enumerate((np.stack([c, -s], -1), np.stack([s, c], -1))):
            r, scale = soften((second[:, axis] - np.sum(by * first, axis=1)) / sigma)
            scale = scale / sigma
            parts = [(3 * (k + 1) + axis, scale / after), (3 * k + axis, -scale / after)]
            for other in range(2):
                pull = scale * by[:, other] / before
                parts += [(3 * k + other, -pull), (3 * (k - 1) + other, pull)]
            rows.add(r, parts)

    def _range_rows(self, rows: _Rows, x, poses, coarse: float) -> None:
        n = 3 * self.count
        beacons = x[n : n + 2 * len(self.nodes)].reshape(-1, 2)
        ends = [poses[k, :2] + turned(poses[k, 2], lever) for k, lever in ((self.at, self.before), (self.at + 1, self.after))]
        antenna = (1 - self.share)[:, None] * ends[0] + self.share[:, None] * ends[1]
        u = antenna - beacons[self.to]
        d = np.maximum(np.sqrt((u**2).sum(1) + self.rise**2), 1e-6)
        column = self._bias_column(self.to)
        robot = self.size - len(self.slots)
        sigma = coarse * self.sigma
        r, scale = soften((d + x[robot] + x[column] - self.distance) / sigma)
        weight = scale / sigma
        unit = u / d[:, None]
        parts = []
        for key, end, part in ((self.at, ends[0], 1 - self.share), (self.at + 1, ends[1], self.share)):
            lever = end - poses[key, :2]
            parts += [(3 * key + axis, part * weight * unit[:, axis]) for axis in range(2)]
            parts.append((3 * key + 2, part * weight * (unit[:, 1] * lever[:, 0] - unit[:, 0] * lever[:, 1])))
        parts += [(n + 2 * self.to + axis, -weight * unit[:, axis]) for axis in range(2)]
        parts += [(np.full(len(d), robot), weight), (column, weight)]
        rows.add(r, parts)

    def _pair_rows(self, rows: _Rows, x, coarse: float) -> None:
        if not len(self.pair):
            return
        n = 3 * self.count
        beacons = x[n : n + 2 * len(self.nodes)].reshape(-1, 2)
        i, j = self.pair.T
        distance, rise, sigma = self.pair_numbers.T
        sigma = coarse * sigma
        u = beacons[i] - beacons[j]
        d = np.maximum(np.sqrt((u**2).sum(1) + rise**2), 1e-6)
        first, second = self._bias_column(i), self._bias_column(j)
        r, scale = soften((d + x[first] + x[second] - distance) / sigma)
        weight = scale / sigma
        parts = []
        for axis in range(2):
            pull = weight * u[:, axis] / d
            parts += [(n + 2 * i + axis, pull), (n + 2 * j + axis, -pull)]
        rows.add(r, [*parts, (first, weight), (second, weight)])


def _factor(A: sparse.csc_matrix):
    # symmetric: the order that keeps poses a band, and beacons, which every pose hangs on, last
    return splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


class _Rows:
    """A sparse Jacobian put together row block by row block."""

    def __init__(self, columns: int):
        self._columns, self._count = columns, 0
        self._row: list[np.ndarray] = []
        self._column: list[np.ndarray] = []
        self._value: list[np.ndarray] = []
        self._residual: list[np.ndarray] = []

    def add(self, residual: np.ndarray, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        """Residuals (R,) and, for each unknown that they depend on, its column (R,) and derivative (R,)."""
        residual = np.ravel(residual)
        row = self._count + np.arange(len(residual))
        for column, value in parts:
            self._row.append(row)
            self._column.append(column)
            self._value.append(value)
        self._residual.append(residual)
        self._count += len(residual)

    def matrix(self) -> sparse.csr_matrix:
        at = np.concatenate(self._row), np.concatenate(self._column)
        return sparse.csr_matrix((np.concatenate(self._value), at), shape=(self._count, self._columns))

    def residuals(self) -> np.ndarray:
        return np.concatenate(self._residual)


def _edges(graph: Graph):
    """Steps between consecutive keyframes, which bound what nothing measured, then the matches with older ground."""
    keys = graph.keyframes
    old, new, between, roots, soft = [], [], [], [], []
    for k in range(1, len(keys)):
        if keys[k].broken:
            continue
        wheels = keys[k].wheels
        z = relative(keys[k - 1].pose, keys[k].pose) if wheels is None else wheels
        floor, share, floor_yaw, share_yaw = _LOOSE if wheels is None else _LOOSE_WHEELS
        elapsed = min((keys[k].stamp - keys[k - 1].stamp) / 1e9, _LONGEST_S) if wheels is None else 0.0
        length, angle = np.hypot(*z[:2]), abs(wrapped(z[2]))
        sigma = np.array([floor + share * length + elapsed] * 2 + [floor_yaw + share_yaw * angle])
        old.append(k - 1)
        new.append(k)
        between.append(z)
        roots.append(np.diag(1 / sigma))
        soft.append(False)
    for edge in graph.edges:
        values, vectors = np.linalg.eigh(edge.information)
        old.append(edge.old)
        new.append(edge.new)
        between.append(edge.between)
        roots.append(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
        soft.append(True)
    return np.array(old), np.array(new), np.array(between), np.array(roots), np.array(soft)


def _steady(graph: Graph) -> np.ndarray:
    """(T, 5) middle keyframe, time before and after it [s], turn on the way [rad] and how much the velocity in the
    robot's own frame may change [m/s], where a scan is blind and no wheels measure.

    How much it does change is learnt where scans tell: some robots drive evenly, some do not.
    """
    keys = graph.keyframes
    if len(keys) < 3:
        return np.zeros((0, 5))
    stamp = np.array([key.stamp for key in keys]) / 1e9
    pose = np.array([key.pose for key in keys])
    open_way = np.array([key.broken or key.wheels is not None for key in keys])
    blind = np.array([key.blind for key in keys])
    dt = np.maximum(np.diff(stamp), 1e-3)
    step = np.diff(pose, axis=0)
    turn = 0.5 * (wrapped(step[:-1, 2]) + wrapped(step[1:, 2]))
    change = step[1:, :2] / dt[1:, None] - turned(turn, step[:-1, :2] / dt[:-1, None])
    mean = 0.5 * (dt[:-1] + dt[1:])
    ok = ~open_way[1:-1] & ~open_way[2:]
    unsure = blind[:-2] | blind[1:-1] | blind[2:]
    learnt = np.abs(change[ok & ~unsure]) / np.sqrt(mean[ok & ~unsure, None])
    sigma_w = np.clip(np.sqrt(np.mean(learnt**2)), *_UNSTEADY) if len(learnt) >= _FEWEST_STEPS else _UNSTEADY[1]
    k = np.flatnonzero(ok & unsure)
    return np.column_stack([k + 1, dt[k], dt[k + 1], turn[k], sigma_w * np.sqrt(mean[k])])
