"""`urlab serve` as other programs rely on it."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
from pathlib import Path

import pytest
from children import DEADLINE_S, in_background, signals_kept
from commands import FREE_PORTS, GYMNASIUM_MODELS, refusal, served, urlab
from forked import program
from waiting import eventually

from urlab_client import URLabClient, URLabPDController
from urlab_client.cli import main
from urlab_client.enums import CameraMode, StepMode
from urlab_client.errors import ModeLocked

READY_KEYS = [
    "event", "address", "step_port", "state_port", "ctrl_port", "info_port", "camera_port", "shm_dir", "saved_dir",
    "pid", "scene_warnings", "open_to", "server_key",
]  # fmt: skip


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, None])
def test_serves_until_told_to_stop_and_leaves_nothing_behind(tmp_path: Path, end: signal.Signals | None) -> None:
    options = ["--until-eof"] if end is None else []
    with served("quadruped", "ball", "--play", *options, cwd=tmp_path) as server:
        ready = server.ready
        assert [*ready] == READY_KEYS
        assert (ready["event"], ready["address"], ready["shm_dir"]) == ("ready", "tcp://127.0.0.1", None)
        assert ready["pid"] == server.process.pid
        assert len({ready[key] for key in READY_KEYS if key.endswith("_port")}) == 5
        assert Path(ready["saved_dir"]).is_dir()
        with URLabClient(**server.client_options, step_mode="direct") as client:
            client.discover()
            assert set(client.articulations) == {"quadruped", "ball"}
            client.step(5)
            assert client.sim_time == pytest.approx(0.01)
        assert server.end(end) == (0, "", "")
    assert not Path(ready["saved_dir"]).exists()
    assert not [*tmp_path.iterdir()]
    with socket.create_server(("127.0.0.1", ready["step_port"])):  # nobody holds the port
        pass


@pytest.mark.parametrize("background", [False, True])
def test_leaves_ctrl_c_to_the_program_that_holds_its_input_or_the_terminal(tmp_path: Path, background: bool) -> None:
    options = [] if background else ["--until-eof"]
    with contextlib.ExitStack() as stack:
        with in_background() if background else contextlib.nullcontext():
            server = stack.enter_context(served("ball", "--play", *options, cwd=tmp_path, inherits=background))
        client = stack.enter_context(URLabClient(**server.client_options, step_mode="direct"))
        client.discover()
        server.process.send_signal(signal.SIGINT)
        for _ in range(20):
            client.step(1000)
        assert client.sim_time == pytest.approx(40)
        assert server.end(signal.SIGTERM if background else None) == (0, "", "")


def test_ends_while_a_client_is_connected_and_physics_runs(tmp_path: Path) -> None:
    with served("ball", "--play", "--unpaused", cwd=tmp_path) as server, URLabClient(**server.client_options) as client:
        client.discover()
        before = client.step().time
        eventually(lambda: client.step().time > before)
        assert server.end(signal.SIGTERM) == (0, "", "")


def test_says_readably_where_it_serves(tmp_path: Path) -> None:
    with served("arm", cwd=tmp_path, json=False) as server:
        assert server.first_line.startswith("Serving arm at tcp://127.0.0.1:")
        assert "open to any program on this machine" in server.first_line
        assert "Ctrl-C" in server.first_line
        assert server.end(signal.SIGINT) == (0, "", "")


def test_a_signal_during_a_start_that_takes_long(tmp_path: Path) -> None:
    source = (
        "import sys, threading\n"
        "from urlab_client.cli import main\n"
        "from urlab_client.server import SimulatedServer\n"
        "def start(self):\n"
        "    print(self._config.saved_dir, flush=True)\n"
        "    threading.Event().wait()\n"
        "SimulatedServer.start = start\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    with program(source, "serve", "arm", *FREE_PORTS, cwd=tmp_path) as process:
        assert process.stdout is not None
        scratch = Path(process.stdout.readline().strip())
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, out, err) == (0, "", "")
    assert not scratch.exists()


def test_ends_with_the_reason_when_a_thread_dies(tmp_path: Path) -> None:
    source = (
        "import ctypes, sys, threading\n"
        "from urlab_client.cli import main\n"
        "def strike():\n"
        "    sys.stdin.readline()\n"
        "    (physics,) = [thread for thread in threading.enumerate() if thread.name == 'urlab-physics']\n"
        "    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(physics.ident), ctypes.py_object(SystemExit))\n"
        "threading.Thread(target=strike, daemon=True).start()\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    with program(source, "serve", "arm", "--play", "--json", *FREE_PORTS, cwd=tmp_path) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["event"] == "ready"
        process.stdin.write("now\n")
        out, err = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, out) == (2, "")
    assert err.splitlines()[-1] == "urlab serve: the server's thread 'urlab-physics' died of SystemExit"


def test_every_option_has_its_effect(tmp_path: Path) -> None:
    models = tmp_path / "models"
    models.mkdir()
    saved = tmp_path / "saved"
    with served(
        "arm", "quadruped", "--host", "localhost", "--no-shm", "--saved-dir", saved, "--model-root", models,
        "--model-root", GYMNASIUM_MODELS, "--play", "--unpaused", "--step-mode", "direct",
        "--controller", "arm=pd,kp=40,kv=3,torque_limit=12.5", "--controller", "*=passthrough",
        "--camera-mode", "arm/wrist=depth", "--camera-size", "320x200", "--mjcf-options", "--actor-names", "plugin",
        "--until-eof",
        cwd=tmp_path,
    ) as server:  # fmt: skip
        assert server.ready["saved_dir"] == str(saved)
        with URLabClient(**server.client_options) as client:
            client.discover()
            assert [*client.articulations] == ["arm_C_0", "quadruped_C_0"]
            arm, quadruped = client.articulations.values()
            assert isinstance(arm.controller, URLabPDController)
            assert (set(arm.controller.kp.values()), set(arm.controller.kv.values())) == ({40.0}, {3.0})
            assert set(arm.controller.torque_limit.values()) == {12.5}
            assert quadruped.controller is not None
            assert not isinstance(quadruped.controller, URLabPDController)
            assert arm.cameras["wrist"].mode is CameraMode.DEPTH
            assert arm.cameras["wrist"].resolution == (320, 200)
            with pytest.raises(ModeLocked):
                client.runtime.set_mode(StepMode.LIVE)
            assert client.scene.import_xml(str(GYMNASIUM_MODELS / "ant.xml")).imported_now
        assert server.end(signal.SIGTERM)[:2] == (0, "")
    assert (saved / "MuJoCoImports" / "ant").is_dir()


def test_names_the_options_of_a_model_that_it_ignores(tmp_path: Path) -> None:
    with served(GYMNASIUM_MODELS / "humanoid.xml", "--play", cwd=tmp_path) as server:
        code, _, err = server.end(signal.SIGTERM)
    assert code == 0
    assert any(line.startswith("urlab serve: warning: ") and "timestep" in line for line in err.splitlines()), err


def test_serves_a_saved_level(tmp_path: Path) -> None:
    with served("arm", "--saved-dir", tmp_path, cwd=tmp_path) as server:
        with URLabClient(**server.client_options) as client:
            client.discover()
            client.scene.create_level("lab")
            client.scene.ensure_manager()
            client.scene.spawn_actor(client.scene.import_xml("ball"), "toy", location=(1, 2, 3))
            client.scene.save_level()
        server.end(signal.SIGTERM)
    level = tmp_path / "Levels" / "lab.json"
    with served(level, "--play", cwd=tmp_path) as server, URLabClient(**server.client_options) as client:
        client.discover()
        assert client.articulations_by_id["toy"].root_pos_w.tolist() == pytest.approx([1, 2, 3.1])


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return the line with which a command on free ports ended."""
    with signals_kept():
        assert main(["serve", *FREE_PORTS, *map(str, arguments)]) == 2
    out, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert out == ""
    return line


