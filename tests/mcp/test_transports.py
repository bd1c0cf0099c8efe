"""How agents come in: a command on standard input and output, or HTTP with a token."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import httpx2
import pytest
from agents import ALL, text_of
from children import child
from http_served import served
from mcp import Client
from mcp.client.stdio import StdioServerParameters, stdio_client
from mcp.client.streamable_http import streamable_http_client
from ports import free_port
from waiting import DEADLINE_S

from urlab_client._installation import install_command
from urlab_client.aio import URLabClient
from urlab_client.cli import main
from urlab_client.cli import mcp as command
from urlab_client.mcp import Agent
from urlab_client.mcp.transports import http_application
from urlab_client.server import SimulatedServer
from urlab_client.web import Access, app

TOKEN, ANOTHER = "what only the agent's host knows", "what only another agent's host knows"


async def test_an_agent_starts_the_command_and_drives(tmp_path: Path) -> None:
    parameters = StdioServerParameters(
        command=sys.executable, args=["-m", "urlab_client", "mcp", "sim://arm", "--allow-drive"], cwd=tmp_path
    )
    with (tmp_path / "stderr").open("w+") as stderr:
        async with Client(stdio_client(parameters, errlog=stderr), read_timeout_seconds=DEADLINE_S) as agent:
            moved = await agent.call_tool("move_to", {"robot": "arm", "joints": {"elbow": 0.5}})
            assert not moved.is_error, text_of(moved)
            assert "--allow-edit" in text_of(await agent.call_tool("remove", {"actor": "arm"}))
        stderr.seek(0)
        lines = stderr.read().splitlines()
    # The console's link is for a person: agents do not see it.
    assert [line.split(":")[0] for line in lines] == ["Console"]
    assert "?token=" in lines[0]


WEB = """
import builtins, sys
importing, asked = builtins.__import__, set()

def note(name, globals=None, *arguments):
    asking = (globals or {}).get("__name__", "")
    if name.partition(".")[0] in ("starlette", "uvicorn") and asking.startswith("urlab_client"):
        asked.add(asking)
    return importing(name, globals, *arguments)

