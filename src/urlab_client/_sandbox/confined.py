"""Limits for a process that compiles an untrusted model. For client and server."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path


def limit_process(memory_bytes: int, cpu_s: int) -> None:
    """Limit additional memory and processor time of this process permanently, as far as the system supports it.

    SIGXCPU terminates the process beyond the time limit; allocations fail beyond the memory limit.
    """
    if sys.platform == "win32":
        return
    import resource  # not on Windows

    present = 0
    with contextlib.suppress(OSError):
        present = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
    # The hard limit is above the soft one, whose signal shows why the process ended.
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 5))
    memory = present + memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def forbid_opening() -> bool:
    """Permanently keep this process from opening files, sockets and pipes. Open ones stay usable.

    Returns:
        False on Windows, which has no such limit; nothing was done.
    """
    if sys.platform == "win32":
        return False
    import resource  # not on Windows

    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    return True
