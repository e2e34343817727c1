"""The notebooks run from their first cell to their last, and are committed without outputs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from notebook_scripts import NOTEBOOKS, cells, script

PATHS = sorted(NOTEBOOKS.glob("*.ipynb"))


def test_there_are_three() -> None:
    assert [path.stem for path in PATHS] == ["01_one_step", "02_rerun_a_log", "03_tune_noise"]


@pytest.mark.slow
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_runs(path: Path, tmp_path: Path) -> None:
    """Their own assertions hold; a process of its own, as in a fresh kernel."""
    code = tmp_path / f"{path.stem}.py"
    code.write_text(script(path), encoding="utf-8")
    environment = {**os.environ, "MPLBACKEND": "Agg", "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, str(code)], capture_output=True, text=True, env=environment, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_has_no_outputs(path: Path) -> None:
    for cell in cells(path):
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
    assert json.loads(path.read_text(encoding="utf-8"))["nbformat"] == 4
