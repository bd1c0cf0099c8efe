"""Shared memory when things go wrong between the two sides: a user notices an error that says so, or nothing."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from plugin_memory import PluginMemory
from shm_clients import shared, shm_clients
from waiting import DEADLINE_S, until
from written_region import WrittenRegion

from urlab_client._platform.processors import processor_fence
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import shm as shm_transport
from urlab_client.errors import OutcomeUnknown, URLabConnectionError
from urlab_client.protocol import shm

SESSION = "11111111-2222-3333-4444-555555555555"
STEP = {"op": "step_ok", "time": 0.5, "step": 1.0, "per_articulation": {}}


@pytest.fixture
def directory() -> Iterator[Path]:
    """A short path: Unix sockets have room for about a hundred bytes."""
    with tempfile.TemporaryDirectory(prefix="urlab-test-", dir="/tmp" if os.name == "posix" else None) as base:
        yield Path(base) / "live"


@pytest.fixture
def answers(scripted: Any, directory: Path) -> dict[str, Any]:
    hello = scripted.answers["hello"]({}) | {
        "manager_present": True,
        "shm_session_dir": str(directory),
        "session_id": SESSION,
    }
    scripted.on("hello", hello)
    scripted.on("step", STEP)
    return scripted.answers


@pytest.fixture
def plugin(answers: dict[str, Any], directory: Path) -> Iterator[PluginMemory]:
    memory = PluginMemory(directory, answers, session_id=SESSION)
    yield memory
    memory.close()


@pytest.fixture
def silent(answers: dict[str, Any], directory: Path) -> Iterator[tuple[WrittenRegion, WrittenRegion]]:
    """Request and reply region of a server that never answers over shared memory."""
    directory.mkdir()
    regions = [WrittenRegion(directory / file, shm.RPC_STRIDE) for file in (shm.REQUEST_FILE, shm.REPLY_FILE)]
    yield regions[0], regions[1]
    for region in regions:
        region.close()


@pytest.fixture
async def connect(scripted: Any, answers: dict[str, Any]) -> AsyncIterator[Callable[..., URLabClient]]:
    async with shm_clients(scripted.port) as connect:
        yield connect


async def step_in_flight(client: URLabClient, plugin: PluginMemory, **options: Any) -> asyncio.Task[Any]:
    plugin.answers = plugin.answers | {"step": lambda _: None}
    task = asyncio.create_task(client.step(**options))
    await asyncio.to_thread(plugin.held.get, timeout=DEADLINE_S)
    return task


async def test_a_server_that_is_lost_while_a_session_opens_is_no_puzzle(
    connect: Any, scripted: Any, silent: tuple[WrittenRegion, WrittenRegion]
) -> None:
    requests, _ = silent
    client = connect()
    opening = asyncio.create_task(client.discover())
    await until(lambda: requests.region.sequence, look=0)  # the client asks whether an old reply is still to come
    await asyncio.to_thread(scripted.close)
    await until(lambda: not client.connected)
    with contextlib.suppress(URLabConnectionError):
        await opening
    with pytest.raises(URLabConnectionError):
        await client.step(timeout=0.5)


async def test_a_reply_region_damaged_while_a_session_opens_leaves_zmq(
    connect: Any, silent: tuple[WrittenRegion, WrittenRegion]
) -> None:
    requests, replies = silent
    client = connect()
    opening = asyncio.create_task(client.discover())
    await until(lambda: requests.region.sequence, look=0)
    replies.region._latest[0] = 9
    replies.region._sequence[0] += 1
    await opening
    assert (await client.step()).time == 0.5
    assert client.transport_stats.over_zmq["no usable regions"] == 1


async def test_a_client_closed_while_its_session_opens_gives_the_regions_back(
    connect: Any, plugin: PluginMemory, directory: Path
) -> None:
    (directory / shm.REPLY_FILE).rename(directory / "later")
    client = connect()
    opening = asyncio.create_task(client.discover())
    await until(lambda: client.connected, look=0)
    await until(lambda: client.transport_stats.received == 2, look=0)  # now it waits for the file
    await client.close()
    (directory / "later").rename(directory / shm.REPLY_FILE)
    await asyncio.gather(opening, return_exceptions=True)
    other = await shared(connect())
    await other.step()
    assert other.transport_stats.over_shm == 1


async def test_opening_a_session_does_not_disturb_a_step_of_another_task(
    connect: Any, plugin: PluginMemory, scripted: Any
) -> None:
    plugin._period = 5e-3  # so that requests are under way most of the time
    client = await shared(connect())
    answering = plugin.answers
    for _ in range(15):
        abandoned = await step_in_flight(client, plugin)
        abandoned.cancel()
        await asyncio.gather(abandoned, return_exceptions=True)
        plugin.answers = answering
        opening = asyncio.create_task(client.discover())
        while not opening.done():
            assert (await client.step()).time == 0.5
        await opening


async def test_no_memory_of_a_lost_server_is_touched(
    connect: Any, plugin: PluginMemory, answers: dict[str, Any], scripted: Any, directory: Path
) -> None:
    camera = {
        "mode": "real",
        "resolution": [2, 2],
        "fovy": 45.0,
        "zmq_endpoint": "tcp://127.0.0.1:9",
        "zmq_topic": "arm/camera/eye",
    }
    arm = {
        "prefix": "arm",
        "actor_id": "",
        "default_control_mode": "raw",
        "actuator_types": {},
        "original_names": {},
        "camera_topics": {"eye": camera},
    }
    scripted.on("hello", answers["hello"]({}) | {"articulations": [arm]})
    region = WrittenRegion(directory / "cam_arm_eye.shm", shm.camera_stride(2, 2))
    region.publish(bytes(16))
    client = await shared(connect())
    eye = client.articulations["arm"].cameras["eye"]
    async with eye.frames() as frames:
        await frames.receive(timeout=DEADLINE_S)
        frame = eye.shared_frame()
        assert frame is not None
        assert frame.valid()
        await asyncio.to_thread(scripted.close)
        await until(lambda: not client.connected, look=0)
        assert not frame.valid()
        assert eye.shared_frame() is None, "its files are there, as a killed server leaves them"
    region.close()


async def test_a_server_lost_during_a_step_is_noticed_before_the_deadline(
    connect: Any, plugin: PluginMemory, scripted: Any
) -> None:
    client = await shared(connect())
    task = await step_in_flight(client, plugin, timeout=None)
    await asyncio.to_thread(scripted.close)
    async with asyncio.timeout(DEADLINE_S):
        with pytest.raises(OutcomeUnknown):
            await task
    with pytest.raises(URLabConnectionError):
        await client.step(timeout=0.5)


async def test_regions_removed_during_a_step_are_noticed_before_the_deadline(
    connect: Any, plugin: PluginMemory, directory: Path
) -> None:
    client = await shared(connect())
    task = await step_in_flight(client, plugin, timeout=None)
    for file in (shm.REQUEST_FILE, shm.REPLY_FILE):
        (directory / file).unlink()
    async with asyncio.timeout(DEADLINE_S):
        with pytest.raises(OutcomeUnknown):
            await task
    assert (await client.step()).time == 0.5


async def test_a_doorbell_that_never_rings_delays_a_reply_and_no_more(
    connect: Any, plugin: PluginMemory, directory: Path
) -> None:
    with socket.socket(socket.AF_UNIX) as deaf:  # a server without a descriptor left cannot let anybody in
        deaf.bind(os.fspath(directory / "doorbell.sock"))
        deaf.listen()
        client = await shared(connect())
        task = await step_in_flight(client, plugin, timeout=None)
        plugin.reply(STEP | {"time": 0.75})
        async with asyncio.timeout(DEADLINE_S):
            assert (await task).time == 0.75


async def test_a_doorbell_that_hangs_up_at_once_is_done_without(
    connect: Any, plugin: PluginMemory, directory: Path
) -> None:
    with socket.socket(socket.AF_UNIX) as doorbell:
        doorbell.bind(os.fspath(directory / "doorbell.sock"))
        doorbell.listen()
        doorbell.setblocking(False)

        def turn_away() -> None:
            doorbell.accept()[0].close()

        asyncio.get_running_loop().add_reader(doorbell, turn_away)
        client = await shared(connect())
        for _ in range(3):
            assert (await client.step()).time == 0.5
        assert client.transport_stats.over_shm == 3
        asyncio.get_running_loop().remove_reader(doorbell)


async def test_a_reply_region_begun_anew_during_a_step_is_noticed_before_the_deadline(
    connect: Any, plugin: PluginMemory
) -> None:
    client = await shared(connect())
    await client.step()
    task = await step_in_flight(client, plugin, timeout=None)
    plugin.replies.region = shm.Region.lay_out(memoryview(plugin.replies._map), shm.RPC_STRIDE, fence=processor_fence())
    async with asyncio.timeout(DEADLINE_S):
        with pytest.raises(OutcomeUnknown):
            await task
    plugin.answers = plugin.answers | {"step": lambda _: STEP}
    assert (await client.step()).time == 0.5


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system cannot be asked for a file's memory")
async def test_memory_for_requests_is_there_before_they_are_written(
    connect: Any, silent: tuple[WrittenRegion, WrittenRegion], directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shm_transport, "_SETTLE_S", 0.0)
    # Writing into a hole of a file on a full tmpfs would kill the process.
    path = directory / shm.REQUEST_FILE
    header = path.read_bytes()[: shm.HEADER_SIZE]
    path.unlink()
    with path.open("wb") as file:
        file.write(header)
        file.truncate(shm.region_size(shm.RPC_STRIDE))
    assert path.stat().st_blocks * 512 < path.stat().st_size
    await connect().discover()
    assert path.stat().st_blocks * 512 >= path.stat().st_size


FORKING = """
import asyncio, os, sys
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import shm
shm._SETTLE_S = 30

