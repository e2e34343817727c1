"""A sparse least-squares problem put together row block by row block, and its factorisation (float64, host)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu


class Rows:
    """A sparse Jacobian put together row block by row block."""

    def __init__(self, columns: int):
        self._columns, self._count = columns, 0
        self._row: list[np.ndarray] = []
        self._column: list[np.ndarray] = []
        self._value: list[np.ndarray] = []
        self._residual: list[np.ndarray] = []

    def add(self, residual: np.ndarray, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        """Residuals (R,) and, for each unknown that they depend on, its column (R,) and derivative (R,)."""
        residual = np.ravel(residual)
        row = self._count + np.arange(len(residual))
        for column, value in parts:
            self._row.append(row)
            self._column.append(column)
            self._value.append(value)
        self._residual.append(residual)
        self._count += len(residual)

    def matrix(self) -> sparse.csr_matrix:
        at = np.concatenate(self._row), np.concatenate(self._column)
        return sparse.csr_matrix((np.concatenate(self._value), at), shape=(self._count, self._columns))

    def residuals(self) -> np.ndarray:
        return np.concatenate(self._residual)


def factor(A: sparse.csc_matrix) -> SuperLU:
    """Factorisation of a symmetric positive definite matrix."""
    # symmetric: the order that keeps poses a band, and beacons, which every pose hangs on, last
    return splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
