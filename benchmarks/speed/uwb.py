"""The filter on ranges alone beside GTSAM's iSAM2 and its batch solution, on the same ranges."""

from __future__ import annotations

import time
from functools import partial
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.metric import Metric, Report, ratio
from uwbslam_jax import Settings, UwbSettings, estimator
from uwbslam_jax.estimator import make_config, make_params, motion, ranging, state_vector
from uwbslam_jax.measurements import Ranges, empty_frame

_BEACONS = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 19.0], [0.0, 19.0], [6.0, 9.0]])
_PAIRS = np.array(list(combinations(range(6), 2)))
_SIGMA, _DT = 0.1, 0.1
_SIGMA_W = 0.5
"""Acceleration noise of both [m/s^1.5]."""
_GUESS_M = 0.5
"""Beacons and robot start so far off [m]."""
_WARM = 100


def measure(*, quick: bool) -> Report:
    """3000 epochs of 15 ranges around a hall of 12 x 19 m."""
    epochs = 400 if quick else 3000
    track, z, guess = _simulate(epochs)
    metrics = _ours(track, z, guess)
    about = (
        f"{epochs} epochs at 10 Hz, 15 ranges each (robot and five beacons, all pairs), sigma {_SIGMA} m, the same "
        f"start {_GUESS_M} m off; position errors after one rigid motion over beacons and robot. The filter's time is "
        "that of a compiled scan, an epoch; iSAM2's that of its update."
    )
    try:
        import gtsam  # pyright: ignore[reportMissingImports]
    except ImportError:
        return Report("Ranges alone", about + " GTSAM is not installed: left out.", metrics)
    theirs = _gtsam(gtsam, track, z, guess)
    ours_ms = next(m.value for m in metrics if m.unit == "ms")
    theirs_ms = next(m.value for m in theirs if m.unit == "ms")
    return Report("Ranges alone", about, [*metrics, *theirs, ratio("filter / iSAM2, an epoch", ours_ms / theirs_ms)])


