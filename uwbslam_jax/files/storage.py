"""What else recordings are kept in: ROS 2 bags in SQLite, and any kind compressed as a whole.

Every kind has the face of `mcap_container.McapFile`; ROS 1 bags are `ros1_bag`. Of SQLite's few tables we read what is
there, so that a database without its metadata.yaml, or of any age, is a recording too.
"""

from __future__ import annotations

import sqlite3
import tempfile
import weakref
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Protocol, runtime_checkable

import zstandard

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.compression import DamagedError, decompress
from uwbslam_jax.files.mcap_container import MAGIC, Channel, McapFile, RawMessage
from uwbslam_jax.files.ros1_bag import Ros1Bag

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""What zstd data begin with [bytes] (RFC 8878); no CDR message does."""
_SQLITE_MAGIC, _ROS1_MAGIC = b"SQLite format 3\x00", b"#ROSBAG V"
"""What a database and a ROS 1 bag begin with [bytes]."""
_PACKED = {
    b"\x1f\x8b": "gzip",
    b"BZh": "bzip2",
    b"\xfd7zXZ\x00": "xz",
    b"PK\x03\x04": "zip",
    b"\x04\x22\x4d\x18": "lz4",
}
"""Other compressions of a whole file [first bytes -> name]: they are named, not read."""
_PLENTY_BYTES, _MOST_TIMES = 1 << 30, 200
"""A compressed file that unpacks to more than 1 GiB and so many times its own size is damaged, or meant to fill the
disk [bytes, ratio]: scans and ranges shrink to a tenth or so."""
_LARGEST_MESSAGE = 1 << 26
"""A compressed message that unpacks to more is damaged [bytes]."""
_DAMAGED_ROWS = (sqlite3.Error, TypeError, ValueError)
"""What a damaged database raises [exceptions]: a column may also hold another type than it was made for."""


@runtime_checkable
class Part(Protocol):
    """One file of a recording, opened for reading; see `mcap_container.McapFile`."""

    path: Path
    channels: dict[int, Channel]
    counts: Counter[int]
    start: int
    end: int

    @property
    def truncated(self) -> str | None:
        """Where and why the file breaks, None where it does not."""
        ...

    def records(self, channels: set[int] | None = None) -> Iterator[RawMessage]:
        """Yields the messages of these channels (all by default) by log time."""
        ...


def open_part(path: Path) -> Part:
    """Opens a file by what it begins with, whatever it is called.

    Raises:
      LogError: it cannot be read, or is none of these kinds.
    """
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}") from None
    if head.startswith(ZSTD_MAGIC):
        return _Unpacked(path)
    if head.startswith(_SQLITE_MAGIC):
        return _Database(path)
    if head.startswith(_ROS1_MAGIC):
        return Ros1Bag(path)
    packed = next((name for magic, name in _PACKED.items() if head.startswith(magic)), None)
    if packed:
        raise LogError(f"{path}: packed with {packed}, which is not read: unpack it first")
    if head and not head.startswith(MAGIC):
        raise LogError(f"{path}: not a recording: neither an MCAP file nor a ROS 1 bag nor a ROS 2 bag in SQLite")
    return McapFile(path)


def unpack_message(data: bytes) -> bytes:
    """What rosbag2 compressed with zstd message by message; as it is where it does not unpack."""
    try:
        found = decompress(data, "zstd", _LARGEST_MESSAGE + 1)
    except DamagedError:
        return data
    return found if len(found) <= _LARGEST_MESSAGE else data


class _Unpacked:
    """A file compressed with zstd as a whole, read from a temporary copy that goes when the part goes."""

    def __init__(self, path: Path):
        self.path = path
        self._copy = tempfile.NamedTemporaryFile(prefix="uwbslam_")  # noqa: SIM115 - it is kept as long as the part
        weakref.finalize(self, self._copy.close)
        self._cut: str | None = None
        try:
            self._cut = self._unpack()
            self._part = open_part(Path(self._copy.name))
        except OSError as error:
            where = tempfile.gettempdir()
            raise LogError(f"{path}: cannot be unpacked into {where}: {error.strerror or error}") from None
        except LogError as error:
            why = f"{path}: {self._cut}" if self._cut else str(error).replace(self._copy.name, str(path))
            raise LogError(why) from None
        self.channels, self.counts = self._part.channels, self._part.counts
        self.start, self.end = self._part.start, self._part.end

    def _unpack(self) -> str | None:
        """Fills the copy; says what is wrong with the compressed file, None where nothing is."""
        size, most = 0, _PLENTY_BYTES + _MOST_TIMES * self.path.stat().st_size
        plain = zstandard.ZstdDecompressor()
        try:
            with self.path.open("rb") as file, plain.stream_reader(file, read_across_frames=True) as stream:
                while block := stream.read(1 << 20):
                    size += len(block)
                    if size > most:
                        raise LogError(f"{self.path}: unpacks to over {most >> 20} MiB: it is damaged")
                    self._copy.write(block)
            return None
        except zstandard.ZstdError as error:
            return f"the compressed file is damaged: {error}"
        finally:
            self._copy.flush()

    @property
    def truncated(self) -> str | None:
        return "; ".join(filter(None, (self._cut, self._part.truncated))) or None

    def records(self, channels: set[int] | None = None) -> Iterator[RawMessage]:
        return self._part.records(channels)


class _Database:
    """A ROS 2 bag in SQLite (.db3): tables topics, messages and, from 2023 on, message_definitions."""

    def __init__(self, path: Path):
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.truncated: str | None = None
        self.start = self.end = 0
        try:
            with closing(self._open()) as database:
                self._take_stock(database)
        except _DAMAGED_ROWS as error:
            raise LogError(f"{path}: not a readable ROS 2 bag in SQLite: {error}") from None

    def _open(self) -> sqlite3.Connection:
        # immutable: one on a read-only disk too, and what a recorder that was killed has left is not written back
        wal = self.path.with_name(f"{self.path.name}-wal")
        return sqlite3.connect(
            f"{self.path.absolute().as_uri()}?mode=ro{'' if wal.exists() else '&immutable=1'}", uri=True
        )

    def _take_stock(self, database: sqlite3.Connection) -> None:
        known = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in known:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {str(name): (str(language), str(text)) for name, language, text in database.execute(query)}
        for number, topic, schema, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            language, text = definitions.get(str(schema), ("", ""))
            about = str(topic), str(encoding), str(schema), language, text.encode()
            self.channels[int(number)] = Channel(int(number), *about)
        try:
            for number, count in database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"):
                self.counts[int(number)] = count
            first, last = database.execute("SELECT min(timestamp), max(timestamp) FROM messages").fetchone()
            self.start, self.end = first or 0, last or 0
        except _DAMAGED_ROWS as error:
            self.truncated = f"the database is damaged: {error}"

    def records(self, channels: set[int] | None = None) -> Iterator[RawMessage]:
        """Yields the messages of these channels (all by default) by log time; ends where the database is damaged."""
        wanted = ",".join(str(number) for number in (self.channels if channels is None else channels))
        query = f"SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({wanted}) ORDER BY timestamp, id"
        last = self.start
        try:
            with closing(self._open()) as database:
                for last, number, data in database.execute(query):
                    yield RawMessage(int(last), int(number), bytes(memoryview(data)))
        except _DAMAGED_ROWS as error:
            self.truncated = f"recording breaks after {(last - self.start) * 1e-9:.1f} s: {error}"
