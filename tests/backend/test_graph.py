"""What a graph keeps of a robot that was carried, and what a scan is laid over."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.estimator import Estimate
from uwbslam_jax.measurements import NAN, Frame, Odometry, Ranges, Scan, ScanMessage, StampedFrame
from uwbslam_jax.session.frame_assembler import pad_scan
from uwbslam_jax.settings import LidarSettings, Settings, UwbSettings, make_host_params, make_params

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


def test_newest_ground_is_drawn_where_it_matches_though_few_scans_hang_on_it_yet():
    graph = chain(count=30, tied=20)  # 20 that hang together; ten each on its own
    for k in range(26, 30):
        graph.edges.append((k - 1, k, np.array([0.3, 0.0, 0.0]), np.eye(3)))
    drawn = [round(float(pose[0] / 0.3)) for pose, _ in graph.seen(graph.poses())]
    assert drawn == [*range(20), *range(25, 30)]


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


def test_a_scan_near_a_keyframe_by_wheels_alone_is_a_keyframe(monkeypatch):
    """Scans a metre apart, wheels in between: every scan that no other was taken near counts, wherever wheels were."""
    monkeypatch.setattr(Graph, "_tie", lambda graph, host: None)
    settings = Settings(uwb=UwbSettings(max_beacons=2), lidar=LidarSettings(max_beams=40))
    host, graph = make_host_params(settings, make_params(settings)), Graph()
    wall = ScanMessage(0, -1.0, 0.05, 0.0, 0.1, 30.0, np.full(40, 3.0, np.float32))
    number = np.zeros(4, np.int32)
    ranges = Ranges(number, number + 1, *np.zeros((3, 4), np.float32), np.zeros(4, bool))
    odometry = Odometry(np.array([0.1, 0.0, 0.0], np.float32), np.bool_(True))
    for k in range(41):
        scan = k % 10 == 0 or k == 21
        padded = pad_scan(wall if scan else None, settings)
        frame = StampedFrame(k * SECOND // 10, Frame(np.float32(0.1), np.bool_(scan), padded, ranges, odometry))
        told = {"pose": np.array([0.1 * k, 0.0, 0.0]), "map_error": np.zeros(3), "velocity": np.zeros(2)}
        told |= {"matched_pose": told["pose"], "information": np.eye(3) * scan, "yaw_rate": np.zeros(())}
        told |= {"active": np.ones(3, bool), "moving": np.zeros(3, bool)}
        graph.add(host, k, frame, Estimate(**{name: told.get(name) for name in Estimate._fields}))
    seen = np.array([scan is not None for scan in graph.scans])
    # but not the one that was taken 0.1 m after another
    np.testing.assert_allclose(graph.poses()[seen, 0], [0.0, 1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(graph.keyframes["wheels"][1:, 0], np.diff(graph.poses()[:, 0]), atol=1e-6)
