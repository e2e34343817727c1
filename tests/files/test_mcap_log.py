"""Recordings in and out: every layout we read, every way a file can be broken, and what is said about it."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uwbslam_jax.errors import LogError
from uwbslam_jax.files import log_summary, mcap_container, ros_types
from uwbslam_jax.files.mcap_log import LogWriter, Recording
from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage, ScanMessage, TruthMessage
from uwbslam_jax.settings import UwbSettings

T0 = 1_700_000_000_123_456_789  # ns; no float64 holds it
MS = 1_000_000

stamps = st.integers(1, 2**31 * 10**9 - 1)
ids = st.integers(0, 2**32 - 1)
metres = st.floats(2.0**-10, 199.0, width=32)
floats = st.floats(-1e6, 1e6)
floats32 = st.floats(-1e3, 1e3, width=32)
increments = st.floats(-0.1875, 0.1875, width=32).filter(bool)


def scan(stamp: int, beams: int = 7) -> ScanMessage:
    ranges = np.linspace(1.0, 2.0, beams, dtype=np.float32)
    ranges[1::3] = np.inf
    step, time = (0.25, 2.0**-10) if beams < 20 else (2.0**-7, 2.0**-19)
    return ScanMessage(stamp, -1.5, step, time, 0.125, 30.0, ranges)


def log_messages(count: int = 40) -> list[Message]:
    """A short drive: a scan every 100 ms, two ranges and an odometry pose with each."""
    messages: list[Message] = []
    for index in range(count):
        stamp = T0 + index * 100 * MS
        messages += [
            scan(stamp),
            RangeMessage(stamp + 1, 0, 1, 2.5, -80.0, -82.0),
            RangeMessage(stamp + 2, 1, 2, 4.5),
            OdometryMessage(stamp + 3, 0.125 * index, 0.0, 0.5),
        ]
    return messages


def write_log(path: Path, messages: list[Message]) -> Path:
    with LogWriter(path) as writer:
        for message in messages:
            writer.write(message)
    return path


def same(a: Message, b: Message) -> bool:
    """Equal field by field; NaN equals NaN, angles to what a quaternion keeps."""
    return type(a) is type(b) and all(
        np.allclose(getattr(a, f.name), getattr(b, f.name), rtol=0, atol=1e-12, equal_nan=True)
        if f.name == "yaw"
        else np.array_equal(np.asarray(getattr(a, f.name)), np.asarray(getattr(b, f.name)), equal_nan=f.name != "node")
        for f in dataclasses.fields(a)
    )


def assert_same(found: list[Message], wanted: list[Message]) -> None:
    assert len(found) == len(wanted)
    assert all(map(same, found, wanted))


def write_raw(
    path: Path,
    channels: dict[str, tuple[str, str, str, bytes]],
    messages: list[tuple[str, int, bytes]],
    *,
    finish: bool = True,
    **options: Any,
) -> Path:
    """A file from topic -> (schema, schema encoding, message encoding, definition) and (topic, log time, data)."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        numbers = {}
        for topic, (schema, language, encoding, text) in channels.items():
            number = writer.register_schema(schema, language, text) if schema else 0
            numbers[topic] = writer.register_channel(topic, encoding, number)
        for topic, log_time, data in messages:
            writer.add_message(numbers[topic], log_time, data, log_time)
        if finish:
            writer.finish()
    return path


def ros_channel(schema: str) -> tuple[str, str, str, bytes]:
    return schema, "ros2msg", "cdr", ros_types.definition(schema)


SCAN_CHANNEL = ros_channel("sensor_msgs/msg/LaserScan")


