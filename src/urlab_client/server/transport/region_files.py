"""The shared-memory regions of a server as files: where they lie, who may touch them, and what is left of the dead.

For `SharedMemory`. A program of the same user can damage the files at any moment, and touching a mapping beyond the end
of its file kills the process. So the server maps nothing: it reads and writes its own descriptors, which costs a
microsecond more.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import sys
import tempfile
from pathlib import Path
from struct import Struct as Layout
from typing import Final

from urlab_client.protocol import doorbell
from urlab_client.protocol.fence import processor_fence
from urlab_client.protocol.shm import HEADER_SIZE, LIVE_DIRECTORY, MAGIC, SIZE_PREFIX, VERSION, region_size

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["InstanceDirectory", "RegionFile", "RequestFile"]

logger: logging.Logger = logging.getLogger("urlab_client.server")

PREFIX: Final = "urlab-"
LOCK_FILE: Final = "lock"

LOCK_TEXT: Final = b"directory of a URLab server's shared memory\n"

_SLOTS: Final = 2
_FIXED: Final = Layout("<IIII")
_SEQUENCE: Final = Layout("<Q")
_SEQUENCE_AT: Final = 16
_LATEST_AT: Final = 24
_COUNTERS: Final = Layout("<QI")
_SIZE: Final = Layout("<I")
_LOOKS: Final = 100
_LOCKED_AT: Final = 1024  # beyond the text: Windows lets nobody read what is locked
_RAW: Final = getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)


class InstanceDirectory:
    """The directory of one server's regions, which nobody but its user can enter.

    It is `BASE/urlab-…/live`: clients look for most regions in a sibling `live` of the directory that the handshake
    names, which so is that directory itself whatever other servers share the base. A lock that dies with the server
    tells a directory in use from one that was left behind.

    Attributes:
        path: The directory.
    """

    def __init__(self, base: Path) -> None:
        """Make the directory, and remove those of servers that were killed.

        Raises:
            OSError: The base cannot be made or written to.
        """
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        _remove_left_behind(base)
        self._instance = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base.resolve()))
        self.path: Path = self._instance / LIVE_DIRECTORY
        with contextlib.ExitStack() as made:
            made.callback(_remove, self._instance)
            self._lock = os.open(self._instance / LOCK_FILE, os.O_RDWR | os.O_CREAT | _RAW, 0o600)
            made.callback(os.close, self._lock)
            # Before the text: a server that starts at this moment takes a directory without it for somebody else's.
            _lock(self._lock)
            os.write(self._lock, LOCK_TEXT)
            self.path.mkdir(mode=0o700)
            made.pop_all()

    def remove(self) -> None:
        """Remove the directory with everything in it."""
        os.close(self._lock)  # first: Windows removes no file that is open
        _remove(self._instance)


def _length(descriptor: int) -> int:
    """Return the length of a file, which a server asks for many times a second: seeking takes a quarter of `fstat`."""
    # Where there is no `pread`, reading needs the position.
    return os.lseek(descriptor, 0, os.SEEK_END) if hasattr(os, "pread") else os.fstat(descriptor).st_size


def _lock(descriptor: int) -> bool:
    """Take a lock that ends with the process; return False if somebody has it."""
    if sys.platform == "win32":
        os.lseek(descriptor, _LOCKED_AT, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        finally:
            os.lseek(descriptor, 0, os.SEEK_SET)
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _remove_left_behind(base: Path) -> None:
    """Remove the directories whose servers are dead."""
    for directory in base.glob(f"{PREFIX}*"):
        try:
            mine = sys.platform == "win32" or directory.lstat().st_uid == os.getuid()
            if directory.is_symlink() or not mine:
                continue
            descriptor = os.open(directory / LOCK_FILE, os.O_RDWR | _RAW | getattr(os, "O_NOFOLLOW", 0))
        except OSError:  # not one of ours
            continue
        try:
            abandoned = _pread(descriptor, len(LOCK_TEXT) + 1, 0) == LOCK_TEXT and _lock(descriptor)
        finally:
            os.close(descriptor)
        if abandoned:
            _remove(directory)
            logger.info("removed %s, which a killed server left behind", directory)


def _remove(instance: Path) -> None:
    """Remove what servers make; a directory with anything else in it stays."""
    live = instance / LIVE_DIRECTORY
    files = [live / doorbell.FILE, instance / LOCK_FILE]
    with contextlib.suppress(OSError):  # servers that start at once may remove the same one
        files += [file for file in live.iterdir() if file.name.endswith(".shm")]
    for file in files:
        with contextlib.suppress(OSError):
            file.unlink()
    for directory in (live, instance):
        with contextlib.suppress(OSError):
            directory.rmdir()


class RegionFile:
    """A region of this server, in its place once it can be read. Written with `pwrite`, never through a mapping.

    Attributes:
        path: The file.
    """

    def __init__(self, path: Path, stride: int) -> None:
        """Make the file.

        Raises:
            OSError: There is no room.
        """
        self.path = path
        self.stride = stride
        self._size = region_size(stride)
        self._fence = processor_fence()
        self._sequence = self._latest = 0
        new = path.with_name(f".{path.name}")
        self._fd = os.open(new, os.O_RDWR | os.O_CREAT | os.O_TRUNC | _RAW, 0o600)
        try:
            self._lay_out()
            self._put_in_place(new)
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(self._fd)
            new.unlink(missing_ok=True)
            raise

    def _put_in_place(self, new: Path) -> None:
        if sys.platform != "win32":
            new.replace(self.path)
            return
        os.close(self._fd)  # Windows moves no file that is open
        try:
            new.replace(self.path)
        except PermissionError:  # nor does it replace one: who has it open finds it laid out anew
            new.unlink()
            self._fd = os.open(self.path, os.O_RDWR | _RAW)
            self._lay_out()
        else:
            self._fd = os.open(self.path, os.O_RDWR | _RAW)

    @property
    def max_payload(self) -> int:
        """Largest payload that fits, bytes."""
        return self.stride - SIZE_PREFIX

    def publish(self, payload: bytes) -> None:
        """Make a payload the newest publication.

        Raises:
            ValueError: It does not fit.
            OSError: There is no room to mend a file that somebody cut off.
        """
        if not 0 < len(payload) <= self.max_payload:
            raise ValueError(f"{len(payload)} bytes, {self.path.name} takes 1 to {self.max_payload}")
        self._mend()
        target = (self._latest + 1) % _SLOTS
        _pwrite(self._fd, _SIZE.pack(len(payload)) + payload, HEADER_SIZE + target * self.stride)
        self._fence()
        # Slot number before count: a reader that sees the new count with the old slot would take the old payload.
        self._latest = target
        _pwrite(self._fd, _SIZE.pack(target), _LATEST_AT)
        self._fence()
        self._sequence += 1
        _pwrite(self._fd, _SEQUENCE.pack(self._sequence), _SEQUENCE_AT)

    def close(self) -> None:
        """Let go of the file and remove it. On Windows it stays while a client has it open."""
        os.close(self._fd)
        with contextlib.suppress(OSError):
            self.path.unlink()

    def _mend(self) -> None:
        """Lay the region out anew if somebody cut the file off or wrote over the header's fixed part."""
        intact = _length(self._fd) >= self._size
        if intact and _pread(self._fd, _FIXED.size, 0) == self._fixed():
            return
        logger.warning("%s was damaged and is laid out again", self.path)
        self._lay_out()

    def _lay_out(self) -> None:
        # Never made shorter: that would kill a client that looks into its mapping.
        self._sequence = self._latest = 0
        # With the memory, not only the length: a full disk is to show here.
        if hasattr(os, "posix_fallocate"):
            try:
                os.posix_fallocate(self._fd, 0, self._size)
            except OSError as error:
                raise OSError(error.errno, os.strerror(error.errno or 0), os.fspath(self.path)) from None
        elif os.fstat(self._fd).st_size < self._size:
            os.ftruncate(self._fd, self._size)
        _pwrite(self._fd, self._fixed().ljust(HEADER_SIZE, b"\0"), 0)

    def _fixed(self) -> bytes:
        return _FIXED.pack(MAGIC, VERSION, self.stride, _SLOTS)


