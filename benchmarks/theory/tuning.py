"""Tuning: whether noises, biases and the mounting come out right, serve another hall, and what the gradient costs."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import uwbslam_jax as us
from benchmarks.accuracy.trials import measure as run
from benchmarks.metric import Metric, Report
from benchmarks.theory.tuning_cost import cost
from benchmarks.theory.tuning_links import links
from uwbslam_jax.sim import Lidar, Scenario, Uwb, Wheels
from uwbslam_jax.tuning import Calibration

_FIRST_SEED = 300
"""Other worlds than those of the scenario suite."""
_SECONDS = 60.0
_SIGMAS, _OFF = (0.05, 0.1, 0.2), (0.5, 2.0)
_PAIRS = 5
_TRUE_N = 0.2
"""What the halls' radios err by that are tuned for: twice the default [m]."""
_LIDAR = ("lidar.x", "lidar.y", "lidar.yaw")
_MOUNTED = (0.2, -0.1, np.deg2rad(6.0))
"""Where the LiDAR really sits; it is configured at the origin [m, m, rad]."""


def measure(*, quick: bool) -> Report:
    """All parts; quick: the first case of each."""
    metrics: list[Metric] = []
    for part in (recovery, transfer, mounting, cost, links):
        for metric in part(quick):
            print(f"{metric.name}: {metric.value:.4g} {metric.unit}", file=sys.stderr, flush=True)
            metrics.append(metric)
    about = (
        "sigma_n: from a default 2x off in either direction, with sigma_w unknown, hall of 60 s at 10 Hz; the time is "
        "that of start-up, compilation, fit and curvature on 2 cores. Pairs: sigma_n and sigma_l "
        f"tuned on one hall whose ranges err by {_TRUE_N} m, judged on another one: log-likelihood along its rollout, "
        "and errors of whole runs. Mounting and biases: from nothing configured, one recording of 150 s with wheels. "
        "Cost: a rollout of 1500 steps with a map of 20 x 20 m at 0.05 m, 1081 beams, forward and with its gradient. "
        "p2p: real DW1000 ranges between nodes at rest, fitted to the first three quarters of each link's exchanges "
        "and judged on the last."
    )
    return Report("Tuning by gradient", about, metrics)


def recovery(quick: bool) -> Iterator[Metric]:
    """The sigma_n found over the true one."""
    seconds = []
    for k, sigma in enumerate(_SIGMAS[: 1 if quick else None]):
        messages = list(us.Simulation(_hall(_FIRST_SEED + k, sigma)))
        for off in _OFF[: 1 if quick else None]:
            begin = time.perf_counter()
            tuned = us.tune(messages, ("sigma_n", "sigma_w"), us.Settings(uwb=us.UwbSettings(sigma_n=off * sigma)))
            seconds.append(time.perf_counter() - begin)
            jax.clear_caches()  # compiled programs hold more memory maps than one process may have
            error = 100 * abs(tuned.values["sigma_n"] / sigma - 1)
            yield Metric(f"sigma_n {sigma:g} m from {off:g} times it, error", error, "%", "lower", bar=3.0)
    yield Metric("the longest of these fits", max(seconds), "s", "lower", bar=180.0)


def _hall(seed: int, sigma: float) -> Scenario:
    return replace(us.simulate("hall", seed, _SECONDS).scenario, uwb=Uwb(sigma=sigma))


def transfer(quick: bool) -> Iterator[Metric]:
    """What was tuned on one hall, in another."""
    rows = [_pair(k) for k in range(1 if quick else _PAIRS)]
    count = float(len(rows))
    for k, (gain, robot, beacons) in enumerate(rows):
        yield Metric(f"pair {k + 1}: log-likelihood gained a measurement", gain, "", "higher")
        yield Metric(f"pair {k + 1}: robot RMS, tuned / default", robot, "x", "lower", bar=1.1)
        yield Metric(f"pair {k + 1}: beacons mean, tuned / default", beacons, "x", "lower", bar=1.1)
    yield Metric("pairs more likely", float(sum(row[0] > 0 for row in rows)), "", "higher", bar=count)
    better = float(sum(min(row[1:]) < 1 for row in rows))
    yield Metric("pairs with robot or beacons better", better, "", "higher", bar=max(count - 1, 1.0))


def _pair(k: int) -> tuple[float, float, float]:
    """Gain in log-likelihood a frame, robot and beacons over what the defaults give."""
    tuned = us.tune(us.Simulation(_hall(_FIRST_SEED + 40 + k, _TRUE_N)), settings=us.Settings())
    print(f"pair {k + 1}: {tuned.values}", file=sys.stderr)
    other = _hall(_FIRST_SEED + 50 + k, _TRUE_N)
    seen = us.rollout(us.Simulation(other), us.Settings())
    params = seen.params._replace(**{name: jnp.float32(value) for name, value in tuned.values.items()})
    gain = float(seen.loss(seen.params) - seen.loss(params))
    before, after = run(other).figures, run(other, tuned.settings).figures
    jax.clear_caches()
    robot, beacons = (float(after[key] / before[key]) for key in ("robot_rmse_m", "beacon_mean_m"))
    return gain, robot, beacons


def mounting(quick: bool) -> Iterator[Metric]:
    """Biases and the LiDAR's place, found from nothing."""

    def found(made: Scenario) -> Calibration:
        names = [*(f"bias.{n}" for n in made.uwb.bias), *_LIDAR]
        calibration = us.tune(us.Simulation(made), names, us.Settings()).calibration
        assert calibration is not None
        return calibration

    def biased(seed: int) -> Scenario:
        return replace(us.simulate("biased", _FIRST_SEED + 30 + seed).scenario, lidar=Lidar(pose=_MOUNTED))

    errors = []

    for seed in range(1 if quick else 5):
        made = replace(biased(seed), wheels=Wheels())
        off = found(made).values - np.array([*made.uwb.bias.values(), *_MOUNTED])
        errors.append([np.sqrt(np.mean(off[:-3] ** 2)), np.hypot(*off[-3:-1]), np.rad2deg(abs(off[-1]))])
    for place, value in (("median", np.median(errors, axis=0)), ("worst", np.max(errors, axis=0))):
        of = f"{place} of {len(errors)} recordings"
        yield Metric(f"biases, RMS error, {of}", float(value[0]), "m", "lower", bar=0.03)
        yield Metric(f"LiDAR's offset, error, {of}", float(value[1]), "m", "lower", bar=0.02)
        yield Metric(f"LiDAR's yaw, error, {of}", float(value[2]), "deg", "lower", bar=0.1)
    told = float(sum(how == "not observed" for how in found(biased(0)).told))
    yield Metric("without wheels: parameters told as not observed (the yaw)", told, "", "higher", bar=1.0)
