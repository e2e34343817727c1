"""Simulation: a scenario becomes the messages that a robot driving through it would record, with ground truth.

Pure numpy and no code shared with the estimator, so that neither can hide the other's mistakes. The worlds are in
`worlds`, the driving in `paths`, the conditions in `scenario`, the ready-made ones in `catalogue`.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from uwbslam_jax.measurements import NAN, Message, OdometryMessage, RangeMessage, ScanMessage, TruthMessage
from uwbslam_jax.sim.paths import smooth
from uwbslam_jax.sim.rays import blocked, strike
from uwbslam_jax.sim.scenario import Beacon, Follow, Interval, Lidar, Scenario, Uwb, stream

START_NS = 1_700_000_000_123_456_789
"""Stamp of a simulation's time 0 [ns]; float32 and even float64 seconds cannot hold it exactly, as in life."""
UWB_PHASE = 0.0137
"""The first round of ranges starts this late [s]: two devices never share a clock."""
ROUNDS = 16
"""Rounds of ranges that are drawn at a time [rounds]: arrays are fast, and memory stays small."""
_RANDOM = ("noise", "nlos", "outlier", "early", "power", "gap", "loss", "jitter")
"""Each fault of a range draws from a stream of its own [name], so that none moves another's numbers."""
TRUTH_PERIOD = 1.0
"""Time between two truths of a beacon at rest [s]; of one that is carried, a tenth of it."""

Logged = tuple[int, Message]


def simulate(scenario: Scenario) -> Iterator[Message]:
    """The messages of a scenario in the order in which a recorder gets them; one at a time, never all in memory.

    A scan arrives with its last beam and is stamped with its first. The same scenario gives the same messages.
    """
    streams = (_beacon_truths(scenario), _odometry(scenario), _ranges(scenario), _scans(scenario))
    for _, message in heapq.merge(*streams, key=lambda logged: logged[0]):
        if scenario.pause is None or message.stamp < stamp(scenario.pause.begin):
            yield message
        elif message.stamp >= stamp(scenario.pause.end):
            longer = scenario.pause.lasts - (scenario.pause.end - scenario.pause.begin)
            yield replace(message, stamp=message.stamp + round(longer * 1e9))


def stamp(t: float) -> int:
    """Stamp [ns] of a time since the start [s]."""
    return START_NS + round(t * 1e9)


def _during(intervals: Sequence[Interval], t: np.ndarray) -> np.ndarray:
    """Whether times t (n,) [s] fall into one of the intervals, (n,) bool."""
    result = np.zeros(np.shape(t), bool)
    for begin, end in intervals:
        result |= (t >= begin) & (t < end)
    return result


# LiDAR ---------------------------------------------------------------------------------------------------------------


def scan_ranges(scenario: Scenario, t: float) -> np.ndarray:
    """Exact distances (beams,) [m] of the sweep that begins at time t [s], without noise or limits; inf for none."""
    return _sweep(scenario, t)[0]


def _sweep(scenario: Scenario, t: float) -> tuple[np.ndarray, np.ndarray]:
    """The same, and the angles between beams and walls (beams,) [rad]."""
    lidar = scenario.lidar
    beams = np.arange(lidar.beams)
    bearings = _angle_min(lidar) + beams * _angle_increment(lidar)
    times = t + beams * lidar.time_increment if lidar.time_increment > 0.0 else np.array([t])
    pose = scenario.path.pose(times)
    x, y, yaw = lidar.pose
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    origins = pose[:, :2] + np.stack([c * x - s * y, s * x + c * y], -1)
    return strike(scenario.world.segments, origins, pose[:, 2] + yaw + bearings)


def _angle_min(lidar: Lidar) -> float:
    return -0.5 * lidar.field_of_view


def _angle_increment(lidar: Lidar) -> float:
    return lidar.field_of_view / (lidar.beams - 1)


def _scans(scenario: Scenario) -> Iterator[Logged]:
    """Scans, each after the truth of the robot's pose at its stamp."""
    lidar = scenario.lidar
    noise, lost, late = (stream(scenario.seed, f"scan {purpose}") for purpose in ("noise", "returns", "jitter"))
    sweep = round((lidar.beams - 1) * lidar.time_increment * 1e9)
    for k in range(int(scenario.duration * lidar.rate)):
        t = k / lidar.rate + lidar.jitter * late.uniform()
        exact, glance = _sweep(scenario, t)
        ranges = _rounded(exact + lidar.sigma * noise.normal(size=lidar.beams), lidar.quantum)
        draw = lost.uniform(size=(2, lidar.beams))
        returned = (draw[0] >= lidar.dropout) & (draw[1] * lidar.grazing <= glance)
        seen = (ranges >= lidar.range_min) & (ranges <= min(lidar.range_max, lidar.reach))
        seen &= returned & ~_during(lidar.blind, np.array([t]))
        ranges = np.where(seen, ranges, np.inf).astype(np.float32)
        x, y, yaw = scenario.path.pose(np.array([t]))[0]
        at = stamp(t)
        yield at + sweep, TruthMessage(at, None, float(x), float(y), float(np.arctan2(np.sin(yaw), np.cos(yaw))))
        angles = (_angle_min(lidar), _angle_increment(lidar))
        limits = (lidar.range_min, lidar.range_max)
        yield at + sweep, ScanMessage(at, *angles, lidar.time_increment, *limits, ranges)


