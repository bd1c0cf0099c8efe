"""Who can connect to a server: loopback, CURVE keys, and what a client is told when it is not let in."""

from __future__ import annotations

import json
import os
import pickle
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from ports import free_ports
from waiting import eventually
from wire import server_threads

from urlab_client import URLabClient
from urlab_client.cli import main
from urlab_client.errors import AuthenticationFailed
from urlab_client.keys import KeyFileError, KeyPair, public_key, read_pair
from urlab_client.protocol.messages.session import HelloOk
from urlab_client.server import CurveServer, SimulatedServer, UnprotectedServer


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the keys `server`, `stranger` and `clients/me`."""
    folder = tmp_path_factory.mktemp("keys")
    for name in ("server", "stranger"):
        KeyPair.new().write(folder, name)
    KeyPair.new().write(folder / "clients", "me")
    return folder


@pytest.fixture(scope="module")
def guarded(keys: Path) -> Iterator[SimulatedServer]:
    """A server that knows one client."""
    curve = CurveServer(server_key=keys / "server.key_secret", allow=[keys / "clients"])
    with SimulatedServer("arm", play=True, unpaused=True, curve=curve) as server:
        yield server


def test_requests_and_state_reach_a_client_with_the_right_keys(guarded: SimulatedServer, keys: Path) -> None:
    with URLabClient(**guarded.client_options(), client_key=keys / "clients/me.key_secret") as client:
        client.discover()
        assert list(client.articulations) == ["arm"]
        with client.state_stream() as stream:
            assert next(stream).time >= 0.0


@pytest.mark.opengl
def test_so_do_pictures(guarded: SimulatedServer, keys: Path) -> None:
    with URLabClient(**guarded.client_options(), client_key=keys / "clients/me.key_secret") as client:
        client.discover()
        view = client.articulations["arm"].cameras["wrist"]
        with view.frames() as pictures:
            assert next(pictures).pixels.any()


def test_pictures_need_the_key_as_well(guarded: SimulatedServer) -> None:
    import zmq

    with zmq.Context() as context:
        ports = guarded.step_port, guarded.state_port, guarded.ctrl_port, guarded.info_port, guarded.camera_port
        for port in ports:
            with context.socket(zmq.DEALER) as socket:
                monitor = socket.get_monitor_socket(zmq.Event.HANDSHAKE_SUCCEEDED | zmq.Event.HANDSHAKE_FAILED_PROTOCOL)
                socket.linger = 0
                socket.connect(f"{guarded.address}:{port}")
                from zmq.utils.monitor import recv_monitor_message

                assert monitor.poll(30_000)
                assert recv_monitor_message(monitor)["event"] == zmq.Event.HANDSHAKE_FAILED_PROTOCOL, port
                socket.disable_monitor()
                monitor.close(0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "does not know this client's key"),
        ({"client_key": "stranger.key_secret"}, "does not know this client's key"),
        ({"server_key": "stranger.key", "client_key": "clients/me.key_secret"}, "does not have the expected key"),
        ({"server_key": ""}, "requires CURVE keys"),
    ],
)
def test_a_wrong_key_is_said_before_any_deadline(
    guarded: SimulatedServer, keys: Path, options: dict[str, str], words: str
) -> None:
    paths = {name: keys / value if value else "" for name, value in options.items()}
    with URLabClient(**{**guarded.client_options(), **paths}, rcv_timeout_ms=3_600_000) as client:
        for _ in range(2):  # and each time, not only the first
            with pytest.raises(AuthenticationFailed, match=words):
                client.discover()


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o610, 0o604, 0o602, 0o601])
def test_a_secret_that_others_could_read_is_refused(tmp_path: Path, mode: int) -> None:
    _, secret = KeyPair.new().write(tmp_path, "me")
    assert read_pair(secret)
    secret.chmod(mode)
    with pytest.raises(KeyFileError, match="chmod 600"):
        read_pair(secret)


def test_keys_for_a_server_without(keys: Path) -> None:
    with (
        SimulatedServer() as server,
        URLabClient(**server.client_options(), server_key=keys / "server.key", rcv_timeout_ms=3_600_000) as client,
        pytest.raises(AuthenticationFailed, match="does not use CURVE keys"),
    ):
        client.discover()


def test_a_client_is_let_in_once_the_server_knows_it(keys: Path) -> None:
    secret = keys / "server.key_secret"
    before = server_threads()
    ports = free_ports()
    with SimulatedServer(curve=CurveServer(server_key=secret, allow=[keys / "stranger.key"]), **ports) as server:
        client = URLabClient(**server.client_options(), client_key=keys / "clients/me.key_secret")
        with pytest.raises(AuthenticationFailed):
            client.discover()
    eventually(lambda: server_threads() <= before)
    with client, SimulatedServer(curve=CurveServer(server_key=secret, allow=[keys / "clients"]), **ports):
        client.discover()
        assert client.session_id


def test_any_client_with_the_servers_key(keys: Path) -> None:
    with SimulatedServer(curve=CurveServer(server_key=keys / "server.key_secret", allow_any=True)) as server:
        assert server.open_to == "everyone with the server's key on this machine, encrypted"
        with URLabClient(**server.client_options()) as client:
            client.discover()
            assert client.session_id


def test_every_socket_is_bound_to_loopback_by_default() -> None:
    with SimulatedServer("arm", play=True) as server:
        ports = [server.step_port, server.state_port, server.ctrl_port, server.info_port, server.camera_port]
        for port in ports:
            with socket.socket() as beside:
                beside.bind(("127.0.0.2", port))  # which is refused where somebody listens on all addresses
            with socket.socket() as instead, pytest.raises(OSError, match="in use"):
                instead.bind(("127.0.0.1", port))


def test_a_wider_interface_needs_protection_or_the_word(keys: Path, caplog: pytest.LogCaptureFixture) -> None:
    for host in ("0.0.0.0", "*", ""):
        with pytest.raises(UnprotectedServer, match="insecure-no-auth"):
            SimulatedServer(host=host).start()
    with SimulatedServer(host="*", insecure_no_auth=True) as server:
        assert server.open_to == "anyone on every network of this machine, without authentication"
        assert "open to anyone" in caplog.text
    with SimulatedServer(
        host="*", curve=CurveServer(server_key=keys / "server.key_secret", allow=[keys / "clients"])
    ) as server:
        assert server.open_to == "1 client key(s) on every network of this machine, encrypted"
    with SimulatedServer() as server:
        assert server.open_to == "any program on this machine"
    with pytest.raises(ValueError, match="exclude each other"):
        SimulatedServer(curve=CurveServer(server_key="x", allow_any=True), insecure_no_auth=True)
    with pytest.raises(ValueError, match="who may connect"):
        CurveServer(server_key="x")


def test_the_command_line_makes_and_shows_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", "new", "server", "alice", "--dir", str(tmp_path)]) == 0
    assert str(tmp_path / "alice.key_secret") in capsys.readouterr().out
    if os.name == "posix":
        assert stat.S_IMODE((tmp_path / "server.key_secret").stat().st_mode) == 0o600
    pair = read_pair(tmp_path / "server.key_secret")
    assert pair.secret.decode() not in (tmp_path / "server.key").read_text() + repr(pair)
    assert main(["keys", "show", str(tmp_path / "server.key")]) == 0
    assert capsys.readouterr().out.startswith(pair.public.decode())
    assert main(["keys", "new", "server", "--dir", str(tmp_path)]) == 2  # never overwritten
    assert "exists" in capsys.readouterr().err
    assert main(["keys", "new", "../out", "--dir", str(tmp_path)]) == 2
    assert main(["keys", "show", str(tmp_path / "none.key")]) == 2


def test_a_secret_that_others_can_read_is_refused(keys: Path, tmp_path: Path) -> None:
    open_file = tmp_path / "open.key_secret"
    open_file.write_bytes((keys / "server.key_secret").read_bytes())
    open_file.chmod(0o644)
    with pytest.raises(KeyFileError, match="chmod 600"):
        URLabClient("tcp://lab", server_key=keys / "server.key", client_key=open_file)


def test_what_a_client_shows_of_itself_holds_no_secret(keys: Path) -> None:
    secret = keys / "clients/me.key_secret"
    hidden = read_pair(secret).secret.decode()
    with URLabClient("tcp://lab", server_key=keys / "server.key", client_key=secret) as client:
        shown = (
            repr(client.config),
            json.dumps(msgspec.to_builtins(client.config)),
            repr(client),
            repr(client.config.options()),
        )
        assert not any(hidden in text for text in shown)
        assert hidden.encode() not in pickle.dumps(client.config)
        with URLabClient(**client.config.options()) as twin:
            assert twin.config == client.config


def test_the_environment_names_keys_for_other_machines_alone(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("URLAB_SERVER_KEY", str(keys / "nowhere.key"))
    with pytest.raises(KeyFileError, match="nowhere"):
        URLabClient("tcp://lab")
    URLabClient("tcp://lab", server_key="").close()
    URLabClient("tcp://127.0.0.1:5559").close()
    URLabClient("sim://arm").close()


@pytest.mark.parametrize("text", ["", "x" * 40 + " ", "a" * 39, "\0"])
def test_what_is_no_key(text: str, tmp_path: Path) -> None:
    with pytest.raises((KeyFileError, ValueError)):
        public_key(text)
    (tmp_path / "bad.key").write_text(f'curve\n public-key = "{text}"')
    with pytest.raises(KeyFileError, match="not a key file"):
        public_key(tmp_path / "bad.key")


@pytest.mark.parametrize("name", ["", ".lab", "lab/pc", "lab pc", "lab:pc"])
def test_keys_are_called_as_files_are_everywhere(name: str, tmp_path: Path) -> None:
    with pytest.raises(KeyFileError, match=f"^{name!r} is not a valid key name: use letters, digits, '-', '_' and '.'"):
        KeyPair.new().write(tmp_path / "new", name)
    assert not list(tmp_path.iterdir())
    public, secret = KeyPair.new().write(tmp_path / "new", "lab-pc_2.x")
    assert (public.name, secret.name) == ("lab-pc_2.x.key", "lab-pc_2.x.key_secret")
    assert public_key(public) == read_pair(secret).public


def test_no_key_is_overwritten_be_it_the_public_or_the_secret_one(tmp_path: Path) -> None:
    for name in ("lab.key", "lab.key_secret"):
        folder = tmp_path / name.rpartition(".")[2]
        folder.mkdir()
        (folder / name).write_text("mine")
        with pytest.raises(KeyFileError, match=f"{name} exists, and keys are never overwritten"):
            KeyPair.new().write(folder, "lab")
        assert [file.read_text() for file in folder.iterdir()] == ["mine"]


def test_files_that_hold_no_key(tmp_path: Path) -> None:
    file = tmp_path / "bad.key"
    file.write_bytes(b"\xff" * 10)
    with pytest.raises(KeyFileError, match=r"bad\.key is not a key file.*urlab keys new"):
        public_key(file)
    file.write_bytes(b"#" * 1_000_000)
    with pytest.raises(KeyFileError, match=r"bad\.key is not a key file: it is too long"):
        public_key(file)
    with pytest.raises(KeyFileError, match=r"nowhere\.key: the key cannot be read: No such file"):
        public_key(tmp_path / "nowhere.key")


# Binary models


def _as_from_afar(monkeypatch: pytest.MonkeyPatch) -> None:
    from urlab_client.aio import client as module

    monkeypatch.setattr(module, "is_local", lambda address: False)


def test_a_binary_model_from_afar_is_not_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    _as_from_afar(monkeypatch)
    with SimulatedServer("arm", play=True) as server:
        for options, approximate in (({}, True), ({"trust_server": True}, False)):
            with URLabClient(**server.client_options(), **options, step_mode="direct") as client:
                client.discover()
                assert client.model is not None
                assert client.model_is_approximate is approximate
                client.step(5)
                client.sim.stop()
                client.sim.start()
                assert client.model_is_approximate is approximate


def test_a_binary_model_from_a_server_with_a_key_is(monkeypatch: pytest.MonkeyPatch, keys: Path) -> None:
    _as_from_afar(monkeypatch)
    curve = CurveServer(server_key=keys / "server.key_secret", allow_any=True)
    with (
        SimulatedServer("ball", play=True, curve=curve) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        assert client.model is not None
        assert not client.model_is_approximate


def test_a_server_from_afar_with_nothing_but_a_binary_model(monkeypatch: pytest.MonkeyPatch) -> None:
    _as_from_afar(monkeypatch)
    from urlab_client import URLabError
    from urlab_client.aio.session.session import Session

    hello = Session.hello

    async def without_assets(self: Session, turn: Any, request: Any) -> HelloOk:
        request.include_assets = False
        return await hello(self, turn, request)

    monkeypatch.setattr(Session, "hello", without_assets)
    with (
        SimulatedServer("ball", play=True) as server,
        URLabClient(**server.client_options()) as client,
        pytest.raises(URLabError, match=r"only in MuJoCo's binary format.*server_key"),
    ):
        client.discover()
