"""Recordings in other containers than a plain MCAP file: bags in SQLite, ROS 1 bags, compressed ones, damaged ones."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uwbslam_jax.errors import LogError
from uwbslam_jax.files import LogWriter, Recording, inspect_log, ros_types
from uwbslam_jax.files.storage import open_part
from uwbslam_jax.measurements import Message, RangeMessage, ScanMessage

MS = 1_000_000
T0 = 1_700_000_000_000_000_000


def drive(count: int = 30) -> list[Message]:
    """A scan every 100 ms and a range with each."""
    ranges = np.linspace(1.0, 2.0, 40, dtype=np.float32)
    times = [T0 + k * 100 * MS for k in range(count)]
    scans: list[Message] = [ScanMessage(t, -1.5, 0.125, 0.0, 0.125, 30.0, ranges) for t in times]
    heard: list[Message] = [RangeMessage(t + MS, 0, 1 + k % 3, 2.5 + k, -80.0, -82.0) for k, t in enumerate(times)]
    return [message for pair in zip(scans, heard, strict=True) for message in pair]


def key(message: Message) -> tuple:
    return message.stamp, type(message), getattr(message, "range", None), getattr(message, "target", None)


def write_mcap(path: Path, messages: list[Message]) -> Path:
    with LogWriter(path) as writer:
        for message in messages:
            writer.write(message)
    return path


def topic_of(message: Message) -> str:
    return "/scan" if isinstance(message, ScanMessage) else "/uwb/ranges"


def write_db3(path: Path, messages: list[Message]) -> Path:
    """The tables that rosbag2 wrote until 2023, without definitions."""
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        for number, (topic, schema) in enumerate(
            {"/scan": "sensor_msgs/msg/LaserScan", "/uwb/ranges": ros_types.UWB_RANGE}.items(), 1
        ):
            database.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr')", (number, topic, schema))
        for message in messages:
            number = 1 if isinstance(message, ScanMessage) else 2
            row = (number, message.stamp, ros_types.encode(message)[1])
            database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", row)
    database.close()
    return path


def ros1_store() -> Any:
    store: Any = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(ros_types.UWB_RANGE_TEXT, ros_types.UWB_RANGE))
    return store


def in_ros1(store: Any, message: Message) -> tuple[str, bytes]:
    """Type and bytes of a message in ROS 1."""
    humble: Any = ros_types.STORE
    schema, data = ros_types.encode(message)
    filled = humble.deserialize_cdr(data, schema)
    header = store.types["std_msgs/msg/Header"](0, filled.header.stamp, filled.header.frame_id)
    fields = {n: getattr(filled, n) for n in store.types[schema].__dataclass_fields__ if n != "__msgtype__"}
    return schema, bytes(store.serialize_ros1(store.types[schema](**fields | {"header": header}), schema))


def write_ros1(path: Path, messages: list[Message], packed: Any = None) -> Path:
    """packed: how its chunks are compressed."""
    store, writer = ros1_store(), Ros1Writer(path)
    if packed is not None:
        writer.set_compression(packed)
    with writer:
        connections = {}
        for message in messages:
            schema, data = in_ros1(store, message)
            if schema not in connections:
                connections[schema] = writer.add_connection(topic_of(message), schema, typestore=store)
            writer.write(connections[schema], message.stamp, data)
    return path


def write_plain(
    path: Path, messages: list[Message], pack: Callable[[bytes], bytes] = bytes, *, ros1: bool = False, **options: Any
) -> Path:
    """By the mcap package; pack: what is done to each message's bytes, options: of its writer."""
    store = ros1_store()
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros1" if ros1 else "ros2")
        channels: dict[str, int] = {}
        for message in messages:
            schema, data = in_ros1(store, message) if ros1 else ros_types.encode(message)
            if schema not in channels and ros1:
                text = store.generate_msgdef(schema, ros_version=1)[0].encode()
                number = writer.register_schema(schema.replace("/msg/", "/"), "ros1msg", text)
                channels[schema] = writer.register_channel(topic_of(message), "ros1", number)
            elif schema not in channels:
                number = writer.register_schema(schema, "ros2msg", ros_types.definition(schema))
                channels[schema] = writer.register_channel(topic_of(message), "cdr", number)
            writer.add_message(channels[schema], message.stamp, pack(data), message.stamp)
        writer.finish()
    return path


