"""Requests over shared memory, against a server that behaves like the plugin and whose every answer a test dictates."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plugin_memory import PluginMemory
from samples import sample
from shm_clients import shared, shm_clients
from waiting import DEADLINE_S, attempts, gives_up, pass_time, until

from urlab_client._platform.windows import NamedEvent
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import shm as shm_transport
from urlab_client.aio.transport import shm_channel
from urlab_client.errors import (
    ProtocolError,
    SessionTakenOver,
    URLabConnectionError,
    URLabRPCError,
    URLabTimeoutError,
)
from urlab_client.protocol import shm
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.messages.runtime import ReadMocapPose, SetQpos
from urlab_client.protocol.registry import OPS

SESSION = "11111111-2222-3333-4444-555555555555"
STEP = {"op": "step_ok", "time": 0.5, "step": 1.0, "per_articulation": {}}


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return tmp_path / "live"


@pytest.fixture
def plugin(scripted: Any, directory: Path) -> Any:
    hello = scripted.answers["hello"]({}) | {
        "manager_present": True,
        "shm_session_dir": str(directory.parent / SESSION),
        "session_id": SESSION,
    }
    scripted.on("hello", hello)
    scripted.on("step", STEP)
    scripted.on("set_paused", lambda request: {"op": "set_paused_ok", "paused": request["paused"]})
    memory = PluginMemory(directory, scripted.answers, session_id=SESSION)
    yield memory
    memory.close()


@pytest.fixture
async def connect(scripted: Any, plugin: PluginMemory) -> AsyncIterator[Callable[..., URLabClient]]:
    async with shm_clients(scripted.port) as connect:
        yield connect


async def test_a_step_goes_over_shared_memory_once_its_size_is_known(connect: Any, plugin: PluginMemory) -> None:
    client = await shared(connect())
    assert plugin.seen == []
    for _ in range(3):
        reply = await client.step()
        assert reply.time == 0.5
    assert plugin.seen == ["step"] * 3
    stats = client.transport_stats
    assert stats.over_shm == 3
    assert stats.over_zmq == {"handshake": 2, "size of the reply not known yet": 1}
    assert stats.sent == stats.received == 6


async def test_editor_ops_pictures_and_open_ended_replies_stay_on_zmq(
    connect: Any, plugin: PluginMemory, scripted: Any
) -> None:
    scripted.on("get_contacts", {"op": "get_contacts_ok", "n_contacts": 0, "truncated": False, "contacts": []})
    scripted.on("clear_markers", {"op": "clear_markers_ok"})
    scripted.on("set_mode", {"op": "set_mode_ok", "previous_mode": "direct", "current_mode": "direct"})
    client = await shared(connect(step_mode="direct"))
    await client.debug.clear_markers()
    await client.runtime.get_contacts()
    await client.step(include_cameras=True)
    assert plugin.seen == ["set_mode"]
    assert client.transport_stats.over_zmq == {
        "handshake": 2,
        "size of the reply not known yet": 1,
        "editor op": 1,
        "reply may be too large": 1,
        "pictures": 1,
    }


async def test_a_large_state_stays_on_zmq_from_the_start(connect: Any, plugin: PluginMemory, scripted: Any) -> None:
    many = {"op": "step_ok", "time": 0.5, "step": 1.0, "per_articulation": {}, "padding": "x" * 200_000}
    scripted.on("step", many)
    client = await shared(connect())
    await client.step()
    assert plugin.seen == []
    assert client.transport_stats.over_zmq["reply may be too large"] == 1


async def test_a_request_larger_than_the_slot_goes_over_zmq(scripted: Any, tmp_path: Path, connect: Any) -> None:
    small = PluginMemory(tmp_path / "small", scripted.answers, session_id=SESSION, stride=200)
    scripted.on(
        "set_qpos",
        {
            "op": "set_qpos_ok",
            "target": "a",
            "actor_name": "a",
            "actor_id": "",
            "qpos": [0.0],
            "free_base_shortcut": False,
        },
    )
    client = connect(shm_dir=str(tmp_path / "small"))
    await client.discover()
    await client.call(SetQpos(target="a", qpos=np.zeros(100)))
    assert client.transport_stats.over_zmq["request too large"] == 1
    assert small.seen == []
    small.close()


async def test_wrong_transport_is_repeated_once_and_remembered(
    connect: Any, plugin: PluginMemory, scripted: Any
) -> None:
    over_zmq = scripted.answers["set_paused"]
    refusal = {"op": "error", "code": "wrong_transport", "message": "op 'set_paused' is not served here"}
    plugin.answers = plugin.answers | {"set_paused": lambda _: refusal}
    assert scripted.answers["set_paused"] is over_zmq
    client = await shared(connect())
    for paused in (True, False):
        assert await client.runtime.set_paused(paused) is paused
    assert plugin.seen == ["set_paused"]
    assert client.transport_stats.over_zmq["refused by the server"] == 2


async def test_a_reply_that_turned_out_too_large_is_asked_for_again_only_if_that_changes_nothing(
    connect: Any, plugin: PluginMemory, scripted: Any
) -> None:
    """Generation 2 statement 57."""
    pose = {"op": "read_mocap_pose_ok", "body": "b", "pos": [0.0] * 3, "quat": [1.0, 0.0, 0.0, 0.0]}
    scripted.on("read_mocap_pose", pose)
    too_large = {"op": "error", "code": "reply_too_large", "message": "the reply does not fit"}
    plugin.answers = plugin.answers | {"read_mocap_pose": lambda _: too_large, "set_paused": lambda _: too_large}
    client = await shared(connect())
    assert (await client.call(ReadMocapPose(body="b"))).body == "b"
    with pytest.raises(URLabRPCError, match="reply_too_large"):
        await client.runtime.set_paused(True)
    asked = [scripted.request()["op"]]
    while asked[-1] != "read_mocap_pose":
        asked.append(scripted.request()["op"])
    await client.meta()
    while asked[-1] != "meta":
        asked.append(scripted.request()["op"])
    assert "set_paused" not in asked, "it was executed already"
    assert plugin.seen == ["read_mocap_pose", "set_paused"]


def shm_rpc(directory: Path) -> dict[str, Any]:
    """What a handshake says of regions in a directory."""
    names = {f"{end}_path": str(directory / f"{end}.shm") for end in ("req", "rep")}
    return {"session": "live_p5559_7", **names, "req_stride": 1048576.0, "rep_stride": 1048576.0, "n_buffers": 2.0}


async def test_regions_are_where_the_handshake_says(
    connect: Any, plugin: PluginMemory, scripted: Any, directory: Path, tmp_path: Path
) -> None:
    """Generation 2 statement 58."""
    hello = scripted.answers["hello"]({})
    scripted.on("hello", hello | {"shm_session_dir": str(tmp_path / "elsewhere"), "shm_rpc": shm_rpc(directory)})
    client = await shared(connect())
    await client.step()
    assert plugin.seen == ["step"]
    for strange in ("req.shm", "", str(directory / ".." / "req.shm")):
        scripted.on("hello", hello | {"shm_rpc": shm_rpc(directory) | {"req_path": strange}})
        with pytest.raises(ProtocolError, match="shm_rpc"):
            await client.discover()


async def test_events_are_called_as_the_handshake_says(
    connect: Any, plugin: PluginMemory, scripted: Any, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []

    class Recorded(NamedEvent):
        def __init__(self, name: str, *, create: bool = False) -> None:
            opened.append(name)
            super().__init__(name, create=create)

    monkeypatch.setattr(shm_channel, "NamedEvent", Recorded)
    hello = scripted.answers["hello"]({})
    events = {"req_event": "Local\\lab_asked", "rep_event": "Local\\lab_answered"}
    for told in (events, {}):
        scripted.on("hello", hello | {"shm_rpc": shm_rpc(directory) | told})
        client = await shared(connect())
        await client.step()
        await client.close()
    derived = [f"Local\\URLab_{directory.name}_{end}_ready" for end in ("req", "rep")]
    assert opened == [*events.values(), *derived]


async def test_a_late_reply_is_not_taken_for_the_next_one(connect: Any, plugin: PluginMemory, scripted: Any) -> None:
    client = await shared(connect())
    scripted.on("step", None)
    with pytest.raises(URLabTimeoutError, match="may still be executed"):
        await client.step(timeout=0.05)
    await until(plugin.held.qsize)  # the next request would take its place
    plugin.reply(STEP | {"time": 99.0})  # at last
    scripted.on("step", STEP | {"time": 0.75})
    for _ in range(5):
        assert (await client.step()).time == 0.75
    assert plugin.seen == ["step"] * 6
    assert plugin.held.qsize() == 1, "it was sent once"


async def test_a_refusal_of_somebody_elses_session_does_not_make_the_channel_clean(
    connect: Any, plugin: PluginMemory, scripted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = await shared(connect())
    scripted.on("step", None)
    with pytest.raises(URLabTimeoutError, match="may still be executed"):
        await client.step(timeout=0.05)
    await until(plugin.held.qsize)
    scripted.on("step", STEP | {"time": 0.75})
    sent = client.transport_stats.over_shm
    monkeypatch.setattr(shm_channel, "_ASK_AGAIN_S", 0.01)
    refusal = {"op": "error", "code": "session_expired", "message": f"session '{SESSION}' is not active"}
    with monkeypatch.context() as silent:
        silent.setattr(plugin, "_answer", lambda _: None)
        for arrives in (refusal, STEP | {"time": 99.0}, refusal):
            with pytest.raises(URLabTimeoutError, match="must not overtake"):
                await client.step(timeout=0.05)
            plugin.reply(arrives)
        with pytest.raises(URLabTimeoutError, match="must not overtake"):
            await client.step(timeout=0.05)
    assert client.transport_stats.over_shm == sent
    assert (await client.step()).time == 0.75
    assert client.transport_stats.over_shm == sent + 1


async def test_a_cancelled_step_leaves_no_reply_behind(connect: Any, plugin: PluginMemory, scripted: Any) -> None:
    client = await shared(connect())
    scripted.on("step", None)
    task = asyncio.create_task(client.step(timeout=None))
    await asyncio.to_thread(plugin.held.get)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    scripted.on("step", STEP | {"time": 0.75})
    plugin.reply(STEP | {"time": 99.0})
    sent = client.transport_stats.over_shm
    for _ in attempts("nothing went over shared memory"):
        assert (await client.step()).time == 0.75
        if client.transport_stats.over_shm > sent:
            break


async def test_a_reply_to_something_else_is_dropped(connect: Any, plugin: PluginMemory, scripted: Any) -> None:
    client = await shared(connect())
    scripted.on("step", None)
    task = asyncio.create_task(client.step())
    await asyncio.to_thread(plugin.held.get)
    plugin.reply({"op": "set_paused_ok", "paused": True})
    await until(lambda: client.transport_stats.late)
    plugin.reply(STEP | {"time": 0.25})
    assert (await task).time == 0.25


async def test_a_real_refusal_is_raised(connect: Any, plugin: PluginMemory) -> None:
    client = await shared(connect())
    plugin.session_id = "another"
    with pytest.raises(SessionTakenOver):
        await client.step()


async def test_what_a_dead_client_left_behind_is_waited_out(
    connect: Any, plugin: PluginMemory, scripted: Any, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shm_transport, "_SETTLE_S", 0.0)
    busy, done = threading.Event(), threading.Event()

    def be_slow(request: dict[str, Any]) -> dict[str, Any]:
        busy.set()
        done.wait(DEADLINE_S)
        return STEP | {"time": 99.0}

    # The worker is still busy with the dead client's step while the next client says hello, and begins to step.
    plugin.answers = scripted.answers | {"step": be_slow}
    plugin._period = 0.02  # so that one reply is there for a while before the next one
    plugin.requests.region.publish(b"\x82\xa2op\xa4step\xaasession_id\xd9\x24" + SESSION.encode())
    await asyncio.to_thread(busy.wait)
    plugin.answers = scripted.answers
    client = await shared(connect())
    asyncio.get_running_loop().call_later(0.05, done.set)
    over_shm = client.transport_stats.over_shm
    for _ in attempts("nothing went over shared memory"):
        assert (await client.step()).time == 0.5
        if done.is_set() and client.transport_stats.over_shm > over_shm:
            break


async def test_the_second_client_uses_zmq_until_the_first_has_gone(connect: Any, plugin: PluginMemory) -> None:
    first = await shared(connect())
    second = await shared(connect())
    await second.step()
    assert second.transport_stats.over_shm == 0
    assert second.transport_stats.over_zmq["regions in use by another client"] >= 2
    await first.step()
    assert first.transport_stats.over_shm == 1
    await first.close()
    await second.discover()
    await second.step()
    await second.step()
    assert second.transport_stats.over_shm >= 1


@pytest.mark.parametrize("file", [shm.REQUEST_FILE, shm.REPLY_FILE])
async def test_missing_regions_are_named(connect: Any, directory: Path, file: str) -> None:
    (directory / file).unlink()
    with pytest.raises(URLabConnectionError, match=f"live/{file}.*{SESSION}/{file}"):
        await connect().discover()


async def test_an_explicit_directory_wins(connect: Any, plugin: PluginMemory, tmp_path: Path, scripted: Any) -> None:
    elsewhere = PluginMemory(tmp_path / "elsewhere", scripted.answers, session_id=SESSION)
    client = await shared(connect(shm_dir=str(tmp_path / "elsewhere")))
    await client.step()
    assert (elsewhere.seen, plugin.seen) == (["step"], [])
    elsewhere.close()


HOSTILE = {
    "empty": b"",
    "short": b"URLB" + bytes(20),
    "not written yet": bytes(4096),
    "another magic": b"ELF\0" + bytes(4096),
    "huge stride": shm.HEADER.pack(shm.MAGIC, 1, 0xFFFFFFFF, 2, 0, 0) + bytes(4096),
    "no slots": shm.HEADER.pack(shm.MAGIC, 1, 64, 1, 0, 0) + bytes(4096),
    "slot out of range": shm.HEADER.pack(shm.MAGIC, 1, 64, 2, 5, 7) + bytes(4096),
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE)
async def test_a_file_that_is_no_region_is_refused(connect: Any, directory: Path, content: bytes) -> None:
    (directory / shm.REPLY_FILE).unlink()
    (directory / shm.REPLY_FILE).write_bytes(content)
    client = connect()
    with pytest.raises(URLabConnectionError, match=r"rep\.shm"):
        await client.discover()
    assert client.connected


async def test_a_pipe_in_place_of_a_region_is_refused(connect: Any, directory: Path) -> None:
    (directory / shm.REPLY_FILE).unlink()
    os.mkfifo(directory / shm.REPLY_FILE)
    with pytest.raises(URLabConnectionError, match="not a file"):
        await connect().discover()


async def test_a_region_cut_off_between_two_requests(connect: Any, plugin: PluginMemory, directory: Path) -> None:
    client = await shared(connect())
    await client.step()
    os.truncate(directory / shm.REPLY_FILE, 100)
    await client.step()
    assert client.transport_stats.over_zmq["no usable regions"] == 1


async def test_a_damaged_reply_region_is_an_error_and_then_left_alone(
    connect: Any, plugin: PluginMemory, scripted: Any
) -> None:
    client = await shared(connect())
    scripted.on("step", None)
    task = asyncio.create_task(client.step())
    await asyncio.to_thread(plugin.held.get)
    region = plugin.replies.region
    region._latest[0] = 9
    region._sequence[0] += 1
    with pytest.raises(ProtocolError, match="latest_idx is 9"):
        await task
    scripted.on("step", STEP)
    assert (await client.step()).time == 0.5


async def test_regions_made_anew_are_found(connect: Any, plugin: PluginMemory, directory: Path, scripted: Any) -> None:
    client = await shared(connect())
    await client.step()
    for file in (shm.REQUEST_FILE, shm.REPLY_FILE):
        (directory / file).unlink()
    again = PluginMemory(directory, scripted.answers, session_id=SESSION)
    await client.discover()
    await client.step()
    await client.step()
    assert again.seen == ["step"]
    again.close()


async def test_a_directory_without_shm_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="shm_dir"):
        URLabClient("tcp://127.0.0.1", shm_dir="/tmp")


@pytest.mark.parametrize("fault", ["cancelled", "timed out"])
@pytest.mark.parametrize("behind", ["current_level", "set_paused"])
async def test_nothing_overtakes_an_abandoned_request_in_shared_memory(
    connect: Any, plugin: PluginMemory, scripted: Any, behind: str, fault: str
) -> None:
    begun, done = threading.Event(), threading.Event()

    def step(_: dict[str, Any]) -> dict[str, Any] | None:
        begun.set()
        return STEP if done.wait(DEADLINE_S) else None

    client = await shared(connect())
    scripted.on("current_level", encode_reply(sample(OPS["current_level"].reply)))
    plugin.answers = plugin.answers | {"step": step}
    await gives_up(client.step, begun.is_set, fault)
    sent, asked = client.transport_stats.sent, plugin.requests.region.sequence
    with pytest.raises(URLabTimeoutError, match="must not overtake"):
        await client.scene.current_level(timeout=0.01)
    assert client.transport_stats.sent == sent
    call = client.scene.current_level() if behind == "current_level" else client.runtime.set_paused(True)
    later = asyncio.create_task(call)
    await until(lambda: later.done() or plugin.requests.region.sequence > asked)
    assert client.transport_stats.sent == sent, f"{behind} went ahead"
    done.set()
    await later
    assert plugin.seen == ["step", *(["set_paused"] if behind == "set_paused" else [])]


@pytest.mark.parametrize("fault", ["cancelled", "timed out"])
async def test_nothing_overtakes_an_abandoned_request_on_zmq(
    connect: Any, plugin: PluginMemory, scripted: Any, fault: str
) -> None:
    client = await shared(connect())
    scripted.on("current_level", None)
    await gives_up(client.scene.current_level, scripted.held.qsize, fault)
    assert plugin.seen == []
    await client.step()  # behind it, the same way
    assert plugin.seen == []
    assert client.transport_stats.over_zmq["behind an abandoned request"] == 1
    await client.step()  # the server has got past it
    assert plugin.seen == ["step"]


async def test_regions_that_nothing_reads_any_more_are_given_up(
    connect: Any, plugin: PluginMemory, scripted: Any
) -> None:
    client = await shared(connect())
    plugin.stop()
    await gives_up(client.step, lambda: client.transport_stats.over_shm, "cancelled")
    call = asyncio.create_task(client.step())
    await until(lambda: client.transport_stats.over_shm == 1)
    pass_time(shm_transport._DEAD_S)
    assert (await call).time == 0.5
