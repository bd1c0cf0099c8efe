"""An agent whose server is not there yet, starts, refuses, or goes away."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path
from typing import Any

from agents import text_of
from children import child
from mcp import Client
from mcp.client.stdio import StdioServerParameters, stdio_client
from ports import free_port
from waiting import DEADLINE_S, until

from urlab_client.aio import URLabClient
from urlab_client.console.session import ConsoleSession
from urlab_client.mcp import Agent, Limits
from urlab_client.server import SimulatedServer

WITHOUT_SERVER = ("explain", "log", "look")


async def test_it_answers_before_a_server_runs_and_connects_when_it_appears(tmp_path: Path) -> None:
    port = free_port()
    client = URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct", live_pictures=False, rcv_timeout_ms=500)
    session = ConsoleSession(client, recordings=tmp_path)
    agent = Agent(session, Limits(drive=True))
    async with client, session.open(), Client(agent.server, read_timeout_seconds=DEADLINE_S) as mcp:

        async def said(tool: str, **arguments: Any) -> str:
            return text_of(await mcp.call_tool(tool, arguments))

        assert "Connection refused" in await said("explain")
        assert "Connection refused" in await said("look")
        assert (await mcp.call_tool("look", {})).structured_content["robots"] == []
        assert (await mcp.call_tool("run", {"steps": 1})).is_error
        assert "Connection refused" in await said("run", steps=1)
        assert '"run"' in await said("log")
        with SimulatedServer("arm", play=True, step_port=port) as server:
            assert server.step_port == port
            await until(lambda: session.link.state == "connected")
            assert '"connected"' in await said("look")
            assert not (await mcp.call_tool("run", {"steps": 1})).is_error
        await until(lambda: session.link.state != "connected")
        for text in (await said("explain"), await said("look")):
            assert "Connection refused" in text
            assert "begun anew" in text
        # What was last known is still there.
        assert (await mcp.call_tool("look", {})).structured_content["robots"][0]["name"] == "arm"


async def test_a_server_that_accepts_and_says_nothing_is_told_from_one_that_refuses(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # the system accepts, and nobody reads
        port = silent.getsockname()[1]
        client = URLabClient(f"tcp://127.0.0.1:{port}", live_pictures=False)
        session = ConsoleSession(client, recordings=tmp_path)
        async with client, session.open(), Client(Agent(session).server) as mcp:
            assert "The port accepts connections" in text_of(await mcp.call_tool("explain", {}))


async def test_a_simulated_server_starts_behind_the_first_answers(tmp_path: Path) -> None:
    """The server is held back, so that the order does not depend on the machine."""
    gate = tmp_path / "gate"
    hold = tmp_path / "sitecustomize.py"
    hold.write_text(
        "import pathlib, sys, time\n"
        "if 'serve' in getattr(sys, 'orig_argv', ()):\n"
        f"    while not pathlib.Path({str(gate)!r}).exists(): time.sleep(0.05)\n"
    )
    parameters = StdioServerParameters(
        command=sys.executable,
        args=["-m", "urlab_client", "mcp", "sim://arm", "--allow-drive", "--no-console"],
        cwd=tmp_path,
        env={"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])},
    )
    told: list[str | None] = []

    async def progress(progress: float, total: float | None, message: str | None) -> None:
        told.append(message)
        gate.touch()

    with (tmp_path / "stderr").open("w") as stderr:
        async with Client(stdio_client(parameters, errlog=stderr), read_timeout_seconds=DEADLINE_S) as agent:
            for tool in WITHOUT_SERVER:
                answer = await agent.call_tool(tool, {})
                assert not answer.is_error
                assert tool == "log" or "The simulated server is starting" in text_of(answer)
            assert not gate.exists()
            ran = await agent.call_tool("run", {"steps": 1}, progress_callback=progress)
            assert not ran.is_error, text_of(ran)
    assert told
    assert told[0] == "The simulated server is starting: sim://arm."


def test_a_simulated_server_that_cannot_start_ends_the_command(tmp_path: Path) -> None:
    with child("-m", "urlab_client", "mcp", "sim://nothing", "--no-console", cwd=tmp_path) as process:
        assert process.wait(DEADLINE_S) == 2
        assert process.stderr is not None
        assert "neither a file nor a bundled robot" in process.stderr.read()
