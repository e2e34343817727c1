"""MCAP as a container: topics and raw messages out of a file, whole or broken, and into a new one.

Knows no message type: what the bytes of a message say is `schemas`, which topic means what is `mcap_log`.
The records are walked here rather than by the mcap package's reader, because that one gives up on a file without
its end, and short reads at a break would pass as messages.
"""

from __future__ import annotations

import io
import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple

from mcap import records as mcap_record_types
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.writer import Writer

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.compression import DamagedError, believable, decompress

MAGIC = b"\x89MCAP0\r\n"
"""What a file begins and ends with [bytes] (MCAP specification)."""
PLAIN_BLOCK_BYTES = 1 << 20
"""Unchunked messages are read so many at a time [bytes]."""
_HEADER, _MESSAGE, _CHUNK = struct.Struct("<BQ"), struct.Struct("<BQH4xQ8x"), struct.Struct("<QQQII")
"""Opcode, length; of a message channel and log time besides; a chunk's first and last log time, size, crc,
length of the compression's name [bytes] (MCAP specification, Records)."""


_SET_BACK, _MOST_SET_BACK = 1_000_000_000, 8
"""A channel's log times that go back by more, so many times at most, tell of a clock that was set back [ns, times]: in
a file that is not in order they go back everywhere."""


class _CorruptError(Exception):
    """A chunk that does not decompress, or not to what its checksum says."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic of a recording, its number in the file, and how its messages are encoded.

    Attributes:
      encoding: of the messages ("cdr", "ros1", "json", "protobuf").
      schema: name of the message type, "" where the file names none.
      schema_encoding: language of the definition ("ros2msg", "ros2idl", "ros1msg", ...).
      definition: text or bytes of the schema.
    """

    id: int
    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    definition: bytes


class RawMessage(NamedTuple):
    """An undecoded message; log_time is when it was recorded [ns]."""

    log_time: int
    channel: int
    data: bytes


class _Block(NamedTuple):
    """A span of the file that holds messages: the content of a chunk, or a run of messages outside any chunk."""

    record: int  # where the record starts [byte]
    offset: int  # where the content starts [byte]
    length: int  # of the content as stored [bytes]
    start: int  # first log time [ns]
    end: int  # last log time [ns]
    size: int  # of the content once decompressed [bytes]
    crc: int  # of the content, 0 where not known
    compression: str
    whole: bool  # False where the file ends inside


class _Part(NamedTuple):
    """Messages of a block, from the first of these numbers to before the other one; start: their first log time."""

    start: int
    block: _Block
    first: int = 0
    end: int | None = None


