"""What commands refuse in one line, and what they end with when something is missing or lost."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from children import signals_kept
from commands import FREE_PORTS
from ports import free_port

from urlab_client.cli import main, record, serve
from urlab_client.server import SimulatedServer

Refused = Callable[..., str]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """Run a command that must end with code 2, and return the one line that it says."""

    def run(*arguments: str | Path) -> str:
        with signals_kept():
            assert main([str(argument) for argument in arguments]) == 2
        out, err = capsys.readouterr()
        (line,) = err.splitlines()
        assert out == ""
        return line

    return run


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["serve", "arm", "--model-root", "nowhere"], "--model-root nowhere: no such folder"),
        (["serve", "arm", "--allow-client", "k"], "--allow-client and --allow-any-client require --server-key FILE"),
        (
            ["record", "x.mcap", "--keyframe", "home"],
            "--keyframe resets the simulation, which needs --step-mode direct",
        ),
        (
            ["record", "x.mcap", "--keyframe", "home", "--task", "urlab/Reach-v0"],
            "--keyframe cannot be combined with --task, which determines the start",
        ),
        (["snapshot", "run.mcap"], "run.mcap is a recording; urlab plot, view and console show it"),
        (["record", "x.csv"], "x.csv: write a file that ends in .mcap, for example x.mcap"),
        (
            ["console", "run.mcap", "--mjcf-options"],
            "--handshake and --mjcf-options are for servers, not for a recording",
        ),
        (["view", "--foxglove", "--page"], "--save, --connect and --page require --rerun"),
        (["view", "--rerun", "--connect", "rerun+http://localhost:9876/proxy", "--page"], "give one of --save"),
        (["view", "--web", "--sensors"], "--camera, --sensors and --seconds do not apply to --web"),
        (["view", "--web", "--camera", "all"], "--camera, --sensors and --seconds do not apply to --web"),
        (["snapshot", "tcp://localhost:1", "--keyframe", "home"], "--keyframe and --seconds are for models"),
        (["snapshot", "tcp://localhost:1", "--seconds", "1"], "--keyframe and --seconds are for models"),
    ],
)
def test_what_cannot_be_done_together(
    arguments: list[str], said: str, refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert f"urlab {arguments[0]}: {said}" in refused(*arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["record", "sim://arm"], "argument OUTPUT: 'sim://arm' is an address, not a file"),
        (["record", "run.mcap", "sim://arm"], "'run.mcap' is a recording, not the address of a server"),
        (["ping", "run.mcap"], "'run.mcap' is a recording, not the address of a server"),
        (["console", "pictures/run.png"], "'pictures/run.png' is a file, not the address of a server"),
        (["console", "/"], "'/' is a folder, not the address of a server"),
    ],
)
def test_files_and_addresses_are_told_apart(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert said in capsys.readouterr().err


def test_an_unknown_option_is_named_before_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["convert", "--hep=1"])
    assert capsys.readouterr().err.startswith("urlab convert: --hep is not an option. Did you mean '--help'")


@pytest.mark.parametrize("command", [["ping", "--timeout", "0.1"], ["ping", "--no-session", "--timeout", "0.1"]])
def test_nobody_there_is_said_without_the_names_of_ops(refused: Refused, command: list[str]) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    assert refused(*command, address).startswith(f"urlab ping: no connection to {address} within ")


def test_a_recording_that_exists_is_not_replaced(refused: Refused, tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    file.write_bytes(b"mine")
    assert f"{file} exists; --overwrite replaces it" in refused("record", "sim://arm", file)
    assert file.read_bytes() == b"mine"


def test_metrics_name_what_is_not_installed(refused: Refused, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve, "find_spec", lambda _: None)
    line = refused("serve", "arm", "--metrics-port", "0")
    assert "prometheus_client is not installed; run: " in line
    assert "prometheus" in line.partition("run: ")[2]


def test_a_port_of_metrics_in_use_is_named(refused: Refused) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"--metrics-port {port} cannot be used: " in refused(
            "serve", *FREE_PORTS, "arm", f"--metrics-port={port}"
        )


def test_a_camera_of_another_mode_is_named_before_a_picture_is_waited_for(refused: Refused) -> None:
    with SimulatedServer("arm", play=True) as server:
        where = [f"{server.address}:{server.step_port}", "--state-port", str(server.state_port)]
        line = refused("snapshot", *where, "--camera", "arm/wrist", "--mode", "depth")
        assert "--mode depth: arm/wrist is a camera of mode real" in line
        line = refused("snapshot", *where)
        assert "the plugin has no op for the viewport's picture; give --camera, one of arm/overview, arm/wrist" in line
    with SimulatedServer("arm") as server:
        line = refused("snapshot", f"{server.address}:{server.step_port}")
        assert "is play running?" in line


@pytest.mark.parametrize(
    ("states", "pictures", "without", "said", "code"),
    [
        (0, 0, [], "", 0),
        (2, 0, [], "; dropped 2 and 0", 1),
        (0, 3, [], "; dropped 0 and 3", 0),
        (0, 0, ["arm/wrist"], "", 1),
    ],
)
def test_a_recording_says_what_was_dropped(
    states: int,
    pictures: int,
    without: list[str],
    said: str,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    stats: dict[str, Any] = {"states": 7, "frames": 5, "file_bytes": 3 << 19}
    stats |= {"dropped_states": states, "dropped_frames": pictures}

    async def recorded(_: Any) -> Any:
        return SimpleNamespace(stats=SimpleNamespace(**stats), without_pictures=without)

    monkeypatch.setattr(record, "_record", recorded)
    file = tmp_path / "run.mcap"
    assert main(["record", f"tcp://127.0.0.1:{free_port()}", str(file)]) == code
    assert capsys.readouterr().out == f"{file}  7 states, 5 pictures, 1.5 MiB{said}\n"
