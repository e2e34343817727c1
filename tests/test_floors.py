"""A module imports only from lower floors, so that there is no circle and the picture of the package stays simple."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "uwbslam_jax"

# Numbers between whole ones are parts of the floor below them that stand on each other.
FLOORS: dict[float, str] = {
    0: "__init__",
    1: "geometry measurements config ekf result layout mcap_records paths",
    2: "motion ranging grid metrics settings_file frames ros_types worlds multilateration",
    2.1: "placement schemas result_log conditions",
    2.2: "mcap_log scenarios",
    2.3: "log_summary",
    3: "objective tiles",
    4: "matching",
    4.1: "paper",
    5: "slam",
    6: "startup beacons",
    6.1: "history",
    6.2: "session",
    7: "run report_data",
    8: "tuning simulate report outputs",
    8.1: "commands",
    9: "__main__",
}
FLOOR = {module: floor for floor, modules in FLOORS.items() for module in modules.split()}
MODULES = sorted(PACKAGE.rglob("*.py"))


def imported_modules(source: str) -> set[str]:
    """Names of the package's own modules that a source imports, wherever the import stands in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = "uwbslam_jax" + (f".{node.module}" if node.module else "") if node.level else node.module or ""
            names = [f"{base}.{alias.name}" for alias in node.names] if base == "uwbslam_jax" else [base]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("uwbslam_jax.")}
    return {name for name in found if (PACKAGE / f"{name}.py").exists() or name in FLOOR}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_imports_only_from_lower_floors(path: Path) -> None:
    assert path.stem in FLOOR, f"{path.name} is in no floor: add it to the table at the top of this file"
    imported = imported_modules(path.read_text(encoding="utf-8"))
    unlisted = sorted(imported - FLOOR.keys())
    assert not unlisted, f"{path.name} imports {unlisted}, which are in no floor"
    wrong = sorted(name for name in imported if FLOOR[name] >= FLOOR[path.stem])
    assert not wrong, f"{path.name} imports {wrong} from its own floor or above"


def test_imports_are_found_wherever_they_stand() -> None:
    source = """
import uwbslam_jax.grid
from uwbslam_jax import slam, __version__
from . import matching
from .ekf import Gaussian
if TYPE_CHECKING:
    from uwbslam_jax.result import Result
def late():
    from uwbslam_jax.run import run_log
"""
    assert imported_modules(source) == {"grid", "slam", "matching", "ekf", "result", "run"}
