"""What the documentation shows is run as a reader runs it: in a folder with a short recording, in a new process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from reader import ROOT, Run

_OF_TESTS = ("JAX_NUMPY_RANK_PROMOTION", "XLA_FLAGS", "NPROC", "OPENBLAS_NUM_THREADS")
"""Set for the tests' own process, before JAX is imported; a reader's process has none of them."""


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a command in a folder, with this checkout's `uwbslam` and this Python on the path; it has to succeed."""
    commands = tmp_path_factory.mktemp("bin")
    for name, words in {"uwbslam": "-m uwbslam_jax", "python": ""}.items():
        (commands / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n', encoding="utf-8")
        (commands / name).chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if name not in _OF_TESTS}
    environment["PATH"] = f"{commands}{os.pathsep}{os.environ['PATH']}"
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "drivers")])
    environment["MPLBACKEND"] = "Agg"

    def run(*words: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(words, capture_output=True, text=True, cwd=cwd, env=environment, check=False)
        assert done.returncode == 0, f"{done.stdout[-1000:]}\n{done.stderr[-3000:]}"
        return done

    return run


@pytest.fixture(scope="session")
def recording(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording that the tutorial makes."""
    folder = tmp_path_factory.mktemp("recording")
    run("uwbslam", "simulate", "hall", "-o", "hall.mcap", "--duration", "30", cwd=folder)
    return folder / "hall.mcap"


@pytest.fixture
def folder(recording: Path, tmp_path: Path) -> Path:
    """A folder that holds hall.mcap and nothing else."""
    shutil.copy(recording, tmp_path)
    return tmp_path
