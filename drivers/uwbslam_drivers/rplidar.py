"""Slamtec RPLIDAR, standard scan (5-byte nodes) and express scan (84-byte capsules of 32 samples).

After the RPLIDAR interface protocol (LR001, v2.x) and, for the angle offsets within a capsule, Slamtec's SDK
(_capsuleToNormal). The scanner turns clockwise and has no clock: a sample's time is that of its arrival less the time
that the samples behind it took.
"""

from __future__ import annotations

import math
import re
import time
from collections import Counter, deque
from collections.abc import Mapping

import numpy as np

from uwbslam_drivers.device import DeviceFailure, Measured, NoAnswer, Option, Port, Session, read_until
from uwbslam_jax.measurements import ScanMessage
from uwbslam_jax.reasons import ScanLost

STOP, RESET, SCAN, GET_HEALTH, GET_SAMPLERATE = b"\xa5\x25", b"\xa5\x40", b"\xa5\x20", b"\xa5\x52", b"\xa5\x59"
"""Requests without payload: A5 and a command [bytes] (LR001)."""
EXPRESS, MOTOR_ON = b"\xa5\x82\x05\x00\x00\x00\x00\x00\x22", b"\xa5\xf0\x02\x94\x02\xc1"
"""Requests with length, payload and XOR sum [bytes] (LR001). The payload of MOTOR_ON is a PWM of 660 of 1023, as in
Slamtec's SDK; models without an accessory board ignore it."""
SCAN_HEADER, EXPRESS_HEADER = b"\xa5\x5a\x05\x00\x00\x40\x81", b"\xa5\x5a\x54\x00\x00\x40\x82"
"""What answers with scans begin with [bytes]: A5 5A, length of one piece with the send mode, data type (LR001)."""
HEALTH_HEADER, RATE_HEADER = b"\xa5\x5a\x03\x00\x00\x00\x06", b"\xa5\x5a\x04\x00\x00\x00\x15"
"""The same of the answers to GET_HEALTH and GET_SAMPLERATE [bytes]."""
NODE, CAPSULE, SAMPLES = 5, 84, 32
"""Length of a standard sample and of an express capsule [bytes], and samples in a capsule (LR001)."""
RANGE_MIN, RANGE_MAX = 0.15, 40.0
"""Limits over all models [m], which do not report their own; a reading of 0 is no return."""
SWEEP = 8192
"""More samples than in any turn; without a new turn in so many the sweep is dropped [samples]."""
LEAST_SAMPLES = 30
"""A turn of fewer is dropped: no model has under 200, and a line through the angles needs many [samples]."""
LEGACY = 476e-6
"""Time of a sample of firmware that does not tell it [s], which Slamtec's SDK assumes before 1.17."""
_PERIODS = 20e-6, 2e-3
"""Times of a sample that a turn may have [s]: 32000 samples a second, and a quarter of the least that is sold."""
_TURNS = 9
"""So many turns tell the time of a sample where the scanner does not [turns]: one alone errs by how late it is read."""
_CAPSULES = {0x83: "HQ nodes", 0x84: "ultra capsules", 0x85: "dense capsules", 0x86: "ultra-dense capsules"}
"""Data types of scans that are not read [number -> words] (Slamtec's SDK, sl_lidar_cmd.h)."""
_BEGIN = re.compile(rb"\xa5\x5a..\x00\x40([\x81-\x8f])", re.DOTALL)
"""A descriptor of any scan, with its data type [bytes]: many answers to one request (LR001)."""
_LOCK = 6
"""So many nodes in a row must look right before they are taken for nodes: each alone has 2 check bits [samples]."""
_ATTEMPTS, _ANSWER = 5, 0.5
"""How often a request is sent at most, and how long its answer is waited for [s]: bytes are lost on serial lines."""
_SPEEDS = {115200: "A1, A2", 256000: "A2M7, A2M12, A3, S1", 460800: "C1", 1000000: "S2, S3"}
"""Speeds of the serial port [baud -> models]."""

Sample = tuple[float, float, int]
"""Clockwise angle [deg, 0 to 360], distance [m], host time [ns]."""


