"""Messages out of and into MCAP recordings: which topic plays which role, in what order, and what was left out.

How a message type is laid out is `schemas`; how the file is built is `mcap_container`.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import islice
from pathlib import Path
from types import TracebackType

from uwbslam_jax.errors import LogError as LogError
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.files.bag import Bag, Source
from uwbslam_jax.files.first_look import look_first
from uwbslam_jax.files.first_ranges import look_ahead
from uwbslam_jax.files.log_order import Logged, in_order, told as told_late
from uwbslam_jax.files.mcap_container import Channel, RecordWriter
from uwbslam_jax.files.mounting import Mounting, read_mounting
from uwbslam_jax.files.pose_messages import odometry_parts
from uwbslam_jax.files.range_messages import Options, names_told
from uwbslam_jax.files.ros_types import definition, encode
from uwbslam_jax.files.schemas import (
    Decoder,
    Role,
    make_decoder,
    names_no_node,
    of_a_radio,
    plausible,
    unpacker,
)
from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage, ScanMessage, TruthMessage
from uwbslam_jax.session import MessageClocks
from uwbslam_jax.settings import UwbSettings

TRUTH_ROBOT, TRUTH_BEACON = "/ground_truth/robot", "/ground_truth/beacon/"
"""Topics of the ground truth, of a beacon without its id [topic]: none is taken for a sensor's."""
_KEYS: dict[Role, str] = {"scan": "lidar.topic", "uwb": "uwb.topic", "odom": "odom.topic"}
"""The setting that chooses a role's topic [role -> key]: where several topics fit, the error names it."""
_FIRST_TRANSFORMS = 500
"""Transforms from odom to the robot are among so many messages, if there are any [messages]."""


class Recording:
    """Iterates over the measurements of a recording by log time, streaming; may be iterated again.

    Attributes:
      name: what messages call it.
      topics: topic -> role ("scan", "uwb", "odom", "truth") of the topics used.
      robot_id: id of the robot's node: the one given, or another that the ranges tell it is.
      warnings: what a user should know, one line each; some show only while iterating.
      dropped: messages left out so far, by reason; of the current iteration.
      truncated: where the recording breaks, None where it does not; a corrupt chunk shows only while iterating.
      message_count: messages on the topics used, whole and not yet decoded; for a progress bar.
      duration: from the first to the last message of the file [s].
    """

    def __init__(
        self,
        source: Source,
        *,
        scan_topic: str | None = "/scan",
        uwb_topic: str | None = "/uwb/ranges",
        odom_topic: str | None = "/odom",
        scan_frame: str = "",
        robot_id: int = 0,
        uwb: UwbSettings | None = None,
    ):
        """Opens a recording and chooses its topics: those named, else the only one of a fitting type.

        Args:
          source: an MCAP file, a ROS 2 bag folder, or several that belong together.
          scan_topic, uwb_topic, odom_topic: where to look first; None leaves that sensor out.
          scan_frame: frame_id of the scanner to use where a topic carries several; "" for the one with most scans.
          robot_id: id of the robot's node, for range messages that name only the other one.
          uwb: unit, greatest range and layout of the ranges; the defaults where not given.

        Raises:
          LogError: the file cannot be read, has neither scans nor odometry nor ranges, leaves a choice open, or a named
            topic holds something else.
        """
        self._recording = Bag(source)
        self._options = Options.of(uwb or UwbSettings(), robot_id, scan_frame)
        self.name = self._recording.name
        wanted: dict[Role, str | None] = {"scan": scan_topic, "uwb": uwb_topic, "odom": odom_topic}
        try:
            self._decoders, self._roles = choose_topics(self._recording, wanted, self._options)
            if scan_topic is not None and not {"scan", "uwb", "odom"} & set(self._roles.values()):
                wanted_scan = f"{scan_topic} or any LaserScan"
                raise LogError(f"no scan topic ({wanted_scan}), no odometry and no ranges; {_listing(self._recording)}")
        except LogError as error:
            broken = f"; {self._recording.truncated}" if self._recording.truncated else ""
            raise LogError(f"{self.name}: {' '.join(str(error).split())}{broken}") from None
        self._look = look_first(self._recording, self._decoders, self._roles, self._options)
        channels = self._recording.channels
        self.topics: dict[str, Role] = {channels[number].topic: role for number, role in self._roles.items()}
        self._warnings = [told_late(self._look.late)] if self._look.late is not None else []
        self._of_clocks: list[str] = []
        self._warnings += left_out(self._recording, self._roles, self._options)
        if uwb_topic is not None and "uwb" not in self._roles.values():
            self._warnings.append(f"no UWB topic: {'LiDAR' if 'scan' in self._roles.values() else 'odometry'} only")
        ranges = {number: decode for number, decode in self._decoders.items() if self._roles[number] == "uwb"}
        look_ahead(self._recording, ranges, self._options, scans=bool({"scan", "odom"} & set(self._roles.values())))
        self.duration = (self._recording.end - self._recording.start) * 1e-9
        counts = self._recording.counts
        self.message_count = sum(counts[number] for number in self._roles)

    @property
    def warnings(self) -> list[str]:
        options = self._options
        told = [*options.scans.told.values(), *options.told, *names_told(options)]
        return [*self._warnings, *told, *self._of_clocks]

    @property
    def robot_id(self) -> int:
        return self._options.robot_id

    @property
    def dropped(self) -> Counter[str]:
        return self._options.dropped

    @property
    def truncated(self) -> str | None:
        return self._recording.truncated

    @cached_property
    def mounting(self) -> Mounting:
        """Where the sensors sit, as far as the recording's transforms tell."""
        return read_mounting(self._recording, self._roles, self._options.scans.frame)

    @cached_property
    def truth(self) -> Truth | None:
        """Where robot and beacons were, None where the recording has no truth of the robot; read through for it."""
        wanted = {number: decode for number, decode in self._decoders.items() if self._roles[number] == "truth"}
        poses = [m for m in self._timed(MessageClocks(rates=self._look.rates), wanted) if isinstance(m, TruthMessage)]
        return Truth.from_messages(poses) if any(m.node is None for m in poses) else None

    def __iter__(self) -> Iterator[Message]:
        self._options.dropped.clear()
        clocks = MessageClocks(self._options.dropped, self._look.rates)
        self._of_clocks = []
        yield from self._timed(clocks, self._decoders)
        self._of_clocks = clocks.warnings

    def _timed(self, clocks: MessageClocks, decoders: dict[int, Decoder]) -> Iterator[Message]:
        """Messages of some channels, on one clock."""
        channels = {n: (decode, self._recording.channels[n].topic) for n, decode in decoders.items()}

        def decoded() -> Iterator[Logged]:
            for log_time, number, data in self._recording.records(set(decoders)):
                decode, topic = channels[number]
                for message in decode(data, log_time):
                    yield message, log_time, topic

        for message, log_time, topic in in_order(decoded(), self._look.late):
            yield from clocks.take(message, log_time, topic)
        yield from clocks.flush()


