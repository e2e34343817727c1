"""A sparse least-squares problem put together row block by row block, and its minimum (float64, host).

Only the normal equations are kept: a run of hours has many times as many rows as they have entries.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from uwbslam_jax import process

_BLOCK = 2048
"""So many rows are put together at a time."""
_LARGE = 500_000
"""Entries of normal equations that take memory worth the milliseconds of handing it back: some 3000 keyframes."""


@runtime_checkable
class Sink(Protocol):
    """What takes rows."""

    def add(self, residual: np.ndarray, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        """Residuals (R,) and, for each unknown that they depend on, its column (R,) and derivative (R,)."""
        ...


class Cost:
    """Half the sum of the squared residuals; derivatives are let go. cost: so far."""

    def __init__(self) -> None:
        self.cost = 0.0

    def add(self, residual: np.ndarray, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        self.cost += 0.5 * float(np.sum(residual**2))


class Normal(NamedTuple):
    """Normal equations of U unknowns in order of rank: A (U, U) symmetric, b (U,); A @ step = b leads to x - step."""

    A: sparse.csr_array
    b: np.ndarray


class Rows:
    """Rows gathered to normal equations, whose unknowns are in the order of their ranks (U,)."""

    def __init__(self, rank: np.ndarray):
        self._rank = rank.astype(np.int32)
        self._b = np.zeros(len(rank))
        self._sums: list[sparse.csr_array] = []

    def add(self, residual: np.ndarray, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        columns, values = zip(*parts, strict=True)
        index, value = self._rank[np.stack(columns, axis=1)], np.stack(values, axis=1)
        begin = np.arange(len(residual) + 1, dtype=np.int32) * index.shape[1]
        J = sparse.csr_array((value.ravel(), index.ravel(), begin), shape=(len(residual), len(self._b)))
        self._b += J.T @ residual
        product = J.T.tocsr() @ J
        product.sort_indices()
        self._sums.append(product)
        # like is added to like: each entry is copied a few times, and not once for every block
        while len(self._sums) > 1 and self._sums[-2].nnz < 2 * self._sums[-1].nnz:
            self._merge()

    def _merge(self) -> None:
        last = self._sums.pop()
        self._sums[-1] = self._sums[-1] + last

    def normal(self) -> Normal:
        """Of all rows so far."""
        while len(self._sums) > 1:
            self._merge()
        return Normal(self._sums[0], self._b)


def blocks(count: int) -> Iterator[slice]:
    """Parts of so many rows that are put together one after the other."""
    return (slice(k, min(k + _BLOCK, count)) for k in range(0, count, _BLOCK))


def elimination(i: np.ndarray, j: np.ndarray, count: int) -> np.ndarray:
    """(count,) rank of each unknown in an order that keeps the factors sparse, where rows tie some i (R,) to j (R,)."""
    tied = sparse.coo_array((np.ones(2 * len(i)), (np.append(i, j), np.append(j, i))), shape=(count, count)).tocsc()
    # SuperLU has the order of minimum degree, and tells it only with a factorisation
    return _factor(tied + (tied.sum() + 1.0) * sparse.eye_array(count, format="csc"), "MMD_AT_PLUS_A").perm_c


def _factor(A: sparse.csc_array, order: str = "NATURAL") -> SuperLU:
    """Factorisation of a symmetric positive definite matrix."""
    return splu(A, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def minimise(
    fill: Callable[[np.ndarray, Sink], None], x: np.ndarray, rank: np.ndarray, *, moves: int, enough: float
) -> tuple[np.ndarray, float]:
    """Levenberg-Marquardt from x (U,): unknowns and cost.

    Args:
      fill: puts all rows at some unknowns into a sink.
      rank: (U,) in which order the unknowns are eliminated.
      moves: so many at most. enough: a move that gains less than this is the last.
    """
    cost, damping = _cost(fill, x), 1e-6
    normal, diagonal = None, np.zeros(0)
    for _ in range(moves):
        if normal is None:
            normal = _linearised(fill, x, rank)
            diagonal = normal.A.diagonal()
        normal.A.setdiag(diagonal + damping * (diagonal + 1e-9))
        moved = x - _factor(normal.A.T).solve(normal.b)[rank]
        new_cost = _cost(fill, moved)
        if new_cost < cost:
            gain, x, cost, normal = cost - new_cost, moved, new_cost, None
            damping = max(damping / 10, 1e-12)
            if gain < enough:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return x, cost


def covariance(
    fill: Callable[[np.ndarray, Sink], None], x: np.ndarray, rank: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """(C, C) covariance at x (U,) of some unknowns (C,), all others free; fill and rank as in `minimise`."""
    A = _linearised(fill, x, rank).A
    A.setdiag(A.diagonal() + 1e-9)
    unit = np.zeros((len(x), len(columns)))
    unit[rank[columns], np.arange(len(columns))] = 1.0
    return _factor(A.T).solve(unit)[rank[columns]]


def _cost(fill: Callable[[np.ndarray, Sink], None], x: np.ndarray) -> float:
    sink = Cost()
    fill(x, sink)
    return sink.cost


def _linearised(fill: Callable[[np.ndarray, Sink], None], x: np.ndarray, rank: np.ndarray) -> Normal:
    rows = Rows(rank)
    fill(x, rows)
    normal = rows.normal()
    if normal.A.nnz > _LARGE:  # the sums on the way left holes of twice its size, and a factorisation is still to come
        process.give_back()
    return normal
