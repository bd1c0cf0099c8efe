"""Windows functions that Python lacks: named events and locks, with which shared memory avoids polling, and input that
does not block the rest of the process.

Other systems have no such events and locks; everything works without them, only more slowly.
"""

from __future__ import annotations

import ctypes
import os
import sys
import time
from typing import Any

if sys.platform == "win32":
    import msvcrt

_SYNCHRONIZE = 0x00100000
_EVENT_MODIFY_STATE = 0x0002
_ALREADY_EXISTS = 183
_SIGNALLED = 0
_PIPE = 3
_POLL_S = 0.05


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
    """An auto-reset event. Does nothing if no event of that name exists, as on other systems.

    Args:
        name: Name of the event.
        create: Create the event, as servers do.

    Attributes:
        exists: Whether the event exists.
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
        """Wake a waiting thread."""
        if self._handle:
            self._kernel.SetEvent(self._handle)

    def wait(self, seconds: float) -> bool:
        """Wait at most `seconds` until the event is set; return whether it was. Other threads keep running."""
        if not self._handle:
            return False
        return self._kernel.WaitForSingleObject(self._handle, max(1, int(seconds * 1000))) == _SIGNALLED

    def close(self) -> None:
        """Close the handle."""
        if self._handle:
            self._kernel.CloseHandle(self._handle)
            self._handle = None


class NamedLock:
    """A lock among the processes of one machine, which the system releases when its owner dies.

    The process that created the object of that name holds it; an acquired mutex could be taken twice by one thread.
    """

    def __init__(self, name: str) -> None:
        self._handle: int | None = None
        self.held = True
        self._kernel = _kernel()
        if sys.platform == "win32":
            self._handle = self._kernel.CreateMutexW(None, 0, name)
            self.held = ctypes.get_last_error() != _ALREADY_EXISTS

    def close(self) -> None:
        """Release the lock."""
        if self._handle:
            self._kernel.CloseHandle(self._handle)
            self._handle = None


def read_aside(descriptor: int, size: int) -> bytes:
    """`os.read` for a thread that runs beside others that load libraries.

    Windows locks a pipe while a thread waits to read from it, and every C runtime queries standard input when it is
    loaded: importing NumPy would wait until input arrives.
    """
    if sys.platform == "win32":
        kernel, handle = _kernel(), msvcrt.get_osfhandle(descriptor)
        waiting = ctypes.c_uint32()
        while kernel.GetFileType(handle) == _PIPE and not waiting.value:
            if not kernel.PeekNamedPipe(handle, None, 0, None, ctypes.byref(waiting), None):
                return b""  # the other end is closed
            if not waiting.value:
                time.sleep(_POLL_S)
    return os.read(descriptor, size)
