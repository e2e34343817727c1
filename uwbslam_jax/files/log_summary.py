"""What a recording holds, for a person: topics with their rates and gaps, nodes heard, what is missing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.bag import Bag, Source
from uwbslam_jax.files.first_look import look_first
from uwbslam_jax.files.first_ranges import look_ahead
from uwbslam_jax.files.log_facts import LogFacts
from uwbslam_jax.files.log_order import Logged, in_order, told as told_late
from uwbslam_jax.files.mcap_log import choose_topics, left_out
from uwbslam_jax.files.mounting import Mounting, read_mounting
from uwbslam_jax.files.range_messages import Options, names_told
from uwbslam_jax.files.schemas import Decoder, Role
from uwbslam_jax.session import MessageClocks
from uwbslam_jax.settings import UwbSettings


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a recording.

    Attributes:
      name, schema: of the topic.
      role: "scan", "uwb", "odom", "truth", None where it is not used.
      count: messages.
      rate: messages per second between its first and its last [Hz], NaN for fewer than two.
      largest_gap: longest time between two of its messages, by log time [s], NaN for fewer than two.
      offset: usual difference of its stamps to the log times [s], NaN where it is not used or has no stamps.
    """

    name: str
    schema: str
    role: str | None
    count: int
    rate: float
    largest_gap: float
    offset: float = math.nan


@dataclass(frozen=True, slots=True)
class LogSummary:
    """What a recording holds.

    Attributes:
      name: what it is called.
      duration: from its first to its last message [s].
      topics: every topic, by name.
      ids: exchanges each node took part in, by id.
      pairs: exchanges by pair of ids, the smaller first.
      powers: whether the ranges report both powers.
      odometry, ground_truth: whether there is any.
      beams: most beams of a scan.
      dropped: messages left out, by reason.
      mounting: where the sensors sit, as far as the recording tells.
      problems: what keeps the recording from being used, or is mended with a warning; one line each.
      notes: what is worth knowing, one line each.
      truncated: where it breaks, None where it does not.
    """

    name: str
    duration: float
    topics: list[TopicSummary]
    ids: dict[int, int]
    pairs: dict[tuple[int, int], int]
    powers: bool
    odometry: bool
    ground_truth: bool
    beams: int
    dropped: Counter[str]
    mounting: Mounting
    problems: list[str]
    notes: list[str]
    truncated: str | None

    def __str__(self) -> str:
        """Text of several lines, units in the column heads."""
        lines = [f"{self.name}: {self.duration:.1f} s"]
        rows = [("topic", "role", "messages", "rate [Hz]", "largest gap [s]", "stamp - log [s]", "type")]
        for topic in self.topics:
            times = topic.rate, topic.largest_gap, topic.offset
            rate, gap, offset = ("-" if math.isnan(v) else f"{v:.2f}" for v in times)
            rows.append((topic.name, topic.role or "-", str(topic.count), rate, gap, offset, topic.schema))
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        for row in rows:
            cells = [
                c.rjust(w) if 2 <= k <= 5 else c.ljust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))
            ]
            lines.append("  " + "  ".join(cells).rstrip())
        if self.beams:
            lines.append(f"beams a scan: {self.beams}")
        if self.pairs:
            lines.append("nodes heard: " + ", ".join(f"{node} ({count})" for node, count in self.ids.items()))
            nodes = len(self.ids)
            lines.append(f"pairs heard: {len(self.pairs)} of {nodes * (nodes - 1) // 2}: " + _pairs(self.pairs))
            lines.append(f"powers: {'reported' if self.powers else 'not reported: NLOS by residuals only'}")
        lines.append(f"odometry: {'yes' if self.odometry else 'no'}")
        lines.append(f"ground truth: {'yes' if self.ground_truth else 'no'}")
        lines += [f"mounting: {self.mounting}"] if str(self.mounting) else []
        lines += [f"dropped: {count} x {reason}" for reason, count in sorted(self.dropped.items())]
        lines += [f"problem: {problem}" for problem in self.problems]
        lines += [f"note: {note}" for note in self.notes]
        lines += [f"truncated: {self.truncated}"] if self.truncated else []
        return "\n".join(lines)


