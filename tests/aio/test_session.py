"""Deadlines, lost servers and cancellation: after each of them the client tells what happened and goes on working."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Any

import pytest
import zmq
from waiting import DEADLINE_S, pass_time, until

from urlab_client.aio import URLabClient
from urlab_client.errors import (
    RPC_ERRORS,
    ClientClosed,
    ConnectionLost,
    OutcomeUnknown,
    ProtocolError,
    ServerUnreachable,
    SessionTakenOver,
    URLabRPCError,
    URLabTimeoutError,
)
from urlab_client.protocol.messages.session import Step
from urlab_client.types import Verdict

PAUSED = {"op": "set_paused_ok", "paused": True}
LEVEL = {"op": "current_level_ok", "level_path": "/Game/Levels/lab"}


async def discovered(client: Any, scripted: Any) -> None:
    await client.discover()
    assert [scripted.request()["op"] for _ in range(2)] == ["hello", "meta"]


async def expired(client: URLabClient, call: Any, sent: Callable[[], object]) -> asyncio.Task[Any]:
    """Let a call's deadline pass once its request has left and `sent` says so; return the call."""
    before = client.transport_stats.sent
    pending = asyncio.create_task(call)
    await until(lambda: client.transport_stats.sent > before and sent())
    pass_time(DEADLINE_S)
    await asyncio.wait((pending,))
    return pending


async def met(client: URLabClient, obstacle: str) -> None:
    """Try to connect until it is known what stands in the way."""
    trying = asyncio.create_task(client.meta(timeout=None))
    await until(lambda: obstacle in client._transport._obstacle)  # type: ignore[attr-defined]
    trying.cancel()
    await asyncio.wait((trying,))


async def test_refused_names_address_and_stage() -> None:
    with socket.socket() as nobody:  # has the port, and does not listen
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
        async with URLabClient("tcp://127.0.0.1", step_port=port, rcv_timeout_ms=300) as client:
            await met(client, "refused")
            with pytest.raises(
                ServerUnreachable, match=rf"tcp://127.0.0.1:{port} within \d+ ms: connection refused"
            ) as info:
                await client.discover()
    assert isinstance(info.value, ConnectionError)
    assert info.value.op == "hello"
    assert "urlab serve" in str(info.value)


async def test_a_slow_op_waits_for_a_connection_no_longer_than_a_quick_one() -> None:
    """`hello` may take 30 s to be answered, but whether somebody is there shows sooner."""
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        where = nobody.getsockname()[1]
        async with URLabClient("tcp://127.0.0.1", step_port=where, rcv_timeout_ms=2000) as client:
            calling = asyncio.create_task(client.discover())
            await until(lambda: client._transport._waiting)  # type: ignore[attr-defined]
            pass_time(2.5)
            await asyncio.wait((calling,), timeout=DEADLINE_S)
            assert calling.done()
            with pytest.raises(ServerUnreachable, match="no connection"):
                await calling


async def test_a_reply_that_came_before_the_line_broke_counts(client: Any, scripted: Any) -> None:
    """The end of a connection is told by another socket than its last reply is: both may wait when the loop looks."""
    await discovered(client, scripted)
    scripted.on("set_paused", None)
    call = asyncio.create_task(client.runtime.set_paused(True))
    await until(scripted.held.qsize)
    transport = client._transport
    scripted.release(PAUSED)
    assert transport._open.connection.socket.poll(round(1e3 * DEADLINE_S))  # the loop stands still
    transport._note(zmq.Event.DISCONNECTED, 0, None)
    assert not client.connected
    assert await call is True


async def test_something_else_listens_there() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        async with URLabClient("tcp://127.0.0.1", step_port=port, rcv_timeout_ms=300) as client:
            await met(client, "does not speak")
            with pytest.raises(ServerUnreachable, match="does not speak ZeroMQ"):
                await client.discover()


async def test_a_port_in_the_address_is_the_rpc_port(scripted: Any) -> None:
    async with URLabClient(f"tcp://127.0.0.1:{scripted.port}", local_model=False) as client:
        await client.discover()
        assert client.session_id == "11111111-2222-3333-4444-555555555555"
        assert client.connected


