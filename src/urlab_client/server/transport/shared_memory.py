"""The shared-memory transport of a server: requests and replies in two regions, state and pictures in others.

One thread watches the request region. For this package's client it sleeps until the doorbell rings, or on Windows until
the named event is set. For clients without a doorbell, such as the plugin's, it polls every 100 µs while they are
active and every 5 ms otherwise.
"""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, cast

from urlab_client._platform.mapped_files import MappedFile
from urlab_client._platform.processors import crowded, processor_fence
from urlab_client._platform.windows import NamedEvent
from urlab_client.errors import ProtocolError
from urlab_client.protocol.shm import (
    DOORBELL_FILE,
    LIVE_DIRECTORY,
    MAX_DOORBELL_PATH_BYTES,
    REPLY_FILE,
    REQUEST_FILE,
    RPC_STRIDE,
    SIZE_PREFIX,
    STATE_FILE,
    Publication,
    Region,
    Ring,
    camera_file,
    camera_stride,
    region_size,
    state_stride,
)
from urlab_client.server.system.temporary_folder import TemporaryFolder
from urlab_client.server.system.threads import Health, ServingThread

logger: logging.Logger = logging.getLogger("urlab_client.server")

Answer = Callable[[bytes], bytes]

MAX_REPLY_BYTES: Final = RPC_STRIDE - SIZE_PREFIX
"""Largest reply that fits into its slot."""

ACTIVE_POLL_S: Final = 1e-4
IDLE_POLL_S: Final = 5e-3
DOORBELL_POLL_S: Final = 0.05
"""Polling intervals: while a client without a doorbell is active, without any client, and with doorbell clients
only."""

ACTIVE_S: Final = 1.0
"""How long after a request a client without a doorbell counts as active."""

SPIN_S: Final = 2e-4
"""How long to spin for the next request after a fast one: waking up takes as long as an answer."""

STATE_PERIOD_S: Final = 0.1
PICTURE_PERIOD_S: Final = 10.0
"""How often state and pictures are published while all clients have a doorbell and none subscribed to them."""

BLIND_PICTURE_PERIOD_S: Final = 0.5
"""How often pictures are published while no client has a doorbell: a region does not know its readers."""

_BACKLOG: Final = 32
_LOOKS: Final = 100
_SELECTOR_STEP_S: Final = 1e-3
"""`epoll` rounds shorter waits up to this."""


class RegionFile:
    """A region of this server, moved into place once it is readable, and laid out again if somebody truncates it.

    Raises:
        OSError: The disk is full.
    """

    def __init__(self, path: Path, stride: int) -> None:
        self._path = path
        self._stride = stride
        # Windows neither replaces nor removes a file that a client has open, so there it is laid out in place.
        new = path if sys.platform == "win32" else path.with_name(f".{path.name}")
        try:
            self._file = MappedFile(new, writable=True, size=region_size(stride))
            self._region = self._laid_out()
            if new != path:
                new.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                new.unlink()
            raise

    @property
    def sequence(self) -> int:
        """Number of publications."""
        self._mend()
        return self._region.sequence

    def publish(self, payload: bytes) -> None:
        """Publish a payload.

        Raises:
            ValueError: The payload does not fit.
            OSError: The file was truncated, and the disk is too full to restore it.
        """
        self._mend()
        self._region.publish(payload)

    def read(self, seen: int) -> Publication[bytes] | None:
        """Return the newest publication, unless `seen` is its sequence. Raises `ProtocolError`."""
        self._mend()
        found = None
        for _ in range(_LOOKS):
            found = self._region.read_latest(seen)
            # A writer stores the slot before it counts. In between, its request would be read as the one before, and
            # then again, which would execute it twice.
            if found is None or self._region.is_counted(found.sequence):
                return found
            time.sleep(0)  # the writer may be a thread of this process
        return found

    def close(self) -> None:
        """Close the file and remove it. On Windows it remains while a client has it open."""
        self._region.release()
        self._file.close()
        with contextlib.suppress(OSError):
            self._path.unlink()

    def _mend(self) -> None:
        if not self._file.intact():
            logger.warning("%s was damaged and is laid out again", self._path)
            self._file.restore()
            self._region = self._laid_out()

    def _laid_out(self) -> Region:
        return Region.lay_out(self._file.view, self._stride, fence=processor_fence())


