"""How the loops of this wing are compiled."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import numba
from llvmlite import binding
from numba.core import config as numba_config

from uwbslam_jax.estimator.native.kept import folder

F = TypeVar("F", bound=Callable[..., Any])
"""A function of plain loops."""

_OVERLAPS = "400"
"""So many pairs of arrays LLVM may check for overlap before a vectorised loop, for numba cannot say that none do: with
its own limit of 8 hardly any loop over a scan is vectorised."""
_OPTIONS = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
"""Of every function: division by zero is inf or NaN as it is in the twin."""
_INNER = {**_OPTIONS, "no_cpython_wrapper": True}
"""Of those that Python does not call: half of the time to compile them would go into how it could."""
_SUMS = {"contract", "reassoc", "nsz"}
"""What a sum over beams may do that its twin's does as well: be added up in another order. NaN and inf stay."""

binding.set_option("", f"--runtime-memory-check-threshold={_OVERLAPS}")


def loops(function: F) -> F:
    """Decorator: compiled when it is first called by something compiled."""
    return numba.njit(fastmath={"contract"}, **_INNER)(inspect.unwrap(function))  # pyright: ignore[reportReturnType]


def sums(function: F) -> F:
    """Decorator: the same for sums over beams, whose order is free."""
    return numba.njit(fastmath=_SUMS, **_INNER)(inspect.unwrap(function))  # pyright: ignore[reportReturnType]


def entry(function: F) -> F:
    """Decorator: called from Python; what was compiled is kept on disk, with all that it calls, see `kept`."""
    config: Any = numba_config
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder())
    try:
        compiled = numba.njit(fastmath={"contract"}, cache=True, **_OPTIONS)(inspect.unwrap(function))
    finally:
        config.CACHE_DIR = before
    return compiled  # pyright: ignore[reportReturnType]
