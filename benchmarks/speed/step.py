"""One online step over the hall at 40 Hz: by each engine, its parts, and KISS-ICP on the same scans in turn."""

from __future__ import annotations

import contextlib
import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import uwbslam_jax as us
from benchmarks.metric import Metric, Report, ratio, spread
from uwbslam_jax.estimator import matching, motion, ranging, state_vector
from uwbslam_jax.estimator.native.warm_up import warm_up
from uwbslam_jax.mapping import grid, undo_motion
from uwbslam_jax.measurements import Message, StampedFrame
from uwbslam_jax.numerics import Gaussian, rotation
from uwbslam_jax.session import Session

_SECONDS = 150.0
_WARM = 400
"""First steps left out: compilation, start-up, the first map."""
_REPEATS = 300
_LOOSE = (0.1, 0.1, 0.05)
"""What the step adds to the prior of a match [m, m, rad]."""


class _Run:
    """One engine's online run of the recording.

    Attributes:
      whole, to_pose, drawn: of each step, seconds to its end and to its pose, and whether its scan was drawn.
      slam: the run. last: its newest update.
    """

    def __init__(self, engine: str, settings: us.Settings):
        self.whole: list[float] = []
        self.to_pose: list[float] = []
        self.drawn: list[bool] = []
        self.last: us.Update | None = None
        self._published = 0.0
        steps = dataclasses.replace(settings.filter, engine=engine)
        self.slam = us.Slam(dataclasses.replace(settings, filter=steps), on_update=self._publish)

    def _publish(self, _: us.Update) -> None:
        self._published = time.perf_counter()

    def take(self, message: Message) -> us.Update | None:
        """A message in; the update of a step that it led to."""
        begin = time.perf_counter()
        updates = self.slam.add(message)
        end = time.perf_counter()
        if len(updates) != 1:  # none, or at the start all that was held
            return None
        (self.last,) = updates
        self.whole.append(end - begin)
        self.to_pose.append(self._published - begin)
        self.drawn.append(bool(self.last.estimate.drawn))
        return self.last

    def figures(self, name: str, **asked: float) -> list[Metric]:
        """Times of its steps. asked: see `spread`."""
        whole, early, drawn = (np.array(values[_WARM:]) for values in (self.whole, self.to_pose, self.drawn))
        return [
            *spread(name, whole, **asked),
            Metric(f"{name}, least", 1e3 * float(whole.min()), "ms", "lower"),
            Metric(
                f"{name}, after the pose is published, median", 1e3 * float(np.median(whole - early)), "ms", "lower"
            ),
            Metric(f"{name}, to the pose, scan drawn, median", 1e3 * float(np.median(early[drawn])), "ms", "lower"),
        ]

    def shares(self, name: str, kiss: float, bars: tuple[float, float, float]) -> list[Metric]:
        """Median, 95 and 99 % of its steps over a median of KISS-ICP [s]."""
        whole = np.array(self.whole[_WARM:])
        figures = zip(("median", "p95", "p99"), np.percentile(whole, [50, 95, 99]), bars, strict=True)
        return [ratio(f"{name} / KISS-ICP's median, {key}", float(t) / kiss, bar=bar) for key, t, bar in figures]


