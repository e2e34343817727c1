"""What the whole run tells, in the published frame: the track of every frame, the beacons, the keyframes to draw.

The estimates that were published along the way stay what they were; this is what the files of a finished run hold.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.backend.range_means import Node
from uwbslam_jax.backend.smoothing import Solution, extended, solve
from uwbslam_jax.estimator import frame_motion, published
from uwbslam_jax.numerics import between, compose, numeric_jacobian, rigid_fit, transformed, wrapped
from uwbslam_jax.settings import Found, HostParams


class Question(NamedTuple):
    """What a solution of the run so far starts from.

    Attributes:
      graph: what was collected. poses: (N, 3) of its keyframes to start from [m, m, rad].
      places: resting place of a beacon -> where it is, about (2,) [m].
      host: with the heights and biases that the user configured.
      frame_nodes: the resting places that make the published frame: its origin, and +x.
      known: what ranges were found to be off by before.
    """

    graph: Graph
    poses: np.ndarray
    places: dict[Node, np.ndarray]
    host: HostParams
    frame_nodes: tuple[Node, Node]
    known: Found


class Hindsight(NamedTuple):
    """The run solved as a whole, in the published frame.

    Attributes:
      solution: with poses, beacons and covariance in that frame.
      track: (T, 3) pose of every frame in the history [m, m, rad].
    """

    solution: Solution
    track: np.ndarray


def look_back(question: Question, stamps: np.ndarray, poses: np.ndarray, sight: np.ndarray) -> Hindsight | None:
    """The run so far solved as a whole; None where it has too little of it.

    Args:
      stamps: (T,) of every frame [ns]; poses: (T, 3) where the map has them [m, m, rad]; sight: (T,) see state.sight.
    """
    solution = framed_solution(question)
    return (
        None if solution is None else Hindsight(solution, _track(question.graph, solution.poses, stamps, poses, sight))
    )


def framed_solution(question: Question) -> Solution | None:
    """The solution, and its covariance, in the published frame."""
    graph, poses, places, host, frame_nodes, known = question
    solution = solve(graph, poses, places, host, known)
    return None if solution is None else _framed(solution, poses, frame_nodes)


def extended_solution(question: Question, before: Solution) -> Solution | None:
    """A solution of the run until some time ago with what came since, in the published frame. question: of now, but the
    poses that it starts from are carried there."""
    graph, poses, places, host, frame_nodes, _ = question
    solution = extended(graph, poses, places, host, before)
    return None if solution is None else _framed(solution, poses, frame_nodes)


def _framed(solution: Solution, before: np.ndarray, frame_nodes: tuple[Node, Node]) -> Solution:
    """The solution in the published frame: that of its two beacons, or where these are not part of it, where the track
    was published."""
    if all(node in solution.nodes for node in frame_nodes):
        to_frame = partial(published, slots=solution.nodes, frame_slots=frame_nodes, onward=np.zeros(3))
        motion = frame_motion(solution.beacons, solution.nodes, frame_nodes)
    else:
        motion = rigid_fit(solution.poses[:, :2], before[:, :2])

        def to_frame(x: np.ndarray) -> np.ndarray:
            beacons = x[3:].reshape(-1, 2)
            return np.concatenate([compose(motion, x[:3]), transformed(motion, beacons).ravel()])

    x = np.concatenate([solution.poses[-1], solution.beacons.ravel()])
    J = numeric_jacobian(to_frame, x)
    beacons = transformed(motion, solution.beacons)
    return solution._replace(poses=compose(motion, solution.poses), beacons=beacons, cov=J @ solution.cov @ J.T)


def _track(graph: Graph, after: np.ndarray, stamps: np.ndarray, poses: np.ndarray, sight: np.ndarray) -> np.ndarray:
    """(T, 3) every frame's pose, from those of the keyframes before and after it.

    Where scans tell the position, the way between two keyframes is what the matches say; in a direction that a scan
    cannot see, it is even.
    """
    keys, before, broken = graph.stamps(), graph.poses(), graph.keyframes["broken"]
    last = len(keys) - 1
    k = np.clip(np.searchsorted(keys, stamps, side="right") - 1, 0, last)
    n = np.minimum(k + 1, last)
    n = np.where(broken[n], k, n)
    share = np.clip((stamps - keys[k]) / np.maximum(keys[n] - keys[k], 1), 0.0, 1.0)
    ends = [compose(after[j], between(before[j], poses)) for j in (k, n)]
    turn = wrapped(ends[1][:, 2] - ends[0][:, 2])
    track = ends[0] + share[:, None] * np.column_stack([ends[1][:, :2] - ends[0][:, :2], turn])
    even = after[k, :2] + share[:, None] * (after[n, :2] - after[k, :2])
    inside = (n > k)[:, None]
    angle = np.where(np.isfinite(sight), sight, 0.0)
    axis = np.stack([np.cos(angle), np.sin(angle)], -1)
    apart = even - track[:, :2]
    along = np.where(np.isfinite(sight)[:, None], axis * np.sum(axis * apart, axis=1)[:, None], 0.0)
    along = np.where(np.isinf(sight)[:, None], apart, along)
    track[:, :2] += np.where(inside, along, 0.0)
    return track
