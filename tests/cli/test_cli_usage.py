"""What every command has in common: help, usage errors, exit codes, what is imported."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from importlib.metadata import version
from pathlib import Path

import pytest
from children import DEADLINE_S
from commands import refusal, urlab
from forked import COMMAND, program

from urlab_client.cli import _parser, main
from urlab_client.server import bundled_models


def test_help_needs_no_heavy_library_and_a_command_none_of_the_others(tmp_path: Path) -> None:
    program = (
        "import sys; from urlab_client.cli import main\n"
        "try: main(['record', '--help'])\n"
        "except SystemExit: print({'numpy', 'zmq', 'urlab_client.aio.client'} & set(sys.modules))\n"
        "try: main(['serve', '--help'])\n"
        "except SystemExit: print('urlab_client.aio.client' in sys.modules)\n"
        "try: main(['--help'])\n"
        "except SystemExit: print(sorted({'mujoco', 'numpy', 'rich', 'urlab_client.cli.ping'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=True
    )
    *text, imported = done.stdout.splitlines()
    assert set(COMMANDS) <= set(" ".join(text).split())
    assert imported == "[]"
    assert "set()" in text, "the help of a command loads the client"
    assert "False" in text, "a server loads the clients"


COMMANDS = (
    "serve", "console", "ping", "doctor", "demo", "robots", "keys", "snapshot", "record", "info", "convert", "plot",
    "run-policy", "view",
)  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: urlab {command}")


@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_each_command_are_understood(command: str) -> None:
    parser = _parser()
    for line, what in parser.commands[command].examples:
        assert what
        words = shlex.split(line)
        assert words[0] == "urlab"
        parser.parse_args(words[1:])


def test_the_command_alone_prints_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    text, errors = capsys.readouterr()
    assert errors == ""
    assert all(command in text for command in COMMANDS)


def test_the_robots_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["arm", "8", "7", "2", "2", "home"]
    assert main(["robots", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [robot["name"] for robot in listed] == [*bundled_models()]
    assert all(Path(robot["path"]).is_file() for robot in listed)


def test_the_names_in_a_robot_are_listed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["robots", "arm"]) == 0
    lines = dict(line.split(None, 1) for line in capsys.readouterr().out.splitlines())
    assert lines["actuators"].split(", ")[-2:] == ["wrist_yaw", "gripper"]
    assert lines["cameras"] == "overview, wrist"
    file = tmp_path / "bob.xml"
    joints = '<joint name="swing"/><joint axis="1 0 0"/>'
    file.write_text(f'<mujoco><worldbody><body>{joints}<geom size=".1"/></body></worldbody></mujoco>')
    assert main(["robots", str(file), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == {
        "name": "bob", "joints": ["swing", "(unnamed)"], "actuators": [], "sensors": [], "cameras": [], "keyframes": [],
        "path": str(file),
    }  # fmt: skip
    assert main(["robots", str(file)]) == 0
    assert "cameras    none" in capsys.readouterr().out
    file.write_text("<mujoco><worldbody><geom/></worldbody></mujoco>")
    assert main(["robots", str(file)]) == 2
    assert f"urlab robots: MuJoCo rejects {file}: " in capsys.readouterr().err
    assert main(["robots", "harm"]) == 2
    assert "Did you mean 'arm'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    "line",
    [
        "record sim://arm --seconds 1 run.mcap --contacts",
        "record --contacts sim://arm run.mcap --seconds=1",
        "record sim://arm run.mcap --contacts --seconds 1",
    ],
)
def test_options_may_stand_between_arguments(line: str) -> None:
    found = _parser("record").parse_args(line.split())
    assert (found.address, str(found.output), found.seconds, found.contacts) == ("sim://arm", "run.mcap", 1.0, True)


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("plot run.mcap --joints a b -o a.png", {"joints": ["a", "b"]}),
        ("plot --joints a b -o a.png run.mcap", {"joints": ["a", "b"]}),
        ("run-policy --command -1 0.5 0 walk.onnx", {"command": [-1.0, 0.5, 0.0]}),
    ],
)
def test_options_with_several_values_keep_them(line: str, wanted: dict[str, object]) -> None:
    found = vars(_parser(line.partition(" ")[0]).parse_args(line.split()))
    assert {name: found[name] for name in wanted} == wanted


def test_what_was_meant_comes_before_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["recrd"])
    assert "'recrd' is not known. Did you mean 'record'? There are: serve, console," in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("urlab pi", ["ping"]),
        ("urlab run", ["run-policy"]),
        ("urlab serve --step-", ["--step-port", "--step-mode"]),
        ("urlab serve arm --step-mode p", ["puppet"]),
    ],
)
def test_a_shell_completes_commands_options_and_values(tmp_path: Path, line: str, words: list[str]) -> None:
    found = tmp_path / "found"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
    asked["_ARGCOMPLETE_STDOUT_FILENAME"] = str(found)
    command = [sys.executable, "-m", "urlab_client"]
    done = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
    assert [word.strip() for word in found.read_text().splitlines()] == words


def test_help_shows_what_the_option_shows(capsys: pytest.CaptureFixture[str]) -> None:
    shown: list[str] = []
    for arguments in (["help", "ping"], ["ping", "--help"], ["help"], ["--help"]):
        with pytest.raises(SystemExit) as exited:
            main(arguments)
        assert exited.value.code == 0
        shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1] != shown[2] == shown[3]
    assert shown[0].startswith("usage: urlab ping")


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["-V"])
    assert version("urlab-client") in capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert version("urlab-client") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fly"], ["'fly'", "serve", "ping", "demo"]),
        (["sreve"], ["'sreve'", "Did you mean 'serve'?"]),
        (["keys", "shwo"], ["'shwo'", "Did you mean 'show'?"]),
        (["doctor", "--stepmode", "live"], ["urlab doctor: --stepmode", "'--step-mode'"]),
        (["doctor", "--step-mode", "drect"], ["'drect'", "Did you mean 'direct'?"]),
        (["plot", "run.mcap", "--field", "sensor"], ["'sensor'", "Did you mean 'sensors'?"]),
        (["ping", "arm"], ["'arm'", "sim://arm"]),
        (["ping", "one", "two"], ["'two'", "too many"]),
        (["serve"], ["MODEL"]),
        (["serve", "arm", "--step-port", "70000"], ["--step-port", "'70000'", "65535"]),
        (["serve", "arm", "--step-mode", "slow"], ["--step-mode", "'slow'", "puppet"]),
        (["serve", "arm", "--actor-names", "x"], ["--actor-names", "'x'", "plugin"]),
        (["serve", "arm", "--controller", "arm"], ["--controller", "'arm'", "ACTOR=pd"]),
        (["serve", "arm", "--controller", "=pd"], ["--controller", "'=pd'", "ACTOR=pd"]),
        (["serve", "arm", "--controller", "arm=lqr"], ["'arm=lqr'", "'lqr'", "pd, passthrough"]),
        (["serve", "arm", "--controller", "arm=pd,ki=1"], ["'ki=1'", "kp=N"]),
        (["serve", "arm", "--controller", "arm=pd,kp=stiff"], ["'kp=stiff'", "number"]),
        (["serve", "arm", "--controller", "arm=pd,kv=-1"], ["'kv=-1'", "number"]),
        (["serve", "arm", "--controller", "arm=pd,kv=nan"], ["'kv=nan'", "number"]),
        (["serve", "arm", "--controller", "arm=passthrough,kp=1"], ["'kp=1'", "passthrough"]),
        (["serve", "arm", "--camera-mode", "wrist=depth"], ["'wrist=depth'", "ACTOR/CAMERA=MODE"]),
        (["serve", "arm", "--camera-mode", "arm/wrist=thermal"], ["'thermal'", "depth"]),
        (["serve", "arm", "--camera-size", "640"], ["--camera-size", "'640'", "640x480"]),
        (["serve", "arm", "--camera-size", "0x480"], ["'0x480'"]),
        (["serve", "arm", "--shm-dir", "x", "--no-shm"], ["--no-shm"]),
        (["ping", "--count", "0"], ["--count", "'0'"]),
        (["ping", "--timeout", "soon"], ["--timeout", "'soon'", "seconds"]),
        (["ping", "--timeout", "inf"], ["--timeout", "'inf'"]),
        (["demo", "--steps", "-5"], ["--steps", "'-5'"]),
        (["evaluate", "walk.onnx", "--seed", "-1"], ["--seed", "'-1'", "at least 0"]),
        (["teleop", "--seed", "-1"], ["--seed", "'-1'", "at least 0"]),
        (["evaluate", "walk.onnx", "--seed", "abc"], ["--seed", "'abc'", "a whole number"]),
        (["view", "--max-hz", "0"], ["--max-hz", "'0'", "per second"]),
        (["record", "sim://arm", "a.mcap", "--step-mode", "puppet"], ["--step-mode", "puppet", "live"]),
    ],
)
def test_wrong_usage_is_one_line_that_names_it(
    arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    out, err = capsys.readouterr()
    assert (end.value.code, out) == (2, "")
    assert err.count("\n") == 1
    assert all(word in err for word in words), err


@pytest.mark.parametrize(
    "command",
    [["ping"], ["doctor"], ["console"], ["snapshot"], ["view", "--foxglove"], ["record", "run.mcap"]],
    ids=lambda command: command[0],
)
def test_an_address_that_is_none_is_one_line_that_says_so(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    name, *others = command
    assert main([name, "gopher://lab", *others]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"urlab {name}: 'gopher://lab' is not a valid address; write tcp://HOST")


def test_a_terminal_without_the_characters_of_a_file_name_shows_their_numbers(tmp_path: Path) -> None:
    name = os.fsdecode("ключ".encode())  # also in a locale of ASCII
    done = urlab("keys", "new", name, cwd=tmp_path, environment={"PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "1"})
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(r"\u043a\u043b\u044e\u0447.key")
    assert (tmp_path / f"{name}.key").is_file()


def test_the_package_runs_as_the_command(tmp_path: Path) -> None:
    assert refusal(urlab("serve", cwd=tmp_path)).startswith("urlab serve: ")


def test_ctrl_c_is_exit_code_130_without_a_traceback(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent.settimeout(DEADLINE_S)
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with program(COMMAND, "ping", address, "--timeout", "60", "--no-session", cwd=tmp_path) as ping:
            connection, _ = silent.accept()  # from here on it waits for an answer that never comes
            with connection:
                ping.send_signal(signal.SIGINT)
                out, err = ping.communicate(timeout=DEADLINE_S)
    assert (ping.returncode, out, err) == (130, "", "")


@pytest.mark.parametrize(
    ("command", "unbuffered"),
    [("ping sim://ball --no-session", ""), ("robots", "1"), ("", ""), ("", "1")],
    ids=lambda value: {"": "-", "1": "unbuffered"}.get(value, value),
)
def test_a_reader_that_has_gone_ends_a_command_silently(command: str, unbuffered: str, tmp_path: Path) -> None:
    with unread() as stdout:
        done = urlab(*command.split(), cwd=tmp_path, stdout=stdout, environment={"PYTHONUNBUFFERED": unbuffered})
    assert (done.returncode, done.stderr) == (141, "")


def test_so_does_the_reader_of_the_errors(tmp_path: Path) -> None:
    with unread() as stderr:
        done = urlab("keys", "show", "nothing", cwd=tmp_path, stderr=stderr)
    assert (done.returncode, done.stdout) == (141, "")


@contextlib.contextmanager
def unread() -> Generator[int]:
    """Yield a pipe that nobody reads any more."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        yield writing
    finally:
        os.close(writing)


def test_output_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with open(os.devnull, "rb") as read_only:
        done = urlab("robots", cwd=tmp_path, stdout=read_only, environment={"PYTHONUNBUFFERED": ""})
    assert (done.returncode, done.stderr) == (2, "urlab: Bad file descriptor\n")
