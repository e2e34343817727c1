"""The notebooks as plain scripts, for what reads or runs scripts: `python tests/notebook_scripts.py FOLDER`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def cells(path: Path) -> list[dict[str, Any]]:
    """The code cells of a notebook."""
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


def script(path: Path) -> str:
    """The code of a notebook's cells in order."""
    return "\n\n".join("".join(cell["source"]) for cell in cells(path)) + "\n"


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        (folder / f"{notebook.stem}.py").write_text(script(notebook), encoding="utf-8")
