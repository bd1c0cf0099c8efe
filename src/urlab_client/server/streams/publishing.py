"""The state, info and control sockets of a server, and their thread.

For `SimulatedServer`, which opens them. The physics thread only copies arrays, and only those with subscribers;
matching, encoding and sending happen here, behind a bounded queue that drops the oldest ticks. Camera images have
their own sockets.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Final

import zmq

from urlab_client._platform.signals import uninterrupted
from urlab_client.errors import ProtocolError
from urlab_client.protocol.topics import STATE_FULL
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.physics.play import Running
from urlab_client.server.streams.broadcast import Broadcast, Tick
from urlab_client.server.streams.commands import CameraEndpoint, StreamedCommand, read_commands
from urlab_client.server.system.threads import Health, ServedThread
from urlab_client.server.transport.curve_authentication import CurveKeys, ZapAuthenticator
from urlab_client.server.transport.endpoint import bind_tcp, bound_peers
from urlab_client.server.transport.shared_memory import SharedMemoryServer

logger: logging.Logger = logging.getLogger("urlab_client.server")

WAITING_TICKS: Final = 64
"""Length of the queue of ticks to send; beyond that the oldest are dropped."""

WAITING_COMMANDS: Final = 1024
"""Length of the queue of control messages that wait for the physics lock; beyond that the oldest are dropped."""

BATCH: Final = 256
"""Messages read from a socket before the other sockets are served."""

MAX_COMMAND_BYTES: Final = 1 << 20
"""Largest control message; a larger one closes the connection."""

MAX_FILTER_BYTES: Final = 4096
"""Largest subscription; a larger one closes the connection."""

_WAKE: Final = "inproc://urlab-streams-wake"


class Publisher(ServedThread):
    """Sockets on which a thread publishes.

    Attributes:
        filter: Called with topic and payload of a message; returns the payload to send, or None to drop it. Set it
            before `start`; called on the sending thread.
    """

    def __init__(self, thread: threading.Thread, health: Health, host: str, curve_keys: CurveKeys | None) -> None:
        super().__init__(thread)
        self.filter: Callable[[bytes, bytes], bytes | None] | None = None
        self._host = host
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._context.linger = 0
        self._authenticator = ZapAuthenticator(self._context, curve_keys, health)
        self._failed = 0

    def _bound(
        self, kind: int, port: int, option: str, *, most: int = MAX_FILTER_BYTES, **options: int
    ) -> tuple[zmq.Socket[bytes], int]:
        """Return a new socket and its port; a peer that sends more than `most` bytes is disconnected.

        Raises:
            PortInUse: The port is in use.
            OSError: The address does not belong to this machine.
        """
        socket = self._context.socket(kind)
        socket.maxmsgsize = most
        for name, value in options.items():
            setattr(socket, name, value)
        self._authenticator.protect(socket)
        bound_peers(socket)
        try:
            return socket, bind_tcp(socket, self._host, port, option)
        except BaseException:
            socket.close()
            raise

    def _filtered(self, topic: bytes, payload: bytes) -> bytes | None:
        return payload if self.filter is None else self.filter(topic, payload)

    def _omit(self, what: str, error: Exception) -> None:
        """Log why something is not published, unless the sockets were closed because the server is closing."""
        self._failed += 1
        if not self._stopping.is_set() and self._failed & (self._failed - 1) == 0:  # ever more rarely
            logger.error("%s not published (%d so far)", what, self._failed, exc_info=error)

    def _release(self) -> None:
        self._authenticator.close()
        with uninterrupted():
            self._context.destroy(linger=0)


def read_subscriptions(socket: zmq.Socket[bytes], topics: set[bytes]) -> bool:
    """Update the subscriptions to an XPUB socket, and return whether they changed."""
    before = topics.copy()
    for frames in _waiting(socket):
        kind, topic = frames[0][:1], frames[0][1:]
        if kind == b"\x01":
            topics.add(topic)
        elif kind == b"\x00":
            topics.discard(topic)
    return topics != before


class StreamServer(Publisher):
    """The state, info and control sockets of a server. They stay bound while it is open, and send nothing between play
    sessions.

    A slow subscriber loses the newest messages beyond ZeroMQ's limit of 1000; other subscribers are not affected.

    Attributes:
        state_port: Port of the state stream.
        ctrl_port: Port of streamed controls and gains.
        info_port: Port of the info stream.
    """

    state_port: int
    ctrl_port: int
    info_port: int

    def __init__(
        self,
        cameras: Callable[[CompiledScene], Iterable[CameraEndpoint]],
        *,
        health: Health,
        host: str = "127.0.0.1",
        state_port: int = 0,
        ctrl_port: int = 0,
        info_port: int = 0,
        curve_keys: CurveKeys | None = None,
        memory: SharedMemoryServer | None = None,
    ) -> None:
        super().__init__(health.thread("urlab-streams", self._run), health, host, curve_keys)
        self._cameras = cameras
        self._memory = memory
        self._wake = self._context.socket(zmq.PAIR)
        self._wake.bind(_WAKE)
        self._waker = self._context.socket(zmq.PAIR)
        self._waker.connect(_WAKE)
        self._waking = threading.Lock()
        self._awake = False
        try:
            # XPUB is PUB that reports subscriptions.
            self._state, self.state_port = self._bound(zmq.XPUB, state_port, "state_port")
            self._control, self.ctrl_port = self._bound(zmq.SUB, ctrl_port, "ctrl_port", most=MAX_COMMAND_BYTES)
            self._info, self.info_port = self._bound(zmq.XPUB, info_port, "info_port")
        except BaseException:
            self._release()
            raise
        self._target: Running | None = None
        self._shown: Running | None = None
        self._ticks: deque[tuple[Broadcast, Tick]] = deque(maxlen=WAITING_TICKS)
        self._commands: deque[StreamedCommand] = deque(maxlen=WAITING_COMMANDS)
        self._malformed = 0
        self._subscribed: dict[zmq.Socket[bytes], set[bytes]] = {self._state: set(), self._info: set()}
        self._listening: list[bytes] = []
        self._broadcast: Broadcast | None = None

    def show(self, running: Running | None) -> None:
        """Serve this simulation from now on, or none. Returns immediately; thread-safe."""
        self._target = running
        self._rouse()

    def stop(self) -> None:
        super().stop()
        self._rouse()

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end; if it is still busy, it closes the sockets when it ends."""
        if not self.started:
            self._release()
        return super().join(timeout)

    def _hand_over(self, broadcast: Broadcast, tick: Tick) -> None:
        self._ticks.append((broadcast, tick))
        self._rouse()

    def _rouse(self) -> None:
        if self._awake:
            return
        with self._waking:
            if not self._awake and not self._waker.closed:
                self._awake = True
                self._waker.send(b"", zmq.NOBLOCK)

    # The thread.

    def _run(self) -> None:
        poller = zmq.Poller()
        for socket in (self._wake, self._state, self._info, self._control):
            poller.register(socket, zmq.POLLIN)
        try:
            while not self._stopping.is_set():
                # Retry commands for which physics was too busy.
                ready = dict(poller.poll(0 if self._commands else None))
                if self._wake in ready:
                    self._wake.recv()
                    self._awake = False  # before checking, so that later events wake it again
                try:
                    self._turn(ready)
                except zmq.ZMQError:
                    raise
                except Exception as error:
                    if self._broadcast is None and self._shown is not None:
                        raise  # the play session cannot be streamed, and subscribers would wait in vain
                    self._ticks.clear()
                    self._commands.clear()
                    self._omit("the messages of a moment are", error)
        finally:
            self._leave()
            self._release()

    def _turn(self, ready: dict[Any, int]) -> None:
        changed = [read_subscriptions(socket, topics) for socket, topics in self._subscribed.items() if socket in ready]
        self._publish()
        if self._shown is not self._target:
            self._switch()
        elif any(changed) and self._broadcast is not None:
            self._broadcast.want(self._subscribed[self._state], self._subscribed[self._info])
        if self._control in ready:
            self._read_commands()
        if self._commands:
            if self._broadcast is None:
                self._commands.clear()
            else:
                self._broadcast.obey(self._commands)

    def _switch(self) -> None:
        target = self._shown = self._target
        self._leave()
        if target is None:
            return
        broadcast = self._broadcast = Broadcast(target, self._hand_over, self._memory)
        self._listening = list(broadcast.command_topics())
        for topic in self._listening:
            self._control.subscribe(topic)
        broadcast.want(self._subscribed[self._state], self._subscribed[self._info])

    def _leave(self) -> None:
        broadcast, self._broadcast = self._broadcast, None
        if broadcast is not None:
            broadcast.leave()
        for topic in self._listening:
            self._control.unsubscribe(topic)
        self._listening = []
        if self._memory is not None:
            self._memory.end_state()

    def _publish(self) -> None:
        for _ in range(len(self._ticks)):
            broadcast, tick = self._ticks.popleft()
            if broadcast is not self._broadcast:
                continue
            for topic, encode in broadcast.state_messages(tick):
                with self._skipping():
                    self._send_state(topic, encode(), full_wanted=broadcast.full_wanted)
            for encode in broadcast.info_messages(tick, self._cameras):
                with self._skipping():
                    frame = encode()
                    sent = self._filtered(frame, frame)
                    if sent is not None:
                        self._info.send(sent, zmq.NOBLOCK)

    def _send_state(self, topic: bytes, payload: bytes | None, *, full_wanted: bool) -> None:
        if payload is None:
            return
        if topic == STATE_FULL:
            if self._memory is not None:
                self._memory.publish_state(payload)
            if not full_wanted:
                return
        sent = self._filtered(topic, payload)
        if sent is not None:
            self._state.send(topic, zmq.SNDMORE | zmq.NOBLOCK)
            self._state.send(sent, zmq.NOBLOCK)

    @contextmanager
    def _skipping(self) -> Generator[None]:
        """Omit the message that the block sends if that fails."""
        try:
            yield
        except zmq.ZMQError:
            raise
        except Exception as error:  # noqa: BLE001 - the next ones are none the worse
            self._omit("a message is", error)

    def _read_commands(self) -> None:
        for frames in _waiting(self._control):
            try:
                self._commands.extend(read_commands(frames))
            except (ProtocolError, UnicodeDecodeError) as error:
                self._malformed += 1
                if self._malformed & (self._malformed - 1) == 0:  # ever more rarely
                    logger.warning("a control message is ignored (%d so far): %s", self._malformed, error)

    def _release(self) -> None:
        with self._waking:
            self._waker.close()
        super()._release()


def _waiting(socket: zmq.Socket[bytes]) -> Iterator[list[bytes]]:
    for _ in range(BATCH):
        try:
            yield socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return
