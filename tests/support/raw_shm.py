"""A client of the shared-memory regions that knows their bytes and nothing else."""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import socket
import struct
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from urlab_client._platform.windows import NamedEvent

HEADER = struct.Struct("<IIIIQI")


class RawRegion:
    """One mapped region."""

    def __init__(self, path: Path) -> None:
        self.fd = os.open(path, os.O_RDWR)
        self.map = mmap.mmap(self.fd, os.fstat(self.fd).st_size)

    @property
    def header(self) -> tuple[int, ...]:
        """Magic, version, stride, slots, sequence, newest slot."""
        return HEADER.unpack_from(self.map)

    @property
    def sequence(self) -> int:
        return self.header[4]

    def payload(self) -> bytes:
        _, _, stride, _, _, latest = self.header
        start = 64 + latest * stride
        (size,) = struct.unpack_from("<I", self.map, start)
        return self.map[start + 4 : start + 4 + size]

    def read(self) -> tuple[int, bytes]:
        """Sequence and payload, by the strict rule."""
        while True:
            before = self.sequence
            payload = self.payload()
            if self.sequence == before:
                return before, payload

    def publish(self, payload: bytes) -> None:
        _, _, stride, slots, sequence, latest = self.header
        target = (latest + 1) % slots
        start = 64 + target * stride
        struct.pack_into("<I", self.map, start, len(payload))
        self.map[start + 4 : start + 4 + len(payload)] = payload
        struct.pack_into("<I", self.map, 24, target)
        struct.pack_into("<Q", self.map, 16, sequence + 1)

    def close(self) -> None:
        self.map.close()
        os.close(self.fd)


class NamedEvents:
    """What Windows has in place of the doorbell, for requests and replies; nothing tells of streams."""

    def __init__(self, directory: Path) -> None:
        self.asked = NamedEvent(f"Local\\URLab_{directory.name}_req_ready")
        self.answered = NamedEvent(f"Local\\URLab_{directory.name}_rep_ready")

    def send(self, ring: bytes) -> None:
        if ring == b"q":
            self.asked.set()

    def wait(self, seconds: float) -> bytes:
        return b"r" if self.answered.wait(seconds) else b""

    def close(self) -> None:
        self.asked.close()
        self.answered.close()


class Doorbell:
    """The Unix socket."""

    def __init__(self, directory: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(os.fspath(directory / "doorbell.sock"))

    def send(self, ring: bytes) -> None:
        self.socket.send(ring)

    def wait(self, seconds: float) -> bytes:
        ready, _, _ = select.select([self.socket], (), (), seconds)
        return self.socket.recv(4096) if ready else b""

    def close(self) -> None:
        self.socket.close()


class RawShm:
    """Requests over `req.shm` and `rep.shm`, with or without being told."""

    def __init__(self, directory: Path, *, doorbell: bool) -> None:
        self.directory = directory
        self.requests = RawRegion(directory / "req.shm")
        self.replies = RawRegion(directory / "rep.shm")
        self.doorbell: Doorbell | NamedEvents | None = None
        if doorbell:
            self.doorbell = NamedEvents(directory) if sys.platform == "win32" else Doorbell(directory)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.requests.close()
        self.replies.close()
        if self.doorbell is not None:
            self.doorbell.close()

    def call(self, request: dict[str, Any] | bytes, seconds: float = 30.0) -> dict[str, Any] | None:
        """The reply, or None if there is none in time."""
        before = self.replies.sequence
        self.requests.publish(request if isinstance(request, bytes) else msgspec.msgpack.encode(request))
        if self.doorbell is not None:
            self.doorbell.send(b"q")
        deadline = time.monotonic() + seconds
        while self.replies.sequence == before:
            left = deadline - time.monotonic()
            if left <= 0:
                return None
            with contextlib.suppress(OSError):
                self.wait(min(left, 0.001 if self.doorbell is None else 0.5))
        return msgspec.msgpack.decode(self.replies.read()[1])

    def wait(self, seconds: float) -> bytes:
        """Rings that came."""
        if self.doorbell is None:
            time.sleep(seconds)
            return b""
        return self.doorbell.wait(seconds)
