"""What every benchmark's table needs: cells, provenance, and the two files that a result is."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def line(cells: list[str]) -> str:
    """One row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def cell(value: float | None, digits: int) -> str:
    """A number, a dash where there is none."""
    return f"{value:.{digits}f}" if value is not None and math.isfinite(value) else "-"


def figures_table(
    words: Sequence[str],
    columns: Mapping[str, tuple[str, int]],
    rows: Iterable[tuple[Sequence[str], Mapping[str, Any]]],
) -> list[str]:
    """Rows of words, then figures; a dash where a row has none.

    Args:
      words: heads of the columns of words. columns: key of a figure -> head of its column, and its digits.
      rows: the words of each, and its figures by their keys.
    """
    lines = [line([*words, *(head for head, _ in columns.values())])]
    lines += [line([*["---"] * len(words), *["---:"] * len(columns)])]
    return lines + [
        line([*told, *(cell(figures.get(key), digits) for key, (_, digits) in columns.items())])
        for told, figures in rows
    ]


def plain(values: Any) -> Any:
    """The same for JSON: None for what is not finite."""
    if isinstance(values, dict):
        return {key: plain(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [plain(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


def write(name: str, text: str, data: dict[str, Any]) -> None:
    """results/NAME.md and NAME.json."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.md").write_text(text, encoding="utf-8")
    (RESULTS / f"{name}.json").write_text(json.dumps(plain(data), indent=1) + "\n", encoding="utf-8")


def provenance(workers: int) -> dict[str, str]:
    """What the figures depend on besides the seeds."""
    packages = ("jax", "jaxlib", "optimistix", "lineax", "numpy")
    return {
        "commit": _commit(),
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "CPU": f"{_cpu()}, {os.cpu_count()} cores, {workers} at once",
        "Python": platform.python_version(),
        **{name: version(name) for name in packages},
        "dtype": "float32",
    }


def _commit() -> str:
    def git(*words: str) -> str:
        folder = Path(__file__).parent
        done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    # the tables that this writes do not count as a change
    changed = git("status", "--porcelain", "--untracked-files=no", "--", "..", ":!results")
    return (git("rev-parse", "--short", "HEAD") or "unknown") + (" with changes" if changed else "")


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
