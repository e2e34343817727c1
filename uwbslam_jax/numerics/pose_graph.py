"""A track of poses, places at rest and what ranges are off by as one least-squares problem: its rows and its minimum.

Start-up solves it for what it remembers, the back end for the whole run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from uwbslam_jax.numerics.freedom import HEIGHT_START_M, Freedom, Off
from uwbslam_jax.numerics.robust import soften
from uwbslam_jax.numerics.se2_host import between, transformed, wrapped
from uwbslam_jax.numerics.sparse_least_squares import Sink, blocks, cost_of, elimination, minimise

_HELD = 1e-4
"""Standard deviation of the first pose, which is held [m, m, rad]."""
WAYS = ("lidar", "wheels", "map")
"""What measures the way from pose to pose, as Freedom names its scale: two scans laid over each other, wheels, scans
matched with a map, which bends."""
LIDAR, WHEELS, MAP = range(len(WAYS))
"""Their numbers."""
_FAR, _FEWEST_FAR, _MANY = 3.0, 3, 0.25
"""A pose may be contradicted where so many of the ranges around it, and this share, are off by more standard deviations
than this."""


class Edges(NamedTuple):
    """Poses relative to older ones, E of them.

    Attributes:
      old, new: (E,) numbers of the poses. between: (E, 3) pose of the new one in the frame of the old one.
      roots: (E, 3, 3) of their information, of which each is root.T @ root. soft: (E,) whether one may be an outlier.
      by: (E,) what has measured it, a number in WAYS.
    """

    old: np.ndarray
    new: np.ndarray
    between: np.ndarray
    roots: np.ndarray
    soft: np.ndarray
    by: np.ndarray


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

    @property
    def flat(self) -> np.ndarray:
        """(P,) distance in the plane, at least 0.1 [m]."""
        return np.sqrt(np.maximum(self.distance**2 - self.rise**2, 0.01))

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


AnyGraph = TypeVar("AnyGraph", bound="PoseGraph")


@dataclass(frozen=True)
class PoseGraph:
    """The problem in arrays. Unknowns: count poses, B places, a bias of the robot and of each node, then the heights,
    scales that `freedom` leaves open.

    Attributes:
      count: of the poses. bias_of: (B,) number of each place's node; 0 is the robot's.
      open: (H,) numbers of the nodes whose height nobody has measured. freedom: see there.
      scaled: whether the way is a measure for the ranges' scale.
      steady: (T, 5) middle one of three poses between which the velocity changes little, time before and after it [s],
        turn on the way [rad], standard deviation of that change [m/s].
    """

    count: int
    bias_of: np.ndarray
    edges: Edges
    ranges: TrackRanges
    pairs: Pairs
    steady: np.ndarray = field(kw_only=True, default_factory=lambda: np.zeros((0, 5)))
    open: np.ndarray = field(kw_only=True, default_factory=lambda: np.zeros(0, int))
    freedom: Freedom = field(kw_only=True, default_factory=Freedom)
    scaled: bool = field(kw_only=True, default=True)

    def freed(self: AnyGraph, groups: tuple[str, ...]) -> AnyGraph:
        """The problem with some groups of unknowns left open."""
        told = {"height": len(self.open) > 0} | {way: bool(np.any(self.edges.by == k)) for k, way in enumerate(WAYS)}
        closed = {name: 0.0 for name, any_of_it in told.items() if not any_of_it}
        return replace(self, freedom=Freedom.of(groups)._replace(**closed))

    @property
    def groups(self) -> dict[str, int]:
        """Unknowns of each group that may be left open."""
        every = {"height": len(self.open), "scale": int(self.scaled), "bias": self.first_height - self.first_bias}
        return {group: count for group, count in every.items() if count}

    @property
    def first_bias(self) -> int:
        """Column of the robot's bias."""
        return 3 * self.count + 2 * len(self.bias_of)

    @cached_property
    def first_height(self) -> int:
        """Column after the last bias."""
        return self.first_bias + 1 + int(self.bias_of.max())

    @cached_property
    def _heights(self) -> int:
        return len(self.open) if self.freedom.height else 0

    @cached_property
    def size(self) -> int:
        """Unknowns."""
        return self.first_height + self._heights + len(self._scales)

    @cached_property
    def _scales(self) -> list[str]:
        """Which of the last fields of Freedom and Off are unknowns, in the order of their columns."""
        return [name for name in ("scale", *WAYS) if getattr(self.freedom, name)]

    @cached_property
    def spread(self) -> np.ndarray:
        """(size - first_bias,) standard deviations of the priors from the robot's bias on."""
        f = self.freedom
        spread = np.repeat([f.bias, f.height], [self.first_height - self.first_bias, self._heights])
        return np.append(spread, [getattr(f, name) for name in self._scales])

    @cached_property
    def rank(self) -> np.ndarray:
        """(size,) in which order the unknowns are eliminated: poses by what ties them to each other, then places and
        biases, on which every pose hangs."""
        middle = self.steady[:, 0].astype(int)
        i = np.concatenate([self.edges.old, self.ranges.at, middle - 1, middle - 1, middle])
        j = np.concatenate([self.edges.new, self.ranges.after, middle, middle + 1, middle + 1])
        poses = 3 * elimination(i, j, self.count)[:, None] + np.arange(3)
        return np.append(poses.ravel(), np.arange(3 * self.count, self.size))

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, Off]:
        """Poses (count, 3), places (B, 2) and what is off of unknowns."""
        n, m = 3 * self.count, self.first_bias
        return x[:n].reshape(-1, 3), x[n:m].reshape(-1, 2), self.off(x[m:])

    def off(self, tail: np.ndarray) -> Off:
        """What the unknowns from the robot's bias on (size - first_bias,) stand for; what is none is 0."""
        k = self.first_height - self.first_bias
        height = np.zeros(k)
        if self._heights:
            height[self.open] = tail[k : k + self._heights]
        return Off(tail[:k], height, **dict(zip(self._scales, tail[k + self._heights :].tolist(), strict=True)))

    def joined(self, poses: np.ndarray, places: np.ndarray, off: Off | None = None) -> np.ndarray:
        """Unknowns of poses, places and what is off, nothing where that is not given."""
        k = self.first_height - self.first_bias
        off = off or Off(np.zeros(k), np.zeros(k))
        heights, scales = off.height[self.open][: self._heights], [getattr(off, name) for name in self._scales]
        return np.concatenate([poses.ravel(), places.ravel(), off.bias, heights, scales])

    def risen(self, x: np.ndarray) -> np.ndarray:
        """Unknowns with no height less than HEIGHT_START_M, to start from and for the covariance: at none, a range does
        not change with it."""
        x, at = x.copy(), slice(self.first_height, self.first_height + self._heights)
        x[at] = np.where(x[at] < 0, -1.0, 1.0) * np.maximum(np.abs(x[at]), HEIGHT_START_M)
        return x

    def turned_over(self, x: np.ndarray, stage: Stage) -> np.ndarray | None:
        """Unknowns with some antennas as far below the robot's as they were above, or above, where that explains the
        ranges between places better; None where it does not. No small move leads there."""
        fill, found = self.rows(x[:3], stage), x
        for column in range(self.first_height, self.first_height + self._heights if len(self.pairs.ends) else 0):
            over = found.copy()
            over[column] *= -1.0
            found = over if cost_of(fill, over) < cost_of(fill, found) else found
        return None if found is x else found

    def bias_column(self, places: np.ndarray) -> np.ndarray:
        """Columns of the biases of places (n,)."""
        return self.first_bias + self.bias_of[places]

    def _height_parts(self, places: np.ndarray, slope: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """What rows depend on by the heights of places (n,), where these are unknowns. slope: (n,)."""
        if not self._heights:
            return []
        number = np.full(self.first_height - self.first_bias, -1)
        number[self.open] = np.arange(self._heights)
        of = number[self.bias_of[places]]
        return [(self.first_height + np.maximum(of, 0), np.where(of >= 0, slope, 0.0))]

    def _scale_parts(self, name: str, slope: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """What rows depend on by a scale, where that is an unknown. name: in Freedom; slope: (n, ...)."""
        if name not in self._scales:
            return []
        return [(np.full(len(slope), self.first_height + self._heights + self._scales.index(name)), slope)]

    def descend(self, x: np.ndarray, stages: tuple[Stage, ...], **effort: Any) -> tuple[np.ndarray, float]:
        """Unknowns and cost after one stage after the other, from x whose first pose is held.

        Args:
          effort: moves, enough, damping, see `minimise`.
        """
        held, cost = x[:3].copy(), np.inf
        for stage in stages:
            x, cost = minimise(self.rows(held, stage), x, self.rank, **effort)
        over = self.turned_over(x, stages[-1])
        return (x, cost) if over is None else minimise(self.rows(held, stages[-1]), over, self.rank, **effort)

    def rows(self, held: np.ndarray, stage: Stage) -> Callable[[np.ndarray, Sink], None]:
        """What puts whitened rows of held start, edges, steady velocity, ranges, pairs and priors into a sink."""

        def fill(x: np.ndarray, rows: Sink) -> None:
            poses = self.split(x)[0]
            rows.add((x[:3] - held) / _HELD, [(np.arange(3), np.full(3, 1 / _HELD))])
            for part in blocks(len(self.edges.old)):
                self._add_edges(rows, x, stage.soft, part)
            self._add_steady(rows, poses)
            for part in blocks(len(self.ranges.at)):
                self._add_ranges(rows, x, stage.coarse, part)
            self.add_pairs(rows, x, stage.coarse)
            tail = x[self.first_bias :]
            rows.add(tail / self.spread, [(np.arange(self.first_bias, len(x)), 1 / self.spread)])

        return fill

    def _add_edges(self, rows: Sink, x: np.ndarray, soft: float, part: slice) -> None:
        poses, _, off = self.split(x)
        old, new, measured, roots, may_err, by_what = (column[part] for column in self.edges)
        a, b = poses[old], poses[new]
        moved = between(a, b)
        way = measured * np.array([1.0, 1.0, 0.0])
        e = moved - (measured + np.array([getattr(off, name) for name in WAYS])[by_what][:, None] * way)
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
        for k, name in enumerate(WAYS):
            for column, slope in self._scale_parts(name, -way * (by_what == k)[:, None]):
                by.append(slope)
                columns.append(column)
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

    def contradicted(self, x: np.ndarray) -> np.ndarray:
        """(count,) whether a pose may not be where its ranges say: many are off by more than they err."""
        far = np.abs(self._range_errors(x, slice(None))[0]) > _FAR
        nearest = np.where(self.ranges.share < 0.5, self.ranges.at, self.ranges.after)
        every, off = (np.bincount(nearest, some, self.count) for some in (np.ones(len(far)), far))
        return (off >= _FEWEST_FAR) & (off >= _MANY * every)

    def range_costs(self, x: np.ndarray) -> np.ndarray:
        """(count,) of each pose the negative log-likelihood of the ranges before and after it."""
        cost = 0.5 * soften(self._range_errors(x, slice(None))[0])[0] ** 2
        return np.bincount(self.ranges.at, cost, self.count) + np.bincount(self.ranges.after, cost, self.count)

    def _range_errors(self, x: np.ndarray, part: slice) -> tuple[np.ndarray, ...]:
        """Of some ranges the residual over its standard deviation (n,), and what that depends on: ends (2, n, 2),
        way from the place (n, 2), difference of the heights (n,), distance (n,)."""
        poses, places, off = self.split(x)
        some = self.ranges.some(part)
        ends = some.ends(poses)
        u = (1 - some.share)[:, None] * ends[0] + some.share[:, None] * ends[1] - places[some.to]
        rise = some.rise - off.height[self.bias_of[some.to]]
        d = np.maximum(np.sqrt((u**2).sum(1) + rise**2), 1e-6)
        error = (1.0 + off.scale) * d + off.bias[0] + x[self.bias_column(some.to)] - some.distance
        return error / some.sigma, np.stack(ends), u, rise, d

    def _add_ranges(self, rows: Sink, x: np.ndarray, coarse: float, part: slice) -> None:
        poses, _, off = self.split(x)
        some, n = self.ranges.some(part), 3 * self.count
        error, ends, u, rise, d = self._range_errors(x, part)
        column, sigma = self.bias_column(some.to), coarse * some.sigma
        r, scale = soften(error / coarse)
        weight = scale / sigma
        pull = (1.0 + off.scale) * weight
        unit = u / d[:, None]
        parts = []
        for key, end, near in ((some.at, ends[0], 1 - some.share), (some.after, ends[1], some.share)):
            lever = end - poses[key, :2]
            parts += [(3 * key + axis, near * pull * unit[:, axis]) for axis in range(2)]
            parts.append((3 * key + 2, near * pull * (unit[:, 1] * lever[:, 0] - unit[:, 0] * lever[:, 1])))
        parts += [(n + 2 * some.to + axis, -pull * unit[:, axis]) for axis in range(2)]
        parts += [(np.full(len(d), self.first_bias), weight), (column, weight)]
        parts += self._height_parts(some.to, -pull * rise / d) + self._scale_parts("scale", weight * d)
        rows.add(r, parts)

    def add_pairs(self, rows: Sink, x: np.ndarray, coarse: float = 1.0) -> None:
        """Rows of the ranges between places; coarse: how many times as much they may err."""
        if not len(self.pairs.ends):
            return
        (i, j), (_, places, off), n = self.pairs.ends.T, self.split(x[: self.size]), 3 * self.count
        sigma = coarse * self.pairs.sigma
        u = places[i] - places[j]
        rise = self.pairs.rise + off.height[self.bias_of[i]] - off.height[self.bias_of[j]]
        d = np.maximum(np.sqrt((u**2).sum(1) + rise**2), 1e-6)
        first, second = self.bias_column(i), self.bias_column(j)
        r, scale = soften(((1.0 + off.scale) * d + x[first] + x[second] - self.pairs.distance) / sigma)
        weight = scale / sigma
        slope = (1.0 + off.scale) * weight
        parts = []
        for axis in range(2):
            pull = slope * u[:, axis] / d
            parts += [(n + 2 * i + axis, pull), (n + 2 * j + axis, -pull)]
        parts += self._height_parts(i, slope * rise / d) + self._height_parts(j, -slope * rise / d)
        rows.add(r, [*parts, (first, weight), (second, weight), *self._scale_parts("scale", weight * d)])