def _rounded(values: np.ndarray, quantum: float) -> np.ndarray:
    """Values (n,) as whole multiples of the quantum, unchanged where that is 0."""
    return quantum * np.round(values / quantum) if quantum > 0.0 else values


# UWB -----------------------------------------------------------------------------------------------------------------


def beacon_positions(scenario: Scenario, beacon: Beacon, t: np.ndarray) -> np.ndarray:
    """Where a beacon is at times t (n,) [s], (n, 2) [m]."""
    position = np.tile(np.asarray(beacon.position, float), (t.size, 1))
    for number, move in enumerate(beacon.moves):
        if not np.any(t >= move.start):
            continue
        clipped = np.clip(t, move.start, move.end)
        if isinstance(move, Follow):
            robot = scenario.path.pose(clipped - move.lag)
            left = np.stack([-np.sin(robot[:, 2]), np.cos(robot[:, 2])], -1)
            goal = robot[:, :2] + move.aside * left
            blend = smooth((clipped - move.start) / move.approach) if move.approach > 0.0 else np.ones(t.size)
        else:
            goal = np.tile(np.asarray(move.to, float), (t.size, 1))
            blend = smooth((clipped - move.start) / (move.end - move.start))
        there = position + blend[:, None] * (goal - position)
        # Hands are still when the beacon is taken and put down.
        still = smooth(np.minimum(clipped - move.start, move.end - clipped))
        there += still[:, None] * _jitter(scenario.seed, beacon.id, number, clipped)
        position = np.where((t >= move.start)[:, None], there, position)
    return position


def _jitter(seed: int, node: int, number: int, t: np.ndarray) -> np.ndarray:
    """A carrying hand's sway at times t (n,) [s]: a few centimetres at 0.4-2 Hz, (n, 2) [m]."""
    rng = stream(seed, f"hand {node} {number}")
    frequency, phase = rng.uniform(0.4, 2.0, (3, 2)), rng.uniform(0.0, 2.0 * np.pi, (3, 2))
    return 0.03 * np.sum(np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase), axis=1)


def _node_positions(scenario: Scenario, t: np.ndarray) -> np.ndarray:
    """Antennas of the robot and of each beacon at times t (n,) [s], (nodes, n, 3) [m]."""
    pose = scenario.path.pose(t)
    x, y, z = scenario.uwb.antenna
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    robot = np.column_stack([pose[:, 0] + c * x - s * y, pose[:, 1] + s * x + c * y, np.full(t.size, z)])
    beacons = [np.column_stack([beacon_positions(scenario, b, t), np.full(t.size, b.height)]) for b in scenario.beacons]
    return np.stack([robot, *beacons])


def _ranges(scenario: Scenario) -> Iterator[Logged]:
    """Rounds of exchanges; each pair has its own place in the round, also while it is silent."""
    uwb = scenario.uwb
    ids = np.array([uwb.robot_id, *(b.id for b in scenario.beacons)])
    i, j = np.array(list(combinations(range(ids.size), 2))).T  # the robot's pairs come first
    used = (i == 0) | uwb.beacon_pairs
    period = max(1.0 / uwb.rate, uwb.exchange * np.count_nonzero(used))
    rounds = int((scenario.duration - UWB_PHASE) / period)
    draws = {d: stream(scenario.seed, f"uwb {d}") for d in _RANDOM}
    for first in range(0, rounds, ROUNDS):
        # All rounds of a block have the same pairs and each purpose its own numbers for every one of them, heard or
        # not: no knob moves another's numbers.
        count = min(ROUNDS, rounds - first)
        t = UWB_PHASE + period * (first + np.arange(count))[:, None] + uwb.exchange * np.arange(i.size)
        t = t.ravel() + uwb.jitter * draws["jitter"].uniform(size=t.size)
        left, right = np.tile(i, count), np.tile(j, count)
        nodes = _node_positions(scenario, t)
        a, b = nodes[left, np.arange(t.size)], nodes[right, np.arange(t.size)]
        distance = np.sqrt(np.sum((a - b) ** 2, -1))
        wall = blocked(scenario.world.segments, a[:, :2], b[:, :2]) if uwb.nlos else np.zeros(t.size, bool)
        exact = (1.0 + uwb.scale) * distance
        measured = _rounded(exact + _range_errors(uwb, draws, ids[left], ids[right], t, wall), uwb.quantum)
        receive, first_path = _powers(uwb, draws, distance, wall)
        on = np.array([np.ones(t.size, bool), *(_during(b.alive, t) for b in scenario.beacons)])
        on = on[left, np.arange(t.size)] & on[right, np.arange(t.size)]
        heard = np.tile(used, count) & on & (distance <= uwb.reach) & ~_during(uwb.silent, t)
        heard &= draws["loss"].uniform(size=t.size) >= uwb.loss
        for p in np.flatnonzero(heard & (t < scenario.duration)).tolist():
            at, pair = stamp(t[p]), (int(ids[left[p]]), int(ids[right[p]]))
            yield at, RangeMessage(at, *pair, max(float(measured[p]), 0.0), float(receive[p]), float(first_path[p]))


