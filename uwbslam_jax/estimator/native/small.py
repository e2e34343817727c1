"""Angles, and matrices of 3 x 3 in float64. Twin: numerics (se2, gaussian)."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from uwbslam_jax.estimator.native.loops import loops


@loops
def wrap_angle(angle: float) -> float:
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


@loops
def product(A: Float[ndarray, "3 3"], B: Float[ndarray, "3 3"]) -> Float[ndarray, "3 3"]:
    """Of the upper left 3 x 3 of larger ones."""
    C = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C


@loops
def times(A: Float[ndarray, "3 3"], x: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
    y = np.empty(3)
    for i in range(3):
        y[i] = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2]
    return y


@loops
def inverse3(A: Float[ndarray, "3 3"], add: float) -> Float[ndarray, "3 3"]:
    """Of A + add times the identity, by cofactors."""
    a, b, c = A[0, 0] + add, A[0, 1], A[0, 2]
    d, e, f = A[1, 0], A[1, 1] + add, A[1, 2]
    g, h, i = A[2, 0], A[2, 1], A[2, 2] + add
    p, q, r, R = e * i - f * h, f * g - d * i, d * h - e * g, np.empty((3, 3))
    det = a * p + b * q + c * r
    R[0, 0], R[0, 1], R[0, 2] = p / det, (c * h - b * i) / det, (b * f - c * e) / det
    R[1, 0], R[1, 1], R[1, 2] = q / det, (a * i - c * g) / det, (c * d - a * f) / det
    R[2, 0], R[2, 1], R[2, 2] = r / det, (b * g - a * h) / det, (a * e - b * d) / det
    return R


@loops
def solve3(A: Float[ndarray, "3 3"], b: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
    """By the Cholesky factor of a symmetric A; NaN where A is not positive definite."""
    l00 = math.sqrt(A[0, 0])
    l10, l20 = A[1, 0] / l00, A[2, 0] / l00
    l11 = math.sqrt(A[1, 1] - l10 * l10)
    l21 = (A[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(A[2, 2] - l20 * l20 - l21 * l21)
    x = np.empty(3)
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    x[2] = (b[2] - l20 * y0 - l21 * y1) / l22 / l22
    x[1] = (y1 - l21 * x[2]) / l11
    x[0] = (y0 - l10 * x[1] - l20 * x[2]) / l00
    return x
