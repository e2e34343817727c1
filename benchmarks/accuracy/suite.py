"""The rows of the scenario suite: what each scenario is called, its bar, and its own checks with their limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.accuracy import checks, intervals
from benchmarks.accuracy.checks import Trial
from uwbslam_jax.sim import Scenario


@dataclass(frozen=True)
class Check:
    """One thing that is asked of every seed.

    Attributes:
      name: of the figure, with its unit.
      limit: the figure has to stay at or below it.
      measure: figure of a trial and its scenario.
      online: whether what was published at the time is judged, or the track as the whole run tells it.
    """

    name: str
    limit: float
    measure: Callable[[Trial, Scenario], float]
    online: bool = True


@dataclass(frozen=True)
class Row:
    """One scenario's bar; inf where nothing is asked.

    Attributes:
      title: what the situation is.
      robot, beacons: RMS of the robot where it is not disturbed, and mean of the beacons [m].
      heading: median of the heading's error [deg].
      checks: what else is asked.
    """

    title: str
    robot: float
    beacons: float = math.inf
    heading: float = math.inf
    checks: tuple[Check, ...] = ()

    def shortfalls(self, figures: dict[str, Any], found: dict[str, float]) -> list[str]:
        """What a seed fails at, in words; NaN fails whatever the bar. found: name -> figure of the checks."""
        limits = {"robot_rmse_m": self.robot, "beacon_mean_m": self.beacons, "heading_deg_median": self.heading}
        limits |= {"stray": STRAY}
        failed = [
            f"{name} {figures[name]:.3g} > {limit:g}" for name, limit in limits.items() if not figures[name] <= limit
        ]
        failed += [f"{c.name} {found[c.name]:.3g} > {c.limit:g}" for c in self.checks if not found[c.name] <= c.limit]
        failed += [f"covered {figures['covered']:.3f} < {COVERED}"] if not figures["covered"] >= COVERED else []
        failed += ["not decided"] if math.isnan(figures["decided_s"]) else []
        missing = ", ".join(map(str, figures["beacons_missing"]))
        return failed + ([f"beacons not placed: {missing}"] if missing else [])


COVERED = 0.98
"""Share of the time that the track has to cover."""
STRAY = 0.03
"""Share of the map's occupied cells that may lie apart from every wall: more is a doubled wall."""

_LENGTH = Check(
    "length error [m]", 0.10, lambda trial, made: checks.length_error(trial, intervals.stops(made)), online=False
)

ROWS: dict[str, Row] = {
    "hall": Row("hall, laps in both directions, ids in any order", 0.015, 0.015, 0.1),
    "hall40": Row("hall at 40 Hz scans, 20 Hz ranges", 0.015, 0.015),
    "fast": Row("1.6 m/s, corners of 0.9 m radius", 0.03, 0.02),
    "spot": Row("turns on the spot at 90 deg/s, stop and go, reversing", 0.02, 0.02),
    "robot_only": Row("robot-to-beacon ranges only", 0.03, 0.05),
    "three": Row("three beacons", 0.03, 0.04),
    "nlos": Row("ranges through walls too long, powers reported", 0.03, 0.04),
    "nlos_silent": Row("the same, no powers reported", 0.04, 0.08),
    "early": Row("one beacon locks early in stretches of 30 s", 0.04, 0.10),
    "schedule": Row(
        "a beacon joins and is carried, another drops, returns elsewhere and is carried",
        0.03,
        checks=(
            Check("resting beacons [m]", 0.05, lambda t, made: checks.resting_error(t, intervals.rests(made))),
            Check("carried beacons [m]", 0.5, lambda t, made: checks.carried_error(t, intervals.carries(made))),
        ),
    ),
    "frame_moved": Row(
        "the frame's two beacons are moved, then switched off",
        0.03,
        checks=(Check("largest jump [m]", 0.05, lambda trial, _: checks.largest_jump(trial)),),
    ),
    "corridor": Row("corridor 22.7 x 2.4 m, reach 6 m", 0.08, checks=(_LENGTH,)),
    "corridor_recess": Row("the same with door recesses", 0.08, checks=(_LENGTH,)),
    "straight": Row(
        "12 m straight before the first turn",
        0.03,
        0.03,
        checks=(
            Check("told too early", 0.0, lambda t, made: checks.told_too_early(t, intervals.first_turn(made))),
            Check("decided late [s]", 3.0, lambda t, made: checks.decided_late(t, intervals.first_turn(made))),
            Check("filled in [m]", 0.05, lambda trial, _: checks.filled_in(trial), online=False),
        ),
    ),
    "blind": Row(
        "LiDAR blinded for 5 s",
        0.03,
        checks=(Check("while blind [m]", 0.10, lambda t, made: checks.rms_within(t, made.lidar.blind), online=False),),
    ),
    "uwb_silent": Row("UWB silent for 30 s", 0.03),
    "kidnapped": Row(
        "carried off and turned by 120 deg",
        0.03,
        checks=(
            Check("lost for [s]", 2.0, lambda t, made: checks.time_lost(t, intervals.carried(made)[-1][1])),
            Check(
                "afterwards [m]",
                0.03,
                lambda t, made: checks.rms_within(t, [(intervals.disturbed(made)[-1][1], math.inf)]),
                online=False,
            ),
        ),
    ),
    "gap": Row(
        "switched off for an hour, carried and turned by 120 deg meanwhile",
        0.03,
        0.03,
        checks=(Check("lost for [s]", 2.0, lambda t, made: checks.time_lost(t, intervals.resumed(made))),),
    ),
    "slow_lidar": Row("1 Hz scans of 361 beams, 3 beacons, robot-only ranges, odometry", 0.10, 0.15),
    "sparse": Row(
        "a scan every metre (2.5 s), 181 beams, wheels at 10 Hz",
        0.03,
        0.03,
        checks=(Check("decided after [s]", 60.0, lambda trial, _: trial.decided),),
    ),
    "lever_arms": Row("lever arms and heights, configured", 0.03, 0.03),
    "biased": Row(
        "antenna delays of 0.15 m rms, not configured",
        0.05,
        0.15,
        checks=(Check("not told as biased", 0.0, lambda trial, _: checks.untold(trial, "biased")),),
    ),
    "heights": Row("heights of 0.3 to 3 m over the robot's antenna, not configured", 0.015, 0.015),
    "heights_robot_only": Row("the same, robot-to-beacon ranges only", 0.015, 0.02),
    "scale": Row(
        "ranges 7 % too long, not configured",
        0.015,
        0.02,
        checks=(Check("scale off by [%]", 0.3, lambda trial, made: checks.scale_error(trial, made.uwb.scale)),),
    ),
    "office": Row(
        "office 60 x 40 m, 300 m driven, 8 beacons of 25 m reach",
        0.05,
        0.08,
        checks=(Check("memory growth in the second lap [MB]", 50.0, lambda trial, _: checks.memory_growth(trial)),),
    ),
    "large": Row("building of 150 x 100 m, 2 km driven, 32 beacons of 40 m reach, robot-only ranges", 0.10, 0.10),
}
"""Scenario -> its row. A scenario that stands for nothing of its own, like the demo's workshop, has none."""
