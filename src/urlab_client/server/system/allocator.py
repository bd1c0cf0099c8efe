"""Settings of glibc's memory allocator for long-running servers. No effect with other C libraries."""

from __future__ import annotations

import contextlib
import ctypes
import sys

_M_ARENA_MAX = -8  # of mallopt


def limit_arenas() -> None:
    """Make all threads of this process allocate from two heaps.

    Each play session draws and compiles in its own threads. By default glibc gives each new thread its own heap, up to
    eight per processor, and each keeps about ten MiB of the renderer's memory.
    """
    _ask("mallopt", _M_ARENA_MAX, 2)


def trim() -> None:
    """Return free pages of the heaps to the system; after many play sessions glibc keeps tens of MiB of them."""
    _ask("malloc_trim", 0)


def _ask(function: str, *arguments: int) -> None:
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            getattr(ctypes.CDLL(None), function)(*arguments)
