"""When what happens in a scenario, in seconds since its start: derived from the scenario itself."""

from __future__ import annotations

import numpy as np

from benchmarks.accuracy.checks import Stay
from uwbslam_jax.sim import Interval, Scenario, paths

_TURNED = np.deg2rad(1.0)
_BACK_S = 2.0
"""A robot that was blinded or carried has this long to find back [s]."""


def carried(scenario: Scenario) -> list[Interval]:
    """When the robot itself is carried."""
    return scenario.path.spans(paths.Carried)


def disturbed(scenario: Scenario) -> list[Interval]:
    """When the robot is carried or blind, and the time that it has to find back; no rigid fit may use it."""
    off = [(scenario.pause.begin, resumed(scenario))] if scenario.pause is not None else []
    return [(begin, end + _BACK_S) for begin, end in (*carried(scenario), *scenario.lidar.blind, *off)]


def resumed(scenario: Scenario) -> float:
    """When the recorder is on again after a pause, NaN where there is none."""
    return float("nan") if scenario.pause is None else scenario.pause.begin + scenario.pause.lasts


def first_turn(scenario: Scenario) -> float:
    """When the robot first turns, infinite where it never does."""
    t = np.arange(0.0, scenario.duration, 0.01)
    yaw = scenario.path.pose(t)[:, 2]
    turned = np.flatnonzero(np.abs(yaw - yaw[0]) > _TURNED)
    return float(t[turned[0]]) if len(turned) else float("inf")


def stops(scenario: Scenario) -> list[float]:
    """The start, and the middle of each turn on the spot until the end."""
    middles = [0.5 * (begin + end) for begin, end in scenario.path.spans(paths.Turn)]
    return [0.0, *(t for t in middles if t < scenario.duration)]


def carries(scenario: Scenario) -> list[Stay]:
    """Which beacon is carried when, while it is switched on."""
    return [
        Stay(beacon.id, max(move.start, begin), min(move.end, end))
        for beacon in scenario.beacons
        for move in beacon.moves
        for begin, end in beacon.alive
        if max(move.start, begin) < min(move.end, end, scenario.duration)
    ]


def rests(scenario: Scenario) -> list[Stay]:
    """Which beacon stands still when, while it is switched on."""
    found = []
    for beacon in scenario.beacons:
        marks = [0.0, *(t for move in beacon.moves for t in (move.start, move.end)), scenario.duration]
        for still_from, still_until in zip(marks[::2], marks[1::2], strict=True):
            for begin, end in beacon.alive:
                stay = Stay(beacon.id, max(still_from, begin), min(still_until, end, scenario.duration))
                found += [stay] if stay.begin < stay.end else []
    return found
