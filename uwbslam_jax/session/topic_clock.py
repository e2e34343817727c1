"""What is known of the stamps of one topic, and what a user is told about its clock."""

from __future__ import annotations

from dataclasses import dataclass, field

from uwbslam_jax.measurements import RangeMessage, TruthMessage
from uwbslam_jax.session.clock_drift import ClockDrift

_MANY = 0.2
"""A topic that loses more than this share of its messages is worth a warning [1]."""
_MOST_TOLD = 3
"""So many jumps of a clock are told one by one [warnings]."""


@dataclass(slots=True)
class TopicClock:
    """One topic so far.

    Attributes:
      stamp, log: of its last good message [ns]. shift: what its stamps are moved by [ns].
      usual: difference of moved stamps to the log time [ns]. known: whether a message was good.
      good, bad, bare, twice: messages, those dropped, those without a stamp, those with the stamp of the one before.
      nobodys: of those without a stamp those with one that is no time, before 1970 or from 2038 on.
      rate: how many times as fast as the log its stamps pass if they tell no time, 0 if they are whole seconds; else 1.
      drift: of its clock against that of the others.
      begin: its first stamps. until: those up to it come again; again: so many messages do.
    """

    name: str
    kind: type
    stamp: int = 0
    log: int = 0
    shift: int = 0
    usual: int = 0
    known: bool = False
    good: int = 0
    bad: int = 0
    bare: int = 0
    nobodys: int = 0
    twice: int = 0
    rate: float = 1.0
    drift: ClockDrift = field(default_factory=ClockDrift)
    begin: set[int] = field(default_factory=set)
    until: int = 0
    again: int = 0

    @property
    def last(self) -> int:
        """Difference of the last good message's moved stamp to its log time [ns]."""
        return self.stamp + self.shift - self.log

    def follow(self, most: int) -> None:
        """Takes the last good message in, which may be off by this much [ns]: the usual difference is that of some 64
        messages."""
        self.usual += min(max(self.last - self.usual, -most), most) >> 2

    def told(self) -> dict[object, str]:
        """What is wrong with its stamps by subject, which stays while counts grow; nothing of a truth."""
        told: dict[object, str] = {}
        if self.kind is TruthMessage:
            return told
        heard = self.good + self.bare + self.bad
        if self.again:
            told[self.name, "again"] = (
                f"{self.again} messages of {self.name} come again, stamp for stamp: a recording played in a loop (ros2 "
                "bag play --loop); the repetition is left out"
            )
        if self.rate != 1.0:
            whole = "are whole seconds (or nanosec counts us or ms)"
            how = f"pass {self.rate:.3g} times as fast as the log's" if self.rate else whole
            told[self.name, "rate"] = (
                f"stamps of {self.name} {how}: their log time is taken; are they in another unit (ms, us), or "
                "a counter of the device?"
            )
        if self.drift.rate:
            how = f"{100 * abs(self.drift.rate):.2g} % too {'fast' if self.drift.rate > 0 else 'slow'}"
            told[self.name, "drift"] = (
                f"the clock of {self.name} runs {how} against the others': its stamps are put on theirs; let its "
                "driver stamp with the computer's clock"
            )
        if self.nobodys > _MANY * heard:
            told[self.name, "nobodys"] = (
                f"{self.nobodys} of {heard} messages of {self.name} have stamps before 1970 or after 2038: their log "
                "time is taken; see how its driver fills in the time"
            )
        elif self.bare and self.known:
            told[self.name, "bare"] = (
                f"{self.bare} of {heard} messages of {self.name} have no stamp, or one again and again: their log time "
                "is taken; does its driver wait for a clock (use_sim_time)?"
            )
        if self.kind is not RangeMessage and self.twice > _MANY * heard:
            told[self.name, "twice"] = (
                f"{self.twice} of {heard} messages of {self.name} have the stamp of the one before and are left out: "
                "were two recordings of the same merged, or are the stamps whole seconds?"
            )
        if self.bad > _MANY * heard:
            told[self.name, "bad"] = (
                f"{self.bad} of {heard} messages of {self.name} are dropped: their stamps do not go with those around "
                "them; do two senders on different clocks share the topic?"
            )
        return told


@dataclass(slots=True)
class Jump:
    """A clock was set. change: of the shift [ns]. after: time since the first message [ns]. topics: that jumped."""

    change: int
    after: int
    topics: list[TopicClock]

    @property
    def names(self) -> str:
        """The topics for people: the truth's are no sensor's."""
        told = [own.name for own in self.topics if own.kind is not TruthMessage] or [self.topics[0].name]
        return ", ".join(dict.fromkeys(told))


def told_apart(own: TopicClock, reference: TopicClock | None) -> list[str]:
    """That a topic is on another clock than the one that all are put on; nothing of a truth."""
    if own.kind is TruthMessage or reference is None:
        return []
    way = "behind" if own.shift > 0 else "ahead of"
    return [
        f"stamps of {own.name} are {_span(own.shift)} {way} those of {reference.name}: another clock; they are put on "
        "that one by their log times (synchronise both clocks before recording)"
    ]


def told_pause(length: int, after: int) -> str:
    """That for a time nothing was recorded, and since when [ns]."""
    return (
        f"nothing was recorded for {_span(length)} after {after / 1e9:.1f} s: was the clock set (from 1970, by NTP)? "
        "the run goes on"
    )


def told_jumps(jumps: list[Jump]) -> dict[object, str]:
    """That clocks were set, the first few times one by one."""
    told: dict[object, str] = {
        k: f"stamps of {jump.names} jump {'back' if jump.change > 0 else 'forward'} by {_span(jump.change)} after "
        f"{jump.after / 1e9:.1f} s: a clock was set, or a recording played again; the run goes on without the jump "
        "(synchronise the clock before recording)"
        for k, jump in enumerate(jumps[:_MOST_TOLD])
    }
    more = len(jumps) - _MOST_TOLD
    return told | ({"jumps": f"stamps jump {more} more times"} if more > 0 else {})


def _span(ns: int) -> str:
    """A time in the unit that fits."""
    seconds = abs(ns) / 1e9
    for unit, size in (("years", 31_557_600.0), ("days", 86_400.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds:.2f} s"