def inspect_log(
    source: Source,
    *,
    scan_topic: str | None = "/scan",
    uwb_topic: str | None = "/uwb/ranges",
    odom_topic: str | None = "/odom",
    scan_frame: str = "",
    robot_id: int = 0,
    uwb: UwbSettings | None = None,
) -> LogSummary:
    """Reads a recording through and says what it holds; arguments as for `Recording`.

    Raises:
      LogError: the file cannot be read at all. Missing or ambiguous topics are `problems` of the summary.
    """
    recording, options = Bag(source), Options.of(uwb or UwbSettings(), robot_id, scan_frame)
    decoders: dict[int, Decoder] = {}
    roles: dict[int, Role] = {}
    problems: list[str] = []
    wanted: dict[Role, str | None] = {"scan": scan_topic, "uwb": uwb_topic, "odom": odom_topic}
    for role, topic in wanted.items():
        try:
            new_decoders, new_roles = choose_topics(recording, {role: topic}, options)
            decoders, roles = new_decoders | decoders, new_roles | roles
            if role != "odom" and topic is not None and role not in new_roles.values():
                problems.append(f"no {role} topic")
        except LogError as error:
            problems.append(str(error))
    problems += left_out(recording, roles, options)
    look = look_first(recording, decoders, roles, options)
    problems += [told_late(look.late)] if look.late is not None else []
    ranges = {number: decode for number, decode in decoders.items() if roles[number] == "uwb"}
    look_ahead(recording, ranges, options, scans=bool({"scan", "odom"} & set(roles.values())))
    topic_of = {channel.id: channel.topic for channel in recording.channels.values()}
    clocks = {topic: _Clock() for topic in topic_of.values()}
    heard, on_clock = LogFacts(), MessageClocks(options.dropped, look.rates)

    def decoded() -> Iterator[Logged]:
        for log_time, number, data in recording.records():
            if number not in topic_of:
                continue
            clocks[topic_of[number]].tick(log_time)
            if number in decoders:
                for message in decoders[number](data, log_time):
                    yield message, log_time, topic_of[number]

    for message, log_time, topic in in_order(decoded(), look.late):
        heard.take(on_clock.take(message, log_time, topic))
    heard.take(on_clock.flush())
    problems += on_clock.warnings
    return LogSummary(
        name=recording.name,
        duration=(recording.end - recording.start) * 1e-9,
        topics=_topics(recording, clocks, roles, on_clock.offsets),
        ids=dict(sorted(heard.ids.items())),
        pairs=dict(sorted(heard.pairs.items())),
        powers=heard.powers,
        odometry="odom" in roles.values(),
        ground_truth="truth" in roles.values(),
        beams=heard.beams,
        dropped=options.dropped,
        problems=[*problems, *options.scans.told.values(), *options.told, *names_told(options)],
        notes=[*filter(None, [options.scans.noted]), *heard.notes()],
        mounting=read_mounting(recording, roles, options.scans.frame),
        truncated=recording.truncated,
    )


class _Clock:
    """Count, first, last and largest gap of a topic's log times."""

    def __init__(self) -> None:
        self.count = self.first = self.last = self.gap = 0

    def tick(self, log_time: int) -> None:
        if self.count:
            self.gap = max(self.gap, log_time - self.last)
        else:
            self.first = log_time
        self.count, self.last = self.count + 1, log_time


def _topics(
    recording: Bag, clocks: dict[str, _Clock], roles: dict[int, Role], offsets: dict[str, float | None]
) -> list[TopicSummary]:
    by_name = {channel.topic: channel for channel in recording.channels.values()}
    role_of = {recording.channels[number].topic: role for number, role in roles.items()}
    summaries = []
    for name, clock in sorted(clocks.items()):
        span = (clock.last - clock.first) * 1e-9
        rate = (clock.count - 1) / span if span > 0 else math.nan
        gap = clock.gap * 1e-9 if clock.count > 1 else math.nan
        offset = offsets.get(name)
        times = rate, gap, math.nan if offset is None else offset
        summaries.append(TopicSummary(name, by_name[name].schema, role_of.get(name), clock.count, *times))
    return summaries


def _pairs(pairs: dict[tuple[int, int], int], most: int = 28) -> str:
    shown = [f"{a}-{b} ({count})" for (a, b), count in list(pairs.items())[:most]]
    return ", ".join(shown + ["..."] * (len(pairs) > most))