class McapFile:
    """An MCAP file opened for reading.

    Attributes:
      path: the file read.
      channels: every channel by its number.
      counts: messages by channel number (of a broken file: those that are whole).
      truncated: where and why the recording breaks, None where it does not (or is not known to, before `records`).
      start, end: first and last log time [ns]; both 0 for a recording without messages.
    """

    def __init__(self, path: str | Path):
        """Walks the record headers; decompresses only where the file has no summary.

        Raises:
          LogError: not an MCAP, empty, or not readable.
        """
        self.path = Path(path)
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.truncated: str | None = None
        self.start = self.end = 0
        self._schemas: dict[int, mcap_record_types.Schema] = {}
        self._statistics: mcap_record_types.Statistics | None = None
        try:
            self.size = self.path.stat().st_size
            with self.path.open("rb") as file:
                self._check_magic(file)
                self._blocks, broken_at = self._walk(file)
                self._take_stock(file, broken_at)
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror or error}") from None

    def records(self, channels: set[int] | None = None) -> Iterator[RawMessage]:
        """Yields the messages of these channels (all by default) by log time, equal ones in file order.

        Where the recorder's clock was set back, what was recorded later comes later, and log times go back there.
        Chunks whose times overlap are merged, so that memory grows with the overlap, not with the file. Sets
        `truncated` and ends where a chunk turns out corrupt.
        """
        with self.path.open("rb") as file:
            for parts in self._epochs:
                if not (yield from self._in_order(file, parts, channels)):
                    return

    def _in_order(
        self, file: BinaryIO, parts: list[_Part], channels: set[int] | None
    ) -> Generator[RawMessage, Any, bool]:
        """The messages of parts in the order of their starts; False where a chunk is corrupt."""
        pending: list[RawMessage] = []
        last = self.start
        for index, part in enumerate(parts):
            try:
                pending += self._messages_of(file, part, channels)
            except _CorruptError as error:
                self._break(part.block.record, max([last, *(m.log_time for m in pending)]), str(error))
                yield from pending
                return False
            pending.sort(key=attrgetter("log_time"))
            ahead = parts[index + 1].start if index + 1 < len(parts) else None
            cut = len(pending) if ahead is None else bisect_right(pending, ahead, key=attrgetter("log_time"))
            ready, pending = pending[:cut], pending[cut:]
            last = ready[-1].log_time if ready else last
            yield from ready
        yield from pending
        return True

    def _messages_of(self, file: BinaryIO, part: _Part, channels: set[int] | None) -> list[RawMessage]:
        content = self._content(file, part.block)
        if part.first == 0 and part.end is None:
            return self._messages(content, channels)
        some = self._messages(content, None)[part.first : part.end]
        return [message for message in some if channels is None or message.channel in channels]

    def _by_clock(self, file: BinaryIO) -> list[list[_Part]]:
        """Parts to be read one after the other, each by log time: several where the recorder's clock was set back, as
        the log times of its channels tell; one where messages are only not in order."""
        blocks, latest = self._blocks, 0
        whole = [sorted((_Part(block.start, block) for block in blocks), key=attrgetter("start"))]
        back = len(blocks) == 1  # nothing to compare with
        for block in blocks:
            back, latest = back or block.start < latest - _SET_BACK, max(latest, block.end)
        if not back:
            return whole
        epochs: list[list[_Part]] = [[]]
        heard: dict[int, int] = {}
        for block in blocks:
            try:
                messages = self._messages(self._content(file, block), None)
            except _CorruptError:
                return whole
            cuts = [0]
            for k, (log_time, channel, _) in enumerate(messages):
                if log_time < heard.get(channel, 0) - _SET_BACK:
                    heard.clear()
                    cuts.append(k)
                heard[channel] = log_time
            for first, end in zip(cuts, [*cuts[1:], None], strict=True):
                epochs += [[]] if first else []
                if some := messages[first:end]:
                    epochs[-1].append(_Part(min(m.log_time for m in some), block, first, end))
            if len(epochs) > _MOST_SET_BACK:
                return whole
        return [sorted(parts, key=attrgetter("start")) for parts in epochs] if len(epochs) > 1 else whole

    def _check_magic(self, file: BinaryIO) -> None:
        head = file.read(16)
        if not head:
            raise LogError(f"{self.path}: the file is empty")
        if head.startswith(MAGIC):
            return
        raise LogError(f"{self.path}: not an MCAP file")

    def _walk(self, file: BinaryIO) -> tuple[list[_Block], int | None]:
        """Record by record through the file; returns the blocks and the byte where it breaks, None if it ends well."""
        blocks: list[_Block] = []
        position = len(MAGIC)
        while True:
            file.seek(position)
            header = file.read(_MESSAGE.size)
            if len(header) < _HEADER.size:
                return blocks, position
            opcode, length = _HEADER.unpack_from(header)
            end = position + _HEADER.size + length
            if opcode == Opcode.CHUNK:
                block = self._chunk_at(file, position)
                blocks += [block] if block else []
                if block is None or not block.whole or end > self.size:
                    return blocks, position
            elif opcode == 0 or end > self.size:  # 0 is no opcode: a file that was allocated and never written
                return blocks, position
            elif opcode == Opcode.MESSAGE and len(header) == _MESSAGE.size:
                _add_plain(blocks, position, end - position, _MESSAGE.unpack(header)[3])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
                file.seek(position + _HEADER.size)
                self._learn(opcode, file.read(length))
            elif opcode == Opcode.FOOTER:
                file.seek(end)
                return blocks, (None if file.read(len(MAGIC)) == MAGIC else end)
            position = end

    def _chunk_at(self, file: BinaryIO, position: int) -> _Block | None:
        """The chunk record at this byte, None where not even its head is whole."""
        file.seek(position)
        head = file.read(_HEADER.size + _CHUNK.size)
        if len(head) < _HEADER.size + _CHUNK.size:
            return None
        start, last, size, crc, name_length = _CHUNK.unpack_from(head, _HEADER.size)
        tail = file.read(name_length + 8) if name_length <= 64 else b""  # "zstd" or "lz4": anything long is noise
        if len(tail) < name_length + 8:
            return None
        (length,) = struct.unpack_from("<Q", tail, name_length)
        offset = position + len(head) + len(tail)
        compression = tail[:name_length].decode("utf-8", "replace")
        stored = min(length, self.size - offset)
        return _Block(position, offset, stored, start, last, size, crc, compression, stored == length)

    def _take_stock(self, file: BinaryIO, broken_at: int | None) -> None:
        """Channels, counts and times: from the summary, or by reading through where there is none."""
        summary = self._statistics
        if broken_at is None and summary and summary.channel_count <= len(self.channels):
            self.counts.update(summary.channel_message_counts)
        if summary and self.counts.total() == summary.message_count:
            self.start, self.end = summary.message_start_time, summary.message_end_time
        else:
            self.counts.clear()
            for index, block in enumerate(self._blocks):
                try:
                    messages = self._messages(self._content(file, block), None)
                except _CorruptError as error:
                    del self._blocks[index:]
                    self._break(block.record, self.end, str(error))
                    break
                self.counts.update(message.channel for message in messages)
                times = [message.log_time for message in messages]
                self.start = min([self.start or times[0], *times]) if times else self.start
                self.end = max([self.end, *times])
        if broken_at is not None and self.truncated is None:
            self._break(broken_at, self.end, "")
        self._epochs = self._by_clock(file)

    def _content(self, file: BinaryIO, block: _Block) -> bytes:
        """The records of a block, decompressed; of a block that the file ends in, those bytes that are there."""
        file.seek(block.offset)
        stored = file.read(block.length)
        if not believable(block.size, block.length):
            raise _CorruptError(f"a chunk of {block.length} bytes says that it unpacks to {block.size}")
        try:
            content = decompress(stored, block.compression, block.size + 1)  # one more than there may be
        except DamagedError as error:
            if block.whole:
                raise _CorruptError(f"a chunk {error}") from None
            return b""
        if block.whole and (len(content) != block.size or (block.crc and zlib.crc32(content) != block.crc)):
            raise _CorruptError("a chunk does not match its checksum")
        return content

    def _messages(self, content: bytes, channels: set[int] | None) -> list[RawMessage]:
        """Whole messages of these channels in file order; schemas and channels on the way are learnt."""
        found: list[RawMessage] = []
        is_message, head, whole = int(Opcode.MESSAGE), _HEADER.size, _MESSAGE.size
        unpack, make = _MESSAGE.unpack_from, tuple.__new__  # RawMessage(...) is a function in Python: half as fast
        position, size, channel, log_time = 0, len(content), 0, 0
        while position + head <= size:
            if position + whole <= size:
                opcode, length, channel, log_time = unpack(content, position)
            else:  # too short for a message
                opcode, length = _HEADER.unpack_from(content, position)
            end = position + head + length
            if end > size:
                break
            if opcode == is_message and length >= whole - head:
                if channels is None or channel in channels:
                    found.append(make(RawMessage, (log_time, channel, content[position + whole : end])))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._learn(opcode, content[position + head : end])
            position = end
        return found

    def _learn(self, opcode: int, content: bytes) -> None:
        """Takes in a schema, channel or statistics record; what does not parse or lacks its schema is left out."""
        stream = ReadDataStream(io.BytesIO(content))
        try:
            if opcode == Opcode.SCHEMA:
                schema = mcap_record_types.Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.STATISTICS:
                self._statistics = mcap_record_types.Statistics.read(stream)
            else:
                channel = mcap_record_types.Channel.read(stream)
                schema = self._schemas.get(channel.schema_id)
                if schema or channel.schema_id == 0:
                    about = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
                    found = Channel(channel.id, channel.topic, channel.message_encoding, *about)
                    self.channels.setdefault(found.id, found)
        except (McapError, struct.error, ValueError):
            pass

    def _break(self, byte: int, last: int, why: str) -> None:
        seconds = max(last - self.start, 0) * 1e-9
        where = f"recording breaks after {seconds:.1f} s (byte {byte} of {self.size})"
        self.truncated = f"{where}: {why}" if why else where


