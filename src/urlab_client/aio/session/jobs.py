"""Editor ops that the server runs as jobs: waiting for their end, within one deadline.

The session uses this module when the server answers an op with `op_started`.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Final, TypeVar

from urlab_client.errors import OutcomeUnknown, ProtocolError, UnknownJob, URLabError, URLabRPCError, URLabTimeoutError
from urlab_client.protocol.base import Op, Reply
from urlab_client.protocol.codec import decode_job
from urlab_client.protocol.messages.jobs import OpStarted, OpStatus, OpStatusOk
from urlab_client.values.types import JobStatus

log: logging.Logger = logging.getLogger("urlab_client.session")

R = TypeVar("R", bound=Reply)

OnProgress = Callable[[JobStatus], object]
"""Callback invoked with the progress of a job, on the client's event loop."""

_FIRST_S: Final = 0.02
_LONGEST_S: Final = 0.25
_GROWTH: Final = 1.5
_CHECK: Final = "Check what the editor did with outliner.list_actors(), list_blueprints() or scene.current_level()."


async def finish(
    op: Op,
    reply: type[R],
    started: OpStarted,
    poll: Callable[[OpStatus], Awaitable[OpStatusOk]],
    *,
    deadline: float | None,
    on_progress: OnProgress | None,
) -> R:
    """Wait for a job's end and return its result, as if that had been the reply to the op.

    The server reports the end of a job once. The op is never sent again.

    Raises:
        URLabRPCError: The editor refused the op; the refusal arrived as the job's result.
        OutcomeUnknown: The report of the job's end was lost.
        URLabTimeoutError: The job did not end in time; it keeps running.
    """
    loop = asyncio.get_running_loop()
    began = loop.time()
    job = started.job_id
    log.debug("%s: the editor runs it as %s", op.name, job)
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
                lost = broken  # the lost reply may have reported the end: the next poll shows
                continue
            if on_progress is not None:
                on_progress(
                    JobStatus(job_id=job, state=status.state, progress=status.progress, elapsed_s=loop.time() - began)
                )
            if status.state in {"done", "failed"}:
                return _result(op, reply, status)
    except asyncio.CancelledError as cancelled:
        cancelled.add_note(f"{op.name}: the editor continues {job}; its outcome is not known. {_CHECK}")
        raise


def _result(op: Op, reply: type[R], status: OpStatusOk) -> R:
    if status.result is not None:
        return decode_job(op, reply, status.result)
    if status.state == "failed":
        raise URLabRPCError("", f"{status.job_id} failed, and the editor gave no reason.", op=op.name)
    raise ProtocolError(f"{op.name}: {status.job_id} is done, but its result is missing.", op=op.name)


def _overdue(op: Op, job: str, waited: float) -> URLabTimeoutError:
    error = URLabTimeoutError(
        f"{op.name}: {job} did not end within {waited:.1f} s. The editor continues it.", op=op.name, hint=_CHECK
    )
    error.job_id = job
    return error


def _unknown(op: Op, job: str) -> OutcomeUnknown:
    error = OutcomeUnknown(
        f"{op.name}: {job} has ended, but the report of its outcome was lost. The op was not sent again.",
        op=op.name,
        hint=_CHECK,
    )
    error.job_id = job
    return error