def write_compressed_messages(path: Path, messages: list[Message]) -> Path:
    """As rosbag2 does with compression mode message."""
    return write_plain(path, messages, zstandard.ZstdCompressor().compress, compression=CompressionType.NONE)


def write_without_sizes(path: Path, messages: list[Message]) -> Path:
    """Chunks compressed by a stream, which does not know how long it will be."""
    with mock.patch("zstandard.compress", zstandard.ZstdCompressor(write_content_size=False).compress):
        return write_plain(path, messages)


def write_without_index(path: Path, messages: list[Message]) -> Path:
    """Neither summary nor index, as some recorders leave a file."""
    off = ("use_statistics", "use_summary_offsets", "repeat_channels", "repeat_schemas")
    return write_plain(path, messages, index_types=IndexType.NONE, **dict.fromkeys(off, False))


def write_unsorted(path: Path, messages: list[Message]) -> Path:
    order = np.random.default_rng(0).permutation(len(messages))
    return write_plain(path, [messages[k] for k in order])


def write_zstd(path: Path, messages: list[Message]) -> Path:
    plain = write_mcap(path.with_suffix(".plain"), messages)
    path.write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    plain.unlink()
    return path


def write_db3_zstd(path: Path, messages: list[Message]) -> Path:
    plain = write_db3(path.with_suffix(".plain"), messages)
    path.write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    plain.unlink()
    return path


KINDS: dict[str, Callable[[Path, list[Message]], Path]] = {
    "a_0.mcap": write_mcap,
    "a_0.db3": write_db3,
    "a_0.bag": write_ros1,
    "a_0.mcap.zstd": write_zstd,
    "a_0.db3.zstd": write_db3_zstd,
    "messages_0.mcap": write_compressed_messages,
}
PACKED: dict[str, Callable[[Path, list[Message]], Path]] = {
    "lz4.mcap": partial(write_plain, compression=CompressionType.LZ4),
    "none.mcap": partial(write_plain, compression=CompressionType.NONE),
    "unchunked.mcap": partial(write_plain, use_chunking=False),
    "nocrc.mcap": partial(write_plain, enable_crcs=False),
    "noindex.mcap": write_without_index,
    "zstd_nosize.mcap": write_without_sizes,
    "unsorted.mcap": write_unsorted,
    "ros1.mcap": partial(write_plain, ros1=True),
    "bz2.bag": partial(write_ros1, packed=Ros1Writer.CompressionFormat.BZ2),
    "lz4.bag": partial(write_ros1, packed=Ros1Writer.CompressionFormat.LZ4),
    "bag.mcap": write_ros1,
    "mcap.bag": write_mcap,
}
"""The same in other ways of packing; the last two are named as the other."""


def metadata(folder: Path, names: list[str]) -> None:
    listed = "".join(f"    - {name}\n" for name in names)
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{listed}")


@pytest.mark.parametrize("name", [*KINDS, *PACKED])
def test_every_container_gives_the_same_messages(tmp_path: Path, name: str) -> None:
    wanted = [key(message) for message in drive()]
    path = (KINDS | PACKED)[name](tmp_path / name, drive())
    assert not inspect_log(path).problems
    for source in (path, tmp_path):  # alone, and in a folder without metadata
        reader = Recording(source)
        for _ in range(2):
            assert [key(message) for message in reader] == wanted
        assert (reader.message_count, reader.truncated, reader.dropped.total()) == (len(wanted), None, 0)
        assert reader.duration == pytest.approx(2.901)


@pytest.mark.parametrize("name", ["a_0.mcap", "a_0.db3", "a_0.mcap.zstd"])
def test_bags_in_folders(tmp_path: Path, name: str) -> None:
    wanted = [key(message) for message in drive()]
    folder = tmp_path / "bag"
    folder.mkdir()
    series, suffix = name.split("_0")
    for k in range(12):  # 10 comes after 9
        KINDS[name](folder / f"{series}_{k}{suffix}", drive()[k * 5 : k * 5 + 5])
    names = [f"{series}_{k}{suffix}" for k in range(12)]
    metadata_kinds: list[list[str] | None] = [
        None,  # there is none
        [],  # an empty one
        names,
        [f"bag/{each}" for each in names],  # with the folder's name, as older ones have it
        [each.replace(series, "old") for each in names],  # renamed since
        [each.removesuffix(".zstd") for each in names],  # compressed since
    ]
    for listed in metadata_kinds:
        if listed is not None:
            metadata(folder, listed)
        assert [key(message) for message in Recording(folder)] == wanted
    (folder / "metadata.yaml").unlink()
    (folder / names[3]).unlink()
    with pytest.raises(LogError, match="name those that are"):
        Recording(folder)


