"""Whole runs of simulated halls beside the bound with a map that is known."""

from __future__ import annotations

import sys

import numpy as np

import uwbslam_jax as us
from benchmarks.metric import Metric
from benchmarks.theory.bound_recursion import recursion
from uwbslam_jax.estimator import match_fusion
from uwbslam_jax.evaluation import align
from uwbslam_jax.numerics import wrapped
from uwbslam_jax.sim import Scenario, strike

_FIRST_SEED, _SECONDS = 500, 60.0
_DT = 0.1
_EVERY = 5
"""Scans between two whose information is worked out; those in between see about the same."""
_H = 1e-4
_EDGE_M = 0.05
"""A beam whose length changes more than this over _H has met an edge: it tells nothing there."""


def fused(runs: int, bar: float) -> list[Metric]:
    """RMSE over bound of beacons and robot, and what the robot's is made of."""
    rows = []
    for seed in range(_FIRST_SEED, _FIRST_SEED + runs):
        rows.append(_one(us.simulate("hall", seed, _SECONDS)))
        print(f"fused {seed}: {np.round(rows[-1], 5).tolist()}", file=sys.stderr, flush=True)
    beacons, robot, heading, online, online_heading, least_beacons, least_robot, least_heading = np.array(rows).T
    deg, floor = 180 / np.pi, match_fusion._MATCH_FLOOR

    def rms(squares: np.ndarray) -> float:
        return float(np.sqrt(np.mean(squares)))

    def median_ratio(squares: np.ndarray, least: np.ndarray) -> float:
        return float(np.median(np.sqrt(squares / least)))

    return [
        Metric("fused, beacons: RMSE", rms(beacons), "m", "lower"),
        Metric("fused, beacons: bound", rms(least_beacons), "m"),
        Metric(
            "fused, beacons: RMSE / bound, median of the runs", median_ratio(beacons, least_beacons), "x", "lower", bar
        ),
        Metric("fused, beacons: the same over all runs", rms(beacons) / rms(least_beacons), "x"),
        Metric("fused, robot's position: RMSE of the whole run's track", rms(robot), "m", "lower"),
        Metric("fused, robot's position: RMSE of what was published on the way", rms(online), "m", "lower"),
        Metric("fused, robot's position: bound with a known map", rms(least_robot), "m"),
        Metric(
            "fused, robot's position: RMSE / bound, median of the runs", median_ratio(robot, least_robot), "x", "lower"
        ),
        Metric("fused, robot's position: the same as published", median_ratio(online, least_robot), "x", "lower"),
        Metric(
            "fused, robot's position: made of, trust floor of a match / bound",
            np.sqrt(2) * floor[0] / rms(least_robot),
            "x",
        ),
        Metric(
            "fused, robot's position: made of, a cell's own spread / bound",
            us.MapSettings().resolution / np.sqrt(6) / rms(least_robot),
            "x",
        ),
        Metric(
            "fused, robot's position: made of, map error while it is drawn (published, whole run's taken off) / bound",
            np.sqrt(max(rms(online) ** 2 - rms(robot) ** 2, 0.0)) / rms(least_robot),
            "x",
        ),
        Metric("fused, heading: RMSE of the whole run's track", deg * rms(heading), "deg", "lower"),
        Metric("fused, heading: RMSE of what was published on the way", deg * rms(online_heading), "deg", "lower"),
        Metric("fused, heading: bound with a known map", deg * rms(least_heading), "deg"),
        Metric("fused, heading: RMSE / bound, median of the runs", median_ratio(heading, least_heading), "x", "lower"),
    ]


def _one(simulation: us.Simulation) -> list[float]:
    """Mean squares of a run: beacons, robot and heading of the whole run, both as published, and the three bounds."""
    result = us.run(simulation)
    truth = result.truth
    assert truth is not None
    into = align(result.stamps, result.poses, {}, truth)
    last = truth.beacon_positions()
    off = [np.sum((into.points(b.position[None])[0] - last[b.id]) ** 2) for b in result.beacons]
    found = [float(np.mean(off))]
    true = truth.poses_at(result.stamps)
    known = np.isfinite(result.online).all(axis=1) & (result.stamps >= result.stamps[0] + _decided(result))
    published = align(result.stamps[known], result.online[known], {}, truth)
    for motion, track, target in ((into, result.poses, true), (published, result.online[known], true[known])):
        apart = motion.poses(track) - target
        found += [float(np.mean(np.sum(apart[:, :2] ** 2, axis=1))), float(np.mean(wrapped(apart[:, 2]) ** 2))]
    return [*found, *_bound(simulation.scenario)]


