"""The scenario suite in a smaller form: two seeds, shortened recordings, every third beam, the suite's own bars.

Seed 0 laps counter-clockwise and seed 1 clockwise. The whole suite is `python -m benchmarks.accuracy.scenarios`.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.accuracy.suite import ROWS
from benchmarks.accuracy.trials import measure
from uwbslam_jax.sim import make_scenario

BEAMS = 361
"""One size for all scenarios: the step is compiled once."""

SHORT = {
    "hall": (40.0, ROWS["hall"]),
    "straight": (30.0, ROWS["straight"]),
    "nlos_silent": (40.0, ROWS["nlos_silent"]),
    "biased": (60.0, ROWS["biased"]),  # a lap
    "corridor_recess": (60.0, ROWS["corridor_recess"]),  # there and back
    "early": (62.0, ROWS["early"]),  # a stretch and ten seconds after it
    "frame_moved": (50.0, ROWS["frame_moved"]),
    "blind": (40.0, ROWS["blind"]),
    "kidnapped": (40.0, ROWS["kidnapped"]),
}
"""Scenario -> how long [s], and what is asked."""


SOON = {("hall", 0), ("biased", 0), ("kidnapped", 0)}
"""These also run with the fast tests."""


def _each() -> list[Any]:
    pairs = [(name, seed) for name in SHORT for seed in (0, 1)]
    return [pytest.param(*pair, marks=[] if pair in SOON else [pytest.mark.slow]) for pair in pairs]


@pytest.mark.parametrize(("name", "seed"), _each())
def test_a_short_form_of_the_scenario_holds_its_bar(name: str, seed: int) -> None:
    duration, row = SHORT[name]
    made = make_scenario(name, seed, duration)
    made = replace(made, lidar=replace(made.lidar, beams=BEAMS))
    outcome = measure(made)
    found = outcome.found(row.checks, made)
    assert row.shortfalls(outcome.figures, found) == []
