"""`uwbslam run` over ten minutes at 40 Hz, end to end, its peak memory; many parameter sets at once."""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

import uwbslam_jax as us
from benchmarks.metric import Metric, Report, ratio
from benchmarks.speed.scaling import Case, sized
from uwbslam_jax.session import FrameAssembler

_SETS = (1, 4, 16, 64)
_STEPS = 20
"""Steps of each parameter set in a compiled scan."""


def measure(*, quick: bool) -> Report:
    """Recordings are simulated into a temporary folder. An hour of them only with UWBSLAM_HOUR=1: it takes long."""
    with tempfile.TemporaryDirectory() as folder:
        metrics = _recording(Path(folder), 60.0 if quick else 600.0)
        if os.environ.get("UWBSLAM_HOUR"):
            hour = _run(Path(folder), 3600.0)
            short = next(m.value for m in metrics if m.unit == "MB")
            metrics.append(ratio("peak memory, an hour / ten minutes", hour["peak_mb"] / short, bar=1.1))
    metrics += _parameter_sets(quick)
    about = (
        "`uwbslam run` as a user calls it, in a process of its own with a warm compilation cache, on the hall at 40 Hz "
        "(1081 beams, five beacons, all pairs): from the shell to the last file. Reading: the recording decoded and "
        "made into frames by itself. Parameter sets: the same twenty steps for other noise of ranges, one vmap in each "
        "of as many processes as there are cores; one set alone in one."
    )
    return Report("Whole recordings", about, metrics)


def _run(folder: Path, seconds: float) -> dict[str, float]:
    """Figures of `uwbslam run` on a simulated recording, run twice so that the second finds everything compiled."""
    log = folder / f"{seconds:.0f}.mcap"
    words = [sys.executable, "-m", "uwbslam_jax"]
    subprocess.run([*words, "simulate", "hall40", "-o", log, "--duration", str(seconds), "--quiet"], check=True)
    summary, wall, peak = {}, 0.0, 0.0
    for _ in range(2):
        begin = time.perf_counter()
        child = subprocess.Popen(
            [*words, "run", log, "-o", folder / "out", "--quiet"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        _, status, usage = os.wait4(child.pid, 0)
        wall, peak = time.perf_counter() - begin, usage.ru_maxrss / 1024
        if status:
            raise RuntimeError(f"uwbslam run ended with status {status}")
        summary = json.loads((folder / "out" / "summary.json").read_text(encoding="utf-8"))
    return {"wall_s": wall, "peak_mb": peak, "run_s": summary["wall_s"], "rmse": summary["robot_rmse_m"]}


def _recording(folder: Path, seconds: float) -> list[Metric]:
    found = _run(folder, seconds)
    settings = us.Settings()
    assembler = FrameAssembler(settings, us.estimator.make_config(settings).max_ranges)
    begin = time.perf_counter()
    frames = sum(len(assembler.add(message)) for message in us.read(folder / f"{seconds:.0f}.mcap"))
    reading = time.perf_counter() - begin
    stepping, rest = found["run_s"] - reading, found["wall_s"] - found["run_s"]
    factor = {"end to end": found["wall_s"], "reading": reading, "stepping": stepping, "start and writing": rest}
    told = [
        Metric(f"{seconds / 60:g} min, real time over {name}", seconds / took, "x", "higher", 20.0 if not k else None)
        for k, (name, took) in enumerate(factor.items())
    ]
    return [
        *told,
        Metric("frames", float(frames), ""),
        Metric("peak memory", found["peak_mb"], "MB", "lower", 1536.0),
        Metric("robot, RMS", found["rmse"], "m", "lower", 0.015),
    ]


def _parameter_sets(quick: bool) -> list[Metric]:
    context = multiprocessing.get_context("spawn")  # a forked JAX hangs
    times = {}
    with ExitStack() as ends:
        pools = [ends.enter_context(ProcessPoolExecutor(1, mp_context=context)) for _ in range(os.cpu_count() or 1)]
        for sets in (1, 4) if quick else _SETS:
            busy = pools[:sets]
            seconds = []
            for _ in range(4):
                begin = time.perf_counter()
                for running in [pool.submit(_step_sets, sets // len(busy)) for pool in busy]:
                    running.result()
                seconds.append(time.perf_counter() - begin)
            times[sets] = float(np.median(seconds[1:]))  # the first one compiles
    told = [
        Metric(f"{sets} parameter sets, a step of one", 1e3 * t / sets / _STEPS, "ms", "lower")
        for sets, t in times.items()
    ]
    most = max(times)
    return [*told, ratio(f"{most} parameter sets / one", times[most] / times[1], bar=40.0)]


def _step_sets(sets: int) -> None:
    jax.block_until_ready(_stepped_sets(sets)())


@cache
def _stepped_sets(sets: int) -> Callable[[], Any]:
    case = Case(5, sized(us.Settings(map=us.MapSettings(size_m=25.6))))
    return case.many(sets, [case.frame() for _ in range(_STEPS)])
