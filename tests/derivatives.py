"""Central differences against forward and reverse mode, for functions of any pytree of floats."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

STEP = 1e-6
"""Step of a central difference in float64: its error, about eps / STEP + STEP^2, is 1e-10 of the values."""


def double(tree: Any) -> Any:
    """The same tree with its floats in float64; needs x64 to be on."""

    def one(leaf):
        leaf = jnp.asarray(leaf)
        return leaf.astype(jnp.float64) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(one, tree)


def directions(tree: Any, count: int, seed: int = 0) -> list[Any]:
    """Random directions in the space of a tree."""
    rng = np.random.default_rng(seed)
    return [jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), tree) for _ in range(count)]


def difference(function: Callable[[Any], jax.Array], at: Any, direction: Any, step: float = STEP) -> np.ndarray:
    """Central difference of a function along a direction."""
    ahead = function(jax.tree.map(lambda x, d: x + step * d, at, direction))
    behind = function(jax.tree.map(lambda x, d: x - step * d, at, direction))
    return (np.asarray(ahead) - np.asarray(behind)) / (2 * step)


@cache
def value_and_gradient(function: Callable[..., jax.Array]) -> Callable[..., Any]:
    """Both in one compilation, the larger part of what a derivative test costs; so the compiler is not to optimise."""
    return _unoptimised(jax.value_and_grad(function))


@cache
def _pushed(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """Derivative along a direction in forward mode."""
    return _unoptimised(lambda at, along, *rest: jax.jvp(lambda x: function(x, *rest), (at,), (along,))[1])


def _unoptimised(function: Callable[..., Any]) -> Callable[..., Any]:
    return jax.jit(function, compiler_options={"xla_backend_optimization_level": 0})


def assert_gradient(
    function: Callable[..., jax.Array],
    at: Any,
    *rest: Any,
    rtol: float = 1e-6,
    atol: float = 1e-8,
    count: int = 6,
    step: float = STEP,
    forward: bool = True,
) -> Any:
    """Reverse mode, forward mode and central differences of a scalar function agree along random directions.

    The default tolerances are those of a central difference in float64 with some room. Returns the gradient by the
    first argument. The same function is compiled once for all calls with the same shapes.
    """
    gradient = assert_reverse(value_and_gradient(function), at, *rest, rtol=rtol, atol=atol, count=count, step=step)
    if forward:
        for direction in directions(at, count):
            # the same derivative by two orders of summation: rounding only
            pushed = _pushed(function)(at, direction, *rest)
            np.testing.assert_allclose(pushed, along(gradient, direction), rtol=1e-9, atol=1e-10)
    return gradient


def assert_reverse(both, at: Any, *rest: Any, rtol: float, atol: float, count: int = 6, step: float = STEP) -> Any:
    """Reverse mode and central differences agree along random directions of the first argument; returns the gradient.

    Args:
      both: of `value_and_gradient`.
    """
    gradient = both(at, *rest)[1]
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all()
    for direction in directions(at, count):
        numeric = difference(lambda x: both(x, *rest)[0], at, direction, step)
        np.testing.assert_allclose(along(gradient, direction), numeric, rtol=rtol, atol=atol)
    return gradient


def along(gradient: Any, direction: Any) -> float:
    """Derivative along a direction."""
    return sum(jax.tree.leaves(jax.tree.map(lambda g, d: float(jnp.sum(g * d)), gradient, direction)))
