"""The command `live`: its options, and a run from the first device to the last file."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import arg

from uwbslam_jax.api import Slam
from uwbslam_jax.cli.finish_run import deliver, warn
from uwbslam_jax.errors import UsageError
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.files import settings_file
from uwbslam_jax.live import Devices, LiveRun, Publisher, rehearse
from uwbslam_jax.settings import Settings
from uwbslam_jax.sim import SCENARIOS, make_scenario, settings_overrides
from uwbslam_jax.web import LivePage, LiveView, parse_address

_LOOPBACK, _PUBLISH_PORT = "127.0.0.1", 8766
"""Host of the view by default [name], which nothing outside this computer reaches, and port of the publisher [number]:
Foxglove's own, 8765, is taken by the view."""
_EMULATE = """\
import ctypes, sys
from uwbslam_jax.__main__ import main
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, 15)  # PR_SET_PDEATHSIG: ends when we do, even if we are killed
main(sys.argv[1:])
"""
"""Program that runs the emulators [Python]: a process of its own, for it must not slow the run down."""
_TRUTH = "truth.npz"
"""Where the emulators write their truth, and the run looks for it [file in its folder]."""


@dataclass
class LiveOptions:
    """Run on devices: record them, show map, track and beacons in the browser, and write a run's files at the end.

    Ends with Ctrl-C. Devices are URLs: tcp://HOST:PORT or serial:///dev/ttyACM0?baud=115200&protocol=dwm1000; see
    drivers/README.md for the protocols.
    """

    out: Annotated[Path, arg(aliases=["-o"])]
    """Folder for recording and files; it is created. A recording that is there is never overwritten."""
    lidar: str | None = None
    """URL of the LiDAR; by default a Hokuyo's protocol. Without, the radios' ranges are all there is."""
    uwb: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """URL of a UWB radio, by default in our line protocol; may be given several times."""
    emulate: str | None = None
    """Instead of devices: emulators of a robot in this world (workshop, hall, office ...), with its truth."""
    config: Path | None = None
    """Settings in TOML; flags go before it."""
    resume: Path | None = None
    """Go on with map and beacons of this folder of a run, killed or ended."""
    localize: Path | None = None
    """Start from map and beacons of this folder of a run and only localise: both stay as they are."""
    view: str = f"{_LOOPBACK}:8765"
    """HOST:PORT of the live view; 'off' for none. Everybody who can reach it sees the map."""
    publish: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Publish ROS 2 messages over a Foxglove WebSocket at port 8766 of the same host."""
    duration: float | None = None
    """End after so long [s]."""
    settings: Annotated[Settings, arg(name="")] = field(default_factory=Settings)


def live(options: LiveOptions) -> None:
    """The command `live`.

    Raises:
      DriverError, UsageError: a URL, port or option that cannot be met.
      LogError, RunError, OSError: a file that cannot be used.
    """
    settings = _check(options)
    devices = None if options.emulate is not None else Devices(options.lidar, options.uwb)
    slam = Slam(settings, resume=options.resume, localize=options.localize, fit=False)
    options.out.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as ends, _until_stopped(options.duration) as go:
        page, publisher = _outputs(options, ends)
        if devices is None:
            devices = Devices(*ends.enter_context(_emulators(str(options.emulate), options.out)))
        print("getting ready", flush=True)
        rehearse(slam.settings)
        if not go():
            raise KeyboardInterrupt
        recording = options.out / f"live-{datetime.now(UTC):%Y%m%d-%H%M%S}.mcap"
        run = LiveRun(slam, devices, recording, page=page, publisher=publisher, tell=warn)
        print(f"recording to {recording}; Ctrl-C ends", flush=True)
        result = run.run(go)
        if not result.summary["steps"]:
            raise UsageError(f"nothing was measured: {'; '.join(devices.troubles())}")
    truth = options.out / _TRUTH
    if options.emulate is not None and truth.exists() and len(result.stamps):
        result.truth = Truth.load(truth)
    deliver(result, options.out, f"UWB and LiDAR SLAM: {recording.name}", set(run.told.values()))
    print(_losses(result.summary))


def _losses(summary: dict) -> str:
    """Latency and losses in a line."""
    median, worst = summary["latency_ms_median"], summary["latency_ms_p99"]
    lost = ", ".join(f"{count} {why}" for why, count in summary["dropped"].items()) or "nothing"
    latency = "no scan came" if median is None else f"{median:.1f} ms, 99 % {worst:.1f} ms"
    return f"arrival to pose: {latency}\ndropped: {lost}"


def _check(options: LiveOptions) -> Settings:
    """The settings, if all options are sound."""
    if options.duration is not None and not options.duration > 0.0:
        raise UsageError(f"duration {options.duration:g} s: must be greater than 0")
    if options.emulate is not None:
        if options.lidar is not None or options.uwb:
            raise UsageError("--emulate brings its own devices: leave --lidar and --uwb out")
        if options.emulate not in SCENARIOS:
            raise UsageError(f"no world {options.emulate}; there are {', '.join(SCENARIOS)}")
    elif options.lidar is None and not options.uwb:
        raise UsageError("no device: give --lidar URL and --uwb URL, or --emulate workshop to try it without any")
    settings = options.settings
    if options.emulate is not None:  # what a user would configure for this robot
        fits = settings_file.from_dict(settings_overrides(make_scenario(options.emulate, 0, None)))
        uwb = dataclasses.replace(settings.uwb, height=fits.uwb.height | settings.uwb.height)
        settings = dataclasses.replace(settings, uwb=uwb)
        settings = settings if settings.robot != Settings().robot else dataclasses.replace(settings, robot=fits.robot)
    elif not options.uwb:
        settings = dataclasses.replace(settings, filter=dataclasses.replace(settings.filter, lidar_only=True))
    return settings_file.check(settings)


def _outputs(options: LiveOptions, ends: contextlib.ExitStack) -> tuple[LivePage | None, Publisher | None]:
    """View and publisher, as far as they are wanted; they end with the stack."""
    host, page, publisher = _LOOPBACK, None, None
    if options.view != "off":
        host, port = parse_address(options.view)
        page = LivePage("UWB and LiDAR SLAM, live", scans=options.lidar is not None or options.emulate is not None)
        view = LiveView(page, host, port)
        ends.callback(view.close)
        print(f"live view: {view.url}", flush=True)
    if options.publish:
        publisher = Publisher(host, _PUBLISH_PORT)
        ends.callback(publisher.close)
        print(f"publishing: {publisher.url}", flush=True)
    return page, publisher


@contextlib.contextmanager
def _until_stopped(duration: float | None) -> Iterator[Callable[[], bool]]:
    """A question whether to go on: until SIGINT, SIGTERM, or a time since it was first asked [s]."""
    stopped = threading.Event()
    begin: list[float] = []

    def go() -> bool:
        begin[:] = begin or [time.monotonic()]
        return not stopped.is_set() and (duration is None or time.monotonic() - begin[0] < duration)

    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, lambda *_: stopped.set())
    try:
        yield go
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _emulators(world: str, out: Path) -> Iterator[tuple[str, tuple[str, ...]]]:
    """URLs of an emulated Hokuyo and emulated DWM1000 radios, served by a process of their own until the end."""
    devices = ["hokuyo=tcp://127.0.0.1:0", f"dwm1000=serial://{(out / 'dwm1000').absolute()}"]
    command = [sys.executable, "-c", _EMULATE, "emulate", *devices, "--world", world, "--truth", str(out / _TRUTH)]
    # in a session of its own, or Ctrl-C would end it before the run
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as process:
        try:
            urls: dict[str, str] = {}
            said = ""
            while len(urls) < len(devices):
                line = process.stdout.readline() if process.stdout else ""
                name, _, url = line.strip().partition(" ")
                if not line:
                    raise UsageError(f"the emulators do not start: {said}")
                said = line.strip()
                if "://" in url and not name.startswith("uwbslam"):
                    urls[name] = url.strip()
            yield urls["hokuyo"], (urls["dwm1000"],)
        finally:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=20.0)
