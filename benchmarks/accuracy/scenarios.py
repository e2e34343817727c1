"""How far off the answer is in the simulated scenarios, against the bar of each, with the defaults.

`python -m benchmarks.accuracy.scenarios` runs every row with 5 seeds and writes results/scenarios.md and .json; names
pick rows and write nothing. Each seed has its own world, beacons and orientation. Exit status 1 if a bar is missed.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import uwbslam_jax as us
from benchmarks.accuracy.sharpness import STRAY_M
from benchmarks.accuracy.suite import ROWS, STRAY, Row
from benchmarks.accuracy.trials import measure
from benchmarks.tables import cell, figures_table, line, plain, provenance, write

Seed = dict[str, Any]
"""One seed's figures: those of `trials.measure`, `seed`, `load`, `checks` (name -> figure) and `failed` (in words)."""

_COLUMNS = {
    "robot_rmse_m": ("robot RMS [m]", 4),
    "online_rmse_m": ("online [m]", 4),
    "beacon_mean_m": ("beacons mean [m]", 4),
    "heading_deg_median": ("heading median [deg]", 3),
    "decided_s": ("decided at [s]", 1),
    "sharpness": ("map sharpness", 3),
    "real_time_factor": ("real-time factor", 1),
}
_MORE = {
    "robot_max_m": ("robot max [m]", 3),
    "beacon_max_m": ("beacons max [m]", 3),
    "own_sharpness": ("map sharpness, own fit", 3),
    "stray": ("stray cells", 3),
    "pose_nees_ratio": ("pose NEES / dof", 2),
    "beacon_nees_ratio": ("beacon NEES / dof", 2),
    "load": ("machine load", 1),
}
_HIGHER_IS_BETTER = {"sharpness", "own_sharpness", "real_time_factor"}


def judge(name: str, seed: int, duration: float | None) -> Seed:
    """Simulates one seed, runs it and judges it."""
    made = us.simulate(name, seed, duration).scenario
    outcome = measure(made)
    found = outcome.found(ROWS[name].checks, made)
    failed = ROWS[name].shortfalls(outcome.figures, found)
    # above a load of 1 other work has slowed the run down
    return {"seed": seed, **outcome.figures, "load": os.getloadavg()[0], "checks": found, "failed": failed}


def run_seeds(name: str, seeds: int, workers: int, duration: float | None) -> Iterator[Seed]:
    """The seeds in order, each as soon as it is there."""
    if workers <= 1:
        yield from (judge(name, seed, duration) for seed in range(seeds))
        return
    context = multiprocessing.get_context("spawn")  # a forked JAX hangs
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from pool.map(judge, [name] * seeds, range(seeds), [duration] * seeds)


