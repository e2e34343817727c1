"""Log times that are no order: messages that came over a slow network or out of a queue, up to seconds late.

Where the differences of stamps and log times go to and fro, it is the log that is wrong, and the stamps are the order.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import count, pairwise
from statistics import median_low
from typing import NamedTuple

from uwbslam_jax.measurements import Message

_LATE_NS, _STEP_NS = 400_000_000, 50_000_000
"""Messages late by less are in no doubt [ns]; smaller steps from one to the next are a computer's usual delays [ns]."""
_FRO, _SPARED = 3.0, 0.05
"""The lateness goes to and fro where its steps are together so many times what nine tenths of it lie in: a clock that
is set steps once [ratio]. So much at both ends is left out [ratio]."""
_FEW = 10
"""Fewer messages of a topic tell nothing [messages]."""
_MORE, _MOST_NS = 1.5, 6_000_000_000
"""It is waited for what is later by so many times what was seen [ratio], but no longer [ns]."""
_SAME_NS = 1_000_000_000
"""Topics whose usual lateness differs by less are on one clock [ns]."""

Times = Sequence[tuple[int, int]]
"""Stamps and log times of a topic's messages in the order of the log [ns]."""
Logged = tuple[Message, int, str]
"""A message with its log time [ns] and topic."""


class Lateness(NamedTuple):
    """How messages come late: how long is to be waited, the usual difference of stamp and log time by topic [ns]."""

    wait: int
    usual: dict[str, int]


def lateness(seen: Mapping[str, Times]) -> Lateness | None:
    """What the first messages tell, by topic; None where the log is an order."""
    waits = [wait for times in seen.values() if (wait := _to_and_fro([stamp - log for stamp, log in times]))]
    if not waits:
        return None
    usual = {topic: median_low([stamp - log for stamp, log in times]) for topic, times in seen.items() if times}
    return Lateness(min(round(_MORE * max(waits)), _MOST_NS), usual)


def told(late: Lateness) -> str:
    """What a user should know."""
    return (
        f"messages were logged up to {late.wait / _MORE / 1e9:.1f} s late and out of order: they are taken in the "
        "order of their stamps; did they come over a network that stalls?"
    )


def _to_and_fro(offsets: list[int]) -> int:
    """What differences of stamp and log time lie in [ns]; 0 where they do not go to and fro."""
    ordered, cut = sorted(offsets), round(_SPARED * len(offsets))
    if len(offsets) < _FEW:
        return 0
    spread = ordered[-1 - cut] - ordered[cut]
    steps = sum(abs(b - a) for a, b in pairwise(offsets) if abs(b - a) > _STEP_NS)
    return ordered[-1] - ordered[0] if spread > _LATE_NS and steps > _FRO * spread else 0


def in_order(logged: Iterable[Logged], late: Lateness | None) -> Iterator[Logged]:
    """Messages as the log has them, or where that is no order, in the order of their stamps."""
    if late is None:
        yield from logged
        return
    order = _StampOrder(late)
    for message, log_time, topic in logged:
        yield from order.take(message, log_time, topic)
    yield from order.flush()


class _StampOrder:
    """Puts messages into the order of their stamps, with log times that go with these."""

    def __init__(self, late: Lateness):
        self._late = late
        self._common = next(iter(late.usual.values()), 0)
        self._held: list[tuple[int, int, Logged]] = []
        self._number = count()

    def take(self, message: Message, log_time: int, topic: str) -> Iterator[Logged]:
        """What need not wait for a later message any more."""
        usual = self._late.usual.get(topic, self._common)
        apart = usual - self._common
        log = message.stamp - self._common - (apart if abs(apart) > _SAME_NS else 0) if message.stamp > 0 else log_time
        heapq.heappush(self._held, (log, next(self._number), (message, log, topic)))
        while self._held and self._held[0][0] < log_time - self._late.wait:
            yield heapq.heappop(self._held)[2]

    def flush(self) -> Iterator[Logged]:
        """The rest."""
        while self._held:
            yield heapq.heappop(self._held)[2]
