"""The processor's memory barrier, for both ends of shared memory.

x86 keeps loads in order and stores in order, which is enough for a region. arm64 guarantees neither, and CPython has no
barrier of its own.
"""

from __future__ import annotations

import ctypes
import platform
import sys
from functools import cache

from urlab_client.protocol.shm import Fence, no_fence

_ORDERED = frozenset({"x86_64", "amd64", "i386", "i686", "x86"})
_SEQ_CST = 5


@cache
def processor_fence() -> Fence:
    """Return a full memory barrier, or `no_fence` where the processor needs none."""
    if platform.machine().lower() in _ORDERED:
        return no_fence
    try:
        if sys.platform == "darwin":
            return ctypes.CDLL("/usr/lib/libSystem.B.dylib").OSMemoryBarrier
        if sys.platform == "win32":
            return ctypes.WinDLL("kernel32").FlushProcessWriteBuffers
        barrier = ctypes.CDLL("libatomic.so.1").atomic_thread_fence
    except (OSError, AttributeError):
        return _mutex_fence()
    return lambda: barrier(_SEQ_CST)


def _mutex_fence() -> Fence:
    """Lock and unlock a private mutex. Not a formal barrier, as accesses may move inside; sufficient in practice."""
    libc = ctypes.CDLL(None)
    mutex = ctypes.create_string_buffer(64)  # zeros are a valid mutex

    def fence() -> None:
        libc.pthread_mutex_lock(mutex)
        libc.pthread_mutex_unlock(mutex)

    return fence
