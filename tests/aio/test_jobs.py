"""How editor ops end that the server runs as jobs, whatever its reports say."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from urlab_client.aio.session.jobs import finish
from urlab_client.errors import OutcomeUnknown, ProtocolError, UnknownJob, URLabRPCError, URLabTimeoutError
from urlab_client.protocol.messages.jobs import OpStarted, OpStatus, OpStatusOk
from urlab_client.protocol.registry import OPS
from urlab_client.values.types import JobStatus

OP = OPS["create_level"]
LOST = OutcomeUnknown("the reply was lost")
RUNNING = OpStatusOk(job_id="job_7", state="running", progress="25 %")
GONE = UnknownJob("unknown_job", "it has been reported")


async def ended(*reports: OpStatusOk | Exception, seconds: float | None = None, told: Any = None) -> Any:
    """Wait for a job of which the server reports something each time; the last report comes again and again."""
    coming = list(reports)

    async def poll(request: OpStatus) -> OpStatusOk:
        assert request.job_id == "job_7"
        report = coming.pop(0) if len(coming) > 1 else coming[0]
        if isinstance(report, Exception):
            raise report
        return report

    deadline = None if seconds is None else asyncio.get_running_loop().time() + seconds
    return await finish(OP, OP.reply, OpStarted(job_id="job_7"), poll, deadline=deadline, on_progress=told)


async def test_progress_is_told_until_the_result() -> None:
    told: list[JobStatus] = []
    result = {"op": "error", "code": "create_level_failed", "message": "no space"}
    with pytest.raises(URLabRPCError, match="no space"):
        await ended(
            RUNNING, OpStatusOk(job_id="job_7", state="failed", progress="all", result=result), told=told.append
        )
    assert [(one.job_id, one.state, one.progress) for one in told] == [
        ("job_7", "running", "25 %"),
        ("job_7", "failed", "all"),
    ]
    assert 0.0 < told[0].elapsed_s <= told[1].elapsed_s


@pytest.mark.parametrize("seconds", [0.0, 0.05])
async def test_an_overdue_job_is_named_as_the_editor_continues_it(seconds: float) -> None:
    with pytest.raises(URLabTimeoutError, match=r"create_level: job_7 did not end within [0-9.]+ s") as overdue:
        await ended(RUNNING, seconds=seconds)
    assert (overdue.value.job_id, overdue.value.op) == ("job_7", "create_level")
    assert "list_actors" in str(overdue.value.hint)


async def test_a_poll_that_is_not_answered_in_time_is_the_jobs_timeout() -> None:
    with pytest.raises(URLabTimeoutError, match="create_level: job_7 did not end within") as overdue:
        await ended(URLabTimeoutError("op_status: no reply within 1 s", op="op_status"))
    assert overdue.value.job_id == "job_7"


async def test_one_lost_report_is_asked_for_again_and_two_leave_the_outcome_unknown() -> None:
    failed = OpStatusOk(job_id="job_7", state="failed")
    with pytest.raises(URLabRPCError, match="job_7 failed, and the editor gave no reason"):
        await ended(LOST, failed)
    for last in (LOST, GONE):
        with pytest.raises(OutcomeUnknown, match="job_7 has ended, but the report of its outcome was lost") as unknown:
            await ended(LOST, last)
        assert (unknown.value.job_id, unknown.value.op) == ("job_7", "create_level")
        assert unknown.value.__cause__ is LOST
        assert "list_actors" in str(unknown.value.hint)


async def test_a_job_that_is_done_without_a_result_broke_the_protocol() -> None:
    with pytest.raises(ProtocolError, match="create_level: job_7 is done, but its result is missing") as broken:
        await ended(OpStatusOk(job_id="job_7", state="done"))
    assert broken.value.op == "create_level"


async def test_who_cancels_the_wait_learns_that_the_editor_goes_on() -> None:
    waiting = asyncio.create_task(ended(RUNNING))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError) as cancelled:
        await waiting
    (note,) = cancelled.value.__notes__
    assert "the editor continues job_7" in note
