"""Requests over a ZeroMQ DEALER socket, driven by the caller's asyncio loop.

The server's REP socket echoes the envelope, so each request carries an id. A reply that arrives after its request was
abandoned is recognised and dropped, and the next request works. The reader callback completes the futures of replies; a
receive is never cancelled, because that could lose a frame.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, cast

import zmq

from urlab_client.aio.background import running_loop
from urlab_client.aio.transport.base import Deadlines, LateReply, SentRequest, TransportStats, lost, no_reply
from urlab_client.aio.transport.connection import (
    FAILED_HANDSHAKES,
    UNANSWERED,
    ClientKeys,
    Connection,
    Context,
    shared_context,
)
from urlab_client.aio.transport.waiting import BusyPoll, Watch
from urlab_client.errors import AuthenticationFailed, ClientClosed, ServerUnreachable, URLabError, URLabTimeoutError
from urlab_client.events import ClientEvent, ServerAnswers, ServerConnected, ServerLost, ServerReconnected, ServerSilent
from urlab_client.protocol.base import Op
from urlab_client.protocol.codec import MAX_REPLY_BYTES
from urlab_client.protocol.messages.session import HelloOk

if TYPE_CHECKING:
    from urlab_client.aio.transport.shm import ShmRequests

log: logging.Logger = logging.getLogger("urlab_client.transport")

# Plain numbers: each operation on the enumerations costs about a microsecond, and a request takes a dozen.
_NOBLOCK = int(zmq.NOBLOCK)
_MORE = int(zmq.NOBLOCK | zmq.SNDMORE)
_EVENTS = int(zmq.EVENTS)
_RCVMORE = int(zmq.RCVMORE)
_POLLIN = int(zmq.POLLIN)

_MECHANISM_MISMATCH = 0x11000002  # ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
_NOTICEABLE_S = 1e-3
# Waking up adds at most a tenth to replies that take longer.
_SPIN_S = 150e-6
_LONGEST_SPIN_S = 500e-6

_Send = Callable[[bytes, int], None]
_Get = Callable[[int], int]

_CERTAIN = 3  # a server that is shutting down aborts one handshake; a server with another key aborts all


class _Open(NamedTuple):
    """The open socket, and what each request needs of it."""

    loop: asyncio.AbstractEventLoop
    context: Context
    connection: Connection
    replies: Watch
    send: _Send
    get: _Get


class ZmqTransport:
    """Sends requests and returns their replies. Use from one event loop, which the session checks.

    It has one DEALER socket, connects on first use and reconnects automatically.

    Attributes:
        shared: Requests over shared memory, which take what they can; None without.
        on_event: Callback invoked when the connection is opened, lost or restored.
        endpoint: The server's RPC endpoint.
        connected: Whether a server is connected.
        state_port: Port of the state stream if the transport knows it; None if it is configured separately.
        lost_at: Loop time at which the connection was last lost.
        refused: Whether a connection attempt has been refused since then.
    """

    stats: TransportStats
    state_port: int | None = None

    def __init__(self, endpoint: str, keys: ClientKeys | None = None) -> None:
        self.stats = TransportStats()
        self.endpoint: str = endpoint
        self._keys = keys
        self._rejections = 0
        self._given_up = False
        self._open: _Open | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0
        self._busy_poll = BusyPoll(_SPIN_S, _LONGEST_SPIN_S)
        self._sent: dict[bytes, SentRequest] = {}
        self._late: tuple[bytes, asyncio.Future[bytes]] | None = None  # id of the last abandoned handshake, its reply
        self._abandoned = b""  # id of the last request whose caller gave up, until a reply shows that it is done
        self._waiting: set[asyncio.Future[None]] = set()
        self._last_id = 0
        self.connected: bool = False
        self._closed = False
        self._obstacle = UNANSWERED
        self.lost_at: float = 0.0
        self.refused: bool = False
        self._silent_since: float | None = None
        self.on_event: Callable[[ClientEvent], None] | None = None
        self.shared: ShmRequests | None = None

    @property
    def owed(self) -> bool:
        """Whether the server has yet to answer a request whose caller gave up, so that it may still execute it."""
        return bool(self._abandoned)

    async def request(  # noqa: PLR0912  # each call between a step and its socket costs every step
        self, frame: bytes, op: Op, deadlines: Deadlines, *, late: LateReply | None = None
    ) -> bytes:
        """Send `frame` over ZeroMQ and return the reply's bytes.

        Args:
            frame: The encoded request.
            op: Its op, which errors name and which determines the meaning of a lost reply.
            deadlines: Loop times at which to give up.
            late: Callback invoked with a future for the reply when this call is cancelled or times out after sending
                over ZeroMQ; None drops the reply.

        Raises:
            ServerUnreachable: No connection was open in time; nothing was sent.
            URLabTimeoutError: The request was sent, but no reply arrived in time.
            ConnectionLost: The connection broke after sending; the op changes nothing.
            OutcomeUnknown: The connection broke after sending; the op may have been executed.
            ClientClosed: The client was closed.
        """
        loop, _, _, replies, send, get = self._open or self._connect()
        deadline = deadlines.reply
        while True:
            if not self.connected:
                await self._wait_connected(loop, op, deadlines.connect)
            started = loop.time()
            if deadline is not None and started >= deadline:
                raise self._too_late(op)
            self._last_id += 1
            key = self._last_id.to_bytes(8, "big")
            try:
                send(key, _MORE)
                send(b"", _MORE)
                send(frame, _NOBLOCK)
            except zmq.Again:
                # The connection was lost and its event has not been read yet, or the queue is full.
                self._read_events()
                if self.connected:
                    raise self._clogged(op) from None
                continue
            break
        reply: asyncio.Future[bytes] = loop.create_future()
        self._sent[key] = SentRequest(op, reply, started, deadline)
        self.stats.sent += 1
        sent = time.perf_counter()
        if deadline is not None and (self._timer is None or deadline < self._due):
            self._expire_at(loop, deadline)
        awake = self._busy_poll.pays(op.name)
        try:
            if awake:
                await self._busy_poll.look(op.name, reply, self._look)
            elif get(_EVENTS) & _POLLIN:
                # Sending may have consumed the edge of the descriptor.
                loop.call_soon(self._take)
            if not reply.done():
                replies.expect()
            answer = await reply
        except (asyncio.CancelledError, URLabTimeoutError):
            if self.connected and not _answered(reply):
                self._abandoned = key
            if late is not None:
                late(self._reply_to_come(key, reply))
            raise
        finally:
            del self._sent[key]
        self._busy_poll.note(op.name, time.perf_counter() - sent, awake=awake)
        return answer

    async def follow(self, hello: HelloOk) -> None:
        """Open the shared memory that a handshake describes.

        Raises:
            URLabConnectionError: It is not available.
        """
        if self.shared is not None:
            await self.shared.follow(hello)

    def fail_waiting(self, error: URLabError) -> None:
        """Fail the unsent requests that wait for a connection."""
        for waiter in self._waiting:
            if not waiter.done():
                waiter.set_exception(error)

    async def aclose(self) -> None:
        """Fail all pending requests and release all resources. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self.connected = False
        closed = self._was_closed()
        if self.shared is not None:
            self.shared.close(closed)
        self._fail_sent(lambda _: closed)
        self.fail_waiting(closed)
        if self._timer is not None:
            self._timer.cancel()
        self._disconnect()

    def _disconnect(self) -> None:
        opened, self._open = self._open, None
        if opened is not None:
            opened.connection.close()
            shared_context.give_back(opened.context)

    def _was_closed(self) -> ClientClosed:
        return ClientClosed(f"The client of {self.endpoint} was closed.", hint="Create a new client.")

    def _connect(self) -> _Open:
        if self._closed:
            raise self._was_closed()
        loop = running_loop()
        context = shared_context.borrow()
        socket = context.socket(zmq.DEALER)
        socket.maxmsgsize = MAX_REPLY_BYTES  # rejected by its header, before it uses memory
        try:
            connection = Connection(loop, socket, self.endpoint, self._keys, self._note, tell=self._tell)
        except ValueError:
            shared_context.give_back(context)
            raise
        replies = connection.watch(self._take, expected=self._reply_expected)
        send = cast("_Send", super(zmq.Socket, socket).send)  # without the overhead of the wrapper
        self._open = _Open(loop, context, connection, replies, send, cast("_Get", socket.get))
        return self._open

    def _reply_to_come(self, key: bytes, reply: asyncio.Future[bytes]) -> asyncio.Future[bytes]:
        """Return a future for the reply to a request that its caller has abandoned."""
        if _answered(reply):
            return reply  # it arrived in the loop iteration that cancelled the caller
        coming: asyncio.Future[bytes] = reply.get_loop().create_future()
        if self.connected:
            self._forget_late()
            self._late = key, coming
        else:
            coming.cancel()
        return coming

    async def _wait_connected(self, loop: asyncio.AbstractEventLoop, op: Op, connect_by: float | None) -> None:
        waiter: asyncio.Future[None] = loop.create_future()
        started = loop.time()
        self._waiting.add(waiter)
        if self._given_up and self._open is not None:
            # ZeroMQ does not retry after this rejection, but the server may have learnt the key by now.
            self._given_up = False
            self._open.connection.reconnect()

        def give_up() -> None:
            self._read_events()  # as in `_expire`
            if not waiter.done():
                waited = loop.time() - started
                within = f" within {_ms(waited)}" if waited > _NOTICEABLE_S else ""
                waiter.set_exception(
                    ServerUnreachable(
                        f"{op.name}: no connection to {self.endpoint}{within}: {self._obstacle}. Nothing was sent.",
                        op=op.name,
                        hint="Is the editor (with URLab's bridge) or `urlab serve` running there, on this port?",
                    )
                )

        timer = None if connect_by is None else loop.call_at(connect_by, give_up)
        try:
            await waiter
        finally:
            if timer is not None:
                timer.cancel()
            self._waiting.discard(waiter)

    def _expire_at(self, loop: asyncio.AbstractEventLoop, deadline: float) -> None:
        """Schedule the expiry of requests. One timer serves all, because most replies arrive long before."""
        if self._timer is not None:
            if self._due <= deadline:
                return
            self._timer.cancel()
        self._due = deadline
        self._timer = loop.call_at(deadline, self._expire, loop)

    def _expire(self, loop: asyncio.AbstractEventLoop) -> None:
        self._take()  # accept replies that arrived while the loop was busy; uvloop runs its timers first
        due = self._due  # not the current time: the loop may be early by its resolution
        self._timer = None
        for entry in self._sent.values():
            if entry.deadline is not None and not entry.reply.done():
                if entry.deadline <= due:
                    self._give_up(entry, due - entry.at)
                else:
                    self._expire_at(loop, entry.deadline)

    def _give_up(self, entry: SentRequest, seconds: float) -> None:
        entry.reply.set_exception(no_reply(entry.op, f"from {self.endpoint}", seconds))
        if self._silent_since is None:
            self._silent_since = entry.at
            self._tell(ServerSilent(endpoint=self.endpoint, op=entry.op.name, waited_s=seconds))

    def _look(self) -> None:
        """Poll the socket for a reply."""
        if self._open is not None and self._open.get(_EVENTS) & _POLLIN:
            self._take()

    def _reply_expected(self) -> bool:
        """Return whether a reply may come, possibly to an abandoned request."""
        unanswered = self._abandoned or self._silent_since is not None
        return bool(unanswered) or not all(sent.reply.done() for sent in self._sent.values())

    def _take(self) -> None:
        """Receive replies until no request waits for one."""
        opened = self._open
        if opened is None:  # it has been closed
            return
        receive = opened.connection.socket.recv
        while True:
            try:
                key = receive(_NOBLOCK)
                delimiter = receive(_NOBLOCK)
                last = receive(_NOBLOCK, copy=False)  # the frame itself shows whether it is the last
            except zmq.Again:
                return
            if delimiter or last.more:
                while opened.get(_RCVMORE):
                    receive(_NOBLOCK)
                self._drop_stray()
                continue
            if (silent := self._silent_since) is not None:
                self._silent_since = None
                self._tell(ServerAnswers(endpoint=self.endpoint, silent_s=opened.loop.time() - silent))
            if self._abandoned and key >= self._abandoned:
                self._abandoned = b""  # the server answers the requests of a connection in their order
            if self._late is not None and key > self._late[0]:
                self._forget_late()
            entry = self._sent.get(key)
            if entry is None or entry.reply.done():
                self._deliver_late(key, last.bytes)
                continue
            self.stats.received += 1
            entry.reply.set_result(last.bytes)
            if len(self._sent) == 1 and not self._late:
                # Only replies that no request waits for may remain. The socket is polled before the next wait, because
                # its descriptor does not signal messages that arrived earlier.
                return

    def _deliver_late(self, key: bytes, answer: bytes) -> None:
        if self._late is not None and self._late[0] == key:
            self.stats.late += 1
            self._late[1].set_result(answer)
            self._late = None
        else:
            self._drop_stray()

    def _forget_late(self) -> None:
        if self._late is not None:
            self._late[1].cancel()
            self._late = None

    def _drop_stray(self) -> None:
        self.stats.late += 1
        log.debug("%s: dropped a reply that no request waits for", self.endpoint)

    def _read_events(self) -> None:
        if self._open is not None:
            self._open.connection.read_events()

    def _note(self, event: zmq.Event, value: int, obstacle: str | None) -> None:
        if event is zmq.Event.HANDSHAKE_SUCCEEDED:
            self.connected = True
            self._rejections = 0
            self.stats.connects += 1
            log.info("connected to %s", self.endpoint)
            self._tell_connected()
            for waiter in self._waiting:
                if not waiter.done():
                    waiter.set_result(None)
        elif event is zmq.Event.DISCONNECTED:
            self._lose()
        elif obstacle is not None:
            self._obstacle = obstacle
            if event is not zmq.Event.CONNECTED and obstacle != UNANSWERED:
                self.refused = True
            if event in FAILED_HANDSHAKES and value != errno.EAGAIN:  # means a timeout
                self._rejections += 1
                self._note_rejection(event, value)

    def _note_rejection(self, event: zmq.Event, value: int) -> None:
        """Fail the waiting requests once it is certain that retrying would not help."""
        if event is zmq.Event.HANDSHAKE_FAILED_AUTH:
            why, hint = "the server does not know this client's key", "Give it the public key (--allow-client)."
        elif value == _MECHANISM_MISMATCH and self._keys is None:
            why, hint = "the server requires CURVE keys", "Pass server_key=…, and client_key=… if it knows its clients."
        elif value == _MECHANISM_MISMATCH:
            why, hint = "the server does not use CURVE keys", "Omit server_key, or start the server with --server-key."
        elif self._keys is not None and self._rejections >= _CERTAIN:
            # A server without keys may close the connection before it can be distinguished from one with another key.
            why = "the server does not have the expected key, or does not use CURVE keys"
            hint = "Compare with: urlab keys show FILE."
        else:
            return
        self._given_up = event is not zmq.Event.HANDSHAKE_FAILED_NO_DETAIL
        text = f"No session with {self.endpoint}: {why}. Nothing was sent."
        self.fail_waiting(AuthenticationFailed(text, hint=hint))

    def _lose(self) -> None:
        self._take()  # replies that arrived before the loss still count
        if self.connected:
            log.info("lost %s; reconnecting", self.endpoint)
            self.lost_at = self._now()
            self.refused = False
            self._obstacle = "the connection was lost and not restored"
            if self.shared is not None:
                self.shared.on_server_lost()
            self._tell(ServerLost(endpoint=self.endpoint))
        else:
            self.refused = True  # a tunnel accepts connections even if the server is down
        if self._open is not None:
            # Also after an aborted handshake: ZeroMQ does not retry after invalid data in it.
            self._open.connection.revive(was_connected=self.connected)
        self.connected = False
        self._silent_since = None
        self._fail_sent(lambda entry: lost(entry.op, f"the connection to {self.endpoint}"))

    def _now(self) -> float:
        return 0.0 if self._open is None else self._open.loop.time()

    def _tell_connected(self) -> None:
        if self.stats.connects == 1:
            self._tell(ServerConnected(endpoint=self.endpoint))
        else:
            down_s = self._now() - self.lost_at
            self._tell(ServerReconnected(endpoint=self.endpoint, down_s=down_s, refused=self.refused))

    def _tell(self, event: ClientEvent) -> None:
        if self.on_event is not None:
            try:
                self.on_event(event)
            except Exception:  # what waits for this connection must hear of its loss all the same
                log.exception("%r could not be handled", event)

    def _clogged(self, op: Op) -> ServerUnreachable:
        return ServerUnreachable(
            f"{op.name}: {self.endpoint} has not read the previous requests. Nothing was sent.",
            op=op.name,
            hint="The connection is up, but the server does not read from it: restart it.",
        )

    def _too_late(self, op: Op) -> URLabTimeoutError:
        return URLabTimeoutError(
            f"{op.name}: the deadline passed before the request could be sent to {self.endpoint}. Nothing was sent.",
            op=op.name,
            hint="Other work kept the event loop busy, or the timeout is too short.",
        )

    def _fail_sent(self, error: Callable[[SentRequest], URLabError]) -> None:
        self._forget_late()
        self._abandoned = b""
        for entry in self._sent.values():
            if not entry.reply.done():
                entry.reply.set_exception(error(entry))


def _answered(reply: asyncio.Future[bytes]) -> bool:
    return reply.done() and not reply.cancelled() and reply.exception() is None


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.0f} ms"
