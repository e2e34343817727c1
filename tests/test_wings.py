"""A module imports only from lower floors, so that there is no circle and the picture of the package stays simple."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "uwbslam_jax"
DRIVERS = Path(__file__).parents[1] / "drivers" / "uwbslam_drivers"

# Numbers between whole ones are parts of the floor below them that stand on each other.
FLOORS: dict[float, str] = {
    0: "__init__ memory",
    1: "geometry measurements config ekf result layout mcap_records packing paths rays sparse_rows columns seldom",
    2: "motion ranging grid metrics settings_file frames ros_types worlds multilateration inbox",
    2.05: "keyframes bag",
    2.1: "sightings placement relative schemas result_log conditions",
    2.2: "mcap_log scenarios hypotheses",
    2.3: "log_summary",
    3: "objective tiles surfaces",
    4: "matching",
    4.1: "paper trust",
    5: "slam",
    5.1: "compiled beacon_state heard registration redraw range_means",
    5.2: "graph",
    5.25: "steps",
    5.3: "smoothing",
    6: "startup beacons",
    6.1: "history",
    6.15: "hindsight mounting",
    6.17: "revision",
    6.2: "session",
    6.3: "findings",
    7: "run report_data page",
    7.2: "tunable rollout",
    7.3: "likelihood calibration",
    7.4: "tuning",
    7.5: "tune_pictures",
    7.6: "tune_command",
    8: "simulate report outputs recorder live_page publish",
    8.05: "pictures",
    8.1: "saved_state live_view rehearsal deliver",
    8.2: "live",
    8.3: "live_command",
    8.4: "commands",
    9: "__main__",
}
DRIVER_FLOORS: dict[float, str] = {
    1: "device scip clock ports",
    1.5: "lines",
    2: "hokuyo rplidar linktrack dwm1001 makerfabs dwm1000",
    3: "source",
    4: "__init__",
    5: "emulators emulators.robot emulators.faults emulators.plugs",
    6: "emulators.hokuyo emulators.rplidar emulators.radios",
    7: "emulators.serve",
    8: "emulators.command",
}
FLOOR = {module: floor for floor, modules in FLOORS.items() for module in modules.split()}
DRIVER_FLOOR = {module: floor for floor, modules in DRIVER_FLOORS.items() for module in modules.split()}
MODULES = sorted(PACKAGE.rglob("*.py"))
DRIVER_MODULES = sorted(DRIVERS.rglob("*.py"))
FOR_DRIVERS = {"measurements"}
"""What the drivers may take from the estimator's package."""
FOR_EMULATORS = {"measurements", "geometry", "simulate", "conditions", "rays"}
"""What the emulators may take from it, for they simulate."""


def driver_module(path: Path) -> str:
    """Name of a module of the drivers, without the package's."""
    words = path.relative_to(DRIVERS).with_suffix("").parts
    return ".".join(words[:-1] if len(words) > 1 and words[-1] == "__init__" else words)


def imported_drivers(source: str) -> set[str]:
    """Names of the drivers' modules that a source imports, without the package's."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "uwbslam_drivers":
            base = (node.module or "").partition(".")[2]
            joined = {f"{base}.{alias.name}".lstrip(".") for alias in node.names}
            found |= joined & DRIVER_FLOOR.keys() or {base or "__init__"}
    return found


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


@pytest.mark.parametrize("path", DRIVER_MODULES, ids=driver_module)
def test_drivers_import_only_from_lower_floors_and_little_of_the_estimator(path: Path) -> None:
    module, source = driver_module(path), path.read_text(encoding="utf-8")
    assert module in DRIVER_FLOOR, f"{path.name} is in no floor: add it to the table at the top of this file"
    wrong = sorted(name for name in imported_drivers(source) if DRIVER_FLOOR[name] >= DRIVER_FLOOR[module])
    assert not wrong, f"{path.name} imports {wrong} from its own floor or above"
    foreign = imported_modules(source) - (FOR_EMULATORS if module.startswith("emulators") else FOR_DRIVERS)
    assert not foreign, f"{path.name} imports {sorted(foreign)} of uwbslam_jax"


def test_imports_of_drivers_are_found_wherever_they_stand() -> None:
    source = """
from uwbslam_drivers import scip
from uwbslam_drivers import open_source
from uwbslam_drivers.emulators import robot
def late():
    from uwbslam_drivers.emulators.plugs import Plug
"""
    assert imported_drivers(source) == {"scip", "__init__", "emulators.robot", "emulators.plugs"}
