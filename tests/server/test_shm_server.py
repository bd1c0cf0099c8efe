"""The server's shared memory: layout of the files, requests, streams, damage, and what is left behind."""

from __future__ import annotations

import errno
import os
import random
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
from raw_shm import HEADER, RawRegion, RawShm
from waiting import eventually

from urlab_client.server import SimulatedServer
from urlab_client.server.system.temporary_folder import TemporaryFolder
from urlab_client.server.system.threads import Health
from urlab_client.server.transport import shared_memory
from urlab_client.server.transport.shared_memory import RegionFile, SharedMemoryServer

Rpc = Callable[..., dict[str, Any]]


@pytest.fixture
def base() -> Iterator[Path]:
    """A short path: Unix sockets have room for about a hundred bytes."""
    with tempfile.TemporaryDirectory(prefix="urlab-test-", dir="/tmp" if os.name == "posix" else None) as directory:
        yield Path(directory)


@pytest.fixture
def server(base: Path) -> Iterator[SimulatedServer]:
    with SimulatedServer("arm", play=True, camera_size=(32, 24), shm_dir=base) as server:
        yield server


@contextmanager
def zmq_line(server: SimulatedServer) -> Iterator[Rpc]:
    """Requests over ZeroMQ, for what shared memory does not take."""
    context = zmq.Context()
    line = context.socket(zmq.REQ)
    line.rcvtimeo = 30_000
    line.connect(f"{server.address}:{server.step_port}")

    def call(**request: Any) -> dict[str, Any]:
        line.send(msgspec.msgpack.encode(request))
        return msgspec.msgpack.decode(line.recv())

    yield call
    context.destroy(linger=0)


@pytest.fixture
def rpc(server: SimulatedServer) -> Iterator[Rpc]:
    with zmq_line(server) as call:
        yield call


@pytest.fixture
def session(rpc: Rpc) -> str:
    session = rpc(op="hello")["session_id"]
    assert rpc(op="set_mode", session_id=session, mode="direct")["op"] == "set_mode_ok"
    return session


def snapshot_of(state: RawRegion, step: int) -> dict[str, Any] | None:
    sequence, payload = state.read()
    if not sequence:  # its file is there before the first snapshot is
        return None
    snapshot = msgspec.msgpack.decode(payload)
    return snapshot if snapshot["step"] == step else None


def directory_of(server: SimulatedServer) -> Path:
    assert server.shm_dir is not None
    return server.shm_dir


def test_the_files_are_laid_out_as_the_plugins(server: SimulatedServer, rpc: Rpc) -> None:
    directory = directory_of(server)
    assert rpc(op="hello")["shm_session_dir"] == str(directory)
    assert directory.name == "live"
    if os.name == "posix":
        assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    for name in ("req.shm", "rep.shm"):
        assert (directory / name).stat().st_size == 2_097_216
        assert HEADER.unpack_from((directory / name).read_bytes())[:4] == (0x424C5255, 1, 1_048_576, 2)
    state = directory / "state.shm"
    eventually(lambda: state.is_file() and state.stat().st_size == 32_832)
    for camera in ("overview", "wrist"):
        stride = 32 * 24 * 4 + 4
        assert (directory / f"cam_arm_{camera}.shm").stat().st_size == 64 + 2 * stride
    if os.name == "posix":
        modes = {file.name: oct(stat.S_IMODE(file.stat().st_mode)) for file in directory.iterdir()}
        assert modes == dict.fromkeys(modes, "0o600"), "nobody else may look or ring"
        assert {"req.shm", "state.shm", "cam_arm_wrist.shm", "doorbell.sock"} <= modes.keys()


def test_play_that_ends_takes_its_regions_along(server: SimulatedServer, rpc: Rpc, session: str) -> None:
    directory = directory_of(server)
    eventually((directory / "state.shm").is_file)
    rpc(op="stop_pie", session_id=session)
    left = {"req.shm", "rep.shm", *(["doorbell.sock"] if os.name == "posix" else [])}
    eventually(lambda: {path.name for path in directory.iterdir()} == left)
    assert "shm_session_dir" not in rpc(op="hello")


@pytest.mark.parametrize("doorbell", [True, False])
def test_steps_are_answered_as_over_zmq(server: SimulatedServer, rpc: Rpc, session: str, doorbell: bool) -> None:
    with RawShm(directory_of(server), doorbell=doorbell) as shm:
        for count in range(1, 6):
            reply = shm.call({"op": "step", "session_id": session})
            assert reply is not None
            assert (reply["op"], reply["step"]) == ("step_ok", count)
        over_zmq = rpc(op="step", session_id=session)
    assert over_zmq["step"] == 6
    assert over_zmq.keys() == reply.keys()


