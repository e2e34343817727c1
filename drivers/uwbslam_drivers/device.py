"""What a device has to bring: a decoder of its bytes and the words that make it talk. No port is opened here.

To add a device, write one file with a class that meets `Device` and enter it in `source.DEVICES`.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

from uwbslam_jax.errors import UwbslamError
from uwbslam_jax.measurements import RangeMessage, ScanMessage

Found = TypeVar("Found")


class DriverError(UwbslamError, ValueError):
    """A URL, an option or a request that cannot be met; the message is one line."""


class DeviceFailure(OSError):
    """A device that does not answer as its protocol says; the port is closed and opened anew."""


class NoAnswer(DeviceFailure):
    """Nothing that is understood comes at all: the port may have another speed."""


class Measured(NamedTuple):
    """One decoded measurement.

    Attributes:
      message: its stamp holds only where `device` is None; it is then host time already [ns].
      device: time of the measurement on the device's own clock [ns], which may wrap; None where it reports none.
    """

    message: ScanMessage | RangeMessage
    device: int | None


class Option(NamedTuple):
    """A word that the URL of a device may carry: its default, a pattern of its values, and what they are in words."""

    default: str
    pattern: str
    values: str


class Port(Protocol):
    """An open byte stream. Every method may raise OSError when the other side is gone."""

    def read(self, timeout: float) -> bytes:
        """What has arrived, at once if there is something, b"" if nothing comes within the timeout [s]."""
        ...

    def write(self, data: bytes) -> None: ...

    def close(self) -> None: ...


class Decoder(Protocol):
    """Bytes to measurements, one chunk after the other, cut anywhere. Never raises, never holds much."""

    @abstractmethod
    def feed(self, data: bytes, received: int) -> list[Measured]:
        """Measurements that these bytes complete; `received` is the host time of the last byte [ns]."""


@dataclass(frozen=True)
class Session:
    """A device that has been made to talk.

    Attributes:
      decoder: for the bytes from now on.
      leftover: bytes of the stream that came with the last answer.
      wrap: period after which the device's clock starts again [ns]; None where it does not or there is none.
      least_delay: the shortest time from a measurement to its arrival [ns], as far as the protocol says.
      reference: time on the device's clock and host time of one moment [ns, ns], from an exchange for that purpose.
      notes: what a user should know of how it talks, one line each.
    """

    decoder: Decoder
    leftover: bytes = b""
    wrap: int | None = None
    least_delay: int = 0
    reference: tuple[int, int] | None = None
    notes: tuple[str, ...] = ()


class Device(Protocol):
    """A kind of device.

    Attributes:
      kind: "lidar" or "uwb".
      bauds: speeds of its serial port, the usual one first; where a URL gives none they are tried in turn.
      dtr: what its serial port's DTR line is set to; it switches the motor of some scanners, and resets some boards.
      tcp_port: where it listens by default; None where it has no network port of its own.
      silence: without a byte for so long, the port is closed and opened anew [s].
      options: words that its URL may carry, by name.
    """

    @property
    def kind(self) -> str: ...
    @property
    def bauds(self) -> tuple[int, ...]: ...
    @property
    def dtr(self) -> bool: ...
    @property
    def tcp_port(self) -> int | None: ...
    @property
    def silence(self) -> float: ...
    @property
    def options(self) -> Mapping[str, Option]: ...

    def start(self, port: Port, options: Mapping[str, str], dropped: Counter[str]) -> Session:
        """Makes the device send measurements.

        Args:
          options: values of all `options`, sound ones.
          dropped: counts what the decoder throws away, by reason.

        Raises:
          OSError: the device does not answer (DeviceFailure) or is gone.
        """
        ...


class SerialRadio:
    """What UWB radios at a serial port have in common, see `Device`."""

    kind = "uwb"
    bauds: tuple[int, ...] = (115200,)
    dtr = True
    tcp_port: int | None = None
    silence = 5.0
    options: Mapping[str, Option] = {}


def read_until(port: Port, find: Callable[[bytes], Found | None], timeout: float) -> Found | None:
    """What `find` returns for the bytes read so far (the last 64 KiB); None where it finds nothing in a time [s]."""
    received = b""
    until = time.monotonic() + timeout
    while (left := until - time.monotonic()) > 0.0:
        received = (received + port.read(left))[-65536:]
        if (found := find(received)) is not None:
            return found
    return None
