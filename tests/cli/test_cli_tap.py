"""`urlab tap` as a command: what it prints and keeps, what it replays, and what it refuses."""

from __future__ import annotations

import re
import signal
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
from children import DEADLINE_S
from commands import refusal, urlab
from forked import COMMAND, Program, program
from ports import free_port

from urlab_client import URLabClient
from urlab_client.conformance.sessions import read_session
from urlab_client.server import SimulatedServer

pytestmark = pytest.mark.skipif("sys.platform == 'win32'", reason="ends by a signal")


@pytest.fixture(scope="module")
def server() -> Generator[SimulatedServer]:
    with SimulatedServer("arm", dialect="beta", play=True) as server:
        yield server


class Tap:
    """A running `urlab tap`."""

    def __init__(self, process: Program) -> None:
        assert process.stdout is not None
        self.process, self.first_line = process, process.stdout.readline()
        self.port, self.state_port = (int(port) for port in re.findall(r":(\d+), state at (\d+)", self.first_line)[0])

    def output(self) -> str:
        """End it as a user does, and return what it has printed since its first line."""
        self.process.send_signal(signal.SIGTERM)
        out, err = self.process.communicate(timeout=DEADLINE_S)
        assert "Traceback" not in err
        return out


@contextmanager
def tap(*arguments: str | Path, cwd: Path) -> Generator[Tap]:
    with program(COMMAND, "tap", "--listen", "0", *arguments, cwd=cwd) as process:
        yield Tap(process)


def drive(port: int, state_port: int) -> None:
    """Take two steps, as any client does."""
    with URLabClient(f"tcp://127.0.0.1:{port}", state_port=state_port, step_mode="direct", local_model=False) as client:
        client.discover()
        client.step()
        client.step(3)


def address(server: SimulatedServer) -> list[str]:
    return [f"{server.address}:{server.step_port}", "--state-port", str(server.state_port)]


def test_each_op_is_printed_and_kept_and_is_served_again(server: SimulatedServer, tmp_path: Path) -> None:
    file = tmp_path / "session.mcap"
    with tap(*address(server), "--save", file, "--strict", cwd=tmp_path) as relay:
        drive(relay.port, relay.state_port)
        lines = relay.output().splitlines()
    ops = [re.sub(r"^[\d:]{8} (\w+)\(.*", r"\1", line) for line in lines]
    assert not [line for line in lines if line.startswith("  ")]  # our server sends nothing undeclared
    assert ops.count("step") == 2
    assert {"hello", "meta", "set_mode"} <= set(ops)
    (one, three) = [line for line in lines if " step(" in line]
    assert "n_steps=3" in three
    assert re.search(r"\) \d+ B -> op=step_ok, .* \d+ B, \d+\.\d\d ms$", one)
    assert [row.op for row in read_session(file)] == ops

    with tap("--replay", file, cwd=tmp_path) as replayed:
        assert replayed.first_line.startswith(f"{file}: {len(ops)} exchanges at 127.0.0.1:")
        drive(replayed.port, replayed.state_port)


def test_quiet_prints_only_where_it_listens(server: SimulatedServer, tmp_path: Path) -> None:
    with tap(*address(server), "--quiet", cwd=tmp_path) as relay:
        drive(relay.port, relay.state_port)
        assert relay.output() == ""


def test_a_request_that_we_do_not_declare_is_named_once(server: SimulatedServer, tmp_path: Path) -> None:
    import msgspec
    import zmq

    with tap(*address(server), "--strict", "--quiet", cwd=tmp_path) as relay, zmq.Context() as context:
        socket = context.socket(zmq.REQ)
        socket.linger, socket.rcvtimeo = 0, 30_000
        socket.connect(f"tcp://127.0.0.1:{relay.port}")
        for _ in range(2):
            socket.send(msgspec.msgpack.encode({"op": "meta", "session_id": "", "mood": "good"}))
            socket.recv()
        socket.close()
        assert relay.output().splitlines() == ["  meta: mood is not declared"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sim://arm"], "sim://arm cannot be relayed: give tcp://HOST or tcp://HOST:PORT"),
        (["tcp://localhost", "--listen", "here"], "--listen: 'here' is not a port below 65535, nor HOST:PORT"),
        (["tcp://localhost", "--save", "kept.mcap"], "kept.mcap exists; choose another name"),
        (["tcp://localhost", "--save", "session.zip"], "session.zip"),
        (["--replay", "kept.mcap"], "kept.mcap is not a recorded session"),
    ],
)
def test_what_cannot_be_done_is_said_at_once(arguments: list[str], said: str, tmp_path: Path) -> None:
    (tmp_path / "kept.mcap").write_bytes(b"something else")
    listen = [] if "--listen" in arguments else ["--listen", str(free_port())]
    assert said in refusal(urlab("tap", *arguments, *listen, cwd=tmp_path))
    assert (tmp_path / "kept.mcap").read_bytes() == b"something else"