def _range_errors(
    uwb: Uwb,
    draws: dict[str, np.random.Generator],
    source: np.ndarray,
    target: np.ndarray,
    t: np.ndarray,
    wall: np.ndarray,
) -> np.ndarray:
    """Noise, bias and faults (n,) [m] of exchanges between two ids (n,) at times t (n,) [s], behind a wall or not."""
    nlos, outlier, early = (draws[d].uniform(size=(t.size, 2)).T for d in ("nlos", "outlier", "early"))
    error = uwb.sigma * draws["noise"].normal(size=t.size)
    for node, bias in uwb.bias.items():
        error += bias * ((source == node) | (target == node))
    error += np.where(wall, -uwb.nlos_bias * np.log1p(-nlos[0]), 0.0)
    error += np.where(outlier[0] < uwb.outliers, 1.0 + 9.0 * outlier[1], 0.0)
    locked = ((source == uwb.early_node) | (target == uwb.early_node)) & _during(uwb.early, t)
    return error - np.where(locked & (early[0] < uwb.early_share), 1.0 + 7.0 * early[1], 0.0)


def _powers(
    uwb: Uwb, draws: dict[str, np.random.Generator], distance: np.ndarray, wall: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Receive and first-path power (n,) [dBm] of exchanges over a distance (n,) [m] through a wall or not (n,).

    The gap is 4 +- 2.5 dB in sight, over 10 dB in 1 % of the cases; behind a wall over 10 dB as often as
    `nlos_detectable` says and as in sight otherwise.
    """
    draw = draws["power"].normal(size=(distance.size, 2)).T
    u = draws["gap"].uniform(size=(distance.size, 2)).T
    if not uwb.report_powers:
        nan = np.full(distance.size, NAN)
        return nan, nan
    receive = np.clip(-62.0 - 20.0 * np.log10(np.maximum(distance, 0.3)) + 1.5 * draw[0] - 6.0 * wall, -105.0, -50.0)
    in_sight = np.maximum(4.0 + 2.5 * draw[1], 0.2)
    hidden = np.where(u[0] < uwb.nlos_detectable, 10.5 - 4.0 * np.log1p(-u[1]), np.minimum(in_sight + 2.0, 9.8))
    return receive, receive - np.where(wall, hidden, in_sight)


# Odometry and truth --------------------------------------------------------------------------------------------------


def _odometry(scenario: Scenario) -> Iterator[Logged]:
    """Increments of the true pose with scale error and noise, added up from a start at zero."""
    wheels = scenario.wheels
    if wheels is None:
        return
    noise = stream(scenario.seed, "odometry")
    times = np.arange(int(scenario.duration * wheels.rate)) / wheels.rate
    pose = scenario.path.pose(times)
    x, y, yaw = 0.0, 0.0, 0.0
    for k, t in enumerate(times):
        step = pose[k] - pose[max(k - 1, 0)]
        c, s = np.cos(pose[max(k - 1, 0), 2]), np.sin(pose[max(k - 1, 0), 2])
        ahead, left = c * step[0] + s * step[1], c * step[1] - s * step[0]
        error = noise.normal(size=3) * np.hypot(ahead, left) * wheels.noise
        ahead, left = (1.0 + wheels.scale) * ahead + error[0], (1.0 + wheels.scale) * left + error[1]
        turn = (1.0 + wheels.scale) * step[2] + noise.normal() * wheels.noise_yaw * abs(step[2])
        x, y = x + np.cos(yaw) * ahead - np.sin(yaw) * left, y + np.sin(yaw) * ahead + np.cos(yaw) * left
        yaw += turn
        wrapped = float(np.arctan2(np.sin(yaw), np.cos(yaw)))
        yield stamp(t), OdometryMessage(stamp(t), float(x), float(y), wrapped)


def _beacon_truths(scenario: Scenario) -> Iterator[Logged]:
    """Where each beacon is while it is switched on: at first, then each period, more often while it is carried."""
    fine = TRUTH_PERIOD / 10.0
    for k in range(int(scenario.duration / fine) + 1):
        t = np.array([k * fine])
        for beacon in scenario.beacons:
            carried = any(m.start <= t[0] <= m.end + fine for m in beacon.moves)
            due = k % 10 == 0 or carried or any(t[0] - fine < begin <= t[0] for begin, _ in beacon.alive)
            if due and t[0] < scenario.duration and _during(beacon.alive, t)[0]:
                x, y = beacon_positions(scenario, beacon, t)[0]
                yield stamp(t[0]), TruthMessage(stamp(t[0]), beacon.id, float(x), float(y))
