"""What the process asks of the C library's allocator, so that hours of running do not leave its memory in pieces."""

from __future__ import annotations

import ctypes
import sys

_ARENA_MAX = -8
"""Number of the parameter in malloc.h."""
_ARENAS = 2


def few_arenas() -> None:
    """Lets all threads allocate from a few heaps. To be called before there are threads: one that has a heap keeps it.

    By default glibc gives each thread a heap of its own, up to eight a core, which grow without ever shrinking again.
    """
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_ARENA_MAX, _ARENAS)


def give_back() -> None:
    """Hands memory that is free to the system: what threads allocate by turns is kept in ever more pieces otherwise."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)