class Sweep:
    """Samples to scans: a scan is complete when the angle begins anew."""

    def __init__(self, period: float | None, dropped: Counter[str]):
        """period: time between two samples [s], None where the scanner does not tell: the turns then do."""
        self.period = LEGACY if period is None else period
        self._turns: deque[float] | None = deque(maxlen=_TURNS) if period is None else None
        self._dropped = dropped
        self._samples: list[Sample] = []
        self._whole = False  # the first turn is seen from somewhere on

    def add(self, sample: Sample) -> list[Measured]:
        """The scan that ends before this sample, if one does."""
        found: list[Measured] = []
        if self._samples and self._samples[-1][0] < 30.0 and sample[0] > 330.0:
            return found  # a straggler of the turn before: offsets within a capsule may swap neighbours
        if self._samples and sample[0] < self._samples[-1][0] - 180.0:
            if self._whole:
                self._time(sample[2])
                found = self._close()
            self._samples, self._whole = [], True
        if len(self._samples) >= SWEEP:
            self._dropped[ScanLost.NO_TURN] += 1
            self._samples, self._whole = [], False
        self._samples.append(sample)
        return found

    def _time(self, end: int) -> None:
        """Finds the time of a sample from a turn that ends at a host time [ns], where it was not told."""
        period = (end - self._samples[0][2]) / 1e9 / len(self._samples)
        if self._turns is not None and _PERIODS[0] < period < _PERIODS[1]:
            self._turns.append(period)
            self.period = float(np.median(self._turns))

    def _close(self) -> list[Measured]:
        angle, distance = np.array([s[:2] for s in self._samples]).T
        order = np.argsort(angle, kind="stable")
        angle, distance = angle[order], distance[order]
        if angle.size < LEAST_SAMPLES or angle[-1] - angle[0] < 180.0:
            self._dropped[ScanLost.FEW_SAMPLES] += 1
            return []
        step = float(np.median(np.diff(angle)))
        index = np.round((angle - angle[0]) / step) if step > 0.0 else np.arange(float(angle.size))
        if index[-1] >= SWEEP:
            self._dropped[ScanLost.ANGLES] += 1
            return []
        # The motor's speed hardly changes within a turn: one straight line through all angles.
        slope, first = np.polyfit(index, angle, 1)
        slots = np.round((angle - first) / slope).astype(int)
        slots -= slots[0]
        ranges = np.full(min(slots[-1] + 1, SWEEP), np.inf, np.float32)
        ranges[slots[slots < SWEEP]] = np.where(distance > 0.0, distance, np.inf)[slots < SWEEP]
        begin = self._samples[0][2]
        angles = (-math.radians(first), -math.radians(slope))
        return [Measured(ScanMessage(begin, *angles, self.period, RANGE_MIN, RANGE_MAX, ranges), None)]


class StandardDecoder:
    """Nodes of 5 bytes: quality and start flag, angle [1/64 deg], distance [1/4 mm]."""

    def __init__(self, period: float | None, dropped: Counter[str]):
        """period: see `Sweep`."""
        self._sweep = Sweep(period, dropped)
        self._dropped = dropped
        self._buffer = b""
        self._locked = False
        self._angle = 0.0

    def feed(self, data: bytes, received: int) -> list[Measured]:
        """Scans that end among these bytes."""
        buffer, at = self._buffer + data, 0
        found: list[Measured] = []
        while len(buffer) - at >= (NODE if self._locked else NODE * _LOCK):
            node = _node(buffer, at)
            if self._locked and node is not None and _ahead(self._angle, node[0]):
                self._angle = node[0]
                behind = (len(buffer) - at - NODE) / NODE * self._sweep.period
                found += self._sweep.add((*node, received - round(behind * 1e9)))
                at += NODE
            elif not self._locked and _nodes(buffer, at):
                self._locked, self._angle = True, _node(buffer, at)[0]  # type: ignore[index]
            else:
                self._locked = False
                self._dropped["node: bytes skipped"] += 1
                at += 1
        self._buffer = buffer[at:]
        return found


