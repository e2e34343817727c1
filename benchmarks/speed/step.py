"""One online step over the hall at 40 Hz: the whole of it, its parts, and KISS-ICP on the same scans in turn."""

from __future__ import annotations

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
from uwbslam_jax.mapping import grid, undo_motion
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.numerics import Gaussian, rotation
from uwbslam_jax.session import Session

_SECONDS = 150.0
_WARM = 400
"""First steps left out: compilation, start-up, the first map."""
_REPEATS = 300
_LOOSE = (0.1, 0.1, 0.05)
"""What the step adds to the prior of a match [m, m, rad]."""


def measure(*, quick: bool) -> Report:
    """Online steps, every 400th apart; KISS-ICP registers the scan of each step right after it."""
    simulation, peer = us.simulate("hall40", 0, 30.0 if quick else _SECONDS), _kiss_icp()
    slam = us.Slam(simulation.settings, on_update=lambda _: published.append(time.perf_counter()))
    whole, to_pose, theirs, drawn = [], [], [], []
    published: list[float] = []
    last: us.Update | None = None
    for message in list(simulation):
        begin = time.perf_counter()
        updates = slam.add(message)
        end = time.perf_counter()
        if len(updates) != 1:  # none, or at the start all that was held
            continue
        (last,) = updates
        whole.append(end - begin)
        to_pose.append(published[-1] - begin)
        drawn.append(bool(last.estimate.drawn))
        if peer is not None and last.frame.frame.has_scan:
            theirs.append(peer(last.frame))
    assert last is not None
    ours, early = np.array(whole[_WARM:]), np.array(to_pose[_WARM:])
    metrics = spread("step", ours, median=0.5, p95=2.0, p99=5.0)
    metrics += [
        Metric("step, least", 1e3 * float(ours.min()), "ms", "lower"),
        Metric("of it: after the pose is published, median", 1e3 * float(np.median(ours - early)), "ms", "lower"),
        Metric("of it: to the pose, scan drawn, median", 1e3 * float(np.median(early[drawn[_WARM:]])), "ms", "lower"),
    ]
    parts = _parts(slam.runner.session, last.frame)
    metrics += [Metric(f"by itself: {part}, median", 1e3 * t, "ms", "lower") for part, t in parts]
    if peer is not None:
        kiss = np.array(theirs[_WARM:])
        metrics += spread("KISS-ICP", kiss)[:3]
        share = float(np.median(ours) / np.median(kiss))
        metrics.append(ratio("step / KISS-ICP, medians", share, bar=0.8))
    about = (
        f"{len(ours)} steps of the hall at 40 Hz, 1081 beams, five beacons that range in all pairs, three levels, map "
        "updates and the host's own work included, from the message to its update, as on the robot. KISS-ICP (C++, one "
        "thread, default settings for this range) registers the same scan right after each step, so both meet the same "
        "machine. The parts are compiled by themselves; together they share work."
    )
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
