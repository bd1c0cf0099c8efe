"""Threads and tasks of commands that fail end the command, which says why."""

from __future__ import annotations

import queue
from typing import Any

import pytest
from waiting import DEADLINE_S

from urlab_client.cli import serve as serve_command
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
