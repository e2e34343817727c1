"""Puts generated result tables into the README, between its two marks, and names the other ones.

python -m benchmarks.readme
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.tables import RESULTS

README = Path(__file__).parents[1] / "README.md"
_BEGIN, _END = "<!-- results -->\n", "<!-- /results -->"
SHOWN = ("scenarios", "recordings", "step", "bound", "consistency")
"""Results whose tables are in the README, in this order; the others are linked."""


def with_tables(readme: str, tables: list[str]) -> str:
    """The README's text with the tables between the marks."""
    head, rest = readme.split(_BEGIN)
    _, tail = rest.split(_END)
    return head + _BEGIN + "\n".join(table.strip() + "\n" for table in tables) + _END + tail


def section(table: str) -> str:
    """A table one headline below the README's sections, without the details that only its own file has."""
    return "##" + table.split("\n<details>")[0]


def others(tables: dict[str, str]) -> str:
    """Links to tables by their headlines. tables: name -> text."""
    lines = [f"- [{text.splitlines()[0].lstrip('# ')}](benchmarks/results/{name}.md)" for name, text in tables.items()]
    return "\n".join(["### More tables", "", *lines])


def main() -> None:
    """Rewrite the README in place."""
    argparse.ArgumentParser(prog="python -m benchmarks.readme", description=__doc__).parse_args()
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(RESULTS.glob("*.md"))}
    tables = [section(texts.pop(name)) for name in SHOWN if name in texts]
    README.write_text(with_tables(README.read_text(encoding="utf-8"), [*tables, others(texts)]), encoding="utf-8")


if __name__ == "__main__":
    main()
