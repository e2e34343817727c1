"""A `lax.cond` for what is seldom and costly: of many runs at once, only those that want it pay for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

T = TypeVar("T")
"""A tree of arrays."""


def seldom(wanted: Bool[Array, ""], costly: Callable[..., T], old: T, *operands: Any) -> T:
    """`costly(old, *operands)` where that is wanted, else old.

    Under `vmap` a `lax.cond` does both for every run. This one takes the runs that want it one after another, so that
    what few runs ask for costs the others nothing.

    Args:
      costly: reads no array but its arguments. Not differentiated: what it returns is taken as given.
    """

    @jax.custom_batching.custom_vmap
    def one(wanted: Bool[Array, ""], old: T, operands: tuple[Any, ...]) -> T:
        return lax.cond(wanted, costly, lambda old, *_: old, old, *operands)

    @one.def_vmap
    def many(size: int, batched: Any, wanted: Bool[Any, "*_"], old: T, operands: tuple[Any, ...]) -> tuple[T, Any]:
        wanted, old = jax.tree.map(
            lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape)), (wanted, old), tuple(batched[:2])
        )
        first = jnp.argsort(~wanted)

        def turn(n: Int[Array, ""], all_old: T) -> T:
            k = first[n]
            mine = jax.tree.map(lambda x, b: x[k] if b else x, operands, batched[2])
            # tied to the turn: the compiler would take what is the same in each out of the loop, and do it for nobody
            n, mine = lax.optimization_barrier((n, mine))
            new = costly(jax.tree.map(lambda x: x[k], all_old), *mine)
            return jax.tree.map(lambda all_, x: all_.at[k].set(x), all_old, new)

        return lax.fori_loop(0, jnp.sum(wanted), turn, old), jax.tree.map(lambda _: True, old)

    return one(wanted, *jax.tree.map(lax.stop_gradient, (old, operands)))
