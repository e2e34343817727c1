"""The paper's experiments in simulation: one seed of each with every setting, as figures and as what pictures need."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.accuracy import intervals
from benchmarks.accuracy.trials import Outcome, measure
from uwbslam_jax import FilterSettings, MapImage, Result, Settings, simulate
from uwbslam_jax.evaluation import rigid_fit
from uwbslam_jax.numerics import wrapped
from uwbslam_jax.sim import Scenario, paths

LENGTH = 22.7
"""Of the corridor [m]."""
_LIDAR_SIGMA = 0.01
"""The paper adds noise of 1 to 2 cm [m]."""
_LATELY_S = 2.0

Figures = dict[str, float]

_PAPER = FilterSettings(preset="paper")
_LIDAR_ONLY = FilterSettings(lidar_only=True)
NO_MATCH = "no scan matching, no correction"
NO_CORRECTION = "gamma 0.65, no correction"
CORRECTED = "gamma 0.65, correction"
TINY_GAMMA = "gamma 1e-6, correction"
ROBUST = "preset robust"
WORKSHOP = {
    NO_MATCH: replace(_PAPER, scan_matching=False, correction=False),
    NO_CORRECTION: replace(_PAPER, correction=False),
    CORRECTED: _PAPER,
    TINY_GAMMA: replace(_PAPER, gamma=1e-6),
    ROBUST: FilterSettings(),
}
SLOW, FAST, FAST_FEW = "LiDAR only, 0.4 m/s", "LiDAR only, 0.8 m/s", "LiDAR only, 0.8 m/s, 5 scans a second"
FUSED_FAST, PAPER_FAST = "preset robust, 0.8 m/s", "preset paper, 0.8 m/s"
SPEEDS = {
    SLOW: (0.4, 40.0, _LIDAR_ONLY),
    FAST: (0.8, 40.0, _LIDAR_ONLY),
    FAST_FEW: (0.8, 5.0, _LIDAR_ONLY),
    PAPER_FAST: (0.8, 10.0, _PAPER),
    FUSED_FAST: (0.8, 10.0, FilterSettings()),
}
"""Speed [m/s], scans a second, settings."""
LIDAR_ONLY, NOISIER, PAPER = "LiDAR only", "LiDAR only, noise 0.015 m", "preset paper"
DYNAMIC = {PAPER: _PAPER, ROBUST: FilterSettings()}
CORRIDOR = {
    LIDAR_ONLY: (_LIDAR_SIGMA, 40.0, _LIDAR_ONLY),
    NOISIER: (0.015, 40.0, _LIDAR_ONLY),
    PAPER: (_LIDAR_SIGMA, 10.0, _PAPER),
    ROBUST: (_LIDAR_SIGMA, 10.0, FilterSettings()),
}
"""Noise of the LiDAR [m], scans a second, settings."""

CLOCK = {
    f"{rate:g} steps a second, {about}": (rate, chosen)
    for rate in (10.0, 5.0, 3.3)
    for about, chosen in (("no correction", replace(_PAPER, correction=False)), ("correction", _PAPER))
}
"""Scans and rounds of ranges a second, settings: 15 pairs of 3 ms each, and 135 steps where the paper counts its run in
steps, point to some 4 to 5 a second."""


@dataclass(frozen=True)
class Seen:
    """What a picture needs of a run, in the published frame.

    Attributes:
      map: at the end.
      t: (T,) [s]; poses: (T, 3) as published [m, m, rad].
      beacons: id -> (n, 2) as published over time [m].
      walls: (S, 4) the true ones, laid into the published frame [m].
      counted, alive: (T,) beacons whose ranges the estimator used lately, and those that were switched on.
      off: (T,) error of the heading [rad]; score: (T,) how well the scan fits after the match.
    """

    map: MapImage
    t: np.ndarray
    poses: np.ndarray
    beacons: dict[int, np.ndarray]
    walls: np.ndarray
    counted: np.ndarray
    alive: np.ndarray
    off: np.ndarray
    score: np.ndarray


@dataclass(frozen=True)
class Case:
    """One run.

    Attributes:
      experiment, setting: which one.
      figures: name with unit -> figure, NaN where the run has none.
      seen: for pictures, None where none is wanted.
    """

    experiment: str
    setting: str
    figures: Figures
    seen: Seen | None = field(default=None, repr=False)


def run_seed(experiment: str, seed: int, pictured: bool) -> list[Case]:
    """Every setting of an experiment on one seed's world."""
    return [
        Case(experiment, setting, figures, _seen(outcome, made) if pictured else None)
        for setting, made, outcome, figures in EXPERIMENTS[experiment](seed)
    ]


_Run = tuple[str, Scenario, Outcome, Figures]


def _workshop(seed: int) -> Iterator[_Run]:
    made = _noisy(simulate("workshop", seed).scenario)
    for setting, chosen in WORKSHOP.items():
        outcome = measure(made, Settings(filter=chosen))
        yield setting, made, outcome, _beacon_figures(outcome) | _of(outcome, "robot", "heading", "stray")