class TestRoundTrip:
    @given(stamps, ids, ids, metres, floats32, floats32)
    def test_range(
        self, tmp_path_factory: Any, stamp: int, source: int, target: int, distance: float, receive: float, first: float
    ) -> None:
        message = RangeMessage(stamp, source, target, distance, receive, first)
        path = write_log(tmp_path_factory.mktemp("log") / "a.mcap", [scan(stamp), message])
        wanted: list[Message] = [] if source == target else [message]
        assert_same([m for m in Recording(path) if isinstance(m, RangeMessage)], wanted)

    @settings(max_examples=20)
    @given(stamps, st.lists(st.floats(width=32), min_size=1, max_size=30, unique=True), increments, floats32)
    def test_scan(self, tmp_path_factory: Any, stamp: int, ranges: list[float], increment: float, angle: float) -> None:
        message = ScanMessage(stamp, angle, increment, 0.5, 0.25, 12.0, np.array(ranges, np.float32))
        assert_same(list(Recording(write_log(tmp_path_factory.mktemp("log") / "a.mcap", [message]))), [message])

    @settings(max_examples=20)
    @given(stamps, floats, floats, st.floats(-3.14, 3.14), ids)
    def test_odometry_and_truth(
        self, tmp_path_factory: Any, stamp: int, x: float, y: float, yaw: float, node: int
    ) -> None:
        messages: list[Message] = [
            scan(stamp),
            OdometryMessage(stamp, x, y, yaw),
            TruthMessage(stamp, None, x, y, yaw),
            TruthMessage(stamp, node, x, y),
        ]
        reader = Recording(write_log(tmp_path_factory.mktemp("log") / "a.mcap", messages))
        assert_same(list(reader), messages)
        assert set(reader.topics.values()) == {"scan", "odom", "truth"}

    def test_a_reader_may_be_iterated_again(self, tmp_path: Path) -> None:
        messages = log_messages()
        bad = [RangeMessage(T0, 0, 1, -1.0)]
        reader = Recording(write_log(tmp_path / "a.mcap", [*bad, *messages]))
        for _ in range(2):
            assert_same(list(reader), messages)
            assert reader.dropped.total() == 1
        assert reader.message_count == len(messages) + 1
        assert reader.duration == pytest.approx(3.9, abs=1e-6)
        assert reader.truncated is None

    def test_the_log_time_orders_and_the_stamp_stays(self, tmp_path: Path) -> None:
        with LogWriter(tmp_path / "a.mcap") as writer:
            writer.write(scan(T0 + 50), log_time=T0 + 200)
            writer.write(RangeMessage(T0 + 90, 0, 1, 1.0), log_time=T0 + 100)
        assert [m.stamp for m in Recording(tmp_path / "a.mcap")] == [T0 + 90, T0 + 50]

    def test_duplicates_and_stamps_out_of_order_are_kept(self, tmp_path: Path) -> None:
        messages: list[Message] = [scan(T0), scan(T0)]
        with LogWriter(tmp_path / "a.mcap") as writer:
            for index, message in enumerate([*messages, scan(T0 - 5)]):
                writer.write(message, log_time=T0 + index)
        assert [m.stamp for m in Recording(tmp_path / "a.mcap")] == [T0, T0, T0 - 5]

    def test_other_topics(self, tmp_path: Path) -> None:
        topics: dict[str, Any] = {"scan_topic": "/front", "uwb_topic": "/radio", "odom_topic": "/wheels"}
        with LogWriter(tmp_path / "a.mcap", **topics) as writer:
            for message in log_messages(3):
                writer.write(message)
        for given_topics in (topics, {}):  # named, and found by their types
            reader = Recording(tmp_path / "a.mcap", **given_topics)
            assert reader.topics == {"/front": "scan", "/radio": "uwb", "/wheels": "odom"}
            assert_same(list(reader), log_messages(3))

    def test_what_is_packed_by_hand_is_what_the_type_store_packs(self) -> None:
        message = scan(T0)
        head = ros_types.header(T0, "laser")
        wanted = ros_types.build(
            "sensor_msgs/msg/LaserScan",
            header=head,
            angle_min=message.angle_min,
            angle_max=message.angle_min + 6 * message.angle_increment,
            angle_increment=message.angle_increment,
            time_increment=message.time_increment,
            scan_time=7 * message.time_increment,
            range_min=message.range_min,
            range_max=message.range_max,
            ranges=message.ranges,
            intensities=np.zeros(0, np.float32),
        )
        assert ros_types.encode(message)[1] == ros_types.serialize(wanted)
        ranging = RangeMessage(T0, 3, 4, 2.5, -80.0, -82.0)
        fields = {"source": 3, "target": 4, "range": 2.5, "receive_power": -80.0, "first_path_power": -82.0}
        wanted = ros_types.build(ros_types.UWB_RANGE, header=ros_types.header(T0, "uwb"), **fields)
        assert ros_types.encode(ranging)[1] == ros_types.serialize(wanted)

    def test_a_second_implementation_reads_what_we_write(self, tmp_path: Path) -> None:
        reader = pytest.importorskip("mcap_ros2.reader")
        truth: list[Message] = [TruthMessage(T0, None, 1.0, 2.0, 0.0), TruthMessage(T0, 4, 3.0, 2.0)]
        path = write_log(tmp_path / "a.mcap", [*truth, *log_messages(2)])
        found = [(m.channel.topic, m.ros_msg) for m in reader.read_ros2_messages(str(path))]
        assert len(found) == 10
        by_topic = dict(reversed(found))
        assert by_topic["/uwb/ranges"].receive_power == -80.0
        assert by_topic["/uwb/ranges"].header.frame_id == "uwb"
        assert by_topic["/scan"].header.frame_id == "laser"
        assert by_topic["/scan"].angle_max == 0.0
        assert by_topic["/odom"].header.frame_id == "odom"
        assert by_topic["/ground_truth/robot"].pose.position.y == 2.0
        assert by_topic["/ground_truth/beacon/4"].point.x == 3.0
        with path.open("rb") as file:
            from mcap.reader import make_reader

            assert make_reader(file).get_header().profile == "ros2"

    def test_a_stamp_that_no_message_holds_is_an_error(self, tmp_path: Path) -> None:
        with LogWriter(tmp_path / "a.mcap") as writer, pytest.raises(LogError, match="cannot be written"):
            writer.write(scan(2**31 * 10**9))

    def test_a_place_that_cannot_be_written_is_an_error(self, tmp_path: Path) -> None:
        with pytest.raises(LogError, match="No such file"):
            LogWriter(tmp_path / "absent" / "a.mcap")


