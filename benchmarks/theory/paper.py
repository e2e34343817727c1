"""Every table and figure of the paper in simulation, with both presets, beside the paper's figures."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed

import numpy as np

from benchmarks.metric import Metric, Report
from benchmarks.tables import cell, line
from benchmarks.theory import paper_cases as cases
from benchmarks.theory.paper_cases import Case, run_seed

_FIRST, _SEEDS = 900, 10
_THEIRS: dict[tuple[str, str], dict[str, str]] = {
    ("workshop", cases.NO_CORRECTION): {"beacons' error [m]": "0.213", "its std [m]": "0.136"},
    ("workshop", cases.CORRECTED): {"beacons' error [m]": "0.076", "its std [m]": "0.122"},
    ("workshop", cases.TINY_GAMMA): {"beacons' error [m]": "0.206", "its std [m]": "0.149"},
    ("corridor", cases.LIDAR_ONLY): {"length [m]": "8.43 (HectorSLAM)"},
    ("corridor", cases.PAPER): {"length [m]": "22.7 (true)"},
}
"""What the paper reports."""
_TITLES = {
    "workshop": "Workshop, three laps (Table I, figure of the four cases)",
    "dynamic": "Beacons that drop, join and move (figure of N_t)",
    "speed": "Speed: one lap (figure of HectorSLAM at two speeds)",
    "clock": "The clock: workshop, three laps, at fewer steps a second",
    "corridor": "Corridor of 22.7 m, walls seen 6 m far",
}
_ABOUT = """{seeds} seeds, each a workshop of 12 x 19 m or a corridor of its own; mean and, after the sign, standard
deviation over the seeds. sigma_n = sigma_w = 0.1, LiDAR noise 0.01 m. Beacons' error as in Table I: as published, over
time and beacons, after one rigid motion. A map with more than 0.03 stray cells is doubled or smeared. The robot's
figures are after one rigid motion of robot and beacons. LiDAR only is gamma = 0 without ranges: HectorSLAM's objective,
but begun from a predicted pose; 40 scans a second, 10 with ranges."""


def measure(*, quick: bool) -> Report:
    """All experiments; two processes, for they take the same cores as one."""
    seeds = range(_FIRST, _FIRST + (1 if quick else _SEEDS))
    context = multiprocessing.get_context("spawn")  # a forked JAX hangs
    runs: list[Case] = []
    with ProcessPoolExecutor(min(2, os.cpu_count() or 1), mp_context=context) as pool:
        jobs = {
            pool.submit(run_seed, name, seed, seed == _FIRST): (name, seed)
            for seed in seeds
            for name in cases.EXPERIMENTS
        }
        for done in as_completed(jobs):
            runs += done.result()
            print(*jobs[done], file=sys.stderr, flush=True)
    if not quick:
        from benchmarks.theory.paper_figures import draw

        draw(runs)
    found: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for case in runs:
        for name, value in case.figures.items():
            found[case.experiment, case.setting][name].append(value)
    return Report("The paper's experiments", _text(found, len(seeds)), list(_metrics(found)))


_Found = Mapping[tuple[str, str], Mapping[str, Sequence[float]]]


def _text(found: _Found, seeds: int) -> str:
    """A table for each experiment in Markdown."""
    lines = [_ABOUT.format(seeds=seeds).replace("\n", " ")]
    for experiment, title in _TITLES.items():
        settings = [setting for name, setting in found if name == experiment]
        names = list(found[experiment, settings[0]])
        lines += ["", f"### {title}", "", line(["", *names]), line(["---", *["---:"] * len(names)])]
        for setting in settings:
            cells = [_spread(found[experiment, setting][name]) for name in names]
            theirs = _THEIRS.get((experiment, setting), {})
            told = [f"{mine}; paper {theirs[n]}" if n in theirs else mine for n, mine in zip(names, cells, strict=True)]
            lines.append(line([setting, *told]))
    return "\n".join([*lines, "", "### What is asked", ""])


def _spread(values: Sequence[float]) -> str:
    known = [v for v in values if np.isfinite(v)]
    if not known:
        return "-"
    lost = f" ({len(values) - len(known)} without)" if len(known) < len(values) else ""
    return f"{cell(float(np.mean(known)), 3)} ± {cell(float(np.std(known)), 3)}{lost}"


def _metrics(found: _Found) -> list[Metric]:
    """What is asked of it: the comparison has to be fair, and the preset robust better."""

    def all_of(experiment: str, setting: str, name: str) -> np.ndarray:
        return np.asarray(found[experiment, setting][name], float)

    length = all_of("corridor", cases.LIDAR_ONLY, "length [m]")
    fused = all_of("corridor", cases.ROBUST, "length [m]")
    robust = [all_of(name, s, "stray cells of the map") for name, s in _ROBUST]
    off = np.abs(fused - cases.LENGTH)
    fast = all_of("speed", cases.FAST, _RMS)
    published = all_of("workshop", cases.ROBUST, "beacons' error [m]")
    ended = all_of("workshop", cases.ROBUST, "at the end [m]")
    return [
        Metric(
            "LiDAR only at 0.8 m/s: robot RMS, mean",
            float(fast.mean()),
            "m",
            "lower",
            0.010,
        ),
        Metric("LiDAR only: corridor's length, mean", float(length.mean()), "m", "higher", 5.0),
        Metric("LiDAR only: the same against its upper bar", float(length.mean()), "m", "lower", 10.0),
        Metric("robust: beacons as published, mean", float(published.mean()), "m", "lower", 0.02),
        Metric("robust: beacons at the end, mean", float(ended.mean()), "m", "lower", 0.02),
        Metric("robust: corridor's length off by, worst", float(off.max()), "m", "lower", 0.10),
        Metric("robust: stray cells of a map, worst", float(np.concatenate(robust).max()), "", "lower", 0.03),
    ]


_RMS = "robot RMS [m]"
_ROBUST = (
    ("workshop", cases.ROBUST),
    ("dynamic", cases.ROBUST),
    ("speed", cases.FUSED_FAST),
    ("corridor", cases.ROBUST),
)
