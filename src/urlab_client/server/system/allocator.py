"""What a server that plays for days asks of glibc's memory allocation. Other C libraries are left alone."""

from __future__ import annotations

import contextlib
import ctypes
import sys

__all__ = ["limit_arenas", "trim"]

_M_ARENA_MAX = -8  # of mallopt


def limit_arenas() -> None:
    """Have all threads of this process allocate from two heaps.

    Each play session draws and compiles in threads of its own. By default glibc gives each new thread a heap of its
    own, up to eight per processor, and each keeps some ten MiB of what the renderer had in it.
    """
    _ask("mallopt", _M_ARENA_MAX, 2)


def trim() -> None:
    """Return free pages amid the heaps to the system: after many play sessions glibc keeps tens of MiB of them."""
    _ask("malloc_trim", 0)


def _ask(function: str, *arguments: int) -> None:
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            getattr(ctypes.CDLL(None), function)(*arguments)