def test_bytes_of_a_reply_are_those_of_zmq(server: SimulatedServer, rpc: Rpc) -> None:
    request = {"op": "step", "session_id": "sync-1234"}
    with RawShm(directory_of(server), doorbell=True) as shm:
        assert shm.call(request) == rpc(**request)
    assert rpc(**request)["code"] == "session_expired"
    assert "sync-1234" in rpc(**request)["message"]


def test_what_does_not_travel_this_way_is_refused_before_it_is_executed(
    server: SimulatedServer, rpc: Rpc, session: str
) -> None:
    with RawShm(directory_of(server), doorbell=True) as shm:
        for op in ("import_xml", "stop_pie", "list_actors"):
            refused = shm.call({"op": op, "session_id": session})
            assert refused is not None
            assert refused["code"] == "wrong_transport"
    assert rpc(op="step", session_id=session)["step"] == 1


def test_a_step_whose_pictures_cannot_fit_is_not_taken(base: Path) -> None:
    with (
        SimulatedServer("arm", play=True, camera_size=(640, 480), shm_dir=base) as server,
        zmq_line(server) as rpc,
        RawShm(directory_of(server), doorbell=True) as shm,
    ):
        session = rpc(op="hello")["session_id"]
        rpc(op="set_mode", session_id=session, mode="direct")
        refused = shm.call({"op": "step", "session_id": session, "include_cameras": True})
        assert refused is not None
        assert refused["code"] == "wrong_transport"
        taken = shm.call({"op": "step", "session_id": session})
        assert taken is not None
        assert taken["step"] == 1


def test_a_handshake_whose_model_cannot_fit_opens_no_session(server: SimulatedServer, rpc: Rpc, session: str) -> None:
    with RawShm(directory_of(server), doorbell=True) as shm:
        refused = shm.call({"op": "hello"})
        assert refused is not None
        assert refused["code"] == "wrong_transport"
    assert rpc(op="step", session_id=session)["op"] == "step_ok"


