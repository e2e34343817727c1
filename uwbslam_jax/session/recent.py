"""What was heard in the last seconds, to tell a copy from a measurement whose stamp goes back."""

from __future__ import annotations

from collections.abc import Hashable

_MEMORY_NS = 5_000_000_000
"""Measurements are remembered for so long at least [ns]: a copy from another topic or computer comes sooner."""


class Recent:
    """Remembers measurements by what they are of and their stamps."""

    def __init__(self) -> None:
        self._new: set[tuple[Hashable, int]] = set()
        self._old: set[tuple[Hashable, int]] = set()
        self._since = 0

    def add(self, of: Hashable, stamp: int) -> None:
        """Takes in a measurement [ns]."""
        if stamp - self._since > _MEMORY_NS:
            self._old, self._new, self._since = self._new, set(), stamp
        self._new.add((of, stamp))

    def has(self, of: Hashable, stamp: int) -> bool:
        """Whether one of the same was taken in."""
        return (of, stamp) in self._new or (of, stamp) in self._old