class TestBrokenFiles:
    @pytest.mark.parametrize(
        ("content", "says"),
        [
            (b"", "empty"),
            (b"\x89MCAP", "not an? (MCAP file|recording)"),
            (b"hello, this is text\n", "neither an MCAP file nor"),
            (b"#ROSBAG V2.0\n.....", "not a readable ROS 1 bag .*rosbag reindex"),
            (b"SQLite format 3\x00....", "not a readable ROS 2 bag in SQLite"),
            (b"\x28\xb5\x2f\xfd....", "compressed file is damaged|neither an MCAP"),
            (b"\x1f\x8b....", "packed with gzip"),
        ],
    )
    def test_not_an_mcap(self, tmp_path: Path, content: bytes, says: str) -> None:
        path = tmp_path / "a.mcap"
        path.write_bytes(content)
        with pytest.raises(LogError, match=says) as caught:
            Recording(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)

    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(LogError, match=r"absent\.mcap: no such file"):
            Recording(tmp_path / "absent.mcap")

    def test_folders(self, tmp_path: Path) -> None:
        with pytest.raises(LogError, match=r"without a \.mcap, \.db3 or \.bag file"):
            Recording(tmp_path)
        (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
        write_log(tmp_path / "bag_0.mcap", log_messages(2))
        assert_same(list(Recording(tmp_path)), log_messages(2))
        write_log(tmp_path / "other_1.mcap", log_messages(2))
        with pytest.raises(LogError, match=r"name those that are: bag_0\.mcap, other_1\.mcap"):
            Recording(tmp_path)
        assert_same(list(Recording([tmp_path / "other_1.mcap"])), log_messages(2))

    @pytest.fixture
    def split(self, tmp_path: Path) -> Path:
        """A bag of two files, of which the first one ends later than the second one begins."""
        messages = log_messages(20)
        write_log(tmp_path / "bag_0.mcap", [*messages[:10], messages[12]])
        write_log(tmp_path / "bag_1.mcap", [*messages[10:12], *messages[13:]])
        (tmp_path / "whole").mkdir()
        write_log(tmp_path / "whole" / "a.mcap", messages)
        (tmp_path / "metadata.yaml").write_text(
            "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n"
            "  relative_file_paths:\n    - bag_0.mcap\n    - bag_1.mcap\n"
        )
        return tmp_path

    def test_a_bag_of_several_files_is_one_recording(self, split: Path) -> None:
        files = [split / "bag_0.mcap", split / "bag_1.mcap"]
        one = Recording(split / "whole")
        for source in (split, files):
            reader = Recording(source)
            assert_same(list(reader), list(one))
            assert (reader.message_count, reader.duration) == (one.message_count, one.duration)
            assert reader.truncated is None
        assert Recording(files).name == f"{files[0]} and 1 more"
        told, whole = log_summary.inspect_log(split), log_summary.inspect_log(split / "whole")
        assert [(t.name, t.role, t.count) for t in told.topics] == [(t.name, t.role, t.count) for t in whole.topics]

    def test_a_bag_whose_first_file_breaks_goes_on_with_the_second(self, split: Path) -> None:
        first, second = split / "bag_0.mcap", split / "bag_1.mcap"
        first.write_bytes(first.read_bytes()[: first.stat().st_size * 2 // 3])
        reader = Recording(split)
        assert str(reader.truncated).startswith("bag_0.mcap: recording breaks after ")
        assert {m.stamp for m in Recording(second)} <= {m.stamp for m in reader}

    @pytest.mark.parametrize(
        ("metadata", "told"),
        [
            ("{relative_file_paths: [a.db3]}", r"not there: a\.db3"),
            ("{relative_file_paths: [bag_0.mcap, c.mcap]}", r"not there: c\.mcap"),
            ("[", r"metadata\.yaml: "),
            ("3", r"metadata\.yaml: "),
        ],
    )
    def test_bags_that_cannot_be_read(self, split: Path, metadata: str, told: str) -> None:
        (split / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {metadata}\n")
        with pytest.raises(LogError, match=told) as error:
            Recording(split)
        assert "\n" not in str(error.value)

    def test_no_messages_at_all(self, tmp_path: Path) -> None:
        with pytest.raises(LogError, match="there are no topics"):
            Recording(write_raw(tmp_path / "a.mcap", {}, []))

    @pytest.mark.parametrize(
        ("compression", "chunked"),
        [
            (CompressionType.ZSTD, True),
            (CompressionType.LZ4, True),
            (CompressionType.NONE, True),
            (CompressionType.NONE, False),
        ],
    )
    def test_cut_anywhere(self, tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
        """Of a file cut at any byte, what comes back is the beginning of the log, at least all its whole chunks."""
        messages: list[Message] = [m for m in log_messages(30) if not isinstance(m, OdometryMessage)]
        encoded = [ros_types.encode(message) for message in messages]
        topics = {"sensor_msgs/msg/LaserScan": "/scan", ros_types.UWB_RANGE: "/uwb/ranges"}
        path = write_raw(
            tmp_path / "whole.mcap",
            {topic: ros_channel(schema) for schema, topic in topics.items()},
            [(topics[schema], message.stamp, data) for (schema, data), message in zip(encoded, messages, strict=True)],
            chunk_size=1500,
            compression=compression,
            use_chunking=chunked,
        )
        whole = path.read_bytes()
        ends = chunk_ends(path) if chunked else None
        last, said = 0, set[str]()
        for size in [*range(9, len(whole), 97), len(whole) - 8, len(whole) - 1]:
            cut = tmp_path / "cut.mcap"
            cut.write_bytes(whole[:size])
            try:
                reader = Recording(cut)
            except LogError as error:
                said.add(re.sub(r"[0-9]+", "N", str(error).removeprefix(f"{cut}: ")))
                continue
            found = list(reader)
            assert_same(found, messages[: len(found)])
            assert len(found) >= last  # more bytes, no fewer messages
            assert len(found) == reader.message_count
            last = len(found)
            assert reader.truncated is not None
            assert f"of {size})" in reader.truncated
            if ends is not None:
                assert len(found) >= sum(count for end, count in ends if end <= size)
        assert last == len(messages)
        why = "no scan topic (/scan or any LaserScan), no odometry and no ranges; there are no topics"
        assert said <= {f"{why}; recording breaks after N.N s (byte N of N)"}

    def test_a_cut_tells_when(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "a.mcap", log_messages())
        path.write_bytes(path.read_bytes()[:-20])
        assert Recording(path).truncated is not None
        assert str(Recording(path).truncated).startswith("recording breaks after 3.9 s (byte ")

    def test_a_file_never_finished(self, tmp_path: Path) -> None:
        """A recorder that was killed: chunks, but no end, and zeros where the disk had been reserved."""
        schema, data = ros_types.encode(scan(T0))
        many = [("/scan", T0 + k, data) for k in range(50)]
        path = write_raw(tmp_path / "a.mcap", {"/scan": ros_channel(schema)}, many, finish=False, chunk_size=1000)
        for tail in (b"", bytes(1000)):
            path.write_bytes(path.read_bytes() + tail)
            reader = Recording(path)
            assert len(list(reader)) >= 40
            assert reader.truncated is not None

    @pytest.mark.parametrize("with_summary", [True, False])
    def test_a_corrupt_chunk_ends_the_reading(self, tmp_path: Path, with_summary: bool) -> None:
        messages: list[Message] = [scan(T0 + k * MS, beams=400) for k in range(100)]
        with mcap_container.RecordWriter(tmp_path / "a.mcap", chunk_size=20_000) as writer:
            channel = writer.add_topic("/scan", "sensor_msgs/msg/LaserScan", SCAN_CHANNEL[3])
            for message in messages:
                writer.write(channel, ros_types.encode(message)[1], message.stamp)
        content = bytearray((tmp_path / "a.mcap").read_bytes())
        (_, count), (end, second), *_ = chunk_ends(tmp_path / "a.mcap")
        content[end - 200] ^= 0xFF  # inside the compressed bytes of the second chunk
        (tmp_path / "a.mcap").write_bytes(content if with_summary else content[:-30])
        reader = Recording(tmp_path / "a.mcap")
        assert second > 0
        assert_same(list(reader), messages[:count])
        assert "recording breaks after 0.0 s (byte" in str(reader.truncated)
        assert "a chunk does not" in str(reader.truncated)

    def test_a_record_that_claims_more_than_there_is(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "a.mcap", log_messages())
        content = bytearray(path.read_bytes())
        (end, count), *_ = chunk_ends(path)
        content[end : end + 9] = struct.pack("<BQ", 5, 2**62)
        path.write_bytes(content)
        reader = Recording(path)
        assert len(list(reader)) == count
        assert f"(byte {end} of" in str(reader.truncated)

    @pytest.mark.parametrize("chunked", [True, False])
    def test_damaged_anywhere(self, tmp_path: Path, chunked: bool) -> None:
        """Whatever bytes are wrong, a file is read or refused with one line, and can be inspected or is refused."""
        schema, data = ros_types.encode(scan(T0))
        many = [("/scan", T0 + k, data) for k in range(60)]
        path = write_raw(
            tmp_path / "a.mcap", {"/scan": ros_channel(schema)}, many, chunk_size=1000, use_chunking=chunked
        )
        whole = path.read_bytes()
        rng = np.random.default_rng(0)
        for _ in range(150):
            content = bytearray(whole)
            for at in rng.integers(8, len(whole), rng.integers(1, 8)):
                content[at] = rng.integers(256)
            path.write_bytes(content)
            for read in (lambda: list(Recording(path)), lambda: str(log_summary.inspect_log(path))):
                try:
                    read()
                except LogError as error:
                    complaint = str(error)
                else:
                    complaint = ""
                assert len(complaint.splitlines()) <= 1

    def test_overlapping_chunks_come_in_order(self, tmp_path: Path) -> None:
        schema, data = ros_types.encode(scan(T0))
        times = [T0 + 10 * k + (35 if k % 5 == 0 else 0) for k in range(200)]
        path = write_raw(
            tmp_path / "a.mcap", {"/scan": ros_channel(schema)}, [("/scan", t, data) for t in times], chunk_size=500
        )
        found = [record.log_time for record in mcap_container.McapFile(path).records()]
        assert found == sorted(times)


def chunk_ends(path: Path) -> list[tuple[int, int]]:
    """Where each chunk record ends [byte] and how many messages it holds, by the mcap package's own reader."""
    from mcap.reader import make_reader
    from mcap.stream_reader import breakup_chunk

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        ends = []
        for index in summary.chunk_indexes:
            file.seek(index.chunk_start_offset + 9)
            from mcap.data_stream import ReadDataStream
            from mcap.records import Chunk, Message

            records = breakup_chunk(Chunk.read(ReadDataStream(file)))
            ends.append((index.chunk_start_offset + index.chunk_length, sum(isinstance(r, Message) for r in records)))
        return ends


class TestTopics:
    def test_no_scan_topic(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "a.mcap", [TruthMessage(T0, None, 0.0, 0.0, 0.0)])
        with pytest.raises(LogError, match=r"no scan topic .*/ground_truth/robot \(geometry_msgs/msg/PoseStamped\)"):
            Recording(path)
        assert len(list(Recording(path, scan_topic=None))) == 1

    def test_ranges_or_odometry_alone_are_read(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "a.mcap", [RangeMessage(T0, 0, 1, 1.0)])
        assert Recording(path).warnings == []
        path = write_log(tmp_path / "b.mcap", [OdometryMessage(T0, 0.0, 0.0, 0.0)])
        assert Recording(path).warnings == ["no UWB topic: odometry only"]

    def test_no_uwb_topic(self, tmp_path: Path) -> None:
        reader = Recording(write_log(tmp_path / "a.mcap", [scan(T0)]))
        assert reader.warnings == ["no UWB topic: LiDAR only"]
        assert_same(list(reader), [scan(T0)])

    def test_several_candidates(self, tmp_path: Path) -> None:
        _, data = ros_types.encode(scan(T0))
        channels = {topic: SCAN_CHANNEL for topic in ("/front", "/rear", "/never")}
        path = write_raw(tmp_path / "a.mcap", channels, [("/front", T0, data), ("/rear", T0, data)])
        with pytest.raises(LogError, match=r"several scan topics: /front, /rear; choose with --lidar\.topic"):
            Recording(path)
        assert len(list(Recording(path, scan_topic="/rear"))) == 1

    def test_a_silent_topic_is_no_rival(self, tmp_path: Path) -> None:
        _, data = ros_types.encode(scan(T0))
        channels = {topic: SCAN_CHANNEL for topic in ("/front", "/never")}
        path = write_raw(tmp_path / "a.mcap", channels, [("/front", T0, data)])
        assert Recording(path).topics == {"/front": "scan"}

    def test_a_named_topic_of_another_type(self, tmp_path: Path) -> None:
        text = ("std_msgs/msg/String", "ros2msg", "cdr", b"string data\n")
        path = write_raw(tmp_path / "a.mcap", {"/scan": text}, [])
        with pytest.raises(LogError, match=r"topic /scan: schema 'std_msgs/msg/String' holds no scan; supported: sens"):
            Recording(path)

    def test_an_unknown_encoding(self, tmp_path: Path) -> None:
        path = write_raw(tmp_path / "a.mcap", {"/scan": ("x.LaserScan", "flatbuffer", "flatbuffer", b"")}, [])
        with pytest.raises(LogError, match=r"'x\.LaserScan' in encoding 'flatbuffer' is not supported"):
            Recording(path)

    def test_an_unreadable_definition(self, tmp_path: Path) -> None:
        channel = ("sensor_msgs/msg/LaserScan", "ros2msg", "cdr", b"float32[ ranges\x00 ???")
        with pytest.raises(LogError, match="unreadable definition of 'sensor_msgs/msg/LaserScan'"):
            Recording(write_raw(tmp_path / "a.mcap", {"/scan": channel}, []))
        channel = ("sensor_msgs/msg/LaserScan", "ros2msg", "cdr", b"absent_msgs/Thing thing\n")
        with pytest.raises(LogError, match="unreadable definition"):
            Recording(write_raw(tmp_path / "a.mcap", {"/scan": channel}, []))

    def test_a_topic_without_a_schema(self, tmp_path: Path) -> None:
        with pytest.raises(LogError, match="topic /scan: "):
            Recording(write_raw(tmp_path / "a.mcap", {"/scan": ("", "", "cdr", b"")}, []))

    def test_no_definition_but_a_known_type(self, tmp_path: Path) -> None:
        schema, data = ros_types.encode(scan(T0))
        path = write_raw(tmp_path / "a.mcap", {"/scan": (schema, "ros2msg", "cdr", b"")}, [("/scan", T0, data)])
        assert_same(list(Recording(path)), [scan(T0)])

    def test_ground_truth_is_never_taken_for_odometry(self, tmp_path: Path) -> None:
        schema, data = ros_types.encode(OdometryMessage(T0, 1.0, 2.0, 0.0))
        channels = {"/scan": SCAN_CHANNEL, "/ground_truth/odom": ros_channel(schema)}
        path = write_raw(tmp_path / "a.mcap", channels, [("/ground_truth/odom", T0, data)])
        assert list(Recording(path)) == []


class TestContent:
    def test_impossible_ranges_are_counted(self, tmp_path: Path) -> None:
        distances = [math.nan, -1.0, 0.0, math.inf, 201.0, 199.0]
        messages: list[Message] = [scan(T0), *(RangeMessage(T0, 0, 1, d) for d in distances)]
        reader = Recording(write_log(tmp_path / "a.mcap", [*messages, RangeMessage(T0, 3, 3, 1.0)]))
        assert [m.range for m in reader if isinstance(m, RangeMessage)] == [199.0]
        assert reader.dropped == {
            "range: not finite or not positive": 4,
            "range: over 200 m": 1,
            "range: from a node to itself": 1,
        }
        far = Recording(tmp_path / "a.mcap", uwb=UwbSettings(max_range=300.0))
        assert [m.range for m in far if isinstance(m, RangeMessage)] == [201.0, 199.0]

    @settings(max_examples=30)
    @given(st.data())
    def test_malformed_messages_are_counted_not_raised(self, tmp_path_factory: Any, data: st.DataObject) -> None:
        good = [scan(T0), RangeMessage(T0, 0, 1, 1.0), OdometryMessage(T0, 0.0, 0.0, 0.0)]
        topics = ["/scan", "/uwb/ranges", "/odom"]
        encoded = [ros_types.encode(message) for message in good]
        broken = [content[: data.draw(st.integers(0, len(content) - 5))] for _, content in encoded]
        path = write_raw(
            tmp_path_factory.mktemp("log") / "a.mcap",
            {topic: ros_channel(schema) for topic, (schema, _) in zip(topics, encoded, strict=True)},
            [(topic, T0, content) for topic, content in zip(topics, broken, strict=True)],
        )
        reader = Recording(path)
        assert list(reader) == []
        assert reader.dropped == {"scan: malformed": 1, "range: malformed": 1, "odometry: malformed": 1}

    def test_scans_without_beams_bearings_or_limits(self, tmp_path: Path) -> None:
        base = scan(T0)
        messages: list[Message] = [
            dataclasses.replace(base, ranges=np.zeros(0, np.float32)),
            dataclasses.replace(base, angle_increment=0.0),
            dataclasses.replace(base, angle_min=math.nan),
            dataclasses.replace(base, range_min=0.0, range_max=0.0),
        ]
        reader = Recording(write_log(tmp_path / "a.mcap", messages))
        (only,) = reader
        assert isinstance(only, ScanMessage)
        assert (only.range_min, only.range_max) == (0.0, math.inf)
        assert reader.dropped == {"scan: no beams": 1, "scan: impossible bearings": 2}
        assert "scans are left out" in reader.warnings[-1]

    def test_a_header_without_a_stamp_takes_the_log_time(self, tmp_path: Path) -> None:
        messages: list[Message] = [dataclasses.replace(scan(0)), RangeMessage(0, 0, 1, 1.0)]
        with LogWriter(tmp_path / "a.mcap") as writer:
            for message in messages:
                writer.write(message, log_time=T0)
        assert [m.stamp for m in Recording(tmp_path / "a.mcap")] == [T0, T0]

    def test_another_order_of_fields_is_read_from_the_definition(self, tmp_path: Path) -> None:
        text = "float64 range\nuint16 target\nuint16 source\nstd_msgs/Header header\n"
        store: Any = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg(text, "lab_msgs/msg/UwbRange"))
        message = store.types["lab_msgs/msg/UwbRange"](2.5, 7, 3, ros_header(store, T0))
        definition, _ = store.generate_msgdef("lab_msgs/msg/UwbRange", ros_version=2)
        for little_endian in (True, False):
            data = bytes(store.serialize_cdr(message, "lab_msgs/msg/UwbRange", little_endian=little_endian))
            channel = ("lab_msgs/msg/UwbRange", "ros2msg", "cdr", definition.encode())
            path = write_raw(
                tmp_path / "a.mcap", {"/scan": SCAN_CHANNEL, "/uwb/ranges": channel}, [("/uwb/ranges", T0, data)]
            )
            assert_same(list(Recording(path)), [RangeMessage(T0, 3, 7, 2.5)])

    def test_big_endian(self, tmp_path: Path) -> None:
        built = ros_types.build(
            ros_types.UWB_RANGE,
            header=ros_types.header(T0, "any frame"),
            source=3, target=4, range=2.5, receive_power=-80.0, first_path_power=-82.0,
        )  # fmt: skip
        data = bytes(ros_types.STORE.serialize_cdr(built, ros_types.UWB_RANGE, little_endian=False))
        channels = {"/scan": SCAN_CHANNEL, "/uwb/ranges": ros_channel(ros_types.UWB_RANGE)}
        path = write_raw(tmp_path / "a.mcap", channels, [("/uwb/ranges", T0, data)])
        assert_same(list(Recording(path)), [RangeMessage(T0, 3, 4, 2.5, -80.0, -82.0)])

    def test_idl_definitions(self, tmp_path: Path) -> None:
        _, data = ros_types.encode(RangeMessage(T0, 3, 4, 2.5, -80.0, -82.0))
        floats_text = " ".join(f"float {name};" for name in ("range", "receive_power", "first_path_power"))
        text = (
            f"{'=' * 80}\nIDL: uwbslam_msgs/msg/UwbRange\n"
            '#include "std_msgs/msg/Header.idl"\n'
            "module uwbslam_msgs { module msg { struct UwbRange {\n"
            f"std_msgs::msg::Header header; uint32 source; uint32 target; {floats_text} }}; }}; }};\n"
            f"{'=' * 80}\nIDL: std_msgs/msg/Header\n"
            "module std_msgs { module msg { struct Header {\n"
            "builtin_interfaces::msg::Time stamp; string frame_id; }; }; };\n"
            f"{'=' * 80}\nIDL: builtin_interfaces/msg/Time\n"
            "module builtin_interfaces { module msg { struct Time { int32 sec; uint32 nanosec; }; }; };\n"
        )
        channel = ("uwbslam_msgs/msg/UwbRange", "ros2idl", "cdr", text.encode())
        path = write_raw(
            tmp_path / "a.mcap", {"/scan": SCAN_CHANNEL, "/uwb/ranges": channel}, [("/uwb/ranges", T0, data)]
        )
        assert_same(list(Recording(path)), [RangeMessage(T0, 3, 4, 2.5, -80.0, -82.0)])


NODE2 = "uint8 role\nuint8 id\nfloat32 dis\nfloat32 fp_rssi\nfloat32 rx_rssi\n"
FRAME = "uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\nfloat32 voltage\n{}LinktrackNode2[] nodes\n"
ARRAYS = (
    "".join(f"float32[{n}] {name}\n" for name, n in [("pos_3d", 3), ("eop_3d", 3), ("vel_3d", 3), ("angle_3d", 3)])
    + "float32[4] quaternion\nfloat32[3] imu_gyro_3d\nfloat32[3] imu_acc_3d\n"
)


def ros_header(store: Any, stamp: int) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    return store.types["std_msgs/msg/Header"](time, "any")


class TestForeignTypes:
    @pytest.mark.parametrize(("number", "extra"), [(2, ARRAYS), (3, "")])
    @pytest.mark.parametrize("package", ["nlink_parser", "nlink_parser_ros2"])
    @pytest.mark.parametrize("with_header", [True, False])
    def test_linktrack(self, tmp_path: Path, number: int, extra: str, package: str, with_header: bool) -> None:
        name, node_name = f"{package}/msg/LinktrackNodeframe{number}", f"{package}/msg/LinktrackNode2"
        text = ("std_msgs/Header header\n" if with_header else "") + FRAME.format(extra)
        store: Any = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg(text, name) | get_types_from_msg(NODE2, node_name))
        node = store.types[node_name]
        nodes = [node(2, 1, 2.5, -82.0, -80.0), node(2, 9, -1.0, 0.0, 0.0), node(1, 5, 3.5, -82.0, -80.0)]
        arrays = [np.zeros(n, np.float32) for n in (3, 3, 3, 3, 4, 3, 3)] if extra else []
        head = [ros_header(store, T0 + 5)] if with_header else []
        message = store.types[name](*head, 1, 5, 100, 200, 4.0, *arrays, nodes)
        definition, _ = store.generate_msgdef(name, ros_version=2)
        path = write_raw(
            tmp_path / "a.mcap",
            {"/scan": SCAN_CHANNEL, "/nlink": (name, "ros2msg", "cdr", definition.encode())},
            [("/nlink", T0, bytes(store.serialize_cdr(message, name)))],
        )
        reader = Recording(path)
        stamp = T0 + 5 if with_header else T0
        assert_same(list(reader), [RangeMessage(stamp, 5, 1, 2.5, -80.0, -82.0)])
        assert reader.dropped == {"range: not finite or not positive": 1, "range: from a node to itself": 1}

    def test_linktrack_tag_and_anchor_of_one_id(self, tmp_path: Path) -> None:
        name, node_name = "nlink_parser/msg/LinktrackNodeframe3", "nlink_parser/msg/LinktrackNode2"
        store: Any = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg(FRAME.format(""), name) | get_types_from_msg(NODE2, node_name))
        nodes = [store.types[node_name](1, k, 2.5, -82.0, -80.0) for k in (0, 1)]
        data = bytes(store.serialize_cdr(store.types[name](2, 0, 1, 2, 4.0, nodes), name))
        channel = (name, "ros2msg", "cdr", store.generate_msgdef(name, ros_version=2)[0].encode())
        path = write_raw(tmp_path / "a.mcap", {"/scan": SCAN_CHANNEL, "/nlink": channel}, [("/nlink", T0, data)])
        assert [m.target for m in Recording(path) if isinstance(m, RangeMessage)] == [256, 1]

    @pytest.mark.parametrize("encoding", ["cdr", "ros1"])
    def test_range_stamped(self, tmp_path: Path, encoding: str) -> None:
        head, name = "std_msgs/Header header\n", "uwb_ros/msg/RangeStamped"
        text = head + "float32 range\nuint8 from_id\nuint8 to_id\nfloat32 covariance\nuint64 tx1\nfloat32 fpp1\n"
        store: Any = get_typestore(Stores.ROS2_HUMBLE if encoding == "cdr" else Stores.ROS1_NOETIC)
        store.register(get_types_from_msg(text, name))
        if encoding == "cdr":
            message = store.types[name](ros_header(store, T0), 2.5, 10, 3, 0.0, 1, 0.5)
            data = bytes(store.serialize_cdr(message, name))
            channel = (name, "ros2msg", "cdr", store.generate_msgdef(name, ros_version=2)[0].encode())
        else:
            time = store.types["builtin_interfaces/msg/Time"](*divmod(T0, 10**9))
            message = store.types[name](store.types["std_msgs/msg/Header"](1, time, ""), 2.5, 10, 3, 0.0, 1, 0.5)
            data = bytes(store.serialize_ros1(message, name))
            channel = ("uwb_ros/RangeStamped", "ros1msg", "ros1", store.generate_msgdef(name)[0].encode())
        path = write_raw(tmp_path / "a.mcap", {"/scan": SCAN_CHANNEL, "/uwb": channel}, [("/uwb", T0 + 9, data)])
        assert_same(list(Recording(path)), [RangeMessage(T0, 10, 3, 2.5)])

    def test_a_range_stamped_without_ids_is_no_candidate(self, tmp_path: Path) -> None:
        channel = ("mil_msgs/msg/RangeStamped", "ros2msg", "cdr", b"float64 range\n")
        reader = Recording(write_raw(tmp_path / "a.mcap", {"/scan": SCAN_CHANNEL, "/dvl": channel}, []))
        assert reader.warnings == ["no UWB topic: LiDAR only"]

    def test_foxglove_json(self, tmp_path: Path) -> None:
        time = {"sec": T0 // 10**9, "nsec": T0 % 10**9}
        content = {"timestamp": time, "frame_id": "laser", "pose": {}, "start_angle": -1.0, "end_angle": 1.0}
        data = json.dumps(content | {"ranges": [1.0, None, 3.0], "intensities": []}).encode()
        channel = ("foxglove.LaserScan", "jsonschema", "json", b"{}")
        bad = [("/lidar", T0, data), ("/lidar", T0, b"{"), ("/lidar", T0, b"{}"), ("/lidar", T0, b"[1]")]
        reader = Recording(write_raw(tmp_path / "a.mcap", {"/lidar": channel}, bad))
        wanted = ScanMessage(T0, -1.0, 1.0, 0.0, 0.0, math.inf, np.array([1.0, np.nan, 3.0], np.float32))
        assert_same(list(reader), [wanted])
        assert reader.dropped == {"scan: malformed": 3}

    def test_foxglove_protobuf(self, tmp_path: Path) -> None:
        def field(number: int, content: bytes) -> bytes:
            return bytes([number << 3 | 2, len(content)]) + content

        def varint(value: int) -> bytes:
            out = b""
            while value > 0x7F:
                out, value = out + bytes([value & 0x7F | 0x80]), value >> 7
            return out + bytes([value])

        time = b"\x08" + varint(T0 // 10**9) + b"\x10" + varint(T0 % 10**9)
        ends = b"\x21" + struct.pack("<d", -1.0) + b"\x29" + struct.pack("<d", 1.0)
        head = field(1, time) + field(2, b"laser") + field(3, b"") + ends
        packed = head + field(6, struct.pack("<3d", 1.0, math.inf, 3.0)) + field(7, b"")
        unpacked = head + b"".join(b"\x31" + struct.pack("<d", r) for r in (1.0, math.inf, 3.0))
        channel = ("foxglove.LaserScan", "protobuf", "protobuf", b"")
        messages = [("/lidar", T0, data) for data in (packed, unpacked, packed[:-3], b"\x0b", packed[:60])]
        reader = Recording(write_raw(tmp_path / "a.mcap", {"/lidar": channel}, messages))
        wanted: Message = ScanMessage(T0, -1.0, 1.0, 0.0, 0.0, math.inf, np.array([1.0, np.inf, 3.0], np.float32))
        assert_same(list(reader), [wanted, wanted])
        assert reader.dropped.total() == 3

    def test_foxglove_ros(self, tmp_path: Path) -> None:
        name = "foxglove_msgs/msg/LaserScan"
        text = (
            "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\n"
            "float64 start_angle\nfloat64 end_angle\nfloat64[] ranges\nfloat64[] intensities\n"
        )
        store: Any = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg(text, name))
        time = store.types["builtin_interfaces/msg/Time"](*divmod(T0, 10**9))
        pose = ros_types.pose(0.0, 0.0, 0.0)
        message = store.types[name](time, "laser", pose, -1.0, 1.0, np.array([1.0, 2.0, 3.0]), np.zeros(0))
        channel = (name, "ros2msg", "cdr", store.generate_msgdef(name, ros_version=2)[0].encode())
        data = bytes(store.serialize_cdr(message, name))
        reader = Recording(write_raw(tmp_path / "a.mcap", {"/lidar": channel}, [("/lidar", T0 + 1, data)]))
        wanted = ScanMessage(T0, -1.0, 1.0, 0.0, 0.0, math.inf, np.array([1.0, 2.0, 3.0], np.float32))
        assert_same(list(reader), [wanted])


class TestInspect:
    def test_summary(self, tmp_path: Path) -> None:
        truth: list[Message] = [TruthMessage(T0, None, 0.0, 0.0, 0.0)]
        path = write_log(tmp_path / "a.mcap", [*truth, *log_messages(31), RangeMessage(T0 + 4000 * MS, 0, 1, -1.0)])
        summary = log_summary.inspect_log(path)
        assert summary.ids == {0: 31, 1: 62, 2: 31}
        assert summary.pairs == {(0, 1): 31, (1, 2): 31}
        assert summary.duration == pytest.approx(4.0)
        assert (summary.powers, summary.odometry, summary.ground_truth, summary.beams) == (True, True, True, 7)
        assert summary.dropped == {"range: not finite or not positive": 1}
        assert summary.problems == []
        scans = next(topic for topic in summary.topics if topic.name == "/scan")
        assert (scans.role, scans.count) == ("scan", 31)
        assert scans.rate == pytest.approx(10.0)
        assert scans.largest_gap == pytest.approx(0.1)
        text = str(summary)
        for part in ("/scan", "sensor_msgs/msg/LaserScan", "10.00", "0-1 (31)", "2 of 3", "powers: reported"):
            assert part in text

    def test_what_cannot_run_can_be_inspected(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "a.mcap", [RangeMessage(T0, 0, 1, 1.0)])
        path.write_bytes(path.read_bytes()[:-3])
        summary = log_summary.inspect_log(path)
        assert summary.problems == ["no scan topic"]
        assert summary.truncated is not None
        assert summary.powers is False
        text = str(summary)
        assert "problem: no scan topic" in text
        assert "truncated: recording breaks" in text
        assert math.isnan(summary.topics[0].rate)


def test_intel(shared_data: Path) -> None:
    """Counts as the folder's README says; the first and last messages."""
    reader = Recording(shared_data / "intel" / "intel.mcap")
    assert reader.message_count == 130_355
    first = list(itertools.islice(reader, 200))
    scans = [m for m in first if isinstance(m, ScanMessage)]
    assert scans[0].stamp == 1_700_000_000 * 10**9
    assert scans[0].ranges.shape == (180,)
    assert scans[0].ranges.dtype == np.float32
    assert all(0 <= m.source <= 6 and m.range < 60 for m in first if isinstance(m, RangeMessage))
    assert reader.dropped.total() == 0
    assert reader.topics == {"/scan": "scan", "/uwb/ranges": "uwb", "/odom": "odom"}
