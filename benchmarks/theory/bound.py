"""Errors beside the least that is possible: posterior Cramer-Rao for ranges, Fisher information of scans for the LiDAR.

Ranges alone: truths are drawn from the filter's own process model, the bound is the recursion of Tichavsky, Muravchik
and Nehorai (1998) at the true states. Fused: whole runs of simulated halls beside the same recursion, to which every
scan adds what it could tell in a map that is known (Censi, "On achievable accuracy for range-finder localization",
2007). No map is known at first, so for the robot this is a bound that nobody can reach.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.metric import Metric, Report
from benchmarks.theory.bound_fused import fused
from benchmarks.theory.bound_recursion import Covariances, recursion
from uwbslam_jax import Settings, UwbSettings
from uwbslam_jax.estimator import make_config, make_params, match_fusion, motion, ranging, state_vector
from uwbslam_jax.measurements import Ranges, empty_frame
from uwbslam_jax.numerics import Gaussian, symmetric_root

RUNS = 50
_STEPS, _DT = 600, 0.1
_WARM = 50
"""Steps that do not count: there the prior is the larger part."""
_BEACONS = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 19.0], [0.0, 19.0], [6.0, 9.0]])
_PAIRS = np.array([(i, j) for i in range(6) for j in range(i + 1, 6)], np.int32)
_SIGMA_W, _SIGMA_W_YAW = 0.2, 0.2
"""A robot that stays among its beacons for a minute or so [m/s^1.5, rad/s^1.5]."""
_PRIOR = {"place": 0.05, "beacon": 0.1, "speed": 0.3, "heading": 0.05, "rate": 0.2}
"""Standard deviations at the start, about those of a start-up [m, m, m/s, rad, rad/s]."""
_FRAME_M = 1e-4
"""Of the three coordinates that make the frame: the first beacon at the origin, the second on +x [m]."""
_BAR, _BAR_FUSED = 1.15, 2.0
PICTURE = Path(__file__).parents[2] / "docs" / "images" / "bound.png"


@dataclass(frozen=True)
class Errors:
    """Errors and bounds of runs (R, T): squared position of the robot, heading, mean over beacons [m^2, rad^2, m^2]."""

    robot: np.ndarray
    beacons: np.ndarray


def measure(*, quick: bool) -> Report:
    """50 runs of ranges alone, 50 fused ones."""
    runs = 5 if quick else RUNS
    found, bound = ranges_alone(runs)
    metrics = []
    for key, name in (("robot", "robot's position"), ("beacons", "beacons")):
        error, least = (getattr(part, key)[:, _WARM:] for part in (found, bound))
        by_run = np.sqrt(error.mean(1) / least.mean(1))
        over_time = np.sqrt(error.mean(0) / least.mean(0))
        metrics += [
            Metric(f"ranges alone, {name}: RMSE", float(np.sqrt(error.mean())), "m", "lower"),
            Metric(f"ranges alone, {name}: bound", float(np.sqrt(least.mean())), "m"),
            Metric(
                f"ranges alone, {name}: RMSE / bound, median of the runs", float(np.median(by_run)), "x", "lower", _BAR
            ),
            Metric(
                f"ranges alone, {name}: the same over the runs, median of the time", float(np.median(over_time)), "x"
            ),
            Metric(f"ranges alone, {name}: and at its worst", float(over_time.max()), "x"),
        ]
    for metric in metrics:
        print(f"{metric.name}: {metric.value:.4g} {metric.unit}", file=sys.stderr, flush=True)
    metrics += fused(runs, _BAR_FUSED)
    if not quick:
        _draw(found, bound)
    about = (
        f"{runs} runs each. Ranges alone: 60 s at 10 Hz, robot and five beacons, all pairs, 0.1 m, truths drawn from "
        "the process model, in the frame of two beacons; ranges alone do not tell the heading. Fused: preset robust on "
        "halls of 60 s, every seed its own, after the robot's track was laid over the true one; beacons as the whole "
        "run tells them. The bound of a fused run takes the map as known: what the robot's ratio is made of stands "
        "below it."
    )
    return Report("How close to the bound", about, metrics)


def settings() -> Settings:
    """Of the runs with ranges alone."""
    return Settings(uwb=UwbSettings(max_beacons=len(_BEACONS), sigma_n=0.1))


def ranges_alone(runs: int) -> tuple[Errors, Errors]:
    """Squared errors of the filter and their bounds."""
    config = make_config(settings())
    params = make_params(settings())._replace(sigma_w=jnp.float32(_SIGMA_W), sigma_w_yaw=jnp.float32(_SIGMA_W_YAW))
    start = _start(config.nodes)
    keys = jax.random.split(jax.random.key(0), runs)
    truth, filtered = jax.jit(jax.vmap(partial(_run, params, start)))(keys)
    F = jax.jit(jax.vmap(jax.vmap(partial(_slope, params))))(truth)
    z = _ranges(jnp.zeros(len(_PAIRS)))
    H = jax.jit(jax.vmap(jax.vmap(lambda x: ranging.linearised_ranges(x, z, params)[1])))(truth)
    Q = np.asarray(_noise(params, start.mean), float)
    P = np.stack([_covariances(start, F[r], Q, H[r], float(params.sigma_n)).every for r in range(runs)])
    k = config.nodes
    e = np.asarray(filtered, float) - np.asarray(truth, float)
    square, variance = e**2, np.einsum("rtii->rti", P)

    def parts(s: np.ndarray) -> Errors:
        return Errors(s[..., :2].sum(-1), s[..., 2 : 2 * k].sum(-1) / (k - 1))

    return parts(square), parts(variance)


def _covariances(start: Gaussian, F: Any, Q: np.ndarray, H: Any, sigma: float) -> Covariances:
    H = np.asarray(H, float)
    return recursion(np.asarray(start.cov, float), np.asarray(F, float), Q, np.einsum("tmi,tmj->tij", H, H) / sigma**2)


def _start(k: int) -> Gaussian:
    mean, std = np.zeros(state_vector.state_size(k), np.float32), np.full(state_vector.state_size(k), 1e-5, np.float32)
    mean[:2], mean[2 : 2 * k] = (6.0, 12.0), _BEACONS.ravel()
    std[:2], std[2 : 2 * k], std[2 * k : 2 * k + 2] = _PRIOR["place"], _PRIOR["beacon"], _PRIOR["speed"]
    std[[2, 3, 5]] = _FRAME_M
    std[4 * k], std[4 * k + 1] = _PRIOR["heading"], _PRIOR["rate"]
    return Gaussian(jnp.asarray(mean), jnp.diag(jnp.asarray(std) ** 2))


_STILL = empty_frame(2, len(_PAIRS)).odometry


def _ranges(z: jax.Array) -> Ranges:
    every = jnp.ones(len(_PAIRS), bool)
    i, j = jnp.asarray(_PAIRS[:, 0]), jnp.asarray(_PAIRS[:, 1])
    return Ranges(i, j, z, jnp.zeros(len(_PAIRS)), jnp.full(len(_PAIRS), jnp.nan), every)


def _moved(x: jax.Array) -> jax.Array:
    return motion.transition(x, jnp.float32(_DT), _STILL, jnp.zeros(state_vector.node_count(x.shape[0]), bool))


def _slope(params, x: jax.Array) -> jax.Array:
    return jax.jacfwd(_moved)(x)


def _noise(params, x: jax.Array) -> jax.Array:
    """Q, as the filter has it: what a prediction adds to a covariance of nothing."""
    nothing = Gaussian(x, jnp.zeros((x.shape[0], x.shape[0])))
    calm = jnp.array(match_fusion.CALM) ** 2
    moving = jnp.zeros(state_vector.node_count(x.shape[0]), bool)
    return motion.predict(nothing, params, jnp.float32(_DT), _STILL, moving, calm).cov


def _run(params, start: Gaussian, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A truth (T, n) drawn from the model, and the filter's means (T, n) on ranges drawn from it."""
    n = start.mean.shape[0]
    first, rest = jax.random.split(key)
    x = start.mean + jnp.sqrt(jnp.diagonal(start.cov)) * jax.random.normal(first, (n,))
    root = symmetric_root(_noise(params, start.mean))
    moving, every = jnp.zeros(state_vector.node_count(n), bool), jnp.ones(len(_PAIRS), bool)
    calm = jnp.array(match_fusion.CALM) ** 2

    def step(carry, key):
        x, belief, scatter = carry
        of_motion, of_ranges = jax.random.split(key)
        x = _moved(x) + root @ jax.random.normal(of_motion, (n,))
        z = ranging.predicted_ranges(x, _ranges(jnp.zeros(len(_PAIRS))), params)
        z = z + params.sigma_n * jax.random.normal(of_ranges, z.shape)
        belief = motion.predict(belief, params, jnp.float32(_DT), _STILL, moving, calm)
        belief, _, scatter = ranging.update(belief, _ranges(z), every, params, scatter, robust=True)
        return (x, belief, scatter), (x, belief.mean)

    scatter = ranging.quiet(state_vector.node_count(n))
    return lax.scan(step, (x, start, scatter), jax.random.split(rest, _STEPS))[1]


def _draw(found: Errors, bound: Errors) -> None:
    """RMSE and bound over time."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, every = plt.subplots(1, 2, figsize=(9, 3.4))
    t = _DT * np.arange(1, _STEPS + 1)
    rows = (("robot", "robot's position [m]"), ("beacons", "beacons [m]"))
    for axes, (key, name) in zip(every, rows, strict=True):
        axes.plot(t, np.sqrt(getattr(found, key).mean(0)), label="RMSE of the filter")
        axes.plot(t, np.sqrt(getattr(bound, key).mean(0)), "k--", label="bound")
        axes.set(xlabel="time [s]", ylabel=name, ylim=(0, None))
    every[0].legend()
    figure.tight_layout()
    figure.savefig(PICTURE, dpi=110)
    plt.close(figure)
