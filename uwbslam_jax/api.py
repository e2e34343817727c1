"""The front door: what scripts, notebooks, the command line and a live run call.

Batch mode steps groups of frames at once, online mode frame by frame; both give the same bits.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import time
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeGuard, cast

from uwbslam_jax import evaluation, result as data
from uwbslam_jax.errors import LogError, UsageError
from uwbslam_jax.estimator import CompileClock, chosen
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.files import LogSummary, Recording, inspect_log, mounting, read_run, settings_file, write_result
from uwbslam_jax.measurements import Message, ScanMessage, TruthMessage
from uwbslam_jax.result import MapImage, RunStatus
from uwbslam_jax.session import PEEK_SCANS, Facts, Runner, Saved, Update, fit_beams, saved_state
from uwbslam_jax.settings import Settings
from uwbslam_jax.simulation import Simulation
from uwbslam_jax.tuning import Log, Rollout, Tuned, check_request, prepare, tune as tune_logs
from uwbslam_jax.web import write_report

Paths = str | Path | Sequence[str | Path]
"""An MCAP file, the folder of a ROS 2 bag, or several files of one recording."""
Progress = Callable[[int, int], object]
"""Called now and then with the number of messages taken in and of all."""

_PROGRESS_EVERY = 100
"""Messages between two reports of progress."""
_PEEK_S = 1.0
"""Measurements are held for at most so long until the number of beams of a scan is known [s, by their stamps]."""


@dataclass(slots=True)
class Result(data.Result):
    """What a run found, see `result.Result` for the arrays.

    Attributes:
      truth: where the recording has some, None otherwise.
      state: what `resume` and `localize` go on from; None where the frame was never decided, or the run only localised.
    """

    truth: Truth | None = None
    state: Saved | None = None

    def errors(self) -> dict[str, Any]:
        """Figures against the truth, as `evaluate` names them, with those of what was published at the time.

        Raises:
          UsageError: there is no truth.
        """
        if self.truth is None:
            raise UsageError("no ground truth to compare with")
        figures = evaluate(self, self.truth) | evaluation.consistency(self, self.truth)
        online = evaluation.evaluate(self.stamps, self.online, {}, self.truth)
        return figures | {"online_ate_m": online["robot_ate_m"]}

    def save(self, folder: str | Path, title: str = "UWB and LiDAR SLAM") -> None:
        """Writes every file of a run into a folder, which is created: see docs/formats.md. Raises OSError."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        figures = None if self.truth is None else self.errors()
        write_report(self, folder / "report.html", figures, title)
        self.summary |= figures or {}
        write_result(self, folder)
        if self.state is not None:
            saved_state.save(self.state, folder)

    def report(self, path: str | Path, title: str = "UWB and LiDAR SLAM") -> None:
        """Writes the report, one HTML file that opens offline. Raises OSError."""
        write_report(self, Path(path), None if self.truth is None else self.errors(), title)

    def plot(self, axes: Any = None) -> Any:
        """Draws map, track and beacons onto matplotlib axes, the current ones by default, and returns them.

        Raises:
          UsageError: matplotlib is not installed.
        """
        try:
            from matplotlib import pyplot
        except ImportError:
            raise UsageError("plot needs matplotlib: pip install 'uwbslam_jax[plot]'") from None
        from uwbslam_jax.plotting import show_run

        axes = pyplot.gca() if axes is None else axes
        show_run(axes, self)
        return axes


Source = Paths | Recording | Simulation | Iterable[Message]


def read(path: Paths, settings: Settings | None = None) -> Recording:
    """Opens a recording: an iterable of messages, with its topics, warnings and truth. Raises LogError."""
    s = settings or Settings()
    return Recording(
        path,
        scan_topic=s.lidar.topic,
        uwb_topic=None if s.filter.lidar_only else s.uwb.topic,
        odom_topic=s.odom.topic if s.odom.use else None,
        scan_frame=s.lidar.frame,
        robot_id=s.robot.id,
        uwb=s.uwb,
    )


