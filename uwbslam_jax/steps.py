"""What is known of the way from keyframe to keyframe, in arrays: scans laid over each other, wheels, an even drive."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.graph import Graph, relative, wrapped
from uwbslam_jax.keyframes import turned

_LOOSE_WHEELS = (0.03, 0.06, 0.02, 0.06)
"""Standard deviation of a step by wheels: floor and share of the way [m], floor and share of the turn [rad]."""
_LOOSE = (0.1, 0.2, 0.05, 0.1)
"""The same of a step that nothing measured, without what it may have driven in the time."""
_MATCHED = (0.02, 0.02, 0.01, 0.02)
"""The same of a step between two scans that were matched with the map: less than two scans tell that can be laid over
each other, but these may see nothing of the same, or be laid wrong."""
_LONGEST_S = 3.0
"""So long at most counts with a metre a second."""
_ASTRAY = (1.0, 0.3)
"""Farther off than this [m, rad] nothing is that two scans tell of a robot that is known by its ranges."""
_UNSTEADY = (0.1, 1.0)
"""Acceleration noise that is learnt at least and at most [m/s^1.5]."""
_FEWEST_STEPS = 20
"""So many steps tell how evenly a robot drives."""


def steps(graph: Graph, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps between consecutive keyframes, which bound what nothing measured, then the scans laid over older ones.

    Args:
      poses: (N, 3) about where the keyframes are. An edge far from them is left out: before the frame is decided
        nothing tells that a robot moves along a corridor, and its scans are laid over others of the same look.

    Returns:
      old, new (E,) keyframes, between (E, 3), roots (E, 3, 3) of their information, soft (E,) whether one may be wrong.
    """
    keys = graph.keyframes
    old, new, between, roots, soft = [], [], [], [], []
    for k in range(1, len(keys)):
        if keys[k].broken:
            continue
        wheels = keys[k].wheels
        z = relative(keys[k - 1].pose, keys[k].pose) if wheels is None else wheels
        elapsed = min((keys[k].stamp - keys[k - 1].stamp) / 1e9, _LONGEST_S) if wheels is None else 0.0
        sigma = _sigma(z, _LOOSE if wheels is None else _LOOSE_WHEELS) + np.array([elapsed, elapsed, 0.0])
        old.append(k - 1)
        new.append(k)
        between.append(z)
        roots.append(np.diag(1 / sigma))
        soft.append(False)
        if not (keys[k - 1].blind or keys[k].blind):
            z = relative(keys[k - 1].pose, keys[k].pose)
            old.append(k - 1)
            new.append(k)
            between.append(z)
            roots.append(np.diag(1 / _sigma(z, _MATCHED)))
            soft.append(True)
    for edge in graph.edges:
        off = relative(poses[edge.old], poses[edge.new]) - edge.between
        if np.hypot(*off[:2]) > _ASTRAY[0] or abs(wrapped(off[2])) > _ASTRAY[1]:
            continue
        values, vectors = np.linalg.eigh(edge.information)
        old.append(edge.old)
        new.append(edge.new)
        between.append(edge.between)
        roots.append(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
        soft.append(True)
    return np.array(old), np.array(new), np.array(between), np.array(roots), np.array(soft)


def _sigma(step: np.ndarray, loose: tuple[float, float, float, float]) -> np.ndarray:
    """Standard deviation of a step (3,) by its length and its turn [m, m, rad]."""
    floor, share, floor_yaw, share_yaw = loose
    along = floor + share * np.hypot(*step[:2])
    return np.array([along, along, floor_yaw + share_yaw * abs(wrapped(step[2]))])


def even_drive(graph: Graph) -> np.ndarray:
    """(T, 5) middle keyframe, time before and after it [s], turn on the way [rad] and how much the velocity in the
    robot's own frame may change [m/s], where a scan is blind and no wheels measure.

    How much it does change is learnt where scans tell: some robots drive evenly, some do not.
    """
    keys = graph.keyframes
    if len(keys) < 3:
        return np.zeros((0, 5))
    stamp = np.array([key.stamp for key in keys]) / 1e9
    pose = np.array([key.pose for key in keys])
    open_way = np.array([key.broken or key.wheels is not None for key in keys])
    blind = np.array([key.blind for key in keys])
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
