"""A shared-memory region of the server, as a file that was opened and mapped.

The file belongs to the server. It may be removed, replaced or cut off at any moment, and touching a mapping beyond the
end of its file kills the process: so whoever touches one asks `intact` first.
"""

from __future__ import annotations

import contextlib
import hashlib
import mmap
import os
import stat
import sys
from pathlib import Path

from urlab_client._windows import NamedLock
from urlab_client.protocol.errors import ProtocolError
from urlab_client.protocol.fence import processor_fence
from urlab_client.protocol.shm import HEADER_SIZE, LAYOUT_SIZE, Region, RegionNotReady, attach

if sys.platform != "win32":
    import fcntl

__all__ = ["MappedRegion", "RegionInUse"]

_BLOCK = 512  # bytes, in which the system counts what a file occupies


class RegionInUse(ProtocolError):
    """Another client on this machine has the region."""


class MappedRegion:
    """One mapped region.

    Args:
        path: The file.
        writable: Map it for writing, too.
        exclusive: Take the lock that our clients respect among each other; held until `close`.

    Attributes:
        path: The file.
        region: The region in it.

    Raises:
        RegionNotReady: It is still being created.
        RegionInUse: Another client holds the lock.
        ProtocolError: It is not a region.
        OSError: It cannot be opened.
    """

    def __init__(self, path: Path, *, writable: bool = False, exclusive: bool = False) -> None:
        self.path = path
        self._lock: NamedLock | None = None
        self._locked_by = 0
        # Not blocking: opening a pipe that somebody put there would wait for its other end.
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
            raise RegionInUse(f"{self.path}: another client on this machine has it.")
        self._identity = about.st_dev, about.st_ino
        self._size = about.st_size
        if writable and hasattr(os, "posix_fallocate") and about.st_blocks * _BLOCK < self._size:
            # To write into a hole of a file for which there is no room any more kills the process, too.
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
            # Of this file: servers call their directories by the same name.
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
        """Whether the file is as long as when it was mapped, so that the mapping may be touched."""
        return os.lseek(self._fd, 0, os.SEEK_END) >= self._size  # asked for each request; a quarter of what fstat takes

    def replaced(self) -> bool:
        """Whether the path leads to another file by now, or to none."""
        try:
            about = self.path.stat()
        except OSError:
            return True
        if not about.st_ino:  # Windows may not say which file it is while that is in use; then it is the same
            return False
        return (about.st_dev, about.st_ino) != self._identity

    def laid_out_anew(self) -> bool:
        """Whether somebody laid the region out in another way than was found. Not to be asked unless `intact`."""
        return self._mmap[:LAYOUT_SIZE] != self._layout

    def close(self) -> None:
        """Unmap and close. What still views the mapping keeps it alive."""
        self.region.release()
        self._unmap()
        self._release()

    def __del__(self) -> None:
        # A client that nobody closed must not keep the regions from the next one.
        if getattr(self, "_fd", -1) >= 0:
            self._release()

    def _unmap(self) -> None:
        # A view handed out to the user keeps the mapping; it goes with the view.
        with contextlib.suppress(BufferError):
            self._mmap.close()

    def _release(self) -> None:
        if sys.platform != "win32" and self._locked_by == os.getpid():
            # Closing alone would leave the lock to a forked child, which has the file open, too. No child may let go.
            fcntl.flock(self._fd, fcntl.LOCK_UN)
        os.close(self._fd)
        self._fd = -1
        if self._lock is not None:
            self._lock.close()
