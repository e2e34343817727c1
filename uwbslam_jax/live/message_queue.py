"""Messages of several devices on their way to the estimator: one bounded queue, in the order of their arrival.

A loop that falls behind loses old scans, never new ones, and every loss is counted. What is handed out and what is
dropped goes to a recorder, each with a time of its own that keeps the order.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

from uwbslam_jax.measurements import Message, ScanMessage
from uwbslam_jax.reasons import ScanLost

BEHIND_S = 0.7
"""Once a scan has waited for so long, only the newest one is taken until the loop has caught up [s]."""
MOST = 4096
"""Messages that wait [messages], several seconds of all devices; more are dropped, the oldest first."""
OVERTAKEN, OVERFULL = ScanLost.OVERTAKEN, "message: the queue is full"
"""Reasons of a loss in `Inbox.dropped` [text]; of which sensor, only the first knows."""


class Arrival(NamedTuple):
    """A message, when it arrived [ns], and the time that it is recorded with: the same, but no two are equal [ns]."""

    message: Message
    received: int
    log_time: int


class Inbox:
    """The queue. Any thread may put, one takes.

    Ranges are recorded when they arrive, scans when it is known whether they are used.

    Attributes:
      dropped: what was not handed out, by reason.
    """

    def __init__(self, record: Callable[[Arrival, bool], object]):
        """record: takes each message and whether the estimator never sees it; must return at once."""
        self.dropped: Counter[str] = Counter()
        self._record = record
        self._queue: deque[Arrival] = deque()
        self._changed = threading.Condition()
        self._scans = 0  # of the queue
        self._last = 0
        self._behind = False

    def put(self, message: Message, received: int) -> None:
        """Takes in a message that arrived at a host time [ns]."""
        with self._changed:
            self._last = max(received, self._last + 1)
            arrival = Arrival(message, received, self._last)
            if not isinstance(message, ScanMessage):
                self._record(arrival, False)
            if len(self._queue) == MOST:
                self._drop(self._queue.popleft(), OVERFULL)
            self._queue.append(arrival)
            self._scans += isinstance(message, ScanMessage)
            self._changed.notify()

    def take(self, now: int, timeout: float) -> Arrival | None:
        """The next message at a host time [ns], None where none comes within a time [s]."""
        with self._changed:
            if not self._queue:
                self._behind = False
                self._changed.wait(timeout)
            self._thin(now)
            if not self._queue:
                return None
            arrival = self._queue.popleft()
            if isinstance(arrival.message, ScanMessage):
                self._scans -= 1
                self._record(arrival, False)
            return arrival

    def thin(self, now: int) -> None:
        """Drops the scans that a loop which is behind will not use, so that they are recorded even while it hangs."""
        with self._changed:
            self._thin(now)

    def _thin(self, now: int) -> None:
        if not self._scans:
            return
        scans = [arrival for arrival in self._queue if isinstance(arrival.message, ScanMessage)]
        if now - scans[0].received > BEHIND_S * 1e9:
            self._behind = True
        if self._behind and len(scans) > 1:
            newest = scans.pop()
            self._queue = deque(a for a in self._queue if a is newest or not isinstance(a.message, ScanMessage))
            for arrival in scans:
                self._drop(arrival, OVERTAKEN)

    def _drop(self, arrival: Arrival, why: str) -> None:
        self.dropped[why] += 1
        if isinstance(arrival.message, ScanMessage):
            self._scans -= 1
            self._record(arrival, True)
