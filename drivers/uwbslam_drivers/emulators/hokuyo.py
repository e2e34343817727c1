"""An emulated Hokuyo UTM-30LX-EW: the scans of the simulated robot in SCIP 2.2."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from uwbslam_drivers import scip
from uwbslam_drivers.emulators import robot
from uwbslam_drivers.emulators.robot import DeviceTime
from uwbslam_drivers.hokuyo import MS, UTM_30LX_EW, WRAP, Specification
from uwbslam_jax.measurements import ScanMessage
from uwbslam_jax.sim import Scenario

PROCESSING = 1 * MS
"""A reply follows the last beam after this time: no sensor answers at once [ns]."""
NO_RETURN, INTENSITY = 1, 3000
"""Error code of a beam that meets nothing [mm], and the intensity of every other beam [dimensionless], which no driver
uses."""


@dataclass
class _Request:
    """An MD or ME request under way; `left` scans to go, None without end."""

    name: bytes
    first: int
    last: int
    skip: int
    left: int | None


class EmulatedHokuyo:
    """A UTM-30LX-EW, or a sensor with another specification."""

    protocol = "hokuyo"

    def __init__(self, time: DeviceTime, spec: Specification = UTM_30LX_EW):
        self.time = time
        self.spec = spec
        self._heard = b""
        self._request: _Request | None = None
        self._synchronising = False
        self._scan = 0

    def measurements(self, scenario: Scenario) -> Iterator[tuple[int, ScanMessage]]:
        spec = self.spec
        beams = 2 * max(spec.front - spec.first, spec.last - spec.front) + 1  # the simulator's are symmetric
        lidar = replace(
            scenario.lidar,
            rate=1.0 / spec.turn,
            beams=beams,
            field_of_view=(beams - 1) * spec.increment,
            range_min=spec.nearest / 1e3,
            range_max=min(spec.farthest / 1e3, 30.0),
            time_increment=spec.turn / spec.per_turn,
        )
        for due, scan in robot.scans(scenario, lidar):
            yield due + PROCESSING, scan

    def restart(self, time: DeviceTime) -> None:
        """Loses its power and comes back: nothing measured, the clock anew."""
        self.__init__(time, self.spec)

    def encode(self, scan: ScanMessage, departure: int) -> bytes:
        """The reply with a scan, b"" while none is asked for; the robot set off at a host time [ns]."""
        request = self._request
        self._scan += 1
        if request is None or self._synchronising or self._scan % (request.skip + 1):
            return b""
        spec = self.spec
        if request.left is not None:
            request.left -= 1
        millimetres = np.where(np.isfinite(scan.ranges), np.round(1e3 * scan.ranges.astype(float)), NO_RETURN)
        begin = spec.front - (scan.ranges.size - 1) // 2
        values = millimetres[request.first - begin : request.last - begin + 1].astype(np.int64)
        if request.name == b"ME":
            values = np.stack([values, np.full(values.size, INTENSITY)], -1).ravel()
        rear = round((scan.angle_min + math.pi) / (2.0 * math.pi) * spec.turn * 1e9)
        stamp = scip.encode(self._clock(robot.host_stamp(scan.stamp, departure) - rear), 4)
        echo = b"%s%04d%04d01%d%02d" % (request.name, request.first, request.last, request.skip, request.left or 0)
        head = echo + b"\n99b\n" + stamp + bytes([scip.checksum(stamp)]) + b"\n"
        if request.left == 0:
            self._request = None
        return head + scip.encode_blocks(values) + b"\n"

    def _clock(self, host: int) -> int:
        return self.time.at(host) % WRAP // MS

    def answer(self, data: bytes, host: int) -> bytes:
        """What it says to bytes that arrive at a host time [ns]."""
        *lines, self._heard = (self._heard + data).replace(b"\r", b"\n").split(b"\n")
        self._heard = self._heard[-64:]
        return b"".join(self._reply(line, host) for line in lines if line)

    def _reply(self, line: bytes, host: int) -> bytes:
        command = line.split(b";")[0]
        if command[:2] in (b"MD", b"ME"):
            status = self._start(command)
        elif command == b"TM1" and self._synchronising:
            stamp = scip.encode(self._clock(host), 4)
            return line + b"\n00P\n" + stamp + bytes([scip.checksum(stamp)]) + b"\n\n"
        elif command in (b"VV", b"PP", b"II"):
            lines = [text + b";" + bytes([scip.checksum(text)]) for text in self._about(command)]
            return line + b"\n00P\n" + b"\n".join(lines) + b"\n\n"
        elif command in (b"TM0", b"TM2"):
            self._synchronising = command == b"TM0"
            self._request = None
            status = b"00"
        elif command in (b"BM", b"QT", b"RS"):
            self._request = None
            self._synchronising = False
            status = b"00"
        else:
            status = b"0E"
        return line + b"\n" + status + bytes([scip.checksum(status)]) + b"\n\n"

    def _start(self, command: bytes) -> bytes:
        """Status of an MD or ME request."""
        fields = command[2:]
        if len(fields) != 13 or not fields.isdigit() or fields[8:10] not in (b"00", b"01"):
            return b"01"
        first, last, skip, count = int(fields[:4]), int(fields[4:8]), int(fields[10:11]), int(fields[11:])
        if not self.spec.first <= first <= last <= self.spec.last:
            return b"04"
        if self._synchronising:
            return b"10"
        self._request = _Request(command[:2], first, last, skip, count or None)
        return b"00"

    def _about(self, command: bytes) -> list[bytes]:
        spec = self.spec
        if command == b"VV":
            return [b"VEND:Hokuyo Automatic Co.,Ltd.", b"PROD:SOKUIKI Sensor UTM-30LX-EW", b"PROT:SCIP 2.2"]
        if command == b"II":
            return [b"MODL:UTM-30LX-EW", b"LASR:OFF", b"SCSP:2400", b"STAT:Sensor works well."]
        fields = {
            "MODL": "UTM-30LX-EW",
            "DMIN": spec.nearest,
            "DMAX": spec.farthest,
            "ARES": spec.per_turn,
            "AMIN": spec.first,
            "AMAX": spec.last,
            "AFRT": spec.front,
            "SCAN": spec.speed,
        }
        return [f"{name}:{value}".encode() for name, value in fields.items()]
