"""Serves emulated devices in real time, each in a thread of its own, with the faults that were asked for."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from uwbslam_drivers.clock import host_time
from uwbslam_drivers.emulators.faults import Faults, Line, within
from uwbslam_drivers.emulators.hokuyo import EmulatedHokuyo
from uwbslam_drivers.emulators.plugs import Plug
from uwbslam_drivers.emulators.radios import (
    EmulatedDwm1000,
    EmulatedDwm1000Powers,
    EmulatedDwm1001,
    EmulatedLinkTrack,
    EmulatedLinkTrack3,
    EmulatedMakerfabs,
)
from uwbslam_drivers.emulators.robot import Departure, DeviceTime
from uwbslam_drivers.emulators.rplidar import EmulatedRplidar, EmulatedRplidarC1, EmulatedRplidarOld
from uwbslam_jax.sim import Scenario, stream

_POLL = 0.02
"""A device that nothing is due of listens so long for a request: what it says then is at most so late [s]."""


class EmulatedDevice(Protocol):
    """A device without a port. All times are host times [ns].

    Attributes:
      protocol: name of the driver that understands it.
    """

    protocol: str

    def measurements(self, scenario: Scenario) -> Iterator[tuple[int, Any]]:
        """What it measures, each with the time at which it is sent [ns since the departure]."""
        ...

    def encode(self, measurement: Any, departure: int, /) -> bytes:
        """What it sends of a measurement, b"" if it was not asked to."""
        ...

    def answer(self, data: bytes, host: int) -> bytes:
        """What it says at once to bytes that it hears."""
        ...

    def restart(self, boot: int) -> None:
        """Forgets everything, as after a loss of power, and is switched on at a host time [ns]."""
        ...


EMULATORS: Mapping[str, Callable[[DeviceTime], EmulatedDevice]] = {
    "hokuyo": EmulatedHokuyo,
    "rplidar": EmulatedRplidar,
    "rplidar-c1": EmulatedRplidarC1,
    "rplidar-old": EmulatedRplidarOld,
    "dwm1000": EmulatedDwm1000,
    "dwm1000-powers": EmulatedDwm1000Powers,
    "linktrack": EmulatedLinkTrack,
    "linktrack3": EmulatedLinkTrack3,
    "dwm1001": EmulatedDwm1001,
    "makerfabs": EmulatedMakerfabs,
}
"""Every emulated device [name -> what makes one with its clock]."""


class Server:
    """One emulated device at a plug; `start` serves it until `stop`."""

    def __init__(
        self,
        device: EmulatedDevice,
        plug: Plug,
        scenario: Scenario,
        departure: Departure,
        faults: Faults | None = None,
        number: int = 0,
    ):
        """number: of this device; it shifts its pauses and pulled plugs."""
        self._device, self._plug, self._departure = device, plug, departure
        self._faults = faults or Faults()
        self._phase = number * 0.37 % 1.0
        self._line = Line(self._faults, stream(scenario.seed, f"line {number}"), self._phase)
        self._measurements = device.measurements(scenario)
        self._next = next(self._measurements, None)  # made before anybody waits for it
        self._stop = threading.Event()
        self._pulled = False
        self._thread = threading.Thread(target=self._serve, name=f"emulated {device.protocol}", daemon=True)

    @property
    def protocol(self) -> str:
        """Name of the driver that understands the device."""
        return self._device.protocol

    @property
    def url(self) -> str:
        """How a driver opens it."""
        return f"{self._plug.url}?protocol={self.protocol}"

    @property
    def running(self) -> bool:
        """False once the simulation has ended or the device was stopped."""
        return self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _serve(self) -> None:
        try:
            while not self._stop.is_set() and self._next is not None:
                self._round()
        finally:
            self._plug.pull()

    def _round(self) -> None:
        """Waits until something is heard or due, and sends."""
        data = self._plug.read(self._patience())
        now = host_time()
        if self._plug.attached:
            self._departure.now(now)
        said = self._device.answer(data, now) if data else b""
        departure = self._departure.at
        elapsed = -1.0 if departure is None else (now - departure) / 1e9
        if departure is not None:
            while self._next is not None and departure + self._next[0] <= now:
                said += self._device.encode(self._next[1], departure)
                self._next = next(self._measurements, None)
        self._pull_or_restore(elapsed, now)
        for piece in self._line.take(said, max(elapsed, 0.0)):
            self._plug.send(piece)

    def _patience(self) -> float:
        """Time until something is due [s]."""
        if self._departure.at is None or self._next is None:
            return _POLL
        return min(max((self._departure.at + self._next[0] - host_time()) / 1e9, 0.0), _POLL)

    def _pull_or_restore(self, elapsed: float, now: int) -> None:
        pulled = within(self._faults.unplug, elapsed, self._phase)
        if pulled and not self._pulled:
            self._plug.pull()
            self._line.clear()
            self._device.restart(now)
        elif self._pulled and not pulled:
            self._plug.restore()
        self._pulled = pulled
