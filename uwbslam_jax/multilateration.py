"""One node from ranges to known points: its best place, the second best, whether the best is certain (float64)."""

from __future__ import annotations

import numpy as np

_SOFT = 4.0
"""Whitened residual at which a range's influence starts to fall (Geman-McClure)."""
RANGE_FLOOR_M = 0.02
"""However many ranges are averaged, their mean is not better than this."""
DECIDED = 15.0
"""Difference of log-likelihood that decides between two explanations."""
SIGMA_ENOUGH_M = 0.15
"""A beacon enters when its position is known this well among the others."""


def multilaterate(anchors: np.ndarray, distance: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The best and the second-best place of one node, from ranges to known points; the same place twice where there
    is no second.

    Args:
      anchors: (R, 2) [m]; distance, sigma: (R,) [m].
    """
    first = np.argmin(sigma)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    spots = anchors[first] + distance[first] * np.stack([np.cos(angle), np.sin(angle)], -1)
    cost = np.zeros(len(spots))
    for _ in range(12):  # Gauss-Newton from every start at once
        u = spots[:, None] - anchors
        d = np.maximum(np.linalg.norm(u, axis=2), 1e-6)
        r, scale = soften((d - distance) / sigma)
        J = (scale / sigma / d)[..., None] * u
        A = np.einsum("sri,srj->sij", J, J) + 1e-3 * np.eye(2)
        move = np.linalg.solve(A, np.einsum("sri,sr->si", J, r)[..., None])[..., 0]
        spots = spots - np.clip(move, -2.0, 2.0)
        cost = 0.5 * (r**2).sum(1)
    order = np.argsort(cost)
    best = spots[order[0]]
    apart = [k for k in order if np.linalg.norm(spots[k] - best) > 0.5]
    return best, spots[apart[0]] if apart else best


def locate(anchors: np.ndarray, distance: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Place (2,) and covariance (2, 2) of a node from ranges to known points, None where they do not determine it.

    Args:
      anchors: (R, 2) [m]; distance, sigma: (R,) [m].
    """
    best, second = multilaterate(anchors, distance, sigma)
    cost, cov = _fit(best, anchors, distance, sigma)
    if np.sqrt(np.linalg.eigvalsh(cov)[-1]) > SIGMA_ENOUGH_M:
        return None
    other, _ = _fit(second, anchors, distance, sigma)
    if np.linalg.norm(second - best) > 0.3 and other - cost < DECIDED:
        return None
    residual = np.linalg.norm(anchors - best, axis=1) - distance
    if np.median(np.abs(residual)) > 3 * np.median(sigma):
        return None  # still being carried: no one place explains the ranges
    return best, cov + RANGE_FLOOR_M**2 * np.eye(2)


def _fit(spot: np.ndarray, anchors: np.ndarray, distance: np.ndarray, sigma: np.ndarray) -> tuple[float, np.ndarray]:
    u = spot - anchors
    d = np.maximum(np.linalg.norm(u, axis=1), 1e-6)
    r, scale = soften((d - distance) / sigma)
    J = (scale / sigma / d)[:, None] * u
    return 0.5 * float(r @ r), np.linalg.inv(J.T @ J + 1e-6 * np.eye(2))


def soften(whitened: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual whose half square is the Geman-McClure loss, and its derivative."""
    inside = 1.0 + (whitened / _SOFT) ** 2
    return whitened / np.sqrt(inside), inside**-1.5
