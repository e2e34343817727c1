"""Rows of numbers that grow one by one, in one array: a list of small arrays takes ten times the memory."""

from __future__ import annotations

from typing import Any

import numpy as np

_ROOM = 1.25


class Column:
    """A growing array; numpy takes it for one."""

    def __init__(self, rows: Any = None, *, shape: tuple[int, ...] = (), dtype: Any = np.float32):
        """Args:
        rows: (n, *shape) to begin with.
        shape: of a row.
        """
        start = np.zeros((0, *shape), dtype) if rows is None else np.asarray(rows, dtype)
        self._length, self._kept = len(start), np.array(start)

    def append(self, row: Any) -> None:
        if self._length == len(self._kept):
            more = np.empty((max(64, int(_ROOM * self._length)), *self._kept.shape[1:]), self._kept.dtype)
            more[: self._length] = self._kept
            self._kept = more
        self._kept[self._length] = row
        self._length += 1

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, at: Any) -> Any:
        return self._kept[: self._length][at]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self._kept[: self._length], dtype, copy=copy)