def test_one_that_was_unpacked_beside_its_compressed_file_is_read_once(tmp_path: Path) -> None:
    write_zstd(tmp_path / "a_0.mcap.zstd", drive())
    write_mcap(tmp_path / "a_0.mcap", drive())
    assert len(list(Recording(tmp_path))) == len(drive())


def test_parts_of_a_ros_1_bag_are_named_after_their_time(tmp_path: Path) -> None:
    for k, part in enumerate((drive()[:20], drive()[20:])):
        write_ros1(tmp_path / f"lab_2024-05-01-10-0{k}-00_{k}.bag", part)
    assert [key(message) for message in Recording(tmp_path)] == [key(message) for message in drive()]


@pytest.mark.parametrize("name", [name for name in KINDS if name != "a_0.mcap"])
def test_damaged_ones_give_what_is_there_or_one_line(tmp_path: Path, name: str) -> None:
    whole = KINDS[name](tmp_path / name, drive()).read_bytes()
    rng = np.random.default_rng(0)
    path = tmp_path / f"damaged_{name}"
    for trial in range(25):
        data = bytearray(whole[: int(rng.integers(1, len(whole)))] if trial % 2 else whole)
        if trial % 2 == 0:
            for at in rng.integers(0, len(data), 8):
                data[at] = int(rng.integers(256))
        path.write_bytes(data)
        told = str(path)
        try:
            assert len(list(Recording(path))) <= len(drive())
        except LogError as error:
            told = str(error)
        assert str(path) in told
        assert "\n" not in told


def test_a_message_that_does_not_unpack_is_counted(tmp_path: Path) -> None:
    path = write_compressed_messages(tmp_path / "a.mcap", drive())
    packed = zstandard.ZstdCompressor().compress(ros_types.encode(drive()[0])[1])
    data = path.read_bytes()
    assert packed in data
    path.write_bytes(data.replace(packed, packed[:4] + b"\xff" * (len(packed) - 4)))
    reader = Recording(path)
    assert len(list(reader)) + reader.dropped.total() == len(drive()) or reader.truncated


def test_a_compressed_file_that_grows_beyond_reason_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("uwbslam_jax.files.storage._PLENTY_BYTES", 1 << 20)
    (tmp_path / "a.mcap.zstd").write_bytes(zstandard.ZstdCompressor().compress(bytes(1 << 24)))
    with pytest.raises(LogError, match=r"a\.mcap\.zstd: unpacks to over"):
        Recording(tmp_path / "a.mcap.zstd")


def patched(path: Path, field: bytes, value: int) -> Path:
    """A ROS 1 bag in whose first header with a field another number of 32 bits stands."""
    data = path.read_bytes()
    at = data.index(field + b"=") + len(field) + 1
    path.write_bytes(data[:at] + value.to_bytes(4, "little") + data[at + 4 :])
    return path


@pytest.mark.parametrize("packed", list(Ros1Writer.CompressionFormat))
def test_chunks_of_a_ros_1_bag_unpack_to_no_more_than_they_say(tmp_path: Path, packed: Any) -> None:
    bag = open_part(patched(write_ros1(tmp_path / "a.bag", drive(), packed), b"size", 1000))
    assert list(bag.records()) == []
    assert "does not unpack to the size it says" in str(bag.truncated)
    with pytest.raises(LogError, match=r"a chunk of \d+ bytes says that it unpacks to 2000000000"):
        open_part(patched(tmp_path / "a.bag", b"size", 2_000_000_000))


def test_chunks_of_a_ros_1_bag_do_not_share_an_index(tmp_path: Path) -> None:
    path, many = write_ros1(tmp_path / "a.bag", drive()), 100
    data = path.read_bytes()
    infos = data[_last_record(data) :]
    path.write_bytes(data + infos * (many - 1))
    with pytest.raises(LogError, match="its chunks share an index"):
        open_part(patched(path, b"chunk_count", many))


def _last_record(data: bytes) -> int:
    """Where the last record of a ROS 1 bag begins."""
    at = last = data.index(b"\n") + 1
    while at < len(data):
        last = at
        for _ in range(2):  # header and content
            at += 4 + int.from_bytes(data[at : at + 4], "little")
    return last
