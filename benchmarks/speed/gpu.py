"""The step of many runs at once on a graphics card: vmap over 1 to 4096 parameter sets, the processor beside it."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

import uwbslam_jax as us
from benchmarks.metric import Metric, Report, ratio
from benchmarks.speed.scaling import Case, sized

_RUNS = (1, 64, 1024, 4096)
_STEPS = 10
_BOTH = 64
"""So many runs are also stepped by the processor of the same machine, for the ratio and to compare what comes out."""
_SAME_M = 1e-3
"""Poses of card and processor may differ by this [m]: sums are taken in another order."""
_TITLE = "Many runs at once on a graphics card"


def measure(*, quick: bool) -> Report:
    """Skipped where JAX sees no graphics card. The window is 25.6 m: 1.4 MB a run, 6 GB for 4096."""
    about = (
        "Steps of a robot in a room, 1081 beams, five beacons in all pairs, one vmap over so many runs with different "
        "noise parameters; medians of five calls of ten steps."
    )
    if jax.default_backend() == "cpu":
        return Report(_TITLE, about, [], skipped="JAX sees no graphics card here, only the CPU")
    case = Case(5, sized(us.Settings(map=us.MapSettings(size_m=25.6))))
    frames = [case.frame() for _ in range(_STEPS)]
    processor = jax.devices("cpu")[0]

    def on_processor() -> Callable[[], Any]:
        with jax.default_device(processor):
            return Case(5, case.settings).many(_BOTH, frames)

    sizes = _RUNS[:2] if quick else _RUNS
    begin = time.perf_counter()
    with ThreadPoolExecutor() as pool:  # compiling takes far longer than all the steps
        beside = pool.submit(on_processor)
        calls = list(pool.map(lambda runs: case.many(runs, frames), sizes))
        reference = beside.result()
    metrics = [Metric("tracing and compiling all sizes, side by side", time.perf_counter() - begin, "s", "lower")]
    each: dict[int, float] = {}
    poses: dict[int, np.ndarray] = {}
    for runs, call in zip(sizes, calls, strict=True):
        seconds, (at, _) = _timed(call)
        each[runs], poses[runs] = 1e6 * seconds / runs / _STEPS, np.asarray(at)
        metrics.append(Metric(f"{runs} runs, a step of one", each[runs], "us", "lower"))
    peak = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use", np.nan)
    metrics.append(Metric("memory of the card, most", peak / 1e9, "GB", "lower"))
    seconds, (at, _) = _timed(reference)
    on_cpu = 1e6 * seconds / _BOTH / _STEPS
    apart = np.abs(np.asarray(at) - poses[_BOTH])[:, :2].max()
    most = max(each)
    metrics += [
        Metric(f"{_BOTH} runs on the processor, a step of one", on_cpu, "us", "lower"),
        ratio(f"{most} runs, a step of one: card / processor", each[most] / on_cpu),
        ratio(f"{most} runs / one, wall time", each[most] * most / each[1]),
        Metric("largest difference of a pose, card and processor", float(apart), "m", "lower", _SAME_M),
    ]
    return Report(_TITLE, f"{about} Device: {jax.devices()[0].device_kind}.", metrics)


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Median seconds of a call, and what it returns."""
    seconds, out = [], None
    for _ in range(6):
        begin = time.perf_counter()
        out = jax.block_until_ready(call())
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds[1:])), out
