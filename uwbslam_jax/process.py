"""Settings of the process that its libraries read once: threads, XLA's flags, the compilation cache, the heaps."""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
from pathlib import Path

_ARENA_MAX, _ARENAS = -8, 2
"""Number of the parameter in glibc's malloc.h; heaps for all threads: one for the loop that steps, one for what runs
beside it [heaps]."""


def cache_folder() -> Path:
    """The user's folder for what is compiled once."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "uwbslam_jax"


def prepare() -> None:
    """Settings that the libraries read once. The package calls it when it is imported; what the user has set stays.

    Compiled programs are kept in the user's cache folder: the second run starts in seconds. LAPACK and XLA work alone:
    LAPACK's threads spin over matrices of 40 rows and make a step many times slower than one thread does, and sums over
    threads round differently. Memory is allocated from a few heaps. Warns where JAX is at work already.
    """
    chosen = "OPENBLAS_NUM_THREADS" in os.environ
    wanted = {
        "JAX_COMPILATION_CACHE_DIR": str(cache_folder() / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
        "OPENBLAS_NUM_THREADS": "1",
        # the same holds for XLA's kernels of a step, each of which takes microseconds
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
        "NPROC": "1",  # size of XLA's own thread pool
    }
    missing = {name for name in wanted if name not in os.environ}
    for name, value in wanted.items():
        os.environ.setdefault(name, value)
    if "numpy" in sys.modules and not chosen:  # it has read the variable already
        import threadpoolctl

        threadpoolctl.threadpool_limits(1, user_api="blas")
    if "jax" in sys.modules:
        _catch_up(missing)
    few_arenas()


def _catch_up(missing: set[str]) -> None:
    """Sets in JAX what it would have read of the variables before its import."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" in missing:
        jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" in missing:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    from jax._src import xla_bridge  # there is no public way to ask

    # XLA reads its flags with the first array
    if missing & {"XLA_FLAGS", "NPROC"} and xla_bridge.backends_are_initialized():
        warnings.warn(
            "uwbslam_jax was imported after JAX had started: steps are slower, and round differently than the command "
            "line's; import uwbslam_jax first",
            RuntimeWarning,
            stacklevel=3,
        )


def few_arenas() -> None:
    """Lets all threads allocate from a few heaps. To be called before there are threads: one that has a heap keeps it.

    By default glibc gives each thread a heap of its own, up to eight a core, which grow without ever shrinking again.
    """
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_ARENA_MAX, _ARENAS)


def peak_mb() -> float | None:
    """The most memory that this process has held [MB], None where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (1 << 20 if sys.platform == "darwin" else 1 << 10)  # bytes there, kB on Linux


def give_back() -> None:
    """Hands memory that is free to the system: what threads allocate by turns is kept in ever more pieces otherwise."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)