class RequestFile(RegionFile):
    """The region in which clients leave requests. What they do to it cannot harm the server."""

    def sequence(self) -> int:
        """Return how many requests were published; 0 after the file was cut off."""
        if _length(self._fd) < self._size:
            self._mend()
        raw = _pread(self._fd, _SEQUENCE.size, _SEQUENCE_AT)
        return _SEQUENCE.unpack(raw)[0] if len(raw) == _SEQUENCE.size else 0

    def read(self) -> tuple[int, bytes | None]:
        """Return the sequence and the newest request, or None instead of one that cannot be taken.

        That is one that changed while it was copied, or whose slot or size lies outside the file.
        """
        self._mend()
        sequence, slot = self._settled_counters()
        start = HEADER_SIZE + slot * self.stride
        if slot >= _SLOTS:
            return sequence, None
        head = _pread(self._fd, SIZE_PREFIX, start)
        size = _SIZE.unpack(head)[0] if len(head) == SIZE_PREFIX else 0
        if not 0 < size <= self.max_payload:
            return sequence, None
        payload = _pread(self._fd, size, start + SIZE_PREFIX)
        self._fence()
        # With two slots, the writer begins to overwrite this one when it has counted once more.
        return sequence, payload if self.sequence() == sequence and len(payload) == size else None

    def _settled_counters(self) -> tuple[int, int]:
        """Return sequence and slot that belong together.

        A writer stores the slot first and then counts. Between the two, its request would be taken under the number
        of the one before, and then once more under its own.
        """
        sequence = slot = 0
        for _ in range(_LOOKS):
            raw = _pread(self._fd, _COUNTERS.size, _SEQUENCE_AT)
            sequence, slot = _COUNTERS.unpack(raw) if len(raw) == _COUNTERS.size else (0, 0)
            if slot == sequence % _SLOTS:
                break
        return sequence, slot


def _pread(descriptor: int, size: int, offset: int) -> bytes:
    if hasattr(os, "pread"):
        return os.pread(descriptor, size, offset)
    os.lseek(descriptor, offset, os.SEEK_SET)
    return os.read(descriptor, size)


def _pwrite(descriptor: int, data: bytes, offset: int) -> None:
    if hasattr(os, "pwrite"):
        written = os.pwrite(descriptor, data, offset)
    else:
        os.lseek(descriptor, offset, os.SEEK_SET)
        written = os.write(descriptor, data)
    if written != len(data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
