"""Coverage-guided fuzzing of every decoder: python tests/fuzz_drivers.py [NAME ...] --runs 2000 --bytes 10000000

Inputs start from what the emulated devices say. One that takes a branch of the drivers that none took before is kept
and mutated further (--runs of these, traced). Then random and mutated bytes (--bytes of them, untraced) go through one
decoder, with good frames in between: it must not raise, must hold little, and must find the good frames again.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from emulated import LANGUAGES, decode, held, stream

import uwbslam_drivers

SOURCES = str(Path(uwbslam_drivers.__file__).parent)
SEED_SECONDS = (0.03, 0.15)
LONGEST = 8000
"""Inputs are cut at this length [bytes]."""
GOOD_SECONDS = 0.45
EVERY = 100_000
"""Good frames follow after so many bad bytes."""
Branch = tuple[str, int, int]


class Coverage:
    """Branches of the drivers, as pairs of lines of one function, that were taken since `start`."""

    def __init__(self) -> None:
        self.taken: set[Branch] = set()

    def start(self) -> None:
        self.taken = set()
        sys.settrace(self._call)

    def stop(self) -> set[Branch]:
        sys.settrace(None)
        return self.taken

    def _call(self, frame: FrameType, event: str, argument: Any) -> Any:
        name = frame.f_code.co_filename
        if not name.startswith(SOURCES):
            return None
        before = 0

        def line(inner: FrameType, event: str, argument: Any) -> Any:
            nonlocal before
            self.taken.add((name, before, inner.f_lineno))
            before = inner.f_lineno
            return line

        return line


def mutate(corpus: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A member of the corpus with some bytes changed, lost, added, repeated, or joined with another member."""
    data = bytearray(corpus[rng.integers(len(corpus))])
    for _ in range(rng.integers(1, 6)):
        at = int(rng.integers(len(data) + 1))
        length = int(rng.integers(1, 20))
        match int(rng.integers(6)):
            case 0 if data:
                data[at % len(data)] = int(rng.integers(256))
            case 1 if data:
                data[at % len(data)] ^= 1 << int(rng.integers(8))
            case 2:
                del data[at : at + length]
            case 3:
                data[at:at] = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
            case 4:
                data[at:at] = data[max(0, at - 10 * length) : at]
            case _:
                data[at:] = corpus[rng.integers(len(corpus))][at // 2 :]
    return bytes(data[:LONGEST])


def explore(name: str, runs: int, rng: np.random.Generator) -> tuple[list[bytes], int]:
    """Inputs that each took a branch which none before took, and the number of branches."""
    language, coverage = LANGUAGES[name], Coverage()
    corpus = [stream(name, seconds)[:LONGEST] for seconds in SEED_SECONDS]
    seen: set[Branch] = set()
    for run in range(runs):
        data = corpus[run] if run < len(corpus) else mutate(corpus, rng)
        size = int(rng.integers(16, 2000))
        decoder = language.decoder(Counter())
        coverage.start()
        try:
            decode(decoder, data, size)
        finally:
            taken = coverage.stop()
        if taken - seen:
            seen |= taken
            corpus.append(data)
    return corpus, len(seen)


def endure(name: str, amount: int, corpus: Sequence[bytes], rng: np.random.Generator) -> tuple[int, int, Counter[str]]:
    """Feeds bad bytes with good frames in between.

    Returns:
      how often good frames were found again, the most that the decoder held [bytes], and what it dropped.
    """
    language = LANGUAGES[name]
    dropped: Counter[str] = Counter()
    decoder = language.decoder(dropped)
    good = stream(name, GOOD_SECONDS)
    expected = len(decode(language.decoder(Counter()), good)) - language.loses
    fed = since = found_again = most = 0
    while fed < amount:
        if rng.uniform() < 0.5:
            data = rng.integers(0, 256, int(rng.integers(1, 4000)), dtype=np.uint8).tobytes()
        else:
            data = mutate(corpus, rng)
        decode(decoder, data, int(rng.integers(1, 4096)) if rng.uniform() < 0.9 else 3)
        fed, since = fed + len(data), since + len(data)
        if rng.uniform() < 0.1:
            most = max(most, held(decoder))
            assert most < language.holds, f"{name} holds {most} bytes"
        if since >= EVERY or fed >= amount:
            since = 0
            found = len(decode(decoder, good))
            assert found >= expected, f"{name}: {found} of {expected} good frames found after {fed} bytes"
            found_again += 1
    return found_again, most, dropped


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Coverage-guided fuzzing of the decoders.")
    parser.add_argument("names", nargs="*", choices=[[], *LANGUAGES], help="decoders; all where none is given")
    parser.add_argument("--runs", type=int, default=2000, help="traced inputs a decoder")
    parser.add_argument("--bytes", type=int, default=1_000_000, help="bad bytes a decoder")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    for name in options.names or LANGUAGES:
        begin = time.monotonic()
        rng = np.random.default_rng([options.seed, *name.encode()])
        corpus, branches = explore(name, options.runs, rng)
        again, most, dropped = endure(name, options.bytes, corpus, rng)
        print(
            f"{name:<17} {options.runs} runs, {branches} branches, {len(corpus)} inputs kept; {options.bytes} bytes, "
            f"good frames found {again} times of {again}, held at most {most} bytes, {sum(dropped.values())} drops, "
            f"{time.monotonic() - begin:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
