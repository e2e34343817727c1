"""Ranges in feet, or counted there and back, are told as what they are, and no beacon is placed by them."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
import start_of_run

from uwbslam_jax.startup import decide
from uwbslam_jax.startup.keyframe_buffer import Buffer
from uwbslam_jax.startup.track_scale import wrong_scale


def scaled(factor: float, poses: np.ndarray | None = None, **options: object) -> Buffer:
    """The start of a run with all ranges so many times as long."""
    kept = start_of_run.buffer(start_of_run.with_a_turn(8.0) if poses is None else poses, each=10, **options)  # type: ignore[arg-type]
    kept.sightings = {
        slot: deque(seen._replace(distance=factor * seen.distance) for seen in own)
        for slot, own in kept.sightings.items()
    }
    kept.pairs = {pair: deque(factor * d for d in own) for pair, own in kept.pairs.items()}
    return kept


@pytest.mark.parametrize(
    ("factor", "advice"),
    [
        (3.2808, "--uwb.unit ft"),
        (1 / 3.2808, "in feet? see their driver"),
        (39.37, "--uwb.unit in"),
        (0.3937, "taken for cm? --uwb.unit in"),
        (2.54, "taken for cm? see its driver"),
        (2.0, "--uwb.bias-scale 1"),
        (0.5, "--uwb.bias-scale -0.5"),
        (100.0, "--uwb.unit cm"),
        (0.01, "in cm? see their driver"),
        (6.0, "in which units are they?"),
    ],
)
def test_another_scale_is_told_with_its_likely_unit(factor: float, advice: str) -> None:
    outcome = decide.solve(scaled(factor), start_of_run.IDS)
    assert outcome.placement is None
    assert outcome.lack is not None
    assert advice in outcome.lack.advice
    assert "times as long as the way of the robot" in outcome.lack


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("length", [1.5, 3.0, 8.0])
def test_ranges_in_metres_are_of_no_other_scale(seed: int, length: float) -> None:
    for poses in (start_of_run.straight(length), start_of_run.with_a_turn(length)):
        assert wrong_scale(scaled(1.0, poses, seed=seed)) is None
        biased = scaled(1.0, poses, seed=seed, bias={0: 0.3, 1: -0.2, 2: 0.4, 3: 0.0})
        assert wrong_scale(biased) is None