def _simulate(epochs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True track (T, 2), ranges (T, 15) [m], and where robot and beacons are taken to be at first (6, 2)."""
    rng = np.random.default_rng(0)
    angle = 2 * np.pi * _DT * np.arange(epochs) / 50.0
    track = np.column_stack([6.0 + 4.0 * np.cos(angle), 9.5 + 7.0 * np.sin(angle)])
    nodes = np.concatenate([track[:, None], np.broadcast_to(_BEACONS, (epochs, *_BEACONS.shape))], axis=1)
    distance = np.linalg.norm(nodes[:, _PAIRS[:, 0]] - nodes[:, _PAIRS[:, 1]], axis=2)
    z = distance + _SIGMA * rng.normal(size=distance.shape)
    return track, z, nodes[0] + _GUESS_M * rng.normal(size=(6, 2))


def _errors(track: np.ndarray, beacons: np.ndarray, found: np.ndarray) -> tuple[float, float]:
    """RMS of the robot and mean of the beacons [m] after one rigid motion. found: (T, 2)."""
    a = np.concatenate([found[_WARM:], np.repeat(beacons, 200, axis=0)])
    b = np.concatenate([track[_WARM:], np.repeat(_BEACONS, 200, axis=0)])
    ca, cb = a.mean(0), b.mean(0)
    u, _, vt = np.linalg.svd((a - ca).T @ (b - cb))
    turn = (u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt).T
    moved, places = (found - ca) @ turn.T + cb, (beacons - ca) @ turn.T + cb
    robot = np.sqrt(np.mean(np.sum((moved - track)[_WARM:] ** 2, axis=1)))
    return float(robot), float(np.linalg.norm(places - _BEACONS, axis=1).mean())


def _ours(track: np.ndarray, z: np.ndarray, guess: np.ndarray) -> list[Metric]:
    settings = Settings(uwb=UwbSettings(max_beacons=5, sigma_n=_SIGMA))
    config, m = make_config(settings), len(_PAIRS)
    params = make_params(settings)._replace(sigma_w=jnp.float32(_SIGMA_W))
    frame = empty_frame(2, m)
    first = estimator.init(config)
    mean = first.belief.mean.at[:12].set(jnp.asarray(guess.ravel(), jnp.float32))
    spread = jnp.zeros(mean.shape[0]).at[:12].set(_GUESS_M**2).at[12:14].set(1.0).at[14:].set(1e-8)
    start = first._replace(belief=first.belief._replace(mean=mean, cov=jnp.diag(spread)), active=jnp.ones(6, bool))
    i, j = _PAIRS.T.astype(np.int32)
    dt, still, every = jnp.float32(_DT), jnp.zeros(m), jnp.ones(m, bool)

    def step(carry, z):
        belief, scatter = carry
        belief = motion.predict(belief, params, dt, frame.odometry, start.moving, jnp.zeros(2))
        ranges = Ranges(jnp.asarray(i), jnp.asarray(j), z, still, jnp.full(m, jnp.nan), every)
        belief, _, scatter = ranging.update(belief, ranges, every, params, scatter, robust=True)
        return (belief, scatter), belief.mean[:2]

    run = jax.jit(partial(lax.scan, step))
    measured = jnp.asarray(z, jnp.float32)
    jax.block_until_ready(run((start.belief, start.scatter), measured))
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        (belief, _), found = jax.block_until_ready(run((start.belief, start.scatter), measured))
        times.append(time.perf_counter() - begin)
    beacons = np.asarray(state_vector.unpack(belief.mean).positions, float)[1:]
    robot, placed = _errors(track, beacons, np.asarray(found, float))
    return [
        Metric("filter, an epoch", 1e3 * float(np.median(times)) / len(z), "ms", "lower"),
        Metric("filter, robot RMS", robot, "m", "lower"),
        Metric("filter, beacons mean", placed, "m", "lower"),
    ]


def _gtsam(gtsam: Any, track: np.ndarray, z: np.ndarray, guess: np.ndarray) -> list[Metric]:
    """iSAM2 and one batch Levenberg-Marquardt: constant velocity by points and velocities, ranges between points."""
    isam, every, values = gtsam.ISAM2(), gtsam.NonlinearFactorGraph(), gtsam.Values()
    of_range, loose = gtsam.noiseModel.Isotropic.Sigma(1, _SIGMA), gtsam.noiseModel.Isotropic.Sigma(2, _GUESS_M)
    walk = gtsam.noiseModel.Isotropic.Sigma(2, 0.1)  # what the robot drives in an epoch, at most about
    keys = [gtsam.symbol("b", n) for n in range(5)]
    times, online = [], np.zeros_like(track)
    last = guess[0]
    for t in range(len(z)):
        graph, new, key = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.symbol("x", t)
        new.insert(key, last)
        if t == 0:
            graph.add(gtsam.PriorFactorPoint2(key, guess[0], loose))
            for n, beacon in enumerate(keys):
                new.insert(beacon, guess[1 + n])
                graph.add(gtsam.PriorFactorPoint2(beacon, guess[1 + n], loose))
        else:
            graph.add(gtsam.BetweenFactorPoint2(gtsam.symbol("x", t - 1), key, np.zeros(2), walk))
        nodes = [key, *keys]
        for (i, j), measured in zip(_PAIRS, z[t], strict=True):
            graph.add(gtsam.RangeFactor2(nodes[i], nodes[j], float(measured), of_range))
        begin = time.perf_counter()
        isam.update(graph, new)
        last = isam.calculateEstimatePoint2(key)
        times.append(time.perf_counter() - begin)
        online[t] = last
        every.push_back(graph)
        values.insert(new)
    beacons = np.array([isam.calculateEstimatePoint2(key) for key in keys])
    robot, placed = _errors(track, beacons, online)
    begin = time.perf_counter()
    best = gtsam.LevenbergMarquardtOptimizer(every, values).optimize()
    batch = time.perf_counter() - begin
    found = np.array([best.atPoint2(gtsam.symbol("x", t)) for t in range(len(z))])
    smooth, fitted = _errors(track, np.array([best.atPoint2(key) for key in keys]), found)
    return [
        Metric("iSAM2, an epoch", 1e3 * float(np.median(times)), "ms", "lower"),
        Metric("iSAM2, robot RMS", robot, "m", "lower"),
        Metric("iSAM2, beacons mean", placed, "m", "lower"),
        Metric("batch, whole recording", batch, "s", "lower"),
        Metric("batch, robot RMS", smooth, "m", "lower"),
        Metric("batch, beacons mean", fitted, "m", "lower"),
    ]
