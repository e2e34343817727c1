"""Whether the stamps of a recording's topics pass as its log times do: whole seconds, other units, counters do not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

_LEAST_NS, _PARTS = 500_000_000, 3
"""Over less log time nothing is told [ns]; over each of so many parts a topic's stamps have to pass alike [parts]."""
_ALIKE, _APART = 2.0, 5.0
"""Rates within the first factor are the same; one that is further than the second from all is none of a clock's."""
_SMALL_NS, _FEW = 1_000_000, 20
"""Fractions of a second that are all smaller [ns], of so many messages at least, are no nanoseconds."""
_UNITS = [10.0**k for k in (-9, -6, -3, 3, 6, 9)]
"""Rates of stamps in other units of time [ratio]."""


def stamp_rates(seen: Mapping[str, Sequence[tuple[int, int]]]) -> dict[str, float]:
    """Topics whose stamps tell no time, and how many times as fast as the log's they pass, 0 for whole seconds.

    Where no topic keeps pace with the log, it is the log that was written later: then only other units are told.

    Args:
      seen: stamps and log times of the first messages by topic [ns].
    """
    rates = {topic: rate for topic, times in seen.items() if (rate := _rate(times)) is not None}
    whole = {topic: 0.0 for topic, times in seen.items() if _whole_seconds([stamp for stamp, _ in times])}
    kept = any(1 / _ALIKE < rate < _ALIKE for rate in rates.values())
    wrong = {topic: rate for topic, rate in rates.items() if not 1 / _APART < rate < _APART}
    return {t: rate for t, rate in wrong.items() if kept or any(_alike(rate, unit) for unit in _UNITS)} | whole


def _rate(times: Sequence[tuple[int, int]]) -> float | None:
    """How many times as fast stamps pass as log times [ns] do; None where too few tell, or they do not pass evenly."""
    at = [times[k * (len(times) - 1) // _PARTS] for k in range(_PARTS + 1)] if times else []
    parts = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(at)]
    stamped, logged = (sum(part[k] for part in parts) for k in range(2))
    if logged < _LEAST_NS or not all(step > 0 and log > 0 for step, log in parts):
        return None
    rate = stamped / logged
    return rate if all(_alike(step / log, rate) for step, log in parts) else None


def _whole_seconds(stamps: list[int]) -> bool:
    """Whether all stamps are whole seconds, of several messages a second, or hardly more: then their field of
    nanoseconds counts microseconds or milliseconds."""
    seconds = len({stamp // 1_000_000_000 for stamp in stamps})
    most = 1 if len(stamps) < _FEW else _SMALL_NS
    return seconds > 1 and len(stamps) > 2 * seconds and all(stamp % 1_000_000_000 < most for stamp in stamps)


def _alike(a: float, b: float) -> bool:
    return abs(math.log(a / b)) < math.log(_ALIKE)
