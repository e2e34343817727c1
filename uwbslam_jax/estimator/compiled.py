"""The step as it is compiled: one vector in, one out, for one frame or several.

It is one program whatever the number of frames is: two would round differently now and then, however alike
they are, and a live run and its recording would part.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from uwbslam_jax.estimator import step
from uwbslam_jax.settings import Config, Params, Settings, UwbSettings, make_params
from uwbslam_jax.measurements import Frame, empty_frame
from uwbslam_jax.estimator.packing import Packing
from uwbslam_jax.estimator.step import Estimate, State

TRACES: Counter[str] = Counter()
"""How often each compiled function was traced, by name; a test counts them."""


GROUP = 10
"""So many frames at most."""


def step(config: Config, params: Params, state: State, frames: Sequence[Frame]) -> tuple[State, list[Estimate]]:
    """Steps over at most GROUP frames in order; the state's buffers are reused. The estimates are on the host.

    Raises:
      ValueError: more frames than that.
    """
    packing, estimates = _packings(config)
    packed = np.zeros((GROUP, packing.size), np.float32)
    for row, frame in zip(packed[: len(frames)], frames, strict=True):
        packing.pack(frame, row)
    state, told = _step(config, params, state, packed, np.int32(len(frames)))
    return state, [estimates.unpack(row) for row in np.asarray(told)[: len(frames)]]


@cache
def _packings(config: Config) -> tuple[Packing[Frame], Packing[Estimate]]:
    """How the frames and the estimates of a configuration lie in vectors."""
    frame, state = empty_frame(config.max_beams, config.max_ranges), jax.eval_shape(partial(step.init, config))
    params = jax.eval_shape(lambda: make_params(Settings(uwb=UwbSettings(max_beacons=config.nodes - 1))))
    _, estimate = jax.eval_shape(partial(step.step, config), params, state, frame)
    return Packing(frame), Packing(_reported(estimate))


def _reported(estimate: Estimate) -> Estimate:
    """What the host is told: what only gradients ask for is left out, and so it is not computed."""
    return estimate._replace(match_log_likelihood=None)


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(config, params, state, frames, count):
    TRACES["step"] += 1
    packing, estimates = _packings(config)

    def one(k, carry):
        state, told = carry
        state, estimate = step.step(config, params, state, packing.unpack(frames[k]))
        return state, told.at[k].set(estimates.pack_device(_reported(estimate)))

    return lax.fori_loop(0, count, one, (state, jnp.zeros((GROUP, estimates.size))))
