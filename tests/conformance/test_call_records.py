"""`observe=`: one record of every request, whatever becomes of it, and no harm from the function that is told."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import Any

import pytest
from ports import free_port
from waiting import gives_up, until

from urlab_client import ServerUnreachable, URLabTimeoutError
from urlab_client.errors import UnknownKeyframe
from urlab_client.protocol.codec import encode_request
from urlab_client.protocol.messages.runtime import SetPaused
from urlab_client.protocol.messages.session import Reset
from urlab_client.server import Drop, Faults
from urlab_client.types import CallOutcome, CallRecord


async def test_each_request_is_told_with_its_size_time_and_outcome(connect: Any, serve: Any) -> None:
    records: list[CallRecord] = []
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct", observe=records.append)
        before = time.time_ns()
        await client.discover()
        opened = records[0]
        assert (opened.op, records[1].op) == ("hello", "meta")
        assert opened.received_bytes > 1000, "the model is in it"
        assert before <= opened.started_ns <= time.time_ns()
        assert opened.round_trip_s > 0
        assert opened.endpoint.endswith(f":{server.client_options()['step_port']}")

        records.clear()
        await client.step(2)
        await client.runtime.set_paused(True)
        with pytest.raises(UnknownKeyframe):
            await client.call(Reset(keyframe_name="nonsense"))
        told = [record for record in records if record.op != "claim_control"]
        assert [(record.op, record.outcome, record.error) for record in told] == [
            ("step", CallOutcome.OK, ""),
            ("set_paused", CallOutcome.OK, ""),
            ("reset", CallOutcome.REFUSED, "unknown_keyframe"),
        ]
        assert told[1].sent_bytes == len(encode_request(SetPaused(paused=True), client.session_id))
        assert min(record.received_bytes for record in told) > 0


async def test_what_was_lost_timed_out_or_never_sent_is_told_too(connect: Any, serve: Any) -> None:
    records: list[CallRecord] = []
    faults = Faults()
    with serve("arm", play=True, faults=faults) as server:
        client = connect(server, step_mode="direct", observe=records.append)
        await client.discover()
        records.clear()

        lost = faults.add(Drop("step", times=1))
        step = asyncio.create_task(client.step(timeout=2))  # a busy machine makes the next two calls meanwhile
        await until(lambda: lost.applied)
        with pytest.raises(URLabTimeoutError, match="another call held"):
            await client.runtime.set_paused(False, timeout=0.01)
        await client.runtime.set_paused(False)
        with pytest.raises(URLabTimeoutError):
            await step
        waited, unanswered, late = records
        assert (waited.op, waited.outcome, waited.sent_bytes) == ("set_paused", CallOutcome.TIMEOUT, 0)
        assert (unanswered.op, unanswered.outcome, unanswered.received_bytes) == ("step", CallOutcome.TIMEOUT, 0)
        assert (unanswered.error, unanswered.queued_s) == ("URLabTimeoutError", 0.0)
        assert waited.queued_s > 0
        assert unanswered.sent_bytes > 0
        # Whoever waits for its turn and then gets it is told with the time of both.
        assert (late.op, late.outcome) == ("set_paused", CallOutcome.OK)
        assert late.queued_s > 0
        assert late.round_trip_s > 0
        for one in (waited, late):
            ended_ns = one.started_ns + 1e9 * (one.queued_s + one.round_trip_s)
            assert ended_ns < time.time_ns() + 1e8, "it starts where its caller asks"
    nowhere = connect(address="tcp://127.0.0.1", step_port=free_port(), rcv_timeout_ms=50, observe=records.append)
    with pytest.raises(ServerUnreachable):
        await nowhere.discover()
    assert (records[-1].op, records[-1].outcome, records[-1].received_bytes) == ("hello", CallOutcome.LOST, 0)


async def test_a_function_that_fails_is_logged_and_harms_no_call(
    connect: Any, serve: Any, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(record: CallRecord) -> None:
        raise RuntimeError(record.op)

    with serve("arm", play=True) as server, caplog.at_level(logging.ERROR, "urlab_client.session"):
        client = connect(server, step_mode="direct", observe=broken)
        await client.discover()
        assert (await client.step()).step == 1
    assert "failed on a record of step" in caplog.text


async def test_what_cannot_be_called_in_the_middle_of_a_request_is_refused(connect: Any) -> None:
    async def later(record: CallRecord) -> None: ...

    with pytest.raises(TypeError, match="observe= takes a plain function, not an async one"):
        connect(observe=later)
    with pytest.raises(TypeError, match="observe= takes a function of one argument, a CallRecord, not 'print'"):
        connect(observe="print")


async def test_a_call_that_is_cancelled_is_told_as_such(serve: Any) -> None:
    from urlab_client.aio import URLabClient

    records: list[CallRecord] = []
    faults = Faults()
    with serve("arm", play=True, faults=faults) as server:
        async with URLabClient(**server.client_options(), step_mode="direct", observe=records.append) as client:
            await client.discover()
            lost = faults.add(Drop("step", times=1))
            await gives_up(client.step, lambda: lost.applied, "cancelled")
            assert (records[-1].op, records[-1].outcome) == ("step", CallOutcome.CANCELLED)
