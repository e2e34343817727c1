"""How far off the answer is in the simulated scenarios: each seed has its own world, beacons and orientation.

`python -m benchmarks.scenarios hall --seeds 10` writes results/scenarios_hall.md and .json; exit status 1 if a bar is
missed. `all` runs every scenario that has a bar.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from uwbslam_jax.__main__ import prepare

RESULTS = Path(__file__).parent / "results"


class Bar(NamedTuple):
    """What every seed has to stay below: robot and beacons [m], heading [deg]."""

    robot_rmse_m: float
    beacon_mean_m: float
    heading_deg_median: float


BARS = {"hall": Bar(0.020, 0.020, 0.20)}
"""Scenario -> bar. A scenario without one is measured all the same."""

_COLUMNS = {
    "robot_rmse_m": ("robot RMS [m]", 4),
    "beacon_mean_m": ("beacons mean [m]", 4),
    "beacon_max_m": ("beacons max [m]", 4),
    "heading_deg_median": ("heading median [deg]", 3),
    "decided_s": ("decided at [s]", 1),
    "real_time_factor": ("real-time factor", 1),
    "load": ("machine load", 1),
}


@dataclass(frozen=True)
class Row:
    """One seed's figures; NaN where there is nothing to compare, decided_s where the frame never was decided.

    load is the machine's (1 min average) when the seed was done: above 1 and other work has slowed the run down.
    """

    seed: int
    robot_rmse_m: float
    beacon_mean_m: float
    beacon_max_m: float
    heading_deg_median: float
    decided_s: float
    real_time_factor: float
    load: float
    beacons_missing: list[int] = field(default_factory=list)

    def passes(self, bar: Bar) -> bool:
        """Whether every figure stays below its bar and no beacon is missing; NaN never does."""
        return not self.beacons_missing and all(getattr(self, key) < limit for key, limit in bar._asdict().items())


def measure(name: str, seed: int, duration: float | None) -> Row:
    """Simulates one seed, runs it and compares."""
    # here, not above: a worker process sets up JAX on its own
    from uwbslam_jax.metrics import evaluate
    from uwbslam_jax.run import run_messages
    from uwbslam_jax.settings_file import from_dict
    from uwbslam_jax.simulate import scenario, settings_overrides, simulate

    made = scenario(name, seed, duration)
    result, truth = run_messages(list(simulate(made)), from_dict(settings_overrides(made)))
    assert truth is not None
    beacons = {beacon.id: beacon.position for beacon in result.beacons}
    figures = evaluate(result.stamps, result.poses, beacons, truth)
    keys = ("robot_rmse_m", "beacon_mean_m", "beacon_max_m", "heading_deg_median", "beacons_missing")
    decided = result.summary["decided_at"]
    return Row(
        seed,
        **{key: figures[key] for key in keys},
        decided_s=math.nan if decided is None else decided,
        real_time_factor=result.summary["real_time_factor"],
        load=os.getloadavg()[0],
    )


def run_seeds(name: str, seeds: int, workers: int, duration: float | None) -> Iterator[Row]:
    """The rows in order of their seeds, each as soon as it is there."""
    if workers <= 1:
        yield from (measure(name, seed, duration) for seed in range(seeds))
        return
    context = multiprocessing.get_context("spawn")  # a forked JAX hangs
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from pool.map(measure, [name] * seeds, range(seeds), [duration] * seeds)


def provenance(workers: int) -> dict[str, str]:
    """What the figures depend on besides the seeds."""
    packages = ("jax", "jaxlib", "optimistix", "lineax", "numpy")
    return {
        "commit": _commit(),
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "CPU": f"{_cpu()}, {os.cpu_count()} cores, {workers} at once",
        "Python": platform.python_version(),
        **{name: version(name) for name in packages},
        "dtype": "float32",
    }


def _commit() -> str:
    def git(*words: str) -> str:
        folder = Path(__file__).parent
        done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    # the tables that this writes do not count as a change
    changed = git("status", "--porcelain", "--untracked-files=no", "--", "..", ":!results")
    return (git("rev-parse", "--short", "HEAD") or "unknown") + (" with changes" if changed else "")


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def table(name: str, rows: list[Row], facts: dict[str, str]) -> str:
    """The figures of one scenario in Markdown."""
    bar = BARS.get(name)
    head = ["seed", *(label for label, _ in _COLUMNS.values()), *(["bar"] if bar else [])]
    lines = [f"# Scenario `{name}`, seeds 0 to {len(rows) - 1}", ""]
    lines += [", ".join(f"{key} {value}" for key, value in facts.items()) + ".", ""]
    if bar:
        limits = f"robot RMS {bar[0]:g} m, beacons mean {bar[1]:g} m, heading median {bar[2]:g} deg"
        lines += [f"Bar for every seed: {limits}, every beacon placed.", ""]
    lines += [line(head), line(["---:"] * len(head))]
    for row in rows:
        verdict = [("pass" if row.passes(bar) else "FAIL")] if bar else []
        lines.append(line([str(row.seed), *_cells([row]), *verdict]))
    passed = [f"{sum(row.passes(bar) for row in rows)} of {len(rows)}"] if bar else []
    lines.append(line(["median", *_cells(rows), *passed]))
    lines.append(line(["worst", *_cells(rows, worst=True), *([""] if bar else [])]))
    missing = [f"seed {row.seed}: {', '.join(map(str, row.beacons_missing))}" for row in rows if row.beacons_missing]
    return "\n".join([*lines, *(["", f"Beacons not placed: {'; '.join(missing)}."] if missing else [])]) + "\n"


def line(cells: list[str]) -> str:
    """One row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def _cells(rows: list[Row], worst: bool = False) -> list[str]:
    """The median of each column, or its worst; a figure that is missing is worse than any."""
    cells = []
    for key, (_, digits) in _COLUMNS.items():
        low_is_worse = key == "real_time_factor"
        bad = -math.inf if low_is_worse else math.inf
        values = sorted(
            (bad if math.isnan(v) else v for v in (getattr(row, key) for row in rows)), reverse=low_is_worse
        )
        middle = (values[(len(values) - 1) // 2] + values[len(values) // 2]) / 2
        value = values[-1] if worst else middle
        cells.append(f"{value:.{digits}f}" if math.isfinite(value) else "-")
    return cells


def run_scenario(name: str, seeds: int, workers: int, duration: float | None) -> bool:
    """Measures one scenario, prints and writes its table; whether its bar is held."""
    facts = provenance(workers)
    rows = []
    for row in run_seeds(name, seeds, workers, duration):
        rows.append(row)
        print(f"{name}: {line([str(row.seed), *_cells([row])])}", file=sys.stderr, flush=True)
    text = table(name, rows, facts)
    print(text)
    if duration is None:  # shorter ones are for trying out
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / f"scenarios_{name}.md").write_text(text, encoding="utf-8")
        whole = {"scenario": name, "provenance": facts, "bar": BARS[name]._asdict() if name in BARS else None}
        plain = [{k: None if v != v else v for k, v in asdict(row).items()} for row in rows]
        path = RESULTS / f"scenarios_{name}.json"
        path.write_text(json.dumps({**whole, "rows": plain}, indent=1) + "\n", encoding="utf-8")
    return name not in BARS or all(row.passes(BARS[name]) for row in rows)


def main() -> int:
    """Returns 0, or 1 where a bar is missed."""
    prepare()  # before JAX is imported, which reads it once
    from uwbslam_jax.simulate import SCENARIOS

    parser = argparse.ArgumentParser(prog="python -m benchmarks.scenarios", description=__doc__)
    parser.add_argument("name", choices=[*SCENARIOS, "all"])
    parser.add_argument("--seeds", type=int, default=10, help="run seeds 0 to this less one")
    parser.add_argument("--workers", type=int, default=1, help="processes; step times are honest with one only")
    parser.add_argument("--duration", type=float, help="shorter recordings [s], for trying out: nothing is written")
    options = parser.parse_args()
    names = list(BARS) if options.name == "all" else [options.name]
    held = [run_scenario(name, options.seeds, options.workers, options.duration) for name in names]
    return 0 if all(held) else 1


if __name__ == "__main__":
    sys.exit(main())
