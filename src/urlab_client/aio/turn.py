"""Turns: while a task has one, it alone reads and changes the client's state, and sends what depends on it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Coroutine
from types import TracebackType
from typing import Any, Protocol, Self, TypeAlias, TypeVar, cast

from urlab_client.aio.deadline import DEFAULT, Timeout
from urlab_client.aio.mutex import Mutex
from urlab_client.aio.transport.base import RequestTransport
from urlab_client.protocol.base import Needs, Op, Reply, Request
from urlab_client.protocol.codec import op_of
from urlab_client.protocol.errors import ProtocolError
from urlab_client.protocol.messages.jobs import OpStarted

__all__ = ["Limits", "Turn", "at_once"]

R = TypeVar("R", bound=Reply)
T = TypeVar("T")


Limits: TypeAlias = tuple[float | None, float | None]
"""Loop times by which a request must have been answered, and a connection must stand; None waits."""


class TurnSession(Protocol):
    """What a turn needs of its session, where the meaning of each stands."""

    line: Mutex
    turns: Mutex
    editing: Mutex

    @property
    def transport(self) -> RequestTransport: ...

    def bound_loop(self) -> asyncio.AbstractEventLoop: ...

    def check_offered(self, op: Op) -> None: ...

    def limits(self, op: Op, timeout: Timeout, since: float, takes: float | None = None) -> Limits: ...

    async def acquire(self, lock: Mutex, op: Op, deadline: float | None) -> None: ...

    def exchange(self, request: Request[R], op: Op, limits: Limits) -> Coroutine[Any, Any, R | OpStarted]: ...


class Turn:
    """The time in which one task alone reads and changes the client's state, and sends what depends on it.

    Within it a request is built, sent, accounted for and taken over. Requests that do not depend on the client's state
    may go in between only during `aside`.
    """

    __slots__ = ("_asked", "_before", "_began", "_each", "_first", "_left", "_op", "_ready", "_session", "_timeout")

    def __init__(self, session: TurnSession, op: Op, timeout: Timeout, *, each: bool) -> None:
        self._session = session
        self._op = op
        self._timeout: Timeout = timeout
        self._each = each
        self._asked: Limits | None = None
        self._first = True
        self._ready = False
        self._began = session.bound_loop().time()
        self._before = 0  # requests that had been sent before the latest `call`
        self._left = False

    def begin_at_once(self) -> bool:
        """Begin if nobody else has a turn and nothing is under way; return whether it was so."""
        session, op = self._session, self._op
        self._asked = session.limits(op, self._timeout, self._began)
        if op.needs is Needs.EDITOR or not session.turns.acquire_nowait():
            return False
        if not session.line.acquire_nowait():
            session.turns.release()
            return False
        self._ready = True
        return True

    async def begin(self) -> None:
        """Wait for the turn.

        Raises:
            URLabTimeoutError: Others had theirs until the deadline; nothing was sent.
        """
        session, op = self._session, self._op
        limits = self._asked or session.limits(op, self._timeout, self._began)
        self._asked = limits
        await session.acquire(session.turns, op, limits[0])
        try:
            await self._take_line(limits[0])
        except BaseException:
            session.turns.release()
            raise

    def end(self) -> None:
        """Let the next one begin."""
        if self._ready:
            self._give_line()
        self._session.turns.release()

    async def __aenter__(self) -> Self:
        await self.begin()
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.end()

    @property
    def sent(self) -> bool:
        """Whether the request of the latest `call` left, so that the server may have executed it."""
        return self._session.transport.stats.sent > self._before if self._ready else self._left

    def call(self, request: Request[R], *, takes: float | None = None) -> Coroutine[Any, Any, R]:
        """Send a request, built since the last wait of this turn, and return its reply.

        Args:
            request: The request.
            takes: Seconds that the server may take, in place of those its op declares; for the default timeout.

        Raises:
            URLabError: As `Session.call`.
        """
        session, op, limits = self._session, self._op, self._asked
        self._before = session.transport.stats.sent
        if limits is None or takes is not None or type(request) is not op.request:
            op = op_of(request)
            session.check_offered(op)
            limits = self._limits(op, takes)
        self._asked = None
        self._first = False
        answer = session.exchange(request, op, limits)
        if op.needs is Needs.EDITOR:
            return _at_once(op, answer)
        return cast("Coroutine[Any, Any, R]", answer)  # only the editor's ops are ever answered with a job

    def deadline(self, takes: float) -> float:
        """Return the loop time until which this turn may wait for something that takes so long, in seconds."""
        by = asyncio.get_running_loop().time() + takes
        limit = None if self._timeout is DEFAULT else self._limits(self._op)[0]
        return by if limit is None else min(by, limit)

    async def aside(self, work: Awaitable[T]) -> T:
        """Let requests that do not depend on the client's state pass while `work`, which sends nothing, is done."""
        self._give_line()
        result = await work
        await self._take_line(self._limits(self._op)[0])
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
        self._left = self._session.transport.stats.sent > self._before
        self._ready = False
        self._session.line.release()
        if self._op.needs is Needs.EDITOR:
            self._session.editing.release()

    def _limits(self, op: Op, takes: float | None = None) -> Limits:
        # What is waited for the turn counts for the first request, and for all where one timeout covers them.
        counted = self._first or (self._timeout is not DEFAULT and not self._each)
        since = self._began if counted else asyncio.get_running_loop().time()
        return self._session.limits(op, self._timeout, since, takes)


async def _at_once(op: Op, answer: Awaitable[R | OpStarted]) -> R:
    return at_once(op, await answer)


def at_once(op: Op, answer: R | OpStarted) -> R:
    """Return the answer to an op that is none of the editor's jobs.

    Raises:
        ProtocolError: The server has made a job of it.
    """
    if isinstance(answer, OpStarted):
        raise ProtocolError(f"{op.name}: the server has started {answer.job_id} instead of answering.", op=op.name)
    return answer
