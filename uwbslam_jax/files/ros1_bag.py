"""ROS 1 bags, version 2.0, with the face of `mcap_container.McapFile`.

They are read by rosbags, which believes what a file says of its sizes: what is unpacked and indexed has limits here.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Chunk, Header, IndexData, RecordType

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.compression import DamagedError, believable, decompress
from uwbslam_jax.files.mcap_container import Channel, RawMessage

_DAMAGED = (
    ReaderError,
    struct.error,
    AssertionError,
    RuntimeError,
    OSError,
    ValueError,
    LookupError,
    EOFError,
    MemoryError,
    zlib.error,
)
"""What reading a damaged bag raises [exceptions]: rosbags passes on those of struct and the builtins."""


class Ros1Bag:
    """A ROS 1 bag opened for reading.

    Attributes:
      path: the file read.
      channels: every channel by its number. counts: messages by channel number.
      truncated: where and why the recording breaks, None where it does not (or is not known to, before `records`).
      start, end: first and last log time [ns]; both 0 for a recording without messages.
    """

    def __init__(self, path: Path):
        """Reads the index. Raises LogError: it is not readable, or has no index."""
        self.path = path
        self.truncated: str | None = None
        try:
            with _Reader(path) as bag:
                self.channels = {c.id: _channel(c.id, c.topic, c.msgtype, c.msgdef.data) for c in bag.connections}
                self.counts = Counter({c.id: c.msgcount for c in bag.connections})
                spoken = bool(self.counts.total())
                self.start, self.end = (bag.start_time, bag.end_time - 1) if spoken else (0, 0)
        except _DAMAGED as error:
            raise LogError(f"{path}: not a readable ROS 1 bag ({_why(error)}): rosbag reindex may mend it") from None

    def records(self, channels: set[int] | None = None) -> Iterator[RawMessage]:
        """Yields the messages of these channels (all by default) by log time; ends where a chunk is damaged."""
        last = self.start
        try:
            with _Reader(self.path) as bag:
                wanted = [c for c in bag.connections if channels is None or c.id in channels]
                left = bag.unpacked
                if wanted:  # none would mean all
                    for connection, last, data in bag.messages(wanted):
                        left -= len(data)
                        if left < 0:
                            raise ReaderError("its index names messages twice")
                        yield RawMessage(last, connection.id, data)
        except _DAMAGED as error:
            self.truncated = f"recording breaks after {(last - self.start) * 1e-9:.1f} s: {_why(error)}"


class _Reader(Reader):
    """rosbags' reader, with limits.

    Attributes:
      unpacked: what all chunks hold together, as they say [bytes].
    """

    def __init__(self, path: Path):
        super().__init__(path)
        self.unpacked = 0
        self._unread = path.stat().st_size  # of the index [bytes]: it is a part of the file

    def read_chunk(self) -> Chunk:
        """The chunk at the current position, with a decompressor that ends where the chunk says it does."""
        assert self.bio is not None
        at = self.bio.tell()
        header = Header.read(self.bio, RecordType.CHUNK)
        size, kind = header.get_uint32("size"), header.get_string("compression")
        self.bio.seek(at)
        chunk = super().read_chunk()
        if not believable(size, chunk.datasize):
            raise ReaderError(f"a chunk of {chunk.datasize} bytes says that it unpacks to {size}")
        self.unpacked += size
        return chunk._replace(decompressor=partial(_content, kind="" if kind == "none" else kind, size=size))

    def read_index_data(self, pos: int, indexes: defaultdict[int, list[IndexData]]) -> None:
        """The index of one connection in a chunk, at the current position."""
        assert self.bio is not None
        at = self.bio.tell()
        super().read_index_data(pos, indexes)
        self._unread -= self.bio.tell() - at
        if self._unread < 0:
            raise ReaderError("its chunks share an index")


def _content(stored: bytes, *, kind: str, size: int) -> bytes:
    """The records of a chunk, decompressed. Raises ReaderError."""
    try:
        content = decompress(stored, kind, size + 1)  # one more than there may be
    except DamagedError as error:
        raise ReaderError(f"a chunk {error}") from None
    if len(content) != size:
        raise ReaderError("a chunk does not unpack to the size it says")
    return content


def _channel(number: int, topic: str, schema: str, definition: str) -> Channel:
    return Channel(number, topic, "ros1", schema, "ros1msg", definition.encode())


def _why(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
