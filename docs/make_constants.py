"""Makes docs/constants.md: every constant of the modules with its value and the docstring that follows it.

python docs/make_constants.py
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "constants.md"
SOURCES = {"uwbslam_jax": ROOT / "uwbslam_jax", "uwbslam_drivers": ROOT / "drivers" / "uwbslam_drivers"}
_NAME = re.compile(r"_{0,1}[A-Z][A-Z0-9_]*")
_LONGEST_VALUE = 60
_HEAD = """\
# Constants

Every number that is neither a setting nor derived: its value, its unit, and why it has that value. This page is made
from the docstrings in the code, by `python docs/make_constants.py`."""


class Constant(NamedTuple):
    """A constant of a module.

    Attributes:
      module: dotted. name, value: as they stand in the code.
      about: its docstring on one line, "" where it has none.
    """

    module: str
    name: str
    value: str
    about: str


def constants() -> Iterator[Constant]:
    """All constants, module by module, in the order in which they stand there."""
    for package, folder in SOURCES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            module = ".".join([package, *(part for part in parts if part != "__init__")])
            yield from of_module(module, path.read_text(encoding="utf-8"))


def without_docstring() -> list[str]:
    """Constants that say neither their unit nor why they have their value, as module.NAME."""
    return [f"{constant.module}.{constant.name}" for constant in constants() if not constant.about]


def page() -> str:
    """The text of docs/constants.md."""
    lines, module = [_HEAD], ""
    for constant in constants():
        if constant.module != module:
            module = constant.module
            lines += ["", f"## {module}", "", "| constant | value | what it is |", "| --- | --- | --- |"]
        lines.append(f"| `{constant.name}` | {_code(constant.value)} | {_escaped(constant.about)} |")
    return "\n".join(lines) + "\n"


def of_module(module: str, text: str) -> Iterator[Constant]:
    """Constants of a module with this text."""
    body = ast.parse(text).body
    for statement, following in zip_longest(body, body[1:]):
        for name, value in _assigned(statement):
            yield Constant(module, name, value, _docstring(following))


def _assigned(statement: ast.stmt) -> Iterator[tuple[str, str]]:
    """Names in capitals that a statement binds, with what it binds them to."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        targets, value = [statement.target], statement.value
    elif isinstance(statement, ast.Assign):
        targets, value = statement.targets, statement.value
    else:
        return
    for target in targets:
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=True))
        elif isinstance(target, ast.Tuple):
            pairs = [(name, value) for name in target.elts]
        else:
            pairs = [(target, value)]
        for name, bound in pairs:
            if isinstance(name, ast.Name) and _NAME.fullmatch(name.id):
                yield name.id, ast.unparse(bound)


def _docstring(statement: ast.stmt | None) -> str:
    literal = statement.value if isinstance(statement, ast.Expr) else None
    told = literal.value if isinstance(literal, ast.Constant) else None
    return " ".join(told.split()) if isinstance(told, str) else ""


def _code(value: str) -> str:
    """A value as code; of a long one (a table, a type of rows) only that it is there."""
    return f"`{value}`" if len(value) <= _LONGEST_VALUE and "|" not in value and "`" not in value else "(see the code)"


def _escaped(text: str) -> str:
    """Text that Markdown leaves as it is, but for what stands between backticks."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([\\$*|<>\[\]_])", r"\\\1", part) for part in parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE}: {len(list(constants()))} constants, {len(without_docstring())} without a docstring")
