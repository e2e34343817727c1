"""SE(2) on the host in float64: poses (..., 3) of x, y, heading [m, m, rad]."""

from __future__ import annotations

import numpy as np


def turned(theta: np.ndarray | np.floating | float, xy: np.ndarray) -> np.ndarray:
    """Vectors (..., 2) turned by angles (...) [rad]."""
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * xy[..., 0] - s * xy[..., 1], s * xy[..., 0] + c * xy[..., 1]], axis=-1)


def carried_along(
    stamps: np.ndarray, poses: np.ndarray, anchors: np.ndarray, before: np.ndarray, after: np.ndarray
) -> np.ndarray:
    """Poses (T, 3) taken at stamps (T,) [ns] of a track whose keyframes, at anchors (N,) [ns], have moved from before
    (N, 3) to after (N, 3): each with the keyframes before and after it."""
    last = len(anchors) - 1
    at = np.clip(np.searchsorted(anchors, stamps, side="right") - 1, 0, last)
    next_one = np.minimum(at + 1, last)
    span = np.maximum(anchors[next_one] - anchors[at], 1)
    share = np.clip((stamps - anchors[at]) / span, 0.0, 1.0)[:, None]
    ends = [compose(after[k], between(before[k], poses)) for k in (at, next_one)]
    return (1 - share) * ends[0] + share * ends[1]


def numeric_jacobian(function, x: np.ndarray) -> np.ndarray:
    h = 1e-6
    columns = [(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    return np.stack(columns, axis=1)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses (..., 3) given in the frames of poses a, as se2.compose; headings are not wrapped."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, a[..., 2] + b[..., 2]], axis=-1)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses b in the frames of poses a, both (..., 3), as se2.between; headings are not wrapped."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, b[..., 2] - a[..., 2]], axis=-1)


def rotation_matrix(theta: float) -> np.ndarray:
    """(2, 2) rotation by an angle [rad]."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def wrapped(angle):
    """The same angles in [-pi, pi) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