def test_a_missing_model(capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "robbot")
    assert line.startswith("urlab serve: robbot is neither a file nor a bundled robot")
    assert "quadruped" in line
    assert refused(capsys, "robbot.xml").endswith("robbot.xml does not exist")


def test_a_broken_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = write(tmp_path, "broken  robot.xml", "<mujoco><worldbody><geom type='potato'/></worldbody></mujoco>")
    line = refused(capsys, broken)
    assert str(broken) in line
    assert "potato" in line
    assert [*tmp_path.iterdir()] == [broken]


def test_a_level_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    level = write(tmp_path, "lab.json", "{}")
    assert str(level) in refused(capsys, level)


@pytest.mark.parametrize("name", ["step", "camera"])
def test_a_port_in_use(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        line = refused(capsys, "ball", f"--{name}-port={port}")
    assert f"127.0.0.1:{port} is in use" in line
    assert f"{name}_port" in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["arm", "--step-port", "1", "--info-port", "1"], ["--step-port", "--info-port", "1"]),
        (["arm", "--host", "host.invalid"], ["host.invalid"]),
        (["arm", "--host", "0.0.0.0"], ["0.0.0.0", "--server-key", "--insecure-no-auth"]),
        (["arm", "--server-key", "s.key_secret"], ["--allow-client", "--allow-any-client"]),
        (["arm", "--allow-any-client"], ["--server-key"]),
        (["arm", "--server-key", "none.key_secret", "--allow-any-client"], ["none.key_secret"]),
        (["arm", "--model-root", "nowhere"], ["--model-root", "nowhere"]),
        (["lab.json"], ["lab.json"]),
    ],
)
def test_what_cannot_be_honoured_is_one_line(
    arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused(capsys, *arguments)
    assert all(word in line for word in words), line


def test_needs_no_opengl(tmp_path: Path) -> None:
    done = urlab("serve", "nothing.xml", cwd=tmp_path, environment={"MUJOCO_GL": "broken"})
    assert "nothing.xml" in refusal(done)


def test_input_is_not_the_end_of_input(tmp_path: Path) -> None:
    with served("ball", "--until-eof", cwd=tmp_path) as server:
        assert server.process.stdin is not None
        server.process.stdin.write("not the end\n")
        server.process.stdin.flush()
        with URLabClient(**server.client_options) as client:
            client.discover()
        assert server.end(signal.SIGTERM) == (0, "", "")
