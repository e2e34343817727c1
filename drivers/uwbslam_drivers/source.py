"""A device behind a URL: opens its port, makes it talk, decodes what it says, and starts over when it falls silent.

    tcp://192.168.0.10:10940                                   a Hokuyo with Ethernet
    serial:///dev/ttyACM0?baud=115200&protocol=dwm1000         a board on a serial port

Query: `protocol` (a key of DEVICES; by default hokuyo for a lidar, dwm1000 for uwb), `baud`, and the device's options.
"""

from __future__ import annotations

import difflib
import random
import re
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple
from urllib.parse import parse_qsl, urlsplit

from uwbslam_drivers.clock import DeviceClock, host_time
from uwbslam_drivers.device import Decoder, Device, DeviceFailure, DriverError, NoAnswer, Option, Port, Session
from uwbslam_drivers.dwm1000 import Dwm1000
from uwbslam_drivers.dwm1001 import Dwm1001
from uwbslam_drivers.hokuyo import Hokuyo
from uwbslam_drivers.linktrack import LinkTrack
from uwbslam_drivers.makerfabs import Makerfabs
from uwbslam_drivers.ports import SerialPort, TcpPort
from uwbslam_drivers.rplidar import Rplidar
from uwbslam_jax.measurements import RangeMessage, ScanMessage

DEVICES: dict[str, Device] = {
    "hokuyo": Hokuyo(),
    "rplidar": Rplidar(),
    "dwm1000": Dwm1000(),
    "linktrack": LinkTrack(),
    "dwm1001": Dwm1001(),
    "makerfabs": Makerfabs(),
}
"""Every protocol [name -> device]; the first of a kind is its default."""

POLL = 0.1
"""A read waits no longer, so that closing is quick [s]."""
SCANLESS = 10.0
"""A LiDAR without an intact scan for so long is started anew: longer than a motor takes to run up [s]."""
FIRST_WAIT, LONGEST_WAIT = 0.2, 2.0
"""Wait before a port is tried again: doubles, so that a device that is absent for long costs nothing [s]."""


class Reading(NamedTuple):
    """One measurement of a device.

    Attributes:
      message: stamped with the host time of the measurement [ns].
      received: host time of its arrival [ns].
      device: time of the measurement on the device's own clock [ns]; None where it reports none.
    """

    message: ScanMessage | RangeMessage
    received: int
    device: int | None


@dataclass(frozen=True)
class Address:
    """What a URL says: device, ways to open its port (speeds, where the URL gives none), and options for it."""

    url: str
    protocol: str
    ways: Sequence[Callable[[], Port]]
    options: Mapping[str, str]

    @property
    def device(self) -> Device:
        return DEVICES[self.protocol]

    def open(self, way: int = 0) -> Port:
        """The port, opened in one of the ways; they come round again. Raises OSError."""
        return self.ways[way % len(self.ways)]()


def parse_url(url: str, kind: str) -> Address:
    """What a URL of a device of a kind, "lidar" or "uwb", says.

    Raises:
      DriverError: it says nothing that can be opened; one line.
    """
    try:
        parts = urlsplit(url)
        words = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query)))
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise DriverError(f"{url}: {error}") from None
    known = [name for name, device in DEVICES.items() if device.kind == kind]
    protocol = words.pop("protocol", known[0])
    if protocol not in known:
        raise DriverError(f"{url}: no {kind} protocol {protocol}; there are {', '.join(known)}")
    device = DEVICES[protocol]
    known_options = dict(device.options)
    if parts.scheme == "serial":
        known_options["baud"] = Option(str(device.bauds[0]), r"[1-9]\d{0,7}", "a whole number greater than 0")
    for word, value in words.items():
        if word not in known_options:
            near = difflib.get_close_matches(word, known_options, 1) or sorted(["protocol", *known_options])
            raise DriverError(f"{url}: unknown option {word}; there is {', '.join(near)}")
        if not re.fullmatch(known_options[word].pattern, value):
            raise DriverError(f"{url}: {word} {value}: must be {known_options[word].values}")
    options = {name: words.get(name, option.default) for name, option in known_options.items()}
    if parts.scheme == "tcp":
        if not host:
            raise DriverError(f"{url}: no host; write tcp://HOST:PORT")
        number = port or device.tcp_port
        if number is None:
            raise DriverError(f"{url}: no port; write tcp://{host}:PORT")
        return Address(url, protocol, [lambda: TcpPort(host, number)], options)
    if parts.scheme == "serial":
        if host or not parts.path.strip("/"):
            raise DriverError(f"{url}: no port; write serial:///dev/ttyACM0")
        bauds = [int(words["baud"])] if "baud" in words else device.bauds
        return Address(url, protocol, [partial(SerialPort, parts.path, baud, device.dtr) for baud in bauds], options)
    raise DriverError(f"{url}: must begin with tcp:// or serial://")


