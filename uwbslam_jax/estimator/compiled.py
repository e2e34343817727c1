"""The step as it is compiled: one vector in, one out, for one frame or several.

It is one program whatever the number of frames is: two would round differently now and then, however alike
they are, and a live run and its recording would part.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache, partial
from types import TracebackType
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from uwbslam_jax.estimator.state import Estimate, State, init
from uwbslam_jax.estimator.step import step as step_frame
from uwbslam_jax.measurements import Frame, empty_frame
from uwbslam_jax.settings import Config, Params, Settings, UwbSettings, make_params

T = TypeVar("T")
"""A tree of arrays."""

TRACES: Counter[str] = Counter()
"""How often each compiled function was traced, by name; a test counts them."""
GROUP = 10
"""Frames of one call at most."""


def step(config: Config, params: Params, state: State, frames: Sequence[Frame]) -> tuple[State, list[Estimate]]:
    """Steps over at most GROUP frames in order; the state's buffers are reused. The estimates are on the host.

    Raises:
      ValueError: more frames than that.
    """
    packing, estimates = _packings(config)
    packed = np.zeros((GROUP, packing.size), np.float32)
    for row, frame in zip(packed[: len(frames)], frames, strict=True):
        packing.pack(frame, row)
    state, reported = _step(config, params, state, packed, np.int32(len(frames)))
    return state, [estimates.unpack(row) for row in np.asarray(reported)[: len(frames)]]


@cache
def _packings(config: Config) -> tuple[Packing[Frame], Packing[Estimate]]:
    """How the frames and the estimates of a configuration lie in vectors."""
    frame, state = empty_frame(config.max_beams, config.max_ranges), jax.eval_shape(partial(init, config))
    params = jax.eval_shape(lambda: make_params(Settings(uwb=UwbSettings(max_beacons=config.nodes - 1))))
    _, estimate = jax.eval_shape(partial(step_frame, config), params, state, frame)
    return Packing(frame), Packing(_reported(estimate))


def _reported(estimate: Estimate) -> Estimate:
    """What the host gets: what only gradients ask for is left out, and so it is not computed."""
    return estimate._replace(match_log_likelihood=None)


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(
    config: Config, params: Params, state: State, frames: Float[Array, "G f"], count: Int[Array, ""]
) -> tuple[State, Float[Array, "G e"]]:
    TRACES["step"] += 1
    packing, estimates = _packings(config)

    def one(k: Int[Array, ""], carry: tuple[State, Float[Array, "G e"]]) -> tuple[State, Float[Array, "G e"]]:
        state, reported = carry
        state, estimate = step_frame(config, params, state, packing.unpack(frames[k]))
        return state, reported.at[k].set(estimates.pack_device(_reported(estimate)))

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


class Packing(Generic[T]):
    """How the trees of one structure lie in a vector.

    Attributes:
      size: length of the vector.
    """

    def __init__(self, like: T):
        """Args: like: a tree of arrays, or of their shapes and dtypes, as all the trees to be packed have them."""
        leaves, self._structure = jax.tree.flatten(like)
        self._shapes = [leaf.shape for leaf in leaves]
        self._dtypes = [leaf.dtype for leaf in leaves]
        ends = np.cumsum([int(np.prod(shape)) for shape in self._shapes]).tolist()
        self._slices = [slice(begin, end) for begin, end in zip([0, *ends], ends, strict=False)]
        self.size = ends[-1]

    def pack(self, tree: T, vector: Float[np.ndarray, "size"]) -> None:
        """A tree on the host into a vector."""
        for leaf, part in zip(jax.tree.leaves(tree), self._slices, strict=True):
            vector[part] = leaf.ravel()

    def pack_device(self, tree: T) -> Float[Array, "size"]:
        """A tree inside a compiled function as a vector."""
        return jnp.concatenate([leaf.ravel().astype(jnp.float32) for leaf in jax.tree.leaves(tree)])

    def unpack(self, vector: Any) -> T:
        """The tree of a vector: of numpy on the host, of JAX inside a compiled function."""
        leaves = [
            vector[part].reshape(shape).astype(dtype, copy=False)
            for part, shape, dtype in zip(self._slices, self._shapes, self._dtypes, strict=True)
        ]
        return jax.tree.unflatten(self._structure, leaves)