async def test_client_started_before_the_server_connects_when_it_comes(scripted: Any) -> None:
    port = scripted.port
    scripted.close()
    async with URLabClient("tcp://127.0.0.1", step_port=port, local_model=False) as client:
        call = asyncio.create_task(client.discover(timeout=DEADLINE_S))
        await asyncio.to_thread(_refused, port)
        reborn = type(scripted)(port)
        try:
            await call
        finally:
            reborn.close()
    assert client.session_id


def _refused(port: int) -> None:
    with socket.socket() as probe, pytest.raises(ConnectionRefusedError):
        probe.connect(("127.0.0.1", port))


async def test_silence_is_a_timeout_and_the_late_reply_is_dropped(client: Any, scripted: Any) -> None:
    await client.discover()
    call = await expired(client, client.runtime.set_paused(True, timeout=5), scripted.held.qsize)
    with pytest.raises(
        URLabTimeoutError, match=r"set_paused: no reply from .* within (49\d\d|5000) ms.*may still be executed"
    ):
        await call
    scripted.release({"op": "set_paused_ok", "paused": False})
    scripted.on("set_paused", PAUSED)
    assert await client.runtime.set_paused(True) is True
    scripted.on("current_level", LEVEL)
    assert await client.scene.current_level() == "/Game/Levels/lab"
    assert client.transport_stats.late == 1


async def test_default_timeout_comes_from_the_client(scripted: Any) -> None:
    async with URLabClient(
        "tcp://127.0.0.1", step_port=scripted.port, rcv_timeout_ms=12345, local_model=False
    ) as client:
        await client.discover()
        call = await expired(client, client.runtime.set_paused(True), lambda: True)
        with pytest.raises(URLabTimeoutError, match=r"within 1234[45] ms"):
            await call


async def test_one_timeout_covers_all_requests_of_a_handshake(client: Any, scripted: Any) -> None:
    hello = scripted.answers["hello"]
    scripted.on("hello", None)
    scripted.on("meta", None)
    call = asyncio.create_task(client.discover(timeout=DEADLINE_S))
    await until(scripted.held.qsize)
    pass_time(0.9 * DEADLINE_S)
    scripted.release(hello({}))
    await until(scripted.held.qsize)  # the second request, with what the first has left
    pass_time(0.2 * DEADLINE_S)
    with pytest.raises(URLabTimeoutError, match="meta: no reply"):
        async with asyncio.timeout(0.4 * DEADLINE_S):  # and not as long again
            await call


async def test_cancelled_call_leaves_the_client_usable(client: Any, scripted: Any) -> None:
    await client.discover()
    call = asyncio.create_task(client.runtime.set_paused(True))
    await asyncio.to_thread(scripted.held.get, timeout=DEADLINE_S)
    call.cancel()
    with pytest.raises(asyncio.CancelledError):
        await call
    scripted.on("set_paused", PAUSED)
    assert await client.runtime.set_paused(True) is True


async def test_users_own_timeout_works(client: Any, scripted: Any) -> None:
    await client.discover()
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.05):
            await client.runtime.set_paused(True, timeout=None)
    scripted.on("set_paused", PAUSED)
    assert await client.runtime.set_paused(True) is True


async def test_calls_of_several_tasks_go_one_at_a_time(client: Any, scripted: Any) -> None:
    scripted.on("set_sim_speed", lambda request: {"op": "set_sim_speed_ok", "percent": request["percent"]})
    await client.discover()
    speeds = [float(percent) for percent in range(5, 55)]
    assert await asyncio.gather(*(client.runtime.set_sim_speed(percent) for percent in speeds)) == speeds


async def test_calls_one_after_the_other_leave_other_tasks_their_turns(client: Any, scripted: Any) -> None:
    scripted.on("set_paused", PAUSED)
    await client.discover()
    turns = 0

    async def count() -> None:
        nonlocal turns
        while True:
            await asyncio.sleep(0)
            turns += 1

    counting = asyncio.create_task(count())
    for _ in range(100):
        await client.runtime.set_paused(True)
    counting.cancel()
    assert turns >= 99  # in the first turn it only begins to count


