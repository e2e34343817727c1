"""The command `emulate`: its options, and the run from the first listener to the end."""

from __future__ import annotations

import difflib
import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from tyro.conf import Positional

from uwbslam_drivers.clock import host_time
from uwbslam_drivers.device import DriverError
from uwbslam_drivers.emulators.faults import Faults, Repeated
from uwbslam_drivers.emulators.plugs import Plug, PtyPlug, TcpPlug
from uwbslam_drivers.emulators.robot import Departure, DeviceTime, write_truth
from uwbslam_drivers.emulators.serve import EMULATORS, Server
from uwbslam_drivers.source import DEVICES
from uwbslam_jax.sim import SCENARIOS, Scenario, make_scenario

LOOPBACK = "127.0.0.1"
"""Host where emulators listen by default [host]: nothing outside this computer reaches them."""
_LOOK = 0.2
"""Time between two looks at whether somebody listens, or all is over [s]: short to a person."""


@dataclass
class EmulateOptions:
    """Serve the sensors of a simulated robot in real time, for uwbslam live; it sets off when somebody listens."""

    devices: Positional[tuple[str, ...]]
    """hokuyo, rplidar, rplidar-c1, rplidar-old, dwm1000, dwm1000-powers, linktrack, linktrack3, dwm1001, makerfabs;
    NAME=URL for another port (tcp://HOST:PORT or serial:///PATH, a link to a pseudo-terminal). All belong to one
    robot."""
    world: str = "workshop"
    """The scenario, as of uwbslam simulate."""
    seed: int = 0
    """Another seed is another world."""
    duration: float = 3600.0
    """The robot drives so long [s]; then the emulators end."""
    truth: Path | None = None
    """Ground truth goes here (.npz), in host time."""
    drop: float = 0.0
    """Share of the bytes that are lost."""
    corrupt: float = 0.0
    """Share of the bytes that are damaged."""
    split: int = 0
    """Send pieces of 1 to so many bytes."""
    coalesce: float = 0.0
    """What is sent within this time arrives together [s]."""
    pause: Repeated | None = None
    """Every so many seconds, the line stands still for so many."""
    unplug: Repeated | None = None
    """Every so many seconds, the plug is pulled for so many; the device restarts."""
    drift: float = 30.0
    """Device clocks run too fast by so many parts in a million."""


def emulate(options: EmulateOptions) -> None:
    """Serves until the duration is over or Ctrl-C.

    Raises:
      DriverError: an option cannot be met. OSError: a port or the truth's file cannot be made.
    """
    made = _check(options)
    departure = Departure()
    faults = Faults(options.drop, options.corrupt, options.split, options.coalesce, options.pause, options.unplug)
    servers = list(_servers(options, made, departure, faults))
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # a script's `kill` ends it like Ctrl-C
    try:
        for server in servers:
            server.start()
        print("\n".join(_listing(servers)), flush=True)
        while departure.at is None and all(server.running for server in servers):
            time.sleep(_LOOK)
        print("the robot sets off", flush=True)
        if options.truth is not None and departure.at is not None:
            # All of it now, in case this process is killed; what was driven, at the end.
            write_truth(options.truth, made, departure.at, options.duration)
        while all(server.running for server in servers):
            time.sleep(_LOOK)
    except KeyboardInterrupt:
        print("stopped", flush=True)
    finally:
        for server in servers:
            server.stop()
        if options.truth is not None and departure.at is not None:
            driven = min((host_time() - departure.at) / 1e9, options.duration)
            write_truth(options.truth, made, departure.at, driven)


def _check(options: EmulateOptions) -> Scenario:
    """The scenario, if all options are sound."""
    if options.world not in SCENARIOS:
        raise DriverError(f"no world {options.world}; there are {', '.join(SCENARIOS)}")
    if not options.devices:
        raise DriverError(f"no device given; there are {', '.join(EMULATORS)}")
    for name, share in (("drop", options.drop), ("corrupt", options.corrupt)):
        if not 0.0 <= share < 1.0:
            raise DriverError(f"{name} {share:g}: must be at least 0 and less than 1")
    if not (options.duration > 0.0 and options.split >= 0 and options.coalesce >= 0.0 and options.seed >= 0):
        raise DriverError("duration must be greater than 0; split, coalesce and seed must not be negative")
    for name, repeated in (("pause", options.pause), ("unplug", options.unplug)):
        if repeated is not None and not 0.0 < repeated[1] < repeated[0]:
            raise DriverError(f"{name} {repeated[0]:g} {repeated[1]:g}: the second must be between 0 and the first")
    return make_scenario(options.world, options.seed, options.duration)


def _servers(options: EmulateOptions, made: Scenario, departure: Departure, faults: Faults) -> Iterator[Server]:
    for number, word in enumerate(options.devices):
        name, _, url = word.partition("=")
        if name not in EMULATORS:
            near = difflib.get_close_matches(name, EMULATORS, 1)
            hint = f", did you mean {near[0]}?" if near else f"; there are {', '.join(EMULATORS)}"
            raise DriverError(f"no emulated device {name}{hint}")
        # An odd uptime each: nothing may depend on devices that were switched on just now, or together.
        device = EMULATORS[name](DeviceTime(host_time(), 1_234_567_890 * (number + 1), options.drift))
        yield Server(device, _plug(name, url), made, departure, faults, number)


def _plug(name: str, url: str) -> Plug:
    """The plug at a URL, by default where the device has it; radios and RPLIDARs are at a serial port."""
    if not url and name == "hokuyo":
        return TcpPlug(LOOPBACK, DEVICES[name].tcp_port or 0)
    try:
        parts = urlsplit(url)
        if parts.scheme == "tcp":
            return TcpPlug(parts.hostname or LOOPBACK, parts.port or 0)
    except ValueError as error:
        raise DriverError(f"{url}: {error}") from None
    if url and (parts.scheme != "serial" or parts.netloc or not parts.path.strip("/")):
        raise DriverError(f"{url}: must be tcp://HOST:PORT or serial:///PATH")
    return PtyPlug(Path(parts.path) if url else Path(tempfile.gettempdir()) / f"uwbslam-{name}")


def _listing(servers: Sequence[Server]) -> Iterator[str]:
    """What listens where, and the command that listens to it."""
    words = []
    for server in servers:
        kind = DEVICES[server.protocol].kind
        words.append(f"--{kind} '{server.url}'")
        yield f"{server.protocol:<10} {server.url}"
    yield f"\nuwbslam live {' '.join(words)} -o DIR\n"
