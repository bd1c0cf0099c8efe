"""A server's regions of shared memory: where they are, how they are mapped, and the doorbell that tells of news.

The files belong to the server, which may remove, replace or truncate them at any time. Accessing a mapping beyond the
end of its file kills the process, so check `intact` before each access.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import mmap
import os
import socket
import stat
import sys
from collections.abc import Callable
from pathlib import Path, PurePath

from urlab_client._platform.processors import processor_fence
from urlab_client._platform.windows import NamedLock
from urlab_client.aio.background import Tell
from urlab_client.aio.transport.waiting import Watch
from urlab_client.errors import ProtocolError, URLabConnectionError
from urlab_client.protocol import shm
from urlab_client.protocol.messages.session import HelloOk
from urlab_client.protocol.shm import RegionNotReady, Ring

if sys.platform != "win32":
    import fcntl

log: logging.Logger = logging.getLogger("urlab_client.transport")

_BLOCK = 512  # bytes; unit of `st_blocks`


class RegionInUse(ProtocolError):
    """Another client on this machine uses the region."""


class MappedRegion:
    """One mapped region.

    Args:
        path: The file.
        writable: Whether to map the region for writing, too, and to take the lock that excludes other clients, held
            until `close`.

    Raises:
        RegionNotReady: The region is still being created.
        RegionInUse: Another client holds the lock.
        ProtocolError: The file is not a region.
        OSError: The file cannot be opened.
    """

    def __init__(self, path: Path, *, writable: bool = False) -> None:
        self.path = path
        self._lock: NamedLock | None = None
        self._locked_by = 0
        # Non-blocking: opening a pipe at this path would wait for its other end.
        mode = os.O_RDWR if writable else os.O_RDONLY
        self._fd = os.open(path, mode | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0))
        try:
            self._map(writable=writable)
        except BaseException:
            self._release()
            raise

    def _map(self, *, writable: bool) -> None:
        about = os.fstat(self._fd)
        if not stat.S_ISREG(about.st_mode):
            raise ProtocolError(f"{self.path} is not a file.")
        if about.st_size < shm.HEADER_SIZE:
            raise RegionNotReady(f"{self.path}: {about.st_size} bytes, expected a header of {shm.HEADER_SIZE}.")
        if writable and not self._take_lock():
            raise RegionInUse(f"{self.path}: another client on this machine uses it.")
        self._identity = about.st_dev, about.st_ino
        self._size = about.st_size
        if writable and hasattr(os, "posix_fallocate") and about.st_blocks * _BLOCK < self._size:
            # Writing to a hole of a file when the disk is full also kills the process.
            os.posix_fallocate(self._fd, 0, self._size)
        access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
        self._mmap = mmap.mmap(self._fd, self._size, access=access)
        try:
            self.region: shm.Region = shm.attach(memoryview(self._mmap), fence=processor_fence())
        except ProtocolError as error:
            raise type(error)(f"{self.path}: {error.args[0]}") from None
        self._layout = self._mmap[: shm.LAYOUT_SIZE]

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

    def laid_out_anew(self) -> bool:
        """Return whether the layout of the region has changed since it was mapped. Call only while `intact`."""
        return self._mmap[: shm.LAYOUT_SIZE] != self._layout

    def close(self) -> None:
        """Unmap and close the file. A view that the user holds keeps the mapping alive."""
        self.region.release()
        with contextlib.suppress(BufferError):
            self._mmap.close()
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


class ServerRegions:
    """Location of the regions of one client's server, and the doorbell if the server has one.

    Args:
        directory: Directory of the regions, overriding the one that the server reports.

    Attributes:
        directory: Directory of `state.shm`; None until a server reports it.
        doorbell: The doorbell; None if it is not connected.
        on_ring: Callbacks for each kind of ring. All are also called when the doorbell is lost: they look once more and
            go on without it.
        tell: Publishes an event of the client.
    """

    def __init__(self, directory: str | os.PathLike[str] | None) -> None:
        self.directory: Path | None = None
        self.doorbell: Doorbell | None = None
        self.on_ring: dict[bytes, list[Callable[[], None]]] = {Ring.STATE: [], Ring.CAMERA: [], Ring.REPLY: []}
        self.tell: Tell | None = None
        self._reported: dict[str, Path] = {}  # files that the server names explicitly, by region
        self._events = "", ""
        self._given = None if directory is None else Path(directory).absolute()
        self._wanted: set[bytes] = set()

    def follow(self, hello: HelloOk) -> bool:
        """Adopt the locations in a handshake; return whether the regions have moved.

        Raises:
            URLabConnectionError: Play runs, but the server does not report the location of its regions.
            ProtocolError: The server names a file without an absolute path.
        """
        before = self.directory, self._reported
        reported = hello.shm_rpc
        paths = {} if reported is None else {shm.REQUEST_FILE: reported.req_path, shm.REPLY_FILE: reported.rep_path}
        self._reported = {file: _checked(path) for file, path in paths.items()}
        self._events = ("", "") if reported is None else (reported.req_event, reported.rep_event)
        if self._given is not None:
            self.directory = self._given
        elif hello.shm_session_dir is not None:
            self.directory = Path(hello.shm_session_dir)
        elif hello.manager_present:
            raise URLabConnectionError(
                "discover: transport='shm', but the server reports no shared-memory directory.",
                hint="Start the server with shared memory, or use transport='zmq'.",
            )
        return (self.directory, self._reported) != before

    def candidates(self, file: str) -> list[Path]:
        """Return the possible paths of a region's file, best first.

        Raises:
            ProtocolError: The server's directory is not absolute.
        """
        if self.directory is None:
            return []
        if self._given is not None:
            return [self._given / file]
        if file in self._reported:
            return [self._reported[file]]
        return [Path(directory) / file for directory in shm.region_directories(self.directory, file)]

    def events(self, requests: Path) -> tuple[str, str]:
        """Return the names of the request and reply events on Windows.

        Those that the server does not report follow from the directory of the request region.
        """
        request, reply = self._events
        session = requests.parent.name
        return request or f"Local\\URLab_{session}_req_ready", reply or f"Local\\URLab_{session}_rep_ready"

    def find(self, file: str) -> Path | None:
        """Return the path of a region's file, or None if it does not exist."""
        return next((path for path in self.candidates(file) if path.exists()), None)

    def connect_doorbell(self) -> None:
        """Connect to the doorbell if the server has one and it is not connected yet."""
        if self.doorbell is not None:
            return
        try:
            requests = self.find(shm.REQUEST_FILE)
            path = None if requests is None else requests.with_name(shm.DOORBELL_FILE)
            if path is None or not path.exists():
                return
            doorbell = self.doorbell = Doorbell(asyncio.get_running_loop(), path, self._on_rings, self._on_lost)
        except (OSError, ProtocolError) as error:
            log.debug("no doorbell: %s", error)
            return
        for message in self._wanted:
            doorbell.ring(message)  # may detect that the connection is already lost

    def want(self, message: bytes) -> None:
        """Request rings for publications, too: `Ring.WANT_STATE` or `Ring.WANT_CAMERAS`."""
        if message not in self._wanted:
            self._wanted.add(message)
            if self.doorbell is not None:
                self.doorbell.ring(message)

    def close(self) -> None:
        """Disconnect from a server that has gone or moved. Idempotent."""
        if self.doorbell is not None:
            self.doorbell.close()
            self.doorbell = None

    def _on_rings(self, rings: bytes) -> None:
        for ring, listeners in self.on_ring.items():
            if ring in rings:
                for listener in tuple(listeners):
                    listener()

    def _on_lost(self) -> None:
        self.doorbell = None
        self._on_rings(b"".join(self.on_ring))


