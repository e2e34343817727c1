"""A track of poses, places at rest and biases of ranges as one least-squares problem: its rows and its minimum.

Start-up solves it for what it remembers, the back end for the whole run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from uwbslam_jax.numerics.robust import soften
from uwbslam_jax.numerics.se2_host import between, transformed, wrapped
from uwbslam_jax.numerics.sparse_least_squares import Sink, blocks, elimination, minimise

_HELD = 1e-4
"""Standard deviation of the first pose, which is held [m, m, rad]."""


class Edges(NamedTuple):
    """Poses relative to older ones, E of them.

    Attributes:
      old, new: (E,) numbers of the poses. between: (E, 3) pose of the new one in the frame of the old one.
      roots: (E, 3, 3) of their information, of which each is root.T @ root. soft: (E,) whether one may be an outlier.
    """

    old: np.ndarray
    new: np.ndarray
    between: np.ndarray
    roots: np.ndarray
    soft: np.ndarray


class TrackRanges(NamedTuple):
    """Ranges between the track and places, R of them.

    Attributes:
      at, after: (R,) pose before and after. to: (R,) place. share: (R,) of the way from the one pose to the other.
      lever_at, lever_after: (R, 2) the antenna in the frames of both poses [m].
      distance, rise, sigma: (R,) range, difference of the heights, standard deviation [m].
    """

    at: np.ndarray
    after: np.ndarray
    to: np.ndarray
    share: np.ndarray
    lever_at: np.ndarray
    lever_after: np.ndarray
    distance: np.ndarray
    rise: np.ndarray
    sigma: np.ndarray

    def ends(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(R, 2) twice: where the antenna was as either pose alone has it [m]."""
        return transformed(poses[self.at], self.lever_at), transformed(poses[self.after], self.lever_after)

    def antenna(self, poses: np.ndarray) -> np.ndarray:
        """(R, 2) where the antenna was when each range was taken, between its two poses [m]."""
        ends = self.ends(poses)
        return (1 - self.share)[:, None] * ends[0] + self.share[:, None] * ends[1]

    def some(self, which: np.ndarray | slice) -> TrackRanges:
        """Those that are asked for."""
        return TrackRanges(*(column[which] for column in self))


class Pairs(NamedTuple):
    """Ranges between places, P of them.

    Attributes:
      ends: (P, 2) places. distance, rise, sigma: (P,) range, difference of the heights, standard deviation [m].
    """

    ends: np.ndarray
    distance: np.ndarray
    rise: np.ndarray
    sigma: np.ndarray

    @staticmethod
    def of(rows: list[tuple[int, int, float, float, float]]) -> Pairs:
        """Rows of two places, range, difference of the heights and standard deviation."""
        numbers = np.array([row[2:] for row in rows]).reshape(-1, 3)
        return Pairs(np.array([row[:2] for row in rows], int).reshape(-1, 2), *numbers.T)


class Stage(NamedTuple):
    """How outliers are met.

    Attributes:
      soft: whitened length of an edge's residual from which on it counts less (Geman-McClure).
      coarse: how many times as much a range may err.
    """

    soft: float
    coarse: float


