"""Messages on one clock: stamps that clocks, drivers and recorders got wrong are mended before frames are made.

Between two messages of a topic the difference of stamp and log time hardly changes. Where it does, the message alone is
wrong and is dropped, or its clock was set and the stamps go on by the log time. A topic on a clock of its own is put on
that of the scans. What is in doubt waits, with all behind it, until what follows tells: order and good stamps stay.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from statistics import median_low
from types import MappingProxyType
from typing import NamedTuple

from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage, ScanMessage, TruthMessage
from uwbslam_jax.reasons import OdometryLost, RangeLost, ScanLost
from uwbslam_jax.session.topic_clock import Jump, TopicClock, told_apart, told_jumps, told_pause

_NEAR = 500_000_000
"""A stamp that follows the one before within this, or whose difference to the log time changes by no more, is in no
doubt [ns]: a recorder that stalls delays messages by less, or delays many one after the other."""
_SAME = 1_000_000_000
"""Topics whose differences to the log time are apart by less are on one clock [ns]: a sweep and its way to the recorder
take some of that."""
_DAY, _HOUR = 86_400_000_000_000, 3_600_000_000_000
"""A pause of more than a day is worth a word; without log times, one of up to an hour is in no doubt [ns]."""
_LOG_BACK = 1_000_000_000
"""Log times that go back by more tell that the recorder's clock was set back [ns]; writers' queues mix up less."""
_ABSURD = (1 << 31) * 1_000_000_000
"""Stamps from here on are nobody's [ns]: the year 2038, where the seconds of ROS end."""
_AGREE, _MOST_DOUBTED = 2, 5
"""So many later messages of a topic that agree with one tell that its clock was set; after so many that agree with
nothing it is dropped [messages]."""
_WAIT, _WAIT_MESSAGES = 2_000_000_000, 4096
"""What is in doubt waits for so long by the log, and behind so many messages, at most [ns, messages]."""
_START = 1_000_000_000
"""So long at most scans are waited for, on whose clock all is put [ns]."""
_SELDOM = 15
"""Of 16 messages in no doubt one tells the usual difference to the log time anew [bits of the count]."""
_DRIFT = 0.1
"""A log whose time passes otherwise than the stamps by more than this share tells no pauses [1]: it was written later,
or the recording played at another speed."""
_BEGIN = 16
"""Where some of a topic's first so many stamps come again, a recording is played in a loop; so many also tell its usual
difference to the log time [messages]."""
_RECENT = 8
"""So many jumps of other topics may be this one's too [jumps]."""
_LOST: dict[type, type[ScanLost | RangeLost | OdometryLost]] = {
    ScanMessage: ScanLost,
    RangeMessage: RangeLost,
    OdometryMessage: OdometryLost,
}
"""What drops are counted as [message type -> reasons]; what is not here is ground truth."""
_RANK = [ScanMessage, OdometryMessage, RangeMessage, TruthMessage]
"""Whose clock all others are put on: the first of these that is heard [message types]."""


class _Held(NamedTuple):
    """A message that waits, its stamp, its log time on a clock that never jumps [ns], its topic."""

    message: Message
    stamp: int
    log: int | None
    own: TopicClock

    @property
    def bare(self) -> bool:
        """Whether a message that was logged says no time: none, nobody's, or again and again the same."""
        if self.log is None:
            return False
        own = self.own
        stuck = own.known and self.stamp == own.stamp and abs(self.off + own.shift - own.usual) > _NEAR
        return stuck or own.rate != 1.0 or not 0 < self.stamp < _ABSURD

    @property
    def off(self) -> int:
        """Stamp less log time [ns]."""
        return self.stamp - (self.log or 0)

    def near(self, other: _Held) -> bool:
        """Whether a later message of the same topic is on the same clock."""
        step = other.stamp - self.stamp
        if self.log is None or other.log is None:
            return -_NEAR <= step <= _HOUR
        return 0 <= step <= _NEAR or abs(other.off - self.off) <= _NEAR


