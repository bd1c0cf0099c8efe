"""Location of a server's shared-memory regions, and the means to detect changes in them."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable
from pathlib import Path, PurePath

from urlab_client.aio.background import Tell
from urlab_client.aio.transport.poller import Doorbell, Poller
from urlab_client.errors import ProtocolError, URLabConnectionError
from urlab_client.protocol import doorbell
from urlab_client.protocol.messages.session import HelloOk
from urlab_client.protocol.shm import REPLY_FILE, REQUEST_FILE, region_directories

log: logging.Logger = logging.getLogger("urlab_client.transport")


class SharedMemoryRegions:
    """Location of the regions of one client's server, and the doorbell or thread that detects changes in them.

    Args:
        directory: Directory of the regions, overriding the one that the server reports.

    Attributes:
        directory: Directory of `state.shm`; None until a server reports it.
        rung: Callbacks for each ring of the doorbell, by kind.
        tell: Publishes an event of the client.
    """

    def __init__(self, directory: str | os.PathLike[str] | None) -> None:
        self.directory: Path | None = None
        self.tell: Tell | None = None
        # Replies last, because the task that waits for one resumes within the callback.
        self.rung: dict[bytes, list[Callable[[], None]]] = {doorbell.STATE: [], doorbell.CAMERA: [], doorbell.REPLY: []}
        self._told: dict[str, Path] = {}  # files that the server names explicitly, by region
        self._events = "", ""
        self._given = None if directory is None else Path(directory).absolute()
        self._waiter: Poller | None = None
        self._bell: Doorbell | None = None
        self._wanted: set[bytes] = set()

    @property
    def waiter(self) -> Poller:
        """The polling thread, used without a doorbell."""
        if self._waiter is None:
            self._waiter = Poller(asyncio.get_running_loop(), self.tell)
        return self._waiter

    @property
    def bell(self) -> Doorbell | None:
        """The doorbell, or None if it is not connected."""
        return self._bell

    def follow(self, hello: HelloOk) -> bool:
        """Adopt the locations in a handshake; return whether the regions have moved.

        Raises:
            URLabConnectionError: Play runs, but the server does not report the location of its regions.
            ProtocolError: The server names a file without an absolute path.
        """
        before = self.directory, self._told
        reported = hello.shm_rpc
        paths = {} if reported is None else {REQUEST_FILE: reported.req_path, REPLY_FILE: reported.rep_path}
        self._told = {file: _checked(path) for file, path in paths.items()}
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
        return (self.directory, self._told) != before

    def candidates(self, file: str) -> list[Path]:
        """Return the possible paths of a region's file, best first.

        Raises:
            ProtocolError: The server's directory is not absolute.
        """
        if self.directory is None:
            return []
        if self._given is not None:
            return [self._given / file]
        if file in self._told:
            return [self._told[file]]
        return [Path(directory) / file for directory in region_directories(self.directory, file)]

    def events(self, requests: Path) -> tuple[str, str]:
        """Return the names of the request and reply events on Windows.

        Args:
            requests: Path of the request region, whose directory determines the names that the server does not report.
        """
        asked, answered = self._events
        session = requests.parent.name
        return asked or f"Local\\URLab_{session}_req_ready", answered or f"Local\\URLab_{session}_rep_ready"

    def find(self, file: str) -> Path | None:
        """Return the path of a region's file, or None if it does not exist."""
        return next((path for path in self.candidates(file) if path.exists()), None)

    def connect_bell(self) -> Doorbell | None:
        """Return the doorbell, connecting it if the server has one."""
        if self._bell is None:
            on_ring = {kind: self._act(kind) for kind in self.rung}
            try:
                requests = self.find(REQUEST_FILE)
                path = None if requests is None else requests.with_name(doorbell.FILE)
                if path is None or not path.exists():
                    return None
                bell = self._bell = Doorbell(asyncio.get_running_loop(), path, on_ring, self._lose_bell)
            except (OSError, ProtocolError) as error:
                log.debug("no doorbell: %s", error)
                return None
            for message in self._wanted:
                bell.ring(message)  # may detect that the connection is already lost
        return self._bell

    def want(self, message: bytes) -> None:
        """Request rings for publications, too: `WANT_STATE` or `WANT_CAMERAS`."""
        if message not in self._wanted:
            self._wanted.add(message)
            if self._bell is not None:
                self._bell.ring(message)

    def disconnect(self) -> None:
        """Disconnect from a server that has gone or moved."""
        if self._bell is not None:
            self._bell.close()
            self._bell = None

    def close(self) -> None:
        """Release all resources. Idempotent."""
        self.disconnect()
        if self._waiter is not None:
            self._waiter.close()

    def _act(self, kind: bytes) -> Callable[[], None]:
        def act() -> None:
            for listener in tuple(self.rung[kind]):
                listener()

        return act

    def _lose_bell(self) -> None:
        self._bell = None
        # Listeners that waited for a ring check once more and continue without the doorbell.
        for kind in self.rung:
            self._act(kind)()


def _checked(path: str) -> Path:
    if not path or "\0" in path or not PurePath(path).is_absolute() or ".." in PurePath(path).parts:
        raise ProtocolError(f"hello: shm_rpc names the file {path!r}; expected an absolute path.", op="hello")
    return Path(path)
