"""How a step's time grows with beacons, beams, the map's window and its levels."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.metric import Metric, Report, exponent, ratio
from uwbslam_jax import LidarSettings, MapSettings, Settings, UwbSettings, estimator
from uwbslam_jax.estimator import Config, compiled, make_config, make_params, state_vector
from uwbslam_jax.measurements import Frame, Ranges, Scan, empty_frame

BEACONS = (3, 5, 10, 20, 50)
BEAMS = (181, 361, 541, 1081, 2162)
EXTENTS = (19.2, 51.2, 153.6, 300.8)
LEVELS = (1, 2, 3, 4)
_ROOM = (6.0, 4.0)
"""Half the sides of the room that is seen [m]."""


def measure(*, quick: bool) -> Report:
    """Medians over some hundred steps of a robot that circles in a room; the sizes take turns step by step."""
    count = 30 if quick else 200
    metrics: list[Metric] = []
    usual = Settings(uwb=UwbSettings(max_beacons=5), map=MapSettings(size_m=25.6))
    with_scans = [Case(b, sized(usual, beacons=b)) for b in BEACONS]
    without = [Case(b, sized(usual, beacons=b), scans=False) for b in BEACONS]
    for name, cases in (("step", with_scans), ("without scan", without)):
        times = _take_turns(cases, count)
        for beacons, t in zip(BEACONS, times, strict=True):
            label = f"{name}, {beacons} beacons, {beacons * (beacons + 1) // 2} ranges"
            metrics.append(Metric(label, 1e3 * t, "ms", "lower", 8.0 if name == "step" and beacons == 50 else None))
    nodes = [b + 1.0 for b in BEACONS]
    metrics.append(Metric("exponent of the part without scan over the nodes", exponent(nodes, times), "", "lower", 3.0))
    times = _take_turns([Case(b, sized(usual, beams=b)) for b in BEAMS], count)
    metrics += [Metric(f"step, {b} beams", 1e3 * t, "ms", "lower") for b, t in zip(BEAMS, times, strict=True)]
    metrics.append(Metric("exponent over the beams", exponent(list(map(float, BEAMS)), times), "", "lower"))
    times = _take_turns([Case(5, replace(usual, map=MapSettings(size_m=e))) for e in EXTENTS], count)
    metrics += [Metric(f"step, window of {e:g} m", 1e3 * t, "ms", "lower") for e, t in zip(EXTENTS, times, strict=True)]
    metrics.append(ratio("300 m window / 20 m window", times[-1] / times[0], bar=1.2))
    times = _take_turns([Case(5, replace(usual, map=MapSettings(size_m=25.6, levels=k))) for k in LEVELS], count)
    metrics += [Metric(f"step, {k} levels", 1e3 * t, "ms", "lower") for k, t in zip(LEVELS, times, strict=True)]
    about = (
        "Compiled steps at 10 Hz (coarser levels and drawing at work), a robot that circles in a room of 12 x 8 m, all "
        "pairs of nodes ranged in every frame. Cases that are compared take turns step by step. The window is all that "
        "the device holds of a map; what lies outside is kept in tiles on the host."
    )
    return Report("How a step grows", about, metrics)


def sized(settings: Settings, *, beacons: int = 5, beams: int = 1081) -> Settings:
    """The settings with so many beacons and beams."""
    return replace(settings, uwb=UwbSettings(max_beacons=beacons), lidar=LidarSettings(max_beams=beams))


class Case:
    """A run whose beacons are known from the start, stepped with exact measurements."""

    def __init__(self, label: int | float, settings: Settings, *, scans: bool = True):
        self.label, self.settings, self._scans = label, settings, scans
        config, k = make_config(settings), 1 + settings.uwb.max_beacons
        self._pairs = np.array(list(combinations(range(k), 2)), np.int32)
        self._config: Config = replace(config, max_ranges=len(self._pairs))
        self._params = make_params(settings)
        around = 2 * np.pi * np.arange(k) / k
        self._nodes = np.column_stack([5.5 * np.cos(around), 3.5 * np.sin(around)])
        state = estimator.init(self._config)
        mean = state.belief.mean.at[2 : 2 * k].set(jnp.asarray(self._nodes[1:].ravel(), jnp.float32))
        at = jnp.arange(2, 2 * k)
        cov = state.belief.cov.at[at, at].set(1e-2).at[at + 2 * k, at + 2 * k].set(1e-8)
        active = jnp.ones(k, bool)
        self.state = state._replace(belief=state.belief._replace(mean=mean, cov=cov), active=active)
        self._time = 0.0

    def frame(self) -> Frame:
        """What is measured 0.1 s later."""
        self._time += 0.1
        angle = 0.4 * self._time
        pose = np.array([2 * np.sin(angle), 2 - 2 * np.cos(angle), angle])
        nodes = self._nodes.copy()
        nodes[0] = pose[:2]
        i, j = self._pairs.T
        distance = np.linalg.norm(nodes[i] - nodes[j], axis=1).astype(np.float32)
        still, none = np.zeros(len(i), np.float32), np.full(len(i), np.nan, np.float32)
        empty = empty_frame(self._config.max_beams, len(i))
        scan = _scan(pose, self._config.max_beams) if self._scans else empty.scan
        ranges = Ranges(i, j, distance, still, none, np.ones(len(i), bool))
        return empty._replace(dt=np.float32(0.1), has_scan=np.bool_(self._scans), scan=scan, ranges=ranges)

    def step(self) -> float:
        """Seconds of one more step."""
        frame = self.frame()
        begin = time.perf_counter()
        self.state, _ = compiled.step(self._config, self._params, self.state, [frame])
        jax.block_until_ready(self.state)
        return time.perf_counter() - begin

    def many(self, sets: int, frames: list[Frame]) -> Callable[[], Any]:
        """The frames stepped for so many parameter sets at once, each with its own noise of ranges; compiled here."""
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *frames)
        params = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (sets, *leaf.shape)), self._params)
        params = params._replace(sigma_n=jnp.linspace(0.05, 0.2, sets))
        start = self.state

        def one(params):
            state, told = lax.scan(partial(estimator.step, self._config, params), start, stacked)
            return state_vector.robot_pose(state.belief.mean), jnp.sum(told.log_likelihood)

        return partial(jax.jit(jax.vmap(one)).lower(params).compile(), params)


def _scan(pose: np.ndarray, beams: int) -> Scan:
    """A scan over 270 degrees in the room, without noise."""
    step = np.deg2rad(270.0) / (beams - 1)
    angle = pose[2] - np.deg2rad(135.0) + step * np.arange(beams)
    along = np.stack([np.cos(angle), np.sin(angle)])
    walls = np.array(_ROOM)[:, None] * np.sign(along)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.min((walls - pose[:2, None]) / along, axis=0).astype(np.float32)
    zero = np.float32(0.0)
    return Scan(reach, np.isfinite(reach), np.float32(-np.deg2rad(135.0)), np.float32(step), zero)


def _take_turns(cases: list[Case], count: int) -> list[float]:
    """Median seconds of a step of each case."""
    times = np.array([[case.step() for case in cases] for _ in range(count + 10)])
    return np.median(times[10:], axis=0).tolist()
