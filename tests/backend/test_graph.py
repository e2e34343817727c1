"""What a graph keeps of a robot that was carried, and what a scan is laid over."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.measurements import NAN, Scan

SECOND = 1_000_000_000
LENGTHS = np.full(40, 3000, np.uint16)


def extend(graph: Graph, *, sees: bool = True, broken: bool = False, x: float | None = None) -> None:
    """One more keyframe, half a second on; 0.3 m on as well, unless told where."""
    number = len(graph.keyframes)
    pose = np.array([0.3 * number if x is None else x, 0.0, 0.0])
    graph.keyframes.append((number * SECOND // 2, number, pose, np.eye(3), np.zeros(2), 0.0, np.full(3, NAN), broken))
    scan = Scan(LENGTHS, None, np.float32(0.0), np.float32(0.1), np.float32(0.0))
    graph.scans.append(scan if sees else None)


def chain(count: int, tied: int) -> Graph:
    """Keyframes in a row, of which the first ones are each laid over the one before."""
    graph = Graph()
    for _ in range(count):
        extend(graph)
    for k in range(1, tied):
        graph.edges.append((k - 1, k, np.array([0.3, 0.0, 0.0]), np.eye(3)))
    return graph


def test_what_a_carried_robot_saw_is_neither_drawn_nor_laid_over_anything():
    graph = chain(count=20, tied=15)
    graph.edges.append((3, 17, np.zeros(3), np.eye(3)))  # in somebody's arms it looked like a place known before
    graph.moved(0)
    assert [scan is not None for scan in graph.scans] == [True] * 15 + [False] * 5
    assert np.all(graph.edges["new"] < 15)
    assert len(list(graph.seen(graph.poses()))) == 15


def test_a_robot_that_was_carried_from_where_its_scans_hang_together_loses_nothing():
    graph = chain(count=20, tied=20)
    graph.moved(0)
    assert len(list(graph.seen(graph.poses()))) == 20
    assert len(graph.edges) == 19


def test_a_scan_after_keyframes_without_one_may_be_laid_over_the_last_that_has_one():
    graph = chain(count=9, tied=9)
    for sees in (False, False, True):
        extend(graph, sees=sees)
    assert 8 in graph._candidates(11)


def test_no_scan_is_laid_over_one_from_before_the_robot_was_carried():
    graph = chain(count=9, tied=9)
    extend(graph, sees=False, broken=True)
    extend(graph)
    assert 8 not in graph._candidates(10)


def test_scans_are_bounded_by_the_ground_and_the_newest_are_kept():
    graph, counts = Graph(), []
    graph._anchors = [2]
    for k in range(800):  # to and fro over 6 m, twenty times
        extend(graph, x=0.3 * min(k % 40, 40 - k % 40))
        graph._thin()
        counts.append(sum(scan is not None for scan in graph.scans))
    assert max(counts[:400]) >= max(counts[400:])
    assert max(counts) < 80
    assert graph.scans[2] is not None
    newest = graph.keyframes["stamp"] > graph.keyframes["stamp"][-1] - 5 * SECOND
    assert all(graph.scans[k] is not None for k in np.flatnonzero(newest))
    seen = [k for k, scan in enumerate(graph.scans) if scan is not None]
    assert np.mean(seen) > 600


def test_a_robot_that_rests_under_an_anchor_keeps_its_newest_scans():
    graph = Graph()
    graph._anchors = list(range(20))
    for _ in range(60):
        extend(graph, x=0.0)
        graph._thin()
    assert all(scan is not None for scan in graph.scans[:20])
    assert graph.scans[-1] is not None
