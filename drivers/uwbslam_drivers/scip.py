"""SCIP 2.x, the language of Hokuyo scanners: numbers in characters, sums, and the blocks of a measurement.

After the SCIP 2.0 specification (Hokuyo, C-42-03320): a character carries 6 bits plus 0x30; a sum is the low 6 bits of
the sum of bytes plus 0x30; data goes in blocks of 64 characters, each with a sum and LF, and values straddle blocks.
"""

from __future__ import annotations

import numpy as np

BLOCK, ZERO = 64, 0x30
"""Characters in a block of data, and the code of a character that stands for 0 [dimensionless] (SCIP 2.0)."""
_REACH = 12
"""A block is looked for so far to either side of where it should be, since bytes are lost or added [bytes]."""


def checksum(data: bytes) -> int:
    """Sum character of a line."""
    return (sum(data) & 0x3F) + ZERO


def encode(value: int, characters: int) -> bytes:
    """A number in so many characters, the highest 6 bits first."""
    return bytes(((value >> 6 * k) & 0x3F) + ZERO for k in reversed(range(characters)))


def decode(text: bytes) -> int:
    """The number that characters hold."""
    value = 0
    for character in text:
        value = value << 6 | (character - ZERO) & 0x3F
    return value


def intact(line: bytes) -> bool:
    """Whether a line of characters ends with its sum."""
    return len(line) > 1 and checksum(line[:-1]) == line[-1]


def body_length(values: int) -> int:
    """Bytes of the blocks of so many 3-character values, with sums and line ends."""
    characters = 3 * values
    return characters + 2 * -(-characters // BLOCK)


def encode_blocks(values: np.ndarray) -> bytes:
    """Values (n,) of 18 bits as blocks of 64 characters with sums and line ends."""
    shifts = np.array([12, 6, 0])
    text = (((np.asarray(values, np.int64)[:, None] >> shifts) & 0x3F) + ZERO).astype(np.uint8).tobytes()
    blocks = [text[k : k + BLOCK] for k in range(0, len(text), BLOCK)]
    return b"".join(block + bytes([checksum(block), 0x0A]) for block in blocks)


def decode_blocks(body: bytes, count: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Values of a measurement; what stands in damaged blocks is left out, also if bytes are lost or added.

    Args:
      body: blocks with sums and line ends, as received.
      count: how many values were asked for.

    Returns:
      values (count,) int32, whether each is intact (count,) bool, and the number of damaged blocks.
    """
    characters = 3 * count
    sizes = [min(BLOCK, characters - k) for k in range(0, characters, BLOCK)]
    text = np.zeros(characters, np.uint8)
    good = np.zeros(characters, bool)
    damaged = 0
    at = 0
    for number, size in enumerate(sizes):
        block = _block_at(body, at, size)
        if block is None:
            damaged += 1
            following = sizes[number + 1] if number + 1 < len(sizes) else 0
            at = _resume(body, at + size + 2, following)
            continue
        text[number * BLOCK : number * BLOCK + size] = np.frombuffer(block, np.uint8)
        good[number * BLOCK : number * BLOCK + size] = True
        at += size + 2
    bits = (text.reshape(count, 3).astype(np.int32) - ZERO) & 0x3F
    return bits @ np.array([4096, 64, 1], np.int32), np.all(good.reshape(count, 3), axis=1), damaged


def _block_at(body: bytes, at: int, size: int) -> bytes | None:
    """The block that begins there, None if it is damaged."""
    block = body[at : at + size]
    if at + size + 2 > len(body) or body[at + size + 1] != 0x0A or body[at + size] != checksum(block):
        return None
    # All 64 characters are allowed, but nothing else is: two flips that cancel in the sum mostly show here.
    return block if min(block) >= ZERO and max(block) < ZERO + BLOCK else None


def _resume(body: bytes, expected: int, size: int) -> int:
    """Where the next block begins after a damaged one: as expected, unless an intact one stands close by."""
    if size:
        for shift in sorted(range(-_REACH, _REACH + 1), key=abs):
            if expected + shift >= 0 and _block_at(body, expected + shift, size) is not None:
                return expected + shift
    return expected
