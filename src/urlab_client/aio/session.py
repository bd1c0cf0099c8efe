"""One RPC session: stamps requests, keeps them one at a time, bounds them in time and decodes the answers."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from urlab_client.aio.control import Control
from urlab_client.aio.deadline import DEFAULT, Timeout, shared
from urlab_client.aio.event_loop import running_loop
from urlab_client.aio.jobs import OnProgress, finish
from urlab_client.aio.transport.base import RequestTransport
from urlab_client.protocol.base import ControlRequest, Needs, Op, Reply, Request
from urlab_client.protocol.codec import check_finite, check_request, decode_answer, encode_request, op_of
from urlab_client.protocol.errors import (
    ConnectionLost,
    ProtocolError,
    ServerUnreachable,
    UnknownOp,
    URLabRPCError,
    URLabTimeoutError,
)
from urlab_client.protocol.features import Features
from urlab_client.protocol.messages.jobs import OpStarted, OpStatus
from urlab_client.protocol.messages.session import Hello, HelloOk, Meta, StateReply

__all__ = ["Session"]

log = logging.getLogger("urlab_client.session")

R = TypeVar("R", bound=Reply)

_UNLISTED = frozenset({"hello", "meta"})  # every server has them, none lists them


class Limits(NamedTuple):
    """Loop times by which a request must have been answered, and a connection must stand; None waits."""

    deadline: float | None
    connect_by: float | None


class Session:
    """A session with one server.

    The server answers one request at a time anyway, and a second request must not be queued behind a first that
    may fail: so requests wait for their turn here, where waiting is visible and cancellable.

    Attributes:
        session_id: Id of the open session; empty without one.
        features: What the server can do, as far as its answers have shown.
        control: The robots that this client owns.
        on_refusal: Told of each refusal before it is raised.
        confirmed: Whether the server has answered within this session since the connection was made. It may be another
            server after that was lost, which only a refused or accepted session id shows.
    """

    def __init__(self, transport: RequestTransport, *, default_timeout: float | None, json: bool = False) -> None:
        self.session_id = ""
        self.features = Features()
        self.on_refusal: Callable[[URLabRPCError], None] | None = None
        self.confirmed = False
        self._transport = transport
        self._default_timeout = default_timeout
        self._json = json
        self.control = Control(self)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._turn = asyncio.Lock()
        self._editing = asyncio.Lock()
        self._queued = 0
        self._aside: asyncio.Task[Reply] | None = None

    @property
    def transport(self) -> RequestTransport:
        """What carries the requests."""
        return self._transport

    async def call(
        self, request: Request[R], *, timeout: Timeout = DEFAULT, on_progress: OnProgress | None = None
    ) -> R:
        """Send a request and return its reply, after the end of the job that it may start.

        Args:
            request: Any request struct of `urlab_client.protocol.messages`.
            timeout: Seconds for queueing, sending and the reply, of a job, too; None waits.
            on_progress: Told how far a job is.

        Raises:
            URLabRPCError: The server refused.
            URLabConnectionError: The server cannot be reached, or the connection broke.
            URLabTimeoutError: No reply in time.
            TypeError, ValueError: The request is malformed; nothing was sent.
        """
        op = op_of(request)
        if op.name not in _UNLISTED and not self.features.offers(op.name):
            raise UnknownOp("unknown_op", "this server does not offer it. Nothing was sent.", op=op.name)
        self._loop = running_loop(self._loop)
        limits = self._limits(op, timeout)
        if op.needs is not Needs.EDITOR:
            return await self._in_turn(request, op, limits)
        # One job at a time: the next op of the editor would wait for it anyway, and block the server meanwhile.
        await self._acquire(self._editing, op, limits.deadline)
        try:
            answer = await self._answer_in_turn(request, op, limits)
            if not isinstance(answer, OpStarted):
                return answer
            status = op_of(OpStatus)
            return await finish(
                op,
                op_reply(request, op),
                answer,
                lambda question: self._in_turn(question, status, limits),
                deadline=limits.deadline,
                on_progress=on_progress,
            )
        finally:
            self._editing.release()

    async def _in_turn(self, request: Request[R], op: Op, limits: Limits) -> R:
        answer = await self._answer_in_turn(request, op, limits)
        if isinstance(answer, OpStarted):
            raise ProtocolError(f"{op.name}: the server has started {answer.job_id} instead of answering.", op=op.name)
        return answer

    async def _answer_in_turn(self, request: Request[R], op: Op, limits: Limits) -> R | OpStarted:
        await self._acquire(self._turn, op, limits.deadline)
        try:
            return await self._exchange(request, op, limits)
        finally:
            self._turn.release()

    async def _exchange(self, request: Request[R], op: Op, limits: Limits) -> R | OpStarted:
        """Send a request and return its answer; for whoever has the turn."""
        if isinstance(request, ControlRequest):
            return await self.control.send(request, self._ask, limits)
        return await self._answer(request, op, limits)

    async def _ask(self, request: Request[R], limits: Limits) -> R:
        op = op_of(request)
        answer = await self._answer(request, op, limits)
        if isinstance(answer, OpStarted):
            raise ProtocolError(f"{op.name}: the server has started {answer.job_id} instead of answering.", op=op.name)
        return answer

    async def _answer(self, request: Request[R], op: Op, limits: Limits) -> R | OpStarted:
        began = asyncio.get_running_loop().time()
        stamped = self.session_id
        frame = encode_request(request, stamped, json=self._json)
        if not op.hot:
            check_finite(request)
            if not self._json:
                check_request(request, frame)
        try:
            answer = await self._transport.request(frame, op, deadline=limits.deadline, connect_by=limits.connect_by)
        except ConnectionLost as lost:
            answer = await self._ask_again(frame, op, lost, deadline=limits.deadline, connect_by=limits.connect_by)
        if log.isEnabledFor(logging.DEBUG):
            took = asyncio.get_running_loop().time() - began
            log.debug("%s: %d bytes out, %d back in %.3f ms", op.name, len(frame), len(answer), 1e3 * took)
        try:
            reply = decode_answer(op, op_reply(request, op), answer)
        except URLabRPCError as refusal:
            # A refusal of what was sent before the latest hello says nothing about the session of now.
            if self.on_refusal is not None and stamped == self.session_id:
                self.on_refusal(refusal)
            raise
        if isinstance(reply, StateReply):
            self.features = self.features.with_reply(reply)
        if not self.confirmed:
            self.confirmed = op.needs is not Needs.NOTHING and stamped == self.session_id
        return reply

    async def probe(self, request: Request[R], *, timeout: float) -> R | None:
        """Send a request that nobody waits for, unless somebody else's is under way, and give way to the next one.

        Returns:
            The reply, or None if it gave way.
        """
        if self._turn.locked() or self._queued:
            return None
        task = asyncio.create_task(self.call(request, timeout=timeout), name="urlab-probe")
        self._aside = task
        try:
            await asyncio.wait((task,))
            return None if task.cancelled() else task.result()
        finally:
            task.cancel()
            self._aside = None

    async def hello(self, request: Hello, *, timeout: Timeout = DEFAULT) -> HelloOk:
        """Open a session; the one before it becomes invalid, here and for any other client."""
        if self._json:
            request.encoding = "json"
        left = shared(timeout)
        reply = await self.call(request, timeout=left())
        self.session_id = reply.session_id
        self.confirmed = True
        # A packaged build lacks the editor's ops, an older server lacks newer ones.
        try:
            listed = [op.name for op in (await self.call(Meta(), timeout=left())).ops]
        except UnknownOp:
            listed = None
        self.features = self.features.with_ops(listed).with_hello(reply)
        return reply

    async def aclose(self) -> None:
        """Release the transport; calls that wait fail with `ClientClosed`."""
        await self._transport.aclose()

    def _seconds(self, op: Op) -> float | None:
        if self._default_timeout is None or op.timeout is None:
            return self._default_timeout
        return max(op.timeout, self._default_timeout)

    def _limits(self, op: Op, timeout: Timeout) -> Limits:
        now = asyncio.get_running_loop().time()
        seconds = self._seconds(op) if timeout is DEFAULT else timeout
        deadline = None if seconds is None else now + seconds
        # A slow op may take long to answer; whether a server is there at all shows much sooner.
        if timeout is not DEFAULT or self._default_timeout is None:
            return Limits(deadline, deadline)
        by = now + self._default_timeout
        return Limits(deadline, by if deadline is None else min(by, deadline))

    async def _ask_again(
        self, frame: bytes, op: Op, lost: ConnectionLost, *, deadline: float | None, connect_by: float | None
    ) -> bytes:
        """Repeat a request that changes nothing, whose connection broke, until there is an answer or time is up."""
        while True:
            log.debug("%s: asking again, because the connection was lost", op.name)
            try:
                return await self._transport.request(frame, op, deadline=deadline, connect_by=connect_by)
            except ConnectionLost as again:
                lost = again
            except ServerUnreachable as unreachable:
                raise lost from unreachable

    async def _acquire(self, lock: asyncio.Lock, op: Op, deadline: float | None) -> None:
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


def op_reply(request: Request[R], op: Op) -> type[R]:
    """Return the reply struct of a request, typed: the registry knows it, type checkers know it from the request."""
    return op.reply  # type: ignore[return-value]  # Op cannot carry R: the registry holds ops of every R
