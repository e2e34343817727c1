"""Settings that every test runs under: compilation cache, strict rank promotion, annotations checked on each call."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from uwbslam_jax.process import prepare

# Before jax is imported, which reads these once. As the command line does it: sums over threads round differently.
prepare()
os.environ.setdefault("JAX_NUMPY_RANK_PROMOTION", "raise")

import jax
import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

install_import_hook("uwbslam_jax", "typechecks.check")

from uwbslam_jax.estimator.native import kept

# The JAX step steps, whatever this machine has compiled; a test that asks for the native engine gets it.
kept.is_kept, kept.compile_beside = lambda: False, lambda: None

# Compilation makes the first example of a property slow, and a failure must be the same on every machine.
settings.register_profile("uwbslam", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("uwbslam")

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture
def x64() -> Iterator[None]:
    """Double precision within one test, for derivatives."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def shared_data() -> Path:
    """Folder of the recorded data, which is not part of the project; skips where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no recorded data at {SHARED_DATA}")
    return SHARED_DATA
