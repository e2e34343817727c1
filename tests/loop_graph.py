"""A graph of keyframes twice around an ellipse among four beacons, with ranges to each, and its solution."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from uwbslam_jax.backend import smoothing
from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.numerics.se2_host import between
from uwbslam_jax.settings import HostParams, Settings, UwbSettings, make_host_params, make_params

BEACONS = {1: np.array([-3.0, 5.0]), 2: np.array([9.0, 6.0]), 3: np.array([8.0, -4.0]), 4: np.array([-2.0, -3.0])}
SIGMA_N = 0.1
ANTENNA = np.array([0.1, -0.05])
K = 5
SETTINGS = Settings(uwb=UwbSettings(max_beacons=K - 1, sigma_n=SIGMA_N))


def loop(count: int = 80) -> np.ndarray:
    """Twice around an ellipse among the beacons."""
    a = np.linspace(0.0, 4 * np.pi, count)
    x, y = 3 + 5 * np.cos(a), 1 + 3.5 * np.sin(a)
    return np.column_stack([x, y, np.unwrap(np.arctan2(3.5 * np.cos(a), -5 * np.sin(a)))])


def turned(theta: float, v: np.ndarray) -> np.ndarray:
    c, s = np.cos(theta), np.sin(theta)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def make(truth: np.ndarray, seed: int = 0, bias=None, sight: np.ndarray | None = None, height=None, scale=0.0) -> Graph:
    """A graph of a track: edges to the keyframe before, and to the one a round before, ranges to every beacon.

    bias: by slot [m]; sight: (3, 3) information of every edge; height: of the antennas over the robot's, by slot [m];
    scale: of all ranges [m/m].
    """
    rng = np.random.default_rng(seed)
    bias, height = (given or dict.fromkeys(range(K), 0.0) for given in (bias, height))
    information = np.diag([0.005**-2, 0.005**-2, 0.001**-2]) if sight is None else sight
    drift = np.cumsum(rng.normal(0, [0.01, 0.01, 0.002], truth.shape), axis=0)
    graph = Graph()
    for k, pose in enumerate(truth + drift):
        graph.keyframes.append((k * 400_000_000, k, pose, information, np.zeros(2), 0.0, np.full(3, np.nan), False))
        graph.scans.append(None)
    spread = np.linalg.pinv(information)
    for new in range(1, len(truth)):
        for old in {new - 1, max(new - len(truth) // 2, 0)} - {new}:
            z = between(truth[old], truth[new]) + rng.multivariate_normal(np.zeros(3), spread)
            graph.edges.append((old, new, z, information))
    for at in range(len(truth) - 1):
        for slot, spot in BEACONS.items():
            for share in (0.25, 0.75):
                pose = (1 - share) * truth[at] + share * truth[at + 1]
                antenna = pose[:2] + turned(pose[2], ANTENNA)
                ends = [turned(-p[2], antenna - p[:2]) for p in truth[[at, at + 1]]]
                slant = np.hypot(np.linalg.norm(antenna - spot), height[slot])
                d = (1 + scale) * slant + bias[0] + bias[slot] + rng.normal(0, 0.05)
                graph.ranges.means.append((at, slot, 0, share, *ends, d, 0.05, False, 0.0))
    for i in BEACONS:
        for j in BEACONS:
            if i < j:
                slant = np.hypot(np.linalg.norm(BEACONS[i] - BEACONS[j]), height[i] - height[j])
                d = (1 + scale) * slant + bias[i] + bias[j]
                graph.ranges.pairs[(i, 0), (j, 0)] = deque(d + rng.normal(0, SIGMA_N, 200))
    return graph


def host(**changes) -> HostParams:
    """Ranges without biases between antennas of one height, but for what is given."""
    made = make_host_params(SETTINGS, make_params(SETTINGS))
    return replace(made, antenna=ANTENNA, **changes)


def solved(graph: Graph, **changes) -> smoothing.Solution:
    rng = np.random.default_rng(99)
    places = {(slot, 0): spot + rng.normal(0, 0.2, 2) for slot, spot in BEACONS.items()}
    found = smoothing.solve(graph, graph.poses(), places, host(**changes))
    assert found is not None
    return found
