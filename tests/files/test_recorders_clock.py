"""A recorder whose clock was set back, and what `inspect` and the result say of clocks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from uwbslam_jax.files import LogWriter, Recording, inspect_log
from uwbslam_jax.files.mcap_container import McapFile
from uwbslam_jax.measurements import Message, RangeMessage, ScanMessage

T0 = 1_700_000_000_000_000_000
S = 1_000_000_000


def messages(seconds: int = 30) -> list[Message]:
    walls = np.linspace(1.0, 4.0, 900, dtype=np.float32)
    scans = [ScanMessage(T0 + k * S // 10, 0.0, 0.005, 0.0, 0.1, 30.0, walls) for k in range(10 * seconds)]
    ranges = [RangeMessage(T0 + 5 + k * S // 20, 0, 1 + k % 3, 2.0) for k in range(20 * seconds)]
    return sorted([*scans, *ranges], key=lambda m: m.stamp)


def write(path: Path, rows: list[tuple[Message, int]]) -> Path:
    with LogWriter(path) as writer:
        for message, log_time in rows:
            writer.write(message, log_time)
    return path


@pytest.mark.parametrize("back", [5, 60])
@pytest.mark.parametrize("seconds", [3, 30])  # one chunk, and several
def test_what_was_recorded_after_the_clock_was_set_back_comes_after(tmp_path: Path, back: int, seconds: int) -> None:
    kept = messages(seconds)
    since = T0 + seconds * S // 2
    rows = [
        (m, m.stamp) if m.stamp < since else (dataclasses.replace(m, stamp=m.stamp - back * S), m.stamp - back * S)
        for m in kept
    ]
    path = write(tmp_path / "back.mcap", rows)
    reader = Recording(path)
    found = list(reader)
    assert len(found) == len(kept)
    assert all(type(a) is type(b) and abs(a.stamp - b.stamp) < S // 10 for a, b in zip(found, kept, strict=True))
    assert [f"jump back by {back}" in told or f"jump back by {back - 1}.9" in told for told in reader.warnings] == [
        True
    ]
    assert list(reader) is not found
    assert len(reader.warnings) == 1  # not once for every reading


def test_messages_out_of_order_are_put_in_order(tmp_path: Path) -> None:
    kept = messages(10)
    mixed = [(kept[k], kept[k].stamp) for k in np.random.default_rng(0).permutation(len(kept))]
    by_topic = [(m, m.stamp) for kind in (ScanMessage, RangeMessage) for m in kept if isinstance(m, kind)]
    for rows in (mixed, by_topic):
        found = list(McapFile(write(tmp_path / "mixed.mcap", rows)).records())
        assert [raw.log_time for raw in found] == [m.stamp for m in kept]


def test_inspect_tells_how_far_stamps_are_from_the_log(tmp_path: Path) -> None:
    rows = [
        (dataclasses.replace(m, stamp=m.stamp - 7200 * S) if isinstance(m, RangeMessage) else m, m.stamp)
        for m in messages(3)
    ]
    found = inspect_log(write(tmp_path / "off.mcap", rows))
    assert {topic.name: topic.offset for topic in found.topics} == {"/scan": 0.0, "/uwb/ranges": -7200.0}
    assert [problem for problem in found.problems if "/uwb/ranges are 2.0 h behind those of /scan" in problem]
    assert "-7200.00" in str(found)