builtins.__import__ = note
from urlab_client.cli import main
assert main(["mcp", "sim://arm", "--no-console"]) == 0
print(sorted(asked), [name for name in sys.modules if name.startswith("urlab_client.web")])
"""


def test_standard_streams_alone_load_no_web_framework(tmp_path: Path) -> None:
    # The SDK imports Starlette for its other transport; nothing of this package does.
    done = subprocess.run(
        [sys.executable, "-c", WEB],
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "[] []\n", "")


@pytest.mark.long
def test_the_command_ends_with_its_input(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "urlab_client", "mcp", "sim://arm", "--no-console"],
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


@pytest.mark.long
@pytest.mark.parametrize("command", [["console"], ["mcp"], ["mcp", "--http"]], ids=" ".join)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_command_that_serves_pages_in_good_order(
    command: list[str], number: signal.Signals, tmp_path: Path
) -> None:
    arguments = ["-m", "urlab_client", *command, "sim://arm", "--port", str(free_port())]
    with child(*arguments, cwd=tmp_path, stderr=subprocess.STDOUT) as process:
        assert process.stdout is not None
        assert any("Ctrl-C ends it" in line for line in iter(process.stdout.readline, ""))
        process.send_signal(number)
        assert process.wait(DEADLINE_S) == 0
        assert process.stdout.read() == ""


async def test_over_http_a_token_is_needed_which_is_not_the_console_s() -> None:
    with SimulatedServer("arm", play=True) as server:
        async with URLabClient(**server.client_options(), step_mode="direct") as client:
            access = Access()
            site = app(client, access=access)
            agent = Agent(site, ALL)
            application = http_application(agent, site, Access(keys=[TOKEN, ANOTHER]))
            async with site.router.lifespan_context(site), served(application) as http:
                assert (await http.post("/mcp")).json()["error"]["code"] == "no_key"
                bearer = {"authorization": f"Bearer {TOKEN}"}
                for name, value in (("host", "evil.example"), ("origin", "http://evil.example")):
                    answer = await http.post("/mcp", headers={**bearer, name: value})
                    assert (answer.status_code, answer.json()["error"]["code"]) == (403, f"bad_{name}")
                assert (await http.get("/api/world", headers=bearer)).status_code == 401
                key = access.admit(access.invite())
                assert (await http.get("/api/world", headers={"authorization": f"Bearer {key}"})).status_code == 200
                assert (await http.post("/mcp", headers={"authorization": f"Bearer {key}"})).status_code == 401

                told: list[float] = []

                async def progress(done: float, total: float | None, message: str | None) -> None:
                    told.append(done)

                async with (
                    httpx2.AsyncClient(headers=bearer, timeout=DEADLINE_S) as own,
                    Client(streamable_http_client(f"{http.base_url}/mcp", http_client=own)) as mcp,
                ):
                    moved = await mcp.call_tool("move_to", {"robot": "arm", "joints": {"elbow": 0.5}})
                    assert not moved.is_error, text_of(moved)
                    await client.runtime.set_sim_options(timestep=1e-4)
                    ran = await mcp.call_tool("run", {"seconds": 1}, progress_callback=progress)
                    assert not ran.is_error, text_of(ran)
                    assert told == sorted(told)
                    async with httpx2.AsyncClient(headers={"authorization": f"Bearer {ANOTHER}"}) as theirs:
                        transport = streamable_http_client(f"{http.base_url}/mcp", http_client=theirs)
                        async with Client(transport) as other:
                            refused = await other.call_tool("run", {"steps": 1})
                            assert "agent 1 (mcp) has the controls" in text_of(refused)
                            assert not (await other.call_tool("state", {"robot": "arm"})).is_error
                    assert "urlab://log" in {str(one.uri) for one in (await mcp.list_resources()).resources}


async def test_behind_a_proxy_agents_and_console_have_its_path_and_its_tls() -> None:
    public = "https://lab.example/robots"
    with SimulatedServer("arm", play=True) as server:
        async with URLabClient(**server.client_options()) as client:
            access = Access(hosts=["lab.example"])
            site = app(client, access=access)
            application = http_application(Agent(site, ALL), site, Access(hosts=["lab.example"], keys=[TOKEN]))
            headers = {"authorization": f"Bearer {TOKEN}", "host": "lab.example"}
            async with site.router.lifespan_context(site), served(application, public_url=public) as http:
                own = httpx2.AsyncClient(headers=headers, timeout=DEADLINE_S)
                async with own, Client(streamable_http_client(f"{http.base_url}/mcp", http_client=own)) as mcp:
                    assert not (await mcp.call_tool("look", {})).is_error
                entered = await http.get(f"/?token={access.invite()}", headers={"host": "lab.example"})
                assert (entered.status_code, entered.headers["location"]) == (303, "/robots/")
                assert "path=/robots/" in entered.headers["set-cookie"].lower()
                assert "secure" in entered.headers["set-cookie"].lower()


@pytest.mark.parametrize("options", [["--http"], []], ids=["http", "streams"])
def test_the_command_prints_the_links_of_its_proxy(options: list[str], tmp_path: Path) -> None:
    arguments = ["-m", "urlab_client", "mcp", "sim://arm", *options, "--port", "0"]
    public = "https://lab.example/robots"
    with child(*arguments, "--public-url", f"{public}/", cwd=tmp_path, stdin=subprocess.PIPE) as process:
        lines = [process.stderr.readline() for _ in range(2 if options else 1)]
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 0
    links = [f"Agent: {public}/mcp with", f"Console: {public}/?token="]
    assert all(line.startswith(link) for line, link in zip(lines, links[-len(lines) :], strict=True)), lines


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["sim://arm", "--host", "0.0.0.0"], "--allow-host NAME"),
        (["sim://arm", "--models", "nowhere"], "no such folder"),
        (["sim://arm", "--handshake", "file"], "not for sim://MODEL"),
        (["tcp://localhost"], "does not take a server over from another client. Pass --handshake FILE"),
        (["tcp://localhost", "--handshake", "file", "--allow-drive"], "leave out"),
        (["sim://arm", "--agents", "2"], "requires --http"),
        (["tcp://localhost", "--handshake", "file", "--step-mode", "live"], "the driving client chooses the mode"),
    ],
)
def test_what_cannot_be_honoured_is_said(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mcp", *arguments]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("given", [None, 0, command.AGENT_PORT, 8001])
def test_beside_standard_input_the_console_has_any_port_but_one_that_is_given(
    monkeypatch: pytest.MonkeyPatch, given: int | None
) -> None:
    told: list[Namespace] = []
    monkeypatch.setattr(command, "run", lambda arguments: told.append(arguments) or 0)
    assert main(["mcp", "sim://arm", *([] if given is None else ["--port", str(given)])]) == 0
    assert command._port(told[0]) == (given or 0)


def test_without_the_sdk_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "mcp" else find(name))
    monkeypatch.delitem(sys.modules, "urlab_client.mcp")
    assert main(["mcp"]) == 2
    assert install_command("mcp") in capsys.readouterr().err