def _add_plain(blocks: list[_Block], position: int, length: int, log_time: int) -> None:
    """Appends a message outside any chunk to the run before it, or begins a new run."""
    if blocks:
        last = blocks[-1]
        joined = last.length + length
        if last.record == last.offset and last.offset + last.length == position and joined <= PLAIN_BLOCK_BYTES:
            blocks[-1] = last._replace(
                length=joined, size=joined, start=min(last.start, log_time), end=max(last.end, log_time)
            )
            return
    blocks.append(_Block(position, position, length, log_time, log_time, length, 0, "", True))


class RecordWriter:
    """Writes an MCAP file of profile ros2 in zstd chunks; a context manager that always finishes the file."""

    def __init__(self, path: str | Path, *, chunk_size: int = 1 << 17):
        """Opens the file. A killed process loses what came after the last full chunk or `flush`. Raises LogError."""
        self.path = Path(path)
        try:
            self._file = self.path.open("wb")
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror or error}") from None
        self._writer = Writer(self._file, chunk_size=chunk_size)
        self._writer.start(profile="ros2", library="uwbslam_jax")
        self._schema_ids: dict[str, int] = {}
        self._sequence: Counter[int] = Counter()

    def add_topic(self, topic: str, schema: str, definition: bytes) -> int:
        """Registers a topic of CDR messages with its ros2msg definition; returns the number to write with."""
        if schema not in self._schema_ids:
            self._schema_ids[schema] = self._writer.register_schema(schema, "ros2msg", definition)
        return self._writer.register_channel(topic, "cdr", self._schema_ids[schema])

    def write(self, channel: int, data: bytes | memoryview, log_time: int) -> None:
        """Writes one message [ns]."""
        self._writer.add_message(channel, log_time, bytes(data), log_time, self._sequence[channel])
        self._sequence[channel] += 1

    def flush(self) -> None:
        """Finishes the open chunk and hands it to the operating system."""
        self._writer.flush()

    def close(self) -> None:
        """Writes the summary and closes the file; a second call does nothing."""
        if not self._file.closed:
            self._writer.finish()
            self._file.close()

    def __enter__(self) -> RecordWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()
