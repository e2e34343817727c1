"""Whether the covariances are what they say: NEES over degrees of freedom, its mean over many runs.

`python -m benchmarks.accuracy.consistency` runs 50 short laps of the hall and 10 rounds of the office and writes
results/consistency.md and .json; exit status 1 if a mean is out of bounds. The truth is put into the published frame by
its own two beacons, not by a fit; only what was published after the frame was decided counts.
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import Any

import numpy as np

import uwbslam_jax as us
from benchmarks.accuracy import trials
from benchmarks.tables import cell, line, provenance, write

BOUNDS = (0.3, 2.0)
"""Between these the mean NEES over its degrees of freedom has to lie."""
RUNS = {"hall": (50, 60.0), "office": (10, None)}
"""Scenario -> how many seeds, and how long each [s], None for all of it."""
_FIRST_SEED = 100
"""Other worlds than those that the suite judges."""
_FIGURES = {"pose_nees_ratio": "pose", "beacon_nees_ratio": "beacons"}


def measure(name: str, seed: int, duration: float | None) -> dict[str, Any]:
    """NEES over dof of one run, with its errors."""
    figures = trials.measure(us.simulate(name, seed, duration).scenario).figures
    return {"seed": seed, **{key: figures[key] for key in (*_FIGURES, "robot_rmse_m", "beacon_mean_m")}}


def mean_of(runs: list[dict[str, Any]], key: str) -> float:
    """Mean over the runs; NaN, which is out of any bounds, where a run has no figure."""
    return float(np.mean([run[key] for run in runs]))


def holds(runs: list[dict[str, Any]]) -> bool:
    """Whether both means lie in bounds."""
    return all(BOUNDS[0] <= mean_of(runs, key) <= BOUNDS[1] for key in _FIGURES)


def table(found: dict[str, list[dict[str, Any]]], facts: dict[str, str]) -> str:
    """Means, medians and worst of the runs in Markdown."""
    lines = ["# Consistency: NEES over degrees of freedom, default settings", ""]
    lines += [", ".join(f"{key} {value}" for key, value in facts.items()) + ".", ""]
    lines += [
        "1 is honest, above it the estimate is too sure of itself. Bar: the mean of the runs between "
        f"{BOUNDS[0]:g} and {BOUNDS[1]:g}. The truth is put into the published frame by its own two beacons, "
        "not by a fit.",
        "",
        line(["scenario", "runs", "of", "mean", "median", "least", "greatest", "verdict"]),
        line(["---", "---:", "---", *["---:"] * 4, "---"]),
    ]
    for name, runs in found.items():
        for key, label in _FIGURES.items():
            values = np.array([run[key] for run in runs])
            told = [cell(float(v), 2) for v in (values.mean(), np.median(values), values.min(), values.max())]
            verdict = "pass" if BOUNDS[0] <= values.mean() <= BOUNDS[1] else "FAIL"
            lines.append(line([f"`{name}`", str(len(runs)), label, *told, verdict]))
    return "\n".join(lines) + "\n"


def main() -> int:
    """Returns 0, or 1 where a mean is out of bounds."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.consistency", description=__doc__)
    parser.add_argument("--runs", type=int, default=math.inf, help="at most so many a scenario: nothing is written")
    options = parser.parse_args()
    found: dict[str, list[dict[str, Any]]] = {}
    for name, (count, duration) in RUNS.items():
        for seed in range(_FIRST_SEED, _FIRST_SEED + min(count, options.runs)):
            run = measure(name, seed, duration)
            found.setdefault(name, []).append(run)
            figures = ", ".join(f"{key} {cell(run[key], 3)}" for key in run if key != "seed")
            print(f"{name} {seed}: {figures}", file=sys.stderr, flush=True)
    facts = provenance(workers=1)
    text = table(found, facts)
    print(text)
    if options.runs == math.inf:
        write("consistency", text, {"provenance": facts, "bounds": BOUNDS, "runs": found})
    return 0 if all(map(holds, found.values())) else 1


if __name__ == "__main__":
    sys.exit(main())
