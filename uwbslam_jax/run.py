"""A recording through the estimator: messages -> frames -> session -> Result. Reads no other file and writes none.

Batch mode steps groups of frames as one compiled scan, online mode steps frame by frame; both give the same bits.
"""

from __future__ import annotations

import dataclasses
import itertools
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np

from uwbslam_jax import __version__
from uwbslam_jax.config import Settings
from uwbslam_jax.frames import FrameAssembler
from uwbslam_jax.mcap_log import LogError, LogReader
from uwbslam_jax.measurements import Message, ScanMessage, StampedFrame, TruthMessage
from uwbslam_jax.metrics import Truth
from uwbslam_jax.result import BeaconEstimate, Result
from uwbslam_jax.session import CONTROL_EVERY, Session
from uwbslam_jax.slam import Estimate

_PEEK_SCANS = 10
"""So many scans tell how many beams a scan has."""
_VARYING_BEAMS = 1.25
"""Room for larger scans than those peeked at, where the scanner's number of beams varies."""
_PROGRESS_EVERY = 100
"""Messages between two reports of progress."""


class CompileClock:
    """Adds up the time that JAX spends tracing and compiling while it is entered, in any thread.

    Attributes:
      seconds: so far [s].
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            self.seconds += duration_secs

    def __enter__(self) -> CompileClock:
        jax.monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        jax.monitoring.unregister_event_duration_listener(self._listen)


@dataclass
class Facts:
    """What the Result tells besides what the session knows.

    Attributes:
      warnings: one line each.
      dropped: measurements left out, by reason.
      truncated: where the recording breaks, None where it does not.
      odometry_used: whether any frame carried an increment.
      wall_s, compile_s: time taken, and how much of it JAX compiled [s].
      step_ms: one a frame [ms], without compilation.
    """

    warnings: list[str] = field(default_factory=list)
    dropped: Counter[str] = field(default_factory=Counter)
    truncated: str | None = None
    odometry_used: bool = False
    wall_s: float = 0.0
    compile_s: float = 0.0
    step_ms: list[float] = field(default_factory=list)


class Runner:
    """Messages in, a Result out. Truth is set aside: the estimator never sees it.

    Attributes:
      session: the estimator's.
      truths: the ground truth messages so far.
    """

    def __init__(self, settings: Settings, clock: CompileClock, *, online: bool = False):
        self.session = Session(settings)
        self.truths: list[TruthMessage] = []
        self._assembler = FrameAssembler(settings, self.session.config.max_ranges)
        self._group = 1 if online else CONTROL_EVERY
        self._clock = clock
        self._waiting: list[StampedFrame] = []
        self._step_ms: list[float] = []

    def add(self, message: Message) -> list[Estimate]:
        """The estimates that a message leads to; in batch mode they come in groups."""
        if isinstance(message, TruthMessage):
            self.truths.append(message)
            return []
        return [e for frame in self._assembler.add(message) for e in self._take(frame)]

    def finish(self) -> list[Estimate]:
        """The estimates of what still waits."""
        estimates = [e for frame in self._assembler.flush() for e in self._take(frame)]
        estimates += self._step()
        self.session.finish()
        return estimates

    def result(self, facts: Facts) -> Result:
        """The Result so far; odometry, step times and the drops of the frames are added to the facts."""
        dropped = facts.dropped + self._assembler.dropped
        warnings = [*facts.warnings, *self._assembler.warnings]
        told = dataclasses.replace(
            facts,
            warnings=warnings,
            dropped=dropped,
            odometry_used=self._assembler.odometry_used,
            step_ms=self._step_ms,
        )
        return to_result(self.session, told)

    def truth(self) -> Truth | None:
        """The ground truth so far, None where there is none of the robot."""
        known = any(message.node is None for message in self.truths)
        return Truth.from_messages(self.truths) if known else None

    def _take(self, frame: StampedFrame) -> list[Estimate]:
        self._waiting.append(frame)
        return self._step() if len(self._waiting) == self._group else []

    def _step(self) -> list[Estimate]:
        frames, self._waiting = self._waiting, []
        if not frames:
            return []
        begin, compiled = time.perf_counter(), self._clock.seconds
        estimates = [self.session.step(frames[0])] if self._group == 1 else self.session.steps(frames)
        seconds = time.perf_counter() - begin - (self._clock.seconds - compiled)
        self._step_ms += [max(seconds, 0.0) * 1e3 / len(frames)] * len(frames)
        return estimates


def run_log(
    path: str | Path,
    settings: Settings,
    *,
    online: bool = False,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[Result, Truth | None]:
    """Runs a recording.

    Args:
      path: an MCAP file, or a ROS 2 bag folder with one.
      online: step frame by frame, as on the robot; the result is the same.
      progress: called now and then with the number of messages read and of all.

    Returns:
      What the estimator found, and the ground truth where the recording has some.

    Raises:
      LogError: the recording cannot be read, or holds no usable scan.
    """
    begin = time.perf_counter()
    reader = LogReader(
        path,
        scan_topic=settings.lidar.topic,
        uwb_topic=None if settings.filter.lidar_only else settings.uwb.topic,
        odom_topic=settings.odom.topic if settings.odom.use else None,
        robot_id=settings.robot.id,
        max_range=settings.uwb.max_range,
    )
    if "uwb" not in reader.topics.values():
        settings = dataclasses.replace(settings, filter=dataclasses.replace(settings.filter, lidar_only=True))
    settings = fit_beams(settings, reader)
    with CompileClock() as clock:
        runner = Runner(settings, clock, online=online)
        for count, message in enumerate(reader):
            runner.add(message)
            if progress is not None and count % _PROGRESS_EVERY == 0:
                progress(count, reader.message_count)
        runner.finish()
        if not any(runner.session.history.has_scan):
            why = f"; {reader.truncated}" if reader.truncated else ""
            raise LogError(f"{reader.path}: no usable scan on {settings.lidar.topic}{why}")
        facts = Facts(list(reader.warnings), reader.dropped, reader.truncated, compile_s=clock.seconds)
        facts.wall_s = time.perf_counter() - begin
    if progress is not None:
        progress(reader.message_count, reader.message_count)
    return runner.result(facts), runner.truth()


def run_messages(
    messages: Iterable[Message], settings: Settings, *, online: bool = False
) -> tuple[Result, Truth | None]:
    """The same for messages in memory, as a recorder got them; iterated twice."""
    begin = time.perf_counter()
    settings = fit_beams(settings, messages)
    with CompileClock() as clock:
        runner = Runner(settings, clock, online=online)
        for message in messages:
            runner.add(message)
        runner.finish()
        facts = Facts(compile_s=clock.seconds, wall_s=time.perf_counter() - begin)
    return runner.result(facts), runner.truth()


def fit_beams(settings: Settings, messages: Iterable[Message]) -> Settings:
    """Settings with no more slots for beams than the first scans need: a step's cost grows with them.

    Where the scans differ in size there is room for larger ones; what still does not fit is thinned.
    """
    scans = (m.ranges.size for m in messages if isinstance(m, ScanMessage) and m.ranges.size > 1)
    sizes = list(itertools.islice(scans, _PEEK_SCANS))
    if not sizes:
        return settings
    beams = max(sizes) if len(set(sizes)) == 1 else round(max(sizes) * _VARYING_BEAMS)
    beams = min(beams, settings.lidar.max_beams)
    return dataclasses.replace(settings, lidar=dataclasses.replace(settings.lidar, max_beams=beams))


def to_result(session: Session, facts: Facts) -> Result:
    """What a session reported, with node ids for slots. Poses of the frames that had a scan.

    A run whose frame was never decided has its poses and map in the frame that the robot started in.
    """
    history = session.history
    at = np.flatnonzero(history.has_scan)
    stamps = np.array(history.stamps, np.int64)[at]
    start = int(stamps[0]) if len(stamps) else 0
    ids = {slot: node for node, slot in session.slots.items()}
    residuals = [((t - start) / 1e9, ids[i], ids[j], r) for t, i, j, r in history.residuals]
    tracks: dict[int, list[tuple[float, float, float, float]]] = {}
    for t, slot, x, y, sigma in history.tracks:
        tracks.setdefault(ids[slot], []).append(((t - start) / 1e9, x, y, sigma))
    diagnostics = {name: np.array(values)[at] for name, values in history.diagnostics.items()}
    if len(facts.step_ms) == len(history.stamps):
        diagnostics["step_ms"] = np.array(facts.step_ms, float)[at]
    return Result(
        stamps=stamps,
        poses=np.array(history.poses, float).reshape(-1, 3)[at],
        pose_covs=np.array(history.covs, float).reshape(-1, 3, 3)[at],
        beacons=_beacons(session, ids),
        beacon_tracks={node: np.array(rows, float) for node, rows in tracks.items()},
        map=session.tiles.image(session.state.grid),
        range_residuals=np.array(residuals, float).reshape(-1, 4),
        scan_points=_scan_points(session),
        diagnostics=diagnostics,
        events=list(history.events),
        summary=_summary(session, facts),
    )


def _beacons(session: Session, ids: dict[int, int]) -> list[BeaconEstimate]:
    """Beacons in the state as they are in it now, those that left it as they were last reported."""
    active = np.asarray(session.state.active)
    mean, cov = np.asarray(session.state.belief.mean, float), np.asarray(session.state.belief.cov, float)
    found = []
    for slot in range(1, len(active)):
        status = session.beacon_status(slot)
        if active[slot]:
            two = slice(2 * slot, 2 * slot + 2)
            found.append(BeaconEstimate(ids[slot], mean[two], cov[two, two], status))
        elif slot in session.history.beacons:
            position, block = session.history.beacons[slot]
            left = status if status in ("moving", "silent") else "dropped"
            found.append(BeaconEstimate(ids[slot], position.astype(float), block.astype(float), left))
    return sorted(found, key=lambda beacon: beacon.id)


def _scan_points(session: Session) -> np.ndarray:
    """(n, 2) the last scan in the published frame, each beam at its own time [m]."""
    if session.history.last_scan is None:
        return np.zeros((0, 2))
    number, frame, estimate = session.history.last_scan
    scan, lidar = frame.frame.scan, session.settings.robot.lidar
    beam = np.flatnonzero(scan.valid)
    bearing = float(scan.angle_min) + float(scan.angle_increment) * beam + lidar[2]
    reach, age = np.asarray(scan.ranges, float)[beam], float(scan.time_increment) * beam
    x, y = lidar[0] + reach * np.cos(bearing), lidar[1] + reach * np.sin(bearing)
    # the estimate may be older than the published frame: its velocity counts relative to its own heading
    pose, velocity = session.history.poses[number], np.asarray(estimate.velocity, float)
    turned = pose[2] - float(estimate.pose[2])
    c, s = np.cos(turned), np.sin(turned)
    drift = np.array([c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1]])
    heading = pose[2] + float(estimate.yaw_rate) * age
    c, s = np.cos(heading), np.sin(heading)
    return pose[:2] + np.stack([c * x - s * y, s * x + c * y], axis=-1) + age[:, None] * drift


def _summary(session: Session, facts: Facts) -> dict[str, Any]:
    """The content of summary.json, see DESIGN; without evaluation figures.

    The real-time factor is the recording's duration over the time taken, compilation left out.
    """
    history = session.history
    stamps, step_ms = history.stamps, facts.step_ms
    duration = (stamps[-1] - stamps[0]) / 1e9 if stamps else 0.0
    decided = None if session.decided_at is None else (session.decided_at - stamps[0]) / 1e9
    total = {name: int(np.sum(values)) for name, values in history.diagnostics.items()}
    rejected = {"not in line of sight": total.get("ranges_nlos", 0), "doubted": total.get("ranges_doubted", 0)}
    used = total.get("ranges_used", 0)
    rejected["node not placed"] = total.get("ranges", 0) - used - sum(rejected.values())
    return {
        "steps": len(stamps),
        "duration_s": duration,
        "wall_s": facts.wall_s,
        "compile_s": facts.compile_s,
        "step_ms_median": float(np.median(step_ms)) if step_ms else None,
        "step_ms_p95": float(np.percentile(step_ms, 95)) if step_ms else None,
        "real_time_factor": duration / max(facts.wall_s - facts.compile_s, 1e-9),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,  # kB on Linux
        "decided_at": decided,
        "hypotheses": session.hypotheses,
        "status": session.status,
        "ids": sorted(node for node, slot in session.slots.items() if slot > 0),
        "odometry_used": facts.odometry_used,
        "poor_matches": total.get("poor_match", 0),
        "searches": total.get("searched", 0),
        "ranges_used": used,
        "ranges_rejected": rejected,
        "dropped": dict(sorted(facts.dropped.items())),
        "truncated": facts.truncated,
        "warnings": facts.warnings,
        "version": __version__,
        "config": dataclasses.asdict(session.settings),
    }
