"""The step as it is compiled: one vector in, one out, for one frame or several.

It is one program whatever the number of frames is: two would round differently now and then, however alike
they are, and a live run and its recording would part.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from types import TracebackType

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from uwbslam_jax.estimator.packing import as_reported, packings
from uwbslam_jax.estimator.state import Estimate, State
from uwbslam_jax.estimator.step import step as step_frame
from uwbslam_jax.measurements import Frame
from uwbslam_jax.settings import Config, Params

TRACES: Counter[str] = Counter()
"""How often each compiled function was traced, by name; a test counts them."""
GROUP = 10
"""Frames of one call at most."""


def step(config: Config, params: Params, state: State, frames: Sequence[Frame]) -> tuple[State, list[Estimate]]:
    """Steps over at most GROUP frames in order; the state's buffers are reused. The estimates are on the host.

    Raises:
      ValueError: more frames than that.
    """
    packing, estimates = packings(config)
    packed = np.zeros((GROUP, packing.size), np.float32)
    for row, frame in zip(packed[: len(frames)], frames, strict=True):
        packing.pack(frame, row)
    state, reported = _step(config, params, state, packed, np.int32(len(frames)))
    return state, [estimates.unpack(row) for row in np.asarray(reported)[: len(frames)]]


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(
    config: Config, params: Params, state: State, frames: Float[Array, "G f"], count: Int[Array, ""]
) -> tuple[State, Float[Array, "G e"]]:
    TRACES["step"] += 1
    packing, estimates = packings(config)

    def one(k: Int[Array, ""], carry: tuple[State, Float[Array, "G e"]]) -> tuple[State, Float[Array, "G e"]]:
        state, reported = carry
        state, estimate = step_frame(config, params, state, packing.unpack(frames[k]))
        return state, reported.at[k].set(estimates.pack_device(as_reported(estimate)))

    return lax.fori_loop(0, count, one, (state, jnp.zeros((GROUP, estimates.size))))


class CompileClock:
    """Adds up the time that JAX spends tracing and compiling while it is entered, in any thread.

    Attributes:
      seconds: so far [s].
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            self.seconds += duration_secs

    def __enter__(self) -> CompileClock:
        jax.monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        jax.monitoring.unregister_event_duration_listener(self._listen)
