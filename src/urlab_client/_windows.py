"""What has to be asked of Windows itself: named events and locks, with which shared memory saves itself from polling,
and input that does not hold up the rest of the process.

Only what clients and servers need. Other systems have no such events and locks: everything works without, only slower.
"""

from __future__ import annotations

import ctypes
import os
import sys
import time
from typing import Any

if sys.platform == "win32":
    import msvcrt

__all__ = ["NamedEvent", "NamedLock", "read_aside"]

_SYNCHRONIZE = 0x00100000
_EVENT_MODIFY_STATE = 0x0002
_ALREADY_EXISTS = 183
_SIGNALLED = 0
_PIPE = 3
_LOOK_S = 0.05


def _kernel() -> Any:
    if sys.platform != "win32":
        return None
    kernel = ctypes.WinDLL("kernel32", use_last_error=True)
    kernel.OpenEventW.restype = kernel.CreateEventW.restype = kernel.CreateMutexW.restype = ctypes.c_void_p
    for function in (kernel.SetEvent, kernel.CloseHandle):
        function.argtypes = [ctypes.c_void_p]
    kernel.GetFileType.argtypes = [ctypes.c_void_p]
    kernel.PeekNamedPipe.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, *[ctypes.c_void_p] * 3]
    kernel.WaitForSingleObject.argtypes = [ctypes.c_void_p, ctypes.c_uint32]
    return kernel


class NamedEvent:
    """An auto-reset event. Without one of that name, as on other systems, it does nothing.

    Args:
        name: Its name.
        create: Make it, as servers do.

    Attributes:
        exists: Whether the server made it.
    """

    def __init__(self, name: str, *, create: bool = False) -> None:
        self._handle: int | None = None
        self._kernel = _kernel()
        if sys.platform == "win32":
            if create:
                self._handle = self._kernel.CreateEventW(None, 0, 0, name)
            else:
                self._handle = self._kernel.OpenEventW(_SYNCHRONIZE | _EVENT_MODIFY_STATE, 0, name)
        self.exists: bool = bool(self._handle)

    def set(self) -> None:
        """Wake who waits for it."""
        if self._handle:
            self._kernel.SetEvent(self._handle)

    def wait(self, seconds: float) -> bool:
        """Wait until it is set, at most so long; other threads go on. Return whether it was."""
        if not self._handle:
            return False
        return self._kernel.WaitForSingleObject(self._handle, max(1, int(seconds * 1000))) == _SIGNALLED

    def close(self) -> None:
        """Let go of it."""
        if self._handle:
            self._kernel.CloseHandle(self._handle)
            self._handle = None


class NamedLock:
    """A lock among the processes of one machine, which the system releases when its owner dies.

    It is held by whoever made the object of that name: a mutex proper would let one thread take it twice.
    """

    def __init__(self, name: str) -> None:
        self._handle: int | None = None
        self.held = True
        self._kernel = _kernel()
        if sys.platform == "win32":
            self._handle = self._kernel.CreateMutexW(None, 0, name)
            self.held = ctypes.get_last_error() != _ALREADY_EXISTS

    def close(self) -> None:
        """Release it."""
        if self._handle:
            self._kernel.CloseHandle(self._handle)
            self._handle = None


def read_aside(descriptor: int, size: int) -> bytes:
    """`os.read` in a thread beside others that load libraries.

    Windows locks a pipe while somebody waits to read from it, and every C runtime that is loaded asks what standard
    input is: importing NumPy would wait until input comes.
    """
    if sys.platform == "win32":
        kernel, handle = _kernel(), msvcrt.get_osfhandle(descriptor)
        waiting = ctypes.c_uint32()
        while kernel.GetFileType(handle) == _PIPE and not waiting.value:
            if not kernel.PeekNamedPipe(handle, None, 0, None, ctypes.byref(waiting), None):
                return b""  # the other end is closed
            if not waiting.value:
                time.sleep(_LOOK_S)
    return os.read(descriptor, size)
