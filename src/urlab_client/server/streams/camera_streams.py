"""Camera images of live mode: one PUB socket and port per camera.

For `SimulatedServer`. One thread draws the cameras with subscribers about thirty times a second, independently of
physics. In the stepped modes nothing is published; as in the plugin, images arrive with `step`. Shared memory gets
images in every mode.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from typing import Final, TypeAlias

import zmq

from urlab_client.enums import StepMode
from urlab_client.protocol.messages.session import CameraFrame
from urlab_client.protocol.topics import camera_filter
from urlab_client.server.dialects import ALPHA, Dialect
from urlab_client.server.physics.play import Running
from urlab_client.server.refusal import Refusal
from urlab_client.server.render.camera_renderer import Film, Shot
from urlab_client.server.streams.publishing import Publisher, read_subscriptions
from urlab_client.server.system.threads import Health
from urlab_client.server.transport.curve_authentication import CurveKeys
from urlab_client.server.transport.endpoint import PortInUse, tcp
from urlab_client.server.transport.shared_memory import SharedMemoryServer
from urlab_client.values.pictures import camera_header

logger: logging.Logger = logging.getLogger("urlab_client.server")

_Sent: TypeAlias = dict[str, int]
"""Snapshot's number of the last picture by `ARTICULATION/CAMERA`."""

PERIOD_S: Final = 1.0 / 30.0
QUEUED_FRAMES: Final = 10

PORTS: Final = 100
"""Number of ports above the first that are tried for a camera."""


class _Stream:
    """The socket of one camera: XPUB, a PUB socket that reports subscriptions."""

    def __init__(self, socket: zmq.Socket[bytes], port: int) -> None:
        self.socket = socket
        self.port = port
        self.key = ""
        self.topic = b""
        self._filters: set[bytes] = set()

    def wanted(self) -> bool:
        read_subscriptions(self.socket, self._filters)
        return bool(self.key) and any(self.topic.startswith(prefix) for prefix in self._filters)

    def show(self, key: str, topic: str) -> None:
        """Publish a camera, given as `ARTICULATION/CAMERA`, from now on; none if empty."""
        self.key = key
        self.topic = camera_filter(topic)