def measure(*, quick: bool, load: int = 0) -> Report:
    """Online steps of both engines on each message, and KISS-ICP on the scan of each step right after. load: so many
    processes keep the machine busy meanwhile."""
    simulation, peer = us.simulate("hall40", 0, 30.0 if quick else _SECONDS), _kiss_icp()
    warm_up()
    native, reference = _Run("native", simulation.settings), _Run("jax", simulation.settings)
    theirs = []
    with contextlib.ExitStack() as ends:
        for _ in range(load):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            ends.callback(busy.wait)
            ends.callback(busy.kill)
        for message in list(simulation):
            last = native.take(message)
            reference.take(message)
            if peer is not None and last is not None and last.frame.frame.has_scan:
                theirs.append(peer(last.frame))
    metrics = native.figures("step", median=0.5) + reference.figures("step by jax", median=2.0)
    assert reference.last is not None
    parts = _parts(reference.slam.runner.session, reference.last.frame)
    metrics += [Metric(f"jax, by itself: {part}, median", 1e3 * t, "ms", "lower") for part, t in parts]
    if peer is not None:
        kiss = np.array(theirs[_WARM:])
        metrics += spread("KISS-ICP", kiss)[:3]
        bars = (1.0, 3.0, 6.0) if load else (0.5, 1.5, 3.0)
        metrics += native.shares("step", float(np.median(kiss)), bars)
        metrics += reference.shares("step by jax", float(np.median(kiss)), (2.0, 8.0, 16.0))[:1]
    about = (
        f"{len(native.whole) - _WARM} steps of the hall at 40 Hz, 1081 beams, five beacons that range in all pairs, "
        "three levels, map updates and the host's own work included, from the message to its update, as on the robot, "
        "by the native engine and by the JAX step in turn. KISS-ICP (C++, one thread, default settings for this range) "
        "registers the same scan right after, so all meet the same machine. The parts are compiled by themselves; "
        "together they share work."
    )
    about += f" {load} other processes keep the machine busy." if load else ""
    return Report("One online step", about + ("" if peer else " KISS-ICP is not installed: left out."), metrics)


def _kiss_icp() -> Callable[[StampedFrame], float] | None:
    """Seconds that KISS-ICP takes for a frame's scan; None where it is not installed."""
    try:
        from kiss_icp.config import KISSConfig  # pyright: ignore[reportMissingImports]
        from kiss_icp.kiss_icp import KissICP  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    config: Any = KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = 30.0, 0.1, False
    config.mapping.voxel_size = 0.3
    config.registration.max_num_threads = 1
    odometry = KissICP(config)

    def register(frame: StampedFrame) -> float:
        scan = frame.frame.scan
        beam = np.flatnonzero(scan.valid)
        bearing = float(scan.angle_min) + float(scan.angle_increment) * beam
        reach = scan.ranges[beam].astype(float)
        points = np.column_stack([reach * np.cos(bearing), reach * np.sin(bearing), np.zeros(len(beam))])
        begin = time.perf_counter()
        odometry.register_frame(points, np.zeros(len(beam)))
        return time.perf_counter() - begin

    return register


def _parts(run: Session, last: StampedFrame) -> list[tuple[str, float]]:
    """Median seconds of the step's parts, each compiled alone, on the state at the end of a run and its last frame."""
    config, params, frame = run.config, run.params, jax.tree.map(jnp.asarray, last.frame)
    state = run.state
    s = state_vector.unpack(state.belief.mean)
    sweep = undo_motion(frame.scan, params.lidar, rotation(-s.heading) @ s.velocities[0], s.yaw_rate)
    usable = ranging.line_of_sight(frame.ranges, config.nlos_gap_db) & frame.ranges.valid
    C = state_vector.matched_pose_jacobian(config.nodes)

    def filtered(state, frame):
        belief = motion.predict(state.belief, params, frame.dt, frame.odometry, state.moving, state.unrest)
        return ranging.update(belief, frame.ranges, usable, params, state.scatter, robust=True)

    def matched(state, sweep):
        loose = C @ state.belief.cov @ C.T + jnp.diag(jnp.array(_LOOSE) ** 2)
        prior = Gaussian(C @ state.belief.mean, loose)
        view = matching.view(sweep, params.sigma_l)
        pose = matching.align(state.grid, view, prior.mean, prior, config.resolution, True)
        return matching.assess(state.grid, view, pose, config.resolution)

    def redrawn(window, pose):
        return grid.integrate(window, pose, sweep, config.resolution)

    draw = jax.jit(redrawn, donate_argnums=0)
    window, pose = jax.tree.map(jnp.array, state.grid), state_vector.robot_pose(state.belief.mean)
    times: list[float] = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        window = jax.block_until_ready(draw(window, pose))
        times.append(time.perf_counter() - begin)
    return [
        ("prediction and ranges", repeated(partial(jax.jit(filtered), state, frame))),
        ("match", repeated(partial(jax.jit(matched), state, sweep))),
        ("drawing a scan", float(np.median(times[5:]))),
    ]


def repeated(call: Callable[[], Any], count: int = _REPEATS) -> float:
    """Median seconds of a compiled call."""
    jax.block_until_ready(call())
    times = []
    for _ in range(count):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - begin)
    return float(np.median(times))
