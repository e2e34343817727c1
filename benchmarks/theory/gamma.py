"""Preset paper: the track's error against gamma, by how much there is to see and how many ranges there are.

The paper's rule of thumb: large gamma where there are few features and many ranges in sight, small where there are many
features and few ranges.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import uwbslam_jax as us
from benchmarks.metric import Metric, Report
from uwbslam_jax.sim import Beacon, Lidar, Scenario, Uwb, paths, spread, stream, worlds

GAMMAS = (1e-6, 0.01, 0.1, 0.65, 3.0, 15.0, 100.0)
_SEEDS = (700, 701)
_SECONDS = 60.0
_SIZE_M = (12.0, 18.0)
PLACES = ("feature-rich hall", "feature-poor hall", "corridor")
RANGES = ("few ranges", "many ranges")
PICTURE = Path(__file__).parents[2] / "docs" / "images" / "gamma.png"


def measure(*, quick: bool) -> Report:
    """All places, ranges and gammas."""
    seeds, gammas = (_SEEDS[:1], GAMMAS[::3]) if quick else (_SEEDS, GAMMAS)
    table: dict[tuple[str, str], np.ndarray] = {}
    for place in PLACES:
        for ranges in RANGES:
            logs = [list(us.Simulation(made(place, ranges, seed))) for seed in seeds]
            rms = [[_error(log, gamma) for log in logs] for gamma in gammas]
            table[place, ranges] = np.median(np.array(rms), axis=1)
            print(f"{place}, {ranges}: {np.round(table[place, ranges], 3).tolist()}", file=sys.stderr, flush=True)
    if not quick:
        _draw(table, gammas)
    about = (
        f"Median robot RMS of {len(seeds)} seeds after one rigid motion over robot and beacons, as published; 60 s, "
        "ranges of 0.1 m, 361 beams. All pairs, 10 Hz: of five beacons where there are many ranges, of three where "
        "there are few. The poor hall is the rich one's outline without niches and furniture, seen 8 m far."
    )
    return Report("Gamma of the paper", about, list(_metrics(table, gammas)))


def _metrics(table: dict[tuple[str, str], np.ndarray], gammas: tuple[float, ...]) -> Iterator[Metric]:
    best = {
        case: gammas[int(np.nanargmin(errors))] if np.isfinite(errors).any() else np.nan
        for case, errors in table.items()
    }
    for case, errors in table.items():
        for gamma, error in zip(gammas, errors, strict=True):
            yield Metric(f"{', '.join(case)}: gamma {gamma:g}", float(error), "m", "lower")
        yield Metric(f"{', '.join(case)}: best gamma", best[case], "1/m^2")
        spread = float(np.nanmax(errors) / np.nanmin(errors))
        yield Metric(f"{', '.join(case)}: worst over best gamma", spread, "x")
    poor, rich = best["feature-poor hall", "many ranges"], best["feature-rich hall", "few ranges"]
    yield Metric("rule of thumb: best gamma, poor hall and many ranges over rich hall and few", poor / rich, "x")


def made(place: str, ranges: str, seed: int) -> Scenario:
    """One case."""
    many = ranges == "many ranges"
    uwb = Uwb()
    if place == "corridor":
        base = us.simulate("corridor_recess", seed).scenario
        kept = base.beacons if many else base.beacons[::2]
        return replace(base, beacons=kept, uwb=uwb, lidar=Lidar(beams=361, reach=6.0))
    world = worlds.hall(seed, _SIZE_M)
    track = paths.Track(world.lap, 1.2, closed=True)
    spots = spread(world, track.sample(0.25), 5, stream(seed, "beacons"), apart=4.0)
    beacons = tuple(Beacon(k + 1, (float(x), float(y))) for k, (x, y) in enumerate(spots[: 5 if many else 3]))
    lidar = Lidar(beams=361)
    if place == "feature-poor hall":
        width, depth = _SIZE_M
        corners = worlds.box((0.5 * width, 0.5 * depth), (width, depth))
        world, lidar = replace(world, segments=worlds.polygon(corners), outline=corners), Lidar(beams=361, reach=8.0)
    path = paths.Path([paths.Rest(4.0), paths.Along(track, 0.0, 0.8 * _SECONDS)])
    return Scenario(place, seed, _SECONDS, world, path, beacons, lidar, uwb)


def _error(messages, gamma: float) -> float:
    """Robot RMS [m]; NaN where start-up decides nothing, or the state is not finite any more."""
    result = us.run(messages, us.Settings(filter=us.FilterSettings(preset="paper", gamma=gamma)))
    if result.summary["decided_at"] is None or result.truth is None or not np.isfinite(result.poses).all():
        return float("nan")
    return float(us.evaluate(result, result.truth)["robot_rmse_m"])


def _draw(table: dict[tuple[str, str], np.ndarray], gammas: tuple[float, ...]) -> None:
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, every = plt.subplots(1, len(PLACES), figsize=(11, 3.4), sharey=True)
    for axes, place in zip(every, PLACES, strict=True):
        for ranges in RANGES:
            axes.loglog(gammas, table[place, ranges], "o-", label=ranges)
        axes.set(title=place, xlabel="gamma [1/m^2]")
    every[0].set_ylabel("robot RMS [m]")
    every[0].legend()
    figure.tight_layout()
    figure.savefig(PICTURE, dpi=110)
    plt.close(figure)
