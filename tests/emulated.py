"""What emulated devices say, as bytes without a port, and the decoders that should understand it."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NamedTuple

from uwbslam_drivers import rplidar
from uwbslam_drivers.device import Decoder, Measured
from uwbslam_drivers.dwm1000 import Dwm1000Decoder
from uwbslam_drivers.dwm1001 import Dwm1001Decoder
from uwbslam_drivers.emulators.robot import DeviceTime
from uwbslam_drivers.emulators.serve import EMULATORS
from uwbslam_drivers.hokuyo import UTM_30LX_EW, HokuyoDecoder
from uwbslam_drivers.linktrack import LinkTrackDecoder
from uwbslam_drivers.makerfabs import MakerfabsDecoder
from uwbslam_jax.sim import Scenario, make_scenario

DEPARTURE = 1_800_000_000_000_000_000
"""Host time at which the robot sets off [ns]."""
SHOWS = 7_000_000_000
"""What every device's clock shows at that time [ns]."""


class Language(NamedTuple):
    """One device and one of its modes.

    Attributes:
      emulator: name in EMULATORS.
      request: what makes it send.
      decoder: for what it sends.
      holds: the pickled decoder never gets larger [bytes].
      loses: so many measurements after garbage may be lost with it.
    """

    emulator: str
    request: bytes
    decoder: Callable[[Counter[str]], Decoder]
    holds: int = 20_000
    loses: int = 0


LANGUAGES: dict[str, Language] = {
    "hokuyo md": Language("hokuyo", b"MD0000108001000\n", lambda dropped: HokuyoDecoder(UTM_30LX_EW, dropped), loses=2),
    "hokuyo me": Language(
        "hokuyo", b"ME0000108001000\n", lambda dropped: HokuyoDecoder(UTM_30LX_EW, dropped, True), loses=2
    ),
    # A turn of garbage, and the one that it ends in.
    "rplidar standard": Language(
        "rplidar", rplidar.SCAN, lambda dropped: rplidar.StandardDecoder(500e-6, dropped), 500_000, loses=2
    ),
    "rplidar express": Language(
        "rplidar", rplidar.EXPRESS, lambda dropped: rplidar.ExpressDecoder(250e-6, dropped), 500_000, loses=2
    ),
    "dwm1000": Language("dwm1000", b"", Dwm1000Decoder),
    "dwm1000-powers": Language("dwm1000-powers", b"", Dwm1000Decoder),
    "linktrack": Language("linktrack", b"", LinkTrackDecoder),
    "linktrack3": Language("linktrack3", b"", LinkTrackDecoder),
    # Text without a check: the first line may be glued to the garbage.
    "dwm1001": Language("dwm1001", b"\r\rlec\r", lambda dropped: Dwm1001Decoder(0, dropped), loses=4),
    "makerfabs": Language("makerfabs", b"", MakerfabsDecoder, loses=8),
}


@cache
def workshop() -> Scenario:
    return make_scenario("workshop", 3, 30.0)


@cache
def spoken(name: str, seconds: float) -> tuple[tuple[int, bytes, Any], ...]:
    """Host time [ns], bytes and simulated measurement of all that a device sends in some seconds."""
    return tuple(speak(name, seconds))


def speak(name: str, seconds: float) -> Iterator[tuple[int, bytes, Any]]:
    language = LANGUAGES[name]
    device = EMULATORS[language.emulator](DeviceTime(DEPARTURE, SHOWS))
    device.answer(language.request, DEPARTURE)
    for due, measurement in device.measurements(workshop()):
        if due > seconds * 1e9:
            return
        yield DEPARTURE + due, device.encode(measurement, DEPARTURE), measurement


def stream(name: str, seconds: float) -> bytes:
    """All bytes that a device sends in some seconds."""
    return b"".join(data for _, data, _ in spoken(name, seconds))


def decode(decoder: Decoder, data: bytes, size: int | None = None) -> list[Measured]:
    """What a decoder makes of bytes, fed in pieces of a size, or whole."""
    size = size or max(len(data), 1)
    return [m for k in range(0, len(data), size) for m in decoder.feed(data[k : k + size], DEPARTURE)]


def held(decoder: Decoder) -> int:
    """How much a decoder holds [bytes], more or less."""
    return len(pickle.dumps(decoder))
