"""The whole run solved at once: poses, resting beacons and what ranges are off by, to explain scans, steps and ranges.

Sparse Gauss-Newton in float64 over the `graph`. The filter decides with what it knew at the time; this takes back what
the rest of the run tells about it (in the words of the field: the back end; for a linear problem, the smoother).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.backend.range_means import Node
from uwbslam_jax.backend.relative_motions import even_drive, steps
from uwbslam_jax.numerics import (
    CALIBRATED_M,
    DECIDED,
    Freedom,
    Off,
    Pairs,
    PoseGraph,
    Stage,
    TrackRanges,
    covariance,
    fewest_open,
    median_range,
    tells_scale,
    widened,
)
from uwbslam_jax.settings import Found, HostParams

_STAGES = (Stage(soft=1000.0, coarse=4.0), Stage(soft=30.0, coarse=2.0), Stage(soft=5.0, coarse=1.0))
"""One solution after the other. The filter's track may be far off for what two scans tell, and nothing must be an
outlier only because the start is wrong."""
_FEWEST_MEANS = 6
"""A resting place that was ranged less takes no part: fewer averages leave more than one place for it."""
_RADIO = 0.8
"""Where so many of the means to each place are loud, it is the radio that is, and no wall in between [share]."""
_MOVES, _ENOUGH = 25, 0.05
"""Moves of a stage at most [moves]: a bound for starts far off; one that gains less log-likelihood than this is the
last."""


class Solution(NamedTuple):
    """What the whole run tells.

    Attributes:
      poses: (N, 3) of the keyframes [m, m, rad].
      nodes: resting places of the beacons; beacons: (B, 2) where they are [m].
      off, sigma: what ranges are off by beyond what is configured, and how well that is known. Of heights those that
        nobody has measured, none where all are as good as that of the robot.
      freedom: what was left open for that: it explains the ranges far better than what is configured.
      cost: negative log-likelihood.
      cov: (3 + 2 B, 3 + 2 B) of the last pose and the beacons while the first pose is held.
    """

    poses: np.ndarray
    nodes: list[Node]
    beacons: np.ndarray
    off: Found
    sigma: Found
    freedom: Freedom
    cost: float
    cov: np.ndarray

    @property
    def found(self) -> Found:
        """What is off, without biases where ranges are taken to be calibrated."""
        return self.off if self.freedom.bias > CALIBRATED_M else replace(self.off, bias={})


def solve(
    graph: Graph,
    poses: np.ndarray,
    places: dict[Node, np.ndarray],
    host: HostParams,
    known: Found | None = None,
) -> Solution | None:
    """The run solved; None where there is nothing to solve.

    Args:
      poses: (N, 3) of the keyframes to start from [m, m, rad].
      places: resting place -> (2,) to start from [m]; others are left out.
      host: with biases and heights as configured.
      known: what was found before; what is not 0 of it stays open.
    """
    problem = Problem.build(graph, poses, places, host)
    if problem is None:
        return None
    known = known or Found()
    groups = tuple(group for group in problem.groups if getattr(known, group))
    first = problem.freed(groups).minimise(*problem.split(problem.start(poses, places))[:2], problem.known(known))
    _, best = fewest_open(groups, first, problem.groups, lambda groups, before: before.freed(groups))
    return best.explained().solution()


def extended(
    graph: Graph, poses: np.ndarray, places: dict[Node, np.ndarray], host: HostParams, before: Solution
) -> Solution | None:
    """A solution with what came since: what ranges are off by stays open where it was, and the start is about right.

    Args: see `solve`. before: the solution of the run until some time ago.
    """
    problem = Problem.build(graph, poses, places, host)
    if problem is None:
        return None
    problem = replace(problem, freedom=before.freedom)
    start = problem.start(poses, places, problem.known(before.off))
    return problem.settled(problem.risen(start)).explained().solution()


def _by_the_radio(loud: np.ndarray, to: np.ndarray) -> bool:
    """Whether means (R,) of ranges to places (R,) scatter more than they should wherever the robot is."""
    return bool(np.all(np.bincount(to, loud) > _RADIO * np.bincount(to)))


@dataclass(frozen=True)
class _Solved:
    """A problem at its minimum: unknowns and cost."""

    problem: Problem
    x: np.ndarray
    cost: float

    @cached_property
    def cov(self) -> np.ndarray:
        """Square covariance of the last pose, the places and what is off, while the first pose is held."""
        p = self.problem
        fill, columns = p.rows(self.x[:3], _STAGES[-1]), np.arange(3 * p.count - 3, p.size)
        return covariance(fill, p.risen(self.x), p.rank, columns)

    @property
    def off(self) -> Off:
        """What ranges are off by."""
        return self.problem.split(self.x)[2]

    @property
    def off_sigma(self) -> Off:
        """How well that is known."""
        tail = self.problem.size - self.problem.first_bias
        return self.problem.off(np.sqrt(np.maximum(np.diag(self.cov)[-tail:], 0.0)))

    def strength(self, group: str) -> float:
        """See Off."""
        return self.off.strength(self.off_sigma, group)

    def explained(self) -> _Solved:
        """Without the poses that their ranges contradict, where the run is explained better so: scans laid over others
        of the same look hold them there, and no small move leads away. Each is tried between its neighbours."""
        poses, places, off = self.problem.split(self.x)
        astray = self.problem.contradicted(self.x)
        if not astray.any() or astray.all():
            return self
        good, t = np.flatnonzero(~astray), self.problem.time
        way = np.column_stack([poses[good, :2], np.unwrap(poses[good, 2])])
        there = np.column_stack([np.interp(t, t[good], column) for column in way.T])

        def moved(which: np.ndarray) -> tuple[Problem, np.ndarray]:
            problem = self.problem.evened(which)
            return problem, problem.joined(np.where(which[:, None], there, poses), places, off)

        problem, x = moved(astray)
        astray &= self.problem.range_costs(self.x) - problem.range_costs(x) > DECIDED
        if not astray.any():
            return self
        problem, x = moved(astray)
        again = problem.settled(x)
        return again if again.cost < self.cost - DECIDED else self

    def freed(self, groups: tuple[str, ...]) -> _Solved:
        """Solved with other groups of unknowns left open."""
        poses, places, off = self.problem.split(self.x)
        return self.problem.freed(groups).minimise(poses, places, off)

    def solution(self) -> Solution:
        """What it tells."""
        p, free = self.problem, 3 + 2 * len(self.problem.nodes)
        poses, beacons, off = p.split(self.x)
        told = p.found(off), p.found(self.off_sigma), p.freedom
        return Solution(poses, p.nodes, beacons, *told, self.cost, self.cov[:free, :free])


@dataclass(frozen=True)
class Problem(PoseGraph):
    """The run in arrays: nodes are its places, slots those that have a bias each, the robot's first; antenna: (2,) on
    the robot [m]. time: (count,) of the poses [s]."""

    nodes: list[Node]
    slots: list[int]
    antenna: np.ndarray
    time: np.ndarray

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
        sigma = means["sigma"] if _by_the_radio(loud, to) else widened(means["sigma"], loud, to)
        pairs = []
        for (a, b), kept in graph.ranges.pairs.items():
            if a in index and b in index and len(kept) >= 3:
                middle, spread, _ = median_range(np.array(kept), host.sigma_n)
                pairs.append((index[a], index[b], host.slant(middle, a[0], b[0]), host.rise(a[0], b[0]), spread))
        distance, rise = host.slant(means["distance"].astype(float), 0, slot), np.asarray(host.rise(0, slot))
        share, before, after = (means[name].astype(float) for name in ("share", "before", "after"))
        ranges = TrackRanges(means["at"], means["at"] + 1, to, share, before, after, distance, rise, sigma)
        return Problem(
            count=len(graph.keyframes),
            bias_of=np.array([slots.index(slot) for slot, _ in nodes]),
            edges=steps(graph, poses),
            ranges=ranges,
            pairs=Pairs.of(pairs),
            steady=even_drive(graph),
            scaled=tells_scale(~graph.blind()[graph.matched()]),
            open=np.array([k for k, slot in enumerate(slots) if slot and not host.surveyed[slot]], int),
            nodes=nodes,
            slots=slots,
            antenna=host.antenna,
            time=(graph.stamps() - graph.stamps()[0]) / 1e9,
        )

    def evened(self, astray: np.ndarray) -> Problem:
        """With the ranges next to poses that are not to be believed (count,) taken on an even way from the pose before
        to the one after: where the antenna was was told by how far it had come from these."""
        which = (astray[self.ranges.at] | astray[self.ranges.after])[:, None]
        at, after = (np.where(which, self.antenna, lever) for lever in (self.ranges.lever_at, self.ranges.lever_after))
        return replace(self, ranges=self.ranges._replace(lever_at=at, lever_after=after))

    def start(self, poses: np.ndarray, places: dict[Node, np.ndarray], off: Off | None = None) -> np.ndarray:
        """Unknowns to start from: poses (N, 3), places of the nodes, and what is off, nothing where not given."""
        return self.joined(poses, np.array([places[node] for node in self.nodes]), off)

    def minimise(self, poses: np.ndarray, places: np.ndarray, off: Off | None = None) -> _Solved:
        """Levenberg-Marquardt from poses (N, 3), places (B, 2) and what is off."""
        x = self.risen(self.joined(poses, places, off))
        return _Solved(self, *self.descend(x, _STAGES, moves=_MOVES, enough=_ENOUGH))

    def settled(self, x: np.ndarray) -> _Solved:
        """At the minimum near unknowns that are about right."""
        return _Solved(self, *self.descend(x, _STAGES[-1:], moves=_MOVES, enough=_ENOUGH))

    def known(self, found: Found) -> Off:
        """By node."""
        bias, height = (np.array([by.get(slot, 0.0) for slot in self.slots]) for by in (found.bias, found.height))
        return Off(bias, height, found.scale)

    def found(self, off: Off) -> Found:
        """By slot."""
        bias = dict(zip(self.slots, map(float, off.bias), strict=True))
        open_slots = [(k, self.slots[k]) for k in self.open] if self.freedom.height else []
        return Found(bias, {slot: float(off.height[k]) for k, slot in open_slots}, float(off.scale))