def _decided(result: us.Result) -> int:
    return round(1e9 * (result.summary["decided_at"] or 0.0))


def _bound(made: Scenario) -> list[float]:
    """Mean squares that are possible: beacons at the end, robot and heading over the run.

    State: robot x, y, heading, velocity, yaw rate, then the beacons.
    """
    t = _DT * np.arange(int(made.duration / _DT))
    pose = made.path.pose(t)
    spots = np.array([b.position for b in made.beacons])
    k = len(spots)
    n = 6 + 2 * k
    F = np.eye(n)
    F[[0, 1, 2], [3, 4, 5]] = _DT
    Q = np.zeros((n, n))
    for place, speed, w in ((0, 3, 1.0), (1, 4, 1.0), (2, 5, 2.0)):  # the defaults of sigma_w and sigma_w_yaw
        Q[place, place], Q[place, speed], Q[speed, place], Q[speed, speed] = w**2 * np.array(
            [_DT**3 / 3, _DT**2 / 2, _DT**2 / 2, _DT]
        )
    Q[6:, 6:] = 1e-8 * _DT * np.eye(2 * k)
    information = np.zeros((len(t), n, n))
    weight = (1.0 - made.uwb.loss) / made.uwb.sigma**2
    for i, now in enumerate(pose):
        if i % _EVERY == 0:
            scan = scan_information(made, now)
        information[i, :3, :3] = scan
        H = _range_slopes(now, spots, n)
        information[i] += weight * H.T @ H
    P0 = np.diag([1e-8, 1e-8, 1e-8, 1.0, 1.0, 1.0, *np.full(2 * k, 100.0)])
    P = recursion(P0, np.broadcast_to(F, (len(t), n, n)).copy(), Q, information).every
    variance = np.einsum("tii->ti", P)
    return [
        float(variance[-1, 6:].sum() / k),
        float(variance[:, :2].sum(1).mean()),
        float(variance[:, 2].mean()),
    ]


def _range_slopes(pose: np.ndarray, spots: np.ndarray, n: int) -> np.ndarray:
    """H of the robot's ranges and of those between beacons; the antenna is at the robot's origin."""
    k = len(spots)
    rows = []
    for b in range(k):
        u = (pose[:2] - spots[b]) / np.linalg.norm(pose[:2] - spots[b])
        row = np.zeros(n)
        row[:2], row[6 + 2 * b : 8 + 2 * b] = u, -u
        rows.append(row)
        for other in range(b):
            u = (spots[b] - spots[other]) / np.linalg.norm(spots[b] - spots[other])
            row = np.zeros(n)
            row[6 + 2 * b : 8 + 2 * b], row[6 + 2 * other : 8 + 2 * other] = u, -u
            rows.append(row)
    return np.array(rows)


def scan_information(made: Scenario, pose: np.ndarray) -> np.ndarray:
    """Fisher information (3, 3) about x, y, heading of one scan in a known map: sum of the beams' squared slopes over
    sigma^2 (Censi 2007, eq. 5), each beam's slope by a central difference of its length."""
    lidar = made.lidar
    bearings = np.linspace(-0.5, 0.5, lidar.beams) * lidar.field_of_view

    def lengths(p: np.ndarray) -> np.ndarray:
        return strike(made.world.segments, p[None, :2], p[2] + bearings)[0]

    slopes = np.stack([lengths(pose + h) - lengths(pose - h) for h in _H * np.eye(3)], axis=-1)
    ok = np.all(np.isfinite(slopes) & (np.abs(slopes) < _EDGE_M), axis=1)
    slopes = slopes[ok] / (2 * _H)
    return (1.0 - lidar.dropout) * slopes.T @ slopes / lidar.sigma**2