class MessageClocks:
    """Takes messages in the order of their arrival, gives them back with stamps on one clock.

    Good messages are handed on as they are, at once but for the first few. Stamps that come out do not go back where a
    clock was set.

    Attributes:
      dropped: what was not given back, by reason.
    """

    def __init__(self, dropped: Counter[str] | None = None, rates: Mapping[str, float] = MappingProxyType({})):
        """Nothing has come yet.

        Args:
          dropped: where losses are counted, a counter of its own if not given.
          rates: topics whose stamps tell no time, and how many times as fast as the log's they pass.
        """
        self.dropped: Counter[str] = Counter() if dropped is None else dropped
        self._topics: dict[str, TopicClock] = {}
        self._rates = rates
        self._held: deque[_Held] = deque()
        self._reference: TopicClock | None = None
        self._newest: TopicClock | None = None  # the last good message's, not of the truth
        self._out = 0  # the latest stamp given back
        self._jumps: list[Jump] = []
        self._apart: list[str] = []
        self._first: tuple[int, int] | None = None  # stamp given back and log time
        self._paused: tuple[int, int] | None = None  # the longest pause over a day, and what was given back before
        self._raw_log = 0
        self._leap = 0  # from the log's time to one that does not go back

    def take(self, message: Message, log_time: int | None, topic: str) -> list[Message]:
        """What a message leads to: itself, nothing while it is in doubt, or those that waited for it.

        Args:
          message: its stamp 0 or less where it has none.
          log_time: when it arrived [ns], None where nobody knows: then only what goes back, or an hour ahead, is seen.
        """
        own = self._topics.get(topic)
        if own is None:
            own = self._topics[topic] = TopicClock(topic, type(message), rate=self._rates.get(topic, 1.0))
        if own.drift.rate:
            message = replace(message, stamp=own.drift.even(message.stamp))
        stamp = message.stamp
        if log_time is not None and log_time < _ABSURD:  # else it is nobody's
            if log_time < self._raw_log - _LOG_BACK:
                self._leap += self._raw_log - log_time
            self._raw_log = log_time
            log_time += self._leap
        elif -_ABSURD < stamp < _ABSURD:
            log_time = None
        else:
            self._drop(own)
            return []
        # nearly all messages: what `_good` does, as far as it is to be done here
        if 0 < stamp - own.stamp <= _NEAR and own.good >= _BEGIN and not self._held:
            own.stamp = stamp
            own.good += 1
            if log_time is not None:
                own.log = log_time
                if not own.good & _SELDOM:
                    own.follow(_NEAR)
                    self._watch(own)
            if own.kind is not TruthMessage:
                self._newest = own
                if stamp + own.shift > self._out:
                    self._out = stamp + own.shift
            return [replace(message, stamp=stamp + own.shift) if own.shift else message]
        self._held.append(_Held(message, stamp, log_time, own))
        return list(self._settled(ended=False))

    def _watch(self, own: TopicClock) -> None:
        """Looks whether a topic's clock runs as fast as the one that all are put on."""
        reference = self._reference
        if reference is None or own is reference or own.kind is TruthMessage:
            return
        if min(own.good, reference.good) >= _BEGIN:
            change = own.drift.look(min(own.begin), own.stamp, own.usual - reference.usual)
            own.stamp += change
            own.usual += change

    def flush(self) -> list[Message]:
        """What still waits, at the end of the messages."""
        return list(self._settled(ended=True))

    @property
    def offsets(self) -> dict[str, float | None]:
        """Topic -> usual difference of its own stamps to the log time [s], None where it has no stamps."""
        return {t.name: (t.usual - t.shift) / 1e9 if t.known else None for t in self._topics.values()}

    @property
    def warnings(self) -> list[str]:
        """What was wrong with clocks so far, one line each."""
        return list(self.told().values())

    def told(self) -> dict[object, str]:
        """The same by subject: a line may change as counts grow, what it is about does not."""
        told: dict[object, str] = {line: line for line in self._apart}
        if self._paused is not None and self._first is not None:
            told["pause"] = told_pause(self._paused[0], self._paused[1] - self._first[0])
        told |= told_jumps(self._jumps)
        for own in self._topics.values():
            told |= own.told()
        return told

    def _good(self, own: TopicClock, message: Message, stamp: int, log: int | None) -> Message:
        """A message with its stamp on the common clock; its topic goes on from it."""
        out = stamp + own.shift
        own.twice += own.known and stamp == own.stamp
        own.stamp = stamp
        if log is not None:
            own.log = log
            own.usual = own.usual if own.known else own.last
        own.known = True
        own.good += 1
        if own.good <= _BEGIN:
            own.begin.add(stamp)
        if own.kind is not TruthMessage or own is self._reference:
            self._newest = own
            if self._first is None:
                self._first, self._out = (out, log or 0), out
            if out - self._out > max(_DAY, (self._paused or (0, 0))[0]):
                self._paused = out - self._out, self._out
            self._out = max(out, self._out)
        return replace(message, stamp=out) if own.shift else message

    def _drop(self, own: TopicClock, *, again: bool = False) -> None:
        own.again += again
        own.bad += not again
        lost = _LOST.get(own.kind)
        reason = (lost.AGAIN if again else lost.APART) if lost else "ground truth: stamp apart or in a loop"
        self.dropped[reason] += 1

    def _settled(self, *, ended: bool) -> Iterator[Message]:
        """What need not wait any longer."""
        while self._held:
            if self._reference is None and not self._refer(ended=ended):
                return
            held = self._held[0]
            if 0 < held.stamp <= held.own.until:
                self._held.popleft()
                self._drop(held.own, again=True)
                continue
            if held.bare:
                self._held.popleft()
                yield self._bare(held)
                continue
            verdict = self._fits(held) or self._shifted(held) or self._judged(held, ended=ended)
            if verdict is None:
                return
            self._held.popleft()
            if verdict:
                yield self._good(held.own, held.message, held.stamp, held.log)
            else:
                self._drop(held.own, again=0 < held.stamp <= held.own.until)

    def _refer(self, *, ended: bool) -> bool:
        """Whether it is known on whose clock all is put: the scans', or that of the best there is once these had time
        to come."""
        first, last = self._held[0], self._held[-1]
        over = ended or len(self._held) > _WAIT_MESSAGES
        if last.log is None or first.log is None:
            over = True  # nothing tells how the clocks of two topics differ
        elif last.log - first.log > _START:
            over = True
        for kind in _RANK if over else _RANK[:1]:
            for own in self._topics.values():
                if own.kind is kind and self._begin(own, alone=over):
                    return True
        if over:  # no stamp agrees with another: the log's own time
            self._reference = first.own
        return over

    def _begin(self, own: TopicClock, *, alone: bool) -> bool:
        """Makes a topic's clock that of all if enough of its messages agree with each other; alone: one will do."""
        stamped = [h for h in self._held if h.own is own and not h.bare]
        for held in stamped:
            agree = [h for h in stamped if held.near(h)]
            if len(agree) > _AGREE or (alone and len(agree) == len(stamped)):
                self._reference = own
                own.usual = median_low([h.off for h in agree])
                return True
        return False

    def _common(self) -> int:
        """Usual difference of stamps and log time now [ns]."""
        own = self._newest or self._reference
        return 0 if own is None else own.last if own.known else own.usual

    def _bare(self, held: _Held) -> Message:
        """A message without a stamp: at its log time, on the clock of the others."""
        own = held.own
        off = own.usual if own.known else self._common()
        own.bare += 1
        own.nobodys += held.stamp < 0 or held.stamp >= _ABSURD
        # a message that says no time has been on its way, as those that do: no difference is worth less than that
        stamp = (held.log or 0) + (off if own.known or abs(off) > _SAME else 0)
        return held.message if held.message.stamp == stamp else replace(held.message, stamp=stamp)

    def _fits(self, held: _Held) -> bool:
        """Whether a message goes on from those before."""
        own = held.own
        if not own.known:
            return held.log is None and (self._first is None or abs(held.stamp - self._out) <= _HOUR)
        step = held.stamp - own.stamp
        if held.log is None:
            return -_NEAR <= step <= _HOUR
        off = held.off + own.shift
        return 0 < step <= _NEAR or any(abs(off - usual) <= _NEAR for usual in (own.usual, own.last, self._common()))

    def _shifted(self, held: _Held) -> bool:
        """Whether a message fits once it is moved as others were: the clock of several topics was set."""
        own = held.own
        if held.log is None:
            goal = None if self._first is None else self._out - held.stamp
            near = _HOUR if not own.known else _SAME
        else:
            goal, near = (own.last if own.known else self._common()) - held.off, _NEAR if own.known else _SAME
        if goal is None:
            return False
        if not own.known:
            shifts = {0: None} | {t.shift: None for t in self._topics.values() if t.known}
            found = next((shift for shift in shifts if abs(shift - goal) <= near), None)
            if found is not None:
                own.shift = found
                others = [t for t in self._topics.values() if t.known and t.shift == found]
                if found and all(t.kind is TruthMessage for t in others):  # of which nothing was told
                    self._apart += told_apart(own, self._reference)
            return found is not None
        for jump in self._jumps[: -1 - _RECENT : -1]:
            if abs(own.shift + jump.change - goal) <= near:
                own.shift += jump.change
                jump.topics.append(own)
                return True
        return False

    def _judged(self, held: _Held, *, ended: bool) -> bool | None:
        """Whether a message that fits nowhere is good after all, as what follows tells; None while it does not."""
        own = held.own
        if isinstance(held.message, TruthMessage) and held.message.node is not None:
            return True  # where a beacon stood may have been told hours ago
        later = [h for h in self._held if h.own is own and h is not held and not h.bare]
        if any(self._fits(h) or (not own.known and self._on_common(h)) for h in later):
            return False
        agree = [h for h in later if held.near(h)]
        if len(agree) >= _AGREE and len(own.begin & {h.stamp for h in [held, *agree]}) >= _AGREE:
            own.until = own.stamp
            return False
        if len(agree) >= _AGREE:
            self._set([held, *agree[:_AGREE]])
            return True
        last = self._held[-1]
        waited = 0 if held.log is None or last.log is None else last.log - held.log
        over = ended or len(later) >= _MOST_DOUBTED or waited > _WAIT or len(self._held) > _WAIT_MESSAGES
        return False if over else None

    def _on_common(self, held: _Held) -> bool:
        return held.log is not None and abs(held.off - self._common()) <= _SAME

    def _set(self, agree: list[_Held]) -> None:
        """A topic's clock was set, or is another one from the start: what it is moved by from now on."""
        held = agree[0]
        own, before = held.own, held.own.shift
        if not own.known and held.log is not None:
            own.shift = self._common() - median_low([h.off for h in agree])
            self._apart += told_apart(own, self._reference)
        elif not own.known:
            own.shift = self._out - held.stamp
            self._apart += told_apart(own, self._reference)
        else:
            own.shift = self._goes_on(own, agree)
        if own.known and own.shift != before:
            after = self._out - (self._first or (0, 0))[0]
            self._jumps.append(Jump(own.shift - before, after, [own]))

    def _goes_on(self, own: TopicClock, agree: list[_Held]) -> int:
        """What a topic whose clock was set is moved by: the log tells how much time has passed. Where it does not, a
        step ahead is a pause, and stamps that went back go on after the last one."""
        held, after = agree[:2]
        if held.log is not None and self._log_tells(own):
            return own.usual - median_low([h.off for h in agree])
        if held.stamp > own.stamp:
            return own.shift
        return self._out + max(after.stamp - held.stamp, 1) - held.stamp

    def _log_tells(self, own: TopicClock) -> bool:
        """Whether time has passed in the log as in the stamps."""
        if self._first is None:
            return False
        passed, logged = own.stamp + own.shift - self._first[0], own.log - self._first[1]
        return abs(passed - logged) <= _DRIFT * max(passed, logged) + _SAME
