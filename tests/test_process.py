"""What importing the package sets in its process; each test in a process of its own, for libraries read it once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

NAMES = (
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "OPENBLAS_NUM_THREADS",
    "XLA_FLAGS",
    "NPROC",
)


def answer(code: str, **own: str) -> str:
    """What a new Python prints; in its environment what a user has set, and none of what this process has."""
    environment = {name: value for name, value in os.environ.items() if name not in NAMES} | own
    words = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


VARIABLES = f"import json, os; import uwbslam_jax; print(json.dumps({{name: os.environ[name] for name in {NAMES}}}))"


def test_the_variables_are_set_before_any_library_reads_them(tmp_path: Path) -> None:
    code = f"{VARIABLES}; import sys; assert not {{'jax', 'numpy'}} & sys.modules.keys()"
    assert json.loads(answer(code, XDG_CACHE_HOME=str(tmp_path))) == {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "uwbslam_jax" / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
        "OPENBLAS_NUM_THREADS": "1",
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
        "NPROC": "1",
    }


def test_what_the_user_has_set_stays() -> None:
    own = dict(zip(NAMES, ["/elsewhere", "7", "3", "--xla_cpu_enable_fast_math=false", "2"], strict=True))
    assert json.loads(answer(VARIABLES, **own)) == own


WITHOUT_POSIX = """
import sys
POSIX = {"resource", "pty", "tty", "termios", "fcntl", "pwd", "grp"}

class Windows:
    def find_spec(self, name, path=None, target=None):
        if name in POSIX:
            raise ImportError(f"there is no {name} here")

for name in POSIX:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Windows())
import uwbslam_jax, uwbslam_drivers
from uwbslam_jax import process
from uwbslam_jax.cli import commands
print(process.peak_mb())
"""
"""Imports all that a command needs where the modules of POSIX systems are missing."""


def test_recordings_need_no_module_that_only_posix_systems_have() -> None:
    assert answer(WITHOUT_POSIX) == "None\n"


BLAS = """
from threadpoolctl import threadpool_info
print([pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"])
"""


def test_blas_has_one_thread_also_where_numpy_was_imported_first() -> None:
    threads = json.loads(answer("import numpy, uwbslam_jax" + BLAS))
    assert set(threads) == {1}


def test_threads_of_blas_that_the_user_has_set_stay_where_numpy_was_imported_first() -> None:
    threads = json.loads(answer("import numpy, uwbslam_jax" + BLAS, OPENBLAS_NUM_THREADS="2"))
    assert set(threads) == {min(2, os.cpu_count() or 1)}


def test_after_jax_was_imported_but_not_started_all_is_set_without_a_warning(tmp_path: Path) -> None:
    code = "import jax, uwbslam_jax; print(jax.config.jax_compilation_cache_dir, end='')"
    assert answer(code, XDG_CACHE_HOME=str(tmp_path)) == str(tmp_path / "uwbslam_jax" / "jax")


@pytest.mark.parametrize(("own", "count"), [({}, 1), ({"XLA_FLAGS": "", "NPROC": "1"}, 0)], ids=["unset", "set"])
def test_after_jax_has_started_a_warning_says_what_to_do(own: dict[str, str], count: int) -> None:
    code = """
import warnings
import jax.numpy
jax.numpy.zeros(1)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import uwbslam_jax
found = [str(each.message) for each in caught if each.category is RuntimeWarning]
assert all("import uwbslam_jax first" in message for message in found)
print(len(found))
"""
    assert int(answer(code, **own)) == count
