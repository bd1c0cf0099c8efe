"""Every op against every fault: the call ends in time with an error of its kind, and the next call works.

CI takes one fault for each op, so that each op and each fault has its turn; `URLAB_LONG_TESTS=1` takes them all.
"""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from ports import free_port
from samples import filled
from scripted import meta_ok
from waiting import DEADLINE_S, in_time, until

from urlab_client.aio import URLabClient, launch
from urlab_client.errors import (
    ClientClosed,
    NoActiveManager,
    OutcomeUnknown,
    ProtocolError,
    URLabTimeoutError,
)
from urlab_client.protocol.base import Effect
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.registry import OPS

LONG = bool(os.environ.get("URLAB_LONG_TESTS"))
SOME = list(OPS) if LONG else ["hello", "step", "reset", "spawn_actor", "recording_start", "list_keyframes"]
FAULTS = ["cancelled", "timed out", "truncated", "garbage"]
PAIRS = [(fault, name) for i, name in enumerate(OPS) for j, fault in enumerate(FAULTS) if LONG or (i + j) % 4 == 0]


async def arrived(scripted: Any, op: str) -> None:
    await asyncio.to_thread(scripted.request, op)


@pytest.mark.parametrize(("fault", "name"), PAIRS)
async def test_the_call_after_a_fault_works(client: Any, scripted: Any, fault: str, name: str) -> None:
    op, answer = OPS[name], encode_reply(filled(OPS[name].reply))
    scripted.on("meta", meta_ok(op.dialects[0]))
    await client.discover()
    scripted.on(name, {"truncated": answer[:-1], "garbage": b"\xc1" * 40}.get(fault))
    call = asyncio.create_task(client.call(filled(op.request), timeout=0.02 if fault == "timed out" else DEADLINE_S))
    if fault == "cancelled":
        await arrived(scripted, name)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
    else:
        with pytest.raises(URLabTimeoutError if fault == "timed out" else ProtocolError):
            await in_time(DEADLINE_S, call)
    other = OPS["list_actors" if name == "current_level" else "current_level"]
    scripted.on(other.name, encode_reply(filled(other.reply)))
    assert type(await client.call(filled(other.request))) is other.reply
    scripted.on(name, answer)
    assert type(await client.call(filled(op.request))) is op.reply


@pytest.mark.parametrize("name", SOME)
async def test_a_server_that_dies_with_the_request_and_comes_back(client: Any, scripted: Any, name: str) -> None:
    op, answer = OPS[name], encode_reply(filled(OPS[name].reply))
    scripted.on("meta", meta_ok(op.dialects[0]))
    await client.discover()
    scripted.on(name, None)
    call = asyncio.create_task(client.call(filled(op.request), timeout=DEADLINE_S))
    await arrived(scripted, name)
    await asyncio.to_thread(scripted.close)
    reborn = type(scripted)(scripted.port)
    reborn.on(name, answer)
    try:
        if op.effect is Effect.READ:
            assert type(await in_time(DEADLINE_S, call)) is op.reply
        else:
            with pytest.raises(OutcomeUnknown):
                await in_time(DEADLINE_S, call)
            assert type(await client.call(filled(op.request))) is op.reply
    finally:
        await asyncio.to_thread(reborn.close)


async def test_closing_while_the_server_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "_STOP_S", 2.0)
    client = URLabClient("sim://arm", step_mode="direct")
    await client.discover()
    pid = client._transport._process.pid  # type: ignore[attr-defined]
    pending = asyncio.create_task(client.step(timeout=None))
    reading = asyncio.create_task(client.state_stream("all").receive(timeout=None))
    os.kill(pid, signal.SIGSTOP)
    await in_time(4, client.close())
    with pytest.raises(ClientClosed):
        await reading
    with pytest.raises(ClientClosed):
        await pending
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


async def test_nothing_is_left_of_many_clients(scripted: Any) -> None:
    def left() -> tuple[int, int]:
        gc.collect()
        return threading.active_count(), len(list(Path("/proc/self/fd").iterdir()))

    async def use() -> None:
        address = f"tcp://127.0.0.1:{scripted.port}"
        async with URLabClient(address, local_model=False, state_port=free_port()) as client:
            await client.discover()
            client.events()
            with pytest.raises(URLabTimeoutError):
                await client.state_stream().receive(timeout=0.01)
        await client.close()

    await use()
    threads, files = left()
    for _ in range(10):
        await use()
    # The server's ends of the connections are among the files, and it closes them when it comes to that.
    await until(lambda: (now := left())[0] <= threads and now[1] <= files)


async def test_what_an_older_session_is_refused_says_nothing_about_the_present_one(client: Any, scripted: Any) -> None:
    """A handshake that was given up opens a session all the same, perhaps while another call of the old one travels."""
    hello = scripted.answers["hello"]({}) | {"manager_present": True}
    scripted.on("hello", hello)
    await client.discover()
    events = client.events()
    scripted.on("hello", None)
    scripted.on("current_level", None)
    given_up = asyncio.create_task(client.discover())
    await until(lambda: scripted.held.qsize() == 1)
    given_up.cancel()
    await asyncio.wait((given_up,))
    travelling = asyncio.create_task(client.scene.current_level())
    await until(lambda: scripted.held.qsize() == 2)
    scripted.release(hello | {"session_id": "second"})
    await until(lambda: client.session_id == "second")
    scripted.release({"op": "error", "code": "no_active_manager", "message": "play of the old session has ended"})
    with pytest.raises(NoActiveManager):
        await travelling
    assert client.manager_present
    assert "PlayEnded" not in [type(event).__name__ for event in iter(events.receive_nowait, None)]