async def test_a_play_state_that_nobody_tells_is_a_finding(client: Any, scripted: Any) -> None:
    await discovered(client, scripted)
    scripted.on("pie_status", None)
    call = await expired(client, client.explain(), scripted.held.qsize)
    (play,) = [finding for finding in (await call).findings if finding.subject == "play"]
    assert play.verdict is Verdict.PROBLEM
    assert "pie_status: no reply" in play.text


async def test_a_queued_call_times_out_without_being_sent(client: Any, scripted: Any) -> None:
    await discovered(client, scripted)
    first = asyncio.create_task(client.runtime.set_paused(True, timeout=None))
    await asyncio.to_thread(scripted.request)
    with pytest.raises(URLabTimeoutError, match=r"current_level: another call held .* Nothing was sent"):
        await client.scene.current_level(timeout=0.05)
    scripted.release(PAUSED)
    assert await first is True
    assert scripted.seen.empty()


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda c: c.call(Step(), timeout=DEADLINE_S), OutcomeUnknown),
        (lambda c: c.runtime.set_paused(True, timeout=DEADLINE_S), OutcomeUnknown),
        (lambda c: c.scene.current_level(timeout=DEADLINE_S), ConnectionLost),
    ],
)
async def test_a_server_that_dies_mid_call(client: Any, scripted: Any, call: Any, error: type[Exception]) -> None:
    await discovered(client, scripted)
    pending = asyncio.create_task(call(client))
    await asyncio.to_thread(scripted.request)
    await asyncio.to_thread(scripted.close)
    await until(lambda: not client.connected)
    pass_time(DEADLINE_S)  # until then a read waits for another server
    with pytest.raises(error, match="was lost after the request was sent"):
        await pending
    assert not client.connected


async def test_a_restarted_server_is_found_again(client: Any, scripted: Any) -> None:
    await client.discover()
    await asyncio.to_thread(scripted.close)
    await until(lambda: not client.connected)
    reborn = type(scripted)(scripted.port)
    try:
        await client.discover(timeout=DEADLINE_S)
        assert client.transport_stats.connects == 2
    finally:
        await asyncio.to_thread(reborn.close)


async def test_an_expired_session_says_so_and_discover_recovers(client: Any, scripted: Any) -> None:
    await client.discover()
    scripted.on("set_paused", {"op": "error", "code": "session_expired", "message": "unknown session"})
    with pytest.raises(SessionTakenOver, match=r"discover\(\)") as info:
        await client.runtime.set_paused(True)
    assert isinstance(info.value, URLabRPCError)
    assert isinstance(info.value, ConnectionError)
    assert info.value.code == "session_expired"
    assert str(info.value).startswith("set_paused: session_expired: unknown session. Call discover() ")
    await client.discover()
    scripted.on("set_paused", PAUSED)
    assert await client.runtime.set_paused(True) is True


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"\xc1",
        b"\x93\x01\x02\x03",
        b"{",
        LEVEL,
        {"op": "set_paused_ok"},
        {"op": "set_paused_ok", "paused": "maybe"},
    ],
)
async def test_a_nonsensical_answer_is_a_protocol_error(client: Any, scripted: Any, answer: Any) -> None:
    await client.discover()
    scripted.on("set_paused", answer)
    with pytest.raises(ProtocolError, match="set_paused: the server's answer is not a valid set_paused_ok"):
        await client.runtime.set_paused(True)
    scripted.on("set_paused", PAUSED)
    assert await client.runtime.set_paused(True) is True


@pytest.mark.parametrize("code", sorted(RPC_ERRORS))
async def test_every_error_code_raises_its_class(client: Any, scripted: Any, code: str) -> None:
    await client.discover()
    scripted.on("set_paused", {"op": "error", "code": code, "message": "because"})
    with pytest.raises(RPC_ERRORS[code], match=f"set_paused: {code}: because") as info:
        await client.runtime.set_paused(True)
    assert (info.value.code, info.value.message, info.value.op) == (code, "because", "set_paused")


