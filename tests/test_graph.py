"""What a graph keeps of a robot that was carried, and what a scan is laid over."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.graph import Edge, Graph, Keyframe
from uwbslam_jax.measurements import Scan
from uwbslam_jax.range_means import RangeMeans

SECOND = 1_000_000_000
LENGTHS = np.full(40, 3000, np.uint16)


def key(number: int, *, sees: bool = True, broken: bool = False) -> Keyframe:
    scan = Scan(LENGTHS, None, np.float32(0.0), np.float32(0.1), np.float32(0.0)) if sees else None
    pose = np.array([0.3 * number, 0.0, 0.0])
    return Keyframe(number * SECOND // 2, number, pose, np.eye(3), scan, np.zeros(2), 0.0, None, broken)


def chain(count: int, tied: int) -> Graph:
    """Keyframes in a row, of which the first ones are each laid over the one before."""
    graph = Graph(RangeMeans(0.1), [key(k) for k in range(count)])
    graph.edges = [Edge(k - 1, k, np.array([0.3, 0.0, 0.0]), np.eye(3)) for k in range(1, tied)]
    return graph


def test_what_a_carried_robot_saw_is_neither_drawn_nor_laid_over_anything():
    graph = chain(count=20, tied=15)
    graph.edges.append(Edge(3, 17, np.zeros(3), np.eye(3)))  # in somebody's arms it looked like a place known before
    graph.moved(0)
    assert [k.scan is not None for k in graph.keyframes] == [True] * 15 + [False] * 5
    assert all(edge.new < 15 for edge in graph.edges)
    assert len(graph.seen(graph.poses())) == 15


def test_a_robot_that_was_carried_from_where_its_scans_hang_together_loses_nothing():
    graph = chain(count=20, tied=20)
    graph.moved(0)
    assert len(graph.seen(graph.poses())) == 20
    assert len(graph.edges) == 19


def test_a_scan_after_keyframes_without_one_may_be_laid_over_the_last_that_has_one():
    graph = chain(count=9, tied=9)
    graph.keyframes += [key(9, sees=False), key(10, sees=False), key(11)]
    assert 8 in graph._candidates(11)


def test_no_scan_is_laid_over_one_from_before_the_robot_was_carried():
    graph = chain(count=9, tied=9)
    graph.keyframes += [key(9, sees=False, broken=True), key(10)]
    assert 8 not in graph._candidates(10)
