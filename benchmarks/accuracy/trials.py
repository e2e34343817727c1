"""One scenario and seed through simulator and estimator: its figures, and the Trial that the checks judge."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import uwbslam_jax as us
from benchmarks.accuracy.checks import NAN, Trial, rms_outside
from benchmarks.accuracy.intervals import disturbed
from benchmarks.accuracy.sharpness import occupied, own_fit, sharpness, stray, wall_distances
from benchmarks.accuracy.suite import Check
from uwbslam_jax.evaluation import RigidMotion, align, consistency, evaluate
from uwbslam_jax.numerics import wrapped
from uwbslam_jax.sim import START_NS, Scenario


@dataclass(frozen=True)
class Outcome:
    """A run's result with the truth, and what was made of both.

    Attributes:
      result, truth: of the run.
      motion: from the published frame into the truth's, fitted where the robot is not disturbed.
      trial: what was published at the time; whole: the same with the track as the whole run tells it. The checks judge
        these.
      figures: name -> number, see `measure`.
    """

    result: us.Result
    truth: us.Truth
    motion: RigidMotion
    trial: Trial
    whole: Trial
    figures: dict[str, Any]

    def found(self, checks: Iterable[Check], scenario: Scenario) -> dict[str, float]:
        """Figure of each check by its name."""
        return {c.name: c.measure(self.trial if c.online else self.whole, scenario) for c in checks}


def resident_mb() -> float:
    """Memory that this process holds now [MB], NaN where the system does not tell as Linux does."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20 if told.exists() else NAN


def measure(scenario: Scenario, settings: us.Settings | None = None) -> Outcome:
    """Simulates, runs with the defaults, or with settings of another kind, and compares.

    The figures are robot_rmse_m (where the robot is not disturbed), online_rmse_m (the same of what was published on
    the way, laid over the truth by itself), robot_max_m, heading_deg_median, beacon_mean_m,
    beacon_max_m, beacons_missing, covered, decided_s, sharpness, own_sharpness, stray, real_time_factor, peak_rss_mb,
    pose_nees_ratio and beacon_nees_ratio; NaN where there is nothing to compare.
    """
    simulation = us.Simulation(scenario)
    memory: list[float] = []
    messages = list(simulation)  # so that the run's time is without the simulation's
    result = us.run(messages, settings or simulation.settings, progress=lambda *_: memory.append(resident_mb()))
    truth = result.truth
    assert truth is not None
    apart = disturbed(scenario)
    beacons = {beacon.id: beacon.position for beacon in result.beacons}
    motion = align(*_undisturbed(result, apart), beacons, truth)
    stamps, _ = _undisturbed(result, apart)
    calm = np.isin(result.stamps, stamps)
    # the last of the memory is told after the end
    trial = lay_over(result, truth, align(stamps, result.online[calm], {}, truth), memory[:-1])
    whole = dataclasses.replace(lay_over(result, truth, motion), poses=motion.poses(result.poses))
    of_all = evaluate(result.stamps, result.poses, beacons, truth)
    true = truth.beacon_positions()
    off = [np.linalg.norm(motion.points(xy[None])[0] - true[node]) for node, xy in beacons.items() if node in true]
    turned = np.abs(wrapped(whole.poses[calm, 2] - whole.true[calm, 2]))
    figures: dict[str, Any] = {key: of_all[key] for key in ("covered", "beacons_missing")}
    figures |= {
        "robot_rmse_m": rms_outside(whole, apart),
        "online_rmse_m": rms_outside(trial, apart),
        "robot_max_m": float(np.linalg.norm(whole.offset[calm], axis=1).max()),
        "heading_deg_median": float(np.rad2deg(np.median(turned))),
        "beacon_mean_m": float(np.mean(off)) if off else NAN,
        "beacon_max_m": float(np.max(off)) if off else NAN,
    }
    figures |= _of_the_map(result.map, motion, scenario.world.segments)
    figures |= {"decided_s": trial.decided}
    figures |= {key: result.summary[key] for key in ("real_time_factor", "peak_rss_mb")}
    figures |= consistency(result, truth)
    return Outcome(result, truth, motion, trial, whole, figures)


def _of_the_map(image: us.MapImage, motion: RigidMotion, walls: np.ndarray) -> dict[str, float]:
    """sharpness where the run's fit puts the map; own_sharpness and stray where the map itself fits best."""
    cells = occupied(image, motion)
    distances = wall_distances(cells, walls)
    own = wall_distances(own_fit(cells, walls).points(cells), walls)
    size = image.resolution
    return {"sharpness": sharpness(distances, size), "own_sharpness": sharpness(own, size), "stray": stray(own)}


def _undisturbed(result: us.Result, apart: Iterable[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and poses that the fit may use."""
    t = (result.stamps - START_NS) / 1e9
    use = np.ones(t.shape, bool)
    for begin, end in apart:
        use &= (t < begin) | (t >= end)
    return result.stamps[use], result.poses[use]


def lay_over(result: us.Result, truth: us.Truth, motion: RigidMotion, memory: Sequence[float] = ()) -> Trial:
    """What a run published on its way, moved into the frame of the truth, in seconds since the simulation's start."""
    began = (result.stamps[0] - START_NS) / 1e9
    decided = result.summary["decided_at"]

    def moved(track: np.ndarray) -> np.ndarray:
        return np.column_stack([track[:, 0] + began, motion.points(track[:, 1:3])])

    def timed(track: np.ndarray) -> np.ndarray:
        return np.column_stack([(track[:, 0] - START_NS) / 1e9, track[:, 1:]])

    return Trial(
        t=(result.stamps - START_NS) / 1e9,
        poses=motion.poses(result.online),
        true=truth.poses_at(result.stamps),
        beacons={node: moved(track) for node, track in result.beacon_tracks.items()},
        true_beacons={node: timed(track) for node, track in truth.beacons.items()},
        decided=NAN if decided is None else began + decided,
        hypotheses=result.diagnostics["hypotheses"],
        warnings=tuple(result.summary["warnings"]),
        memory=np.asarray(memory, float),
        scale=result.summary["found_scale"],
    )
