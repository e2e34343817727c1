"""What goes wrong on the way: lost and damaged bytes, odd pieces, pauses, a pulled plug. No port is known here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Repeated = tuple[float, float]
"""Every so many seconds, for so many; at the end of each period."""


@dataclass(frozen=True)
class Faults:
    """Faults of a line from a device.

    Attributes:
      drop, corrupt: share of the bytes that are lost, and that arrive as another byte.
      split: pieces of 1 to so many bytes; 0 leaves them whole.
      coalesce: what is sent within this time arrives together [s].
      pause: the line stands still, then all comes at once.
      unplug: the plug is pulled; the device loses its power with it.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    split: int = 0
    coalesce: float = 0.0
    pause: Repeated | None = None
    unplug: Repeated | None = None


def within(repeated: Repeated | None, t: float, phase: float = 0.0) -> bool:
    """Whether a repeated fault is on at a time since the departure [s]; phase shifts it by a share of its period."""
    if repeated is None:
        return False
    every, lasting = repeated
    return t >= 0.0 and (t + phase * every) % every >= every - lasting


class Line:
    """A line with faults: bytes go in, pieces come out, sooner or later."""

    def __init__(self, faults: Faults, rng: np.random.Generator, phase: float = 0.0):
        self._faults = faults
        self._rng = rng
        self._phase = phase
        self._held = b""
        self._since = 0.0

    def take(self, data: bytes, t: float) -> list[bytes]:
        """Pieces that arrive at a time since the departure [s], with these bytes sent just now."""
        faults = self._faults
        data = self.mangle(data)
        if data and not self._held:
            self._since = t
        self._held += data
        if not self._held or within(faults.pause, t, self._phase) or t - self._since < faults.coalesce:
            return []
        whole, self._held = self._held, b""
        return self._pieces(whole) if faults.split else [whole]

    def clear(self) -> None:
        """Forgets what has not arrived."""
        self._held = b""

    def mangle(self, data: bytes) -> bytes:
        """The bytes with some lost and some damaged."""
        faults = self._faults
        if not data or not (faults.drop or faults.corrupt):
            return data
        raw = np.frombuffer(data, np.uint8)
        bad = self._rng.uniform(size=raw.size) < faults.corrupt
        raw = np.where(bad, raw ^ self._rng.integers(1, 256, raw.size, dtype=np.uint8), raw)
        return raw[self._rng.uniform(size=raw.size) >= faults.drop].tobytes()

    def _pieces(self, data: bytes) -> list[bytes]:
        pieces, at = [], 0
        while at < len(data):
            size = int(self._rng.integers(1, self._faults.split + 1))
            pieces.append(data[at : at + size])
            at += size
        return pieces
