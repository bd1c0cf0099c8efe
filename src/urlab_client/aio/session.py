"""One RPC session: gives out turns, stamps requests, bounds them in time and decodes the answers."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Any, NamedTuple, Self, TypeVar

from urlab_client.aio.control import Control
from urlab_client.aio.deadline import DEFAULT, Timeout
from urlab_client.aio.event_loop import running_loop
from urlab_client.aio.jobs import OnProgress, finish
from urlab_client.aio.transport.base import RequestTransport
from urlab_client.protocol.base import ControlRequest, Needs, Op, Reply, Request
from urlab_client.protocol.codec import (
    check_finite,
    check_request,
    decode_answer,
    decode_reply,
    encode_request,
    op_of,
)
from urlab_client.protocol.errors import (
    ConnectionLost,
    NoSession,
    ProtocolError,
    ServerUnreachable,
    SessionTakenOver,
    UnknownOp,
    URLabError,
    URLabRPCError,
    URLabTimeoutError,
)
from urlab_client.protocol.features import Features
from urlab_client.protocol.messages.jobs import OpStarted, OpStatus
from urlab_client.protocol.messages.session import Hello, HelloOk, Meta, StateReply

__all__ = ["Session", "Turn"]

log = logging.getLogger("urlab_client.session")

R = TypeVar("R", bound=Reply)
T = TypeVar("T")


_UNLISTED = frozenset({"hello", "meta"})  # every server has them, none lists them


class Limits(NamedTuple):
    """Loop times by which a request must have been answered, and a connection must stand; None waits."""

    deadline: float | None
    connect_by: float | None


class Session:
    """A session with one server.

    The server answers one request at a time anyway, and a second request must not be queued behind a first that
    may fail: so requests wait here for the line to be free, where waiting is visible and cancellable. What depends on
    the client's state, or changes it, waits for a `turn` besides.

    Attributes:
        session_id: Id of the open session; empty without one.
        greeted: Whether a handshake was sent, with whatever outcome.
        features: What the server can do, as far as its answers have shown.
        control: The robots that this client owns.
        on_opened: Told of each session that was opened, also by a handshake that its caller had given up.
        on_refusal: Told of each refusal before it is raised.
        confirmed: Whether the server has answered within this session since the connection was made. It may be another
            server after that was lost, which only a refused or accepted session id shows.
        line: Held while a request is under way, from encoding it to its reply.
        turns: Held by the `Turn` under way.
        editing: Held while the editor has a job.
    """

    def __init__(self, transport: RequestTransport, *, default_timeout: float | None, json: bool = False) -> None:
        self.session_id = ""
        self.greeted = False
        self.features = Features()
        self.on_opened: Callable[[HelloOk], None] | None = None
        self.on_refusal: Callable[[URLabRPCError], None] | None = None
        self.confirmed = False
        self._transport = transport
        self._default_timeout = default_timeout
        self._json = json
        self.control = Control(self)
        self.line = asyncio.Lock()
        self.turns = asyncio.Lock()
        self.editing = asyncio.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._queued = 0
        self._aside: asyncio.Task[Reply] | None = None
        # A handshake that was given up after it was sent opens a session all the same.
        self._given_up: asyncio.Future[bytes] | None = None
        self._unanswered = False

    @property
    def transport(self) -> RequestTransport:
        """What carries the requests."""
        return self._transport

    async def call(
        self, request: Request[R], *, timeout: Timeout = DEFAULT, on_progress: OnProgress | None = None
    ) -> R:
        """Send a request that does not depend on the client's state; return its reply, after the end of its job.

        Args:
            request: Any request struct of `urlab_client.protocol.messages`.
            timeout: Seconds for queueing, sending and the reply, of a job, too; None waits.
            on_progress: Told how far a job is.

        Raises:
            URLabRPCError: The server refused.
            URLabConnectionError: The server cannot be reached, or the connection broke.
            URLabTimeoutError: No reply in time.
            NoSession: No session is open; nothing was sent.
            TypeError, ValueError: The request is malformed; nothing was sent.
        """
        op = op_of(request)
        self.check_offered(op)
        limits = self.limits(op, timeout, self.bound_loop().time())
        if op.needs is not Needs.EDITOR:
            return await self._on_line(request, op, limits)
        # One job at a time: the next op of the editor would wait for it anyway, and block the server meanwhile.
        await self.acquire(self.editing, op, limits.deadline)
        try:
            await self.acquire(self.line, op, limits.deadline)
            try:
                answer = await self.exchange(request, op, limits)
            finally:
                self.line.release()
            if not isinstance(answer, OpStarted):
                return answer
            status = op_of(OpStatus)
            return await finish(
                op,
                op_reply(request, op),
                answer,
                lambda question: self._on_line(question, status, limits),
                deadline=limits.deadline,
                on_progress=on_progress,
            )
        finally:
            self.editing.release()

    async def _on_line(self, request: Request[R], op: Op, limits: Limits) -> R:
        await self.acquire(self.line, op, limits.deadline)
        try:
            return at_once(op, await self.exchange(request, op, limits))
        finally:
            self.line.release()

    def turn(self, request: type[Request[Any]], *, timeout: Timeout = DEFAULT, each: bool = False) -> Turn:
        """Return the turn of a task whose requests depend on the client's state or change it.

        Args:
            request: The first request, whose deadline covers the wait for the turn as well.
            timeout: Seconds for queueing and all requests together; the default is for each by itself, None waits.
            each: Whether a timeout that is given is for each request by itself, too.
        """
        op = op_of(request)
        self.check_offered(op)
        return Turn(self, op, timeout, each=each)

    async def probe(self, request: Request[R], *, timeout: float) -> R | None:
        """Send a request that nobody waits for, unless somebody else's is under way, and give way to the next one.

        Returns:
            The reply, or None if it gave way.
        """
        if self.line.locked() or self._queued:
            return None
        task = asyncio.create_task(self.call(request, timeout=timeout), name="urlab-probe")
        self._aside = task
        try:
            await asyncio.wait((task,))
            return None if task.cancelled() else task.result()
        finally:
            task.cancel()
            self._aside = None

    async def hello(self, turn: Turn, request: Hello) -> HelloOk:
        """Open a session; the one before it becomes invalid, here and for any other client."""
        if self._json:
            request.encoding = "json"
        reply = await turn.call(request)
        # A packaged build lacks the editor's ops, an older server lacks newer ones.
        try:
            listed = [op.name for op in (await turn.call(Meta())).ops]
        except UnknownOp:
            listed = None
        self.features = self.features.with_ops(listed).with_hello(reply)
        return reply

    async def aclose(self) -> None:
        """Release the transport; calls that wait fail with `ClientClosed`."""
        await self._transport.aclose()

    def bound_loop(self) -> asyncio.AbstractEventLoop:
        """Return the running loop, on which this session stays.

        Raises:
            URLabError: It is another one than before, or not asyncio's.
        """
        self._loop = running_loop(self._loop)
        return self._loop

    def check_offered(self, op: Op) -> None:
        """Refuse an op that the server does not list.

        Raises:
            UnknownOp: It does not; nothing was sent.
        """
        if op.name not in _UNLISTED and not self.features.offers(op.name):
            raise UnknownOp("unknown_op", "this server does not offer it. Nothing was sent.", op=op.name)

    def limits(self, op: Op, timeout: Timeout, since: float, takes: float | None = None) -> Limits:
        """Return the limits of a request.

        Args:
            op: Its op.
            timeout: As its caller gave it.
            since: Loop time from which it counts.
            takes: Seconds that the server may take, in place of those the op declares; for the default timeout.
        """
        default = self._default_timeout
        if timeout is not DEFAULT:
            deadline = None if timeout is None else since + timeout
            return Limits(deadline, deadline)
        if default is None:
            return Limits(None, None)
        # A slow op may take long to answer; whether a server is there at all shows much sooner.
        seconds = op.timeout if takes is None else takes
        return Limits(since + max(seconds or 0.0, default), since + default)

    async def exchange(self, request: Request[R], op: Op, limits: Limits) -> R | OpStarted:
        """Send a request and return its answer; for whoever holds the line."""
        if self.features.claims and isinstance(request, ControlRequest):
            return await self.control.send(request, self._ask, limits)
        return await self._answer(request, op, limits)

    async def _ask(self, request: Request[R], limits: Limits) -> R:
        op = op_of(request)
        return at_once(op, await self._answer(request, op, limits))

    async def _answer(self, request: Request[R], op: Op, limits: Limits) -> R | OpStarted:
        stamped = self.session_id
        try:
            return await self._send(request, op, limits)
        except SessionTakenOver as refusal:
            # A handshake of our own that was given up opens a session all the same. What it made the server refuse
            # was not executed, and is sent once more in that session.
            if await self._settled(limits.deadline) and self.session_id != stamped:
                return await self._send(request, op, limits)
            if not stamped:
                raise NoSession("no session is open.", op=op.name) from None
            if self.on_refusal is not None:
                self.on_refusal(refusal)
            if self._unanswered:
                raise _by_ourselves(refusal) from None
            raise

    async def _send(self, request: Request[R], op: Op, limits: Limits) -> R | OpStarted:
        hello = op.request is Hello
        loop = asyncio.get_running_loop()
        began = loop.time()
        stamped = self.session_id
        frame = encode_request(request, stamped, json=self._json)
        if not op.hot:
            check_finite(request)
            if not self._json:
                check_request(request, frame)
        sent = self._transport.stats.sent
        try:
            try:
                answer = await self._transport.request(
                    frame,
                    op,
                    deadline=limits.deadline,
                    connect_by=limits.connect_by,
                    late=self._await_later if hello else None,
                )
            except ConnectionLost as lost:
                answer = await self._ask_again(frame, op, lost, limits)
        finally:
            if hello and self._transport.stats.sent > sent:
                self.greeted = self._unanswered = True  # until its answer has been read
        if log.isEnabledFor(logging.DEBUG):
            log.debug(
                "%s: %d bytes out, %d back in %.3f ms", op.name, len(frame), len(answer), 1e3 * (loop.time() - began)
            )
        try:
            reply = decode_answer(op, op_reply(request, op), answer)
        except URLabRPCError as refusal:
            # A refusal of what was sent before the latest hello says nothing about the session of now.
            taken_over = isinstance(refusal, SessionTakenOver)
            if self.on_refusal is not None and stamped == self.session_id and not taken_over:
                self.on_refusal(refusal)
            raise
        if isinstance(reply, StateReply):
            self.features = self.features.with_reply(reply)
        if isinstance(reply, HelloOk):
            self._open(reply)
        elif not self.confirmed:
            self.confirmed = op.needs is not Needs.NOTHING and stamped == self.session_id
        return reply

    def _open(self, hello: HelloOk) -> None:
        self.session_id = hello.session_id
        self.confirmed = True
        self._given_up = None
        self._unanswered = False
        if self.on_opened is not None:
            self.on_opened(hello)

    def _await_later(self, reply: asyncio.Future[bytes]) -> None:
        """Take the session over that a handshake opens whose caller has given up."""
        self._given_up = reply
        reply.add_done_callback(self._take_later)

    def _take_later(self, reply: asyncio.Future[bytes]) -> None:
        if self._given_up is not reply or not reply.done():
            return  # a later handshake has been answered since
        self._given_up = None
        if reply.cancelled():
            return  # the connection was lost; `_unanswered` remembers it
        try:
            self._open(decode_reply(op_of(Hello), HelloOk, reply.result()))
        except URLabError as error:
            log.info("the answer to a handshake that was given up is of no use: %s", error)

    async def _settled(self, deadline: float | None) -> bool:
        """Wait until it is known which session a handshake opened that was given up; return whether it is."""
        reply = self._given_up
        if reply is not None:
            left = None if deadline is None else max(0.0, deadline - asyncio.get_running_loop().time())
            await asyncio.wait((reply,), timeout=left)
            self._take_later(reply)
        return self._given_up is None

    async def _ask_again(self, frame: bytes, op: Op, lost: ConnectionLost, limits: Limits) -> bytes:
        """Repeat a request that changes nothing, whose connection broke, until there is an answer or time is up."""
        late = self._await_later if op.request is Hello else None
        while True:
            log.debug("%s: asking again, because the connection was lost", op.name)
            try:
                return await self._transport.request(
                    frame, op, deadline=limits.deadline, connect_by=limits.connect_by, late=late
                )
            except ConnectionLost as again:
                lost = again
            except ServerUnreachable as unreachable:
                raise lost from unreachable

    async def acquire(self, lock: asyncio.Lock, op: Op, deadline: float | None) -> None:
        """Wait for `line`, `turns` or `editing`.

        Raises:
            URLabTimeoutError: Another call held it until the deadline; nothing was sent.
        """
        if not lock.locked() and not self._queued:
            await lock.acquire()
            return
        if self._aside is not None:
            self._aside.cancel()
        self._queued += 1
        try:
            async with asyncio.timeout_at(deadline):
                await lock.acquire()
        except TimeoutError:
            raise URLabTimeoutError(
                f"{op.name}: another call held {self._transport.endpoint} until the deadline. Nothing was sent.",
                op=op.name,
                hint="A client sends one request at a time; use a second client or a longer timeout.",
            ) from None
        finally:
            self._queued -= 1


class Turn:
    """The time in which one task alone reads and changes the client's state, and sends what depends on it.

    Within it a request is built, sent, accounted for and taken over. Requests that do not depend on the client's state
    may go in between only during `aside`.

    Attributes:
        sent: Whether the request of the latest `call` left, so that the server may have executed it.
    """

    __slots__ = ("_asked", "_began", "_each", "_first", "_op", "_ready", "_session", "_timeout", "sent")

    def __init__(self, session: Session, op: Op, timeout: Timeout, *, each: bool) -> None:
        self.sent = False
        self._session = session
        self._op = op
        self._timeout: Timeout = timeout
        self._each = each
        self._asked: Limits | None = None
        self._began = 0.0
        self._first = True
        self._ready = False

    async def __aenter__(self) -> Self:
        session, op = self._session, self._op
        self._began = session.bound_loop().time()
        limits = self._asked = session.limits(op, self._timeout, self._began)
        await session.acquire(session.turns, op, limits.deadline)
        try:
            await self._take_line(limits.deadline)
        except BaseException:
            session.turns.release()
            raise
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._ready:
            self._give_line()
        self._session.turns.release()

    async def call(self, request: Request[R], *, takes: float | None = None) -> R:
        """Send a request, built since the last wait of this turn, and return its reply.

        Args:
            request: The request.
            takes: Seconds that the server may take, in place of those its op declares; for the default timeout.

        Raises:
            URLabError: As `Session.call`.
        """
        session, op = self._session, op_of(request)
        session.check_offered(op)
        limits = self._asked
        if limits is None or op is not self._op or takes is not None:
            limits = self._limits(op, takes)
        self._asked = None
        self._first = False
        stats = session.transport.stats
        before = stats.sent
        self.sent = False
        try:
            return at_once(op, await session.exchange(request, op, limits))
        finally:
            self.sent = stats.sent > before

    async def aside(self, work: Awaitable[T]) -> T:
        """Let requests that do not depend on the client's state pass while `work`, which sends nothing, is done."""
        self._give_line()
        result = await work
        await self._take_line(self._limits(self._op).deadline)
        return result

    async def _take_line(self, deadline: float | None) -> None:
        session, op = self._session, self._op
        editing = op.needs is Needs.EDITOR
        if editing:
            await session.acquire(session.editing, op, deadline)
        try:
            await session.acquire(session.line, op, deadline)
        except BaseException:
            if editing:
                session.editing.release()
            raise
        self._ready = True

    def _give_line(self) -> None:
        self._ready = False
        self._session.line.release()
        if self._op.needs is Needs.EDITOR:
            self._session.editing.release()

    def _limits(self, op: Op, takes: float | None = None) -> Limits:
        # What is waited for the turn counts for the first request, and for all where one timeout covers them.
        counted = self._first or (self._timeout is not DEFAULT and not self._each)
        since = self._began if counted else asyncio.get_running_loop().time()
        return self._session.limits(op, self._timeout, since, takes)


def at_once(op: Op, answer: R | OpStarted) -> R:
    """Return the answer to an op that is none of the editor's jobs.

    Raises:
        ProtocolError: The server has made a job of it.
    """
    if isinstance(answer, OpStarted):
        raise ProtocolError(f"{op.name}: the server has started {answer.job_id} instead of answering.", op=op.name)
    return answer


def op_reply(request: Request[R], op: Op) -> type[R]:
    """Return the reply struct of a request, typed: the registry knows it, type checkers know it from the request."""
    return op.reply  # type: ignore[return-value]  # Op cannot carry R: the registry holds ops of every R


def _by_ourselves(refusal: SessionTakenOver) -> SessionTakenOver:
    return SessionTakenOver(
        refusal.code,
        f"{refusal.message.rstrip('.')}. A handshake of this client that was given up may have opened another session.",
        op=refusal.op,
    )
