"""The package has few wings in one order, each with a front door; what is inside is of bounded size and annotated."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE, DRIVERS = ROOT / "uwbslam_jax", ROOT / "drivers" / "uwbslam_drivers"
WINGS = [
    "measurements result errors process reasons",
    "settings",
    "numerics",
    "mapping evaluation",
    "estimator",
    "startup",
    "beacons backend",
    "session",
    "tuning sim files",
    "web plotting simulation",
    "api",
    "live",
    "cli",
    "__init__ __main__",
]
"""From the ground up; a wing, or a module beside them, imports only from rows above its own in this table."""
ROW = {wing: row for row, wings in enumerate(WINGS) for wing in wings.split()}
FOR_ANYBODY = {"__version__"}
"""What the package itself gives to its wings."""
FOR_DRIVERS = {"measurements", "errors", "reasons"}
"""What the drivers may take of the package."""
FOR_EMULATORS = FOR_DRIVERS | {"numerics", "sim"}
"""What the emulators may take of it, for they simulate."""

MODULES = sorted(PACKAGE.rglob("*.py"))
DRIVER_MODULES = sorted(DRIVERS.rglob("*.py"))
LONGEST = 400
MANY_ARGUMENTS = 6
FUNCTIONS_WITH_MANY = 10
ANNOTATED = ("estimator", "startup", "backend", "session")


def dotted(path: Path) -> str:
    """A module's full name; a package's is that of its folder."""
    above = PACKAGE.parent if path.is_relative_to(PACKAGE) else DRIVERS.parent
    return ".".join(path.relative_to(above).with_suffix("").parts).removesuffix(".__init__")


def imports(source: str, package: str) -> Iterator[tuple[str, str | None]]:
    """Module and name, None where a module is imported as such, of every import of ours, wherever it stands.

    Args:
      package: of which the source is a module, for relative imports.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found = [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = ".".join(package.split(".")[: len(package.split(".")) + 1 - node.level]) if node.level else ""
            module = ".".join(filter(None, (above, node.module)))
            found = [(module, alias.name) for alias in node.names]
        else:
            continue
        yield from (each for each in found if each[0].split(".")[0] in ("uwbslam_jax", "uwbslam_drivers"))


def imported_by(path: Path) -> list[tuple[str, str | None]]:
    name = dotted(path)
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    return list(imports(path.read_text(encoding="utf-8"), package))


def wing_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


@cache
def exports(wing: str) -> set[str]:
    """Public names of a wing: what its `__init__` imports under their own names."""
    tree = ast.parse((PACKAGE / wing / "__init__.py").read_text(encoding="utf-8"))
    aliases = [alias for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    return {alias.name for alias in aliases if alias.asname == alias.name and not alias.name.startswith("_")}


def crossing(found: list[tuple[str, str | None]], wing: str | None) -> tuple[set[str], list[str]]:
    """The other wings that imports reach, and those imports that do not take a public name through the front door."""
    wings: set[str] = set()
    wrong: list[str] = []
    for module, name in found:
        first, _, inner = module.partition(".")[2].partition(".")
        if not module.startswith("uwbslam_jax"):
            continue
        if not first and name is not None and name in ROW:
            wings.add(name)
        elif first == wing:
            continue
        elif not first:
            wrong += [f"{module}: {name}"] if name not in FOR_ANYBODY else []
        else:
            wings.add(first)
            public = name is not None and not inner and not name.startswith("_")
            if not public or ((PACKAGE / first).is_dir() and name not in exports(first)):
                wrong.append(f"{module}: {name}")
    return wings - {wing}, wrong


def circle(paths: list[Path]) -> list[str]:
    """A circle of imports among modules, empty where there is none; a front door imports all and is left out."""
    names = {dotted(path): path for path in paths if path.stem != "__init__"}
    graph = {
        name: {full for module, what in imported_by(path) for full in (module, f"{module}.{what}") if full in names}
        for name, path in names.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def functions(paths: list[Path]) -> Iterator[tuple[str, list[ast.arg]]]:
    """Name and arguments, without self, _ and what a star gathers, of every function, nested ones too."""
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                known = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                yield f"{dotted(path)}.{node.name}", [arg for arg in known if arg.arg not in ("self", "cls", "_")]


@pytest.mark.parametrize("path", MODULES, ids=dotted)
def test_a_wing_imports_public_names_of_rows_above(path: Path) -> None:
    wing = wing_of(path)
    assert wing in ROW, f"{wing} is in no row: add it to the table at the top of this file"
    reached, wrong = crossing(imported_by(path), wing)
    assert not wrong, f"{dotted(path)} imports what is no public name of a wing: {wrong}"
    below = sorted(name for name in reached if ROW[name] >= ROW[wing])
    assert not below, f"{dotted(path)} imports {below} of its own row or below"


def test_every_wing_of_the_table_is_there_and_no_circle_in_it() -> None:
    folders = [path.parent for path in MODULES if path.name == "__init__.py" and path.parent != PACKAGE]
    own = {folder.name for folder in folders if folder.parent == PACKAGE}
    assert own | {path.stem for path in PACKAGE.glob("*.py")} == ROW.keys()
    assert len(WINGS) <= 14
    for folder in folders:
        assert not circle(sorted(folder.glob("*.py")))


@pytest.mark.parametrize("path", DRIVER_MODULES, ids=dotted)
def test_drivers_take_little_of_the_package_and_nothing_of_the_emulators(path: Path) -> None:
    emulates = path.parent.name == "emulators"
    found = imported_by(path)
    reached, wrong = crossing(found, None)
    assert not wrong, f"{dotted(path)} imports what is no public name of a wing: {wrong}"
    assert not reached - (FOR_EMULATORS if emulates else FOR_DRIVERS)
    assert emulates or not any("emulators" in f"{module}.{name}".split(".") for module, name in found)


def test_drivers_have_no_circle() -> None:
    assert not circle(DRIVER_MODULES)


@pytest.mark.parametrize("path", sorted(Path(__file__).parent.rglob("test_*.py")), ids=lambda path: path.stem)
def test_no_test_module_imports_another(path: Path) -> None:
    """What several of them use is in a module of helpers."""
    source = path.read_text(encoding="utf-8")
    assert not [line for line in source.splitlines() if line.startswith(("import test_", "from test_"))]


def test_imports_are_found_wherever_they_stand() -> None:
    source = """
import uwbslam_jax.mapping.grid
from uwbslam_jax import sim, __version__, nothing
from . import batched_cond
from .step import step
from ..session import Session
from uwbslam_jax.numerics import se2_host, wrap_angle, hidden
from uwbslam_jax.api import _private
if TYPE_CHECKING:
    from uwbslam_jax.result import Result
def late():
    from uwbslam_jax.web.report import write_report
"""
    reached, wrong = crossing(list(imports(source, "uwbslam_jax.estimator")), "estimator")
    assert reached == {"mapping", "sim", "session", "numerics", "api", "result", "web"}
    assert sorted(wrong) == [
        "uwbslam_jax.api: _private",
        "uwbslam_jax.mapping.grid: None",
        "uwbslam_jax.numerics: hidden",
        "uwbslam_jax.numerics: se2_host",
        "uwbslam_jax.web.report: write_report",
        "uwbslam_jax: nothing",
    ]


def test_a_circle_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{__name__}.PACKAGE", tmp_path / "uwbslam_jax")
    wing = tmp_path / "uwbslam_jax" / "wing"
    wing.mkdir(parents=True)
    texts = {"a": "from .b import x", "b": "from uwbslam_jax.wing import c", "c": "import uwbslam_jax.wing.a", "d": ""}
    for name, text in texts.items():
        (wing / f"{name}.py").write_text(text)
    assert len(set(circle(sorted(wing.glob("*.py"))))) == 3
    (wing / "c.py").write_text("from .d import y")
    assert not circle(sorted(wing.glob("*.py")))


def test_no_module_is_long() -> None:
    long = {dotted(path): len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES + DRIVER_MODULES}
    assert not {name: lines for name, lines in long.items() if lines > LONGEST}


def test_few_functions_have_many_arguments() -> None:
    found = functions(MODULES + DRIVER_MODULES)
    many = [f"{name}: {len(arguments)}" for name, arguments in found if len(arguments) > MANY_ARGUMENTS]
    assert len(many) <= FUNCTIONS_WITH_MANY, "\n".join(many)


def test_every_argument_is_annotated() -> None:
    found = functions([path for path in MODULES if wing_of(path) in ANNOTATED])
    bare = [f"{name}: {arg.arg}" for name, arguments in found for arg in arguments if arg.annotation is None]
    assert not bare, "\n".join(bare)
