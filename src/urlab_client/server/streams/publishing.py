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
from urlab_client.server.system.threads import Health, ended
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


class StreamServer:
    """The state, info and control sockets of a server. They stay bound while it is open, and send nothing between play
    sessions.

    A slow subscriber loses the newest messages beyond ZeroMQ's limit of 1000; other subscribers are not affected.

    Attributes:
        state_port: Port of the state stream.
        ctrl_port: Port of streamed controls and gains.
        info_port: Port of the info stream.
        filter: Called with topic and payload of a message; returns the payload to send, or None to drop it. Set it
            before `start`; called on the sending thread.
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
        """Bind the sockets; `start` begins to serve.

        Raises:
            PortInUse: A port is in use.
            OSError: The address does not belong to this machine.
        """
        self.filter: Callable[[bytes, bytes], bytes | None] | None = None
        self._cameras = cameras
        self._memory = memory
        self._context = zmq.Context()
        self._context.linger = 0
        self._authenticator = ZapAuthenticator(self._context, curve_keys, health)
        self._failed = 0
        # XPUB is PUB that reports subscriptions.
        self._state = self._context.socket(zmq.XPUB)
        self._info = self._context.socket(zmq.XPUB)
        self._control = self._context.socket(zmq.SUB)
        self._control.maxmsgsize = MAX_COMMAND_BYTES
        for socket in (self._state, self._info):
            socket.maxmsgsize = MAX_FILTER_BYTES
        for socket in (self._state, self._info, self._control):
            self._authenticator.protect(socket)
            bound_peers(socket)
        try:
            self.state_port = bind_tcp(self._state, host, state_port, "state_port")
            self.ctrl_port = bind_tcp(self._control, host, ctrl_port, "ctrl_port")
            self.info_port = bind_tcp(self._info, host, info_port, "info_port")
        except BaseException:
            self._authenticator.close()
            with uninterrupted():
                self._context.destroy(linger=0)
            raise
        self._wake = self._context.socket(zmq.PAIR)
        self._wake.bind(_WAKE)
        self._waker = self._context.socket(zmq.PAIR)
        self._waker.connect(_WAKE)
        self._waking = threading.Lock()
        self._awake = False
        self._stopping = False
        self._target: Running | None = None
        self._shown: Running | None = None
        self._ticks: deque[tuple[Broadcast, Tick]] = deque(maxlen=WAITING_TICKS)
        self._commands: deque[StreamedCommand] = deque(maxlen=WAITING_COMMANDS)
        self._malformed = 0
        self._subscribed: dict[zmq.Socket[bytes], set[bytes]] = {self._state: set(), self._info: set()}
        self._listening: list[bytes] = []
        self._broadcast: Broadcast | None = None
        self._thread = health.thread("urlab-streams", self._run)

    @property
    def alive(self) -> bool:
        """Whether the thread is running."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread that serves."""
        self._thread.start()

    def show(self, running: Running | None) -> None:
        """Serve this simulation from now on, or none. Returns immediately; thread-safe."""
        self._target = running
        self._rouse()

    def stop(self) -> None:
        """Ask the thread to end, without waiting."""
        self._stopping = True
        self._rouse()

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end after `stop`.

        Returns:
            False if the thread is still busy; it then closes the sockets when it ends.
        """
        if self._thread.ident is None:
            self._close()
            return True
        return ended(self._thread, timeout)

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
            while not self._stopping:
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
                    self._skip(error)
        finally:
            self._leave()
            self._close()

    def _skip(self, error: Exception) -> None:
        """Log an error and continue without the current ticks and commands."""
        self._ticks.clear()
        self._commands.clear()
        self._note_failure(error)

    def _note_failure(self, error: Exception) -> None:
        self._failed += 1
        if self._failed & (self._failed - 1) == 0:  # ever more rarely
            logger.error("messages were not streamed (%d times so far)", self._failed, exc_info=error)

    def _turn(self, ready: dict[Any, int]) -> None:
        changed = [self._read_subscriptions(socket) for socket in self._subscribed if socket in ready]
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

    def _read_subscriptions(self, socket: zmq.Socket[bytes]) -> bool:
        """Update the subscriptions, and return whether they changed."""
        topics = self._subscribed[socket]
        before = topics.copy()
        for frames in _waiting(socket):
            kind, topic = frames[0][:1], frames[0][1:]
            if kind == b"\x01":
                topics.add(topic)
            elif kind == b"\x00":
                topics.discard(topic)
        return topics != before

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
        """Stop publishing and listening."""
        broadcast, self._broadcast = self._broadcast, None
        if broadcast is not None:
            broadcast.leave()
        for topic in self._listening:
            self._control.unsubscribe(topic)
        self._listening = []
        self._ticks.clear()
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
                    sent = frame if self.filter is None else self.filter(frame, frame)
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
        sent = payload if self.filter is None else self.filter(topic, payload)
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
            self._note_failure(error)

    def _read_commands(self) -> None:
        for frames in _waiting(self._control):
            try:
                self._commands.extend(read_commands(frames))
            except (ProtocolError, UnicodeDecodeError) as error:
                self._malformed += 1
                if self._malformed & (self._malformed - 1) == 0:  # ever more rarely
                    logger.warning("a control message is ignored (%d so far): %s", self._malformed, error)

    def _close(self) -> None:
        with self._waking:
            self._waker.close()
        self._authenticator.close()
        with uninterrupted():
            self._context.destroy(linger=0)


def _waiting(socket: zmq.Socket[bytes]) -> Iterator[list[bytes]]:
    for _ in range(BATCH):
        try:
            yield socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return
