"""Lines out of a stream of bytes, for radios that speak text."""

from __future__ import annotations

from collections import Counter

LONGEST = 1024
"""A longer line is noise [bytes]."""


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
                self._dropped["line: too long"] += 1
                self._overlong = False
            elif line:
                found.append(line)
        if len(self._open) > LONGEST:
            self._overlong, self._open = True, b""
        return found