async def shared(port):
    client = URLabClient(f"tcp://127.0.0.1:{port}", transport="shm", local_model=False)
    await client.discover()
    await client.step()
    await client.step()
    return client

async def main():
    port = sys.argv[1]
    first = await shared(port)
    if os.fork() == 0:
        sys.stdin.read()
        os._exit(0)
    await first.close()
    second = await shared(port)
    print(first.transport_stats.over_shm, second.transport_stats.over_shm, flush=True)
    await second.close()

asyncio.run(main())
"""


FORGETFUL = """
import asyncio, gc, sys
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import shm
shm._SETTLE_S = 30

async def main():
    client = URLabClient(f"tcp://127.0.0.1:{sys.argv[1]}", transport="shm", local_model=False)
    await client.discover()
    await client.step()
    await client.step()
    return client.transport_stats.over_shm

for _ in range(3):
    print(asyncio.run(main()), flush=True)
    gc.collect()
"""


async def printed_by(program: str, port: int, lines: int) -> list[bytes]:
    """Run a program that may wait for the end of its input, and return what it prints."""
    command = (sys.executable, "-W", "ignore", "-c", program, str(port))
    process = await asyncio.create_subprocess_exec(*command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdin is not None
    try:
        async with asyncio.timeout(2 * DEADLINE_S):
            printed = [(await process.stdout.readline()).strip() for _ in range(lines)]
            process.stdin.close()
            assert await process.wait() == 0
    except BaseException:
        process.kill()
        raise
    return printed


async def test_a_forked_child_keeps_no_regions(plugin: PluginMemory, scripted: Any) -> None:
    assert await printed_by(FORKING, scripted.port, 1) == [b"1 1"]


async def test_a_client_that_nobody_closed_keeps_nothing(plugin: PluginMemory, scripted: Any) -> None:
    assert await printed_by(FORGETFUL, scripted.port, 3) == [b"1"] * 3
