"""`sim://…` addresses: the client brings its own server and takes it away again."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from waiting import DEADLINE_S, eventually, gives_up, pass_time, until

import urlab_client
from urlab_client import ClientClosed, OutcomeUnknown, ServerUnreachable, URLabError
from urlab_client.aio import URLabClient, check_address, launch
from urlab_client.aio.launch import serve_arguments, start_seconds, with_model_options
from urlab_client.events import ServerReconnected


def children() -> set[int]:
    listing = subprocess.run(
        ["ps", "-ww", "--ppid", str(os.getpid()), "-o", "pid=,args="], capture_output=True, text=True, check=False
    )
    return {int(line.split()[0]) for line in listing.stdout.splitlines() if "urlab_client serve" in line}


@pytest.fixture
def never_ready(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Servers that start for as long as their input is open."""
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\nread line\n")
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))


async def test_a_script_needs_no_server_of_its_own() -> None:
    async with URLabClient("sim://arm", step_mode="direct") as client:
        assert children() == set(), "nothing starts before the first call"
        await client.discover()
        (server,) = children()
        await client.step(10)
        assert client.sim_time == pytest.approx(0.02)
    with pytest.raises(ProcessLookupError):
        os.kill(server, 0)


def test_the_facade_does_the_same() -> None:
    with urlab_client.URLabClient("sim://ball?model=pallet", step_mode="direct") as client:
        client.discover()
        client.step(10)
        assert set(client.articulations) == {"ball", "pallet"}
    assert children() == set()


async def test_the_start_of_the_server_counts_for_no_deadline() -> None:
    async with URLabClient("sim://ball") as client:
        calling = asyncio.create_task(client.discover())
        await until(children)
        pass_time(40)  # that is longer than a call may take, or wait for a connection
        await calling
        assert client.session_id


async def test_options_of_serve_go_into_the_address(tmp_path: Path) -> None:
    model = tmp_path / "slow.xml"
    body = '<body><freejoint/><geom size=".1"/></body>'
    model.write_text(f'<mujoco model="slow"><option timestep="0.01"/><worldbody>{body}</worldbody></mujoco>')
    async with URLabClient(f"sim://{model}?mjcf-options", step_mode="direct") as client:
        await client.discover()
        await client.step()
        assert client.sim_time == 0.01


@pytest.mark.parametrize("text", ["soon", "0", "nan", "inf"])
def test_how_long_a_start_may_take_is_a_number_of_seconds(text: str) -> None:
    assert start_seconds("sim://arm?start-timeout=2.5&model=ball") == 2.5
    assert serve_arguments("sim://arm?start-timeout=2.5&model=ball") == ["arm", "ball"]
    with pytest.raises(ValueError, match="start-timeout must be a number of seconds above 0"):
        URLabClient(f"sim://arm?start-timeout={text}")


async def test_a_server_that_is_not_ready_in_time_is_ended_and_the_option_named() -> None:
    async with URLabClient("sim://arm?start-timeout=0.001") as client:
        with pytest.raises(ServerUnreachable, match=r"not ready within 0\.001 s; add \?start-timeout=SECONDS"):
            await client.discover()
    assert children() == set()


async def test_options_of_a_model_that_have_no_effect_are_told(tmp_path: Path) -> None:
    """Simulation behaviour 1.4: the plugin ignores a model's options, and so does what stands for it, unless told."""
    model = tmp_path / "slow.xml"
    body = '<body><freejoint/><geom size=".1"/></body>'
    model.write_text(f'<mujoco model="slow"><option timestep="0.02"/><worldbody>{body}</worldbody></mujoco>')
    async with URLabClient(f"sim://{model}", step_mode="direct") as client:
        with pytest.warns(UserWarning, match=r"slow: timestep 0\.02\).*\?mjcf-options"):
            await client.discover()
        assert client.model is not None
        assert client.model.opt.timestep == 0.002
        told = [finding.text for finding in (await client.explain()).findings if finding.subject == "physics"]
    assert told[0].startswith("A step takes 0.002 s; integrator implicitfast")
    assert told[1].startswith("Options of the models have no effect (slow: timestep 0.02)")


