"""Rows that are appended one at a time while a run goes on, kept as compactly as an array can.

A run of hours keeps millions of small things; as objects of their own they would take ten times the room, and leave
the heap in pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_LEAST = 64
"""Rows of an empty array: a short run does not grow it often."""
_GROWTH = 1.25
"""Less than twice: what a run of hours keeps is copied a few times more often, but little room stands empty."""


class Column:
    """Rows of one shape or one structured type, in one array that grows by a share of itself when it is full."""

    def __init__(self, shape: tuple[int, ...] = (), dtype: np.typing.DTypeLike = np.float32):
        self._rows = np.empty((_LEAST, *shape), dtype)
        self._count = 0

    def append(self, row: Any) -> None:
        """One more row at the end; a tuple where the type is structured."""
        self.extend([row])

    def extend(self, rows: Sequence[Any] | np.ndarray) -> None:
        """Some more rows at the end."""
        count = self._count + len(rows)
        if count > len(self._rows):
            # what is not written to yet takes no memory of the system
            room = max(_LEAST, round(_GROWTH * count))
            longer = np.empty((room, *self._rows.shape[1:]), self._rows.dtype)
            longer[: self._count] = self.values
            self._rows = longer
        self._rows[self._count : count] = rows
        self._count = count

    def keep(self, which: np.ndarray) -> None:
        """Leave out all rows but those of a mask (n,)."""
        self._rows = self.values[which]
        self._count = len(self._rows)

    def copy(self) -> Column:
        """The rows there are now; what happens to these later does not change them."""
        other = Column(self._rows.shape[1:], self._rows.dtype)
        other._rows, other._count = self.values.copy(), self._count
        return other

    @property
    def values(self) -> np.ndarray:
        """All rows so far, a view."""
        return self._rows[: self._count]

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        return self.values[index]

    def __array__(self, dtype: np.typing.DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype)
