"""A run as one HTML page that opens offline: figures, map with a player, charts and tables.

The page's frame is `page`, its data comes from `page_data`; here its words and tables are written.
"""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from uwbslam_jax.result import BeaconStatus, Result, RunStatus
from uwbslam_jax.web import page
from uwbslam_jax.web.page_data import diagnostics, page_data, pair_kinds, pair_residuals, span

_PAIRS = 60
"""Rows of the table of pairs [pairs]: more than the 45 of ten nodes, and still to be read."""
_FIGURES: dict[str, tuple[str, str, int]] = {
    "steps": ("Steps", "", 0),
    "duration_s": ("Duration", "s", 1),
    "wall_s": ("Wall time", "s", 2),
    "compile_s": ("Compilation", "s", 2),
    "step_ms_median": ("Step time, median", "ms", 2),
    "step_ms_p95": ("Step time, 95 %", "ms", 2),
    "latency_ms_median": ("Scan arrival to pose, median", "ms", 2),
    "latency_ms_p99": ("Scan arrival to pose, 99 %", "ms", 2),
    "real_time_factor": ("Real-time factor", "×", 1),
    "peak_rss_mb": ("Peak memory", "MB", 0),
    "robot_rmse_m": ("Robot, RMS", "m", 3),
    "robot_ate_m": ("Robot, ATE (aligned alone)", "m", 3),
    "robot_max_m": ("Robot, largest", "m", 3),
    "heading_deg_median": ("Heading, median", "°", 2),
    "heading_deg_p95": ("Heading, 95 %", "°", 2),
    "beacon_mean_m": ("Beacons, mean", "m", 3),
    "beacon_max_m": ("Beacons, largest", "m", 3),
    "covered": ("Share of the time covered", "", 3),
    "decided_at": ("Frame decided at", "s", 1),
    "beacons_missing": ("Beacons missing", "", 0),
    "pose_nees_ratio": ("Pose NEES / dof", "", 2),
    "beacon_nees_ratio": ("Beacon NEES / dof", "", 2),
}
"""Label, unit and digits of a figure [name -> texts, number]; one that is not listed is shown under its own name."""
_UNITS = ("m", "s", "ms", "deg", "rad", "Hz")
"""Units that may be the last part of a figure's name [text], and are shown behind its value instead."""
_SHOWN_APART = {"config", "warnings", "events", "dropped"}
"""Parts of the summary that have sections of their own [keys]."""


def write_report(
    result: Result, path: Path | str, metrics: Mapping[str, Any] | None = None, title: str = "UWB and LiDAR SLAM run"
) -> None:
    """Writes the page.

    Args:
      metrics: errors against the truth where there is one, see evaluation.evaluate.
      title: heading of the page, plain text.

    Shown from result.summary besides plain figures: `warnings` (a list of lines), `truncated` (a line or a flag),
    `dropped` (reason -> count), `config` (TOML text or nested tables), and `decided_at`, None
    where the frame never was.

    Raises:
      OSError: the file cannot be written.
    """
    parts = page.Parts(
        title=title,
        subtitle=_subtitle(result),
        notices=page.notices(_notices(result, metrics)),
        tiles=_tiles(result, metrics),
        sections=_sections(result, metrics),
        data=page_data(result),
    )
    Path(path).write_text(page.render(parts), encoding="utf-8")


def _subtitle(result: Result) -> str:
    if not len(result.stamps):
        return "No scan was processed."
    begin = datetime.fromtimestamp(int(result.stamps[0]) / 1e9, UTC)
    when = f"{begin:%Y-%m-%d %H:%M:%S} UTC · " if begin.year > 2000 else ""
    return f"{when}{span(result):.1f} s · {len(result.stamps)} frames · {_driven(result):.1f} m driven"


def _driven(result: Result) -> float:
    """Length of the track [m]; moves under 2 cm are summed up first, so that jitter at rest is not driving."""
    total, last = 0.0, None
    for xy in result.poses[np.isfinite(result.poses).all(axis=1), :2]:
        if last is None:
            last = xy
        elif (step := float(np.hypot(*(xy - last)))) > 0.02:
            total, last = total + step, xy
    return total


