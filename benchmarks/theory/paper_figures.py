"""The paper's figures, from the runs of one seed: docs/images/paper_*.png."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

from benchmarks.theory import paper_cases as cases
from benchmarks.theory.paper_cases import Case, Seen
from uwbslam_jax.plotting import show_map, show_track
from uwbslam_jax.result import trinary

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

IMAGES = Path(__file__).parents[2] / "docs" / "images"


def draw(runs: Sequence[Case]) -> None:
    """All figures, of runs that have what pictures need."""
    seen = {(case.experiment, case.setting): case.seen for case in runs if case.seen is not None}
    _panels("paper_workshop", {s: seen["workshop", s] for s in cases.WORKSHOP}, (16, 4.6))
    _panels("paper_speed", {s: seen["speed", s] for s in cases.SPEEDS}, (16, 4.6))
    _corridors({s: seen["corridor", s] for s in (cases.LIDAR_ONLY, cases.PAPER, cases.ROBUST)})
    _dynamic({s: seen["dynamic", s] for s in cases.DYNAMIC})
    _why(seen["workshop", cases.NO_CORRECTION], seen["workshop", cases.CORRECTED])


def _map(axes: Axes, run: Seen, title: str, beacons: bool = True) -> None:
    """Map, published track and the beacons' last places."""
    show_map(axes, run.map)
    show_track(axes, run.poses, {node: track[-1] for node, track in run.beacons.items()} if beacons else {})
    axes.set_title(title, fontsize=9)
    axes.tick_params(labelsize=7)


def _panels(name: str, runs: dict[str, Seen], size: tuple[float, float]) -> None:
    figure, every = plt.subplots(1, len(runs), figsize=size)
    for axes, (setting, run) in zip(every, runs.items(), strict=True):
        _map(axes, run, setting, beacons="LiDAR only" not in setting)
    _save(figure, name)


def _corridors(runs: dict[str, Seen]) -> None:
    """One below the other, each turned so that the true corridor is level, at one scale."""
    figure, every = plt.subplots(len(runs), 1, figsize=(9, 6.5), sharex=True)
    for axes, (setting, run) in zip(every, runs.items(), strict=True):
        longest = run.walls[np.argmax(np.hypot(*(run.walls[:, 2:] - run.walls[:, :2]).T))]
        angle = np.arctan2(longest[3] - longest[1], longest[2] - longest[0])
        c, s = np.cos(-angle), np.sin(-angle)
        level = np.array([[c, s], [-s, c]])
        ends = run.walls.reshape(-1, 2) @ level
        corner = ends.min(0)
        occupied = np.argwhere(trinary(run.map.log_odds) == 0)[:, ::-1] + 0.5
        cells = (run.map.origin + run.map.resolution * occupied) @ level - corner
        axes.plot(cells[:, 0], cells[:, 1], "s", color="black", ms=0.8)
        axes.plot(*((run.poses[:, :2] @ level) - corner).T, color="tab:blue", lw=0.8)
        if setting != cases.LIDAR_ONLY:
            for track in run.beacons.values():
                axes.plot(*(track[-1] @ level - corner), "^", color="tab:red", ms=6)
        for x in (0.0, cases.LENGTH):
            axes.axvline(x, color="tab:green", ls="--", lw=1)
        axes.set(title=f"{setting}; the true ends dashed", ylabel="[m]", xlim=(-2.5, 25.0), ylim=(-1.5, 4.0))
        axes.set_aspect("equal")
    every[-1].set_xlabel("[m]")
    _save(figure, "paper_corridor")


def _dynamic(runs: dict[str, Seen]) -> None:
    """Where the beacons were, as published, and how many took part."""
    figure, every = plt.subplots(1, len(runs) + 1, figsize=(14, 4.6))
    for axes, (setting, run) in zip(every, runs.items(), strict=False):
        _map(axes, run, setting, beacons=False)
        for k, (node, track) in enumerate(sorted(run.beacons.items())):
            axes.plot(track[:, 0], track[:, 1], ".-", ms=3, lw=0.8, color=f"C{k + 1}", label=f"beacon {node}")
        axes.legend(fontsize=7, loc="upper left")
    one = next(iter(runs.values()))
    every[-1].step(one.t, one.alive, color="black", lw=3, alpha=0.3, label="switched on")
    for setting, run in runs.items():
        every[-1].step(run.t, run.counted, lw=1.2, label=setting)
    every[-1].set(title="N_t, beacons that take part", xlabel="time [s]", ylim=(0, 6))
    every[-1].legend(fontsize=7)
    _save(figure, "paper_dynamic")


def _why(free: Seen, corrected: Seen) -> None:
    """How well a scan fits after the match, against how far off the heading was that the match began from."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.8))
    moving = free.t > free.t[0] + 20.0  # after start-up
    off = np.abs(np.rad2deg(free.off[moving]))
    left.plot(off, free.score[moving], ".", ms=3)
    left.set(xlabel="heading of the velocity, error [deg]", ylabel="fit after the match", xlim=(0, 40), ylim=(0, 1))
    left.set_title("no correction: each scan matched from the filter's own heading", fontsize=9)
    right.plot(corrected.t, np.abs(np.rad2deg(corrected.off)), lw=0.6, label="gamma 0.65, correction")
    right.plot(free.t, np.abs(np.rad2deg(free.off)), lw=0.6, label="no correction")
    right.set(xlabel="time [s]", ylabel="error of the heading [deg]", yscale="log", ylim=(0.01, 180))
    right.legend(fontsize=8)
    _save(figure, "paper_why")


def _save(figure, name: str) -> None:
    figure.tight_layout()
    figure.savefig(IMAGES / f"{name}.png", dpi=75)
    plt.close(figure)