def choose_topics(
    recording: Bag, wanted: dict[Role, str | None], options: Options
) -> tuple[dict[int, Decoder], dict[int, Role]]:
    """Decoders and roles by channel number: of the topic wanted for each role, else of the only one that fits.

    Raises:
      LogError: several topics fit, or a topic wanted by name holds something else.
    """
    decoders: dict[int, Decoder] = {}
    roles: dict[int, Role] = {}
    for role, topic in wanted.items():
        if topic is None:
            continue
        chosen = [channel for channel in recording.channels.values() if fnmatchcase(channel.topic, topic)]
        if chosen:
            options.joined = sorted({channel.topic for channel in chosen}) if role == "uwb" else options.joined
            found = {channel.id: make_decoder(channel, role, options) for channel in chosen}
        else:
            found = _discover(recording, role, options)
        decoders |= found
        roles |= dict.fromkeys(found, role)
    for channel in recording.channels.values():
        if channel.id not in decoders and (decoder := _truth_decoder(channel, options)) is not None:
            decoders[channel.id], roles[channel.id] = decoder, "truth"
    return decoders, roles


def _discover(recording: Bag, role: Role, options: Options) -> dict[int, Decoder]:
    """The channels of the only topic whose type fits the role; empty where none does. Raises LogError for several.

    Of ranges: also those of all topics that have one node's each.
    """
    found: dict[int, tuple[int, Decoder]] = {}
    joined: list[Channel] = []
    unread: list[str] = []
    for channel in recording.channels.values():
        rank = plausible(channel, role, options)
        if rank is None or channel.topic.startswith("/ground_truth"):
            continue
        try:
            decoder = make_decoder(channel, role, options)
            if role == "uwb" and names_no_node(channel, options):
                joined += [channel] * (recording.counts[channel.id] > 0)
            else:
                found[channel.id] = rank, decoder
        except LogError as error:  # the name fits, the content does not: not a candidate
            unread += [str(error)] * (recording.counts[channel.id] > 0)
    # a topic without a message is no rival to one with, nor one whose name says less
    spoken = {number: each for number, each in found.items() if recording.counts[number]} or found
    best = min((rank for rank, _ in spoken.values()), default=0)
    fitting = {number: decoder for number, (rank, decoder) in spoken.items() if rank == best}
    topics = sorted({recording.channels[number].topic for number in fitting})
    if len(topics) > 1:
        several = ", with * for several" if role == "uwb" else ""
        raise LogError(f"several {role} topics: {', '.join(topics)}; choose with --{_KEYS[role]} TOPIC{several}")
    if not fitting and role == "odom":
        return _odometry_in_transforms(recording, options)
    if not fitting:
        fitting = _of_one_radio(joined, unread, options)
        options.told += unread if role == "uwb" and not fitting else []
    return fitting