def _decided(result: Result) -> tuple[bool, Any]:
    """Whether the frame was ever decided, and when [s after the first frame]."""
    when = result.summary.get("decided_at")
    return when is not None, when


def _notices(result: Result, metrics: Mapping[str, Any] | None) -> Iterator[tuple[str, str]]:
    """What a reader must know before any figure: ("warn" or "info", text)."""
    summary = result.summary
    if summary.get("status") == RunStatus.LIDAR_ONLY:
        yield "info", "LiDAR only: poses and map are in the frame that the robot started in."
    elif not _decided(result)[0]:
        yield (
            "warn",
            "The frame was not decided: poses, beacons and map are not in a known frame.",
        )
    elif not result.beacons:
        yield "warn", "No beacon was placed."
    if summary.get("truncated"):
        where = summary["truncated"]
        yield "warn", where if isinstance(where, str) else "The recording breaks off; it was used up to there."
    for text in summary.get("warnings") or []:
        yield "warn", str(text)
    frames = np.diff(result.stamps) / 1e6
    step = float(np.mean(result.diagnostics["step_ms"])) if len(result.diagnostics.get("step_ms", [])) else 0.0
    if len(frames) and step > np.median(frames):
        yield (
            "warn",
            f"Slower than real time: a step takes {step:.1f} ms in the mean, a frame {np.median(frames):.1f} ms.",
        )
    for status in (BeaconStatus.MOVING, BeaconStatus.SILENT, BeaconStatus.DROPPED):
        ids = [str(beacon.id) for beacon in result.beacons if beacon.status == status]
        if ids:
            yield "info", f"{'Beacon' if len(ids) == 1 else 'Beacons'} {', '.join(ids)} {status} at the end."
    if metrics and metrics.get("beacons_missing"):
        yield "warn", f"Not placed although the truth has them: beacons {page.text(metrics['beacons_missing'])}."


def _tiles(result: Result, metrics: Mapping[str, Any] | None) -> str:
    """The headline figures."""
    decided, when = _decided(result)
    at = f"{when:.1f} s" if isinstance(when, int | float) and not isinstance(when, bool) else "yes"
    states = Counter(beacon.status for beacon in result.beacons)
    known = {**result.summary, **(metrics or {})}

    def shown(name: str) -> str:
        return page.figure(known.get(name), *_FIGURES[name][1:])

    tiles = []
    if metrics is not None:
        tiles += [
            ("Robot error, RMS", shown("robot_rmse_m"), f"largest {shown('robot_max_m')}"),
            ("Heading error, median", shown("heading_deg_median"), f"95 % {shown('heading_deg_p95')}"),
            ("Beacon error, mean", shown("beacon_mean_m"), f"largest {shown('beacon_max_m')}"),
        ]
    tiles += [
        ("Beacons placed", str(len(result.beacons)), ", ".join(f"{n} {html.escape(s)}" for s, n in states.items())),
        ("Frame decided", html.escape(at) if decided else "not decided", "after the first scan" if at != "yes" else ""),
        ("Driven", page.figure(_driven(result), "m", 1), f"in {page.figure(span(result), 's', 1)}"),
        ("Step time, median", shown("step_ms_median"), f"95 % {shown('step_ms_p95')}"),
        ("Real-time factor", shown("real_time_factor"), "recorded time over computing time"),
    ]
    return page.tiles(tiles)


def _label(name: str, value: Any) -> tuple[str, str]:
    """Name and value of a figure as plain text."""
    stem, _, suffix = name.rpartition("_")
    plain = (stem, suffix, -1) if stem and suffix in _UNITS else (name, "", -1)
    label, unit, digits = _FIGURES.get(name, plain)
    label = label[:1].upper() + label[1:].replace("_", " ")
    if isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value):
        return label, f"{value:.{digits}f} {unit}".rstrip() if digits >= 0 else f"{page.text(value)} {unit}".rstrip()
    return label, page.text(value)


