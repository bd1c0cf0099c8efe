"""A shared-memory region of the server, opened and mapped from its file.

The file belongs to the server, which may remove, replace or truncate it at any time. Accessing a mapping beyond the end
of its file kills the process, so check `intact` before each access.
"""

from __future__ import annotations

import contextlib
import hashlib
import mmap
import os
import stat
import sys
from pathlib import Path

from urlab_client._platform.windows import NamedLock
from urlab_client.errors import ProtocolError
from urlab_client.protocol.fence import processor_fence
from urlab_client.protocol.shm import HEADER_SIZE, LAYOUT_SIZE, Region, RegionNotReady, attach

if sys.platform != "win32":
    import fcntl

_BLOCK = 512  # bytes; unit of `st_blocks`


class RegionInUse(ProtocolError):
    """Another client on this machine uses the region."""


class MappedRegion:
    """One mapped region.

    Args:
        path: The file.
        writable: Whether to map the region for writing, too.
        exclusive: Whether to take the lock that excludes other clients, held until `close`.

    Attributes:
        path: The file.
        region: The region in it.

    Raises:
        RegionNotReady: The region is still being created.
        RegionInUse: Another client holds the lock.
        ProtocolError: The file is not a region.
        OSError: The file cannot be opened.
    """

    def __init__(self, path: Path, *, writable: bool = False, exclusive: bool = False) -> None:
        self.path = path
        self._lock: NamedLock | None = None
        self._locked_by = 0
        # Non-blocking: opening a pipe at this path would wait for its other end.
        mode = os.O_RDWR if writable else os.O_RDONLY
        self._fd = os.open(path, mode | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0))
        try:
            self._map(writable=writable, exclusive=exclusive)
        except BaseException:
            self._release()
            raise

    def _map(self, *, writable: bool, exclusive: bool) -> None:
        about = os.fstat(self._fd)
        if not stat.S_ISREG(about.st_mode):
            raise ProtocolError(f"{self.path} is not a file.")
        if about.st_size < HEADER_SIZE:
            raise RegionNotReady(f"{self.path}: {about.st_size} bytes, expected a header of {HEADER_SIZE}.")
        if exclusive and not self._take_lock():
            raise RegionInUse(f"{self.path}: another client on this machine uses it.")
        self._identity = about.st_dev, about.st_ino
        self._size = about.st_size
        if writable and hasattr(os, "posix_fallocate") and about.st_blocks * _BLOCK < self._size:
            # Writing to a hole of a file when the disk is full also kills the process.
            os.posix_fallocate(self._fd, 0, self._size)
        access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
        self._mmap = mmap.mmap(self._fd, self._size, access=access)
        try:
            self.region: Region = attach(memoryview(self._mmap), fence=processor_fence())
        except ProtocolError as error:
            raise type(error)(f"{self.path}: {error.args[0]}") from None
        self._layout = self._mmap[:LAYOUT_SIZE]

    def _take_lock(self) -> bool:
        if sys.platform == "win32":
            # Hash the whole path, because the directories of different servers may have the same name.
            place = hashlib.sha256(os.path.normcase(self.path.resolve()).encode()).hexdigest()[:16]
            self._lock = NamedLock(f"Local\\URLab_{place}_client")
            return self._lock.held
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        self._locked_by = os.getpid()
        return True

    def intact(self) -> bool:
        """Return whether the file still has its mapped length, so that accessing the mapping is safe."""
        return (
            os.lseek(self._fd, 0, os.SEEK_END) >= self._size
        )  # called for each request; takes a quarter of the time of fstat

    def replaced(self) -> bool:
        """Return whether the path now leads to another file or to none."""
        try:
            about = self.path.stat()
        except OSError:
            return True
        if not about.st_ino:  # Windows may not identify a file in use; then it is the same file
            return False
        return (about.st_dev, about.st_ino) != self._identity

    def laid_out_anew(self) -> bool:
        """Return whether the layout of the region has changed since it was mapped. Call only while `intact`."""
        return self._mmap[:LAYOUT_SIZE] != self._layout

    def close(self) -> None:
        """Unmap and close the file. Remaining views keep the mapping alive."""
        self.region.release()
        self._unmap()
        self._release()

    def __del__(self) -> None:
        # A client that was never closed must not block the regions for the next one.
        if getattr(self, "_fd", -1) >= 0:
            self._release()

    def _unmap(self) -> None:
        # A view held by the user keeps the mapping alive.
        with contextlib.suppress(BufferError):
            self._mmap.close()

    def _release(self) -> None:
        if sys.platform != "win32" and self._locked_by == os.getpid():
            # Closing alone would leave the lock to a forked child, which has the file open, too. A child never unlocks.
            fcntl.flock(self._fd, fcntl.LOCK_UN)
        os.close(self._fd)
        self._fd = -1
        if self._lock is not None:
            self._lock.close()
