"""Figures of the benchmarks: bars, the gate against a baseline, exponents."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks import metric
from benchmarks.metric import Metric, Report, exponent, judge, ratio, spread, table


@pytest.mark.parametrize(
    ("value", "better", "bar", "wrong"),
    [(1.0, "lower", 2.0, False), (3.0, "lower", 2.0, True), (3.0, "higher", 2.0, False), (1.0, "higher", 2.0, True)],
)
def test_a_bar_is_held_or_missed_by_its_direction(value, better, bar, wrong):
    assert bool(Metric("m", value, "ms", better, bar).shortfalls(None)) == wrong


def test_a_figure_that_could_not_be_had_misses_its_bar():
    assert Metric("m", math.nan, "ms", "lower", 1.0).shortfalls(None)
    assert Metric("m", math.nan, "x", "higher", 1.0).shortfalls(None)


def test_the_gate_holds_ratios_against_the_baseline_and_nothing_else():
    assert not ratio("m", 1.2).shortfalls(1.0)
    assert ratio("m", 1.3).shortfalls(1.0)
    assert ratio("m", 0.7, better="higher").shortfalls(1.0)
    assert not ratio("m", 0.8, better="higher").shortfalls(1.0)
    assert not Metric("m", 9.0, "ms", "lower").shortfalls(1.0)


def test_a_baseline_is_written_read_and_missed(tmp_path, monkeypatch):
    monkeypatch.setattr(metric, "BASELINE", tmp_path / "baseline.json")
    report = Report("t", "a", [ratio("m", 1.0), Metric("s", 2.0, "s")])
    assert judge("n", report, renew=False) == []  # nothing is known yet
    assert judge("n", report, renew=True) == []
    worse = Report("t", "a", [ratio("m", 1.5), Metric("s", 20.0, "s")])
    assert len(judge("n", worse, renew=False)) == 1
    assert judge("other", worse, renew=False) == []


def test_a_table_tells_unit_bar_and_verdict_or_why_there_is_none():
    told = table(Report("Title", "How.", [Metric("m", 0.1234, "ms", "lower", 0.1)]), {"commit": "abc"})
    assert "| m | 0.123 | ms | lower | 0.1 | short of it |" in told
    assert "Skipped: no card." in table(Report("Title", "How.", [], skipped="no card"), {})


def test_exponents_and_spreads():
    assert exponent([1.0, 2.0, 4.0], [3.0, 24.0, 192.0]) == pytest.approx(3.0)
    figures = {m.name: m.value for m in spread("t", np.arange(1, 101) / 1e3)}
    assert figures["t, median"] == pytest.approx(50.5)
    assert figures["t, p95"] == pytest.approx(95.05)
