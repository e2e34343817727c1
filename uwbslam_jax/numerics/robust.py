"""Robust weights of range residuals, and the thresholds by which they decide (host, float64)."""

from __future__ import annotations

import numpy as np

_QUIET = 1.6
"""Scatter beyond this multiple of sigma_n is no chance but a range through walls or a radio that locks early."""

CALIBRATED_M = 1e-3
"""Standard deviation of a node's bias when ranges are taken to be calibrated [m]."""

_SOFT = 4.0
"""Whitened residual at which a range's influence starts to fall (Geman-McClure)."""
_WINDOW = 21
"""So many ranges of a pair around one tell how much they scatter there."""
_WILD_M = 0.5
"""A range this far from the median of others at about the same time takes no part in their mean."""
_FEWEST_OF_PAIR = 5
"""So many ranges of a pair at rest tell how much they scatter."""
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


def widened(sigma: np.ndarray, loud: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Standard deviations (n,) of means, where those that are loud (n,) of one pair (n,) tell no more than one: a wall
    makes all of its ranges too long."""
    count = np.bincount(which[loud], minlength=int(which.max(initial=0)) + 1)[which]
    return sigma * np.where(loud, np.sqrt(np.maximum(count, 1)), 1.0)


def near_middle(ranges: np.ndarray) -> np.ndarray:
    """(n,) which of some ranges to one place are near their median [m]."""
    middle = np.sort(ranges)[len(ranges) // 2]  # one of them, so that at least one is near it
    return np.abs(ranges - middle) < _WILD_M


def scatter_along(ranges: np.ndarray, sigma_n: float) -> np.ndarray:
    """(n,) standard deviation of a moving pair's ranges (n,) around each of them, sigma_n of too few [m].

    From second differences: a model-free one, so that it can tell a range through walls from a place that is not yet
    right.
    """
    if len(ranges) < _WINDOW:
        return np.full(len(ranges), sigma_n)
    second = np.abs(ranges[2:] - 2 * ranges[1:-1] + ranges[:-2])
    window = np.lib.stride_tricks.sliding_window_view(second, min(_WINDOW, len(second)))
    # the median of |x| of a normal x is 0.674 sigma, and a second difference has 6 sigma^2
    sigma = np.median(window, axis=1) / (0.674 * np.sqrt(6.0))
    at = np.clip(np.arange(len(ranges)) - 1 - window.shape[1] // 2, 0, len(sigma) - 1)
    return sigma[at]


def median_range(ranges: np.ndarray, sigma_n: float) -> tuple[float, float, float]:
    """Median of ranges (n,) between two nodes at rest, its standard deviation, and theirs [m]."""
    middle = float(np.median(ranges))
    scatter = float(np.median(np.abs(ranges - middle))) / 0.674 if len(ranges) >= _FEWEST_OF_PAIR else sigma_n
    # a median of n is as good as a mean of 0.64 n
    return middle, mean_sigma(0.64 * len(ranges), scatter, sigma_n), scatter
