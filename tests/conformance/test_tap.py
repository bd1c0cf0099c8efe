"""`urlab tap`: what passes through the relay, what is kept of it, and its replay."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from targets import BOT

from urlab_client.aio import URLabClient
from urlab_client.cli import main
from urlab_client.cli.tap import departures, described
from urlab_client.conformance.sessions import Passed, Ports, Relay, Replay, SessionWriter, read_session
from urlab_client.errors import URLabConnectionError, URLabError, URLabTimeoutError
from urlab_client.keys import KeyPair
from urlab_client.server import SimulatedServer

RECORDINGS = Path(__file__).resolve().parents[1] / "recordings"


class Recording(Relay):
    """A relay that keeps what passes."""

    def __init__(self, server: SimulatedServer, writer: SessionWriter) -> None:
        super().__init__(f"tcp://127.0.0.1:{server.step_port}", None, server.state_port, Ports("127.0.0.1", None))
        self._writer = writer

    def on_exchange(self, passed: Passed) -> bytes:
        self._writer.exchange(passed)
        return passed.reply

    def on_message(self, source: str, topic: bytes, payload: bytes) -> tuple[bytes, bytes]:
        self._writer.message(source, topic, payload)
        return topic, payload


async def program(port: int, state_port: int, *, picture: bool = False) -> list[np.ndarray[Any, Any]]:
    """Drive the first robot for five steps, and return its positions after each."""
    address = f"tcp://127.0.0.1:{port}"
    async with URLabClient(address, state_port=state_port, step_mode="direct", local_model=False) as client:
        await client.discover()
        robot = next(iter(client.articulations.values()))
        await client.reset()
        found: list[np.ndarray[Any, Any]] = []
        for value in (0.5, -0.5, 0.25, 0.0, 1.0):
            robot.set_ctrl({"m": value})
            cameras = {f"{robot.prefix}/cam": "sync"} if picture else {}
            reply = await client.step(include_cameras=cameras)
            found.append(reply.per_articulation[robot.prefix].qpos)
        return found


@contextmanager
def recorded(folder: Path, dialect: Any, *, images: bool = False) -> Iterator[Recording]:
    (folder / "bot.xml").write_text(BOT)
    writer = SessionWriter(folder / "session.mcap", images=images)
    try:
        served = SimulatedServer(folder / "bot.xml", dialect=dialect, play=True, camera_size=(64, 48))
        with served as server, Recording(server, writer) as relay:
            yield relay
    finally:
        writer.close()


@pytest.mark.parametrize("generation", ["alpha", "beta"])
async def test_a_recorded_session_is_replayed(generation: str, tmp_path: Path) -> None:
    with recorded(tmp_path, generation) as relay:
        live = await program(relay.port, relay.state_port)
    session = read_session(tmp_path / "session.mcap")
    with Replay(session, Ports("127.0.0.1", None)) as replay:
        again = await program(replay.port, replay.state_port)
        assert replay.unknown == {}
    assert all(map(np.array_equal, live, again))


async def test_a_client_of_a_replay_is_sent_to_its_ports(tmp_path: Path) -> None:
    """The recorded server's own would lead past it."""
    import zmq

    with recorded(tmp_path, "beta") as relay:
        await program(relay.port, relay.state_port)
    session = read_session(tmp_path / "session.mcap")
    hello = next(row for row in session if row.op == "hello")
    recorded_ports = set(re.findall(rb"tcp://[^:]+:(\d+)", hello.reply))
    with Replay(session, Ports("127.0.0.1", None)) as replay, zmq.Context() as context:
        socket = context.socket(zmq.REQ)
        socket.linger, socket.rcvtimeo = 0, 30_000
        socket.connect(f"tcp://127.0.0.1:{replay.port}")
        socket.send(hello.request)
        reply = socket.recv()
        socket.close()
        told = msgspec.msgpack.decode(reply)
        ports = set(re.findall(rb"tcp://[^:]+:(\d+)", reply))
    assert ports
    assert not ports & recorded_ports
    assert not told.keys() & {"shm_session_dir", "shm_rpc"}


async def test_the_session_in_the_repository_is_replayed() -> None:
    session = read_session(RECORDINGS / "simulated-beta.mcap")
    with Replay(session, Ports("127.0.0.1", None)) as replay:
        positions = await program(replay.port, replay.state_port)
        assert replay.unknown == {}
    assert [len(one) for one in positions] == [8] * 5
    heights = [one[2] for one in positions]
    assert heights == sorted(heights, reverse=True)
    assert {row.op for row in session} >= {"hello", "meta", "set_mode", "claim_control", "reset", "step"}


@pytest.mark.opengl
@pytest.mark.parametrize("images", [False, True])
async def test_pixels_are_kept_only_if_asked_for(tmp_path: Path, images: bool) -> None:
    with recorded(tmp_path, "beta", images=images) as relay:
        await program(relay.port, relay.state_port, picture=True)
    session = read_session(tmp_path / "session.mcap")
    replies = [msgspec.msgpack.decode(row.reply) for row in session if row.op == "step"]
    sizes = {len(one["data"]) for reply in replies for one in reply.get("cameras", {}).values()}
    assert sizes == ({4 * 64 * 48} if images else {0})
    with Replay(session, Ports("127.0.0.1", None)) as replay:
        await program(replay.port, replay.state_port, picture=True)


