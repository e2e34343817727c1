"""SE(2) on the host in float64: poses (..., 3) of x, y, heading [m, m, rad]."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

Angle = TypeVar("Angle", float, np.ndarray)


def turned(theta: np.ndarray | np.floating | float, xy: np.ndarray) -> np.ndarray:
    """Vectors (..., 2) turned by angles (...) [rad]."""
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * xy[..., 0] - s * xy[..., 1], s * xy[..., 0] + c * xy[..., 1]], axis=-1)


def transformed(pose: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Points (..., 2) given in the frames of poses (..., 3), in the frame that these are given in [m]."""
    return pose[..., :2] + turned(pose[..., 2], xy)


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


def numeric_jacobian(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """(m, n) derivatives of a function (n,) -> (m,) at x, by central differences."""
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


def rotation_matrix(theta: float, size: int = 2) -> np.ndarray:
    """(size, size) rotation of the first two axes by an angle [rad]; with 3 that of a pose's covariance."""
    R = np.eye(size)
    c, s = np.cos(theta), np.sin(theta)
    R[:2, :2] = [[c, -s], [s, c]]
    return R


def rigid_fit(points: np.ndarray, onto: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """(3,) the pose with the least weighted sum of |transformed(pose, points) - onto|^2, both (n, 2) (Umeyama 1991).

    A rotation whatever the points: where a reflection fits better, this is the best rotation.
    """
    w = np.ones(len(points)) if weights is None else weights
    mean_a, mean_b = np.average(points, axis=0, weights=w), np.average(onto, axis=0, weights=w)
    # in the plane the best angle has a closed form: the direction of sum w conj(a) b as complex numbers
    a, b = points - mean_a, onto - mean_b
    along = np.sum(w * (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    theta = np.arctan2(np.sum(w * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), along)
    return np.append(mean_b - turned(theta, mean_a), theta)


def wrapped(angle: Angle) -> Angle:
    """The same angles in [-pi, pi) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
