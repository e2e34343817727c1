"""What the gradient of a long rollout costs, in time and memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import uwbslam_jax as us
from benchmarks.metric import Metric
from uwbslam_jax.estimator import state_vector
from uwbslam_jax.mapping import TILE
from uwbslam_jax.sim import Beacon, Scenario, paths, spread, stream, worlds
from uwbslam_jax.tuning import cropped

_STEPS = 1521
"""39 chunks of 39, not below 1500."""
_CELLS = 384
"""The largest window of whole blocks within 20 m."""
_HALL_M = (10.0, 13.0)
"""It is seen whole in that window, however it lies."""
_SECONDS = 185.0
_NAMES = ("sigma_n", "sigma_w", "sigma_l")


def cost(quick: bool) -> Iterator[Metric]:
    """Gradient over forward rollout, and the memory that the compiler sets aside for it."""
    ready = us.rollout(us.Simulation(_small_hall()), us.Settings())
    steps = 144 if quick else _STEPS
    assert ready.count >= steps
    frames = jax.tree.map(lambda x: x[:steps], ready.frames)
    config, params = replace(ready.config, cells=_CELLS), ready.params
    middle = np.asarray(state_vector.unpack(ready.state.belief.mean).positions[1:], float).mean(0)
    tile = TILE * config.resolution
    origin = np.round((middle - 0.5 * _CELLS * config.resolution) / tile) * tile
    state = ready.state._replace(grid=cropped(ready.state.grid, config.resolution, origin, _CELLS))

    def total(logs, state, frames):
        tuned = params._replace(**dict(zip(_NAMES, jnp.exp(logs), strict=True)))
        return ready._replace(config=config, state=state, frames=frames).loss(tuned)

    logs = jnp.log(jnp.array([float(getattr(params, name)) for name in _NAMES]))
    compiled = jax.jit(jax.value_and_grad(total)).lower(logs, state, frames).compile()
    memory = compiled.memory_analysis()
    assert memory is not None
    size = memory.temp_size_in_bytes + memory.output_size_in_bytes + memory.argument_size_in_bytes
    forward = _seconds(jax.jit(partial(total, logs, state, frames)))
    both = _seconds(lambda: compiled(logs, state, frames))
    yield Metric("cost: steps", float(steps), "")
    yield Metric("cost: forward rollout", forward, "s", "lower")
    yield Metric("cost: value and gradient", both, "s", "lower")
    yield Metric("cost: value and gradient / forward", both / forward, "x", "lower", bar=5.0)
    yield Metric("cost: memory of value and gradient", size / 2**20, "MB", "lower", bar=600.0)


def _seconds(run: Callable[[], object]) -> float:
    """Least of three, after one that may compile [s]."""
    times = []
    for _ in range(4):
        begin = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - begin)
    return min(times[1:])


def _small_hall() -> Scenario:
    world = worlds.hall(1, _HALL_M)
    track = paths.Track(world.lap, 1.2, closed=True)
    spots = spread(world, track.sample(0.25), 5, stream(1, "beacons"), apart=3.0)
    beacons = tuple(Beacon(k + 1, (float(x), float(y))) for k, (x, y) in enumerate(spots))
    return Scenario(
        "small hall", 1, _SECONDS, world, paths.Path([paths.Rest(4.0), paths.Along(track, 0.0, _SECONDS)]), beacons
    )
