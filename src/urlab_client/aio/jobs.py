"""Editor ops that the server carries out as jobs: waiting for their end, within one deadline.

For the session, which comes here when an op is answered by `op_started`.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Final, TypeVar

from urlab_client.protocol.base import Op, Reply
from urlab_client.protocol.codec import decode_job
from urlab_client.protocol.errors import (
    OutcomeUnknown,
    ProtocolError,
    UnknownJob,
    URLabError,
    URLabRPCError,
    URLabTimeoutError,
)
from urlab_client.protocol.messages.jobs import OpStarted, OpStatus, OpStatusOk
from urlab_client.protocol.types import JobStatus

__all__ = ["OnProgress", "finish"]

log: logging.Logger = logging.getLogger("urlab_client.session")

R = TypeVar("R", bound=Reply)

OnProgress = Callable[[JobStatus], object]
"""Told how far a job is, on the client's event loop."""

_FIRST_S: Final = 0.02
_LONGEST_S: Final = 0.25
_GROWTH: Final = 1.5
_LOOK: Final = "What the editor did shows in outliner.list_actors(), list_blueprints() or scene.current_level()."


async def finish(
    op: Op,
    reply: type[R],
    started: OpStarted,
    poll: Callable[[OpStatus], Awaitable[OpStatusOk]],
    *,
    deadline: float | None,
    on_progress: OnProgress | None,
) -> R:
    """Wait for a job's end and return what it delivers, as if that had been the reply to the op.

    The server tells the end of a job once. The op is never sent again.

    Args:
        op: The op.
        reply: Its reply.
        started: What answered it.
        poll: Sends one question, to be answered by the deadline.
        deadline: Loop time until which to wait; None for no limit.
        on_progress: Told of each answer.

    Raises:
        URLabRPCError: The editor refused, as it could have done at once.
        OutcomeUnknown: The end of the job was told, and did not arrive.
        URLabTimeoutError: It has not ended in time; it goes on.
    """
    loop = asyncio.get_running_loop()
    began = loop.time()
    job = started.job_id
    log.debug("%s: the editor does it as %s", op.name, job)
    pause = _FIRST_S
    lost: URLabError | None = None
    try:
        while True:
            left = None if deadline is None else deadline - loop.time()
            if left is not None and left <= 0:
                raise _overdue(op, job, loop.time() - began)
            await asyncio.sleep(pause if left is None else min(pause, left))
            pause = min(pause * _GROWTH, _LONGEST_S)
            try:
                status = await poll(OpStatus(job_id=job))
            except UnknownJob:
                raise _unknown(op, job) from lost
            except URLabTimeoutError:
                raise _overdue(op, job, loop.time() - began) from None
            except OutcomeUnknown as broken:
                if lost is not None:
                    raise _unknown(op, job) from broken
                lost = broken  # its answer may have told the end; asking once more shows
                continue
            if on_progress is not None:
                on_progress(
                    JobStatus(job_id=job, state=status.state, progress=status.progress, elapsed_s=loop.time() - began)
                )
            if status.state in {"done", "failed"}:
                return _result(op, reply, status)
    except asyncio.CancelledError as cancelled:
        cancelled.add_note(f"{op.name}: the editor goes on with {job}; whether it succeeds is not known. {_LOOK}")
        raise


def _result(op: Op, reply: type[R], status: OpStatusOk) -> R:
    if status.result is not None:
        return decode_job(op, reply, status.result)
    if status.state == "failed":
        raise URLabRPCError("", f"{status.job_id} failed, and the editor does not say why.", op=op.name)
    raise ProtocolError(f"{op.name}: {status.job_id} is done, but its result is missing.", op=op.name)


def _overdue(op: Op, job: str, waited: float) -> URLabTimeoutError:
    error = URLabTimeoutError(
        f"{op.name}: {job} has not ended within {waited:.1f} s. The editor goes on with it.", op=op.name, hint=_LOOK
    )
    error.job_id = job
    return error


def _unknown(op: Op, job: str) -> OutcomeUnknown:
    error = OutcomeUnknown(
        f"{op.name}: {job} has ended, but the one report of how did not arrive here. It was not sent again.",
        op=op.name,
        hint=_LOOK,
    )
    error.job_id = job
    return error