async def test_unknown_error_codes_stay_plain_rpc_errors(client: Any, scripted: Any) -> None:
    await client.discover()
    scripted.on("set_paused", {"op": "error", "code": "brand_new", "message": "from the future"})
    with pytest.raises(URLabRPCError, match="set_paused: brand_new: from the future") as info:
        await client.runtime.set_paused(True)
    assert type(info.value) is URLabRPCError


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda c: c.runtime.set_sim_speed("fast"), TypeError, "set_sim_speed: percent: expected `float`, got `str`"),
        (lambda c: c.scene.spawn_actor("b", "a", location=(1, 2)), ValueError, "location takes 3 numbers, got 2"),
        (lambda c: c.runtime.set_mode("fast"), ValueError, "fast"),
        (lambda c: c.runtime.set_sim_options(timestp=1), TypeError, "unknown option timestp"),
    ],
)
async def test_mistakes_are_refused_before_anything_is_sent(
    client: Any, scripted: Any, call: Any, error: type[Exception], message: str
) -> None:
    await discovered(client, scripted)
    with pytest.raises(error, match=message):
        await call(client)
    scripted.on("current_level", LEVEL)
    await client.scene.current_level()
    assert scripted.request()["op"] == "current_level"


async def test_closing_fails_what_waits_and_everything_after(client: Any, scripted: Any) -> None:
    await discovered(client, scripted)
    pending = asyncio.create_task(client.runtime.set_paused(True))
    await asyncio.to_thread(scripted.request)
    await client.close()
    await client.close()
    with pytest.raises(ClientClosed):
        await pending
    with pytest.raises(ClientClosed):
        await client.discover()


async def test_closing_fails_what_waits_for_a_server() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        client = URLabClient("tcp://127.0.0.1", step_port=nobody.getsockname()[1], rcv_timeout_ms=600_000)
        pending = asyncio.create_task(client.meta())
        await until(lambda: client._transport._waiting)  # type: ignore[attr-defined]
        await client.close()
        async with asyncio.timeout(DEADLINE_S):
            with pytest.raises(ClientClosed):
                await pending


async def test_many_clients_share_a_loop(scripted: Any) -> None:
    scripted.on("current_level", LEVEL)
    clients = [URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False) for _ in range(8)]
    levels = await asyncio.gather(*(client.scene.current_level() for client in clients))
    assert levels == ["/Game/Levels/lab"] * 8
    await asyncio.gather(*(client.close() for client in clients))


@pytest.mark.parametrize("address", ["localhost", "http://x", "tcp://", "sim://"])
def test_malformed_addresses_are_refused(address: str) -> None:
    with pytest.raises(ValueError, match=r"tcp://HOST|names no model"):
        URLabClient(address)


@pytest.mark.parametrize(
    "address",
    ["tcp://localhost:rpc", "tcp://localhost:70000", "tcp://localhost:0", "tcp://:5559", "tcp://::1", "tcp://", "lab"],
)
def test_what_is_no_address_is_refused_at_once(address: str) -> None:
    with pytest.raises(ValueError, match=r"is not a valid address; write tcp://HOST"):
        URLabClient(address)


@pytest.mark.parametrize(
    ("address", "endpoint"),
    [
        ("tcp://lab-7", "tcp://lab-7:5559"),
        ("tcp://10.0.0.7:65535", "tcp://10.0.0.7:65535"),
        ("tcp://[::1]", "tcp://[::1]:5559"),
        ("tcp://[fe80::1%eth0]:7", "tcp://[fe80::1%eth0]:7"),
        ("ipc:///tmp/lab", "ipc:///tmp/lab:5559"),
    ],
)
def test_an_address_may_have_a_port_of_its_own(address: str, endpoint: str) -> None:
    assert URLabClient(address)._transport.endpoint == endpoint
