"""The whole run solved at once: the poses, resting beacons and range biases that explain scans, steps and ranges.

Sparse Gauss-Newton in float64 over the `graph`. The filter decides with what it knew at the time; this takes back what
the rest of the run tells about it (in the words of the field: the back end; for a linear problem, the smoother).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.backend.range_means import Node
from uwbslam_jax.backend.relative_motions import even_drive, steps
from uwbslam_jax.numerics import (
    CALIBRATED_M,
    DECIDED,
    Pairs,
    PoseGraph,
    Stage,
    TrackRanges,
    covariance,
    median_range,
    widened,
)
from uwbslam_jax.settings import HostParams

BIASED_M = 0.3
"""Standard deviation of a node's bias when ranges are not taken to be calibrated [m]."""
_STAGES = (Stage(soft=1000.0, coarse=4.0), Stage(soft=30.0, coarse=2.0), Stage(soft=5.0, coarse=1.0))
"""One solution after the other. The filter's track may be far off for what two scans tell, and nothing must be an
outlier only because the start is wrong."""
_FEWEST_MEANS = 6
"""A resting place that was ranged less takes no part: fewer averages leave more than one place for it."""
_MOVES, _ENOUGH = 25, 0.05
"""Moves of a stage at most [moves]: a bound for starts far off; one that gains less log-likelihood than this is the
last."""


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
class Problem(PoseGraph):
    """The run in arrays: nodes are its places, slots those that have a bias each, the robot's first."""

    nodes: list[Node]
    slots: list[int]

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
        sigma = widened(means["sigma"], loud, to)
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
            nodes=nodes,
            slots=slots,
        )

    def start(self, poses: np.ndarray, places: dict[Node, np.ndarray]) -> np.ndarray:
        """Unknowns to start from: poses (N, 3), places of the nodes and others."""
        return self.joined(poses, np.array([places[node] for node in self.nodes]))

    def minimise(self, x: np.ndarray, bias_sigma: float) -> tuple[np.ndarray, float]:
        """Levenberg-Marquardt from x: unknowns and cost."""
        return self.descend(x, bias_sigma, _STAGES, moves=_MOVES, enough=_ENOUGH)

    def solution(self, x: np.ndarray, cost: float, bias_sigma: float, biased: bool) -> Solution:
        """What unknowns at their minimum tell."""
        last = 3 * self.count - 3
        cov = covariance(self.rows(x[:3], bias_sigma, _STAGES[-1]), x, self.rank, np.arange(last, self.size))
        free = self.first_bias - last
        spread = np.sqrt(np.maximum(np.diag(cov)[free:], 0.0))
        poses, beacons, bias = self.split(x)
        return Solution(
            poses,
            self.nodes,
            beacons,
            dict(zip(self.slots, map(float, bias), strict=True)),
            dict(zip(self.slots, map(float, spread), strict=True)),
            biased,
            cost,
            cov[:free, :free],
        )