class Doorbell:
    """The client's end of the doorbell.

    Raises:
        OSError: No server accepts connections there.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        path: Path,
        on_rings: Callable[[bytes], None],
        on_lost: Callable[[], None],
    ) -> None:
        self._on_rings = on_rings
        self._on_lost = on_lost
        if len(str(path).encode()) > shm.MAX_DOORBELL_PATH_BYTES:
            raise OSError(f"{path} is too long for a socket")
        if not hasattr(socket, "AF_UNIX"):
            raise OSError("this system has no Unix sockets")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect(str(path))
            self._watch = Watch(loop, self._on_readable, fd=self._socket.fileno())
        except BaseException:
            self._socket.close()
            raise

    def ring(self, message: bytes) -> None:
        """Wake the server."""
        try:
            self._socket.send(message)
        except BlockingIOError:
            pass  # earlier rings are still pending
        except OSError:
            self._lose()

    def close(self) -> None:
        """Close the connection. Idempotent."""
        if self._socket.fileno() >= 0:
            self._watch.close()
            self._socket.close()

    def _on_readable(self) -> None:
        try:
            rings = self._socket.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            rings = b""
        if rings:
            self._on_rings(rings)
        else:
            self._lose()

    def _lose(self) -> None:
        if self._socket.fileno() >= 0:
            self.close()
            self._on_lost()


def _checked(path: str) -> Path:
    if not path or "\0" in path or not PurePath(path).is_absolute() or ".." in PurePath(path).parts:
        raise ProtocolError(f"hello: shm_rpc names the file {path!r}; expected an absolute path.", op="hello")
    return Path(path)
