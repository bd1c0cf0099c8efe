"""What a run of the checks says: differences in words, reports as text, page and bundle, and what is left over."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from targets import bench, furnish, server

from urlab_client import cli
from urlab_client.aio import URLabClient
from urlab_client.cli import conformance as command
from urlab_client.conformance import Bench, Check, Choice, Group, Report, Verdict, run
from urlab_client.conformance.declarations import Differs, NotTried, StatementResult, check, expecting, holds, same
from urlab_client.conformance.reports import (
    counts,
    differences_first,
    page,
    plain_report,
    readable,
    redaction,
    write_bundle,
)
from urlab_client.conformance.runner import CheckResult, one
from urlab_client.conformance.wire import Exchange, oddities, plain, reply_oddities, thinned
from urlab_client.protocol.messages.session import HelloOk
from urlab_client.protocol.registry import OPS

NAMES = {"Franka_C_0": "robot_1", "left": "robot_1", "Franka": "robot_1", "Go2_C_1": "robot_2", "lab-pc": "host"}
SERVER = {"address": "tcp://lab-pc:5559", "urlab_version": "1.2", "mujoco_version": "3.3.0", "generation": "beta"}
SERVER |= {"capabilities": [], "requests": 12, "robots": None}


def rows() -> list[StatementResult]:
    texts = [("A 1", "`step` answers", Verdict.NOT_TRIED, "needs <play>", []), ("A 2", "b", Verdict.HOLDS, "", [])]
    texts += [("A 3", "c", Verdict.DIFFERS, "expected left, got Go2_C_1 in /home/me/x.xml", ["7", "8"])]
    return [StatementResult(name, title, verdict, detail, frames) for name, title, verdict, detail, frames in texts]


def report(**changed: Any) -> Report:
    checks = [CheckResult("c", ("A 3",), Group.READ, Verdict.DIFFERS, "left is lost", (7, 8))]
    made = Report(dict(SERVER), rows(), checks, {"rate": 3.5}, ["stop_pie: play is failed"], "it died")
    return msgspec.structs.replace(made, **changed)


def exchange(number: int, reply: bytes, size: int | None = None) -> Exchange:
    request = msgspec.msgpack.encode({"op": "step", "actor": "left"})
    return Exchange(number, "step", request, reply, len(request), len(reply) if size is None else size, 0.0123456)


def test_verdicts_are_counted_in_words() -> None:
    some = {row.verdict: row for row in rows()}
    hold, differ, untried = some[Verdict.HOLDS], some[Verdict.DIFFERS], some[Verdict.NOT_TRIED]
    assert counts([]) == "0 hold, 0 differ, 0 not tried"
    assert counts([hold, differ]) == "1 holds, 1 differs, 0 not tried"
    assert counts([hold, hold, differ, differ, untried]) == "2 hold, 2 differ, 1 not tried"
    assert [row.id for row in differences_first(report())] == ["A 3", "A 2", "A 1"]


def test_names_paths_and_hosts_stay_here() -> None:
    redact = redaction(NAMES, allowed=False)
    assert redact("left, Franka_C_0 and Franka on lab-pc") == "robot_1, robot_1 and robot_1 on host"
    assert redact("Go2_C_1 leftover") == "robot_2 leftover"
    assert redact("read /home/me/x.xml and C:\\Users\\me\\y.xml") == "read (path) and (path)"
    assert redact("/Game/Levels/lab and /Engine/Basic") == "/Game/Levels/lab and /Engine/Basic"
    assert redact("tcp://10.0.0.7:5559 tcp://127.0.0.1:5559") == "tcp://host:5559 tcp://127.0.0.1:5559"
    assert redaction(NAMES, allowed=True)("left /home") == "left /home"
    assert redaction({}, allowed=False)("left") == "left"


def test_plain_data_of_a_report_say_what_ran_and_not_whose_it_is() -> None:
    shown = plain_report(report(), redaction(NAMES, allowed=False))
    assert shown["checks"] == [
        {"title": "c", "statements": ("A 3",), "verdict": "differs", "detail": "robot_1 is lost"}
    ]
    assert shown["server"]["address"] == "tcp://host:5559"
    assert shown["statements"][2]["detail"] == "expected robot_1, got robot_2 in (path)"
    assert shown["measurements"] == {"rate": 3.5}
    assert set(shown["versions"]) == {"urlab_client", "python", "system", "mujoco", "pyzmq"}


def test_an_exchange_is_readable_without_models_and_pixels() -> None:
    redact = redaction(NAMES, allowed=False)
    reply = msgspec.msgpack.encode(
        {"op": "x", "mjb": "abc", "data": b"12345", "left": ["left", 1.5, None], "other": b"12"}
    )
    shown = readable(exchange(7, reply), redact)
    assert (shown["number"], shown["op"], shown["ms"]) == (7, "step", 12.346)
    assert shown["request"] == {"op": "step", "actor": "robot_1"}
    assert shown["reply"] == {
        "op": "x",
        "mjb": "(3 bytes)",
        "data": "(5 bytes)",
        "robot_1": ["robot_1", 1.5, None],
        "other": "(2 bytes)",
    }
    assert readable(exchange(7, b"\xc1\xc1"), redact)["reply"] == "(not a message: c1c1)"
    assert readable(exchange(7, b"\xc1\xc1", 9), redact)["reply"] == "(9 bytes)"


def test_the_page_and_the_bundle_show_differences_with_their_frames(tmp_path: Path) -> None:
    redact = redaction(NAMES, allowed=False)
    reply = msgspec.msgpack.encode({"op": "step_ok", "note": "<b>"})
    exchanges = [exchange(7, reply), exchange(9, reply)]
    shown = page(report(), exchanges, redact)
    assert "<strong>1 holds, 1 differs, 1 not tried</strong>" in shown
    assert "<p class=differs>it died</p>" in shown
    assert "<p class=differs>Not put back: stop_pie: play is failed</p>" in shown
    assert "<tr><th>capabilities<td>none told" in shown
    assert "<th>robots<td>" not in shown
    assert "<tr><th>address<td>tcp://host:5559" in shown
    assert "<code>step</code> answers<td>not tried<td>needs &lt;play&gt;" in shown
    assert "<summary>1 exchanges</summary>" in shown
    assert "&lt;b&gt;" in shown
    assert "&quot;rate&quot;: 3.5" in shown
    assert shown.index("A 3") < shown.index("A 2") < shown.index("A 1")
    calm = report(left=[], stopped="", statements=rows()[:2], server={**SERVER, "capabilities": ["shm", "xyz"]})
    assert "<p class=differs>" not in page(calm, [], redact)
    assert "<td>shm, xyz" in page(calm, [], redact)
    for raw in (False, True):
        write_bundle(tmp_path / "sent.zip", report(), exchanges, redact, raw=raw)
        with zipfile.ZipFile(tmp_path / "sent.zip") as bundle:
            assert bundle.read("report.html").decode() == shown
            lines = bundle.read("exchanges.jsonl").decode().splitlines()
            assert [json.loads(line)["number"] for line in lines] == [7, 9]
            assert json.loads(bundle.read("report.json")) == json.loads(json.dumps(plain_report(report(), redact)))
            frames = {name for name in bundle.namelist() if name.startswith("frames/")}
            assert len(frames) == (4 if raw else 0)
            if raw:
                assert bundle.read("frames/00007-step.reply") == reply
                assert bundle.read("frames/00009-step.request") == exchanges[1].request


def test_differences_are_said_in_words() -> None:
    with pytest.raises(Differs, match=r"expected two, got 3"):
        holds(0, "two", 3)
    holds(1, "two", 3)
    same("x", 1.0, 1.0 + 1e-3, 1e-2)
    same("x", np.array([1.0, np.nan, 200.0]), [1.0, np.nan, 201.0], 1e-2)
    for what, expected, got, said in (
        ("x", 1.0, 1.02, r"expected x = 1\.0, got 1\.02"),
        ("x", np.zeros(2), np.zeros(3), r"expected x of shape \(2,\), got \(3,\)"),
        ("x", np.zeros(2), [0.0, 1.0], r"expected x\[1\] = 0\.0, got 1\.0"),
        ("x", np.zeros(1), [np.nan], r"expected x\[0\] = 0\.0, got nan"),
        ("x", "a", "b", "expected x = 'a', got b"),
    ):
        with pytest.raises(Differs, match=said):
            same(what, expected, got, 1e-2)
    with pytest.raises(Differs, match=r"expected a number, got invalid literal"), expecting("a number"):
        int("seven")
    with pytest.raises(ValueError, match=r"no statements are called A 1, A 2"):
        check("A 1", "Session 5.2", "A 2")


def test_what_departs_from_a_declaration_is_named_by_its_place() -> None:
    op = OPS["set_paused"]
    assert reply_oddities(op, {"op": "set_paused_ok", "paused": True}) == []
    assert reply_oddities(op, {"op": "hello_ok"}) == ["op is 'hello_ok'"]
    assert reply_oddities(op, {"op": "set_paused_ok", "paused": 1, "more": 2}) == [
        "paused is int 1, declared bool",
        "more is not declared",
    ]
    assert reply_oddities(op, {"op": "set_paused_ok"}) == ["paused is missing"]
    step = {"op": "step_ok", "time": True, "step": 1.5, "per_articulation": {"bot": {"qpos": [1, True], "qvel": 3}}}
    assert reply_oddities(OPS["step"], step) == [
        "time is bool True, declared float",
        "step is float 1.5, declared int",
        "per_articulation.bot.qpos is list [1, True], declared numbers",
        "per_articulation.bot.qvel is int 3, declared numbers",
    ]
    assert oddities(3, HelloOk) == ["the reply is int 3, declared a map"]
    assert reply_oddities(OPS["step"], {"op": "step_ok", "time": 0, "step": 1.0, "per_articulation": {"bot": 7}}) == [
        "per_articulation.bot is int 7, declared a map"
    ]


def test_frames_are_kept_without_what_is_long() -> None:
    kept = {"op": "x", "short": "s" * 1024, "list": [b"b" * 1025], "map": {"long": "l" * 1025}}
    assert plain(thinned(msgspec.msgpack.encode(kept))) == {
        **kept,
        "list": ["(1025 bytes)"],
        "map": {"long": "(1025 bytes)"},
    }
    assert thinned(b"\xc1") == b"\xc1"
    with pytest.raises(ValueError, match="a reply of 1 bytes cannot be decoded"):
        plain(b"\xc1")
    with pytest.raises(ValueError, match=r"a reply is int 7 instead of a map"):
        plain(b"\x07")


async def fails_to_read(_: Bench) -> None:
    raise KeyError("mode")


async def never_ends(_: Bench) -> None:
    raise TimeoutError


async def cannot(_: Bench) -> None:
    raise NotTried("needs luck")


async def test_robots_of_other_clients_are_left_alone(tmp_path: Path) -> None:
    with server(tmp_path, "beta", shm=False) as served:
        async with bench(served, tmp_path) as made, URLabClient(**served.client_options()) as other:
            await furnish(made, tmp_path)
            await other.discover()
            await next(iter(other.articulations.values())).claim()
            await made.play()
            assert len(made.robots) == 1
            made.later("load_level", level_path="/Game/Levels/nowhere")
            await made.put_back()
            assert made.left == ["load_level: load_level_failed: play is running: stop it first"]
            await other.discover()
            for robot in other.articulations.values():
                await robot.claim()
            with pytest.raises(NotTried, match="needs a robot that no other client controls"):
                await made.play()
            await made.put_back()
            for body, verdict, said in (
                (fails_to_read, Verdict.DIFFERS, "expected the declared fields, got KeyError: 'mode'"),
                (never_ends, Verdict.DIFFERS, "expected an end within "),
                (cannot, Verdict.NOT_TRIED, "needs luck"),
            ):
                result = await one(made, Check("it", ("A 1",), Group.READ, ("beta",), (), body, False))
                assert (result.title, result.verdict) == ("it", verdict)
                assert result.detail.startswith(said)


async def test_a_level_without_robots_is_not_driven_but_told_why(tmp_path: Path) -> None:
    with server(tmp_path, "beta", shm=False) as served:
        async with bench(served, tmp_path) as made:
            made.own_server = False
            report = await run(made, Choice(groups=frozenset(Group), words=("level",), measure=False))
    assert report.stopped == ""
    assert {row.verdict for row in report.statements} <= {Verdict.HOLDS, Verdict.NOT_TRIED}


def test_the_command_says_what_was_not_put_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Made:
        names = NAMES
        wire = type("W", (), {"exchanges": ()})

    async def checked(*_: Any) -> Any:
        return Made, report()

    monkeypatch.setattr(command, "_check", checked)
    assert cli.main(["conformance", "tcp://127.0.0.1:1"]) == 1
    out, err = capsys.readouterr()
    assert err.splitlines()[:2] == [
        "urlab conformance: not put back: stop_pie: play is failed",
        "urlab conformance: it died; what came after was not tried",
    ]
    assert "1.2, generation beta, MuJoCo 3.3.0" in out
    assert "1 holds, 1 differs, 1 not tried, by 1 checks and 12 requests." in out
    assert "A 1" not in out.partition("tcp://")[0]
    assert "--all also prints what was not tried" in out
    assert cli.main(["conformance", "tcp://127.0.0.1:1", "--all"]) == 1
    out = capsys.readouterr().out
    assert "A 1" in out
    assert "--all also" not in out
