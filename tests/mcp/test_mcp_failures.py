"""What runs beside an agent's calls and fails is logged, and ends what waits for it."""

from __future__ import annotations

import asyncio
import os
from typing import Any

import pytest
from waiting import DEADLINE_S, until

from urlab_client.errors import URLabError
from urlab_client.mcp import transports
from urlab_client.mcp.call import Call


def logged(caplog: pytest.LogCaptureFixture, name: str) -> bool:
    return any(f"{name} ended unexpectedly" in record.getMessage() and record.exc_info for record in caplog.records)


async def test_the_thread_that_reads_the_agents_messages(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = os.pipe()
    try:
        os.write(theirs, b"first\n")
        with monkeypatch.context() as patch:
            patch.setattr(transports, "_CHUNK_BYTES", 6)
            lines = aiter(transports._Lines(ours))
            async with asyncio.timeout(DEADLINE_S):
                assert await anext(lines) == "first"
                patch.setattr(transports, "_CHUNK_BYTES", "many")
                os.write(theirs, b"second")
                with pytest.raises(URLabError, match="urlab-mcp-stdin ended unexpectedly: TypeError") as caught:
                    await anext(lines)
        assert isinstance(caught.value.__cause__, TypeError)
        assert logged(caplog, "urlab-mcp-stdin")
    finally:
        os.close(ours)
        os.close(theirs)


async def test_the_progress_of_a_call(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    async def fail(_: Any) -> None:
        raise MemoryError("none left")

    async def work() -> str:
        await until(lambda: logged(caplog, "urlab-mcp-progress"))
        return "done"

    class Controls:
        running = False

    class View:
        def notify(self) -> None: ...

    class Console:
        controls = Controls()
        view = View()

    monkeypatch.setattr(Call, "_report", fail)
    call = object.__new__(Call)
    call.console = Console()  # type: ignore[assignment]
    assert await call._reported(work) == "done"