def inspect(path: Paths, settings: Settings | None = None) -> LogSummary:
    """Tells what a recording holds: topics, rates, gaps, nodes heard, what is missing; `print` it. Raises LogError."""
    s = settings or Settings()
    topics = {"scan_topic": s.lidar.topic, "uwb_topic": s.uwb.topic, "odom_topic": s.odom.topic}
    found = inspect_log(path, **topics, scan_frame=s.lidar.frame, robot_id=s.robot.id, uwb=s.uwb)
    found.problems.extend(mounting.contradictions(mounting.mounted(s, found.mounting), found.mounting))
    return found


def run(
    source: Source,
    settings: Settings | None = None,
    *,
    online: bool = False,
    resume: str | Path | None = None,
    localize: str | Path | None = None,
    progress: Progress | None = None,
) -> Result:
    """Runs a recording.

    Args:
      source: path of a recording, what `read` or `simulate` gave, or messages.
      settings: the defaults where not given; a simulation brings its own.
      online: step frame by frame, as on the robot; the result is the same.
      resume: folder of a run to go on from, with its map and beacons.
      localize: the same, but both stay as they are.

    Raises:
      LogError: the recording cannot be read, or holds no usable scan, no odometry and no ranges between nodes at
        rest that fix a geometry.
      ConfigError: a setting is out of range. RunError: the folder to go on from holds no state that fits.
      UsageError: both resume and localize.
    """
    begin = time.perf_counter()
    messages, settings = _opened(source, settings)
    reader = messages if isinstance(messages, Recording) else None
    if reader is not None and "uwb" not in reader.topics.values():
        settings = dataclasses.replace(settings, filter=dataclasses.replace(settings.filter, lidar_only=True))
    settings = chosen(fit_beams(settings, messages), compile_beside=True)
    saved, fixed = _saved(resume, localize, settings)
    total = reader.message_count if reader is not None else 0
    with CompileClock() as clock:
        runner = Runner(settings, clock, online=online, saved=saved, fixed=fixed)
        take = runner.add if reader is None else runner.take
        for count, message in enumerate(messages):
            take(message)
            if progress is not None and count % _PROGRESS_EVERY == 0:
                progress(count, total)
        runner.finish()
        facts = Facts(compile_s=clock.seconds)
    if reader is not None:
        facts.warnings = [*reader.warnings, *mounting.contradictions(settings, reader.mounting)]
        facts.dropped, facts.truncated = reader.dropped, reader.truncated
    facts.wall_s = time.perf_counter() - begin
    found = finished(runner, facts)
    if reader is not None and not len(found.stamps) and not found.beacons:
        told = [*runner.warnings(reader.dropped).values(), *([reader.truncated] if reader.truncated else [])]
        why = "".join(f"; {text}" for text in told)
        raise LogError(
            f"{reader.name}: no usable scan on {settings.lidar.topic}, no odometry on {settings.odom.topic}, and no "
            f"ranges that fix a geometry on {settings.uwb.topic}{why}"
        )
    if progress is not None:
        progress(total, total)
    return found