def worst_and_median(seeds: list[Seed], key: str) -> tuple[float, float]:
    """Of one figure; one that is missing is worse than any."""
    sign = -1.0 if key in _HIGHER_IS_BETTER else 1.0
    values = sorted(math.inf if math.isnan(seed[key]) else sign * seed[key] for seed in seeds)
    middle = 0.5 * (values[(len(values) - 1) // 2] + values[len(values) // 2])
    return sign * values[-1], sign * middle


def summary_table(rows: dict[str, list[Seed]], facts: dict[str, str]) -> str:
    """The table of all scenarios in Markdown: worst and median of the seeds, bar and verdict."""
    count = max(len(seeds) for seeds in rows.values())
    lines = [f"# Scenarios in simulation, {count} seeds each, default settings", ""]
    lines += [", ".join(f"{key} {value}" for key, value in facts.items()) + ".", ""]
    lines += [
        "Figures are worst / median of the seeds, after one rigid motion over robot and beacons. "
        "Every seed has its own world. "
        "Robot RMS: of the track in trajectory.tum, which the whole run tells; online: of what was published then, "
        "laid over the truth by itself. "
        "Bar: robot RMS [m] / beacons mean [m] / heading median [deg] where asked, then the row's own checks. "
        "A row passes when every seed holds its bar, places every beacon and covers the whole time, and when at most "
        f"{100 * STRAY:g} % of the map's occupied cells lie over {STRAY_M:g} m apart from every wall once the map "
        "itself is laid over the walls. "
        "Map sharpness: share of the occupied cells within one cell of a true wall where the fit of robot and beacons "
        "puts the map; by the map's own fit it is in the table of the seeds.",
        "",
        line(["scenario", *(label for label, _ in _COLUMNS.values()), "bar", "checks, worst", "verdict"]),
        line(["---", *["---:"] * len(_COLUMNS), "---", "---", "---"]),
    ]
    for name, seeds in rows.items():
        figures = [
            " / ".join(cell(v, digits) for v in worst_and_median(seeds, key)) for key, (_, digits) in _COLUMNS.items()
        ]
        lines.append(
            line([f"`{name}`: {ROWS[name].title}", *figures, _bar(ROWS[name]), _checks(name, seeds), verdict(seeds)])
        )
    return "\n".join(lines) + "\n"


def _bar(row: Row) -> str:
    """The averages that are asked."""
    return " / ".join("-" if math.isinf(limit) else f"{limit:g}" for limit in (row.robot, row.beacons, row.heading))


def _checks(name: str, seeds: list[Seed]) -> str:
    """The worst figure of each of a row's own checks, with its limit."""
    told = []
    for check in ROWS[name].checks:
        values = [seed["checks"][check.name] for seed in seeds]
        worst = math.nan if any(map(math.isnan, values)) else max(values)
        told.append(f"{check.name} {cell(worst, 2)} (at most {check.limit:g})")
    return "; ".join(told) or "-"


def verdict(seeds: list[Seed]) -> str:
    """Whether every seed holds, and how many do where not all do."""
    held = sum(not seed["failed"] for seed in seeds)
    return "pass" if held == len(seeds) else f"FAIL, {held} of {len(seeds)} hold"


def seed_table(rows: dict[str, list[Seed]]) -> str:
    """Every seed's figures in Markdown."""
    every = [
        ((f"`{name}`", str(seed["seed"]), "; ".join(seed["failed"]) or "-"), seed)
        for name, seeds in rows.items()
        for seed in seeds
    ]
    lines = figures_table(("scenario", "seed", "fails at"), {**_COLUMNS, **_MORE}, every)
    return "\n".join(["", "<details><summary>Every seed</summary>", "", *lines, "", "</details>"]) + "\n"


def main() -> int:
    """Returns 0, or 1 where a bar is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.scenarios", description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*ROWS, []], metavar="NAME", help=f"of {', '.join(ROWS)}")
    parser.add_argument("--seeds", type=int, default=5, help="run seeds 0 to this less one")
    parser.add_argument("--workers", type=int, default=1, help="processes; step times are honest with one only")
    parser.add_argument("--duration", type=float, help="shorter recordings [s], for trying out: nothing is written")
    options = parser.parse_args()
    facts = provenance(options.workers)
    rows: dict[str, list[Seed]] = {}
    for name in options.names or ROWS:
        for seed in run_seeds(name, options.seeds, options.workers, options.duration):
            rows.setdefault(name, []).append(seed)
            figures = ", ".join(f"{label} {cell(seed[key], digits)}" for key, (label, digits) in _COLUMNS.items())
            checked = "".join(f", {check} {cell(value, 3)}" for check, value in seed["checks"].items())
            told = "; ".join(seed["failed"]) or "pass"
            print(f"{name} {seed['seed']}: {figures}{checked}: {told}", file=sys.stderr, flush=True)
    text = summary_table(rows, facts)
    print(text)
    if not options.names and options.duration is None:
        bars = {name: _limits(ROWS[name]) for name in rows}
        write("scenarios", text + seed_table(rows), {"provenance": facts, "bars": bars, "rows": plain(rows)})
    return 0 if all(verdict(seeds) == "pass" for seeds in rows.values()) else 1


def _limits(row: Row) -> dict[str, float]:
    """A row's bar and checks for JSON."""
    asked = {"robot_rmse_m": row.robot, "beacon_mean_m": row.beacons, "heading_deg_median": row.heading}
    return {key: value for key, value in asked.items() if math.isfinite(value)} | {c.name: c.limit for c in row.checks}


if __name__ == "__main__":
    sys.exit(main())
