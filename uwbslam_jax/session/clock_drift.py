"""A clock that runs faster or slower than the others', found by how the difference to the log time grows."""

from __future__ import annotations

_EVERY_NS = 500_000_000
"""The difference is looked at so often [ns]."""
_LEAST, _LAG_NS, _MOST = 1e-4, 40_000_000, 0.05
"""A clock drifts where it runs so much too fast at least, and is off by so much; beyond the last it is no drift [ratio,
ns, ratio]."""
_FEWEST, _EVEN = 14, 0.2
"""So many looks have to lie on a line, each to this share of what the clock is off by [looks, ratio]: a queue that
grows, or a computer that stalls, draws none."""
_KEPT = 64
"""Looks that are kept; then every other one goes."""


class ClockDrift:
    """The drift of one topic's clock against the one that all are put on.

    Attributes:
      rate: how much too fast it runs, 0 while nothing tells [ratio].
    """

    def __init__(self) -> None:
        self.rate = 0.0
        self._first = self._from = self._base = self._next = self._every = 0
        self._looks: list[tuple[int, int]] = []  # time since the first and how far ahead it is by then [ns]

    def even(self, stamp: int) -> int:
        """A stamp of this clock as a clock without the drift tells it [ns]."""
        return stamp - self._ahead(stamp) if self.rate else stamp

    def _ahead(self, stamp: int) -> int:
        return round(self.rate * (stamp - self._first))

    def look(self, first: int, stamp: int, lag: int) -> int:
        """Takes in how far ahead of the others the clock is, with what is known of its drift taken off; by how much
        its evened stamps are different from now on [ns].

        Args:
          first: its first stamp [ns], when it was right. stamp: the last one. lag: beyond a constant [ns].
        """
        if not self._from:
            self._first, self._from, self._base, self._every = first, stamp, lag, _EVERY_NS
        if stamp < self._next:
            return 0
        before = self._ahead(stamp)
        self._next = stamp + self._every
        self._looks.append((stamp - self._from, lag - self._base + before))
        if len(self._looks) > _KEPT:
            self._looks, self._every = self._looks[::2], 2 * self._every
        self._solve()
        return before - self._ahead(stamp)

    def _solve(self) -> None:
        last = abs(self._looks[-1][1])
        if len(self._looks) < _FEWEST or last < _LAG_NS:
            return
        rate = sum(t * ahead for t, ahead in self._looks) / sum(t * t for t, _ in self._looks)
        straight = all(abs(ahead - rate * t) < _EVEN * last for t, ahead in self._looks)
        self.rate = rate if straight and _LEAST <= abs(rate) <= _MOST else 0.0