def test_a_reply_that_turns_out_too_large_says_so_and_whether_it_was_executed(
    base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Generation 2 statement 17."""
    monkeypatch.setattr("urlab_client.server.open_server.MAX_REPLY_BYTES", 200)
    with (
        SimulatedServer("ball", play=True, shm_dir=base) as server,
        zmq_line(server) as rpc,
        RawShm(directory_of(server), doorbell=True) as shm,
    ):
        read = shm.call({"op": "meta"})
        assert read is not None
        assert read["code"] == "reply_too_large"
        assert "executed" not in read["message"]
        changed = shm.call({"op": "reset", "session_id": rpc(op="hello")["session_id"]})
        assert changed is not None
        assert changed["code"] == "reply_too_large"
        assert "was executed" in changed["message"]


def test_snapshots_come_with_each_step_to_whom_asks_for_them(server: SimulatedServer, session: str, rpc: Rpc) -> None:
    directory = directory_of(server)
    with RawShm(directory, doorbell=True) as shm:
        assert shm.doorbell is not None
        shm.doorbell.send(b"S")
        state = RawRegion(eventually(lambda: (directory / "state.shm").is_file() and directory / "state.shm"))
        for count in range(1, 30):
            reply = shm.call({"op": "step", "session_id": session})
            assert reply is not None
            snapshot = eventually(partial(snapshot_of, state, count))
            assert snapshot["op"] == "state_full"
            assert snapshot["time"] == reply["time"]
            assert snapshot["per_articulation"]["arm"]["qpos"] == reply["per_articulation"]["arm"]["qpos"]
        state.close()


@pytest.mark.opengl
def test_pictures_come_to_whom_asks_for_them_in_every_mode(server: SimulatedServer, session: str) -> None:
    directory = directory_of(server)
    with RawShm(directory, doorbell=True) as shm:
        assert shm.doorbell is not None
        shm.doorbell.send(b"C")
        region = RawRegion(directory / "cam_arm_overview.shm")
        eventually(lambda: region.sequence >= 3)
        eventually(lambda: b"c" in shm.wait(1.0))  # those may have been published before there was whom to tell
        _, pixels = region.read()
        assert len(pixels) == 32 * 24 * 4
        assert len(set(pixels)) > 10
        region.close()


HOSTILE = {
    "size zero": lambda r: r.map.__setitem__(slice(64, 68), b"\0\0\0\0"),
    "size beyond the slot": lambda r: [
        r.map.__setitem__(slice(at, at + 4), b"\xff" * 4) for at in (64, 64 + 1_048_576)
    ],
    "slot that is none": lambda r: r.map.__setitem__(slice(24, 28), b"\x07\0\0\0"),
    "sequence that jumps back": lambda r: r.map.__setitem__(slice(16, 24), b"\1" + b"\0" * 7),
    "another magic": lambda r: r.map.__setitem__(slice(0, 4), b"NOPE"),
    "another stride": lambda r: r.map.__setitem__(slice(8, 12), b"\xff\xff\xff\xff"),
}


@pytest.mark.parametrize("damage", HOSTILE)
def test_a_damaged_request_region_harms_nobody(server: SimulatedServer, rpc: Rpc, session: str, damage: str) -> None:
    directory = directory_of(server)
    with RawShm(directory, doorbell=True) as shm:
        assert shm.call({"op": "step", "session_id": session}) is not None
        good = shm.requests.map[:64]
        HOSTILE[damage](shm.requests)
        sequence = int.from_bytes(shm.requests.map[16:24], "little")
        shm.requests.map[16:24] = (sequence + 5).to_bytes(8, "little")
        assert shm.doorbell is not None
        shm.doorbell.send(b"q")
        assert rpc(op="step", session_id=session)["op"] == "step_ok"
        shm.requests.map[:64] = good
        eventually(lambda: shm.call({"op": "meta"}, 1.0))


@pytest.mark.parametrize(("name", "left"), [("req.shm", 10), ("req.shm", -1), ("rep.shm", 10), ("state.shm", 10)])
def test_files_that_are_cut_off_do_not_kill_the_server(
    server: SimulatedServer, rpc: Rpc, session: str, name: str, left: int
) -> None:
    directory = directory_of(server)
    eventually((directory / name).is_file)
    whole, header = (directory / name).stat().st_size, (directory / name).read_bytes()[:16]
    requests = RawRegion(directory / "req.shm")
    with socket.socket(socket.AF_UNIX) as doorbell:
        doorbell.connect(os.fspath(directory / "doorbell.sock"))
        doorbell.send(b"S")
        os.truncate(directory / name, left % whole)
        if name != "req.shm":
            requests.publish(msgspec.msgpack.encode({"op": "meta"}))
        doorbell.send(b"q")
        for _ in range(20):
            assert rpc(op="step", session_id=session)["op"] == "step_ok"
    requests.close()
    eventually(lambda: (directory / name).stat().st_size == whole and (directory / name).read_bytes()[:16] == header)
    with RawShm(directory, doorbell=True) as shm:
        eventually(lambda: shm.call({"op": "meta"}, 0.5))


def test_nonsense_at_the_doorbell_disturbs_nobody(server: SimulatedServer, session: str) -> None:
    directory = directory_of(server)
    noise = random.Random(5)
    with ExitStack() as unmatched_names, RawShm(directory, doorbell=False) as shm:
        for number in range(50):
            stranger = unmatched_names.enter_context(socket.socket(socket.AF_UNIX))
            stranger.connect(os.fspath(directory / "doorbell.sock"))
            stranger.send(noise.randbytes(3000))
            if number % 2:
                stranger.close()
        for count in range(1, 20):
            reply = shm.call({"op": "step", "session_id": session})
            assert reply is not None
            assert reply["step"] == count


def test_a_client_that_never_listens_to_the_doorbell_delays_nobody(base: Path) -> None:
    memory = SharedMemoryServer(base, Health())
    memory.start(lambda request: msgspec.msgpack.encode({"op": "pong"}))
    with socket.socket(socket.AF_UNIX) as deaf, RawShm(memory.directory, doorbell=True) as shm:
        deaf.connect(os.fspath(memory.directory / "doorbell.sock"))
        for _ in range(600):  # its buffer holds fewer rings
            assert shm.call({"op": "ping"}) is not None
    memory.stop()
    assert memory.join(30)


def test_a_request_that_is_seen_before_its_ring_does_not_count_as_one_without(base: Path) -> None:
    memory = SharedMemoryServer(base, Health())
    memory.switch_camera("bot/eye", (4, 4))
    memory.start(lambda request: msgspec.msgpack.encode({"op": "pong"}))
    with RawShm(memory.directory, doorbell=True) as shm:
        assert shm.call({"op": "ping"}) is not None
        memory.publish_picture("bot/eye", bytes(64))  # whoever may have waited for the first one has it
        before = shm.replies.sequence
        shm.requests.publish(msgspec.msgpack.encode({"op": "ping"}))
        eventually(lambda: shm.replies.sequence > before)
        assert shm.doorbell is not None
        shm.doorbell.send(b"q")
        assert shm.call({"op": "ping"}) is not None
        assert memory.wanted_cameras() == []
        with RawShm(memory.directory, doorbell=False) as silent:
            eventually(lambda: silent.call({"op": "ping"}) and memory.wanted_cameras() == ["bot/eye"])
    memory.stop()
    assert memory.join(30)


def test_a_path_too_long_for_a_socket_leaves_polling(tmp_path: Path) -> None:
    deep = tmp_path / ("d" * 100)
    with (
        SimulatedServer("ball", play=True, shm_dir=deep) as server,
        RawShm(directory_of(server), doorbell=False) as shm,
    ):
        assert not (directory_of(server) / "doorbell.sock").exists()
        assert shm.call({"op": "meta"}) is not None


def test_two_servers_share_a_base_and_leave_nothing(base: Path) -> None:
    with SimulatedServer("ball", play=True, shm_dir=base) as one, SimulatedServer("ball", shm_dir=base) as two:
        assert directory_of(one) != directory_of(two)
        for server in (one, two):
            with RawShm(directory_of(server), doorbell=True) as shm:
                assert shm.call({"op": "meta"}) is not None
    eventually(lambda: list(base.iterdir()) == [])


def serve(base: Path) -> tuple[subprocess.Popen[bytes], Path]:
    command = [sys.executable, "-m", "urlab_client", "serve", "ball", "--json", "--shm-dir", os.fspath(base)]
    ports = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
    process = subprocess.Popen([*command, *ports], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL)
    assert process.stdout is not None
    return process, Path(msgspec.json.decode(process.stdout.readline())["shm_dir"])


def end(process: subprocess.Popen[bytes], stop: Callable[[subprocess.Popen[bytes]], None]) -> None:
    stop(process)
    process.wait(60)
    assert process.stdout is not None
    process.stdout.close()


def test_a_terminated_server_cleans_up_and_a_killed_one_is_cleaned_up_after(base: Path) -> None:
    killed, left = serve(base)
    (base / "urlab-not-ours").mkdir()
    (base / "urlab-not-ours" / "lock").write_text("somebody's")
    end(killed, subprocess.Popen.kill)
    assert left.is_dir()
    terminated, directory = serve(base)
    assert not left.exists()
    assert directory.is_dir()
    with RawShm(directory, doorbell=True) as shm:
        assert shm.call({"op": "meta"}) is not None
    end(terminated, subprocess.Popen.terminate)
    assert {path.name for path in base.iterdir()} == {"urlab-not-ours"}


def test_servers_that_start_at_once_leave_each_other_alone(base: Path) -> None:
    killed, left = serve(base)
    end(killed, subprocess.Popen.kill)
    with ThreadPoolExecutor(8) as threads:
        directories = list(threads.map(lambda _: TemporaryFolder(base), range(64)))
    assert not left.exists()
    assert all(directory.path.is_dir() for directory in directories)
    for directory in directories:
        directory.close()
    assert list(base.iterdir()) == []


def test_a_server_for_which_there_is_no_room_keeps_nothing(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, reserve = list[int](), os.posix_fallocate

    def allocate(descriptor: int, offset: int, size: int) -> None:
        made.append(descriptor)
        if len(made) % 2 == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        reserve(descriptor, offset, size)

    monkeypatch.setattr(os, "posix_fallocate", allocate)
    before = os.listdir("/dev/fd")
    with pytest.raises(OSError, match="No space left"):
        SharedMemoryServer(base, Health())
    assert set(os.listdir("/dev/fd")) <= set(before)  # what was garbage before may have been collected meanwhile
    assert list(base.iterdir()) == []


def test_where_replies_cannot_be_written_zmq_goes_on_alone(
    server: SimulatedServer, rpc: Rpc, session: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = directory_of(server)
    with RawShm(directory, doorbell=True) as shm:
        assert shm.call({"op": "step", "session_id": session}) is not None

        def publish(region: RegionFile, payload: bytes) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(RegionFile, "publish", publish)
        assert shm.call({"op": "step", "session_id": session}, 0.2) is None
        eventually(lambda: not directory.exists())
    assert rpc(op="step", session_id=session)["step"] == 3


def test_a_request_that_is_not_counted_yet_is_not_read_as_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = RegionFile(tmp_path / "req.shm", 64)
    client = file._region
    client.publish(b"first")
    client.publish(b"second")

    def count(_: float) -> None:
        client._sequence[0] = 2

    client._sequence[0] = 1  # as between the two stores of a client
    monkeypatch.setattr(shared_memory.time, "sleep", count)
    found = file.read(0)
    assert found is not None
    assert (found.sequence, found.payload) == (2, b"second")
    assert file.read(found.sequence) is None, "it would be executed twice"
    file.close()


def test_a_writer_that_numbers_its_slots_in_another_way_is_served(tmp_path: Path) -> None:
    file = RegionFile(tmp_path / "req.shm", 64)
    file._region.publish(b"first")
    file._region._sequence[0] = 2
    found = file.read(0)
    assert found is not None
    assert found.payload == b"first"
    file.close()
