"""The shared-memory regions of a server as files.

For `SharedMemoryServer`. Programs of the same user can damage the files at any moment, and accessing a mapping beyond
the end of its file kills the process. The server therefore maps nothing; it reads and writes file descriptors, which
takes a microsecond more.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import sys
from pathlib import Path
from struct import Struct as Layout
from typing import Final

from urlab_client._platform.processors import processor_fence
from urlab_client.protocol.shm import HEADER_SIZE, MAGIC, SIZE_PREFIX, VERSION, region_size

logger: logging.Logger = logging.getLogger("urlab_client.server")

_SLOTS: Final = 2
_FIXED: Final = Layout("<IIII")
_SEQUENCE: Final = Layout("<Q")
_SEQUENCE_AT: Final = 16
_LATEST_AT: Final = 24
_COUNTERS: Final = Layout("<QI")
_SIZE: Final = Layout("<I")
_LOOKS: Final = 100
_RAW: Final = getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)


class RegionFile:
    """A region of this server, moved into place once it is readable. Written with `pwrite`, never through a mapping.

    Attributes:
        path: The file.
    """

    def __init__(self, path: Path, stride: int) -> None:
        """Create the file.

        Raises:
            OSError: The disk is full.
        """
        self.path = path
        self.stride = stride
        self._size = region_size(stride)
        self._fence = processor_fence()
        self._sequence = self._latest = 0
        # Windows neither replaces nor removes a file that a client has open, so there it is laid out in place.
        new = path if sys.platform == "win32" else path.with_name(f".{path.name}")
        self._fd = os.open(new, os.O_RDWR | os.O_CREAT | _RAW, 0o600)
        try:
            self._lay_out()
            if new != path:
                new.replace(path)
        except BaseException:
            os.close(self._fd)
            with contextlib.suppress(OSError):
                new.unlink()
            raise

    @property
    def max_payload(self) -> int:
        """Largest payload that fits, bytes."""
        return self.stride - SIZE_PREFIX

    def publish(self, payload: bytes) -> None:
        """Publish a payload.

        Raises:
            ValueError: The payload does not fit.
            OSError: The file was truncated, and the disk is too full to restore it.
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
        """Close the file and remove it. On Windows it remains while a client has it open."""
        os.close(self._fd)
        with contextlib.suppress(OSError):
            self.path.unlink()

    def _mend(self) -> None:
        """Initialise the region again if the file was truncated or the fixed part of its header overwritten."""
        intact = _length(self._fd) >= self._size
        if intact and _pread(self._fd, _FIXED.size, 0) == self._fixed():
            return
        logger.warning("%s was damaged and is laid out again", self.path)
        self._lay_out()

    def _lay_out(self) -> None:
        # Never truncated: that would kill a client that accesses its mapping.
        self._sequence = self._latest = 0
        # Allocates the blocks, not only the length, so that a full disk is detected here.
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
    """The region in which clients write requests. Nothing that they write can harm the server."""

    def sequence(self) -> int:
        """Return the number of published requests; 0 if the file was truncated."""
        if _length(self._fd) < self._size:
            self._mend()
        raw = _pread(self._fd, _SEQUENCE.size, _SEQUENCE_AT)
        return _SEQUENCE.unpack(raw)[0] if len(raw) == _SEQUENCE.size else 0

    def read(self) -> tuple[int, bytes | None]:
        """Return the sequence and the newest request, or None instead of a request that cannot be read.

        It cannot be read if it changed during the copy, or if its slot or size lies outside the file.
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
        # With two slots, the writer starts overwriting this one after the next count.
        return sequence, payload if self.sequence() == sequence and len(payload) == size else None

    def _settled_counters(self) -> tuple[int, int]:
        """Return a consistent pair of sequence and slot.

        A writer stores the slot before it increments the sequence. In between, its request would be read with the
        previous number, and then again with its own.
        """
        sequence = slot = 0
        for _ in range(_LOOKS):
            raw = _pread(self._fd, _COUNTERS.size, _SEQUENCE_AT)
            sequence, slot = _COUNTERS.unpack(raw) if len(raw) == _COUNTERS.size else (0, 0)
            if slot == sequence % _SLOTS:
                break
        return sequence, slot


def _length(descriptor: int) -> int:
    """Return the length of a file. Called many times a second; seeking takes a quarter of the time of `fstat`."""
    # Without `pread`, reading depends on the position.
    return os.lseek(descriptor, 0, os.SEEK_END) if hasattr(os, "pread") else os.fstat(descriptor).st_size


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
