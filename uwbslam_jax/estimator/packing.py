"""How trees of arrays lie in vectors: frames go to a compiled step as one vector each, estimates come back as one."""

from __future__ import annotations

from functools import cache, partial
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from uwbslam_jax.estimator.state import Estimate, init
from uwbslam_jax.estimator.step import step
from uwbslam_jax.measurements import Frame, empty_frame
from uwbslam_jax.settings import Config, Params, Settings, UwbSettings, make_params

T = TypeVar("T")
"""A tree of arrays."""


class Packing(Generic[T]):
    """How the trees of one structure lie in a vector.

    Attributes:
      size: length of the vector. like: a tree of the structure.
    """

    def __init__(self, like: T):
        """Args: like: a tree of arrays, or of their shapes and dtypes, as all the trees to be packed have them."""
        leaves, self._structure = jax.tree.flatten(like)
        self.like = like
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


def params_like(config: Config) -> Params:
    """Shapes and dtypes of the parameters of a configuration."""
    return jax.eval_shape(lambda: make_params(Settings(uwb=UwbSettings(max_beacons=config.nodes - 1))))


@cache
def packings(config: Config) -> tuple[Packing[Frame], Packing[Estimate]]:
    """How the frames and the estimates of a configuration lie in vectors."""
    frame, state = empty_frame(config.max_beams, config.max_ranges), jax.eval_shape(partial(init, config))
    _, estimate = jax.eval_shape(partial(step, config), params_like(config), state, frame)
    return Packing(frame), Packing(as_reported(estimate))


def as_reported(estimate: Estimate) -> Estimate:
    """What the host gets: what only gradients ask for is left out, and so it is not computed."""
    return estimate._replace(match_log_likelihood=None)
