"""Every code block of the README and the documentation runs, page by page, or says why it does not."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import pytest
from reader import ROOT, Run

PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "drivers" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
RUN = {"python", "sh", "toml"}
SHOWN = {"console", "text", "c", "bibtex"}
"""Languages of blocks that are only to be read."""
STAND_FOR = dict.fromkeys(("LOG", "BAG", "TRUTH"), "hall.mcap") | {"DIR": "out", "OUT": "again", "TUNED": "tuned"}
"""What a reader puts in place of a word in capitals."""

_FENCE = re.compile(r"(`{3,})(\S*)")
_NOT_RUN = re.compile(r"^<!-- not run: (\S.*) -->$", re.MULTILINE)


class Block(NamedTuple):
    """A block of code.

    Attributes:
      line: where it begins. language: the word after the fence. text: what it says.
      why_not: why it is not run, None where it is.
    """

    line: int
    language: str
    text: str
    why_not: str | None


def blocks(page: str) -> list[Block]:
    """The code blocks of a page, without the directives that only the site knows."""
    lines, found, above = page.splitlines(), [], ""
    at = 0
    while at < len(lines):
        fence = _FENCE.match(lines[at])
        if fence is None:
            above = lines[at]
            at += 1
            continue
        end = next(k for k in range(at + 1, len(lines)) if lines[k].strip() == fence[1])
        excuse = _NOT_RUN.fullmatch(above)
        if not fence[2].startswith("{"):
            found.append(Block(at + 1, fence[2], "\n".join(lines[at + 1 : end]), excuse and excuse[1]))
        at, above = end + 1, ""
    return found


def _of(path: Path) -> list[Block]:
    return blocks(path.read_text(encoding="utf-8"))


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_finds_blocks_and_why_they_are_not_run() -> None:
    page = "a\n```sh\nls\n```\n<!-- not run: no port -->\n```python\nx\n\ny\n```\n```{include} z\n```\n```\nplain\n```"
    assert blocks(page) == [
        Block(2, "sh", "ls", None),
        Block(6, "python", "x\n\ny", "no port"),
        Block(13, "", "plain", None),
    ]


@pytest.mark.parametrize("path", PAGES, ids=_name)
def test_every_block_is_run_or_says_what_it_is(path: Path) -> None:
    assert [(b.line, b.language) for b in _of(path) if b.language not in RUN | SHOWN] == []
    # an excuse belongs to a block that would be run without it
    excuses = _NOT_RUN.findall(path.read_text(encoding="utf-8"))
    assert [b.why_not for b in _of(path) if b.why_not and b.language in RUN] == excuses


def _to_run(path: Path) -> list[Block]:
    return [b for b in _of(path) if b.language in RUN and b.why_not is None]


@pytest.mark.slow
@pytest.mark.parametrize("path", [path for path in PAGES if _to_run(path)], ids=_name)
def test_runs(path: Path, folder: Path, run: Run) -> None:
    """Blocks run in their order in one folder, each in a process of its own, as they are copied one by one."""
    for block in _to_run(path):
        if block.language == "python":
            run("python", "-c", block.text, cwd=folder)
        elif block.language == "toml":
            (folder / "robot.toml").write_text(block.text, encoding="utf-8")
            run("python", "-c", "import uwbslam_jax as us; us.load_settings('robot.toml')", cwd=folder)
        else:
            words = "|".join(STAND_FOR)
            text = re.sub(rf"\b({words})\b", lambda word: STAND_FOR[word[0]], block.text)
            run("bash", "-euo", "pipefail", "-c", text, cwd=folder)
