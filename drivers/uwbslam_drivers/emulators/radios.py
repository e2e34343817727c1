"""Emulated UWB radios: our line protocol, LinkTrack, DWM1001 and Makerfabs, with the ranges of the simulated robot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from uwbslam_drivers import dwm1000, linktrack
from uwbslam_drivers.emulators import robot
from uwbslam_drivers.emulators.robot import DeviceTime
from uwbslam_jax.measurements import RangeMessage
from uwbslam_jax.sim import Scenario

PROCESSING = 1_000_000
"""A range is sent after this time: no radio answers at once [ns]."""
TAG, ANCHOR = 2, 1
"""Roles of LinkTrack [one byte] (NLink protocol)."""


class Radio:
    """What all radios have in common: they send by themselves and hear nothing."""

    def __init__(self, time: DeviceTime):
        self.time = time

    def restart(self, time: DeviceTime) -> None:
        """Loses its power and comes back."""
        self.__init__(time)

    def measurements(self, scenario: Scenario) -> Iterator[tuple[int, Any]]:
        """Rounds of the robot's own exchanges."""
        for due, messages in robot.rounds(scenario):
            yield due + PROCESSING, messages

    def answer(self, data: bytes, host: int) -> bytes:
        return b""


class EmulatedDwm1000(Radio):
    """A board behind a microcontroller that reports every exchange with the DW1000's diagnostics."""

    protocol = "dwm1000"

    def measurements(self, scenario: Scenario) -> Iterator[tuple[int, RangeMessage]]:
        for due, message in robot.ranges(scenario):
            yield due + PROCESSING, message

    def encode(self, message: RangeMessage, departure: int) -> bytes:
        time = self.time.at(robot.host_stamp(message.stamp, departure)) % dwm1000.WRAP // dwm1000.US
        head = f"{time},{message.source},{message.target},{round(message.range * 1e3)}"
        return dwm1000.frame(self._line(head, message))

    def _line(self, head: str, message: RangeMessage) -> str:
        if math.isnan(message.receive_power):
            return f"UWBP,{head},,"
        return f"UWBD,{head},64,{','.join(map(str, diagnostics(message.receive_power, message.first_path_power)))}"


class EmulatedDwm1000Powers(EmulatedDwm1000):
    """The same with powers that the board has worked out itself."""

    def _line(self, head: str, message: RangeMessage) -> str:
        powers = (message.receive_power, message.first_path_power)
        return f"UWBP,{head},{','.join('' if math.isnan(power) else f'{power:.2f}' for power in powers)}"


def diagnostics(receive: float, first_path: float) -> tuple[int, int, int, int, int]:
    """F1, F2, F3, C, N of a DW1000 at 64 MHz that mean these powers [dBm]; N as large as the registers allow."""
    constant = dwm1000.PRF_CONSTANT[64]
    amplitude = math.sqrt(10.0 ** ((first_path + constant) / 10.0) / 3.0)
    power = 10.0 ** ((receive + constant) / 10.0) / 2.0**17
    n = min(int(65535 / amplitude), int(math.sqrt(65535 / power)), 1024)
    f = round(amplitude * n)
    return f, f, f, round(power * n * n), n


class EmulatedLinkTrack(Radio):
    """A tag that sends NodeFrame2; the system time of each range in it."""

    protocol = "linktrack"
    _mark, _fixed, _layout = linktrack.FRAME2, linktrack.FIXED2, linktrack.NODE2

    def encode(self, messages: list[RangeMessage], departure: int) -> bytes:
        system = [self._clock(robot.host_stamp(m.stamp, departure)) for m in messages]
        length = self._fixed + len(messages) * self._layout.size + 1
        fixed = bytearray(self._fixed)
        fixed[0:6] = self._mark + length.to_bytes(2, "little") + bytes([TAG, messages[0].source & 0xFF])
        self._times(fixed, system[-1])
        fixed[-3:] = (4900).to_bytes(2, "little") + bytes([len(messages)])
        nodes = b"".join(self._node(m, t) for m, t in zip(messages, system, strict=True))
        frame = bytes(fixed) + nodes
        return frame + bytes([sum(frame) & 0xFF])

    def _clock(self, host: int) -> int:
        return self.time.at(host) % linktrack.WRAP // linktrack.MS

    def _times(self, fixed: bytearray, system: int) -> None:
        fixed[6:10] = system.to_bytes(4, "little")

    def _node(self, message: RangeMessage, system: int) -> bytes:
        return self._layout.pack(*_node_fields(message), system)


class EmulatedLinkTrack3(EmulatedLinkTrack):
    """A tag that sends NodeFrame3; one system time for all of its ranges, that of the last."""

    _mark, _fixed, _layout = linktrack.FRAME3, linktrack.FIXED3, linktrack.NODE3

    def _times(self, fixed: bytearray, system: int) -> None:
        fixed[6:14] = 2 * system.to_bytes(4, "little")

    def _node(self, message: RangeMessage, system: int) -> bytes:
        return self._layout.pack(*_node_fields(message))


def _node_fields(message: RangeMessage) -> tuple[int, int, bytes, int, int]:
    powers = (message.first_path_power, message.receive_power)
    halves = [0 if math.isnan(power) else min(round(-2.0 * power), 255) for power in powers]
    return ANCHOR, message.target & 0xFF, round(message.range * 1e3).to_bytes(3, "little"), halves[0], halves[1]


class EmulatedDwm1001(Radio):
    """A module whose shell has to be entered and given the command `lec`."""

    protocol = "dwm1001"

    def __init__(self, time: DeviceTime):
        super().__init__(time)
        self._shell = self._sends = False
        self._heard = b""

    def encode(self, messages: list[RangeMessage], departure: int) -> bytes:
        if not self._sends:
            return b""
        anchors = [f"AN{k},{m.target:04X},0.00,0.00,0.00,{m.range:.2f}" for k, m in enumerate(messages)]
        return ",".join([f"DIST,{len(anchors)}", *anchors]).encode() + b"\r\n"

    def answer(self, data: bytes, host: int) -> bytes:
        *lines, self._heard = (self._heard + data)[-64:].split(b"\r")
        said = b""
        for line in lines:
            if not self._shell:
                self._shell = True
                said += b"\r\n\r\n DWM1001 TWR Real Time Location System\r\n\r\n dwm> "
            elif line.strip() in (b"lec", b"") and (line.strip() or self._sends):
                self._sends = not self._sends
            else:
                said += b"\r\ndwm> "
        return said


class EmulatedMakerfabs(Radio):
    """A tag that reports up to eight anchors."""

    protocol = "makerfabs"

    def __init__(self, time: DeviceTime):
        super().__init__(time)
        self._number = 0

    def encode(self, messages: list[RangeMessage], departure: int) -> bytes:
        self._number = (self._number + 1) % 256
        heard = messages[:8]
        empty = 8 - len(heard)
        centimetres = [round(m.range * 100.0) for m in heard] + [0] * empty
        powers = [0.0 if math.isnan(m.receive_power) else m.receive_power for m in heard] + [0.0] * empty
        ids = [m.target for m in heard] + [-1] * empty
        return (
            f"AT+RANGE=tid:{messages[0].source},mask:{(1 << len(heard)) - 1:02X},seq:{self._number},"
            f"range:({','.join(map(str, centimetres))}),rssi:({','.join(f'{p:.2f}' for p in powers)}),"
            f"ancid:({','.join(map(str, ids))})\r\n"
        ).encode()
