"""The recursion of the posterior Cramer-Rao bound along one true trajectory, float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Covariances(NamedTuple):
    """Least covariances (T, n, n) after every step."""

    every: np.ndarray


def recursion(P: np.ndarray, F: np.ndarray, Q: np.ndarray, information: np.ndarray) -> Covariances:
    """J(t) = (F J(t-1)^-1 F^T + Q)^-1 + H^T R^-1 H, with additive Gaussian noise (Tichavsky et al. 1998, eq. 21).

    Args:
      P: (n, n) at first. F: (T, n, n) slopes of the motion that ends at each step, at the true state after it.
      Q: (n, n). information: (T, n, n) of each step's measurements, H^T R^-1 H at the true states.
    """
    found = np.zeros_like(F)
    for t in range(len(F)):
        P = F[t] @ P @ F[t].T + Q
        # scaled by its own deviations: places and what is nearly certain differ by many powers of ten
        scale = np.sqrt(np.diag(P))
        J = np.linalg.inv(P / np.outer(scale, scale)) + information[t] * np.outer(scale, scale)
        P = np.linalg.inv(J) * np.outer(scale, scale)
        P = 0.5 * (P + P.T)
        found[t] = P
    return Covariances(found)
