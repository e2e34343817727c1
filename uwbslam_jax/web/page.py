"""The one page of live view and report, as HTML: its frame with looks and scripts, and the pieces that both show.

Every text that comes in is plain and escaped here. What a report or a live view says is `report` and `live_page`; the
map, the charts and the live connection are in map.js, charts.js and live.js.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from uwbslam_jax import __version__
from uwbslam_jax.result import BeaconEstimate

_SCRIPTS = ("map.js", "charts.js", "live.js")
"""Scripts of the page [files], in the order in which they use each other."""


@dataclass(frozen=True)
class Parts:
    """What makes one page of the frame.

    Attributes:
      title, subtitle: plain text.
      notices, tiles, sections: HTML.
      data: for the scripts, see page_data.page_data.
    """

    title: str
    subtitle: str
    notices: str
    tiles: str
    sections: str
    data: Mapping[str, Any]


def render(parts: Parts) -> str:
    """The page as one text that needs nothing else."""
    folder = files("uwbslam_jax.web")

    def read(name: str) -> str:
        return folder.joinpath(name).read_text(encoding="utf-8")

    filled = {
        "title": html.escape(parts.title),
        "subtitle": html.escape(parts.subtitle),
        "notices": parts.notices,
        "tiles": parts.tiles,
        "sections": parts.sections,
        "footer": f"uwbslam_jax {html.escape(__version__)}",
        # A closing tag inside a text would end the script element; the escape means the same to JSON.
        "data": json.dumps(parts.data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "style": read("page.css"),
        "script": "\n".join(map(read, _SCRIPTS)),
    }
    # In one pass, so that a text which looks like a placeholder stays a text.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: filled[match[1]], read("page.html"))


def notices(lines: Iterable[tuple[str, str]]) -> str:
    """What a reader must know before any figure: ("warn" or "info", plain text)."""
    return "".join(
        f'<div class="notice {kind}">{"<b>Warning:</b> " if kind == "warn" else ""}{html.escape(line)}</div>'
        for kind, line in lines
    )


def tiles(figures: Sequence[tuple[str, str, str]]) -> str:
    """Headline figures: name, value and note, as HTML."""
    return "".join(
        f'<div class="tile"><div class="name">{name}</div><div class="value">{value}</div>'
        f'<div class="note">{note}</div></div>'
        for name, value, note in figures
    )


def figure(value: Any, unit: str, digits: int) -> str:
    """A number with its unit, small, as HTML; a dash where there is none."""
    if not isinstance(value, int | float | np.number) or not np.isfinite(value):
        return "–"
    space = "" if unit in ("°", "×") else " "
    return f"{value:.{digits}f}" + (f"{space}<small>{html.escape(unit)}</small>" if unit else "")


def text(value: Any) -> str:
    """Any value of a summary as plain text."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if value is None:
        return "–"
    if isinstance(value, float | np.floating):
        return f"{value:.5g}" if np.isfinite(value) else "–"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {text(item)}" for key, item in value.items()) or "none"
    if isinstance(value, list | tuple | np.ndarray):
        return ", ".join(map(text, value)) or "none"
    return str(value)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numeric: Sequence[int] = ()) -> str:
    """A table of plain texts; the numeric columns are set to the right."""

    def line(tag: str, cells: Sequence[str]) -> str:
        kinds = [' class="n"' if k in numeric else ' class="text"' for k in range(len(cells))]
        inner = "".join(f"<{tag}{kind}>{html.escape(cell)}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))
        return f"<tr>{inner}</tr>"

    header = f"<thead>{line('th', head)}</thead>" if head else ""
    return f'<div class="scroll"><table>{header}<tbody>{"".join(line("td", row) for row in rows)}</tbody></table></div>'


def section(title: str, body: str) -> str:
    """A card with a heading, plain text, and a body, HTML."""
    return f"<section><h2>{html.escape(title)}</h2>{body}</section>"


def beacon_table(beacons: Sequence[BeaconEstimate]) -> str:
    """Ids, places, standard deviations and states; a dash for what is not known."""
    if not beacons:
        return '<p class="sub">No beacon was placed.</p>'
    rows = []
    for b in sorted(beacons, key=lambda b: b.id):
        sigma = np.sqrt(np.maximum(np.diagonal(b.cov), 0))
        numbers = [*((v, 3) for v in b.position), *((v, 4) for v in sigma), (b.z, 2), (b.sigma_z, 2)]
        cells = "".join(f'<td class="n">{figure(float(v), "", digits)}</td>' for v, digits in numbers)
        kind = re.sub(r"\W", "", b.status)
        status = html.escape(b.status)
        rows.append(f'<tr><td class="n">{b.id}</td>{cells}<td class="status {kind}">{status}</td></tr>')
    head = "".join(
        f'<th class="n">{name}</th>' for name in ("Id", "x [m]", "y [m]", "σ x [m]", "σ y [m]", "z [m]", "σ z [m]")
    )
    return f'<div class="scroll"><table><thead><tr>{head}<th>Status</th></tr></thead>{"".join(rows)}</table></div>'
