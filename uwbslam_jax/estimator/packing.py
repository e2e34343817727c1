"""Trees of small arrays as one vector of float32: between host and device, a copy costs by the array, not by the byte.

Integers and truth values below 2^24 come back as they were, floats bit by bit.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

T = TypeVar("T")


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