def open_source(url: str, kind: str) -> Source:
    """The device of a kind, "lidar" or "uwb", at a URL. Nothing is opened before its readings are asked for.

    Raises:
      DriverError: the URL says nothing that can be opened; one line.
    """
    return Source(parse_url(url, kind))


class Source:
    """Readings of one device, for as long as it is not closed; iterate in a thread of its own.

    Attributes:
      address: where it is and what it speaks.
      status: "closed", "opening", "waiting" for the first measurement, or "streaming".
      failure: why the port was lost or cannot be opened, in one line; "" while it is open.
      counts: measurements, bytes, connections, and what was dropped, by reason.
      notes: what a user should know of how the device talks, one line each.
    """

    def __init__(self, address: Address, now: Callable[[], int] = host_time):
        """now: host time [ns]."""
        self.address = address
        self.status = "closed"
        self.failure = ""
        self.counts: Counter[str] = Counter()
        self.notes: list[str] = []
        self._way = 0  # to open the port: the last that led to an answer, or the next to be tried
        self._now = now
        self._stop = threading.Event()

    def close(self) -> None:
        """Ends the iteration soon; may be called from any thread."""
        self._stop.set()

    def __iter__(self) -> Iterator[Reading]:
        wait = FIRST_WAIT
        while not self._stop.is_set():
            try:
                self.status = "opening"
                for reading in self._connection():
                    wait = FIRST_WAIT
                    yield reading
            except OSError as error:  # of pyserial too: its SerialException is one
                self.failure = " ".join(str(error).split()) or type(error).__name__
                self.counts["connection: lost or refused"] += 1
            if self.status == "streaming":
                self.status = "opening"
            # Not all devices at once after a power failure.
            self._stop.wait(wait * random.uniform(0.8, 1.2))
            wait = min(2.0 * wait, LONGEST_WAIT)
        self.status = "closed"

    def _connection(self) -> Iterator[Reading]:
        """Readings until the port fails or falls silent."""
        port = self.address.open(self._way)
        try:
            device = self.address.device
            session = self._started(device, port)
            self.counts["connections"] += 1
            self.notes += [note for note in session.notes if note not in self.notes]
            self.status, self.failure = "waiting", ""
            clock = DeviceClock(session.wrap, session.least_delay, session.reference)
            heard = measured = self._now()
            yield from self._readings(session.decoder, clock, session.leftover, heard)
            while not self._stop.is_set():
                data = port.read(POLL)
                now = self._now()
                if data:
                    heard = now
                    for reading in self._readings(session.decoder, clock, data, now):
                        measured = now
                        yield reading
                elif now - heard > device.silence * 1e9:
                    raise DeviceFailure(f"silent for {device.silence:g} s")
                # A radio may hear nobody for a while; a LiDAR that sends bytes but no scan is not understood.
                if device.kind == "lidar" and now - measured > SCANLESS * 1e9:
                    raise DeviceFailure(f"no scan for {SCANLESS:g} s")
        except _Closed:
            return
        finally:
            port.close()

    def _started(self, device: Device, port: Port) -> Session:
        """The device made to talk; where nothing comes, the port is opened in its next way from now on."""
        try:
            return device.start(_Interruptible(port, self._stop), self.address.options, self.counts)
        except NoAnswer:
            self._way += 1
            raise

    def _readings(self, decoder: Decoder, clock: DeviceClock, data: bytes, received: int) -> Iterator[Reading]:
        self.counts["bytes"] += len(data)
        restarts = clock.restarts
        for message, device in decoder.feed(data, received):
            stamp = message.stamp if device is None else clock.host_stamp(device, received)
            if stamp is None:
                self.counts["device time: impossible"] += 1
                continue
            self.status = "streaming"
            self.counts["measurements"] += 1
            yield Reading(replace(message, stamp=stamp), received, device)
        if clock.restarts > restarts:
            self.counts["device clock: restarts"] += clock.restarts - restarts


class _Closed(Exception):
    """The source was closed during a handshake."""


class _Interruptible:
    """A port whose reads end when the source is closed, so that a handshake does not outlive it."""

    def __init__(self, port: Port, stop: threading.Event):
        self._port = port
        self._stop = stop

    def read(self, timeout: float) -> bytes:
        while True:
            if self._stop.is_set():
                raise _Closed
            data = self._port.read(min(timeout, POLL))
            timeout -= POLL
            if data or timeout <= 0.0:
                return data

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def close(self) -> None:
        self._port.close()
