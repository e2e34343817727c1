"""A sparse least-squares problem put together row block by row block, and its minimum (float64, host).

Only the normal equations are kept: a run of hours has many times as many rows as they have entries. Of few unknowns
they are dense: what is known of their sparsity would cost more than it saves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from uwbslam_jax import process

_BLOCK = 2048
"""So many rows are put together at a time."""
_FEW = 300
"""Up to so many unknowns the normal equations are dense."""
_RIDGE = 1e-6
"""Share of the diagonal [1], and prior information [1/unit^2], that make singular equations solvable: a kilometre."""
_LARGE = 500_000
"""Entries of normal equations that take memory worth the milliseconds of handing it back: some 3000 keyframes."""


class SingularError(ArithmeticError):
    """Normal equations that have no solution."""


@runtime_checkable
class Sink(Protocol):
    """What takes rows."""

    def add(self, residual: np.ndarray, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        """Residuals (R,) and, for each unknown that they depend on, its column (R,) and derivative (R,)."""
        ...


Fill = Callable[[np.ndarray, Sink], None]
"""Puts all rows at some unknowns into a sink."""


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

    def diagonal(self) -> np.ndarray:
        """(U,) of A."""
        return self.A.diagonal()

    def solved(self, diagonal: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Solution for b (U,) or (U, C) with another diagonal (U,); A has it from then on. Raises SingularError."""
        self.A.setdiag(diagonal)
        return _factor(self.A.T).solve(b)


class Dense:
    """The same of few unknowns. cost: half the sum of the squared residuals."""

    def __init__(self, rank: np.ndarray):
        self._rank, self.cost = rank, 0.0
        self._J, self._r = [np.zeros((0, len(rank)))], [np.zeros(0)]

    def add(self, residual: np.ndarray, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        rows, J = np.arange(len(residual)), np.zeros((len(residual), len(self._rank)))
        for column, value in parts:
            J[rows, self._rank[column]] += value
        self.cost += 0.5 * float(residual @ residual)
        self._J.append(J)
        self._r.append(residual)

    @cached_property
    def A(self) -> np.ndarray:
        """(U, U)."""
        J = np.concatenate(self._J)
        return J.T @ J

    @property
    def b(self) -> np.ndarray:
        """(U,)."""
        return np.concatenate(self._J).T @ np.concatenate(self._r)

    def diagonal(self) -> np.ndarray:
        """(U,) of A."""
        return self.A.diagonal().copy()

    def solved(self, diagonal: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Solution for b (U,) or (U, C) with another diagonal (U,); A has it from then on. Raises SingularError."""
        np.fill_diagonal(self.A, diagonal)
        try:
            return np.linalg.solve(self.A, b)
        except np.linalg.LinAlgError as error:
            raise SingularError(str(error)) from None


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
    """Factorisation of a symmetric positive definite matrix. Raises SingularError."""
    try:
        return splu(A, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:
        raise SingularError(str(error)) from None


def minimise(
    fill: Fill, x: np.ndarray, rank: np.ndarray, *, moves: int, enough: float, damping: float = 1e-6
) -> tuple[np.ndarray, float]:
    """Levenberg-Marquardt from x (U,): unknowns and cost.

    Args:
      rank: (U,) in which order the unknowns are eliminated.
      moves: so many at most. enough: a move that gains less than this is the last.
      damping: of the first move, as a share of the diagonal: far from the minimum a large one keeps to the valley.
    """
    cost, normal = _costed(fill, x, rank)
    diagonal = None
    for _ in range(moves):
        normal = normal or _linearised(fill, x, rank)
        diagonal = normal.diagonal() if diagonal is None else diagonal
        try:
            moved = x - normal.solved(diagonal + damping * (diagonal + 1e-9), normal.b)[rank]
            new_cost, there = _costed(fill, moved, rank)
        except SingularError:  # what is not tied to anything stays, and with more damping the rest is solved
            moved, new_cost, there = x, np.inf, None
        if new_cost < cost:
            gain, x, cost, normal, diagonal = cost - new_cost, moved, new_cost, there, None
            damping = max(damping / 10, 1e-12)
            if gain < enough:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return x, cost


def covariance(fill: Fill, x: np.ndarray, rank: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(C, C) covariance at x (U,) of some unknowns (C,), all others free; fill and rank as in `minimise`.

    Raises:
      SingularError: there is none, even where the unknowns are known a little beforehand.
    """
    normal = _linearised(fill, x, rank)
    unit = np.zeros((len(x), len(columns)))
    unit[rank[columns], np.arange(len(columns))] = 1.0
    diagonal = normal.diagonal()
    try:
        return normal.solved(diagonal + 1e-9, unit)[rank[columns]]
    except SingularError:
        return normal.solved(diagonal * (1.0 + _RIDGE) + _RIDGE, unit)[rank[columns]]


def cost_of(fill: Fill, x: np.ndarray) -> float:
    """Half the sum of the squared residuals at x (U,)."""
    sink = Cost()
    fill(x, sink)
    return sink.cost


def _costed(fill: Fill, x: np.ndarray, rank: np.ndarray) -> tuple[float, Dense | None]:
    """The cost at x, with the normal equations where these are as quickly had."""
    if len(x) > _FEW:
        return cost_of(fill, x), None
    rows = Dense(rank)
    fill(x, rows)
    return rows.cost, rows


def _linearised(fill: Fill, x: np.ndarray, rank: np.ndarray) -> Normal | Dense:
    if len(x) <= _FEW:
        few = Dense(rank)
        fill(x, few)
        return few
    rows = Rows(rank)
    fill(x, rows)
    normal = rows.normal()
    if normal.A.nnz > _LARGE:  # the sums on the way left holes of twice its size, and a factorisation is still to come
        process.give_back()
    return normal
