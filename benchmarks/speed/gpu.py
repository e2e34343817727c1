"""The step of many runs at once on a graphics card: vmap over 1 to 4096 parameter sets."""

from __future__ import annotations

import time

import jax
import numpy as np

import uwbslam_jax as us
from benchmarks.metric import Metric, Report, ratio
from benchmarks.speed.scaling import Case, sized

_RUNS = (1, 64, 1024, 4096)
_STEPS = 10
_TITLE = "Many runs at once on a graphics card"


def measure(*, quick: bool) -> Report:
    """Skipped where JAX sees no graphics card. The window is 25.6 m: 1.4 MB a run, 6 GB for 4096."""
    about = (
        "Steps of a robot in a room, 1081 beams, five beacons in all pairs, one vmap over so many runs with different "
        "noise parameters."
    )
    if jax.default_backend() == "cpu":
        return Report(_TITLE, about, [], skipped="JAX sees no graphics card here, only the CPU")
    case = Case(5, sized(us.Settings(map=us.MapSettings(size_m=25.6))))
    frames = [case.frame() for _ in range(_STEPS)]
    times: dict[int, float] = {}
    for runs in _RUNS[:2] if quick else _RUNS:
        call = case.many(runs, frames)
        jax.block_until_ready(call())
        seconds = []
        for _ in range(5):
            begin = time.perf_counter()
            jax.block_until_ready(call())
            seconds.append(time.perf_counter() - begin)
        times[runs] = float(np.median(seconds))
    device = jax.devices()[0].device_kind
    told = [Metric(f"{n} runs, a step of one", 1e6 * t / n / _STEPS, "us", "lower") for n, t in times.items()]
    most = max(times)
    return Report(_TITLE, f"{about} Device: {device}.", [*told, ratio(f"{most} runs / one", times[most] / times[1])])
