"""The end of a run: every file of it, and its figures in words. What it prints is for the user of the command line."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from uwbslam_jax.api import Result


def deliver(result: Result, out: Path, title: str, told: Collection[str] = ()) -> None:
    """Writes every file of a run into a folder and prints its figures, and the warnings that were not told before.

    Raises:
      OSError: a file cannot be written.
    """
    result.save(out, title)
    for warning in [*result.summary["warnings"], *filter(None, [result.summary["truncated"]])]:
        if warning not in told:
            warn(warning)
    print(table([*accuracy(result.summary), *effort(result)]))
    print(f"report: {out / 'report.html'}")


def warn(line: str) -> None:
    """Prints a warning where it is seen at once, also beside output that goes elsewhere."""
    print(f"warning: {line}", file=sys.stderr, flush=True)


def accuracy(figures: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Figures against the truth, named, with units."""
    named = {
        "robot_rmse_m": ("robot, RMS", "{:.3f} m"),
        "robot_ate_m": ("robot, ATE (aligned alone)", "{:.3f} m"),
        "online_ate_m": ("robot, ATE of what was published at the time", "{:.3f} m"),
        "robot_max_m": ("robot, largest", "{:.3f} m"),
        "heading_deg_median": ("heading, median", "{:.2f} deg"),
        "heading_deg_p95": ("heading, 95 %", "{:.2f} deg"),
        "beacon_mean_m": ("beacons, mean", "{:.3f} m"),
        "beacon_max_m": ("beacons, largest", "{:.3f} m"),
        "covered": ("share of the time covered", "{:.3f}"),
        "pose_nees_ratio": ("pose, NEES / dof", "{:.2f}"),
        "beacon_nees_ratio": ("beacons, NEES / dof", "{:.2f}"),
    }
    for key, (name, form) in named.items():
        if key in figures:
            yield name, form.format(figures[key])
    if figures.get("beacons_missing"):
        yield "beacons not placed", ", ".join(map(str, figures["beacons_missing"]))


def effort(result: Result) -> Iterator[tuple[str, str]]:
    """What was found, and what it took."""
    summary = result.summary
    decided = summary["decided_at"]
    states = [beacon.status for beacon in result.beacons]
    yield "frame decided at", f"{decided:.1f} s" if decided is not None else f"never ({summary['status']})"
    counts = [f"{states.count(status)} {status}" for status in dict.fromkeys(states)]
    yield "beacons placed", f"{len(states)} of {len(summary['ids'])} ({', '.join(counts)})" if states else "none"
    yield "recording", f"{summary['duration_s']:.1f} s, {summary['steps']} steps"
    yield (
        f"step ({summary['engine']}), median and 95 %",
        f"{summary['step_ms_median']:.2f} ms, {summary['step_ms_p95']:.2f} ms",
    )
    yield "real-time factor", f"{summary['real_time_factor']:.1f} (compilation, {summary['compile_s']:.1f} s, left out)"


def table(rows: Iterable[tuple[str, str]]) -> str:
    rows = list(rows)
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)