def _node(buffer: bytes, at: int) -> tuple[float, float] | None:
    """Angle [deg] and distance [m] of the node there; None where its check bits are wrong."""
    flags, low = buffer[at], buffer[at + 1]
    if (flags & 1) == (flags >> 1 & 1) or not low & 1:
        return None
    angle = (low >> 1 | buffer[at + 2] << 7) / 64.0
    distance = (buffer[at + 3] | buffer[at + 4] << 8) / 4000.0
    return (angle % 360.0, distance) if angle < 370.0 else None


def _ahead(last: float, angle: float) -> bool:
    """Whether an angle follows the last one: at most a little back and not far ahead [deg]."""
    return (angle - last + 5.0) % 360.0 < 30.0


def _nodes(buffer: bytes, at: int) -> bool:
    """Whether what begins there looks like nodes."""
    angles = []
    for k in range(_LOCK):
        node = _node(buffer, at + k * NODE)
        if node is None or (angles and not _ahead(angles[-1], node[0])):
            return False
        angles.append(node[0])
    return True


class ExpressDecoder:
    """Capsules of 84 bytes: start angle, 16 cabins of two samples each, XOR check."""

    def __init__(self, period: float, dropped: Counter[str]):
        self._sweep = Sweep(period, dropped)
        self._period = period
        self._dropped = dropped
        self._buffer = b""
        self._capsule: tuple[bytes, int] | None = None  # waits for the angle at which the next begins
        self._turned = 0.0

    def feed(self, data: bytes, received: int) -> list[Measured]:
        """Scans that end among these bytes."""
        buffer, at = self._buffer + data, 0
        found: list[Measured] = []
        while len(buffer) - at >= CAPSULE:
            capsule = buffer[at : at + CAPSULE]
            if not _capsule_intact(capsule):
                self._dropped["capsule: bytes skipped"] += 1
                found += self._expand(None)
                at += 1
                continue
            behind = (len(buffer) - at - CAPSULE) / CAPSULE * SAMPLES * self._period
            found += self._expand(capsule)
            self._capsule = capsule, received - round(behind * 1e9)
            at += CAPSULE
        self._buffer = buffer[at:]
        return found

    def _expand(self, following: bytes | None) -> list[Measured]:
        """Adds the samples of the waiting capsule; if the next one is lost, the turn is taken from the one before."""
        if self._capsule is None:
            return []
        capsule, received = self._capsule
        self._capsule = None
        start = _start_angle(capsule)
        if following is not None:
            self._turned = (_start_angle(following) - start) % 360.0
        if not 0.0 < self._turned < 180.0:
            return []
        cabins = np.frombuffer(capsule, np.uint8, offset=4).reshape(16, NODE).astype(int)
        word = np.stack([cabins[:, 0] | cabins[:, 1] << 8, cabins[:, 2] | cabins[:, 3] << 8], -1)
        offset = np.stack([cabins[:, 4] & 0xF, cabins[:, 4] >> 4], -1) | (word & 3) << 4
        distance = ((word & 0xFFFC) / 4000.0).ravel()
        angle = (start + self._turned / SAMPLES * np.arange(SAMPLES) - offset.ravel() / 8.0) % 360.0
        age = (SAMPLES - 1 - np.arange(SAMPLES)) * self._period
        times = received - np.round(age * 1e9).astype(np.int64)
        found: list[Measured] = []
        for sample in zip(angle.tolist(), distance.tolist(), times.tolist(), strict=True):
            found += self._sweep.add(sample)
        return found


def _capsule_intact(capsule: bytes) -> bool:
    if capsule[0] >> 4 != 0xA or capsule[1] >> 4 != 0x5:
        return False
    return (capsule[0] & 0xF | (capsule[1] & 0xF) << 4) == xor(capsule[2:])


def _start_angle(capsule: bytes) -> float:
    """Clockwise angle of a capsule's first sample [deg]; the top bit only says that scanning has begun."""
    return ((capsule[2] | capsule[3] << 8) & 0x7FFF) / 64.0


def xor(data: bytes) -> int:
    """Exclusive or of all bytes."""
    return int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint8)))


