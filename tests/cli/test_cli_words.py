"""What commands print: each figure in its place, the plural where it is due, and nothing that is not so."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from children import signals_kept

from urlab_client.cli import console, main, ping
from urlab_client.cli.tap import departures, described
from urlab_client.conformance.sessions import Passed
from urlab_client.integrations import record
from urlab_client.integrations.record.contents import Summary, Topic

Printed = Callable[..., str]


@pytest.fixture
def summarised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Printed:
    """Return what `urlab info` prints about a recording of these contents, and its exit code before that."""
    file = tmp_path / "run.mcap"
    file.write_bytes(bytes(3 << 19))

    def printed(**contents: Any) -> str:
        whole: dict[str, Any] = {"complete": True, "damage": "", "about": {}, "duration_s": 2.5, "wall_s": 2.75}
        whole |= {"episodes": 1, "dropped_states": 0, "dropped_frames": 0, "topics": {}}
        summary = Summary(path=file, **whole | contents)
        run = SimpleNamespace(path=file, summary=lambda _progress, verify: summary)
        monkeypatch.setattr(record, "read_run", lambda _: run)
        code = main(["info", str(file)])
        return f"{code}\n{capsys.readouterr().out}"

    return printed


def test_a_summary_of_a_whole_recording(summarised: Printed) -> None:
    about = {
        "started": "noon",
        "address": "sim://arm",
        "step_mode": "direct",
        "urlab_version": "1",
        "mujoco_version": "3",
    }
    topics = {
        "/state/arm": Topic("/state/arm", "State", 12, 100.04, 2, 0.03125),
        "/once": Topic("/once", "Mark", 1, 0.0, 0, 0.0),
    }
    lines = summarised(about=about, topics=topics).splitlines()
    assert lines[:4] == [
        "0",
        f"{lines[1].partition('  ')[0]}  1.5 MiB",
        "noon  sim://arm  direct mode  server 1, MuJoCo 3",
        "2.500 s simulated in 2.750 s, 1 episode",
    ]
    assert [line.split() for line in lines[4:]] == [
        ["topic", "schema", "messages", "rate", "(Hz)", "gaps", "longest", "(s)"],
        ["/state/arm", "State", "12", "100.0", "2", "0.031"],
        ["/once", "Mark", "1", "0"],
    ]


def test_a_summary_says_what_is_missing(summarised: Printed) -> None:
    shown = summarised(complete=False, damage="it ends early", episodes=3)
    assert shown.startswith("1\n")
    assert "?  ?  ? mode  server ?, MuJoCo ?\n" in shown
    assert ", 3 episodes\nnot finished, or damaged: it ends early\n" in shown
    for states, pictures, said in ((1, 0, "1 state, 0 pictures"), (0, 1, "0 states, 1 picture")):
        shown = summarised(dropped_states=states, dropped_frames=pictures)
        assert shown.startswith("1\n")
        assert f"dropped: {said}, which arrived faster than the file could be written" in shown
    assert "dropped" not in summarised()
    assert "outcomes" not in summarised()


def test_a_summary_counts_outcomes(summarised: Printed) -> None:
    marks = tuple(SimpleNamespace(outcome=outcome) for outcome in ("success", "failure", "success"))
    assert "outcomes: 2 success, 1 failure, 1 unmarked\n" in summarised(outcomes=marks, episodes=4)
    assert "outcomes: 2 success, 1 failure\n" in summarised(outcomes=marks, episodes=3)


PLAY = {"state": "ready", "sim_time": 1.5, "physics": "advancing", "step_mode": "live", "step_mode_pinned": False}
ROBOT = {"key": "arm", "actor_id": "left", "joints": 1, "actuators": 2, "sensors": 0, "cameras": 1, "controller": "pd"}
BARE = {
    "key": "ball",
    "actor_id": "",
    "joints": None,
    "actuators": 0,
    "sensors": None,
    "cameras": 0,
    "controller": None,
}
WHO = {"urlab_version": "1.2", "mujoco_version": "3.3.0", "local_mujoco_version": "3.3.1", "same_mujoco_build": False}
TRIPS = {"count": 3, "min": 0.1, "median": 0.25, "max": 1.0}


def test_ping_in_words(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    server: dict[str, Any] = {**WHO, "play": PLAY, "articulations": [ROBOT, BARE], "entities": ["crate", "door"]}

    def said(**changed: Any) -> list[str]:
        report = {"address": "tcp://lab", "ops": 90, "round_trip_ms": TRIPS, "server": server} | changed

        async def pinged(_: Any) -> Any:
            return report

        monkeypatch.setattr(ping, "_ping", pinged)
        assert main(["ping", "tcp://lab"]) == 0
        return capsys.readouterr().out.splitlines()

    *lines, note = said()
    assert lines == [
        "tcp://lab",
        "  URLab          1.2",
        "  MuJoCo         3.3.0 (3.3.1 here)",
        "  ops            90",
        "  play           ready, sim time 1.500 s, advancing",
        "  step mode      live",
        "  articulations  arm (actor left): 1 joint, 2 actuators, 0 sensors, 1 camera, pd controller",
        "                 ball: 0 actuators, 0 cameras, no controller",
        "  entities       crate",
        "                 door",
        "  round trip     min 0.10 ms, median 0.25 ms, max 1.00 ms (3 times meta)",
    ]
    assert note.startswith("A session was opened: ")
    assert not any("session was opened" in line for line in said(address="sim://arm"))
    assert said(server=None) == ["tcp://lab", "  ops            90", lines[-1]]
    for play, shown in (
        ({"state": "off", "physics": None}, ["  play           off"]),
        ({"step_mode": None}, ["  step mode      live and paused, or a mode in which its client steps"]),
        ({"step_mode_pinned": True}, ["  step mode      live, pinned by the server"]),
    ):
        there = said(server={**server, "same_mujoco_build": True, "play": {**PLAY, **play}})
        assert set(shown) <= set(there)
        assert "  MuJoCo         3.3.0 (same version here)" in there


def passed(request: Any, reply: Any, op: str = "set_paused") -> Passed:
    frames = [one if isinstance(one, bytes) else msgspec.msgpack.encode(one) for one in (request, reply)]
    return Passed(op=op, request=frames[0], reply=frames[1], at=0, seconds=0.0015)


def test_an_exchange_on_one_line() -> None:
    request = {"op": "set_paused", "session_id": "s", "control_owner": "me", "paused": True, "more": {"a": 1, "b": 2}}
    reply = {"op": "set_paused_ok", "at": 0.25, "raw": b"123", "all": [1, 2]}
    line = described(passed(request, reply)).partition(" ")[2]
    sizes = [len(msgspec.msgpack.encode(one)) for one in (request, reply)]
    assert line == (
        f"set_paused(paused=True, more={{a, b}}) {sizes[0]} B -> "
        f"op=set_paused_ok, at=0.25, raw=3 B, all=[2] {sizes[1]} B, 1.50 ms"
    )
    assert " ?(" in described(passed(b"\xc1", reply, op=""))
    assert "cannot be decoded" in described(passed(b"\xc1", reply))
    assert "(…) " in described(passed({"op": "x", "data": bytes(1 << 14)}, reply))
    long = described(passed({"op": "x", "text": "t" * 5000}, {"op": "y"}))
    assert "t…) " in long
    assert len(long) < 1000


def test_departures_from_the_declarations() -> None:
    request, reply = {"op": "set_paused", "paused": True}, {"op": "set_paused_ok", "paused": True}
    assert departures(passed(request, reply)) == []
    assert departures(passed(request, reply, op="fly")) == ["the op 'fly' is not declared"]
    assert departures(passed({**request, "paused": 1}, {**reply, "more": 2})) == [
        "set_paused: paused is int 1, declared bool",
        "set_paused_ok: more is not declared",
    ]
    (line,) = departures(passed(request, b"\xc1"))
    assert line.startswith("set_paused: a reply of 1 bytes cannot be decoded")


def test_keys_of_the_console_are_long(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for keys, refused in (("k" * 15, True), (f"{'k' * 16} short", True), (f"{'k' * 16} {'l' * 20}", False)):
        monkeypatch.setenv("URLAB_CONSOLE_KEY", keys)
        monkeypatch.setattr(console, "_serve", served)
        with signals_kept():
            assert main(["console", "sim://arm"]) == (2 if refused else 0)
        assert ("a key must have at least 16 characters" in capsys.readouterr().err) is refused


async def served(_: Any) -> None:
    try:
        int("lost")
    except ValueError:
        logging.getLogger("urlab_client.web").exception("it %s", "failed")


def test_the_console_logs_lines_of_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    root, ours = logging.getLogger(), logging.getLogger("urlab_client")
    before = root.level, root.handlers[:], ours.handlers[:]
    monkeypatch.setattr(console, "_serve", served)
    try:
        with signals_kept():
            assert main(["console", "sim://arm", "--json-log"]) == 0
    finally:
        root.level, root.handlers[:], ours.handlers[:] = before
    (line,) = capsys.readouterr().err.splitlines()
    logged = json.loads(line)
    assert (logged["level"], logged["logger"], logged["message"]) == ("error", "urlab_client.web", "it failed")
    assert "ValueError: invalid literal" in logged["error"]
    assert logged["at"].endswith("+00:00")