@dataclass(frozen=True)
class PoseGraph:
    """The problem in arrays. Unknowns: count poses, a place for each of slots, a bias of the robot and of each node.

    Attributes:
      count: of the poses. bias_of: (B,) number of each place's bias; 0 is the robot's.
      steady: (T, 5) middle one of three poses between which the velocity changes little, time before and after it [s],
        turn on the way [rad], standard deviation of that change [m/s].
    """

    count: int
    bias_of: np.ndarray
    edges: Edges
    ranges: TrackRanges
    pairs: Pairs
    steady: np.ndarray = field(kw_only=True, default_factory=lambda: np.zeros((0, 5)))

    @property
    def first_bias(self) -> int:
        """Column of the robot's bias."""
        return 3 * self.count + 2 * len(self.bias_of)

    @cached_property
    def size(self) -> int:
        """Unknowns."""
        return self.first_bias + 1 + int(self.bias_of.max())

    @cached_property
    def rank(self) -> np.ndarray:
        """(size,) in which order the unknowns are eliminated: poses by what ties them to each other, then places and
        biases, on which every pose hangs."""
        middle = self.steady[:, 0].astype(int)
        i = np.concatenate([self.edges.old, self.ranges.at, middle - 1, middle - 1, middle])
        j = np.concatenate([self.edges.new, self.ranges.after, middle, middle + 1, middle + 1])
        poses = 3 * elimination(i, j, self.count)[:, None] + np.arange(3)
        return np.append(poses.ravel(), np.arange(3 * self.count, self.size))

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses (count, 3), places (B, 2) and biases of unknowns."""
        n, m = 3 * self.count, self.first_bias
        return x[:n].reshape(-1, 3), x[n:m].reshape(-1, 2), x[m:]

    def joined(self, poses: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Unknowns of poses and places, without biases."""
        return np.concatenate([poses.ravel(), places.ravel(), np.zeros(self.size - self.first_bias)])

    def bias_column(self, places: np.ndarray) -> np.ndarray:
        """Columns of the biases of places (n,)."""
        return self.first_bias + self.bias_of[places]

    def descend(
        self, x: np.ndarray, bias_sigma: float, stages: tuple[Stage, ...], **effort: Any
    ) -> tuple[np.ndarray, float]:
        """Unknowns and cost after one stage after the other, from x whose first pose is held.

        Args:
          bias_sigma: prior spread of each bias [m]. effort: moves, enough, damping, see `minimise`.
        """
        held, cost = x[:3].copy(), np.inf
        for stage in stages:
            x, cost = minimise(self.rows(held, bias_sigma, stage), x, self.rank, **effort)
        return x, cost

    def rows(self, held: np.ndarray, bias_sigma: float, stage: Stage) -> Callable[[np.ndarray, Sink], None]:
        """What puts whitened rows of held start, edges, steady velocity, ranges, pairs and biases into a sink."""

        def fill(x: np.ndarray, rows: Sink) -> None:
            poses, _, bias = self.split(x)
            rows.add((x[:3] - held) / _HELD, [(np.arange(3), np.full(3, 1 / _HELD))])
            for part in blocks(len(self.edges.old)):
                self._add_edges(rows, poses, stage.soft, part)
            self._add_steady(rows, poses)
            for part in blocks(len(self.ranges.at)):
                self._add_ranges(rows, x, stage.coarse, part)
            self.add_pairs(rows, x, stage.coarse)
            rows.add(bias / bias_sigma, [(np.arange(self.first_bias, len(x)), np.full(len(bias), 1 / bias_sigma))])

        return fill

    def _add_edges(self, rows: Sink, poses: np.ndarray, soft: float, part: slice) -> None:
        old, new, measured, roots, may_err = (column[part] for column in self.edges)
        a, b = poses[old], poses[new]
        moved = between(a, b)
        e = moved - measured
        e[:, 2] = wrapped(e[:, 2])
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        zero, one = np.zeros_like(c), np.ones_like(c)
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
        inside = np.where(may_err, 1.0 + np.sum(white**2, axis=1) / soft**2, 1.0)
        scaled = roots * inside[:, None, None] ** -1.5
        columns = [3 * old, 3 * old + 1, 3 * old + 2, 3 * new, 3 * new + 1, 3 * new + 2]
        parts = [(column, np.einsum("eij,ej->ei", scaled, d)) for column, d in zip(columns, by, strict=True)]
        for k in range(3):
            rows.add(white[:, k] / np.sqrt(inside), [(column, d[:, k]) for column, d in parts])

    def _add_steady(self, rows: Sink, poses: np.ndarray) -> None:
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

    def _add_ranges(self, rows: Sink, x: np.ndarray, coarse: float, part: slice) -> None:
        poses, places, bias = self.split(x)
        some, n = self.ranges.some(part), 3 * self.count
        ends = some.ends(poses)
        u = (1 - some.share)[:, None] * ends[0] + some.share[:, None] * ends[1] - places[some.to]
        d = np.maximum(np.sqrt((u**2).sum(1) + some.rise**2), 1e-6)
        column, sigma = self.bias_column(some.to), coarse * some.sigma
        r, scale = soften((d + bias[0] + x[column] - some.distance) / sigma)
        weight = scale / sigma
        unit = u / d[:, None]
        parts = []
        for key, end, near in ((some.at, ends[0], 1 - some.share), (some.after, ends[1], some.share)):
            lever = end - poses[key, :2]
            parts += [(3 * key + axis, near * weight * unit[:, axis]) for axis in range(2)]
            parts.append((3 * key + 2, near * weight * (unit[:, 1] * lever[:, 0] - unit[:, 0] * lever[:, 1])))
        parts += [(n + 2 * some.to + axis, -weight * unit[:, axis]) for axis in range(2)]
        parts += [(np.full(len(d), self.first_bias), weight), (column, weight)]
        rows.add(r, parts)

    def add_pairs(self, rows: Sink, x: np.ndarray, coarse: float = 1.0) -> None:
        """Rows of the ranges between places; coarse: how many times as much they may err."""
        if not len(self.pairs.ends):
            return
        (i, j), (_, places, _), n = self.pairs.ends.T, self.split(x[: self.size]), 3 * self.count
        sigma = coarse * self.pairs.sigma
        u = places[i] - places[j]
        d = np.maximum(np.sqrt((u**2).sum(1) + self.pairs.rise**2), 1e-6)
        first, second = self.bias_column(i), self.bias_column(j)
        r, scale = soften((d + x[first] + x[second] - self.pairs.distance) / sigma)
        weight = scale / sigma
        parts = []
        for axis in range(2):
            pull = weight * u[:, axis] / d
            parts += [(n + 2 * i + axis, pull), (n + 2 * j + axis, -pull)]
        rows.add(r, [*parts, (first, weight), (second, weight)])
