"""One RPC session: grants turns, stamps requests, sets their deadlines and decodes the replies."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine, Generator
from contextlib import asynccontextmanager, contextmanager
from contextvars import ContextVar
from typing import Any, Final, TypeVar

from urlab_client.aio.background import Tell, running_loop
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.features import Features
from urlab_client.aio.session.call_records import CallRecords, Observe
from urlab_client.aio.session.control import Control
from urlab_client.aio.session.jobs import OnProgress, finish
from urlab_client.aio.session.turn import Mutex, Settle, Turn, require_reply
from urlab_client.aio.transport.base import Deadlines
from urlab_client.aio.transport.zmq import ZmqTransport
from urlab_client.errors import (
    ConnectionLost,
    GameThreadTimeout,
    InternalError,
    NoSession,
    ReadOnlyClient,
    ServerRestarted,
    ServerUnreachable,
    SessionTakenOver,
    ShuttingDown,
    StepTimeout,
    UnknownOp,
    URLabError,
    URLabRPCError,
    URLabTimeoutError,
)
from urlab_client.protocol.base import ControlRequest, Effect, Needs, Op, Reply, Request
from urlab_client.protocol.codec import check_finite, check_request, decode_answer, decode_reply, encode_request, op_of
from urlab_client.protocol.messages.jobs import OpStarted, OpStatus
from urlab_client.protocol.messages.session import Hello, HelloOk, Meta, StateReply

log: logging.Logger = logging.getLogger("urlab_client.session")

R = TypeVar("R", bound=Reply)
_Ask = Callable[[bytes, Op, Deadlines], Awaitable[bytes]]
_HELLO = op_of(Hello)
_COMPOSING: ContextVar[Session | None] = ContextVar("_COMPOSING", default=None)
"""Session whose scene the running task changes by several ops."""
# These refusals leave open whether the op was executed. All others mean that it was not.
_UNDECIDED = (StepTimeout, GameThreadTimeout, ShuttingDown, InternalError)

STOP: Final = "end of play"
"""The end of play among what may be `unsettled`."""

_UNLISTED = frozenset({"hello", "meta"})  # every server offers them and none lists them


class Session:
    """A session with one server.

    The server handles one request at a time anyway, and a second request must not be queued behind a first one that may
    fail. Requests therefore wait here for the request lock, where waiting is visible and cancellable. Requests that
    depend on the client's state or change it also wait for a `turn`.

    Attributes:
        transport: What sends its requests.
        session_id: Id of the open session; empty without one.
        default_timeout: Seconds until the deadline of a request, by default; None for no limit.
        hello_sent: Whether a handshake was sent, with any outcome.
        features: Features of the server, as far as its replies have shown them.
        control: The robots that this client owns.
        read_only: Whether requests that need a session are refused.
        on_opened: Callback invoked with the handshake of each new session, even if its caller had given up.
        on_refusal: Callback invoked with each refusal before it is raised.
        confirmed: Whether the server has answered within this session since the connection was established. After a
            lost connection another server may listen, which only a refused or accepted session id shows.
        was_down: Whether no server listened at the address for a while since the last answer within this session.
        restarts: Number of sessions that ended because the server restarted.
        tell: Publishes an event of the client.
        unkept: Why the session is no longer kept open although `keep_session` is set; otherwise None.
        unsettled: How to settle what the client mirrors and an abandoned request may have changed, by its name.
        unsettled_on: Number of connections opened when the latest of these requests was abandoned.
        request_lock: Held while a request is in progress, from its encoding to its reply.
        state_lock: Held by the current `Turn`.
        editor_lock: Held while the editor runs a job.
        scene_lock: Held by the task that changes the scene, for one op or for several that belong together.
    """

    def __init__(
        self,
        transport: ZmqTransport,
        *,
        default_timeout: float | None,
        json: bool = False,
        observe: Observe | None = None,
        claim_control: bool = True,
        read_only: bool = False,
    ) -> None:
        self.session_id: str = ""
        self.hello_sent: bool = False
        self.read_only = read_only
        self.features: Features = Features()
        self.on_opened: Callable[[HelloOk], None] | None = None
        self.on_refusal: Callable[[URLabRPCError], None] | None = None
        self.confirmed: bool = False
        self.was_down: bool = False
        self.restarts: int = 0
        self.tell: Tell = lambda _: None
        self.unkept: URLabError | None = None
        self.unsettled: dict[str, Settle] = {}
        self.unsettled_on: int = 0
        self._lost_to_restart = ""
        self.transport = transport
        self._call_records = None if observe is None else CallRecords(observe, transport)
        self._way = self._call_records or transport.shared or transport
        self.default_timeout = default_timeout
        self._json = json
        self.control: Control = Control(self, wanted=claim_control)
        self.request_lock: Mutex = Mutex()
        self.state_lock: Mutex = Mutex()
        self.editor_lock: Mutex = Mutex()
        self.scene_lock: Mutex = Mutex()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._queued = 0
        self._probe_task: asyncio.Task[Reply] | None = None
        # A handshake whose caller gave up after it was sent still opens a session.
        self._abandoned_hello: asyncio.Future[bytes] | None = None
        self._hello_unanswered = False

    async def call(
        self, request: Request[R], *, timeout: Timeout = DEFAULT, on_progress: OnProgress | None = None
    ) -> R:
        """Send a request that does not depend on the client's state; return its reply, or the result of its job.

        Raises:
            URLabRPCError: The server refused the request.
            URLabConnectionError: The server cannot be reached, or the connection broke.
            URLabTimeoutError: No reply arrived in time.
            NoSession: No session is open; nothing was sent.
            TypeError, ValueError: The request is malformed; nothing was sent.
        """
        op = op_of(request)
        if on_progress is not None and not callable(on_progress):
            raise TypeError(f"{op.name}: on_progress takes a function, got {on_progress!r:.80}.")
        self.check_offered(op)
        deadlines = self.deadlines(op, timeout, self.bound_loop().time())
        if op.needs is not Needs.EDITOR and op.ns != "scene":
            return await self._exchange_alone(request, op, deadlines)
        if op.effect is Effect.READ or op.ns != "scene" or _COMPOSING.get() is self:
            return await self._edit(request, op, deadlines, on_progress)
        await self.acquire(self.scene_lock, op, deadlines.reply)
        try:
            return await self._edit(request, op, deadlines, on_progress)
        finally:
            self.scene_lock.release()

    @asynccontextmanager
    async def composing(self, request: type[Request[Any]], timeout: Timeout) -> AsyncGenerator[None]:
        """Keep other tasks from changing the scene while this one does so by several ops, of which `request` is first.

        Raises:
            URLabTimeoutError: Other tasks held the scene until the deadline of that op; nothing was sent.
        """
        op = op_of(request)
        await self.acquire(self.scene_lock, op, self.deadlines(op, timeout, self.bound_loop().time()).reply)
        outer = _COMPOSING.set(self)
        try:
            yield
        finally:
            _COMPOSING.reset(outer)
            self.scene_lock.release()

    async def _edit(self, request: Request[R], op: Op, deadlines: Deadlines, on_progress: OnProgress | None) -> R:
        if op.needs is not Needs.EDITOR:
            return await self._exchange_alone(request, op, deadlines)
        # One job at a time: the next editor op would wait for it anyway, and block the server in the meantime.
        await self.acquire(self.editor_lock, op, deadlines.reply)
        try:
            await self.acquire(self.request_lock, op, deadlines.reply)
            try:
                answer = await self.exchange(request, op, deadlines)
            finally:
                self.request_lock.release()
            if not isinstance(answer, OpStarted):
                return answer
            status = op_of(OpStatus)
            return await finish(
                op,
                op.reply,
                answer,
                lambda question: self._exchange_alone(question, status, deadlines),
                deadline=deadlines.reply,
                on_progress=on_progress,
            )
        finally:
            self.editor_lock.release()

    async def _exchange_alone(self, request: Request[R], op: Op, deadlines: Deadlines) -> R:
        await self.acquire(self.request_lock, op, deadlines.reply)
        try:
            return require_reply(op, await self.exchange(request, op, deadlines))
        finally:
            self.request_lock.release()

    def turn(self, request: type[Request[Any]], *, timeout: Timeout = DEFAULT, each: bool = False) -> Turn:
        """Return a turn for requests that depend on the client's state or change it.

        The deadline of the first request also covers the wait for the turn. A given timeout covers all requests
        together, or `each` of them; the default timeout always applies to each.
        """
        op = op_of(request)
        self.check_offered(op)
        return Turn(self, op, timeout, each=each)

    async def probe(self, request: Request[R], *, timeout: float) -> R | None:
        """Send a background request if no other is in progress, and cancel it when another request comes.

        Returns:
            The reply, or None if the request was cancelled or not sent.
        """
        if self.request_lock.locked() or self._queued or self._probe_task is not None:
            return None  # two at a time could not both be cancelled for the next call
        task = asyncio.create_task(self.call(request, timeout=timeout), name="urlab-probe")
        self._probe_task = task
        try:
            await asyncio.wait((task,))
            return None if task.cancelled() else task.result()
        finally:
            task.cancel()
            self._probe_task = None

    @contextmanager
    def settling(self, what: str, settle: Settle) -> Generator[None]:
        """Keep `settle` for `resync()` if the body leaves open whether the server executed its request."""
        before = self.transport.stats.sent
        try:
            yield
        except BaseException as error:  # a cancellation, too: the request may be under way
            if not leaves_open(error):
                self.unsettled.pop(what, None)
            elif self.transport.stats.sent > before:
                self.unsettled[what] = settle
                self.unsettled_on = self.transport.stats.connects
            raise
        self.unsettled.pop(what, None)

    async def hello(self, turn: Turn, request: Hello) -> HelloOk:
        """Open a session; the previous one becomes invalid, here and for any other client."""
        if self._json:
            request.encoding = "json"
        reply = await turn.call(request)
        # A packaged build lacks the editor's ops, and an older server lacks newer ops.
        try:
            listed = [op.name for op in (await turn.call(Meta())).ops]
        except UnknownOp:
            listed = None
        self.features = self.features.with_ops(listed).with_hello(reply)
        return reply

    async def aclose(self) -> None:
        """Close the transport; waiting calls fail with `ClientClosed`."""
        await self.transport.aclose()

    def bound_loop(self) -> asyncio.AbstractEventLoop:
        """Return the running loop, to which this session is bound. Raises `URLabError` on any other."""
        bound = self._loop
        if bound is None or asyncio._get_running_loop() is not bound:  # noqa: SLF001  # as in `running_loop`
            bound = self._loop = running_loop(bound)
        return bound

    def check_offered(self, op: Op) -> None:
        """Check that the server offers an op and that this client may send it.

        Raises:
            UnknownOp: The server does not list the op; nothing was sent.
            ReadOnlyClient: The client is read-only; nothing was sent.
        """
        if self.read_only and op.name != "meta":
            raise ReadOnlyClient(
                f"{op.name}: this client is read-only. Nothing was sent.",
                op=op.name,
                hint="It has no session. Use the client that drives the server, or create one without read_only=True.",
            )
        listed = self.features.ops
        if listed is not None and op.name not in listed and op.name not in _UNLISTED:
            raise UnknownOp("unknown_op", "this server does not offer this op. Nothing was sent.", op=op.name)

    def deadlines(self, op: Op, timeout: Timeout, since: float, takes: float | None = None) -> Deadlines:
        default = self.default_timeout
        if timeout is not DEFAULT:
            deadline = None if timeout is None else since + timeout
            return Deadlines(deadline, deadline)
        if default is None:
            return Deadlines(None, None)
        # The reply to a slow op may take long, but a missing server shows much sooner.
        seconds = (op.timeout if takes is None else takes) or 0.0
        connect_by = since + default
        return Deadlines(since + seconds if seconds > default else connect_by, connect_by)

    def exchange(self, request: Request[R], op: Op, deadlines: Deadlines) -> Coroutine[Any, Any, R | OpStarted]:
        """Send a request and return its answer. The caller must hold the request lock."""
        if self.features.claims and isinstance(request, ControlRequest):
            return self.control.send(request, deadlines)
        if self._call_records is not None:
            return self._call_records.record(op, self._answer(request, op, deadlines))
        return self._answer(request, op, deadlines)

    async def exchange_once(self, request: Request[R], deadlines: Deadlines) -> R:
        """Send a request as it is, without the claims that it may need. The caller must hold the request lock."""
        op = op_of(request)
        answer = self._answer(request, op, deadlines)
        records = self._call_records
        return require_reply(op, await (answer if records is None else records.record(op, answer)))

    async def _answer(self, request: Request[R], op: Op, deadlines: Deadlines, *, again: bool = False) -> R | OpStarted:
        # A single coroutine, because each further one between a step and its socket slows down every step.
        stamped = self.session_id  # a handshake may change it before the answer comes
        frame = encode_request(request, stamped, json=self._json)
        if not op.hot:  # the caller of a hot op has checked it more cheaply
            check_finite(request)
            if not self._json:
                check_request(request, frame)
        began = time.perf_counter()
        try:
            ask = self._greet if op is _HELLO else self._way.request
            try:
                answer = await ask(frame, op, deadlines)
            except ConnectionLost as lost:
                answer = await _ask_again(ask, frame, op, deadlines, lost)
            if log.isEnabledFor(logging.DEBUG):
                took = 1e3 * (time.perf_counter() - began)
                log.debug("%s: %d bytes out, %d back in %.3f ms", op.name, len(frame), len(answer), took)
            return self._read(op.reply, op, stamped, answer)
        except SessionTakenOver as refusal:
            # An abandoned handshake of this client still opens a session. A request refused because of it was not
            # executed, and is sent again in that session.
            if not again and await self._settled(deadlines.reply) and self.session_id != stamped:
                return await self._answer(request, op, deadlines, again=True)
            if not stamped:
                raise NoSession("no session is open.", op=op.name) from None
            if self.on_refusal is not None:
                self.on_refusal(refusal)
            if self.was_down:
                raise self._after_restart(stamped, op, refusal.message) from self.unkept
            if self._hello_unanswered:
                raise _maybe_own_handshake(refusal) from None
            raise

    def _after_restart(self, stamped: str, op: Op, said: str) -> ServerRestarted:
        if stamped != self._lost_to_restart:  # several requests may be refused for one restart
            self._lost_to_restart = stamped
            self.restarts += 1
        return server_restarted(op.name, self.transport.endpoint, said)

    def _read(self, kind: type[R], op: Op, stamped: str, answer: bytes) -> R | OpStarted:
        """Decode the answer to a request that was sent in the session `stamped`, and update the session from it."""
        try:
            reply = decode_answer(op, kind, answer)
        except URLabRPCError as refusal:
            # A refusal of a request sent before the latest hello says nothing about the current session.
            taken_over = isinstance(refusal, SessionTakenOver)
            if self.on_refusal is not None and stamped == self.session_id and not taken_over:
                self.on_refusal(refusal)
            raise
        if isinstance(reply, StateReply):
            if (reply.arts is not None) is not self.features.arts:
                self.features = self.features.with_reply(reply)
        elif isinstance(reply, HelloOk):
            self._open(reply)
        if not self.confirmed:
            self.confirmed = op.needs is not Needs.NOTHING and stamped == self.session_id
            self.was_down = self.was_down and not self.confirmed
        return reply

    def _open(self, hello: HelloOk) -> None:
        self.session_id = hello.session_id
        self.confirmed = True
        if self.was_down:
            self.unsettled.clear()  # the server has been restarted
        self.was_down = False
        self._abandoned_hello = None
        self._hello_unanswered = False
        if self.on_opened is not None:
            self.on_opened(hello)

    def _adopt_later(self, reply: asyncio.Future[bytes]) -> None:
        """Adopt the session that an abandoned handshake opens, when its reply arrives."""
        self._abandoned_hello = reply
        reply.add_done_callback(self._adopt_abandoned_hello)

    def _adopt_abandoned_hello(self, reply: asyncio.Future[bytes]) -> None:
        if self._abandoned_hello is not reply or not reply.done():
            return  # a later handshake has been answered in the meantime
        self._abandoned_hello = None
        if reply.cancelled():
            return  # the connection was lost; `_hello_unanswered` remembers it
        try:
            self._open(decode_reply(op_of(Hello), HelloOk, reply.result()))
        except URLabError as error:
            log.info("the reply to an abandoned handshake cannot be used: %s", error)

    async def _settled(self, deadline: float | None) -> bool:
        """Wait for the reply to an abandoned handshake; return whether none is outstanding."""
        reply = self._abandoned_hello
        if reply is not None:
            left = None if deadline is None else max(0.0, deadline - asyncio.get_running_loop().time())
            await asyncio.wait((reply,), timeout=left)
            self._adopt_abandoned_hello(reply)
        return self._abandoned_hello is None

    async def _greet(self, frame: bytes, op: Op, deadlines: Deadlines) -> bytes:
        """Send a handshake, which opens a session even if its caller gives up."""
        sent = self.transport.stats.sent
        try:
            return await self._way.request(frame, op, deadlines, late=self._adopt_later)
        finally:
            if self.transport.stats.sent > sent:
                self.hello_sent = self._hello_unanswered = True  # `_hello_unanswered` until the reply has been read

    async def acquire(self, lock: Mutex, op: Op, deadline: float | None) -> None:
        """Wait for one of the session's locks.

        Raises:
            URLabTimeoutError: Another call held it until the deadline; nothing was sent.
        """
        if lock.acquire_nowait():
            return
        waiting = self._wait_for(lock, op, deadline)
        await (waiting if self._call_records is None else self._call_records.queued(op, waiting))

    async def _wait_for(self, lock: Mutex, op: Op, deadline: float | None) -> None:
        if self._probe_task is not None:
            self._probe_task.cancel()  # a probe can be repeated; a call of the user should not wait for it
        self._queued += 1
        try:
            async with asyncio.timeout_at(deadline):
                await lock.acquire()
        except TimeoutError:
            raise URLabTimeoutError(
                f"{op.name}: another call held {self.transport.endpoint} until the deadline. Nothing was sent.",
                op=op.name,
                hint="A client sends one request at a time; use a second client or a longer timeout.",
            ) from None
        finally:
            self._queued -= 1


async def _ask_again(ask: _Ask, frame: bytes, op: Op, deadlines: Deadlines, lost: ConnectionLost) -> bytes:
    """Repeat an idempotent request whose connection broke, until it is answered or its deadline has passed."""
    while True:
        log.debug("%s: sending the request again, because the connection was lost", op.name)
        try:
            return await ask(frame, op, deadlines)
        except ConnectionLost as again:
            lost = again
        except ServerUnreachable as unreachable:
            raise lost from unreachable


def leaves_open(error: BaseException) -> bool:
    """Return whether a request that was sent and failed with this error may have been executed."""
    if isinstance(error, URLabRPCError):
        return isinstance(error, _UNDECIDED)
    return not isinstance(error, (ServerUnreachable, TypeError, ValueError))


def server_restarted(what: str, endpoint: str, said: str = "") -> ServerRestarted:
    """Return the error of an op that a restart of the server ended, with the server's message `said`."""
    words = f" ({said})" if said else ""
    text = f"the server at {endpoint} has restarted and does not know the session{words}."
    return ServerRestarted(text, op=what)


def _maybe_own_handshake(refusal: SessionTakenOver) -> SessionTakenOver:
    return SessionTakenOver(
        refusal.code,
        f"{refusal.message.rstrip('.')}. An abandoned handshake of this client may have opened another session.",
        op=refusal.op,
    )
