"""Sweeps that a driver sends in parts, one message each, put together: a part alone sees too little to be matched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from uwbslam_jax.measurements import ScanMessage

_TURN = 2 * math.pi
"""[rad]."""
_NEXT, _ALIKE = 2.5, 0.05
"""A part begins within so many increments of where the one before ended, with an increment that is alike to this share
[increments, ratio]."""
_MOST_OF_A_TURN, _FULL = 0.75, 1.02
"""A scan of more than the first share of a turn is no part; parts are together no more than the second [ratio]."""
_OFTEN = 0.4
"""Where so many of the scans go on from the one before, they are parts [ratio]: of two parts every second one does."""
_LONGEST_S = 1.0
"""From one part to the next it takes no longer [s]."""


def goes_on(part: ScanMessage, after: ScanMessage) -> bool:
    """Whether a scan is the next part of the sweep that another one is a part of."""
    step, size = part.angle_increment, part.ranges.size
    if size < 2 or after.ranges.size < 2 or abs(step) * size > _MOST_OF_A_TURN * _TURN:
        return False
    if abs(after.angle_increment - step) > _ALIKE * abs(step) or min(part.time_increment, after.time_increment) < 0:
        return False
    apart = math.remainder(after.angle_min - part.angle_min - step * size, _TURN)
    return abs(apart) <= _NEXT * abs(step) and 0 <= after.stamp - part.stamp <= _LONGEST_S * 1e9


def in_parts(scans: Sequence[ScanMessage]) -> bool:
    """Whether the messages of a scanner, in order, are parts of sweeps."""
    following = [goes_on(a, b) for a, b in pairwise(scans)]
    return len(following) > 2 and sum(following) >= _OFTEN * len(following)


class SweepJoiner:
    """Puts parts together: a sweep is over with its turn, or with a part that does not go on from the last."""

    def __init__(self) -> None:
        self._parts: list[ScanMessage] = []

    def take(self, part: ScanMessage) -> list[ScanMessage]:
        """The sweeps that a part completes: none or one."""
        over: list[ScanMessage] = []
        if self._parts and part.stamp < self._parts[-1].stamp:
            self._parts.clear()  # the recording is read again
        elif self._parts and not (goes_on(self._parts[-1], part) and self._span(part) <= _FULL * _TURN):
            over = self._over()
        self._parts.append(part)
        return over or (self._over() if self._span(part) > _FULL * _TURN else [])

    def _span(self, more: ScanMessage) -> float:
        """Of what is there, and of one more part [rad]."""
        return sum(abs(p.angle_increment) * p.ranges.size for p in [*self._parts, more])

    def _over(self) -> list[ScanMessage]:
        parts, self._parts = self._parts, []
        if len(parts) < 2:
            return parts
        first, sizes = parts[0], [part.ranges.size for part in parts]
        step = sum(part.angle_increment * size for part, size in zip(parts, sizes, strict=True)) / sum(sizes)
        took = (parts[-1].stamp - first.stamp) / 1e9 / sum(sizes[:-1])  # parts of one stamp have the sweep's
        ranges = np.concatenate([part.ranges for part in parts])
        limits = first.range_min, first.range_max
        return [ScanMessage(first.stamp, first.angle_min, step, took or first.time_increment, *limits, ranges)]
