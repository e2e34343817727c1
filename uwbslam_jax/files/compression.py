"""Decompression with a limit: what compressed bytes say of their size is not believed, nor is what they unpack to."""

from __future__ import annotations

import bz2

import lz4.frame
import zstandard

_PLENTY_BYTES, _MOST_TIMES = 1 << 28, 200
"""What unpacks to more than 256 MiB and so many times its own size is damaged, or meant to fill the memory [bytes,
ratio]: scans and ranges shrink to a tenth or so, and a chunk with an empty map of a city block is smaller."""
_DAMAGED = (zstandard.ZstdError, OSError, RuntimeError, ValueError, EOFError, MemoryError)
"""What damaged bytes raise [exceptions]: those of lz4 and bz2 have no class of their own."""


class DamagedError(Exception):
    """Bytes that do not decompress; the message says why."""


def believable(size: int, stored: int) -> bool:
    """Whether so many bytes may unpack to a size [bytes]."""
    return size <= max(_PLENTY_BYTES, _MOST_TIMES * stored)


def decompress(stored: bytes, kind: str, most: int) -> bytes:
    """The content of one frame, its first bytes where it holds more than most; of a frame cut off what is there.

    Args:
      kind: "zstd", "lz4", "bz2", "" for none.

    Raises:
      DamagedError: the bytes are no such frame, or kind is none of these.
    """
    try:
        if kind == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(stored) as plain:
                return plain.read(most)
        if kind == "lz4":
            return lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=most)
        if kind == "bz2":
            return bz2.BZ2Decompressor().decompress(stored, max_length=most)
    except _DAMAGED:
        raise DamagedError("does not decompress") from None
    if kind:
        raise DamagedError(f"is compressed with {kind[:16]!r}, which is not read")
    return stored[:most]