class CameraStreams(Publisher):
    """Publishes the cameras of the play session. The first port is bound while the server is open."""

    def __init__(
        self,
        *,
        health: Health,
        host: str,
        port: int,
        curve_keys: CurveKeys | None = None,
        memory: SharedMemoryServer | None = None,
        dialect: Dialect = ALPHA,
    ) -> None:
        """Bind the first camera's port, 0 for any; the other cameras get the free ones after it."""
        super().__init__(health.thread("urlab-cameras", self._run), health, host, curve_keys)
        self._dialect = dialect
        self._zmq_on: set[str] = set()
        self._shm_on: set[str] = set()
        # Apart, because subscribers and readers of shared memory come at different times.
        self._zmq_sent: _Sent = {}
        self._shm_sent: _Sent = {}
        self._memory = memory
        self._lock = threading.Lock()
        self._running: Running | None = None
        try:
            self._streams = [self._stream(port)]
        except BaseException:
            self._release()
            raise
        self.port: int = self._streams[0].port

    def _stream(self, port: int) -> _Stream:
        return _Stream(*self._bound(zmq.XPUB, port, "camera_port", sndhwm=QUEUED_FRAMES))

    def endpoint(self, articulation: str, camera: str) -> str:
        """Return the endpoint of a camera; the first port for a camera that does not publish."""
        key = f"{articulation}/{camera}"
        with self._lock:
            port = next((stream.port for stream in self._streams if stream.key == key), self.port)
        return f"{tcp(self._host)}:{port}"

    def show(self, running: Running | None) -> None:
        """Publish the cameras of this simulation only; None for none."""
        with self._lock:
            if self._stopping.is_set():
                return
            self._running = running
            self._zmq_sent.clear()
            self._shm_sent.clear()
            for stream in self._streams[1:]:
                stream.socket.close()
            del self._streams[1:]
            keys = [] if running is None else running.cameras.keys
            on = self._dialect.cameras_on
            self._zmq_on = set(keys) if on else set()
            self._shm_on = set(keys) if on else set()
            if self._memory is not None:
                shown = running.cameras.resolutions() if on and running is not None else {}
                self._memory.show_cameras(shown, self._header_bytes)
            first = keys[0] if keys else ""
            self._streams[0].show(first, self._topic(first))
            for key in keys[1:]:
                stream = self._next_free()
                if stream is None:
                    logger.warning("no free port for camera '%s' and those after it; they have no stream", key)
                    break
                stream.show(key, self._topic(key))
                self._streams.append(stream)

    def switch(self, key: str, *, zmq: bool, shm: bool) -> None:
        """Set whether a camera of the play session publishes on its socket and in shared memory."""
        with self._lock:
            running = self._running
            if running is None:
                return
            places = ((self._zmq_on, self._zmq_sent, zmq), (self._shm_on, self._shm_sent, shm))
            for on, sent, wanted in places:
                if wanted and key not in on:  # a state that the camera has not seen is news, even if nothing moves now
                    sent[key] = max(sent.get(key, 0), running.cameras.newest(key))
                (on.add if wanted else on.discard)(key)
            if self._memory is not None:
                size = running.cameras.resolutions()[key] if shm else None
                self._memory.switch_camera(key, size, self._header_bytes)

    def _topic(self, key: str) -> str:
        robot, _, camera = key.partition("/")
        return self._dialect.camera_topic(robot, camera)

    @property
    def _header_bytes(self) -> int:
        return len(camera_header(0, 0.0, 0, 0, 0.0)) if self._dialect.camera_headers else 0

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end and close the sockets; return False if a picture is still being drawn."""
        ended = super().join(timeout)
        with self._lock:
            self._running = None
            self._release()
            self._streams.clear()
        return ended

    def _next_free(self) -> _Stream | None:
        last = self._streams[-1].port
        for port in range(last + 1, min(self.port + PORTS, 65535) + 1):
            with contextlib.suppress(PortInUse):
                return self._stream(port)
        return None

    def _run(self) -> None:
        pause = 0.0
        while not self._stopping.wait(pause):
            began = time.monotonic()
            try:
                self._publish()
            except Exception as error:  # noqa: BLE001 - the next images may do better
                self._omit("the camera images of a moment are", error)
            pause = max(0.0, began + PERIOD_S - time.monotonic())

    def _publish(self) -> None:
        with self._lock:
            running = self._running
            streams = {stream.key: stream for stream in self._streams if stream.wanted() and stream.key in self._zmq_on}
        if running is None:
            return
        if self._dialect.cameras_on and running.engine.mode in (StepMode.DIRECT, StepMode.PUPPET):
            streams = {}
        shared = [] if self._memory is None else self._memory.wanted_cameras()
        if not (streams or shared):
            return
        shots = running.cameras.stream_shots(dict.fromkeys([*streams, *shared]))
        try:
            with running.engine.lock:
                film = running.cameras.capture(shots, running.engine.snapshots.number)
        except Refusal:  # physics is busy; retried next time
            return
        frames = running.cameras.frames(shots, film) or {}
        for shot in shots:
            frame, stream = frames.get(shot.key), streams.get(shot.key)
            if frame is not None:
                try:
                    self._publish_picture(running, film, shot, frame, stream=stream, shared=shot.key in shared)
                except Exception as error:  # noqa: BLE001 - the other cameras are none the worse
                    self._omit(f"an image of '{shot.key}' is", error)

    def _publish_picture(
        self, running: Running, film: Film, shot: Shot, frame: CameraFrame, *, stream: _Stream | None, shared: bool
    ) -> None:
        """Publish a picture where it is wanted, unless another simulation is shown by now."""
        key, memory = shot.key, self._memory
        number = film.snapshot(shot) if frame.frame_id is None else frame.frame_id
        with self._lock:
            if self._running is not running:
                return
            in_memory = shared and self._is_news(running, key, number, self._shm_sent)
            on_socket = stream is not None and self._is_news(running, key, number, self._zmq_sent)
            if not (in_memory or on_socket):
                return
            payload = self._headed(frame, film.capture_time(shot))
            if in_memory and memory is not None:
                memory.publish_picture(key, payload)
        if stream is None or not on_socket:
            return
        image = self._filtered(stream.topic, payload)  # which may take its time
        with self._lock:
            if image is not None and self._running is running:
                stream.socket.send_multipart([stream.topic, image], zmq.DONTWAIT)

    def _is_news(self, running: Running, key: str, number: int, sent: _Sent) -> bool:
        """Whether to send a picture of snapshot `number`, if the camera sends only changes."""
        latency = running.cameras.latency(key)
        repeats = self._dialect.cameras_repeat if latency is None else not latency.on_state_change
        before, sent[key] = sent.get(key), number
        return repeats or before != number

    def _headed(self, frame: CameraFrame, captured: float) -> bytes:
        if not self._dialect.camera_headers:
            return frame.data
        sim_time = frame.sim_time or 0.0
        return camera_header(frame.frame_id or 0, sim_time, frame.width, frame.height, captured) + frame.data
