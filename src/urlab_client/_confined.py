"""What a process that compiles a foreign model may use. For client and server."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

__all__ = ["forbid_opening", "limit_process"]


def limit_process(memory_bytes: int, cpu_s: int) -> None:
    """Limit this process for good, as far as the system can: memory besides what it has, and processor time.

    Beyond the time it is ended by SIGXCPU; beyond the memory, allocations fail.
    """
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415 - not on Windows

    present = 0
    with contextlib.suppress(OSError):
        present = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
    # A hard limit above the soft one: the signal at the soft one tells why it ended.
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 5))
    memory = present + memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def forbid_opening() -> bool:
    """Keep this process from opening files, sockets and pipes, for good. What is open stays usable.

    Returns:
        False, and nothing was done, on Windows, which has no such limit.
    """
    if sys.platform == "win32":
        return False
    import resource  # noqa: PLC0415 - not on Windows

    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    return True
