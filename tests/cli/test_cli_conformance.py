"""`urlab conformance` at the terminal: its output, its files, its exit codes."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from urlab_client.cli import conformance as cli_conformance
from urlab_client.cli import main
from urlab_client.conformance import statement_titles
from urlab_client.conformance.reports import redaction
from urlab_client.server import SimulatedServer


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with SimulatedServer("arm", dialect="beta", play=True) as server:
        yield f"{server.address}:{server.step_port}"


def test_reading_changes_nothing_and_says_what_holds(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", address]) == 0
    out = capsys.readouterr().out
    assert "Session 5.2" in out
    assert "generation beta" in out
    assert " 0 differ, " in out


def test_the_files(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {name: tmp_path / name for name in ("r.json", "r.html", "r.zip")}
    options = ["--json", str(files["r.json"]), "--html", str(files["r.html"]), "--bundle", str(files["r.zip"])]
    assert main(["conformance", address, *options]) == 0
    report = json.loads(files["r.json"].read_text())
    assert [row["id"] for row in report["statements"]] == list(statement_titles())
    assert {row["verdict"] for row in report["statements"]} == {"holds", "not_tried"}
    assert all(row["detail"] for row in report["statements"])
    assert report["measurements"]["round_trip_ms"]["meta"]["count"] > 50
    assert report["server"]["generation"] == "beta"
    assert report["server"]["address"] == address
    page = files["r.html"].read_text()
    assert page.startswith("<!doctype html>")
    assert "src=" not in page
    assert "href=" not in page
    with zipfile.ZipFile(files["r.zip"]) as bundle:
        assert set(bundle.namelist()) == {"report.json", "report.html", "exchanges.jsonl"}
        exchanges = [json.loads(line) for line in bundle.read("exchanges.jsonl").decode().splitlines()]
    assert "hello" in {one["op"] for one in exchanges}
    text = json.dumps([report, exchanges])
    assert str(Path.home()) not in text
    assert "mjb_base64" not in text or "bytes)" in text
    capsys.readouterr()


def test_names_stay_if_they_may(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option, there in (([], False), (["--with-names"], True)):
        file = tmp_path / f"{there}.zip"
        assert main(["conformance", address, "--bundle", str(file), "--only", "robot", *option]) == 0
        with zipfile.ZipFile(file) as bundle:
            assert ('"arm"' in bundle.read("exchanges.jsonl").decode()) is there
            assert any(name.startswith("frames/") for name in bundle.namelist()) is there
    capsys.readouterr()


@pytest.mark.opengl
def test_a_bundle_has_no_robot_that_an_earlier_handshake_named(tmp_path: Path) -> None:
    file = tmp_path / "r.zip"
    options = ["--play", "--author", "--only", "robot", "--only", "missing file", "--no-measurements"]
    assert main(["conformance", "sim://arm?dialect=beta", *options, "--bundle", str(file)]) == 0
    with zipfile.ZipFile(file) as bundle:
        text = "".join(bundle.read(name).decode() for name in bundle.namelist())
    assert re.findall(r".{20}\barm(?:_C_0)?\b.{20}", text) == []
    assert "robot_1" in text


@pytest.mark.parametrize(
    ("text", "left"),
    [
        (r"no C:\Users\Joe Smith\arm.xml here", "no (path) here"),
        (r"\\nas\joe\arm.xml", "(path)"),
        ("ipc:///home/joe/socket", "ipc:/(path)"),
        ("tcp://[fe80::1]:5559", "tcp://host:5559"),
        ("tcp://10.0.0.7:5559", "tcp://host:5559"),
        ("tcp://localhost:5559", "tcp://localhost:5559"),
        ("/Game/Levels/lab.lab at 3 m/s", "/Game/Levels/lab.lab at 3 m/s"),
        ("arm_C_0/elbow on pc", "robot_1/elbow on host"),
    ],
)
def test_what_is_taken_out_of_a_text(text: str, left: str) -> None:
    told = {"arm": "robot_1", "arm_C_0": "robot_1", "pc": "host"}
    assert redaction(told, allowed=False)(text) == left
    assert redaction(told, allowed=True)(text) == text


def test_some_checks(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", address, "--play", "--statement", "32", "--json", "-", "--no-measurements"]) == 0
    rows = {row["id"]: row for row in json.loads(capsys.readouterr().out)["statements"]}
    assert rows["Beta 32"]["verdict"] == "holds"
    assert rows["Beta 2"]["verdict"] == "not_tried"
    assert rows["Beta 70"]["detail"].startswith("it is about clients")


def test_what_cannot_be_tried(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", "tcp://127.0.0.1:1", "--timeout", "0.2"]) == 2
    assert "connection refused" in capsys.readouterr().err
    assert main(["conformance", "--statement", "Beta 320"]) == 2
    assert "'Beta 320' is not a statement. Did you mean" in capsys.readouterr().err


def test_ctrl_c_keeps_what_was_found(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextlib.contextmanager
    def interrupting(*_: object) -> Iterator[Callable[[float], None]]:
        pressed: list[None] = []

        def show(share: float) -> None:
            if share > 0.1 and not pressed:
                pressed.append(signal.raise_signal(signal.SIGINT))

        yield show

    monkeypatch.setattr(cli_conformance, "progress_bar", interrupting)
    files = {name: tmp_path / name for name in ("r.json", "r.html", "r.zip")}
    options = ["--json", str(files["r.json"]), "--html", str(files["r.html"]), "--bundle", str(files["r.zip"])]
    assert main(["conformance", address, "--play", "--no-measurements", *options]) == 130
    captured = capsys.readouterr()
    assert "interrupted; what came after was not tried" in captured.err
    assert re.search(r"^Session 5\.2 +holds", captured.out, re.MULTILINE)
    report = json.loads(files["r.json"].read_text())
    assert report["stopped"] == "interrupted"
    details = {row["detail"] for row in report["statements"] if row["verdict"] == "not_tried"}
    assert {"interrupted", "changes the world, so it needs --author"} <= details
    assert "interrupted" in files["r.html"].read_text()
    assert zipfile.is_zipfile(files["r.zip"])


def test_nothing_tried_is_no_success(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", address, "--statement", "Beta 9"]) == 2  # which needs --play
    captured = capsys.readouterr()
    assert "0 hold, 0 differ" in captured.out
    assert "nothing was tried" in captured.err


def test_long_lines_are_folded_at_a_terminal(
    address: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def table() -> str:
        assert main(["conformance", address, "--only", "robot"]) == 0
        return capsys.readouterr().out.partition("tcp://")[0]

    plain = table()
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    folded = table()
    assert max(map(len, plain.splitlines())) > 80 >= max(map(len, folded.splitlines()))
    assert folded.split() == plain.split()


def test_play_is_measured(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", address, "--play", "--statement", "32", "--json", "-"]) == 0
    measured = json.loads(capsys.readouterr().out)["measurements"]
    assert set(measured["steps_per_second"]) == {"1", "10", "100"}
    assert min(measured["steps_per_second"].values()) > 0
    live = measured["live"]
    assert live["snapshots_per_second"] > 0
    assert live["gap_ms"]["median"] <= live["gap_ms"]["max"]
    assert live["real_time_factor"] > 0
    (picture,) = measured["pictures"].values()
    assert picture["step_to_picture_ms"]["count"] == 5
    assert picture["per_second"] > 0
    trips = measured["round_trip_ms"]["step"]
    assert trips["min"] <= trips["median"] <= trips["max"]


def test_a_server_of_its_own_is_checked_with_a_folder_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--author", "--only", "import", "--no-measurements", "--json", "-"]
    assert main(["conformance", "sim://arm?dialect=beta", *options]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {row["verdict"] for row in report["statements"]} == {"holds", "not_tried"}
    assert next(row for row in report["statements"] if row["id"] == "Editor 3.1 import_xml")["verdict"] == "holds"
