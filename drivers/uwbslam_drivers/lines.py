"""Lines out of a stream of bytes, for radios that speak text."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter

from uwbslam_drivers.device import Measured
from uwbslam_jax.reasons import RangeLost

LONGEST = 1024
"""A longer line is noise [bytes]: 32 ranges of a Makerfabs tag, the most a radio reports in one, take about 600."""


class Lines:
    """Cuts a stream into lines at CR or LF; what is longer than LONGEST is dropped and counted."""

    def __init__(self, dropped: Counter[str]):
        self._dropped = dropped
        self._open = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[bytes]:
        """Complete lines without their ends; empty ones are left out."""
        *done, self._open = (self._open + data).replace(b"\r", b"\n").split(b"\n")
        found = []
        for line in done:
            if self._overlong or len(line) > LONGEST:
                self._dropped[RangeLost.LINE_TOO_LONG] += 1
                self._overlong = False
            elif line:
                found.append(line)
        if len(self._open) > LONGEST:
            self._overlong, self._open = True, b""
        return found


class LineDecoder(ABC):
    """A decoder of lines, each read from its last `mark` on: where a line end was lost, the last line is whole.

    Attributes:
      sign: in a line that holds it and is not a measurement, something was damaged.
    """

    mark: bytes
    sign: bytes

    def __init__(self, dropped: Counter[str]):
        self._dropped = dropped
        self._lines = Lines(dropped)

    def feed(self, data: bytes, received: int) -> list[Measured]:
        """Ranges of the lines that these bytes complete."""
        found: list[Measured] = []
        for line in self._lines.feed(data):
            begin = line.rfind(self.mark)
            ranges = self.ranges(line[begin:], received) if begin >= 0 else None
            if ranges is not None:
                found += ranges
            elif self.sign in line:
                self._dropped[RangeLost.LINE_DAMAGED] += 1
        return found

    @abstractmethod
    def ranges(self, line: bytes, received: int) -> list[Measured] | None:
        """Ranges of a line that arrived at a host time [ns]; None where it is damaged."""
