"""The shared-memory transport of a server: requests and replies in two regions, state and pictures in others.

For `SimulatedServer`. One thread watches the request region. With our own client it sleeps until the doorbell rings, or
on Windows the named event is set; for clients without one, as the plugin's, it looks every 100 µs while they are at
work and every 5 ms otherwise.
"""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, cast

from urlab_client._processors import crowded
from urlab_client._windows import NamedEvent
from urlab_client.protocol import doorbell
from urlab_client.protocol.errors import ProtocolError
from urlab_client.protocol.shm import (
    REPLY_FILE,
    REQUEST_FILE,
    RPC_STRIDE,
    SIZE_PREFIX,
    STATE_FILE,
    camera_file,
    camera_stride,
    state_stride,
)
from urlab_client.server.system.health import Health
from urlab_client.server.system.serving_thread import ServingThread
from urlab_client.server.transport.region_files import InstanceDirectory, RegionFile, RequestFile

__all__ = ["MAX_REPLY_BYTES", "SharedMemoryServer"]

logger: logging.Logger = logging.getLogger("urlab_client.server")

Answer = Callable[[bytes], bytes]

MAX_REPLY_BYTES: Final = RPC_STRIDE - SIZE_PREFIX
"""Largest reply that fits its slot."""

BUSY_POLL_S: Final = 1e-4
IDLE_POLL_S: Final = 5e-3
RUNG_POLL_S: Final = 0.05
"""Between two looks at the requests: while a client without a doorbell is at work, when nobody is there, and when
somebody with a doorbell is."""

AT_WORK_S: Final = 1.0
"""How long after a request its client counts as at work."""

BRISK_S: Final = 2e-4
"""Requests that follow each other so quickly are waited for without sleep: waking up takes as long as an answer."""

STATE_PERIOD_S: Final = 0.1
PICTURE_PERIOD_S: Final = 10.0
"""How often state and pictures are published while all clients have a doorbell and none wants them."""

BLIND_PICTURE_PERIOD_S: Final = 0.5
"""How often pictures are published while no client has a doorbell: a region has no list of its readers."""

MAX_LISTENERS: Final = 32

DOOR_SHUT_S: Final = 1.0
"""How long nobody new is let in after there was no descriptor for somebody."""

_SELECTOR_STEP_S: Final = 1e-3
"""Shorter waits than this are rounded up by `epoll`."""


