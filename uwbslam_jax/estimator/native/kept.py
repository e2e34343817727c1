"""Where what numba compiles is kept, whether it is there, and a process that compiles it for the next run.

numba's own cache does not see a change in another file's function or constant. So it lies in a folder whose name is a
hash of all sources that the loops and their constants come from, of where they lie, of numba and of the processor.
Nothing here imports numba, which takes half a second, or LLVM before it is asked for.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import time
from functools import cache
from importlib.metadata import version
from pathlib import Path

from uwbslam_jax import process

_PATIENCE_S = 900.0
"""A process that compiles and has not ended for so long has been killed [s]."""
_OTHERS = {"engine.py", "kept.py", "warm_up.py"}
"""Modules of this wing in which nothing is compiled [names]."""


@cache
def folder() -> Path:
    """Where numba keeps what it compiles of these sources for this processor."""
    from llvmlite import binding  # no other run has a use for it

    package = Path(__file__).parents[2]
    key = hashlib.sha256()
    for path in sorted(p for wing in ("estimator", "mapping") for p in (package / wing).rglob("*.py")):
        if path.parent.name != "native" or path.name not in _OTHERS:
            key.update(path.read_bytes())
    entry = Path(__file__).with_name("step.py")  # numba asks for the place and the time of this one itself
    key.update(repr((str(entry), entry.stat().st_mtime_ns)).encode())
    cpu = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
    key.update(repr((version("numba"), version("llvmlite"), version("numpy"), sys.version_info[:2], cpu)).encode())
    return process.cache_folder() / "native" / key.hexdigest()[:24]


def is_kept() -> bool:
    """Whether the step is compiled: it then is there within a second, not in most of a minute."""
    return any(folder().rglob("step.step-*.nbc"))


def mark_of_work() -> Path:
    """A file that is there while a process compiles."""
    return folder() / "compiling"


def compile_beside() -> None:
    """Compiles in a process of its own, which outlives this one; where one is at it already, or the folder cannot be
    written, nothing happens."""
    mark = mark_of_work()
    try:
        mark.parent.mkdir(parents=True, exist_ok=True)
        if mark.exists() and time.time() - mark.stat().st_mtime > _PATIENCE_S:
            mark.unlink(missing_ok=True)
        mark.touch(exist_ok=False)
        command = [sys.executable, "-c", f"from {__package__} import warm_up; warm_up.main()"]
        none = subprocess.DEVNULL
        subprocess.Popen(command, start_new_session=True, stdin=none, stdout=none, stderr=none)
    except OSError:
        pass
