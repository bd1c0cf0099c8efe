"""Ctrl-C in a terminal, and a notebook's interrupt, reach the whole process group; the servers of clients stay."""

from __future__ import annotations

import ast
import os
from pathlib import Path

import pytest
from terminal import Terminal

import urlab_client
import urlab_client.aio

BLOCKING = """
import time
from urlab_client import URLabClient

def rest():
    while True:
        time.sleep(0.01)  # Python goes on sleeping after a signal that came just before

def step_on():
    while True:
        client.step()

with URLabClient("sim://arm", step_mode="direct") as client:
    client.discover()
    client.step(10)
    for work in (rest, step_on):
        try:
            print("ready", flush=True)
            work()
        except KeyboardInterrupt:
            client.resync()
        before = client.sim_time
        client.step(5)
        print(before >= 0.02, round(client.sim_time - before, 6), flush=True)
"""

ASYNCHRONOUS = """
import asyncio, signal
from urlab_client.aio import URLabClient

async def step_on(client):
    while True:
        await client.step()

async def main():
    async with URLabClient("sim://arm", step_mode="direct") as client:
        await client.discover()
        await client.step(10)
        task = asyncio.current_task()
        asyncio.get_running_loop().add_signal_handler(signal.SIGINT, task.cancel)
        for work in (lambda client: asyncio.sleep(600), step_on):
            try:
                print("ready", flush=True)
                await work(client)
            except asyncio.CancelledError:
                task.uncancel()
                await client.resync()
            before = client.sim_time
            await client.step(5)
            print(before >= 0.02, round(client.sim_time - before, 6), flush=True)

asyncio.run(main())
"""


@pytest.mark.parametrize("program", [BLOCKING, ASYNCHRONOUS], ids=["blocking", "asynchronous"])
def test_the_simulation_goes_on_where_it_was(program: str) -> None:
    with Terminal(program) as terminal:
        for _ in ("between calls", "during a call"):
            assert terminal.line() == "ready"
            terminal.press_ctrl_c()
            assert terminal.line() == "True 0.01"
        assert terminal.end() == (0, "", "")


async def test_the_server_is_in_no_group_that_a_terminal_signals() -> None:
    async with urlab_client.aio.URLabClient("sim://ball") as client:
        await client.discover()
        server = client._transport._process.pid  # type: ignore[attr-defined]
        assert os.getsid(server) == os.getpgid(server) == server


def test_nor_is_any_other_process_that_clients_and_servers_start() -> None:
    package = Path(urlab_client.__file__).parent
    starts: list[str] = []
    parts = ("_platform", "_sandbox", "aio", "server", "simulation")
    for file in sorted(file for part in parts for file in package.glob(f"{part}/**/*.py")):
        text = file.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text if "subprocess" in text else "")):  # parsing takes long
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                name = ast.unparse(node.func)
                if name in {"subprocess.run", "subprocess.Popen", "asyncio.create_subprocess_exec"}:
                    starts.append(name)
                    unpacked = {ast.unparse(keyword.value) for keyword in node.keywords if keyword.arg is None}
                    assert "APART" in unpacked, f"{file}:{node.lineno}"
    assert len(starts) >= 3
