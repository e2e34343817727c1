"""Device clocks to host time: offset and drift of one device from what it says and when that arrives.

The difference host receive time - device time is the clocks' offset plus a delay that is never negative. Its lower
envelope therefore follows the offset whatever the delays do. The envelope is the line under all points that lies
closest to them, an edge of their lower convex hull (Moon, Skelly and Towsley, Estimation and removal of clock skew
from network delay measurements, INFOCOM 1999, section IV; Zhang, Liu and Xia 2002 for the hull).
"""

from __future__ import annotations

import time
from collections import deque

BLOCK = 1.0
"""Of each block of this length only the point with the least delay is kept, or there were thousands [s]."""
BLOCKS = 120
"""Blocks of the window: two minutes, in which a crystal's drift hardly changes [blocks]."""
LEAST_SPAN = 10.0
"""A shorter window gives no drift: delays of milliseconds would pass for one [s]."""
MOST_DRIFT = 1e-3
"""No device's clock is worse than this; crystals are within 1e-4 [s/s]."""
SOONER = 0.2
"""A device time this far ahead of the envelope is impossible: all data before would have been held up that long [s]."""
EARLY = 5e-3
"""One this far ahead of it [s] may be a damaged number that its sum did not show, and moves nothing; as many as
AGREEING in a row are the end of a delay."""
LATER = 5.0
"""Data does not wait longer than this in any buffer on its way, so a later device time is wrong [s]."""
AGREEING = 3
"""So many impossible times that agree with each other mean a restarted device; damaged ones do not [readings]."""
SETTLING = 2.0
"""The least delay is known after this time of a stream: tens of measurements, one of which was not held up [s]."""


def host_time() -> int:
    """Host time [ns since the epoch] that never steps back while the program runs."""
    return _EPOCH + time.monotonic_ns()


_EPOCH = time.time_ns() - time.monotonic_ns()
"""Epoch time of the monotonic clock's zero [ns]: read once, so that a corrected system clock steps nothing back."""


class DeviceClock:
    """The clock of one device, seen from the host.

    Attributes:
      restarts: how often the device's clock has started anew.
      drift: rate of the host's clock over the device's, less 1.
    """

    def __init__(self, wrap: int | None = None, least_delay: int = 0, reference: tuple[int, int] | None = None):
        """Args:
        wrap: period after which the device's clock starts again [ns].
        least_delay: from a measurement to its arrival [ns]; the envelope does not distinguish it from an offset.
        reference: device and host time of one moment [ns, ns]; the least delay is then measured with it.
        """
        self.restarts = 0
        self.drift = 0.0
        self._wrap = wrap
        self._delay = least_delay / 1e9
        self._reference = reference
        self._strange: list[tuple[int, int]] = []
        self._early: list[tuple[float, float]] = []
        self._zero = None if reference is None else self._begin(reference)

    def _begin(self, moment: tuple[int, int]) -> tuple[int, int]:
        """Forgets all points; device and host time of a moment [ns, ns] become the zero of both axes."""
        self._zero = moment
        self._early.clear()
        self._blocks: deque[tuple[float, float]] = deque(maxlen=BLOCKS)
        self._block = -1
        self._offset = 0.0  # of the envelope at the zero [s]
        self._first: float | None = None
        self._least = float("inf")
        self.drift = 0.0
        return moment

    def host_stamp(self, device: int, received: int) -> int | None:
        """Host time [ns] of a device time [ns] that arrived at a host time [ns].

        None where it contradicts what is known of this clock: a damaged number, or the first of a restarted device.
        """
        zero = self._begin((device, received)) if self._zero is None else self._zero
        late, x = self._point(zero, device, received)
        # Delays count from the envelope; until there is one, only a reference says what is possible.
        if not -SOONER < late - self._envelope(x) < LATER:
            return self._doubt(device, received)
        self._strange.clear()
        least = self._least_delay(x, late if self._believed(x, late) else self._envelope(x))
        # nothing arrives before it was measured, even where what came before was later than this
        arrived = min(zero[1] + round((x + self._envelope(x)) * 1e9), received)
        return arrived - round(least * 1e9)

    def _believed(self, x: float, late: float) -> bool:
        """Lets a point lower the envelope, unless it does by much and alone."""
        if self._first is None or late > self._envelope(x) - EARLY:
            self._early.clear()
            self._add(x, late)
            return True
        self._early.append((x, late))
        if len(self._early) < AGREEING:
            return False
        self._add(*max(self._early, key=lambda point: point[1]))
        self._early.clear()
        return True

    def _point(self, zero: tuple[int, int], device: int, received: int) -> tuple[float, float]:
        """Receive time less device time, and device time, both since the zero [s]; unwraps the device's clock."""
        ticks, host = device - zero[0], received - zero[1]
        if self._wrap is not None:
            ticks += self._wrap * round((host - ticks) / self._wrap)
        return (host - ticks) / 1e9, ticks / 1e9

    def _envelope(self, x: float) -> float:
        return self._offset + self.drift * x

    def _doubt(self, device: int, received: int) -> None:
        """Starts anew once several strange times in a row agree with each other."""
        self._strange.append((device, received))
        first = self._strange[0]
        if abs((received - first[1]) - (device - first[0])) > LATER * 1e9:
            self._strange = [(device, received)]
        if len(self._strange) >= AGREEING:
            self.restarts += 1
            # The reference belongs to the time before; the delay measured with it does not change.
            if self._least < float("inf"):
                self._delay = self._least
            self._reference = None
            self._begin((device, received))
            self._strange = []

    def _add(self, x: float, late: float) -> None:
        if self._first is None:
            self._first = x
            self._offset = late
        block = int((x - self._first) / BLOCK)
        if block > self._block:
            self._block = block
            self._blocks.append((x, late))
            self._fit()
        elif late < self._blocks[-1][1]:
            self._blocks[-1] = (x, late)
        self._offset = min(self._offset, late - self.drift * x)

    def _fit(self) -> None:
        points = sorted({x: y for x, y in self._blocks}.items())  # measurements of one device may come out of order
        if points[-1][0] - points[0][0] >= LEAST_SPAN:
            self.drift = min(max(_slope(points), -MOST_DRIFT), MOST_DRIFT)
        self._offset = min(y - self.drift * x for x, y in points)

    def _least_delay(self, x: float, late: float) -> float:
        """The delay that the envelope contains [s]."""
        if self._reference is None or self._first is None:
            return self._delay
        if x - self._first < SETTLING:
            self._least = max(0.0, min(self._least, late))
        return self._least


def _slope(points: list[tuple[float, float]]) -> float:
    """Slope of the line below all points that is closest to them: of the lower hull's edge over their mean x."""
    hull: list[tuple[float, float]] = []
    for p in points:
        while len(hull) >= 2 and _turns_right(hull[-2], hull[-1], p):
            hull.pop()
        hull.append(p)
    mean = sum(x for x, _ in points) / len(points)
    right = next((k for k in range(1, len(hull)) if hull[k][0] >= mean), len(hull) - 1)
    (x1, y1), (x2, y2) = hull[right - 1], hull[right]
    return (y2 - y1) / (x2 - x1)


def _turns_right(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) <= 0.0
