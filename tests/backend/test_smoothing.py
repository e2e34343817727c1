"""The run solved at once: right on made-up graphs, derivatives against differences, outliers and biases."""

from __future__ import annotations

import numpy as np
import pytest
from derivatives import stacked
from loop_graph import BEACONS, host, loop, make, solved, turned

from uwbslam_jax.backend import smoothing
from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.numerics import Freedom, Stage, sparse_least_squares
from uwbslam_jax.numerics.se2_host import between
from uwbslam_jax.settings import Found


def apart(found: smoothing.Solution, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of poses (N,) and beacons (B,) after the one rigid motion that lays both over the truth [m]."""
    a = np.concatenate([found.poses[:, :2], found.beacons])
    b = np.concatenate([truth[:, :2], np.array([BEACONS[slot] for slot, _ in found.nodes])])
    ca, cb = a.mean(0), b.mean(0)
    u, _, vt = np.linalg.svd((a - ca).T @ (b - cb))
    R = vt.T @ np.diag([1, np.linalg.det(vt.T @ u.T)]) @ u.T
    off = np.linalg.norm((a - ca) @ R.T + cb - b, axis=1)
    return off[: len(truth)], off[len(truth) :]


def test_a_run_is_solved_to_millimetres() -> None:
    truth = loop()
    graph = make(truth)
    found = solved(graph)
    robot, beacons = apart(found, truth)
    assert np.sqrt(np.mean(robot**2)) < 0.01  # edges of 5 mm, closed every round
    assert beacons.max() < 0.03  # 158 means of 5 cm
    assert found.found == Found()
    drifted = np.sqrt(np.mean(np.sum((graph.poses()[:, :2] - truth[:, :2]) ** 2, axis=1)))
    assert drifted > 0.03  # what it started from was worse


def nees(found: smoothing.Solution, truth: np.ndarray) -> float:
    """Squared Mahalanobis distance of the beacons, 8 degrees of freedom, in the frame of the first pose."""
    to = between(found.poses[0], np.column_stack([found.beacons, np.zeros(4)]))[:, :2]
    true = np.array([turned(-truth[0, 2], BEACONS[slot] - truth[0, :2]) for slot, _ in found.nodes])
    e = np.array([turned(found.poses[0, 2], d) for d in to - true]).ravel()
    return float(e @ np.linalg.solve(found.cov[3:, 3:], e))


def test_the_covariance_is_what_it_says() -> None:
    truth, runs = loop(60), 25
    mean = np.mean([nees(solved(make(truth, seed)), truth) for seed in range(runs)]) / 8
    assert 0.6 < mean < 1.5  # 200 degrees of freedom: three sigma are 0.3


def test_edges_that_are_wrong_are_left_out() -> None:
    truth = loop()
    graph = make(truth)
    for k in range(10, 70, 15):
        wrong = between(truth[k - 8], truth[k]) + np.array([0.5, -0.4, 0.1])
        graph.edges.append((k - 8, k, wrong, graph.edges[0]["information"]))
    robot, beacons = apart(solved(graph), truth)
    assert np.sqrt(np.mean(robot**2)) < 0.015
    assert beacons.max() < 0.03


def test_ranges_that_are_wrong_are_left_out() -> None:
    truth = loop()
    graph = make(truth)
    graph.ranges.means["distance"][::7] += 2.0
    robot, beacons = apart(solved(graph), truth)
    assert np.sqrt(np.mean(robot**2)) < 0.01
    assert beacons.max() < 0.04


def test_a_pose_that_all_scans_hold_where_its_ranges_are_not_is_moved_there() -> None:
    """A scan laid over those before it where it looks alike, and with it the ranges on the way there."""
    truth, wrong, off = loop(), 60, np.array([0.9, -0.8, 0.0])
    graph = make(truth)
    keys, edges, means = graph.keyframes.values, graph.edges.values, graph.ranges.means.values
    keys["pose"][wrong] += off
    edges["between"][edges["new"] == wrong] = between(truth[edges["old"][edges["new"] == wrong]], truth[wrong] + off)
    graph.edges.keep(edges["old"] != wrong)
    for row in np.flatnonzero(means["at"] == wrong - 1):
        means["before"][row] += turned(-truth[wrong - 1, 2], off[:2])
    for row in np.flatnonzero(means["at"] == wrong):
        means["before"][row] -= turned(-truth[wrong, 2], off[:2])
    for row in means[np.abs(means["at"] - wrong) <= 1].copy():
        for _ in range(7):  # as many beacons as it takes to outweigh four scans and steps
            graph.ranges.means.append(tuple(row))
    found = solved(graph)
    robot, beacons = apart(found, truth)
    assert robot[wrong] < 0.1
    assert np.sqrt(np.mean(robot**2)) < 0.02
    assert beacons.max() < 0.03


def test_biases_are_found_and_not_invented() -> None:
    truth = loop()
    bias = {0: 0.05, 1: 0.2, 2: -0.15, 3: 0.1, 4: -0.2}
    found = solved(make(truth, bias=bias))
    assert found.found.bias
    assert nees(found, truth) < 26.1  # chi-square of 8 degrees of freedom, 0.1 %
    for slot in bias:
        assert abs(found.off.bias[slot] - bias[slot]) < 3.3 * found.sigma.bias[slot]
        assert found.sigma.bias[slot] < 0.15
    assert solved(make(truth, seed=5)).found == Found()


HEIGHT = {0: 0.0, 1: 0.4, 2: 2.8, 3: 1.5, 4: 1.0}
"""Of the antennas over the robot's, by slot [m]."""


def test_heights_that_nobody_has_measured_are_found() -> None:
    truth = loop()
    graph = make(truth, height=HEIGHT)
    found = solved(graph)
    known = solved(graph, height=np.array(list(HEIGHT.values())), surveyed=np.ones(5, bool))
    assert found.freedom == Freedom.of(("height",))
    for slot, height in HEIGHT.items():
        if slot:
            assert abs(found.off.height[slot] - height) < 3.3 * found.sigma.height[slot]
            assert found.sigma.height[slot] < 0.2
    assert nees(found, truth) < 26.1  # chi-square of 8 degrees of freedom, 0.1 %
    robot, beacons = apart(found, truth)
    assert np.sqrt(np.mean(robot**2)) < 1.2 * np.sqrt(np.mean(apart(known, truth)[0] ** 2))
    assert beacons.max() < 0.04
    assert known.found == Found()


def test_an_antenna_below_that_of_the_robot_is_found_there() -> None:
    """Its ranges to the robot do not tell, those to the other beacons do."""
    found = solved(make(loop(), height=HEIGHT | {3: -1.5}))
    assert found.off.height[3] == pytest.approx(-1.5, abs=0.1)
    assert found.off.height[2] == pytest.approx(2.8, abs=0.1)


def test_a_scale_of_the_ranges_is_found() -> None:
    truth = loop()
    found = solved(make(truth, scale=0.07))
    assert found.freedom == Freedom.of(("scale",))._replace(wheels=0.0)
    assert found.off.scale == pytest.approx(0.07, abs=0.003)
    assert found.sigma.scale == pytest.approx(0.0022, abs=0.0005)  # a LiDAR is not better
    assert apart(found, truth)[1].max() < 0.04


def test_what_was_found_before_is_where_the_next_solution_starts() -> None:
    graph, places = make(loop(), height=HEIGHT), {(slot, 0): spot for slot, spot in BEACONS.items()}
    first = solved(graph)
    again = smoothing.solve(graph, first.poses, places, host(), first.found)
    assert again.off.height == pytest.approx(first.off.height, abs=0.02)
    flat = smoothing.solve(make(loop()), first.poses, places, host(), first.found)
    assert flat.found == Found()


def test_ranges_of_a_coarse_radio_are_believed_where_all_are_loud() -> None:
    """Walls make some of the ranges loud; a radio that is coarser than uwb.sigma_n all of them."""
    loud, to = np.array([True] * 9 + [False] + [True] * 10), np.repeat([0, 1], 10)
    assert smoothing._by_the_radio(loud, to)
    loud[:3] = False
    assert not smoothing._by_the_radio(loud, to)


def test_configured_biases_and_heights_are_taken_off() -> None:
    truth = loop()
    bias = np.array([0.05, 0.2, -0.15, 0.1, -0.2])
    graph = make(truth, bias=dict(enumerate(bias)))
    means = graph.ranges.means.values
    offset = bias[0] + bias[means["slot"]]
    means["distance"] = np.hypot(means["distance"] - offset, 1.5) + offset
    found = solved(graph, bias=bias, height=np.array([0.0, 1.5, 1.5, 1.5, 1.5]), surveyed=np.ones(5, bool))
    assert found.found == Found()
    assert apart(found, truth)[1].max() < 0.03


def test_where_scans_are_blind_ranges_and_an_even_drive_tell_the_way() -> None:
    """Edges that tell nothing along x: the track along x is that of the ranges, not that of the map."""
    sway = np.sin(np.linspace(0, 6, 60))
    truth = np.column_stack([np.linspace(0, 8, 60), 0.3 * sway, 0.05 * sway])
    graph = make(truth, sight=np.diag([0.0, 0.005**-2, 0.001**-2]))
    wrong = graph.poses()
    wrong[:, 0] *= 0.8
    graph.put(wrong, 0.0)
    robot, _ = apart(solved(graph), truth)
    assert np.sqrt(np.mean(robot**2)) < 0.04


def test_too_little_gives_nothing() -> None:
    graph = make(loop(60))
    places = {(slot, 0): spot for slot, spot in BEACONS.items()}
    empty = Graph()
    assert smoothing.solve(empty, empty.poses(), places, host()) is None
    assert smoothing.solve(graph, graph.poses(), {}, host()) is None


def test_derivatives_agree_with_differences() -> None:
    truth = loop(12)
    graph = make(truth, sight=np.diag([0.2**-2, 0.02**-2, 0.004**-2]))
    graph.keyframes["informed"][:] = 0.0  # blind: the even drive counts
    places = {(slot, 0): spot for slot, spot in BEACONS.items()}
    ranging = host(height=np.array([0.0, 1.0, 0.5, 0.0, 2.0]), bias_scale=0.02)
    graph.keyframes["wheels"][3:8] = between(truth[2:7], truth[3:8])  # so that their scale is an unknown as well
    problem = smoothing.Problem.build(graph, graph.poses(), places, ranging).freed(("bias", "height", "scale"))
    assert problem.size == 3 * 12 + 8 + 5 + 4 + 4
    rng = np.random.default_rng(3)
    x = problem.start(graph.poses() + rng.normal(0, 0.05, truth.shape), places)
    x[-12:] += rng.normal(0, 0.05, 12)
    stage = Stage(1e6, 1.0)  # edges not softened: their reweighting is no derivative of the residual
    fill = problem.rows(x[:3].copy(), stage)
    J, _ = stacked(fill, x)
    h = 1e-6
    for column in {*rng.choice(len(x), 40, replace=False), *range(len(x) - 12, len(x))}:
        e = h * np.eye(len(x))[column]
        want = (stacked(fill, x + e)[1] - stacked(fill, x - e)[1]) / (2 * h)
        np.testing.assert_allclose(J[:, column], want, rtol=1e-4, atol=1e-4 * max(1, abs(want).max()))


def test_normal_equations_are_those_of_the_rows(monkeypatch) -> None:
    """Gathered block by block, with a few rows in each, they are J.T J, J.T r and r.r / 2 of all rows."""
    monkeypatch.setattr(sparse_least_squares, "_BLOCK", 7)
    truth = loop(40)
    graph = make(truth)
    places = {(slot, 0): spot for slot, spot in BEACONS.items()}
    problem = smoothing.Problem.build(graph, graph.poses(), places, host())
    x = problem.start(graph.poses() + np.random.default_rng(5).normal(0, 0.05, truth.shape), places)
    fill = problem.rows(x[:3] + 1e-5, Stage(30.0, 2.0))
    J, r = stacked(fill, x)
    rank = np.random.default_rng(6).permutation(len(x))
    rows, cost = sparse_least_squares.Rows(rank), sparse_least_squares.Cost()
    fill(x, rows)
    fill(x, cost)
    A, b = rows.normal()
    np.testing.assert_allclose(A.toarray()[np.ix_(rank, rank)], J.T @ J, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(b[rank], J.T @ r, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(cost.cost, 0.5 * r @ r)


def test_unknowns_are_eliminated_in_an_order_that_keeps_the_factor_sparse() -> None:
    """Each unknown once; the factor of a track of many rounds has few more entries than the equations themselves, and
    many times fewer than where the places, on which every pose hangs, go first."""
    truth = np.tile(loop(40), (5, 1))
    graph = make(truth)
    places = {(slot, 0): spot for slot, spot in BEACONS.items()}
    problem = smoothing.Problem.build(graph, graph.poses(), places, host())
    assert sorted(problem.rank) == list(range(problem.size))

    def entries(rank: np.ndarray) -> tuple[int, int]:
        rows = sparse_least_squares.Rows(rank)
        problem.rows(np.zeros(3), Stage(30.0, 2.0))(problem.start(graph.poses(), places), rows)
        A = rows.normal().A
        return A.nnz // 2, sparse_least_squares._factor(A.T).L.nnz

    lower, factor = entries(problem.rank)
    assert factor < 1.5 * lower
    assert factor < 0.2 * entries(problem.size - 1 - problem.rank)[1]


def test_what_nothing_ties_stays_where_it_is_and_the_rest_is_solved() -> None:
    for count in (4, 400):  # dense and sparse

        def fill(x: np.ndarray, rows: sparse_least_squares.Sink, count: int = count) -> None:
            free = np.arange(count - 1)
            rows.add(x[free] - 1.0, [(free, np.ones(count - 1))])
            rows.add(np.zeros(1), [(np.array([count - 1]), np.zeros(1))])

        rank = np.arange(count)
        found, cost = sparse_least_squares.minimise(fill, np.zeros(count), rank, moves=30, enough=1e-9)
        assert np.allclose(found[:-1], 1.0)
        assert found[-1] == 0.0
        assert cost < 1e-9
        assert np.isfinite(sparse_least_squares.covariance(fill, found, rank, rank)).all()
