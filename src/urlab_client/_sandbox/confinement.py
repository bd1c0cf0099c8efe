"""Permanently limiting a process: its memory and processor time, and with the Linux kernel's Landlock its files.

The system calls are used directly, which are part of the kernel's stable interface. The bindings on the package index
are either pre-releases or far larger, and as an extra the protection would be missing where it is needed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Final

_CREATE_RULESET: Final = 444  # these numbers are the same on all of CPython's Linux platforms
_ADD_RULE: Final = 445
_RESTRICT_SELF: Final = 446
_VERSION: Final = 1
_PATH_BENEATH: Final = 1
_NO_NEW_PRIVILEGES: Final = 38

_READ: Final = 1 << 2 | 1 << 3  # files and directories
_EXECUTE: Final = 1 << 0
_RIGHTS: Final = {1: (1 << 13) - 1, 2: 1 << 13, 3: 1 << 14, 5: 1 << 15}
"""File operations that the kernel can forbid, by the first version that supports them."""

_NETWORK: Final = 4, 0b11
_SCOPES: Final = 6, 0b11
"""Likewise for TCP connections, and for abstract sockets and signals to other processes."""


@cache
def is_available() -> bool:
    """Return whether this system has Landlock."""
    return _version() > 0


def confine_files(readable: Iterable[Path], writable: Iterable[Path]) -> bool:
    """Permanently keep this thread, and threads and processes that it starts, from opening other files and sockets.

    Open files stay usable, and the existence and size of other files can still be queried.

    Args:
        readable: Folders below which files may be read. Missing folders are skipped.
        writable: Folders below which files may be used in any way except executing them.

    Returns:
        False if the system has no Landlock; nothing was done.

    Raises:
        OSError: The system has Landlock but refuses the request.
    """
    version = _version()
    if version <= 0:
        return False
    everything = sum(rights for since, rights in _RIGHTS.items() if since <= version)
    (network_since, network), (scopes_since, scopes) = _NETWORK, _SCOPES
    fields = [everything]
    if version >= network_since:
        fields.append(network)
    if version >= scopes_since:
        fields.append(scopes)
    attributes = struct.pack(f"={len(fields)}Q", *fields)
    ruleset = _call(_CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), ctypes.c_uint32(0))
    try:
        for folder in readable:
            _allow(ruleset, folder, _READ)
        for folder in writable:
            _allow(ruleset, folder, everything & ~_EXECUTE)
        if _libc().prctl(_NO_NEW_PRIVILEGES, ctypes.c_ulong(1), *(ctypes.c_ulong(0) for _ in range(3))) != 0:
            raise OSError(ctypes.get_errno(), "this process cannot give up privileges")
        _call(_RESTRICT_SELF, ctypes.c_int(ruleset), ctypes.c_uint32(0))
    finally:
        os.close(ruleset)
    return True


def _allow(ruleset: int, folder: Path, rights: int) -> None:
    try:
        handle = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        rule = struct.pack("=Qi", rights, handle)
        _call(_ADD_RULE, ctypes.c_int(ruleset), ctypes.c_int(_PATH_BENEATH), rule, ctypes.c_uint32(0))
    finally:
        os.close(handle)


@cache
def _version() -> int:
    if not sys.platform.startswith("linux"):
        return 0
    try:
        return _call(_CREATE_RULESET, None, ctypes.c_size_t(0), ctypes.c_uint32(_VERSION))
    except OSError:  # not built in, not enabled, or forbidden in containers
        return 0


@cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _call(number: int, *arguments: object) -> int:
    result = int(_libc().syscall(ctypes.c_long(number), *arguments))
    if result < 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
    return result


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
