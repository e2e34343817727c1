"""A benchmark's figures: each with unit, direction, tolerance and bar; their tables; and the gate against a baseline.

Only ratios of one run are held against the baseline: seconds are another machine's as soon as it is busy.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np

from benchmarks.tables import RESULTS, cell, line, plain, provenance, write

BASELINE = RESULTS / "baseline.json"


@dataclass(frozen=True)
class Metric:
    """One figure.

    Attributes:
      name: what it is.
      value: the figure, NaN where it could not be had.
      unit: "ms", "s", "MB", "m", "x" for a ratio, "" for a pure number.
      better: which way is good; "" where the figure only describes.
      bar: has to be reached, None where nothing is asked.
      tolerance: how much worse than the baseline's a ratio may be, as a share of it; None: not held against it.
    """

    name: str
    value: float
    unit: str
    better: Literal["lower", "higher", ""] = ""
    bar: float | None = None
    tolerance: float | None = None

    def misses(self, limit: float) -> bool:
        """Whether the figure is worse than a limit; NaN is worse than any."""
        return not (self.value >= limit if self.better == "higher" else self.value <= limit)

    def shortfalls(self, baseline: float | None) -> list[str]:
        """What is wrong with it, in words, against its bar and the baseline's figure."""
        told = []
        if self.bar is not None and self.misses(self.bar):
            told.append(f"{self.name}: {self.value:.3g} {self.unit}, bar {self.bar:g}")
        if baseline is not None and self.tolerance is not None:
            worse = 1.0 - self.tolerance if self.better == "higher" else 1.0 + self.tolerance
            if self.misses(baseline * worse):
                told.append(f"{self.name}: {self.value:.3g} {self.unit}, baseline {baseline:.3g}")
        return told


@dataclass(frozen=True)
class Report:
    """What a benchmark found.

    Attributes:
      title: of the table.
      about: how it was measured, a paragraph.
      metrics: in the order of the table.
      skipped: why there is nothing, "" where there is.
    """

    title: str
    about: str
    metrics: list[Metric]
    skipped: str = ""


def spread(name: str, seconds: np.ndarray | list[float], **asked) -> list[Metric]:
    """Median, 95th and 99th percentile and jitter of times in ms. asked: bars by "median", "p95", "p99"."""
    ms = 1e3 * np.asarray(seconds)
    figures = {"median": np.median(ms), "p95": np.percentile(ms, 95), "p99": np.percentile(ms, 99), "jitter": ms.std()}
    return [
        Metric(f"{name}, {key}", float(value), "ms", "lower", asked.get(key.replace(" ", "_")))
        for key, value in figures.items()
    ]


def exponent(sizes: list[float], times: list[float]) -> float:
    """Slope of times over sizes, both in logarithms: 1 is linear, 3 the cube."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def table(report: Report, facts: dict[str, str]) -> str:
    """The report in Markdown."""
    lines = [f"# {report.title}", "", ", ".join(f"{key} {value}" for key, value in facts.items()) + ".", ""]
    lines += [report.about, ""]
    if report.skipped:
        return "\n".join([*lines, f"Skipped: {report.skipped}."]) + "\n"
    lines += [line(["figure", "value", "unit", "better", "bar", "verdict"]), line(["---", "---:", *["---"] * 4])]
    for m in report.metrics:
        verdict = "-" if m.bar is None else "short of it" if m.misses(m.bar) else "held"
        bar = "-" if m.bar is None else f"{m.bar:g}"
        digits = max(0, 2 - math.floor(math.log10(abs(m.value)))) if m.value and math.isfinite(m.value) else 0
        lines.append(line([m.name, cell(m.value, min(digits, 4)), m.unit, m.better, bar, verdict]))
    return "\n".join(lines) + "\n"


def publish(name: str, report: Report) -> str:
    """Writes the table and the figures of a benchmark and returns the table."""
    # above a load of 1 other work has slowed this down: then only least times and ratios tell something
    facts = provenance(workers=1) | {"machine load": f"{os.getloadavg()[0]:.1f}"}
    text = table(report, facts)
    write(name, text, {"provenance": facts, **plain(asdict(report))})
    return text


def judge(name: str, report: Report, *, renew: bool) -> list[str]:
    """What falls short of bars and baseline, in words; `renew` puts this run's ratios into the baseline instead."""
    known = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.exists() else {}
    if renew and not report.skipped:
        ratios = {m.name: m.value for m in report.metrics if m.tolerance is not None}
        known[name] = {"provenance": provenance(workers=1), "ratios": plain(ratios)}
        BASELINE.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
        return []
    before = known.get(name, {}).get("ratios", {})
    return [told for m in report.metrics for told in m.shortfalls(before.get(m.name))]


def ratio(name: str, value: float, **asked) -> Metric:
    """A ratio of two figures of one run: held against the baseline, within a quarter unless told otherwise."""
    return replace(Metric(name, value, "x", "lower", tolerance=0.25), **asked)