class Rplidar:
    """Stops the scanner, asks for its health and sample times, starts the motor and the scan.

    A scanner that has no express scan which is read (C1, S2, S3, firmware before 1.17) scans as by `mode=standard`.
    """

    kind = "lidar"
    bauds = tuple(_SPEEDS)
    dtr = False  # set, it stops the motor of an A1
    tcp_port = 20108
    silence = 4.0  # the motor takes a while
    options: Mapping[str, Option] = {"mode": Option("express", "standard|express", "standard or express")}

    def start(self, port: Port, options: Mapping[str, str], dropped: Counter[str]) -> Session:
        port.write(STOP)
        _drain(port, 0.1)
        health = _answer(port, GET_HEALTH, HEALTH_HEADER, 3)
        if health[0] == 2:
            port.write(RESET)
            code = health[1] | health[2] << 8
            raise DeviceFailure(f"the scanner reports error {code} and is reset; if it stays, its power or motor fails")
        try:
            rates = _answer(port, GET_SAMPLERATE, RATE_HEADER, 4)
        except DeviceFailure:
            rates = bytes(4)
        standard, express = (int.from_bytes(rates[k : k + 2], "little") / 1e6 for k in (0, 2))
        port.write(MOTOR_ON)
        notes = []
        if options["mode"] == "express":
            found = _begin(port, EXPRESS) if express else None
            if found is not None and found[0] == EXPRESS_HEADER[-1]:
                return Session(ExpressDecoder(express, dropped), found[1])
            port.write(STOP)
            _drain(port, 0.1)
            told = f"{_described(found)} to an express scan" if express else "tells of no express scan (old firmware)"
            notes = [f"the scanner {told}: standard scan is used, as by mode=standard"]
        found = _begin(port, SCAN)
        if found is None or found[0] != SCAN_HEADER[-1]:
            raise DeviceFailure(f"the scanner {_described(found)} to a standard scan (0x81)")
        return Session(StandardDecoder(standard or None, dropped), found[1], notes=tuple(notes))


def _begin(port: Port, request: bytes) -> tuple[int, bytes] | None:
    """Data type of the scan that a request begins, and what came behind its descriptor; None where nothing begins."""

    def find(received: bytes) -> tuple[int, bytes] | None:
        match = _BEGIN.search(received)
        return None if match is None else (match[1][0], received[match.end() :])

    for _ in range(_ATTEMPTS):
        port.write(request)
        if (found := read_until(port, find, _ANSWER)) is not None:
            return found
    return None


def _described(found: tuple[int, bytes] | None) -> str:
    """How a scanner answers where it does not begin the scan that is read."""
    if found is None:
        return "does not answer"
    return f"answers with descriptor 0x{found[0]:02x} ({_CAPSULES.get(found[0], 'unknown')}, not read)"


def _answer(port: Port, request: bytes, header: bytes, length: int) -> bytes:
    """Answer of a length after its header. Raises DeviceFailure, which tells what came instead."""
    heard = b""

    def find(received: bytes) -> bytes | None:
        nonlocal heard
        heard = received
        begin = received.find(header) + len(header)
        return received[begin : begin + length] if len(header) <= begin <= len(received) - length else None

    for _ in range(_ATTEMPTS):
        port.write(request)
        if (answer := read_until(port, find, _ANSWER)) is not None:
            return answer
    if (begin := heard.find(header[:2])) >= 0 and len(heard) >= begin + len(header):
        kind = heard[begin + len(header) - 1]
        raise DeviceFailure(f"answers with descriptor 0x{kind:02x} in place of 0x{header[-1]:02x}: no RPLIDAR we know")
    what = "an answer that is none" if heard else "no answer"
    speeds = ", ".join(f"{baud} {models}" for baud, models in _SPEEDS.items())
    raise NoAnswer(f"{what}: not an RPLIDAR, no power, or another baud ({speeds}), tried in turn unless baud= is given")


def _drain(port: Port, quiet: float) -> None:
    """Reads until nothing comes for a while [s]."""
    until = time.monotonic() + 2.0
    while port.read(quiet) and time.monotonic() < until:
        pass