def left_out(recording: Bag, roles: dict[int, Role], options: Options) -> list[str]:
    """One line for each sensor of which other topics hold as much as those that are used, and how to choose them."""
    told = []
    sensors: dict[Role, str] = {"scan": "scans", "uwb": "ranges"}
    for role, things in sensors.items():
        used = sorted({recording.channels[number].topic for number in roles if roles[number] == role})
        others = {
            channel.topic
            for channel in recording.channels.values()
            if recording.counts[channel.id] and channel.id not in roles and _holds(channel, role, options)
        }
        if used and others:
            several = ", with * for several" if role == "uwb" else "; several scanners are not used together"
            names, one = ", ".join(sorted(others)), "s" * (len(others) == 1)
            told.append(
                f"{names} hold{one} {things} too and {'is' if one else 'are'} left out, {', '.join(used[:3])} is used: "
                f"--{_KEYS[role]} TOPIC chooses another{several}"
            )
    return told


def _holds(channel: Channel, role: Role, options: Options) -> bool:
    """Whether a channel's type and content are those of a role."""
    if plausible(channel, role, options) is None or channel.topic.startswith("/ground_truth"):
        return False
    try:
        make_decoder(channel, role, replace(options, told=[], names={}, dropped=Counter()))
        return role != "uwb" or not names_no_node(channel, options) or of_a_radio(channel)
    except LogError:
        return False


def _of_one_radio(joined: list[Channel], unread: list[str], options: Options) -> dict[int, Decoder]:
    """Decoders of the topics that have one node's ranges each, if they are a radio's; else told in unread."""
    ours = [channel for channel in joined if of_a_radio(channel)] or (joined if options.message.type else [])
    options.joined = sorted({channel.topic for channel in ours})
    if joined and not ours:
        names = ", ".join(sorted({channel.topic for channel in joined}))
        unread.append(
            f"ranges to no named node on {names} are not taken for a radio's: if they are, "
            "--uwb.topic names them, with * for several"
        )
    return {channel.id: make_decoder(channel, "uwb", options) for channel in ours}


def _odometry_in_transforms(recording: Bag, options: Options) -> dict[int, Decoder]:
    """The channels of transforms that lead from odom to the robot; empty where none does."""
    channels = [channel for channel in recording.channels.values() if plausible(channel, "tf", options) is not None]
    moving = [channel for channel in channels if recording.counts[channel.id] and not channel.topic.endswith("_static")]
    unpack = {channel.id: unpacker(channel, "tf") for channel in moving}
    found: set[int] = set()
    for _, number, data in islice(recording.records(set(unpack)) if unpack else (), _FIRST_TRANSFORMS):
        message = unpack[number](data)
        found |= {number} if message is not None and odometry_parts(message) else set()
    return {channel.id: make_decoder(channel, "odom", options) for channel in moving if channel.id in found}


def _truth_decoder(channel: Channel, options: Options) -> Decoder | None:
    """Decoder of a ground truth topic, None for any other topic or where it cannot be read."""
    match = re.fullmatch(re.escape(TRUTH_BEACON) + r"(\d+)", channel.topic)
    if match is None and channel.topic != TRUTH_ROBOT:
        return None
    try:
        decode = make_decoder(channel, "truth", options)
    except LogError:
        return None
    if match is None:
        return decode
    node = int(match[1])

    def decode_beacon(data: bytes, log_time: int) -> list[Message]:
        return [TruthMessage(m.stamp, node, m.x, m.y) for m in decode(data, log_time) if isinstance(m, TruthMessage)]

    return decode_beacon


def _listing(recording: Bag) -> str:
    topics = sorted({f"{channel.topic} ({channel.schema})" for channel in recording.channels.values()})
    return f"the topics are {', '.join(topics)}" if topics else "there are no topics"


class LogWriter:
    """Writes measurements as a ROS 2 recording; a context manager that always finishes the file."""

    def __init__(
        self, path: str | Path, *, scan_topic: str = "/scan", uwb_topic: str = "/uwb/ranges", odom_topic: str = "/odom"
    ):
        """Opens the file, replacing one that is there. Raises LogError."""
        self._records = RecordWriter(path)
        self._topics = {"scan": scan_topic, "uwb": uwb_topic, "odom": odom_topic}
        self._channels: dict[str, int] = {}

    def write(self, message: Message, log_time: int | None = None, topic: str | None = None) -> None:
        """Writes one measurement; log_time [ns] is its stamp and topic that of its kind where not given.

        Raises:
          LogError: a stamp that cannot be written.
        """
        topic = topic or self._topic(message)
        try:
            schema, data = encode(message)
            if topic not in self._channels:
                self._channels[topic] = self._records.add_topic(topic, schema, definition(schema))
            self._records.write(self._channels[topic], data, message.stamp if log_time is None else log_time)
        except struct.error as error:
            raise LogError(f"{self._records.path}: {type(message).__name__} cannot be written: {error}") from None

    def _topic(self, message: Message) -> str:
        if isinstance(message, TruthMessage):
            return TRUTH_ROBOT if message.node is None else f"{TRUTH_BEACON}{message.node}"
        kind = {ScanMessage: "scan", RangeMessage: "uwb", OdometryMessage: "odom"}[type(message)]
        return self._topics[kind]

    def flush(self) -> None:
        """Hands all messages so far to the operating system."""
        self._records.flush()

    def close(self) -> None:
        """Finishes the file; a second call does nothing."""
        self._records.close()

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()