def _sections(result: Result, metrics: Mapping[str, Any] | None) -> str:
    """Everything below the map."""
    summary = result.summary
    start = int(result.stamps[0]) if len(result.stamps) else 0
    events = [(f"{(event.stamp - start) / 1e9:.2f}", event.text) for event in result.events]
    dropped = summary.get("dropped") or {}
    plain = [_label(key, value) for key, value in summary.items() if key not in _SHOWN_APART]
    none = '<p class="sub">None.</p>'
    tables = []
    if metrics is not None:
        evaluation = [_label(key, value) for key, value in metrics.items()]
        tables.append(page.section("Errors against the truth", page.table((), evaluation, [1])))
    tables.append(page.section("Run", page.table((), plain, [1]) if plain else '<p class="sub">No summary.</p>'))
    counts = [(str(reason).replace("_", " "), page.text(count)) for reason, count in dropped.items()]
    tables.append(page.section("Dropped measurements", page.table((), counts, [1]) if counts else none))
    happened = f'<div class="tall">{page.table(("Time [s]", "What happened"), events, [0])}</div>'
    settings = summary.get("config")
    text = settings if isinstance(settings, str) else _nested(settings or {})
    folded = f"<section><details><summary>Configuration</summary><pre>{html.escape(text)}</pre></details></section>"
    sections = [
        page.section("Beacons", page.beacon_table(result.beacons)),
        _chart_section(result),
        _residual_section(result),
        page.section("Events", happened if events else none),
        f'<div class="two">{"".join(tables)}</div>',
        folded if text else "",
    ]
    return "".join(sections)


def _nested(table: Mapping[str, Any], indent: str = "") -> str:
    """Nested tables as lines of key = value."""
    lines = []
    for key, value in table.items():
        if isinstance(value, Mapping) and value:
            lines += [f"{indent}[{key}]", _nested(value, indent + "  ")]
        else:
            lines.append(f"{indent}{key} = {page.text(value)}")
    return "\n".join(lines)


def _chart_section(result: Result) -> str:
    shown = diagnostics(result)
    if not shown:
        return ""
    boxes = "".join(
        f'<div><div class="head"><h3>{html.escape(s["name"])} <span>{html.escape(s["unit"])}</span></h3>'
        f'<output></output></div><div data-chart="{k}"></div></div>'
        for k, s in enumerate(shown)
    )
    return page.section("Over time", f'<div class="charts">{boxes}</div>')


def _residual_section(result: Result) -> str:
    """Chart of the residuals, and a table of each pair's."""
    statistics = pair_residuals(result)
    if not statistics:
        return page.section("Range residuals", '<p class="sub">No range was used.</p>')
    kinds = pair_kinds(result, statistics)
    options = "".join(f'<option value="{k}">{a} – {b}</option>' for k, (a, b) in enumerate(statistics))
    rows = []
    for (a, b), r in sorted(statistics.items(), key=lambda item: -_rms(item[1]))[:_PAIRS]:
        median = float(np.median(r))
        spread = 1.4826 * float(np.median(np.abs(r - median)))
        figures = [f"{median:+.3f}", f"{spread:.3f}", f"{_rms(r):.3f}", f"{np.abs(r).max():.3f}"]
        rows.append((f"{a} – {b}", ("robot – beacon", "beacon – beacon")[kinds[a, b]], str(len(r)), *figures))
    head = ("Pair", "Kind", "Count", "Median [m]", "Spread [m]", "RMS [m]", "Largest [m]")
    more = (
        f'<p class="sub">The {_PAIRS} pairs with the largest RMS of {len(statistics)}.</p>'
        if len(rows) < len(statistics)
        else ""
    )
    return page.section(
        "Range residuals",
        '<div class="bar"><span class="sub">Measured minus predicted [m]</span><label class="push">Pair '
        f'<select id="pair"><option value="">all</option>{options}</select></label></div><div id="residuals"></div>'
        '<div class="legend"><span><i style="background: var(--accent)"></i>robot – beacon</span>'
        '<span><i style="background: var(--second)"></i>beacon – beacon</span>'
        "<span>Outliers are drawn at the edge; spread is 1.4826 times the median absolute deviation.</span></div>"
        f'<details style="margin-top: 14px"><summary>Each pair</summary>{more}'
        f'<div class="tall">{page.table(head, rows, range(2, 7))}</div></details>',
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
