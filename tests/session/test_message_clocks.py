"""Stamps that clocks, drivers and recorders got wrong: nothing good is lost, what comes out does not go back."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage, ScanMessage, TruthMessage
from uwbslam_jax.session import MessageClocks

T0 = 1_700_000_000_000_000_000
S = 1_000_000_000
HOUR = 3600 * S
TOPICS = {ScanMessage: "/scan", RangeMessage: "/uwb", OdometryMessage: "/odom", TruthMessage: "/truth"}
NO_BEAM = np.zeros(0, np.float32)

Row = tuple[Message, int]
"""A message and its log time [ns]."""


def drive(seconds: float = 20.0) -> list[Row]:
    """Scans at 10 Hz, ranges at 25 Hz and a truth at 5 Hz, each logged some milliseconds later, scans after a sweep."""
    rng = np.random.default_rng(0)
    rows: list[Row] = []
    for k in range(round(10 * seconds)):
        stamp = T0 + k * S // 10
        rows.append((ScanMessage(stamp, 0.0, 0.1, 0.0, 0.1, 30.0, NO_BEAM), stamp + S // 10))
    for k in range(round(25 * seconds)):
        stamp = T0 + k * S // 25 + 7
        rows.append((RangeMessage(stamp, 0, 1, 2.0), stamp + int(rng.integers(S // 50))))
    for k in range(round(5 * seconds)):
        stamp = T0 + k * S // 5 + 11
        rows.append((TruthMessage(stamp, None, 0.0, 0.0, 0.0), stamp + S // 1000))
    return sorted(rows, key=lambda row: row[1])


def moved(rows: list[Row], kind: type, by: int, since: float = -1.0, log: int = 0) -> list[Row]:
    """Stamps of a kind of message (object: of all) moved from a log time on, and log times of all [ns]."""
    late = T0 + round(since * S)
    return [
        (
            dataclasses.replace(m, stamp=m.stamp + by) if isinstance(m, kind) and at > late else m,
            at + log if at > late else at,
        )
        for m, at in rows
    ]


def timed(rows: list[Row], clocks: MessageClocks | None = None, *, log: bool = True) -> list[Message]:
    clocks = clocks or MessageClocks()
    found = [out for m, at in rows for out in clocks.take(m, at if log else None, TOPICS[type(m)])]
    return found + clocks.flush()


def stamps(messages: list[Message], kind: type) -> np.ndarray:
    return np.array([m.stamp for m in messages if isinstance(m, kind)], dtype=np.int64)


def assert_on_time(found: list[Message], rows: list[Row], most: int = S // 20) -> None:
    """Every message of the drive is there, at its time but for what log times tell badly."""
    for kind in (ScanMessage, RangeMessage):
        true = stamps([m for m, _ in rows], kind)
        assert len(stamps(found, kind)) == len(true)
        assert np.abs(stamps(found, kind) - true).max() <= most
        assert (np.diff(stamps(found, kind)) > -most).all()


@pytest.mark.parametrize("log", [True, False])
def test_good_messages_pass_as_they_are_in_their_order(log: bool) -> None:
    rows, clocks = drive(), MessageClocks()
    found = timed(rows, clocks, log=log)
    assert all(a is b for a, (b, _) in zip(found, rows, strict=True))
    assert not clocks.warnings
    assert not clocks.dropped


def test_once_begun_a_good_message_does_not_wait() -> None:
    clocks = MessageClocks()
    for count, (message, at) in enumerate(drive(3.0)):
        found = clocks.take(message, at, TOPICS[type(message)])
        assert count < 30 or found == [message]


@pytest.mark.parametrize("by", [HOUR, -HOUR, 5 * S, -5 * S, 400 * 24 * HOUR])
@pytest.mark.parametrize("kind", [ScanMessage, RangeMessage])
@pytest.mark.parametrize("number", [0, 70, -1])
def test_one_bad_stamp_is_one_message_lost(by: int, kind: type, number: int) -> None:
    rows, clocks = drive(), MessageClocks()
    at = [k for k, (m, _) in enumerate(rows) if isinstance(m, kind)][number]
    bad = list(rows)
    bad[at] = dataclasses.replace(rows[at][0], stamp=rows[at][0].stamp + by), rows[at][1]
    del rows[at]
    found = timed(bad, clocks)
    assert [m for m in found if not isinstance(m, TruthMessage)] == [
        m for m, _ in rows if not isinstance(m, TruthMessage)
    ]
    assert clocks.dropped.total() == 1


@pytest.mark.parametrize("by", [-60 * S, -S, HOUR, -400 * 24 * HOUR, 400 * 24 * HOUR])
def test_a_clock_that_is_set_loses_nothing_and_is_told(by: int) -> None:
    rows, clocks = drive(), MessageClocks()
    assert_on_time(timed(moved(rows, object, by, 10.0), clocks), rows)
    assert not clocks.dropped
    (told,) = clocks.warnings
    assert "/scan" in told
    assert "/uwb" in told
    assert ("back" if by < 0 else "forward") in told


def test_the_clock_of_one_topic_is_set() -> None:
    rows = drive()
    for kind in (ScanMessage, RangeMessage):
        clocks = MessageClocks()
        assert_on_time(timed(moved(rows, kind, -60 * S, 10.0), clocks), rows)
        assert len(clocks.warnings) == 1


def test_the_recorders_clock_is_set_back_with_the_stamps() -> None:
    rows, clocks = drive(), MessageClocks()
    assert_on_time(timed(moved(rows, object, -60 * S, 10.0, log=-60 * S), clocks), rows)
    assert "back by 60.0" in clocks.warnings[0] or "back by 59.9" in clocks.warnings[0]


def test_a_pause_stays_and_only_a_long_one_is_told() -> None:
    for pause, told in ((600 * S, 0), (HOUR, 0), (10 * 365 * 24 * HOUR, 1)):
        rows, clocks = moved(drive(), object, pause, 10.0, log=pause), MessageClocks()
        assert timed(rows, clocks) == [m for m, _ in rows]
        assert len(clocks.warnings) == told


@pytest.mark.parametrize("by", [3 * HOUR, -3 * HOUR, -T0 + 5 * S, 3 * S])
def test_a_topic_on_another_clock_is_put_on_the_scans(by: int) -> None:
    rows = drive()
    for kind, told in ((RangeMessage, "/uwb"), (TruthMessage, None)):
        clocks = MessageClocks()
        assert_on_time(timed(moved(rows, kind, by), clocks), rows, S // 5)
        assert len(clocks.warnings) == (told is not None)
        assert told is None or f"stamps of {told} are" in clocks.warnings[0]
    clocks = MessageClocks()
    found = timed(moved(rows, ScanMessage, by), clocks)
    assert abs(stamps(found, RangeMessage)[100] - stamps(found, ScanMessage)[40]) < S // 5
    assert (stamps(found, ScanMessage) == stamps([m for m, _ in rows], ScanMessage) + by).all()
    assert clocks.offsets["/scan"] == pytest.approx(by / 1e9 - 0.1)


def test_messages_without_a_stamp_are_at_their_log_time_on_the_common_clock() -> None:
    """Simulated time, and drivers that wait for its clock."""
    rows, clocks = moved(drive(), object, -T0 + S), MessageClocks()
    first = [next(k for k, (m, _) in enumerate(rows) if isinstance(m, kind)) for kind in (ScanMessage, RangeMessage)]
    bare = [(dataclasses.replace(m, stamp=0), at) if k in first else (m, at) for k, (m, at) in enumerate(rows)]
    assert_on_time(timed(bare, clocks), rows, S // 5)
    assert len(clocks.warnings) == 2
    assert all("no stamp" in told for told in clocks.warnings)


def test_a_topic_that_never_has_a_stamp_is_no_fault() -> None:
    rows, clocks = drive(), MessageClocks()
    bare = [(dataclasses.replace(m, stamp=0), at) if isinstance(m, RangeMessage) else (m, at) for m, at in rows]
    found = timed(bare, clocks)
    assert stamps(found, RangeMessage).tolist() == [at for m, at in rows if isinstance(m, RangeMessage)]
    assert not clocks.warnings
    assert clocks.offsets["/uwb"] is None


def test_a_stamp_that_stands_still_is_none() -> None:
    rows, clocks = drive(), MessageClocks()
    stuck = [(dataclasses.replace(m, stamp=T0), at) if isinstance(m, ScanMessage) else (m, at) for m, at in rows]
    found = stamps(timed(stuck, clocks), ScanMessage)
    assert (np.abs(found - stamps([m for m, _ in rows], ScanMessage))[10:] < S // 5).all()
    assert "again and again" in clocks.warnings[0]


def test_a_recording_played_in_a_loop_is_taken_once() -> None:
    rows, clocks = drive(), MessageClocks()
    again = [(m, at + 20 * S * k) for k in range(3) for m, at in rows]
    assert timed(again, clocks) == [m for m, _ in rows]
    assert clocks.dropped["scan: recorded before, in a loop"] == 400
    assert sorted(told.split(" messages of ")[1].split()[0] for told in clocks.warnings) == ["/scan", "/uwb"]


def test_two_recordings_of_the_same_are_told() -> None:
    clocks = MessageClocks()
    timed([(m, at + k) for m, at in drive() for k in range(2) if not k or isinstance(m, ScanMessage)], clocks)
    assert [told for told in clocks.warnings if "200 of 400 messages of /scan" in told] == clocks.warnings


def test_a_log_that_was_written_later_tells_nothing() -> None:
    rows = moved(drive(), object, 30 * S, 10.0, log=30 * S)
    for log in ([T0] * len(rows), [T0 + (at - T0) // 10 for _, at in rows], [T0 + 3 * (at - T0) for _, at in rows]):
        clocks = MessageClocks()
        found = timed([(m, at) for (m, _), at in zip(rows, log, strict=True)], clocks)
        assert found == [m for m, _ in rows]


def test_a_recorder_that_stalls_loses_nothing() -> None:
    """Eight seconds of messages are logged at once, and then some were lost."""
    rows = [(m, max(at, T0 + 13 * S) if at > T0 + 5 * S else at) for m, at in drive()]
    rows = [(m, at) for m, at in rows if not 9 * S < m.stamp - T0 < 12 * S]
    clocks = MessageClocks()
    assert timed(rows, clocks) == [m for m, _ in rows]
    assert not clocks.warnings


@pytest.mark.parametrize("by", [-60 * S, 400 * 24 * HOUR])
def test_without_log_times_the_run_goes_on_after_a_clock_was_set(by: int) -> None:
    rows, clocks = drive(), MessageClocks()
    found = timed(moved(rows, object, by, 10.0), clocks, log=False)
    assert len(found) == len(rows)
    for kind in (ScanMessage, RangeMessage):
        step = np.diff(stamps(found, kind))
        assert (step > -S // 5).all()
        assert np.sum(step > S // 2) == (by > 0)
    assert clocks.warnings


def test_junk_does_no_harm() -> None:
    rng, clocks = np.random.default_rng(1), MessageClocks()
    rows: list[Row] = []
    for m, at in drive():
        junk = [0, -5, 2**31 * S, 1 << 70, -(1 << 70), m.stamp + 7 * S, m.stamp - 9 * S, int(rng.integers(2 * T0))]
        bad = not isinstance(m, TruthMessage) and rng.random() < 0.1
        rows.append((dataclasses.replace(m, stamp=junk[rng.integers(len(junk))]), at) if bad else (m, at))
    found = timed(rows, clocks)
    assert len(found) + clocks.dropped.total() == len(rows)
    for kind, least in ((ScanMessage, 180), (RangeMessage, 450)):
        known = stamps(found, kind)
        assert len(known) >= least
        assert T0 - S < known.min() <= known.max() < T0 + 21 * S
    assert len(timed(rows, log=False)) > 0


def test_what_is_told_keeps_its_subject_while_its_counts_grow() -> None:
    """A live run tells each subject once."""
    clocks, subjects, lines = MessageClocks(), set(), set()
    for k, (message, log) in enumerate(drive()):
        bare = isinstance(message, RangeMessage) and k > 200
        clocks.take(dataclasses.replace(message, stamp=0) if bare else message, log, TOPICS[type(message)])
        subjects |= set(clocks.told())
        lines |= set(clocks.warnings)
    assert subjects == {("/uwb", "bare")}
    assert len(lines) > 100


@pytest.mark.parametrize("stamped", [False, True])
def test_a_log_time_that_is_nobodys_says_nothing(stamped: bool) -> None:
    rows = drive()
    message, _ = rows[200]
    rows[200] = message if stamped else dataclasses.replace(message, stamp=0), 2**64 - 1
    clocks = MessageClocks()
    wanted = [m for m, _ in drive()]
    assert timed(rows, clocks) == (wanted if stamped else [m for m in wanted if m is not wanted[200]])
    assert clocks.dropped.total() == (0 if stamped else 1)
    assert clocks.warnings == []
