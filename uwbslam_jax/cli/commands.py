"""What each command of the command line does: options, files, progress and figures. All printing is here.

Every key of the settings is a flag of `run` (--uwb.sigma-n 0.1); a flag goes before the file given by --config.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tqdm import tqdm
from tyro.conf import Positional, arg

from uwbslam_drivers.emulators.command import EmulateOptions, emulate
from uwbslam_jax import api
from uwbslam_jax.cli.finish_run import accuracy, deliver, table
from uwbslam_jax.cli.live_command import LiveOptions, live
from uwbslam_jax.cli.tune_command import TuneOptions, tune
from uwbslam_jax.files import settings_file
from uwbslam_jax.settings import Settings
from uwbslam_jax.simulation import Simulation, simulate


@dataclass
class RunOptions:
    """Run a recording; its track, beacons, map, summary and report go into a folder."""

    logs: Positional[tuple[Path, ...]]
    """MCAP recording, or a ROS 2 bag folder; several MCAP files are one recording."""
    out: Annotated[Path, arg(aliases=["-o"])]
    """Folder for the files; it is created."""
    config: Path | None = None
    """Settings in TOML; flags go before it."""
    no_odom: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave odometry out, short for --odom.no-use."""
    lidar_only: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave the ranges out, short for --filter.lidar-only."""
    resume: Path | None = None
    """Go on with map and beacons of this folder of a run."""
    localize: Path | None = None
    """Start from map and beacons of this folder of a run and only localise: both stay as they are."""
    online: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Step frame by frame as on the robot; the same result, more slowly."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """No progress bar."""
    settings: Annotated[Settings, arg(name="")] = field(default_factory=Settings)


@dataclass
class DemoOptions:
    """Simulate a robot in a workshop with five beacons, run the recording, and report how far off the answer is."""

    seed: int = 0
    """Another seed is another workshop."""
    duration: float = 150.0
    """Length of the recording [s]."""
    out: Annotated[Path, arg(aliases=["-o"])] = Path("uwbslam-demo")
    """Folder for the recording and the files of the run; it is created."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """No progress bars."""


@dataclass
class SimulateOptions:
    """Write a recording of a ready-made scenario, with ground truth, and the settings that fit its robot, if any."""

    name: Positional[str]
    """The scenario."""
    out: Annotated[Path, arg(aliases=["-o"])]
    """The recording (.mcap); settings go beside it (.toml)."""
    seed: int = 0
    """Another seed is another world."""
    duration: float | None = None
    """Length of the recording [s]; the scenario's own where not given."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """No progress bar."""


@dataclass
class EvaluateOptions:
    """Compare a run with ground truth, after one rigid motion that lays robot and beacons together over it."""

    directory: Positional[Path]
    """Folder that `uwbslam run` wrote."""
    truth: Positional[Path]
    """Recording (.mcap) with ground truth, or arrays t, robot, ids, beacons (.npz)."""


@dataclass
class InspectOptions:
    """Show what a recording holds: topics, rates, gaps, nodes heard, and what is missing."""

    logs: Positional[tuple[Path, ...]]
    """MCAP recording, or a ROS 2 bag folder; several MCAP files are one recording."""
    config: Path | None = None
    """Settings in TOML, for the topics and the robot's id."""


def call(command: str, words: Sequence[str]) -> None:
    """Runs one command with its own arguments.

    Raises:
      UwbslamError, OSError: what a user can repair.
      SystemExit: bad usage (status 2), or help was asked for (0); the text is printed.
    """
    options, run = _COMMANDS[command]
    default: Any = None
    names = {field.name for field in dataclasses.fields(options)}
    if "settings" in names:
        required = {name: blank for name, blank in (("logs", ()), ("out", Path())) if name in names}
        default = options(**required, settings=_settings_file(words))
        for name in required:  # these have to be given all the same
            setattr(default, name, tyro.MISSING)
    run(tyro.cli(options, args=list(words), default=default, prog=f"uwbslam {command}", description=options.__doc__))


def _settings_file(words: Sequence[str]) -> Settings:
    """The settings of the file given by --config: they are the defaults that the flags are read against."""
    for k, word in enumerate(words):
        if word == "--config" and k + 1 < len(words):
            return settings_file.load_settings(words[k + 1])
        if word.startswith("--config="):
            return settings_file.load_settings(word.removeprefix("--config="))
    return Settings()


def run(options: RunOptions) -> None:
    """The command `run`."""
    settings = options.settings
    if options.no_odom:
        settings = dataclasses.replace(settings, odom=dataclasses.replace(settings.odom, use=False))
    if options.lidar_only:
        settings = dataclasses.replace(settings, filter=dataclasses.replace(settings.filter, lidar_only=True))
    title = f"UWB and LiDAR SLAM: {', '.join(log.name for log in options.logs)}"
    goes_on = {"online": options.online, "resume": options.resume, "localize": options.localize}
    _run_and_write(options.logs, settings, options.out, title, quiet=options.quiet, **goes_on)


def demo(options: DemoOptions) -> None:
    """The command `demo`."""
    options.out.mkdir(parents=True, exist_ok=True)
    made = simulate("workshop", options.seed, options.duration)
    log = options.out / "demo.mcap"
    _record(made, log, options.quiet)
    _run_and_write((log,), made.settings, options.out, "UWB and LiDAR SLAM demo", quiet=options.quiet)


def simulate_scenario(options: SimulateOptions) -> None:
    """The command `simulate`."""
    made = simulate(options.name, options.seed, options.duration)
    _record(made, options.out, options.quiet)
    print(f"recording: {options.out} ({made.scenario.duration:.1f} s)")
    if made.settings != Settings():
        path = options.out.with_suffix(".toml")
        settings_file.save_settings(made.settings, path)
        print(f"settings: {path}")


def evaluate_run(options: EvaluateOptions) -> None:
    """The command `evaluate`."""
    print(table(accuracy(api.evaluate(options.directory, options.truth))))


def inspect_log(options: InspectOptions) -> None:
    """The command `inspect`."""
    print(api.inspect(options.logs, settings_file.load_settings(options.config) if options.config else None))


_COMMANDS: dict[str, tuple[Any, Callable[[Any], None]]] = {
    "demo": (DemoOptions, demo),
    "run": (RunOptions, run),
    "simulate": (SimulateOptions, simulate_scenario),
    "evaluate": (EvaluateOptions, evaluate_run),
    "inspect": (InspectOptions, inspect_log),
    "tune": (TuneOptions, tune),
    "live": (LiveOptions, live),
    "emulate": (EmulateOptions, emulate),
}
"""Every command [name -> its options, what runs it]."""


def _run_and_write(
    logs: tuple[Path, ...], settings: Settings, out: Path, title: str, *, quiet: bool, **how: Any
) -> None:
    """Runs a recording, writes every file of the run and prints its figures. how: see api.run."""
    settings_file.check(settings)
    out.mkdir(parents=True, exist_ok=True)  # before the long work, not after it
    with tqdm(desc="run", unit="msg", leave=False, disable=True if quiet else None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        result = api.run(logs, settings, progress=progress, **how)
    deliver(result, out, title)


def _record(made: Simulation, path: Path, quiet: bool) -> None:
    """Writes the messages of a simulation."""
    scans = int(made.scenario.duration * made.scenario.lidar.rate)
    bar = tqdm(desc="simulate", unit="scan", total=scans, leave=False, disable=True if quiet else None)
    with bar:
        made.save(path, lambda scans: bar.update(scans - bar.n))