class Slam:
    """A run fed message by message, as on a robot. The same messages give the bits of `run`, where both make room for
    the same number of beams: see `fit`.

    Attributes:
      settings: what it runs with.
      on_update: called with each update, see `__init__`.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        resume: str | Path | None = None,
        localize: str | Path | None = None,
        on_update: Callable[[Update], object] | None = None,
        fit: bool = True,
    ):
        """Nothing is compiled yet: that happens with the first frame, or has been done by an earlier run.

        Args:
          resume, localize: see `run`.
          on_update: called with each update before the host looks at what it means for beacons and map, which takes
            longer now and then.
          fit: make room for as many beams as the first scans have, by holding the first second of messages. Without,
            or where no scan comes in that time, for lidar.max_beams.

        Raises:
          ConfigError, RunError, UsageError: see `run`.
        """
        self.settings = chosen(settings_file.check(settings or Settings()), compile_beside=True)
        self.on_update = on_update
        self._goes_on = _saved(resume, localize, self.settings)
        self._held: list[Message] = []
        self._due: list[Update] = []
        self._clock, self._begin = CompileClock(), 0.0
        self._end = contextlib.ExitStack()
        self._end.enter_context(self._clock)
        self._runner = None if fit else self._start()

    def _start(self) -> Runner:
        saved, fixed = self._goes_on
        runner = Runner(self.settings, self._clock, online=True, saved=saved, fixed=fixed)
        runner.session.listener = lambda update: self.on_update(update) if self.on_update is not None else None
        return runner

    def add(self, message: Message) -> list[Update]:
        """Takes in one measurement, in the order in which they arrive; what it led to, mostly nothing or one update."""
        self._begin = self._begin or time.perf_counter()
        if self._runner is None:
            self._held.append(message)
            scans = sum(isinstance(m, ScanMessage) for m in self._held)
            late = message.stamp - self._held[0].stamp > _PEEK_S * 1e9
            return self._release() if scans >= PEEK_SCANS or late else []
        due, self._due = self._due, []
        return due + self._runner.add(message)

    def _release(self) -> list[Update]:
        """What was held goes in."""
        if any(isinstance(m, ScanMessage) for m in self._held):  # a LiDAR that is late may have any number of beams
            self.settings = fit_beams(self.settings, self._held)
        self._runner, held, self._held = self._start(), self._held, []
        return list(itertools.chain.from_iterable(map(self.add, held)))

    @property
    def runner(self) -> Runner:
        """What does the work."""
        if self._runner is None:
            self._due = self._release()  # handed over with the next message
        assert self._runner is not None
        return self._runner

    @property
    def status(self) -> RunStatus:
        """Of start-up: what it waits for, or that the frame is decided."""
        return self.runner.session.status if self._runner is not None else RunStatus.WAITING

    def map(self) -> MapImage:
        """The map so far; messages that are still held go in first."""
        return self.runner.session.map()

    def finish(self, facts: Facts | None = None) -> Result:
        """Ends the run: what still waits is stepped, and the whole run solved once more. facts: told besides."""
        with self._end:
            self.runner.finish()
        facts = facts or Facts()
        facts.compile_s = self._clock.seconds
        facts.wall_s = facts.wall_s or time.perf_counter() - self._begin
        return finished(self.runner, facts)

    def save(self, folder: str | Path) -> bool:
        """Writes the state, for `resume` and `localize`, into a folder, which is created; False where there is none to
        save, because the frame is not decided or the run only localises. Raises OSError."""
        saved = None if self._runner is None else self._runner.saved()
        if saved is not None:
            Path(folder).mkdir(parents=True, exist_ok=True)
            saved_state.save(saved, Path(folder))
        return saved is not None


def finished(runner: Runner, facts: Facts) -> Result:
    """The Result of a run that has ended, or so far."""
    found = runner.result(facts)
    values = {f.name: getattr(found, f.name) for f in dataclasses.fields(found)}
    return Result(**values, truth=runner.truth(), state=runner.saved())


def evaluate(estimate: Result | str | Path, truth: Truth | str | Path) -> dict[str, Any]:
    """How far an estimate is from the truth, after one rigid motion that lays robot and beacons together over it.

    Args:
      estimate: a Result, or the folder of a run.
      truth: or the path of a recording with ground truth, or of its arrays t, robot, ids, beacons (.npz).

    Returns:
      Name -> figure: robot_rmse_m, robot_ate_m, robot_max_m, heading_deg_median, beacon_mean_m ...

    Raises:
      RunError, LogError, UsageError: a file that cannot be used.
    """
    if isinstance(estimate, Result):
        found, beacons = estimate, {beacon.id: beacon.position for beacon in estimate.beacons}
    else:
        found = read_run(estimate)
        beacons = dict(zip(found.beacon_ids.tolist(), found.beacons, strict=True))
    truth = truth if isinstance(truth, Truth) else load_truth(Path(truth))
    return evaluation.evaluate(found.stamps, found.poses, beacons, truth)


def load_truth(path: Path) -> Truth:
    """Ground truth of a recording or of an .npz file. Raises LogError, UsageError."""
    try:
        if path.suffix == ".npz":
            return Truth.load(path)
        truth = Recording(path, scan_topic=None, uwb_topic=None, odom_topic=None).truth
    except LogError:
        raise
    except (ValueError, zipfile.BadZipFile) as error:
        raise UsageError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    if truth is None:
        raise UsageError(f"{path}: has no ground truth of the robot")
    return truth


def tune(
    recordings: Source | Sequence[Source],
    params: Sequence[str] = (),
    settings: Settings | None = None,
    *,
    objective: Literal["likelihood", "truth"] = "likelihood",
    progress: Callable[[str], object] = lambda text: None,
) -> Tuned:
    """Finds noise parameters, range biases and the LiDAR's mounting.

    Args:
      recordings: one, or several to be explained together.
      params: sigma_n, sigma_w, sigma_w_yaw, sigma_w_beacon, sigma_l, sigma_map, gamma ..., bias.ID, lidar.x, lidar.y,
        lidar.yaw; by default sigma_n and sigma_l.
      objective: what noises are tuned for, the likelihood of ranges and matches or the track's error.
      progress: told what is being done.

    Raises:
      ConfigError: a name is unknown, a setting out of range, or the LiDAR's place is asked of recordings whose
        transforms tell different ones. LogError: see `run`. UsageError: there is no recording. RolloutError: start-up
        decides nothing, too few frames follow, or there is no truth to tune for.
    """
    wanted = settings_file.check(settings or Settings())
    check_request(tuple(params), wanted)
    one = isinstance(recordings, str | Path | Recording | Simulation) or _are_messages(recordings)
    logs = []
    for source in cast(Sequence[Source], [recordings] if one else recordings):
        messages, own = _opened(source, settings)
        name = messages.name if isinstance(messages, Recording) else f"recording {len(logs) + 1}"
        kept = list(messages)
        truths = [m for m in kept if isinstance(m, TruthMessage)]
        known = any(m.node is None for m in truths)
        logs.append(Log(name, kept, own, Truth.from_messages(truths) if known else None))
    if not logs:
        raise UsageError("there is no recording to tune from")
    base = settings or dataclasses.replace(logs[0].settings, robot=Settings().robot)
    return tune_logs(logs, tuple(params), base, objective, progress)


def rollout(source: Source, settings: Settings | None = None) -> Rollout:
    """A recording from the end of its start-up on, as one differentiable function of the parameters: `loss(params)`.

    Raises:
      LogError: see `run`. RolloutError: start-up decides nothing, or too few frames follow.
    """
    messages, settings = _opened(source, settings)
    return prepare(list(messages), settings)


def _are_messages(source: object) -> TypeGuard[Sequence[Message]]:
    return isinstance(source, Sequence) and len(source) > 0 and isinstance(source[0], Message)


def _opened(source: Source, settings: Settings | None) -> tuple[Recording | Iterable[Message], Settings]:
    """Messages that can be iterated over again, and the settings for them, with the mounting that a recording tells."""
    if settings is None:
        settings = source.settings if isinstance(source, Simulation) else Settings()
    settings_file.check(settings)
    if isinstance(source, str | Path | Sequence) and not _are_messages(source):
        source = read(cast(Paths, source), settings)
    if isinstance(source, Recording):
        settings = dataclasses.replace(settings, robot=dataclasses.replace(settings.robot, id=source.robot_id))
        return source, mounting.mounted(settings, source.mounting)
    if isinstance(source, Simulation) or _are_messages(source):
        return source, settings
    return list(source), settings


def _saved(resume: str | Path | None, localize: str | Path | None, settings: Settings) -> tuple[Saved | None, bool]:
    """The state to go on from, and whether it stays as it is."""
    if resume is not None and localize is not None:
        raise UsageError("resume and localize: one of them")
    folder = resume if localize is None else localize
    return None if folder is None else saved_state.load(Path(folder), settings), localize is not None