class SharedMemoryServer:
    """The regions of one server.

    A region does not know its readers. While no client has a doorbell, or a client without one sends requests, every
    snapshot is published, as by the plugin. Pictures are published thirty times a second while such a client sends
    requests, otherwise twice. If all clients have a doorbell, state and pictures are published as often as a client
    subscribes to them; without subscribers, state is published ten times a second and pictures every ten seconds.

    Attributes:
        directory: Absolute path of the directory with the regions.
    """

    def __init__(self, base: Path, health: Health) -> None:
        """Create the regions of requests and replies in a directory below `base`; `start` begins to serve.

        Raises:
            OSError: The disk is full, or `base` cannot be used.
        """
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        with contextlib.ExitStack() as made:
            self._folder = made.enter_context(TemporaryFolder(base.resolve()))
            # Clients look for most regions in a sibling `live` of the directory that the handshake names; this way that
            # is the directory itself, whatever other servers share the base.
            self.directory: Path = self._folder.path / LIVE_DIRECTORY
            self.directory.mkdir(mode=0o700)
            self._requests = RegionFile(self.directory / REQUEST_FILE, RPC_STRIDE)
            made.callback(self._requests.close)
            self._replies = RegionFile(self.directory / REPLY_FILE, RPC_STRIDE)
            made.callback(self._replies.close)
            self._doorbell = _Doorbell(self.directory)
            made.pop_all()
        self._active_at = -ACTIVE_S
        self._served_at = -SPIN_S
        self._spinning = False
        self._state: RegionFile | None = None
        self._state_at = 0.0
        self._cameras: dict[str, RegionFile] = {}
        self._pictures_at = 0.0
        self._lock = threading.Lock()
        self._too_large = False
        self._stopping = False
        self._released = False
        self._seen = 0  # so that a request before the thread's start is served
        self._answer: Answer = bytes
        self.serving: ServingThread = ServingThread("urlab-shm", self._run, health)

    def start(self, answer: Answer) -> None:
        """Start the thread that serves.

        `answer` returns at most `MAX_REPLY_BYTES`, or nothing to leave a request unanswered. It must not raise.
        """
        self._answer = answer
        self.serving.start()

    @property
    def alive(self) -> bool:
        """Whether requests are served."""
        return self.serving.alive

    def stop(self) -> None:
        """Ask the thread to end after the current request, without waiting."""
        self._stopping = True

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end after `stop`, and remove the regions. Return False if a request took longer."""
        if self.serving.started:
            return self.serving.join(timeout)
        self._release()
        return True

    # State, on the thread that publishes it.

    def wants_state(self) -> bool:
        """Whether to publish the snapshot of this tick. Cheap, because physics calls it."""
        if self._released:
            return False
        return not self._doorbell.listeners or self._due(Ring.STATE, self._state_at, STATE_PERIOD_S)

    def publish_state(self, snapshot: bytes) -> None:
        """Publish a snapshot; the first one of a play session determines the size of the region."""
        self._state_at = time.monotonic()
        try:
            with self._lock:
                if self._released:
                    return
                if self._state is None:
                    self._state = RegionFile(self.directory / STATE_FILE, state_stride(len(snapshot)))
                self._state.publish(snapshot)
        except (OSError, ValueError) as error:
            if not self._too_large:
                logger.warning("snapshots are not in shared memory: %s", error)
            self._too_large = True
            return
        self._too_large = False
        self._doorbell.ring(Ring.STATE)

    def end_state(self) -> None:
        """Remove the state region: the play session is over."""
        with self._lock:
            state, self._state = self._state, None
            if state is not None:
                state.close()

    # Cameras, on the thread that draws for the streams.

    def show_cameras(self, resolutions: dict[str, tuple[int, int]], header_bytes: int = 0) -> None:
        """Replace all camera regions by those of these cameras: width and height by `ARTICULATION/CAMERA`."""
        with self._lock:
            for region in self._cameras.values():
                region.close()
            self._cameras = {}
        self._pictures_at = time.monotonic()  # no unknown reader can be there before play begins
        for key, size in resolutions.items():
            self.switch_camera(key, size, header_bytes)

    def switch_camera(self, key: str, size: tuple[int, int] | None, header_bytes: int = 0) -> None:
        """Create the region of a camera, or remove it if `size` is None; no effect if that is already done."""
        with self._lock:
            if size is None:
                region = self._cameras.pop(key, None)
                if region is not None:
                    region.close()
                return
            if self._released or key in self._cameras:
                return
            articulation, _, camera = key.partition("/")
            try:
                path = self.directory / camera_file(articulation, camera)
                self._cameras[key] = RegionFile(path, camera_stride(*size) + header_bytes)
            except (OSError, ProtocolError) as error:
                logger.warning("camera '%s' is not in shared memory: %s", key, error)

    def wanted_cameras(self) -> list[str]:
        """Return the cameras whose pictures to publish now."""
        period = PICTURE_PERIOD_S if self._doorbell.listeners else BLIND_PICTURE_PERIOD_S
        return list(self._cameras) if self._due(Ring.CAMERA, self._pictures_at, period) else []

    def publish_picture(self, key: str, pixels: bytes) -> None:
        """Publish a picture of one of the `wanted_cameras`."""
        self._pictures_at = time.monotonic()
        with self._lock:
            region = self._cameras.get(key)
            if region is None:
                return
            try:
                region.publish(pixels)
            except (OSError, ValueError) as error:
                logger.warning("a picture of '%s' is not in shared memory: %s", key, error)
                return
        self._doorbell.ring(Ring.CAMERA)

    def _due(self, ring: bytes, last: float, period: float) -> bool:
        """Whether a client subscribed, or a client without a doorbell is active, or so much time has passed."""
        return self._doorbell.wanted(ring) or self._active() or time.monotonic() - last >= period

    def _active(self) -> bool:
        """Whether a client without a doorbell has sent a request recently."""
        return time.monotonic() - self._active_at < ACTIVE_S

    # The thread.

    def _run(self, owed: bytes | None) -> None:
        try:
            if owed is not None:
                self._reply(owed)
            while not self._stopping:
                if self._requests.sequence == self._seen and not (self._spinning and self._spin()):
                    rung = self._doorbell.wait(self._pause())
                    news = self._requests.sequence != self._seen
                    if rung:
                        self._active_at = -ACTIVE_S
                    elif news:
                        self._active_at = time.monotonic()
                    if not news:
                        continue
                self._spinning = time.monotonic() - self._served_at < SPIN_S and not crowded()
                if not self._serve():
                    return
                self._served_at = time.monotonic()
        except (OSError, ValueError):
            logger.exception("shared memory failed; the server answers over ZMQ alone")
        finally:
            if self.serving.is_current:
                self._release()  # so that clients notice

    def _spin(self) -> bool:
        """Poll for a short time without sleeping; return whether a request arrived."""
        while time.monotonic() - self._served_at < SPIN_S:
            if self._requests.sequence != self._seen:
                return True
            time.sleep(0)  # releases the interpreter lock
        return False

    def _pause(self) -> float:
        if self._active():
            return ACTIVE_POLL_S
        return DOORBELL_POLL_S if self._doorbell.listeners else IDLE_POLL_S

    def _serve(self) -> bool:
        """Answer the pending request; return False if another thread has done so and serves now."""
        sequence = self._requests.sequence
        try:
            request = self._requests.read(self._seen)
        except ProtocolError as error:
            logger.warning("a request stays unanswered: %s", error)
            request = None
        if request is None:  # laid out anew, damaged, or overwritten again and again
            self._seen = sequence
            return True
        self._seen = request.sequence
        self.serving.begin()
        reply = self._answer(request.payload)
        if not self.serving.finish():
            return False
        if reply:
            self._reply(reply)
        return True

    def _reply(self, reply: bytes) -> None:
        self._replies.publish(reply)
        self._doorbell.ring(Ring.REPLY)

    def _release(self) -> None:
        with self._lock:
            self._released = True
        self.show_cameras({})
        self.end_state()
        self._doorbell.close()
        self._requests.close()
        self._replies.close()
        self._folder.close()


class _Doorbell:
    """The server's end of the doorbell; see `urlab_client.protocol.shm`.

    Python has no Unix sockets on Windows. There the plugin's named events signal requests and replies.
    """

    def __init__(self, directory: Path) -> None:
        self._request_event = NamedEvent(f"Local\\URLab_{directory.name}_req_ready", create=True)
        self._reply_event = NamedEvent(f"Local\\URLab_{directory.name}_rep_ready", create=True)
        self._subscriptions: dict[socket.socket, set[bytes]] = {}
        self._lock = threading.Lock()
        self._selector = selectors.DefaultSelector()
        self._listener = self._listen(directory / DOORBELL_FILE)
        if self._listener is not None:
            self._selector.register(self._listener, selectors.EVENT_READ)

    @property
    def listeners(self) -> int:
        """Number of connected clients."""
        return len(self._subscriptions)

    def wanted(self, ring: bytes) -> bool:
        """Whether a client subscribed to these publications."""
        return any(ring in wants for wants in tuple(self._subscriptions.values()))

    def ring(self, ring: bytes) -> None:
        """Notify the clients without blocking. Thread-safe."""
        if ring == Ring.REPLY:
            self._reply_event.set()
        with self._lock:
            for client, wants in self._subscriptions.items():
                if ring == Ring.REPLY or ring in wants:
                    with contextlib.suppress(OSError):  # its buffer is full, or it is gone
                        client.send(ring)

    def wait(self, seconds: float) -> bool:
        """Wait until a client rings, or for some seconds; return whether one announced a request."""
        if self._request_event.exists:
            return self._request_event.wait(seconds)
        if seconds < _SELECTOR_STEP_S:
            time.sleep(seconds)
            seconds = 0.0
        ready = self._selector.select(seconds)
        return sum(self._read(cast("socket.socket", key.fileobj)) for key, _ in ready) > 0

    def close(self) -> None:
        """Disconnect all clients and remove the socket."""
        self._request_event.close()
        self._reply_event.close()
        with self._lock:
            for client in self._subscriptions:
                client.close()
            self._subscriptions.clear()
        self._stop_listening()
        self._selector.close()

    def _stop_listening(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None:
            self._selector.unregister(listener)
            with contextlib.suppress(OSError):
                os.unlink(listener.getsockname())
            listener.close()

    def _listen(self, path: Path) -> socket.socket | None:
        if not hasattr(socket, "AF_UNIX"):
            return None
        if len(os.fsencode(path)) > MAX_DOORBELL_PATH_BYTES:
            logger.info("no doorbell: the path %s is too long for a socket; clients poll", path)
            return None
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listener.bind(os.fspath(path))
            path.chmod(0o600)
            listener.listen(_BACKLOG)
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            logger.info("no doorbell: %s; clients poll", error)
            return None
        return listener

    def _read(self, source: socket.socket) -> bool:
        """Handle a readable socket; return whether its client announced a request."""
        if source is self._listener:
            self._accept(source)
            return False
        try:
            data = source.recv(4096)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if not data:
            self._selector.unregister(source)
            with self._lock:
                self._subscriptions.pop(source, None)
                source.close()
            return False
        if Ring.WANT_STATE in data:
            self._subscriptions[source].add(Ring.STATE)
        if Ring.WANT_CAMERAS in data:
            self._subscriptions[source].add(Ring.CAMERA)
        return Ring.REQUEST in data

    def _accept(self, listener: socket.socket) -> None:
        try:
            client, _ = listener.accept()
        except BlockingIOError:
            return
        except OSError as error:  # no descriptor left: retrying would be a busy loop
            logger.warning("no doorbell any more: %s; further clients poll", error)
            self._stop_listening()
            return
        client.setblocking(False)
        self._selector.register(client, selectors.EVENT_READ)
        with self._lock:
            self._subscriptions[client] = set()
        with contextlib.suppress(OSError):
            client.send(Ring.REPLY)  # its first request may have been answered before it was accepted