async def test_the_state_stream_passes(tmp_path: Path) -> None:
    with recorded(tmp_path, "beta") as relay:
        async with URLabClient(
            f"tcp://127.0.0.1:{relay.port}",
            state_port=relay.state_port,
            step_mode="live",
            local_model=False,
            live_pictures=False,
        ) as client:
            await client.discover()
            await client.runtime.set_paused(False)
            async with client.state_stream() as stream:
                times = [(await anext(stream)).time for _ in range(3)]
    assert times == sorted(times)
    kept = [message for row in read_session(tmp_path / "session.mcap") for message in row.messages]
    assert {(source, topic) for source, topic, _ in kept} == {("state", b"state/full")}


async def asked(port: int) -> None:
    """Send a request that gets no reply."""
    async with URLabClient(f"tcp://127.0.0.1:{port}", rcv_timeout_ms=300, local_model=False) as client:
        with pytest.raises((URLabConnectionError, URLabTimeoutError)):
            await client.meta()


async def test_a_relay_that_fails_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> bytes:
        raise RuntimeError("on purpose")

    monkeypatch.setattr(Relay, "on_exchange", fail)
    monkeypatch.setattr(Replay, "_answer", fail)
    with SimulatedServer() as server:
        relay = Relay(f"tcp://127.0.0.1:{server.step_port}", None, server.state_port, Ports("127.0.0.1", None))
        with relay:
            await asked(relay.port)
            with pytest.raises(URLabError, match="urlab-relay"):
                relay.join()
    session = [Passed("meta", msgspec.msgpack.encode({"op": "meta", "session_id": ""}), b"x")]
    with Replay(session, Ports("127.0.0.1", None)) as replay:
        await asked(replay.port)
        with pytest.raises(URLabError, match="urlab-replay"):
            replay.join()


def test_a_request_that_was_not_recorded_is_refused() -> None:
    import zmq

    session = [Passed("meta", msgspec.msgpack.encode({"op": "meta"}), msgspec.msgpack.encode({"op": "meta_ok"}))]
    with Replay(session, Ports("127.0.0.1", None)) as replay, zmq.Context() as context:
        socket = context.socket(zmq.REQ)
        socket.linger, socket.rcvtimeo = 0, 30_000
        socket.connect(f"tcp://127.0.0.1:{replay.port}")
        socket.send(msgspec.msgpack.encode({"op": "forward", "session_id": "x"}))
        reply = msgspec.msgpack.decode(socket.recv())
        assert (reply["op"], reply["code"]) == ("error", "unknown_op")
        socket.send(msgspec.msgpack.encode({"op": "meta"}))
        assert msgspec.msgpack.decode(socket.recv()) == {"op": "meta_ok"}
        assert replay.unknown == {"forward": 1}
        socket.close()


def test_other_machines_need_a_key(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="needs a key"):
        Ports("0.0.0.0", None)
    Ports("0.0.0.0", KeyPair.new()).context.term()
    assert main(["tap", "tcp://localhost", "--listen", "0.0.0.0:6559"]) == 2
    assert "needs a key (--listen-key)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["tcp://localhost", "--listen", "65535"], "is not a port below 65535"),
        (["tcp://localhost:99999"], "'tcp://localhost:99999' is not a valid address"),
        (["sim://arm"], "sim://arm cannot be relayed"),
    ],
)
def test_what_cannot_be_relayed_is_refused(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tap", *arguments]) == 2
    assert said in capsys.readouterr().err


def passed(request: dict[str, Any], reply: dict[str, Any]) -> Passed:
    return Passed(request["op"], msgspec.msgpack.encode(request), msgspec.msgpack.encode(reply), 0.00125, 0)


def test_an_op_is_printed_on_one_line() -> None:
    line = described(
        passed({"op": "set_paused", "session_id": "s", "paused": True}, {"op": "set_paused_ok", "paused": True})
    )
    assert line.endswith("set_paused(paused=True) 36 B -> op=set_paused_ok, paused=True 26 B, 1.25 ms")


def test_what_is_not_declared_is_named() -> None:
    request = {"op": "set_paused", "session_id": "s", "paused": True, "gently": True}
    assert departures(passed(request, {"op": "set_paused_ok", "paused": "yes", "mood": 1.0})) == [
        "set_paused: gently is not declared",
        "set_paused_ok: paused is str 'yes', declared bool",
        "set_paused_ok: mood is not declared",
    ]
    assert departures(passed({"op": "hover"}, {"op": "hover_ok"})) == ["the op 'hover' is not declared"]


def test_a_file_that_is_not_a_session_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.mcap").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="not a recorded session"):
        read_session(tmp_path / "other.mcap")
