"""Records for `observe=`: one for each request, after it has finished."""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from typing import TypeVar

from urlab_client.aio.client_types import CallOutcome, CallRecord
from urlab_client.aio.transport.base import Deadlines, LateReply
from urlab_client.aio.transport.zmq import ZmqTransport
from urlab_client.errors import URLabConnectionError, URLabRPCError, URLabTimeoutError
from urlab_client.protocol.base import Op

log: logging.Logger = logging.getLogger("urlab_client.session")

T = TypeVar("T")

Observe = Callable[[CallRecord], object]

_QUEUED: ContextVar[float] = ContextVar("seconds that this task's next request has been waiting", default=0.0)


class CallRecords:
    """Measures the requests of one session, of which one is in progress at a time, and calls the user's function.

    A session without an observer does not use this class: its requests go directly to the transport.
    """

    def __init__(self, observe: Observe, transport: ZmqTransport) -> None:
        if not callable(observe):
            raise TypeError(f"observe= takes a function of one argument, a CallRecord, not {observe!r}")
        if inspect.iscoroutinefunction(observe) or inspect.iscoroutinefunction(getattr(observe, "__call__", None)):  # noqa: B004
            raise TypeError("observe= takes a plain function, not an async one, because it is called during a request")
        self._observe = observe
        self._transport = transport
        self._way = transport.shared or transport
        self._sent_bytes = 0
        self._received_bytes = 0
        self._on_the_way = 0.0

    async def request(self, frame: bytes, op: Op, deadlines: Deadlines, *, late: LateReply | None = None) -> bytes:
        self._sent_bytes += len(frame)
        began = time.perf_counter()
        try:
            answer = await self._way.request(frame, op, deadlines, late=late)
        finally:
            self._on_the_way += time.perf_counter() - began
        self._received_bytes += len(answer)
        return answer

    async def queued(self, op: Op, waiting: Awaitable[None]) -> None:
        """Let a request wait for others, and record it if it fails or is cancelled while waiting."""
        began = time.perf_counter()
        try:
            await waiting
        except BaseException as error:
            queued = _QUEUED.get() + time.perf_counter() - began
            _QUEUED.set(0.0)
            self._tell(op, error, queued=queued, started_ns=time.time_ns() - int(1e9 * queued))
            raise
        _QUEUED.set(_QUEUED.get() + time.perf_counter() - began)

    async def record(self, op: Op, answer: Awaitable[T]) -> T:
        queued = _QUEUED.get()
        _QUEUED.set(0.0)
        started_ns = time.time_ns() - int(1e9 * queued)
        self._sent_bytes = self._received_bytes = 0
        self._on_the_way = 0.0
        error: BaseException | None = None
        try:
            return await answer
        except BaseException as raised:
            error = raised
            raise
        finally:
            self._tell(
                op,
                error,
                queued=queued,
                started_ns=started_ns,
                round_trip=self._on_the_way,
                sent=self._sent_bytes,
                received=self._received_bytes,
            )

    def _tell(
        self,
        op: Op,
        error: BaseException | None,
        *,
        queued: float,
        started_ns: int,
        round_trip: float = 0.0,
        sent: int = 0,
        received: int = 0,
    ) -> None:
        record = CallRecord(
            op=op.name,
            endpoint=self._transport.endpoint,
            started_ns=started_ns,
            queued_s=queued,
            round_trip_s=round_trip,
            sent_bytes=sent,
            received_bytes=received,
            outcome=_outcome(error),
            error=_name(error),
        )
        try:
            self._observe(record)
        except Exception:
            log.exception("observe=%r failed on a record of %s", self._observe, op.name)


def _outcome(error: BaseException | None) -> CallOutcome:
    match error:
        case None:
            return CallOutcome.OK
        case asyncio.CancelledError():
            return CallOutcome.CANCELLED
        case URLabTimeoutError():
            return CallOutcome.TIMEOUT
        case URLabRPCError():
            return CallOutcome.REFUSED
        case URLabConnectionError():
            return CallOutcome.LOST
        case _:
            return CallOutcome.FAILED


def _name(error: BaseException | None) -> str:
    if isinstance(error, URLabRPCError):
        return error.code
    return "" if error is None else type(error).__name__
