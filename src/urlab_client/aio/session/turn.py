"""Turns: exclusive access to the client's state, for tasks whose requests depend on it."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypeVar

from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.transport.base import Deadlines
from urlab_client.errors import ProtocolError
from urlab_client.protocol.base import Needs, Op, Reply, Request
from urlab_client.protocol.codec import op_of
from urlab_client.protocol.messages.jobs import OpStarted

if TYPE_CHECKING:
    from urlab_client.aio.session.session import Session

R = TypeVar("R", bound=Reply)
T = TypeVar("T")


class Turn:
    """Exclusive access of one task to the client's state, and to the connection for requests that depend on it.

    Within a turn a request is built, sent and accounted for, and its reply updates the state. Requests that do not
    depend on the client's state may be sent in between only during `aside`.
    """

    __slots__ = ("_before", "_began", "_each", "_first", "_left", "_op", "_ready", "_session", "_timeout")

    def __init__(self, session: Session, op: Op, timeout: Timeout, *, each: bool) -> None:
        self._session = session
        self._op = op
        self._timeout: Timeout = timeout
        self._each = each
        self._began = session.bound_loop().time()
        self._first: Deadlines | None = session.deadlines(op, timeout, self._began)  # None after the first `call`
        self._ready = False
        self._before = 0  # requests that had been sent before the latest `call`
        self._left = False

    def begin_nowait(self) -> bool:
        """Begin if no other task has a turn and no request is in progress; return whether the turn has begun."""
        session = self._session
        if self._op.needs is Needs.EDITOR or not session.state_lock.acquire_nowait():
            return False
        if not session.request_lock.acquire_nowait():
            session.state_lock.release()
            return False
        self._ready = True
        return True

    async def begin(self) -> None:
        """Wait for the turn, or raise `URLabTimeoutError` after the deadline. Nothing was sent by then."""
        state_lock, deadline = self._session.state_lock, self._deadlines(self._op).reply
        await self._session.acquire(state_lock, self._op, deadline)
        try:
            await self._acquire_request_lock(deadline)
        except BaseException:
            state_lock.release()
            raise

    def end(self) -> None:
        if self._ready:
            self._release_request_lock()
        self._session.state_lock.release()

    async def __aenter__(self) -> Self:
        await self.begin()
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.end()

    @property
    def sent(self) -> bool:
        """Whether the request of the latest `call` was sent, so that the server may have executed it."""
        return self._session.transport.stats.sent > self._before if self._ready else self._left

    def call(self, request: Request[R], *, takes: float | None = None) -> Coroutine[Any, Any, R]:
        """Send a request, built since the last wait of this turn, and return its reply.

        By default the server may take the seconds that the op declares; `takes` overrides them.

        Raises:
            URLabError: See `Session.call`.
        """
        session, op = self._session, self._op
        if type(request) is not op.request:
            op = op_of(request)
            session.check_offered(op)
        deadlines = self._deadlines(op, takes)
        self._first = None
        self._before = session.transport.stats.sent
        answer: Coroutine[Any, Any, Any] = session.exchange(request, op, deadlines)
        # The server answers only the editor's ops with a job.
        return _await_reply(op, answer) if op.needs is Needs.EDITOR else answer

    def deadline(self, takes: float) -> float:
        """Return the loop time until which this turn may wait for something that takes `takes` seconds."""
        by = asyncio.get_running_loop().time() + takes
        limit = None if self._timeout is DEFAULT else self._deadlines(self._op).reply
        return by if limit is None else min(by, limit)

    async def aside(self, work: Awaitable[T]) -> T:
        """Let requests that do not depend on the client's state pass while awaiting `work`, which sends nothing."""
        self._left = self.sent
        self._ready = False
        self._release_request_lock()
        result = await work
        await self._acquire_request_lock(self._deadlines(self._op).reply)
        return result

    async def _acquire_request_lock(self, deadline: float | None) -> None:
        session, op = self._session, self._op
        in_editor = op.needs is Needs.EDITOR
        if in_editor:
            await session.acquire(session.editor_lock, op, deadline)
        try:
            await session.acquire(session.request_lock, op, deadline)
        except BaseException:
            if in_editor:
                session.editor_lock.release()
            raise
        self._ready = True

    def _release_request_lock(self) -> None:
        self._session.request_lock.release()
        if self._op.needs is Needs.EDITOR:
            self._session.editor_lock.release()

    def _deadlines(self, op: Op, takes: float | None = None) -> Deadlines:
        if self._first is not None and op is self._op and takes is None:
            return self._first
        # The wait for the turn counts for the first request, and for all requests if one timeout covers them.
        counted = self._first is not None or (self._timeout is not DEFAULT and not self._each)
        since = self._began if counted else asyncio.get_running_loop().time()
        return self._session.deadlines(op, self._timeout, since, takes)


Settle: TypeAlias = Callable[[Turn], Awaitable[object]]
"""Makes certain, within a turn, what a request with an unknown outcome was about."""


async def _await_reply(op: Op, answer: Awaitable[R | OpStarted]) -> R:
    return require_reply(op, await answer)


def require_reply(op: Op, answer: R | OpStarted) -> R:
    """Return the reply to an op that may not run as a job, or raise `ProtocolError`."""
    if isinstance(answer, OpStarted):
        raise ProtocolError(f"{op.name}: the server started {answer.job_id} instead of replying.", op=op.name)
    return answer


class Mutex:
    """Mutual exclusion of tasks, first come, first served.

    Unlike `asyncio.Lock` it can be taken without a coroutine, and it is handed over: a task that is woken holds it.
    """

    __slots__ = ("_held", "_waiting")

    def __init__(self) -> None:
        self._held = False
        self._waiting: deque[asyncio.Future[None]] = deque()

    def locked(self) -> bool:
        return self._held

    def acquire_nowait(self) -> bool:
        if self._held:
            return False
        self._held = True
        return True

    async def acquire(self) -> None:
        if not self._held:
            self._held = True
            return
        handed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(handed)
        try:
            await handed
        except asyncio.CancelledError:
            if handed.cancelled():
                self._waiting.remove(handed)
            else:  # the lock was handed over in the same loop iteration in which the caller was cancelled
                self.release()
            raise

    def release(self) -> None:
        """Hand the lock to the task that has waited longest, or free it."""
        for handed in self._waiting:
            if not handed.done():
                self._waiting.remove(handed)
                handed.set_result(None)
                return
        self._held = False
