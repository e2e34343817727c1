"""Relative geometry of nodes at rest: exact without noise, robust, honest about what the links cannot tell."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from uwbslam_jax.startup import static_geometry
from uwbslam_jax.startup.static_geometry import Link, Links, average, solve

NODES = {
    3: (0.0, 0.0),
    7: (6.2, 0.4),
    11: (1.1, 4.9),
    12: (7.0, 5.5),
    20: (3.4, 2.0),
    21: (9.1, 2.2),
    33: (4.4, 6.3),
    40: (8.0, -1.5),
}


def true_links(nodes: dict[int, tuple[float, float]], without: set[tuple[int, int]] = frozenset()) -> dict:
    """What every pair would measure without any error."""
    pairs = [pair for pair in combinations(sorted(nodes), 2) if pair not in without]
    return {(a, b): Link(float(np.hypot(*np.subtract(nodes[a], nodes[b]))), 10, 0) for a, b in pairs}


def rms_after_fit(found: static_geometry.Relative, nodes: dict[int, tuple[float, float]]) -> float:
    """RMS distance to the truth after the best orthogonal motion, reflection allowed [m]."""
    A, B = found.positions, np.array([nodes[node] for node in found.nodes])
    A, B = A - A.mean(0), B - B.mean(0)
    u, _, vt = np.linalg.svd(A.T @ B)
    return float(np.sqrt(np.mean(np.sum((A @ u @ vt - B) ** 2, axis=1))))


def test_without_noise_the_geometry_is_exact():
    found = solve(true_links(NODES))
    assert found is not None
    assert found.nodes == sorted(NODES)
    assert rms_after_fit(found, NODES) < 1e-6
    assert found.rms < 1e-6
    assert found.rejected == []


def test_missing_pairs_need_not_start_near():
    """Each node keeps five of its seven links: MDS of the shortest ways round is only a start."""
    missing = {(3, 12), (3, 21), (7, 33), (7, 11), (11, 40), (12, 20), (20, 21), (33, 40)}
    found = solve(true_links(NODES, missing))
    assert rms_after_fit(found, NODES) < 1e-6


def test_frame_is_by_convention():
    found = solve(true_links(NODES), origin=20)
    at = dict(zip(found.nodes, found.positions, strict=True))
    np.testing.assert_allclose(at[20], 0.0, atol=1e-9)
    farthest = found.positions[np.argmax(np.linalg.norm(found.positions, axis=1))]
    assert farthest[0] > 0
    assert abs(farthest[1]) < 1e-9
    assert found.positions[np.argmax(np.abs(found.positions[:, 1])), 1] > 0
    lowest = solve(true_links(NODES), origin=999)
    np.testing.assert_allclose(lowest.positions[0], 0.0, atol=1e-9)


def test_eight_nodes_at_rest_with_outliers():
    """Gross single ranges, and two links that are wrong as a whole, both counted; the rest is as good as its noise."""
    rng = np.random.default_rng(4)
    links = Links()
    for pair, link in true_links(NODES).items():
        ranges = link.distance + rng.normal(0.0, 0.05, 60) + rng.normal(0.0, 0.03)
        ranges[:6] += rng.uniform(2.0, 40.0, 6) * rng.choice([-1.0, 1.0], 6)
        ranges += {(7, 33): 2.5, (11, 21): -1.8}.get(pair, 0.0)
        for distance in ranges:
            links.add(*pair[::-1], float(distance))
    found = solve(links.averages())
    assert found.rejected == [(7, 33), (11, 21)]
    assert found.gross == 6 * 28
    assert found.links == 26
    assert rms_after_fit(found, NODES) < 0.05


def test_common_offset_is_found_when_asked():
    """Raw times of flight: 77 m of antenna delay a node, that is 154 m a pair."""
    links = {pair: link._replace(distance=link.distance + 154.9) for pair, link in true_links(NODES).items()}
    found = solve(links, fit_offset=True)
    assert found.offset == pytest.approx(154.9, abs=1e-6)
    assert rms_after_fit(found, NODES) < 1e-5
    assert rms_after_fit(solve(links), NODES) > 1.0


def test_heights_are_taken_off():
    rise = {pair: 0.3 * (pair[0] % 5) - 0.3 * (pair[1] % 5) for pair in true_links(NODES)}
    links = {
        pair: link._replace(distance=float(np.hypot(link.distance, rise[pair])))
        for pair, link in true_links(NODES).items()
    }
    assert rms_after_fit(solve(links, rise), NODES) < 1e-6


def test_nodes_with_too_few_links_are_left_out():
    star = {(0, k): Link(3.0, 5, 0) for k in (1, 2, 3, 4)}
    assert solve(star) is None
    assert solve({}) is None
    assert solve({(1, 2): Link(3.0, 5, 0)}) is None
    two_links_only = {(3, 11), (3, 12), (3, 20), (3, 21), (3, 33)}
    found = solve(true_links(NODES, two_links_only))
    assert found.nodes == sorted(set(NODES) - {3})
    triangle = {node: NODES[node] for node in (3, 7, 11)}
    assert rms_after_fit(solve(true_links(triangle)), triangle) < 1e-6


def test_offset_needs_a_link_more_than_the_geometry():
    triangle = {node: NODES[node] for node in (3, 7, 11)}
    assert solve(true_links(triangle), fit_offset=True) is None


def test_two_groups_that_may_turn_against_each_other_are_no_geometry():
    """Two complete squares that share one node: every node has three links, yet one square swings about it."""
    far = {50: (9.0, 9.0), 51: (12.0, 8.0), 52: (10.0, 12.0)}
    near = {3: NODES[3], 7: NODES[7], 20: NODES[20], 33: NODES[33]}
    links = true_links(near) | true_links(far | {33: NODES[33]})
    assert solve(links) is None


def test_covariance_is_what_the_errors_are():
    """Over draws of the links' errors the squared error, whitened, averages one a degree of freedom (2 N - 3)."""
    rng = np.random.default_rng(1)
    truth = solve(true_links(NODES))
    ratios = []
    for _ in range(60):
        links = {
            pair: link._replace(distance=link.distance + rng.normal(0, 0.1)) for pair, link in true_links(NODES).items()
        }
        found = solve(links)
        A, B = truth.positions - truth.positions.mean(0), found.positions - found.positions.mean(0)
        u, _, vt = np.linalg.svd(B.T @ A)
        turn = np.kron(np.eye(len(B)), (u @ vt).T)
        error = (B @ u @ vt - A).ravel()
        cov = turn @ found.cov @ turn.T
        ratios.append(error @ np.linalg.pinv(cov, rcond=1e-6, hermitian=True) @ error / (2 * len(B) - 3))
    # mean of 60 draws of 13 degrees of freedom, their variance estimated from 15 redundant links each
    assert 0.8 < np.mean(ratios) < 1.6


def test_average_counts_what_it_leaves_out():
    ranges = np.array([2.0, 2.02, 1.98, 2.01, 9.0, -30.0])
    assert average(ranges) == Link(pytest.approx(2.005), 4, 2)
    assert average(np.array([3.0])) == Link(3.0, 1, 0)


def test_links_keep_a_bounded_number():
    links = Links()
    for k in range(3000):
        links.add(1, 2, 5.0 if k < 1500 else 6.0)
    assert links.averages() == {(1, 2): Link(6.0, 1024, 0)}
