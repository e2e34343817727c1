"""The least-squares problem of `smoothing` with the LiDAR's mounting and the wheels' scales as further unknowns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uwbslam_jax.backend import Graph, Problem, Solution
from uwbslam_jax.numerics import Sink, between, compose, covariance, minimise, soften, transformed, turned, wrapped
from uwbslam_jax.settings import HostParams

_SCALE = 0.1
"""Spread of the wheels' scale errors, of way and turn."""
_HELD = 1e-4
"""Spread of the first pose, which holds the frame [m, m, rad]."""
FIXED = 1e-6
"""Spread of what is not asked for."""
_STAGES = ((1000.0, 4.0), (30.0, 2.0), (5.0, 1.0), (5.0, 1.0))
"""One solution after the other, as in `smoothing`: whitened length of an edge's residual from which on it counts less
(Geman-McClure), how many times as much a range may err. Each has the wheels' errors that the one before has found."""
_WHEELS = (0.02, 0.02)
"""What wheels err by at first, per root of way and of turn [m/m^0.5, rad/rad^0.5]."""
_WAY, _TURN = 0.01, 0.02
"""Way and turn that a step counts at least [m, rad]."""
_MOVES, _ENOUGH = 20, 0.02
"""Steps of a stage at most; one that gains less log-likelihood is the last."""
_H = 1e-6
"""Of central differences: with float64 they are good to 1e-10."""

Array = np.ndarray


