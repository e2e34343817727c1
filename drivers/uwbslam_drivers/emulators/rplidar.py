"""An emulated RPLIDAR: turns clockwise at 10 Hz, 2000 samples a second in standard and 4000 in express scan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from uwbslam_drivers import rplidar as protocol
from uwbslam_drivers.emulators.robot import DeviceTime
from uwbslam_jax.sim import Scenario, cast, stream

RATE = 10.0
"""Turns a second of an A2 by default [Hz]."""
STANDARD, EXPRESS = 500, 250
"""Time of a sample [us]: what an A2 answers to GET_SAMPLERATE (LR001)."""
REACH, SIGMA = 12.0, 0.01
"""Farthest return of an A2, and the standard deviation of a distance [m]."""
_MODES = {protocol.SCAN: "standard", protocol.EXPRESS: "express", protocol.STOP: "", protocol.RESET: ""}
"""Mode that a request leads to [request -> name], where it is known."""
_REPLIES = {
    protocol.GET_HEALTH: protocol.HEALTH_HEADER + b"\x00\x00\x00",
    protocol.GET_SAMPLERATE: protocol.RATE_HEADER + STANDARD.to_bytes(2, "little") + EXPRESS.to_bytes(2, "little"),
    protocol.SCAN: protocol.SCAN_HEADER,
    protocol.EXPRESS: protocol.EXPRESS_HEADER,
}
"""Request -> what an A2 says at once [bytes] (LR001)."""
_DENSE = b"\xa5\x5a\x54\x00\x00\x40\x85"
"""Descriptor of dense capsules [bytes] (Slamtec's SDK)."""
_REPLIES_C1 = _REPLIES | {protocol.EXPRESS: _DENSE}
"""The same of a C1 [bytes]."""
_REPLIES_OLD = {request: _REPLIES[request] for request in (protocol.GET_HEALTH, protocol.SCAN)}
"""The same of an A1 with old firmware [bytes]."""


class Samples(NamedTuple):
    """Clockwise angles (32,) [deg] and distances (32,) [m], 0 for no return, of samples in the order of time."""

    angles: np.ndarray
    distances: np.ndarray


class EmulatedRplidar:
    """An A2-like scanner without accessory board; its subclasses are other firmwares.

    Attributes:
      replies: request -> what it says at once. A scanner does not know requests that are missing.
    """

    protocol = "rplidar"
    replies: Mapping[bytes, bytes] = _REPLIES

    def __init__(self, time: DeviceTime):
        self._mode = ""
        self._heard = b""
        self._begun = False

    def restart(self, boot: int) -> None:
        self.__init__(DeviceTime(boot))

    def measurements(self, scenario: Scenario) -> Iterator[tuple[int, Samples]]:
        """Samples, 32 at a time."""
        noise = stream(scenario.seed, "rplidar noise")
        t = 0.0
        while t < scenario.duration:
            period = (STANDARD if self._mode == "standard" else EXPRESS) * 1e-6
            times = t + period * np.arange(protocol.SAMPLES)
            t += period * protocol.SAMPLES
            angles = 360.0 * RATE * times % 360.0
            distances = _distances(scenario, times, RATE) + SIGMA * noise.normal(size=protocol.SAMPLES)
            seen = (distances > protocol.RANGE_MIN) & (distances < REACH)
            yield round(t * 1e9), Samples(angles, np.where(seen, distances, 0.0))

    def encode(self, samples: Samples, departure: int) -> bytes:
        if self._mode == "standard":
            return b"".join(_node(a, d) for a, d in zip(*samples, strict=True))
        if self._mode == "express":
            first, self._begun = not self._begun, True
            return _capsule(samples, first)
        return b""

    def answer(self, data: bytes, host: int) -> bytes:
        self._heard = (self._heard + data)[-64:]
        said = b""
        while (begin := self._heard.find(b"\xa5")) >= 0:
            request = self._heard[begin:]
            if len(request) < 2 or (request[1] & 0x80 and (len(request) < 3 or len(request) < request[2] + 4)):
                self._heard = request
                return said
            length = request[2] + 4 if request[1] & 0x80 else 2
            said += self._reply(request[:length])
            self._heard = request[length:]
        self._heard = b""
        return said

    def _reply(self, request: bytes) -> bytes:
        said = self.replies.get(request, b"")
        if request in _MODES and (said or not _MODES[request]):
            self._mode, self._begun = _MODES[request], False
        return said


class EmulatedRplidarC1(EmulatedRplidar):
    """A C1, S2 or S3: its express scan comes in dense capsules, 40 distances each."""

    replies: Mapping[bytes, bytes] = _REPLIES_C1

    def encode(self, samples: Samples, departure: int) -> bytes:
        return super().encode(samples, departure) if self._mode == "standard" else b"\xa0\x50" * 42 * bool(self._mode)


class EmulatedRplidarOld(EmulatedRplidar):
    """An A1 with firmware before 1.17: it knows neither sample times nor an express scan."""

    replies: Mapping[bytes, bytes] = _REPLIES_OLD


def _distances(scenario: Scenario, times: np.ndarray, rate: float) -> np.ndarray:
    """Exact distances [m] of a scanner that turns clockwise, at times [s] within a turn."""
    pose = scenario.path.pose(times)
    x, y, yaw = scenario.lidar.pose
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    origins = pose[:, :2] + np.stack([c * x - s * y, s * x + c * y], -1)
    bearings = pose[:, 2] + yaw - 2.0 * np.pi * rate * times
    return cast(scenario.world.segments, origins[::-1], bearings[::-1])[::-1]  # the caster wants them increasing


def _node(angle: float, distance: float) -> bytes:
    start = angle < 360.0 * RATE * STANDARD * 1e-6
    raw = round(angle * 64.0) % (360 * 64) << 1 | 1
    quality = 47 << 2 if distance else 0
    millimetres = min(round(distance * 4000.0), 0xFFFF)
    return bytes([quality | (1 if start else 2)]) + raw.to_bytes(2, "little") + millimetres.to_bytes(2, "little")


def _capsule(samples: Samples, first: bool) -> bytes:
    raw = round(samples.angles[0] * 64.0) % (360 * 64) | (0x8000 if first else 0)
    words = np.minimum(np.round(samples.distances * 1000.0), 0x3FFF).astype(int) << 2
    body = raw.to_bytes(2, "little")
    for a, b in words.reshape(16, 2).tolist():
        body += a.to_bytes(2, "little") + b.to_bytes(2, "little") + b"\x00"
    check = protocol.xor(body)
    return bytes([0xA0 | check & 0xF, 0x50 | check >> 4]) + body
