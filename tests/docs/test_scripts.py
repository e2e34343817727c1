"""The scripts of the documentation: short, shown, and they run on the tutorial's recording."""

from __future__ import annotations

from pathlib import Path

import pytest
from reader import ROOT, Run

SCRIPTS = ROOT / "docs" / "scripts"

MADE = {
    "make_arrays": ["arrays.npz"],
    "first": ["out/trajectory.tum", "out/beacons.csv", "out/map.pgm", "out/report.html"],
    "own_arrays": ["out/trajectory.tum", "out/beacons.csv", "out/map.pgm", "out/report.html"],
    "gradient": [],
    "compare": [],
    "simulate": [],
    "localize": ["saved/state.npz"],
    "inspect_recording": [],
    "tune": ["tuned.toml"],
    "seeds": [],
}
"""Script -> the files that it writes. The first one only makes arrays for another."""

LONG = set(MADE) - {"make_arrays", "first", "inspect_recording"}
"""All that run the estimator, but for the first."""


def test_every_script_is_listed_and_shown() -> None:
    assert {path.stem for path in SCRIPTS.glob("*.py")} == set(MADE)
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md"))
    assert [name for name in MADE if f"{{literalinclude}} scripts/{name}.py" not in pages] == []


@pytest.mark.parametrize("name", MADE)
def test_has_at_most_ten_lines_of_code(name: str) -> None:
    lines = [line.strip() for line in (SCRIPTS / f"{name}.py").read_text(encoding="utf-8").splitlines()]
    assert len([line for line in lines if line and not line.startswith("#")]) <= 10


def _marked(name: str) -> object:
    return pytest.param(name, marks=[pytest.mark.slow] if name in LONG else [])


@pytest.mark.parametrize("name", [_marked(name) for name in MADE])
def test_runs(name: str, folder: Path, run: Run) -> None:
    if name == "own_arrays":
        run("python", SCRIPTS / "make_arrays.py", cwd=folder)
    done = run("python", SCRIPTS / f"{name}.py", cwd=folder)
    assert [path for path in MADE[name] if not (folder / path).is_file()] == []
    assert "nan" not in done.stdout.split()  # no figure is missing
    assert done.stdout or MADE[name]
    if name == "own_arrays":
        assert "decided" in done.stdout  # the arrays are enough for a frame