@dataclass
class Mounting:
    """The problem of `smoothing` with the LiDAR's mounting and the wheels' scales as further unknowns.

    Unknowns of N keyframes, B resting beacons, S slots: poses (3 N), places (2 B), biases (S), the LiDAR's x, y, yaw
    beyond the configured, scales of way and of turn.
    """

    problem: Problem
    graph: Graph
    host: HostParams
    poses: Array
    start: Array
    wheels: tuple[float, float] = _WHEELS
    stage: tuple[float, float] = _STAGES[0]

    @staticmethod
    def build(graph: Graph, host: HostParams, solution: Solution) -> Mounting | None:
        """The problem of a run, None where there are too few ranges to beacons at rest."""
        places = dict(zip(solution.nodes, solution.beacons, strict=True))
        problem = Problem.build(graph, solution.poses, places, host)
        if problem is None:
            return None
        x = np.append(problem.start(solution.poses, places), np.zeros(5))
        return Mounting(problem, graph, host, solution.poses, x)

    @property
    def bias(self) -> int:
        """Column of the first bias."""
        return self.problem.first_bias

    @property
    def lidar(self) -> int:
        """Column of the LiDAR's x."""
        return self.problem.size

    def configured(self, at: Array) -> Array:
        """What the run was made with, of the columns asked for."""
        slots = np.array(self.problem.slots)
        every = np.zeros(self.problem.size + 5)
        every[self.bias : self.lidar] = self.host.bias[slots]
        every[self.lidar : self.lidar + 3] = self.host.lidar
        return every[at]

    def minimise(self, at: Array, prior: Array, offset: Array) -> tuple[Array, Array]:
        """Unknowns and their standard deviations (0 but for biases and mounting). at, prior, offset: columns that are
        asked for, their spreads, and what their priors are about."""
        spread = np.full(self.problem.size + 5, FIXED)
        mean = np.zeros(len(spread))
        spread[self.lidar + 3 :] = _SCALE
        # a bias that is not asked for is what the run took it for
        spread[at], mean[at] = prior, offset
        x = self.start.copy()
        fill = self._rows(spread, mean)
        rank = np.append(self.problem.rank, np.arange(self.problem.size, len(x)))
        for self.stage in _STAGES:
            x, _ = minimise(fill, x, rank, moves=_MOVES, enough=_ENOUGH)
            self.wheels = self._wheel_errors(x)
        columns = np.arange(self.bias, len(x))
        sigma = np.zeros(len(x))
        sigma[columns] = np.sqrt(np.maximum(np.diag(covariance(fill, x, rank, columns)), 0.0))
        return x, sigma

    def _rows(self, spread: Array, mean: Array) -> Callable[[Array, Sink], None]:
        """What puts all rows at some unknowns into a sink."""

        def fill(x: Array, rows: Sink) -> None:
            rows.add((x[:3] - self.start[:3]) / _HELD, [(np.arange(3), np.full(3, 1 / _HELD))])
            tail = np.arange(self.bias, len(x))
            rows.add((x[tail] - mean[tail]) / spread[tail], [(tail, 1 / spread[tail])])
            self._scans(rows, x)
            self._wheels(rows, x)
            self._ranges(rows, x)
            self.problem.add_pairs(rows, x, self.stage[1])

        return fill

    def _scans(self, rows: Sink, x: Array) -> None:
        """The LiDAR's own motions. Compared in its own frame, where they are the same whatever the mounting is: in the
        robot's a turn of the frame would turn the residuals, and pass for something that they tell."""
        p = self.problem.edges
        keep = p.soft | ~self._rolled()[p.new]
        old, new, measured, roots, soft, _ = (column[keep] for column in p)
        columns = [*_columns(3 * old, 3), *_columns(3 * new, 3), *_shared(self.lidar, 3, len(old))]
        own, back = self.host.lidar[None], between(self.host.lidar[None], np.zeros(3))
        motion = compose(compose(back, measured), own)

        def on_robot(m: Array) -> Array:
            return compose(compose(own, m), back)

        slopes = [(on_robot(motion + h) - on_robot(motion - h)) / (2 * _H) for h in _H * np.eye(3)]
        roots = roots @ np.stack(slopes, axis=-1)

        def residual(v: Array) -> Array:
            lidar = self.host.lidar + v[:, 6:]
            e = between(compose(v[:, :3], lidar), compose(v[:, 3:6], lidar)) - motion
            e[:, 2] = wrapped(e[:, 2])
            white = np.einsum("eij,ej->ei", roots, e)
            inside = np.where(soft, 1.0 + np.sum(white**2, axis=1) / self.stage[0] ** 2, 1.0)
            return white / np.sqrt(inside)[:, None]

        _add(rows, x, columns, residual)

    def _rolled(self) -> Array:
        """(N,) whether wheels measured the way from the keyframe before."""
        return self.graph.rolled() & ~self.graph.keyframes["broken"]

    def _steps(self) -> tuple[Array, Array]:
        new = np.flatnonzero(self._rolled())
        new = new[new > 0]
        return new, self.graph.keyframes["wheels"][new]

    def _wheels(self, rows: Sink, x: Array) -> None:
        new, wheels = self._steps()
        if not len(new):
            return
        sigma = self._wheel_sigma(wheels)
        columns = [*_columns(3 * (new - 1), 3), *_columns(3 * new, 3), *_shared(self.lidar + 3, 2, len(new))]

        def residual(v: Array) -> Array:
            white = _slip(v[:, :3], v[:, 3:6], v[:, 6:], wheels) / sigma
            return white / np.sqrt(1.0 + np.sum(white**2, axis=1, keepdims=True) / self.stage[0] ** 2)

        _add(rows, x, columns, residual)

    def _wheel_sigma(self, wheels: Array) -> Array:
        along = self.wheels[0] * np.sqrt(np.hypot(wheels[:, 0], wheels[:, 1]) + _WAY)
        return np.stack([along, along, self.wheels[1] * np.sqrt(np.abs(wheels[:, 2]) + _TURN)], -1)

    def _wheel_errors(self, x: Array) -> tuple[float, float]:
        """What wheels err by per root of way and of turn, by their residuals (a robust standard deviation)."""
        new, wheels = self._steps()
        if not len(new):
            return self.wheels
        poses = x[: 3 * self.problem.count].reshape(-1, 3)
        scales = np.broadcast_to(x[self.lidar + 3 :], (len(new), 2))
        off = np.abs(_slip(poses[new - 1], poses[new], scales, wheels)) / self._wheel_sigma(wheels)
        factors = np.median(off[:, :2]) / 0.674, np.median(off[:, 2]) / 0.674
        return self.wheels[0] * factors[0], self.wheels[1] * factors[1]

    def _ranges(self, rows: Sink, x: Array) -> None:
        p, n = self.problem.ranges, 3 * self.problem.count
        robot = np.full(len(p.at), self.bias)
        lidar = _shared(self.lidar, 3, len(p.at))
        columns = [*_columns(3 * p.at, 3), *_columns(3 * p.at + 3, 3), *_columns(n + 2 * p.to, 2), robot]
        columns += [self.problem.bias_column(p.to), *lidar]
        turn = wrapped(self.poses[p.at + 1, 2] - self.poses[p.at, 2])

        def residual(v: Array) -> Array:
            change = compose(self.host.lidar + v[:, 10:], between(self.host.lidar, np.zeros(3)))
            # robot frames of the run, as seen from those with this mounting
            back = between(change, np.zeros(3))
            shift = compose(back, np.append(self.host.antenna, 0.0))[:, :2] - self.host.antenna
            ends = []
            for pose, lever, angle in (
                (v[:, :3], p.lever_at, p.share * turn),
                (v[:, 3:6], p.lever_after, (p.share - 1) * turn),
            ):
                moved = lever + turned(angle, shift)
                ends.append(transformed(pose, transformed(change, moved)))
            antenna = (1 - p.share)[:, None] * ends[0] + p.share[:, None] * ends[1]
            distance = np.sqrt(np.sum((antenna - v[:, 6:8]) ** 2, axis=1) + p.rise**2)
            return soften((distance + v[:, 8] + v[:, 9] - p.distance) / (self.stage[1] * p.sigma))[0][:, None]

        _add(rows, x, columns, residual)


def _slip(old: Array, new: Array, scales: Array, wheels: Array) -> Array:
    """Motion by wheels of these scales less the motion measured, (n, 3)."""
    moved = between(old, new)
    moved[:, 2] = wrapped(moved[:, 2])
    e = moved * (1.0 + scales[:, [0, 0, 1]]) - wheels
    e[:, 2] = wrapped(e[:, 2])
    return e


def _columns(first: Array, count: int) -> list[Array]:
    return [first + k for k in range(count)]


def _shared(first: int, count: int, rows: int) -> list[Array]:
    return [np.full(rows, first + k) for k in range(count)]


def _add(rows: Sink, x: Array, columns: list[Array], residual: Callable[[Array], Array]) -> None:
    """Residuals (n, d) of a few unknowns each, with central differences as their derivatives."""
    v = np.stack([x[column] for column in columns], axis=1)
    r = residual(v)
    slopes = []
    for k in range(v.shape[1]):
        h = np.zeros(v.shape[1])
        h[k] = _H
        slopes.append((residual(v + h) - residual(v - h)) / (2 * _H))
    for d in range(r.shape[1]):
        rows.add(r[:, d], [(column, slope[:, d]) for column, slope in zip(columns, slopes, strict=True)])
