"""A server's regions of shared memory: where they are, who reads them, and how the client learns of news in them.

The files belong to the server, which may remove, replace or truncate them at any time. All regions are read in the same
way: the doorbell tells of news, or, without one, a thread that looks at them. While somebody waits for news, the loop
looks, too, every 50 ms, for lost rings and for regions that were lost.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import TypeVar

from urlab_client._platform.mapped_files import MappedFile
from urlab_client._platform.processors import processor_fence
from urlab_client.aio.background import Tell
from urlab_client.aio.transport.waiting import Watch
from urlab_client.errors import ProtocolError, URLabConnectionError
from urlab_client.protocol import shm
from urlab_client.protocol.messages.session import HelloOk
from urlab_client.protocol.shm import Publication, Region, Ring

log: logging.Logger = logging.getLogger("urlab_client.transport")

T = TypeVar("T")

_LOOK_S = 0.05
_ATTEMPTS = 4

_WANTS = {Ring.STATE: Ring.WANT_STATE, Ring.CAMERA: Ring.WANT_CAMERAS}


class MessageGone(ProtocolError):
    """A message was overwritten or removed before it was read. This is not a fault of either side."""


def attached(file: MappedFile) -> Region:
    """Return the region in a file. Raises `ProtocolError` and closes the file if there is none."""
    try:
        return Region(file.view, fence=processor_fence())
    except ProtocolError as error:
        file.close()
        raise type(error)(f"{file.path}: {error.args[0]}") from None


class RegionReader:
    """A mapped region that is read.

    Args:
        location: Where the region is; tells of rings.
        name: Name of the region's file.
        ring: The doorbell's message about it.
        on_news: Called on the loop when there is a publication that is not `seen` yet. Must set `seen`.
        on_lost: Called on the loop when the file was removed, replaced, truncated or laid out anew. Must close this.
        fastest_s: Pause between two looks of the thread, if there is no doorbell, in the first millisecond.

    Attributes:
        waits: Whether somebody waits for news.
        seen: Sequence of the last publication that was dealt with.
        quiet: Looks of the loop since there was news.
        block: Sleeps until the server signals news, for at most the given seconds; None without signals.

    Raises:
        FileNotFoundError: There is no file.
        RegionNotReady: The region is still being created.
        ProtocolError: The file is not a region.
        OSError: The file cannot be opened.
    """

    def __init__(
        self,
        location: ServerRegions,
        name: str,
        ring: bytes,
        *,
        on_news: Callable[[], None],
        on_lost: Callable[[], None],
        fastest_s: float,
    ) -> None:
        self.name: str = name
        self.ring: bytes = ring
        self.file: MappedFile = MappedFile(location.find(name))
        self.region: Region = attached(self.file)
        self.waits: bool = True
        self.seen: int = 0
        self.quiet: int = 0
        self.block: Callable[[float], object] | None = None
        self._location = location
        self._on_news = on_news
        self._on_lost = on_lost
        self._fastest_s = fastest_s
        self._watch: Watch | None = None
        # Pictures are read on the thread that accesses them.
        self._lock = threading.Lock()
        self.closed: bool = False
        location.add(self)

    def has_news(self) -> bool:
        """Return whether there is something to do. Called on the watching thread, too."""
        return not self.file.intact() or self.region.sequence != self.seen

    def check(self) -> None:
        """Report news or the loss of the region."""
        if self.closed:
            return
        if not self.file.intact():
            self._on_lost()
        elif self.region.sequence != self.seen:
            if self.region.begun_anew(self.seen):
                self._on_lost()
            else:
                self.quiet = 0
                self._on_news()

    def look(self) -> None:
        """Check, and have the thread look on if somebody waits and there is no doorbell."""
        self.check()
        if self.closed or not self.waits or self._location.doorbell is not None:
            return
        if self._watch is None:
            self._watch = Watch(
                self._location.loop,
                self.look,
                has_news=self.has_news,
                block=self.block,
                fastest_s=self._fastest_s,
                tell=self._location.tell,
            )
        self._watch.expect()

    def ignore(self) -> None:
        """Nobody waits for news any more."""
        self.waits = False
        if self._watch is not None:
            self._watch.ignore()

    def moved(self) -> bool:
        """Return whether another file has taken the place of this one."""
        try:
            return self.file.replaced() or self._location.find(self.name) != self.file.path
        except (OSError, ProtocolError):  # the directory's name comes from the server
            return True

    def supervise(self) -> None:
        """Look, and check the file if nothing has come since the last time."""
        self.quiet += 1
        self.look()
        if not self.closed and self.quiet > 1 and self.moved():
            self._on_lost()

    def read(self, take: Callable[[memoryview], T]) -> Publication[T]:
        """Return the newest publication, converted. Call from any thread.

        Raises:
            MessageGone: The region is gone.
            ProtocolError: No publication could be read completely.
        """
        with self._lock:
            if not self.closed and self.file.intact():
                for _ in range(_ATTEMPTS):
                    found = self.region.read_latest(take=take)
                    if found is not None:
                        return found
                raise ProtocolError(f"{self.file.path}: pictures arrive faster than they can be read.")
        raise MessageGone(f"{self.file.path}: the picture is gone.")

    def view(self) -> tuple[Publication[memoryview], Callable[[], bool]] | None:
        """Return a live view of the current publication and a check whether it is still valid."""

        def holds(sequence: int) -> bool:
            with self._lock:
                return not self.closed and self.file.intact() and self.region.holds(sequence)

        with self._lock:
            if self.closed or not self.file.intact():
                return None
            found = self.region.read_latest(take=lambda view: view)
            return None if found is None else (found, lambda: holds(found.sequence))

    def close(self) -> None:
        """Let go of the region. Idempotent."""
        if self.closed:
            return
        self._location.remove(self)
        if self._watch is not None:
            self._watch.close()
            self._watch = None  # it refers to this reader, whose mapping must not wait for the garbage collector
        with self._lock:
            self.closed = True
            self.region.release()
            self.file.close()


class ServerRegions:
    """The regions of one client's server, and the doorbell if the server has one.

    Args:
        directory: Directory of the regions, overriding the one that the server reports.

    Attributes:
        directory: Directory of `state.shm`; None until a server reports it.
        doorbell: The doorbell; None if it is not connected.
        on_look: Callbacks for each look of the loop, with the loop time at which it was due.
        tell: Publishes an event of the client.
    """

    def __init__(self, directory: str | os.PathLike[str] | None) -> None:
        self.directory: Path | None = None
        self.doorbell: Doorbell | None = None
        self.on_look: list[Callable[[float], None]] = []
        self.tell: Tell | None = None
        self._reported: dict[str, Path] = {}  # files that the server names explicitly, by region
        self._events = "", ""
        self._given = None if directory is None else Path(directory).absolute()
        self._readers: dict[RegionReader, None] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        # One timer for all: most replies arrive long before, and creating and cancelling one takes a tenth of the time
        # of a step.
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The client's event loop."""
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
        return self._loop

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

    def _candidates(self, file: str) -> list[Path]:
        """Return the possible paths of a region's file, best first."""
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

    def find(self, file: str) -> Path:
        """Return the path of a region's file.

        Raises:
            FileNotFoundError: There is none.
            ProtocolError: The server's directory is not absolute.
        """
        candidates = self._candidates(file)
        for path in candidates:
            if path.exists():
                return path
        raise FileNotFoundError(f"there is no {', '.join(map(str, candidates)) or file}")

    def add(self, reader: RegionReader) -> None:
        """Tell a reader of its news."""
        self._readers[reader] = None
        self.connect_doorbell()
        if self.doorbell is not None and reader.ring in _WANTS:
            self.doorbell.ring(_WANTS[reader.ring])

    def remove(self, reader: RegionReader) -> None:
        """Tell a reader of nothing any more."""
        self._readers.pop(reader, None)

    def connect_doorbell(self) -> None:
        """Connect to the doorbell if the server has one and it is not connected yet."""
        if self.doorbell is not None:
            return
        try:
            path = self.find(shm.REQUEST_FILE).with_name(shm.DOORBELL_FILE)
            doorbell = self.doorbell = Doorbell(self.loop, path, self._on_rings, self._on_lost)
        except (OSError, ProtocolError) as error:
            log.debug("no doorbell: %s", error)
            return
        for want in {_WANTS[reader.ring] for reader in self._readers if reader.ring in _WANTS}:
            doorbell.ring(want)  # may detect that the connection is already lost

    def look_by(self, when: float | None = None) -> None:
        """Look at the regions in 50 ms, or at `when`, if that is earlier."""
        if self._timer is not None:
            if when is None or when >= self._due:
                return
            self._timer.cancel()
        self._due = min(self.loop.time() + _LOOK_S, math.inf if when is None else when)
        self._timer = self.loop.call_at(self._due, self._look)

    def close(self) -> None:
        """Disconnect from a server that has gone or moved. Idempotent."""
        if self.doorbell is not None:
            self.doorbell.close()
            self.doorbell = None

    def _look(self) -> None:
        self._timer = None
        due = self._due  # not the current time: the loop may be early by its resolution
        for callback in self.on_look:
            callback(due)
        for reader in tuple(self._readers):
            if reader.waits:
                reader.supervise()

    def _on_rings(self, rings: bytes) -> None:
        for reader in tuple(self._readers):
            if reader.ring in rings:
                reader.look()

    def _on_lost(self) -> None:
        self.doorbell = None
        for reader in tuple(self._readers):
            reader.look()


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
