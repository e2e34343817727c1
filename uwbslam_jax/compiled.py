"""The step as it is compiled: one vector in, one out, one by one or as a scan over several; both give the same bits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache, partial

import jax
import numpy as np
from jax import lax

from uwbslam_jax import slam
from uwbslam_jax.config import Config, Params, Settings, UwbSettings, make_params
from uwbslam_jax.measurements import Frame, StampedFrame, empty_frame
from uwbslam_jax.packing import Packing
from uwbslam_jax.slam import Estimate, State

TRACES: Counter[str] = Counter()
"""How often each compiled function was traced, by name; a test counts them."""


def step_once(config: Config, params: Params, state: State, frame: Frame) -> tuple[State, Estimate]:
    """One compiled step; the state's buffers are reused. The estimate is on the host."""
    frames, estimates = _packings(config)
    state, told = _step_once(config, params, state, frames.pack(frame))
    return state, estimates.unpack(np.asarray(told))


def step_many(
    config: Config, params: Params, state: State, frames: Sequence[StampedFrame]
) -> tuple[State, list[Estimate]]:
    """Steps over frames in order, as one compiled scan."""
    packing, estimates = _packings(config)
    state, told = _step_many(config, params, state, np.stack([packing.pack(frame.frame) for frame in frames]))
    return state, [estimates.unpack(row) for row in np.asarray(told)]


@cache
def _packings(config: Config) -> tuple[Packing[Frame], Packing[Estimate]]:
    """How the frames and the estimates of a configuration lie in vectors."""
    frame, state = empty_frame(config.max_beams, config.max_ranges), jax.eval_shape(partial(slam.init, config))
    params = jax.eval_shape(lambda: make_params(Settings(uwb=UwbSettings(max_beacons=config.nodes - 1))))
    _, estimate = jax.eval_shape(partial(slam.step, config), params, state, frame)
    return Packing(frame), Packing(_reported(estimate))


def _reported(estimate: Estimate) -> Estimate:
    """What the host is told: what only gradients ask for is left out, and so it is not computed."""
    return estimate._replace(match_log_likelihood=None)


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step_once(config, params, state, frame):
    TRACES["step_once"] += 1
    return _guarded(config, params, state, frame)


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step_many(config, params, state, frames):
    TRACES["step_many"] += 1
    return lax.scan(lambda s, f: _guarded(config, params, s, f), state, frames)


def _guarded(config, params, state, frame):
    # without the barriers the compiler fuses the step with the loop around it and rounds differently there
    state, frame = lax.optimization_barrier((state, frame))
    frames, estimates = _packings(config)
    state, estimate = lax.optimization_barrier(slam.step(config, params, state, frames.unpack(frame)))
    return state, estimates.pack_device(_reported(estimate))