def _dynamic(seed: int) -> Iterator[_Run]:
    made = _noisy(simulate("schedule", seed).scenario)
    for setting, chosen in DYNAMIC.items():
        outcome = measure(made, Settings(filter=chosen))
        seen = _seen(outcome, made)
        counted = float(np.mean(seen.counted == seen.alive))
        yield setting, made, outcome, _of(outcome, "robot", "stray") | {"share of time with the true N_t": counted}


def _speed(seed: int) -> Iterator[_Run]:
    base = simulate("workshop", seed).scenario
    track = paths.Track(base.world.lap, 1.2, closed=True)
    for setting, (speed, rate, chosen) in SPEEDS.items():
        path = paths.Path([paths.Rest(4.0), paths.Along(track, 0.0, track.length, speed), paths.Rest(1.0)])
        made = _noisy(replace(base, path=path, duration=path.duration), rate)
        outcome = measure(made, Settings(filter=chosen))
        yield setting, made, outcome, _of(outcome, "robot", "heading", "stray")


def _clock(seed: int) -> Iterator[_Run]:
    base = simulate("workshop", seed).scenario
    for setting, (rate, chosen) in CLOCK.items():
        made = _noisy(replace(base, uwb=replace(base.uwb, rate=rate)), rate)
        outcome = measure(made, Settings(filter=chosen))
        yield setting, made, outcome, _of(outcome, "robot", "heading", "stray")


def _corridor(seed: int) -> Iterator[_Run]:
    base = simulate("corridor", seed).scenario
    first, second, *_ = intervals.stops(base)
    for setting, (sigma, rate, chosen) in CORRIDOR.items():
        made = _noisy(base, rate, sigma)
        outcome = measure(made, Settings(filter=chosen))
        at = [int(np.argmin(np.abs(outcome.whole.t - stop))) for stop in (first, second)]
        told, true = (
            float(np.hypot(*np.diff(p[at, :2], axis=0)[0])) for p in (outcome.whole.poses, outcome.whole.true)
        )
        yield setting, made, outcome, {"length [m]": LENGTH - true + told} | _of(outcome, "robot", "stray")


EXPERIMENTS = {"workshop": _workshop, "dynamic": _dynamic, "speed": _speed, "clock": _clock, "corridor": _corridor}
"""Each yields setting, scenario, outcome and figures for a seed."""


def _noisy(made: Scenario, rate: float | None = None, sigma: float = _LIDAR_SIGMA) -> Scenario:
    return replace(made, lidar=replace(made.lidar, sigma=sigma, rate=rate or made.lidar.rate))


def _of(outcome: Outcome, *names: str) -> Figures:
    """The figures of these names; of the track as the whole run tells it, which without a back end is as published."""
    keys = {
        "robot": ("robot RMS [m]", "robot_rmse_m"),
        "heading": ("heading, median [deg]", "heading_deg_median"),
        "stray": ("stray cells of the map", "stray"),
    }
    return {keys[name][0]: float(outcome.figures[keys[name][1]]) for name in names}


def _beacon_figures(outcome: Outcome) -> Figures:
    """Table I: error of the beacons as published, averaged over time and beacons, after one rigid motion of all of them
    over the true ones, and the error's standard deviation; and the error at the end."""
    told = outcome.result.beacon_tracks
    true = outcome.truth.beacon_positions()
    known = [node for node in told if node in true and len(told[node])]
    if len(known) < 2:
        return {"beacons' error [m]": np.nan, "its std [m]": np.nan, "at the end [m]": np.nan}
    points = np.concatenate([told[node][:, 1:3] for node in known])
    spots = np.concatenate([np.repeat(true[node][None], len(told[node]), axis=0) for node in known])
    off = np.linalg.norm(rigid_fit(points, spots).points(points) - spots, axis=1)
    return {
        "beacons' error [m]": float(off.mean()),
        "its std [m]": float(off.std()),
        "at the end [m]": float(outcome.figures["beacon_mean_m"]),
    }


def _seen(outcome: Outcome, made: Scenario) -> Seen:
    result = outcome.result
    back = rigid_fit(outcome.truth.poses_at(result.stamps)[:, :2], result.online[:, :2])
    walls = back.points(made.world.segments.reshape(-1, 2)).reshape(-1, 4)
    t = outcome.trial.t
    alive = np.array([sum(any(a <= now < b for a, b in beacon.alive) for beacon in made.beacons) for now in t])
    return Seen(
        map=result.map,
        t=t,
        poses=result.online,
        beacons={node: track[:, 1:3] for node, track in result.beacon_tracks.items()},
        walls=walls,
        counted=_heard(result, made.uwb.robot_id),
        alive=alive,
        off=np.asarray(wrapped(outcome.trial.poses[:, 2] - outcome.trial.true[:, 2])),
        score=np.asarray(result.diagnostics["match_score"]),
    )


def _heard(result: Result, robot: int) -> np.ndarray:
    """(T,) beacons with a range that the estimator had an expectation of within the last moments."""
    t = (result.stamps - result.stamps[0]) * 1e-9
    counts = np.zeros(len(t), int)
    rows = result.range_residuals
    for node in set(rows[:, 1:3].ravel().astype(int).tolist()) - {robot}:
        times = rows[(rows[:, 1:3] == node).any(axis=1), 0]
        latest = np.searchsorted(times, t, side="right")
        counts += (latest > 0) & (t - times[np.maximum(latest - 1, 0)] < _LATELY_S)
    return counts