class SharedMemoryServer:
    """The regions of one server.

    A region has no list of its readers. While no client has a doorbell, or one without it makes requests, every
    snapshot is published, as by the plugin; pictures come thirty times a second while such a client makes requests,
    else twice. Where all clients have a doorbell, those who want state or pictures get all of them; while nobody does,
    state is published ten times a second and pictures every ten seconds.

    Attributes:
        directory: Where the regions are, absolute.
    """

    def __init__(self, base: Path, health: Health) -> None:
        """Lay out the regions of requests and replies; `start` begins to serve.

        Args:
            base: Directory below which this server makes one of its own.
            health: Told when requests cannot be served any more.

        Raises:
            OSError: There is no room, or the base cannot be used.
        """
        self._health = health
        with contextlib.ExitStack() as made:
            self._instance = InstanceDirectory(base)
            made.callback(self._instance.remove)
            self.directory: Path = self._instance.path
            self._requests = RequestFile(self.directory / REQUEST_FILE, RPC_STRIDE)
            made.callback(self._requests.close)
            self._replies = RegionFile(self.directory / REPLY_FILE, RPC_STRIDE)
            made.callback(self._replies.close)
            self._bell = _Bell(self.directory)
            made.pop_all()
        self._unrung_at = -AT_WORK_S
        self._unannounced = False
        self._served_at = -BRISK_S
        self._brisk = False
        self._state: RegionFile | None = None
        self._state_at = 0.0
        self._cameras: dict[str, RegionFile] = {}
        self._pictures_at = 0.0
        self._lock = threading.Lock()
        self._too_large = False
        self._stopping = False
        self._released = False
        self._given_up = False
        self._seen = 0  # whoever was quicker than the thread is not forgotten
        self._answer: Answer = bytes
        self.serving: ServingThread = ServingThread("urlab-shm", self._run)

    def start(self, answer: Answer) -> None:
        """Start the thread that serves.

        Args:
            answer: Turns a request into its reply of at most `MAX_REPLY_BYTES`, or into nothing, so that it stays
                unanswered; must not raise.
        """
        self._answer = answer
        self.serving.start()

    @property
    def alive(self) -> bool:
        """Whether requests are served."""
        return self.serving.alive

    def stop(self) -> None:
        """Ask the thread to end after the request under way, without waiting."""
        self._stopping = True
        self._bell.wake()

    def join(self, timeout: float) -> bool:
        """Wait for the end after `stop` and remove the regions.

        Returns:
            False when the request under way took longer.
        """
        if self.serving.started:
            ended = self.serving.join(timeout)
            with self._lock:
                self._given_up = not ended and self.serving.alive
            if self._given_up:
                return False
        self._release()
        return True

    # State, on the thread that sends it.

    def wants_state(self) -> bool:
        """Whether the snapshot of this tick is to be published. Cheap; called by physics."""
        if self._released:
            return False
        if self._bell.wanted(doorbell.STATE) or not self._bell.listeners:
            return True
        now = time.monotonic()
        return self._at_work(now) or now - self._state_at >= STATE_PERIOD_S

    def publish_state(self, snapshot: bytes) -> None:
        """Publish a snapshot; the first of a play session decides on the size of the region."""
        self._state_at = time.monotonic()
        try:
            with self._lock:
                if self._state is None:
                    self._state = RegionFile(self.directory / STATE_FILE, state_stride(len(snapshot)))
                self._state.publish(snapshot)
        except (OSError, ValueError) as error:
            if not self._too_large:
                logger.warning("snapshots are not in shared memory: %s", error)
            self._too_large = True
            return
        self._too_large = False
        self._bell.ring(doorbell.STATE)

    def end_state(self) -> None:
        """Remove the state region: the play session is over."""
        with self._lock:
            state, self._state = self._state, None
            if state is not None:
                state.close()

    # Cameras, on the thread that draws for streams.

    def show_cameras(self, resolutions: dict[str, tuple[int, int]], header_bytes: int = 0) -> None:
        """Lay out the regions of these cameras, by `ARTICULATION/CAMERA`, in place of all others.

        Args:
            resolutions: Width and height of each.
            header_bytes: What stands before the pixels.
        """
        with self._lock:
            for region in self._cameras.values():
                region.close()
            self._cameras = {}
        self._pictures_at = time.monotonic()  # whoever begins play comes before readers that nobody knows of
        for key, size in resolutions.items():
            self.switch_camera(key, size, header_bytes)

    def switch_camera(self, key: str, size: tuple[int, int] | None, header_bytes: int = 0) -> None:
        """Lay out the region of one camera, or with no size take it away; without effect where that is done already."""
        with self._lock:
            if size is None:
                region = self._cameras.pop(key, None)
                if region is not None:
                    region.close()
                return
            if key in self._cameras:
                return
            articulation, _, camera = key.partition("/")
            try:
                path = self.directory / camera_file(articulation, camera)
                self._cameras[key] = RegionFile(path, camera_stride(*size) + header_bytes)
            except (OSError, ProtocolError) as error:
                logger.warning("camera '%s' is not in shared memory: %s", key, error)

    def wanted_cameras(self) -> list[str]:
        """Return the cameras whose pictures are to be published now."""
        now = time.monotonic()
        period = PICTURE_PERIOD_S if self._bell.listeners else BLIND_PICTURE_PERIOD_S
        if self._bell.wanted(doorbell.CAMERA) or self._at_work(now) or now - self._pictures_at >= period:
            return list(self._cameras)
        return []

    def publish_picture(self, key: str, pixels: bytes) -> None:
        """Publish a picture of a camera that was wanted."""
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
        self._bell.ring(doorbell.CAMERA)

    def _at_work(self, now: float) -> bool:
        """Whether a client without a doorbell makes requests."""
        return now - self._unrung_at < AT_WORK_S

    # The thread.

    def _run(self, owed: bytes | None) -> None:
        try:
            if owed is not None:
                self._reply(owed)
            while not self._stopping:
                if self._requests.sequence() == self._seen and not (self._brisk and self._follows(self._seen)):
                    rung = self._bell.wait(self._pause())
                    self._learn(rung=rung)
                    if self._requests.sequence() == self._seen:
                        continue
                    self._unannounced = not rung
                self._brisk = time.monotonic() - self._served_at < BRISK_S and not crowded()
                if not self._serve():
                    return
                self._served_at = time.monotonic()
        except (OSError, ValueError):
            logger.exception("shared memory failed; the server answers over ZMQ alone")
            self._give_up()
        except BaseException as error:  # noqa: BLE001 - clients over ZMQ hear of it by the next request
            self._health.report(error)
            self._give_up()
        finally:
            with self._lock:
                given_up = self._given_up
            if given_up and self.serving.is_current:  # nobody waits for this thread any more
                self._release()

    def _give_up(self) -> None:
        self._stopping = True
        self._release()  # so that clients see it, too

    def _follows(self, seen: int) -> bool:
        """Look for a while without sleep; return whether a request came."""
        while time.monotonic() - self._served_at < BRISK_S:
            if self._requests.sequence() != seen:
                return True
            time.sleep(0)  # others may have the interpreter
        return False

    def _learn(self, *, rung: bool) -> None:
        """Conclude from a wait whether the client at work has a doorbell: a ring may come after its request is seen."""
        if rung:
            self._unrung_at = -AT_WORK_S
        elif self._unannounced:
            self._unrung_at = time.monotonic()
        self._unannounced = False

    def _pause(self) -> float:
        if self._unannounced or self._at_work(time.monotonic()):
            return BUSY_POLL_S
        return RUNG_POLL_S if self._bell.listeners else IDLE_POLL_S

    def _serve(self) -> bool:
        """Answer the request that is there; return False if another thread has done so and serves now."""
        self._seen, request = self._requests.read()
        if request is None:
            logger.warning("a request in shared memory could not be read and stays unanswered")
            return True
        self.serving.begin()
        reply = self._answer(request)
        if not self.serving.finish():
            return False
        if reply:
            self._reply(reply)
        return True

    def _reply(self, reply: bytes) -> None:
        self._replies.publish(reply)
        self._bell.ring(doorbell.REPLY)

    def _release(self) -> None:
        with self._lock:
            released, self._released = self._released, True
        if released:
            return
        self.show_cameras({})
        self.end_state()
        self._bell.close()
        self._requests.close()
        self._replies.close()
        self._instance.remove()


