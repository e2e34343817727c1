"""A radio whose clock runs fast: its stamps are put on the others' clock, and those that are only late are left."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from uwbslam_jax.measurements import Message, RangeMessage, ScanMessage
from uwbslam_jax.session import MessageClocks

T0, MS = 1_700_000_000_000_000_000, 1_000_000
NOTHING = np.zeros(2, np.float32)


def heard(ranged_at: Callable[[int], int], late: Callable[[int], int], seconds: int = 60) -> tuple[list, list[str]]:
    """How far the stamps that come out are from the times that they are of [ns], and what is told.

    Args:
      ranged_at: from the time since the start to what the radio's clock says of it [ns].
      late: from that time to how long a range is on its way to the log [ns].
    """
    rng = np.random.default_rng(0)
    rows: list[tuple[int, int, Message, str]] = []
    for k in range(seconds * 1000 // 25):
        at = 25 * MS * k
        stamp = T0 + ranged_at(at)
        log = T0 + at + late(at) + int(rng.exponential(5 * MS))
        rows.append((log, at, RangeMessage(stamp, 0, 1 + k % 3, float(k)), "/uwb/ranges"))
        if k % 4 == 0:
            log = T0 + at + 100 * MS + int(rng.exponential(5 * MS))
            rows.append((log, at, ScanMessage(T0 + at, 0.0, 0.1, 0.0, 0.1, 30.0, NOTHING), "/scan"))
    clocks, out = MessageClocks(), []
    for log, _, message, topic in sorted(rows, key=lambda row: row[0]):
        out += clocks.take(message, log, topic)
    out += clocks.flush()
    ranges = [m for m in out if isinstance(m, RangeMessage)]
    return [m.stamp - T0 - 25 * MS * round(m.range) for m in ranges], clocks.warnings


@pytest.mark.parametrize("rate", [0.01, -0.01, 0.002])
def test_a_clock_that_drifts_is_told_and_taken_back(rate: float) -> None:
    apart, told = heard(lambda at: at + round(rate * at), lambda at: 0)
    assert f"% too {'fast' if rate > 0 else 'slow'} against the others'" in told[0]
    assert len(told) == 1
    assert np.abs(apart).max() < 160 * MS
    assert np.abs(apart[len(apart) // 2 :]).max() < 30 * MS


@pytest.mark.parametrize(
    "late",
    [
        lambda at: 0,
        lambda at: 300 * MS * (at > 20_000 * MS),
        lambda at: 300 * MS * (20_000 * MS < at < 25_000 * MS),
        lambda at: round(150 * MS * np.sin(at / 5e9)),
    ],
    ids=["good", "a step", "a stall", "to and fro"],
)
def test_messages_that_are_on_their_way_for_longer_are_of_no_other_clock(late: Callable[[int], int]) -> None:
    apart, told = heard(lambda at: at, late)
    assert told == []
    assert not any(apart)