@pytest.mark.parametrize(
    ("address", "asked"),
    [
        ("sim://arm", "sim://arm?mjcf-options"),
        ("sim://arm?model=ball", "sim://arm?model=ball&mjcf-options"),
        ("sim://arm?no-mjcf-options", "sim://arm?no-mjcf-options"),
        ("sim://arm?mjcf-options&model=ball", "sim://arm?mjcf-options&model=ball"),
        ("tcp://localhost", "tcp://localhost"),
    ],
)
def test_environments_ask_for_the_options_of_the_model(address: str, asked: str) -> None:
    assert with_model_options(address) == asked


async def test_a_model_that_is_not_there() -> None:
    async with URLabClient("sim://nowhere.xml") as client:
        with pytest.raises(ServerUnreachable, match=r"nowhere\.xml"):
            await client.discover()
    assert children() == set()


async def test_a_program_that_says_something_else_is_no_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sitecustomize.py").write_text("print('{\"x\": ' + '[' * 50_000)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    async with URLabClient("sim://arm") as client:
        with pytest.raises(ServerUnreachable, match="its first line is not a server's"):
            await client.discover()
    assert children() == set()


async def test_a_killed_server_is_noticed() -> None:
    async with URLabClient("sim://ball", step_mode="direct") as client:
        await client.discover()
        (server,) = children()
        reconnections = client.events(kinds=[ServerReconnected])
        os.kill(server, signal.SIGKILL)
        with pytest.raises((OutcomeUnknown, ServerUnreachable)):
            await client.step(timeout=10)
        assert not client.connected
        await client._transport._process.wait()  # type: ignore[attr-defined]  # until the event loop knows, too
        with pytest.raises(ServerUnreachable, match=r"exited with code -9.*discover\(\)"):
            await client.step()
        await client.discover()
        assert (await client.step()).step == 1
        assert (await reconnections.receive()).refused is True, "another server, not another connection"


async def test_a_server_that_has_exited_is_not_connected_although_its_connection_seems_to_be() -> None:
    async with URLabClient("sim://ball", step_mode="direct") as client:
        await client.discover()
        process: Any = client._transport._process  # type: ignore[attr-defined]
        os.kill(process.pid, signal.SIGKILL)
        process._process.wait()  # in which the event loop learns nothing
        with pytest.raises(ServerUnreachable, match="exited with code -9"):
            await client.step()
        assert not client.connected


async def test_a_call_that_waits_for_a_connection_to_a_killed_server_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[bool] = []
    known = property(lambda process: process._process.poll() if told else None)
    monkeypatch.setattr(launch._ServerProcess, "returncode", known)
    async with URLabClient("sim://ball", step_mode="direct") as client:
        await client.discover()
        transport: Any = client._transport
        os.kill(transport._process.pid, signal.SIGKILL)
        await until(lambda: not client.connected)
        step = asyncio.create_task(client.step(timeout=10 * DEADLINE_S))
        await until(lambda: transport._waiting)
        transport._process._process.wait()
        told.append(True)
        transport._on_end()
        async with asyncio.timeout(DEADLINE_S):
            with pytest.raises(ServerUnreachable, match=r"exited with code -9.*discover\(\)"):
                await step


async def test_cancelling_the_first_call_leaves_no_server_behind(never_ready: None) -> None:
    async with URLabClient("sim://ball") as client:
        await gives_up(client.discover, children, "cancelled")
    assert children() == set()


@pytest.mark.parametrize("moment", ["before there is a process", "before it is ready"])
async def test_closing_while_the_server_starts_leaves_none_behind(moment: str, never_ready: None) -> None:
    client = URLabClient("sim://ball")
    call = asyncio.create_task(client.discover())
    await asyncio.sleep(0)
    if moment == "before it is ready":
        await until(children, look=0)
    await client.close()
    assert children() == set()
    with pytest.raises(ClientClosed):
        await call
    assert children() == set()
    with pytest.raises(ClientClosed):
        await client.discover()


