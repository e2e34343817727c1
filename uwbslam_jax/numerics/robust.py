"""Robust weights of range residuals, and the thresholds by which they decide (host, float64)."""

from __future__ import annotations

import numpy as np

_QUIET = 1.6
"""Scatter beyond this multiple of sigma_n is no chance but a range through walls or a radio that locks early."""

CALIBRATED_M = 1e-3
"""Standard deviation of a node's bias when ranges are taken to be calibrated [m]."""

_SOFT = 4.0
"""Whitened residual at which a range's influence starts to fall (Geman-McClure)."""
RANGE_FLOOR_M = 0.02
"""However many ranges are averaged, their mean is not better than this."""
DECIDED = 15.0
"""Difference of log-likelihood that decides between two explanations."""
SIGMA_ENOUGH_M = 0.15
"""A beacon enters when its position is known this well among the others."""


def misfit(spot: np.ndarray, anchors: np.ndarray, distance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(R,) negative log-likelihood (Geman-McClure) of each range, from places (2,) or (R, 2) [m]."""
    r, _ = soften((np.linalg.norm(spot - anchors, axis=1) - distance) / sigma)
    return 0.5 * r**2


def soften(whitened: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual whose half square is the Geman-McClure loss, and its derivative."""
    inside = 1.0 + (whitened / _SOFT) ** 2
    return whitened / np.sqrt(inside), inside**-1.5


def largest_sigma(cov: np.ndarray) -> np.ndarray:
    """(B,) largest standard deviation of each of B points with joint covariance (2 B, 2 B)."""
    blocks = [cov[2 * b : 2 * b + 2, 2 * b : 2 * b + 2] for b in range(len(cov) // 2)]
    return np.array([np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0)) for block in blocks])


def mean_sigma(count: float, scatter: float, sigma_n: float) -> float:
    """Standard deviation of a mean of `count` ranges; where they scatter more than the radio does, what makes them
    scatter does not average out."""
    excess = max(scatter**2 - (_QUIET * sigma_n) ** 2, 0.0)
    return float(np.sqrt(sigma_n**2 / max(count, 1.0) + RANGE_FLOOR_M**2 + excess))
