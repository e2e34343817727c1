"""Puts the generated result tables into the README, between its two marks.

python -m benchmarks.readme
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.tables import RESULTS

README = Path(__file__).parents[1] / "README.md"
_BEGIN, _END = "<!-- results -->\n", "<!-- /results -->"


def with_tables(readme: str, tables: list[str]) -> str:
    """The README's text with the tables between the marks."""
    head, rest = readme.split(_BEGIN)
    _, tail = rest.split(_END)
    return head + _BEGIN + "\n".join(table.strip() + "\n" for table in tables) + _END + tail


def section(table: str) -> str:
    """A table one headline below the README's sections, without the details that only its own file has."""
    return "##" + table.split("\n<details>")[0]


def main() -> None:
    """Rewrite the README in place."""
    tables = [section(path.read_text(encoding="utf-8")) for path in sorted(RESULTS.glob("*.md"))]
    README.write_text(with_tables(README.read_text(encoding="utf-8"), tables), encoding="utf-8")


if __name__ == "__main__":
    main()