class _Bell:
    """The server's end of the doorbell; see `urlab_client.protocol.doorbell`.

    Windows has no Unix sockets in Python. There the plugin's named events tell of requests and replies.
    """

    def __init__(self, directory: Path) -> None:
        self._asked = NamedEvent(f"Local\\URLab_{directory.name}_req_ready", create=True)
        self._answered = NamedEvent(f"Local\\URLab_{directory.name}_rep_ready", create=True)
        self._wants: dict[socket.socket, set[bytes]] = {}
        self._lock = threading.Lock()
        self._selector = selectors.DefaultSelector()
        self._door = self._listen(directory / doorbell.FILE)
        self._door_shut_until = 0.0
        self._woken, self._waker = socket.socketpair()
        for end in (self._woken, self._waker):
            end.setblocking(False)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._open_door()

    @property
    def listeners(self) -> int:
        """How many clients are connected."""
        return len(self._wants)

    def wanted(self, ring: bytes) -> bool:
        """Whether a client asked to be told of these publications."""
        return any(ring in wants for wants in tuple(self._wants.values()))

    def ring(self, ring: bytes) -> None:
        """Tell the clients, without waiting for any. From any thread."""
        if ring == doorbell.REPLY:
            self._answered.set()
        with self._lock:
            for client, wants in self._wants.items():
                if ring == doorbell.REPLY or ring in wants:
                    with contextlib.suppress(OSError):  # it has rings waiting, or is gone
                        client.send(ring)

    def wake(self) -> None:
        """End `wait`. From any thread."""
        self._asked.set()
        with contextlib.suppress(OSError):
            self._waker.send(b"\0")

    def wait(self, seconds: float) -> bool:
        """Wait until a client rings, or for so long; return whether one announced a request."""
        if self._asked.exists:
            return self._asked.wait(seconds)
        if self._door_shut_until and time.monotonic() >= self._door_shut_until:
            self._open_door()
        if seconds < _SELECTOR_STEP_S:
            time.sleep(seconds)
            seconds = 0.0
        ready = self._selector.select(seconds)
        return sum(self._attend(cast("socket.socket", key.fileobj)) for key, _ in ready) > 0

    def close(self) -> None:
        """Let everybody go and remove the socket."""
        self._asked.close()
        self._answered.close()
        with self._lock:
            for client in self._wants:
                client.close()
            self._wants.clear()
        if self._door is not None:
            with contextlib.suppress(OSError):
                os.unlink(self._door.getsockname())
            self._door.close()
        self._selector.close()
        self._woken.close()
        self._waker.close()

    def _open_door(self) -> None:
        self._door_shut_until = 0.0
        if self._door is not None:
            self._selector.register(self._door, selectors.EVENT_READ)

    def _listen(self, path: Path) -> socket.socket | None:
        if not hasattr(socket, "AF_UNIX"):
            return None
        if len(os.fsencode(path)) > doorbell.MAX_PATH_BYTES:
            logger.info("no doorbell: %s is too long a path for a socket; clients poll", path)
            return None
        door = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            door.bind(os.fspath(path))
            path.chmod(0o600)
            door.listen(MAX_LISTENERS)
            door.setblocking(False)
        except OSError as error:
            door.close()
            logger.info("no doorbell: %s; clients poll", error)
            return None
        return door

    def _attend(self, source: socket.socket) -> bool:
        if source is self._door:
            self._admit(source)
            return False
        try:
            data = source.recv(4096)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if source is self._woken:
            return False
        if not data:
            self._selector.unregister(source)
            with self._lock:
                self._wants.pop(source, None)
                source.close()
            return False
        if doorbell.WANT_STATE in data:
            self._wants[source].add(doorbell.STATE)
        if doorbell.WANT_CAMERAS in data:
            self._wants[source].add(doorbell.CAMERA)
        return doorbell.REQUEST in data

    def _admit(self, door: socket.socket) -> None:
        try:
            client, _ = door.accept()
        except BlockingIOError:
            return
        except OSError as error:  # no descriptor left: asking again at once would be a busy loop
            logger.warning("a client could not be accepted at the doorbell: %s", error)
            self._selector.unregister(door)
            self._door_shut_until = time.monotonic() + DOOR_SHUT_S
            return
        if len(self._wants) >= MAX_LISTENERS:
            client.close()
            return
        client.setblocking(False)
        self._selector.register(client, selectors.EVENT_READ)
        with self._lock:
            self._wants[client] = set()
        with contextlib.suppress(OSError):
            client.send(doorbell.REPLY)  # its first request may have been answered before it was let in
