"""What is known of the way from keyframe to keyframe, in arrays: scans laid over each other, wheels, an even drive."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.numerics import LIDAR, MAP, WHEELS, Edges, between, turned, wrapped
from uwbslam_jax.startup import diagonal, loose_sigma, step_sigma

_MATCHED = (0.02, 0.02, 0.01, 0.02)
"""Standard deviation, see `step_sigma`, of a step between two scans that were matched with the map: less than two scans
tell that can be laid over each other, but these may see nothing of the same, or be laid wrong."""
_ASTRAY = (1.0, 0.3)
"""Farther off than this [m, rad] nothing is that two scans tell of a robot that is known by its ranges."""
_UNSTEADY = (0.1, 1.0)
"""Acceleration noise that is learnt at least and at most [m/s^1.5]."""
_FEWEST_STEPS = 20
"""So many steps tell how evenly a robot drives."""


def steps(graph: Graph, poses: np.ndarray) -> Edges:
    """Steps between consecutive keyframes, which bound what nothing measured, then the scans laid over older ones.

    Args:
      poses: (N, 3) about where the keyframes are. An edge far from them is left out: before the frame is decided
        nothing tells that a robot moves along a corridor, and its scans are laid over others of the same look.
    """
    keys = graph.keyframes.values
    new = np.flatnonzero(~keys["broken"][1:]) + 1
    stamp, matched = keys["stamp"] / 1e9, between(keys["pose"][new - 1], keys["pose"][new])
    rolled = graph.rolled()[new]
    z = np.where(rolled[:, None], keys["wheels"][new], matched)
    loose = loose_sigma(z, stamp[new] - stamp[new - 1], rolled)
    sees = ~graph.blind()
    tight = sees[new - 1] & sees[new]
    sure, edges = matched[tight], _near(graph.edges.values, poses)
    values, vectors = np.linalg.eigh(edges["information"].astype(float))
    roots = [
        diagonal(1 / loose),
        diagonal(1 / step_sigma(sure, _MATCHED)),
        np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.swapaxes(1, 2),
    ]
    return Edges(
        np.concatenate([new - 1, new[tight] - 1, edges["old"]]),
        np.concatenate([new, new[tight], edges["new"]]),
        np.concatenate([z, sure, edges["between"]]),
        np.concatenate(roots),
        np.arange(len(z) + len(sure) + len(edges)) >= len(z),
        np.concatenate([np.where(rolled, WHEELS, MAP), np.full(len(sure), MAP), np.full(len(edges), LIDAR)]),
    )


def _near(edges: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """The edges that are not far from where the keyframes are."""
    off = between(poses[edges["old"]], poses[edges["new"]]) - edges["between"]
    return edges[(np.hypot(off[:, 0], off[:, 1]) <= _ASTRAY[0]) & (np.abs(wrapped(off[:, 2])) <= _ASTRAY[1])]


def even_drive(graph: Graph) -> np.ndarray:
    """(T, 5) middle keyframe, time before and after it [s], turn on the way [rad] and how much the velocity in the
    robot's own frame may change [m/s], where a scan is blind and no wheels measure.

    How much it does change is learnt where scans tell: some robots drive evenly, some do not.
    """
    keys = graph.keyframes.values
    if len(keys) < 3:
        return np.zeros((0, 5))
    stamp, pose = keys["stamp"] / 1e9, keys["pose"]
    open_way, blind = keys["broken"] | graph.rolled(), graph.blind()
    dt = np.maximum(np.diff(stamp), 1e-3)
    step = np.diff(pose, axis=0)
    turn = 0.5 * (wrapped(step[:-1, 2]) + wrapped(step[1:, 2]))
    change = step[1:, :2] / dt[1:, None] - turned(turn, step[:-1, :2] / dt[:-1, None])
    mean = 0.5 * (dt[:-1] + dt[1:])
    ok = ~open_way[1:-1] & ~open_way[2:]
    unsure = blind[:-2] | blind[1:-1] | blind[2:]
    learnt = np.abs(change[ok & ~unsure]) / np.sqrt(mean[ok & ~unsure, None])
    sigma_w = np.clip(np.sqrt(np.mean(learnt**2)), *_UNSTEADY) if len(learnt) >= _FEWEST_STEPS else _UNSTEADY[1]
    k = np.flatnonzero(ok & unsure)
    return np.column_stack([k + 1, dt[k], dt[k + 1], turn[k], sigma_w * np.sqrt(mean[k])])
