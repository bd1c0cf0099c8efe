"""Threads and tasks of commands that fail end the command, which says why."""

from __future__ import annotations

import asyncio
import queue
from typing import Any

import pytest
from starlette.applications import Starlette
from waiting import DEADLINE_S, until

from urlab_client.cli import serve as serve_command
from urlab_client.cli._pages import bound, serve
from urlab_client.cli.serve import Event, Events, next_event, start_aside, watch_input


def die(*_: Any) -> Any:
    raise SystemExit("enough")


def test_the_thread_that_starts_a_server() -> None:
    class Deadly:
        start = die

    events: Events = queue.SimpleQueue()
    thread = start_aside(Deadly(), events)  # type: ignore[arg-type]
    assert thread.name == "urlab-start"
    with pytest.raises(SystemExit, match="enough"):
        next_event(events)


def test_the_thread_that_waits_for_the_end_of_input(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serve_command, "read_aside", die)
    events: Events = queue.SimpleQueue()
    watch_input(events)
    assert events.get(timeout=DEADLINE_S) is Event.STOP
    (record,) = [one for one in caplog.records if "standard input can no longer be read" in one.getMessage()]
    assert record.threadName == "urlab-stdin"


async def test_the_task_that_waits_for_the_end_of_an_agent(caplog: pytest.LogCaptureFixture) -> None:
    class Deadly(asyncio.Event):
        async def wait(self) -> Any:
            raise MemoryError("none left")

    started = asyncio.Event()
    with bound("127.0.0.1", 0) as listener:
        serving = asyncio.create_task(serve(Starlette(), listener, started.set, Deadly()))
        async with asyncio.timeout(DEADLINE_S):
            await serving
    assert "urlab-end ended unexpectedly" in caplog.text
    await until(started.is_set)
