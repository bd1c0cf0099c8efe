"""Files that are mapped into memory and shared with other processes."""

from __future__ import annotations

import contextlib
import hashlib
import mmap
import os
import stat
import sys
from pathlib import Path

from urlab_client._platform.windows import NamedLock

if sys.platform != "win32":
    import fcntl

_BLOCK = 512  # bytes; unit of `st_blocks`
# Non-blocking: opening a pipe at the path would wait for its other end.
_FLAGS = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


class MappedFile:
    """A file that is mapped whole.

    Other programs may remove, replace or truncate it at any time. Accessing a mapping beyond the end of its file kills
    the process, so check `intact` before each access.

    Args:
        path: The file.
        writable: Whether to map it for writing, too.
        size: Size of a file that is created, bytes; by default the file must exist.

    Attributes:
        view: The mapping; empty if the file is.

    Raises:
        OSError: The file cannot be opened, or the disk is full.
    """

    def __init__(self, path: Path, *, writable: bool = False, size: int | None = None) -> None:
        self.path = path
        self._lock: NamedLock | None = None
        self._locked_by = 0
        create = 0 if size is None else os.O_CREAT
        self._fd = os.open(path, (os.O_RDWR if writable else os.O_RDONLY) | create | _FLAGS, 0o600)
        try:
            self._map(writable=writable, size=size)
        except BaseException:
            self._release()
            raise

    def _map(self, *, writable: bool, size: int | None) -> None:
        about = os.fstat(self._fd)
        if not stat.S_ISREG(about.st_mode):
            raise OSError(f"{self.path} is not a file")
        self._identity = about.st_dev, about.st_ino
        self._size = about.st_size if size is None else size
        if writable:
            self.restore()
        access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
        self._mmap = mmap.mmap(self._fd, self._size, access=access) if self._size else None
        self.view: memoryview = memoryview(b"" if self._mmap is None else self._mmap)

    def restore(self) -> None:
        """Give the file its size back, and all of its blocks: writing to a hole when the disk is full kills, too."""
        about = os.fstat(self._fd)
        if not hasattr(os, "posix_fallocate"):
            if about.st_size < self._size:
                os.ftruncate(self._fd, self._size)
        elif self._size and (about.st_size < self._size or about.st_blocks * _BLOCK < self._size):
            try:
                os.posix_fallocate(self._fd, 0, self._size)
            except OSError as error:
                raise OSError(error.errno, os.strerror(error.errno or 0), os.fspath(self.path)) from None

    def lock(self) -> bool:
        """Exclude other clients until `close`. Return False if one of them has done so."""
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
        # Called for each request; takes a quarter of the time of fstat.
        return os.lseek(self._fd, 0, os.SEEK_END) >= self._size

    def replaced(self) -> bool:
        """Return whether the path now leads to another file or to none."""
        try:
            about = self.path.stat()
        except OSError:
            return True
        if not about.st_ino:  # Windows may not identify a file in use; then it is the same file
            return False
        return (about.st_dev, about.st_ino) != self._identity

    def close(self) -> None:
        """Unmap and close the file. A view that somebody holds keeps the mapping alive."""
        self.view.release()
        if self._mmap is not None:
            with contextlib.suppress(BufferError):
                self._mmap.close()
            self._mmap = None  # Windows removes no mapped file, so nothing but a view that somebody holds may keep it
        self._release()

    def __del__(self) -> None:
        # A client that was never closed must not block the regions for the next one.
        if getattr(self, "_fd", -1) >= 0:
            self._release()

    def _release(self) -> None:
        if sys.platform != "win32" and self._locked_by == os.getpid():
            # Closing alone would leave the lock to a forked child, which has the file open, too. A child never unlocks.
            fcntl.flock(self._fd, fcntl.LOCK_UN)
        os.close(self._fd)
        self._fd = -1
        if self._lock is not None:
            self._lock.close()