def test_closing_a_blocking_client_while_its_server_starts(never_ready: None) -> None:
    client = urlab_client.URLabClient("sim://ball")
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(client.discover)
        eventually(children)
        client.close()
        assert children() == set()
        with pytest.raises(ClientClosed):
            call.result()


@pytest.fixture
def never_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Servers that are ready at once, and do not end with their input."""
    program = tmp_path / "python"
    ready = '{"address": "tcp://127.0.0.1", "step_port": 1, "state_port": 2}'
    program.write_text(f"#!{sys.executable}\nimport time\nprint('{ready}', flush=True)\ntime.sleep(600)\n")
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))


@pytest.fixture
def forks_and_never_ends(never_ends: None) -> None:
    program = Path(sys.executable)
    forks = "\nimport os\npid = os.fork()\npid and open(__file__ + '.forked', 'w').write(str(pid))\ntime"
    program.write_text(program.read_text().replace("\ntime", forks))


async def test_what_a_server_has_forked_does_not_delay_the_close(
    forks_and_never_ends: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch, "_STOP_S", 0.1)
    client = URLabClient("sim://ball", rcv_timeout_ms=1)
    with pytest.raises(URLabError):  # on a busy machine its time is over before that is known
        await client.discover()
    process = client._transport._process  # type: ignore[attr-defined]
    note = Path(sys.executable + ".forked")
    await until(lambda: note.exists() and note.read_text())
    forked = int(await asyncio.to_thread(note.read_text))
    try:
        async with asyncio.timeout(DEADLINE_S):
            await client.close()
    finally:
        os.kill(forked, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL


async def test_cancelling_the_close_ends_the_server_at_once(never_ends: None) -> None:
    client = URLabClient("sim://ball", rcv_timeout_ms=1)
    with pytest.raises(ServerUnreachable):
        await client.discover()
    process = client._transport._process  # type: ignore[attr-defined]
    close = asyncio.create_task(client.close())
    await until(lambda: process._input.closed, look=0)
    assert process.returncode is None
    close.cancel()
    with pytest.raises(asyncio.CancelledError):
        await close
    assert process.returncode == -signal.SIGKILL
    await client.close()


def test_interrupting_a_blocking_close_ends_the_server_at_once(never_ends: None) -> None:
    client = urlab_client.URLabClient("sim://ball", rcv_timeout_ms=1)
    with pytest.raises(ServerUnreachable):
        client.discover()
    process = client._aio._transport._process  # type: ignore[attr-defined]

    def interrupt() -> None:
        eventually(lambda: process._input.closed)
        os.kill(os.getpid(), signal.SIGUSR1)

    def strike(*_: object) -> None:
        raise InterruptedError

    before = signal.signal(signal.SIGUSR1, strike)
    try:
        with ThreadPoolExecutor(1) as pool:
            interrupting = pool.submit(interrupt)
            with pytest.raises(InterruptedError):
                client.close()
            interrupting.result()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert process.returncode == -signal.SIGKILL
    client.close()


def test_the_server_dies_with_its_client() -> None:
    script = (
        "import os, urlab_client\n"
        "client = urlab_client.URLabClient('sim://ball')\n"
        "client.discover()\n"
        "print(client._aio._transport._process.pid, flush=True)\n"
        "os._exit(9)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 9
    pid = int(done.stdout)
    descriptor = None
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return  # already gone
    import select

    ready, _, _ = select.select([descriptor], [], [], DEADLINE_S)
    os.close(descriptor)
    assert ready, "the server outlived its client"


def test_a_blocking_client_starts_servers_under_uvloops_policy() -> None:
    script = (
        "import asyncio, os, signal, uvloop, urlab_client\n"
        "asyncio.set_event_loop_policy(uvloop.EventLoopPolicy())\n"
        "with urlab_client.URLabClient('sim://ball', step_mode='direct') as client:\n"
        "    client.discover()\n"
        "    process = client._aio._transport._process\n"
        "    os.kill(process.pid, signal.SIGKILL)\n"
        "    client._portal.call(process.wait)\n"
        "    client.discover()\n"
        "    print(process.returncode, client.step().step)\n"
        "    process = client._aio._transport._process\n"
        "print(process.returncode)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout.split(), done.returncode) == (["-9", "1", "0"], 0), done.stderr


@pytest.mark.parametrize(
    ("address", "arguments"),
    [
        ("sim://arm", ["arm"]),
        ("sim:///models/a.xml?model=b.xml", ["/models/a.xml", "b.xml"]),
        ("sim://arm?mjcf-options&step-mode=direct", ["arm", "--mjcf-options", "--step-mode=direct"]),
        ("sim://arm?controller=arm=pd,kp=50", ["arm", "--controller=arm=pd,kp=50"]),
    ],
)
def test_addresses_become_arguments(address: str, arguments: list[str]) -> None:
    assert serve_arguments(address) == arguments


@pytest.mark.parametrize(
    "option", ["insecure-no-auth", "server-key=a", "server-key%3Da", "allow-client=a", "allow-any-client"]
)
@pytest.mark.parametrize("flavour", [urlab_client.URLabClient, URLabClient])
def test_no_address_opens_a_server_to_others(flavour: Any, option: str) -> None:
    name = option.replace("%3D", "=").partition("=")[0]
    with pytest.raises(ValueError, match=rf"'{name}' is for a server that others use"):
        flavour(f"sim://arm?host=0.0.0.0&{option}")


@pytest.mark.parametrize("address", ["sim://--host=0.0.0.0", "sim://arm?model=--until-eof", "sim://arm?model="])
def test_what_an_address_names_as_a_model_is_no_option(address: str) -> None:
    option = address.partition("--")[2] and f" but the option '--{address.partition('--')[2]}'"
    with pytest.raises(ValueError, match=f"names no model{option}; write for example sim://arm"):
        URLabClient(address)


@pytest.mark.parametrize(
    "address",
    ["sim://arm", "sim://arm?model=ball&camera-size=64x48&play", "sim://ball?play", "tcp://localhost:5569"],
)
def test_an_address_from_outside_may_say_what_is_allowed(address: str) -> None:
    assert urlab_client.check_address is check_address
    options, servers = {"camera-size", "play"}, ("tcp://localhost:5569",)
    assert check_address(address, models=["arm", "ball"], options=options, servers=servers) == address


@pytest.mark.parametrize(
    ("address", "named"),
    [
        ("sim:///etc/passwd", "model '/etc/passwd'"),
        ("sim://arm?model=../x.xml", "model '../x.xml'"),
        ("sim://arm?saved-dir=/home/me", "option 'saved-dir'"),
        ("sim://arm?camera-size=64x48&%73aved-dir=/home/me", "option 'saved-dir'"),
        ("sim://arm?start-timeout=1e9", "option 'start-timeout'"),
        ("sim://arm?-play", "option '-play'"),
        ("SIM://arm", "server 'SIM://arm'"),
        ("tcp://localhost", "server 'tcp://localhost'"),
        ("ipc:///run/other", "server 'ipc:///run/other'"),
    ],
)
def test_an_address_from_outside_may_say_nothing_else(address: str, named: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"the {named} is not one of those that are allowed")):
        check_address(address, models=["arm"], options=["camera-size"], servers=["tcp://localhost:5569"])


async def test_a_start_cancelled_twice_leaves_no_process_to_the_next_call(monkeypatch: pytest.MonkeyPatch) -> None:
    async with URLabClient("sim://ball") as client:
        transport: Any = client._transport
        start = asyncio.create_task(client.discover())
        await until(lambda: transport._process)
        process, wait = transport._process, asyncio.Event()
        monkeypatch.setattr(process, "wait", lambda *_: wait.wait())
        start.cancel()
        await until(lambda: process._input.closed, look=0)
        start.cancel()
        with pytest.raises(asyncio.CancelledError):
            await start
        assert transport._process is None
        await client.discover()
