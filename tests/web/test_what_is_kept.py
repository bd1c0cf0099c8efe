"""What the console keeps of those who come and go: no more than it needs, however long it runs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from starlette.datastructures import Headers

from urlab_client.aio import URLabClient
from urlab_client.console import recordings
from urlab_client.console.session import ConsoleSession
from urlab_client.web import Access, access


def test_the_keys_that_were_used_last_are_good(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "_MOST", 2)
    made = Access(keys=["given"])
    unused, first, second = (made.invite() for _ in range(3))
    assert made.admit(unused) is None

    def good(key: str | None) -> bool:
        return made.key_of(Headers({"authorization": f"Bearer {key}"})) == key

    early, idle = made.admit(first), made.admit(second)
    assert good(idle)
    assert good(early)
    late = made.admit(made.invite())
    assert [good(key) for key in (early, idle, late, "given")] == [True, False, True, True]


async def test_a_recording_that_grows_or_goes_leaves_no_descriptions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client: Any = None
    made = recordings.Recordings(client, tmp_path)
    file = tmp_path / "run.mcap"
    file.touch()
    monkeypatch.setattr(recordings, "_described", lambda file: {"at": os.stat(file).st_mtime})
    for at in (1, 2, 2):
        os.utime(file, (at, at))
        assert await made.describe(file.name) == {"at": at}
    assert len(made._described) == 1
    made.remove(file.name)
    assert not made._described


async def test_a_status_is_encoded_once_for_all_viewers_until_it_changes(tmp_path: Path) -> None:
    async with URLabClient("tcp://localhost") as client:
        console = ConsoleSession(client, recordings=tmp_path)
        with console.new_viewer() as one, console.new_viewer() as other:
            told = console.status_json(one)
            for _ in range(3):
                console.view.notify()  # as with each state
                assert console.status_json(one) is told
                assert console.status_json(other) is told
            console.lease.use(one)
            console.view.notify()
            assert json.loads(console.status_json(one))["mine"]
            assert not json.loads(console.status_json(other))["mine"]


async def test_a_viewer_gets_the_entries_of_the_log_that_it_does_not_have(tmp_path: Path) -> None:
    async with URLabClient("tcp://localhost") as client:
        view = ConsoleSession(client, recordings=tmp_path).view
        assert view.entries_after(-1) == []
        for number in range(1, 1001):
            view.note("event", "test", "counted", str(number))
        assert [entry.n for entry in view.entries_after(998)] == [999, 1000]
        assert view.entries_after(1000) == view.entries_after(2000) == []
        assert [*view.entries_after(-1)] == [*view.entries_after(3)] == [*view.entries]
