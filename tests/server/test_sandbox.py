"""Models and files that clients name: what they may reach, and what becomes of those that ask for too much."""

from __future__ import annotations

import asyncio
import os
import signal
import struct
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import pytest
from waiting import eventually
from wire import Wire

from urlab_client import URLabTimeoutError
from urlab_client._sandbox import process, references
from urlab_client._sandbox.confinement import is_available
from urlab_client.aio import URLabClient
from urlab_client.errors import ImportFailed
from urlab_client.server import Limits, ModelError, SimulatedServer, open_server
from urlab_client.server.assets import importer
from urlab_client.server.refusal import Refusal

Serve = Callable[..., Wire]

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
FIGURE = (
    '<mujoco><asset><mesh name="m" file="{file}"/></asset>'
    '<worldbody><body><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
)
HUNGRY = {
    "replicate": '<worldbody><replicate count="1000000" offset="1 0 0"><body><geom size=".1"/></body></replicate>'
    "</worldbody>",
    "nested": '<worldbody><replicate count="1000"><replicate count="1000"><replicate count="1000"><geom size=".1"/>'
    "</replicate></replicate></replicate></worldbody>",
    "texture": '<asset><texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset>',
    "heightfield": '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>',
    "deep": "<worldbody>" + "<body>" * 100_000 + "</body>" * 100_000 + "</worldbody>",
}
LIMITS = Limits(model_cpu_s=1, model_wall_s=60, model_memory_bytes=512 * 2**20, data_bytes=2**26)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model root `root`, and beside it what clients are not to read."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "root" / "meshes").mkdir(parents=True)
    (folder / "root" / "meshes" / "figure.obj").write_text(TRIANGLE)
    (folder / "secret.obj").write_text(TRIANGLE)
    (folder / "secret.xml").write_text('<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>')
    return folder


@pytest.fixture(scope="module")
def wire(folder: Path) -> Iterator[Wire]:
    with SimulatedServer(model_roots=[folder / "root"], limits=LIMITS) as server, Wire(server) as wire:
        wire.hello()
        wire.ask("create_level", name="lab")
        yield wire


def refusal(wire: Wire, path: Any) -> str:
    code, message = wire.refusal("import_xml", path=str(path))
    assert code == "import_failed"
    return message


@pytest.mark.parametrize("name", [name for name in HUNGRY if name != "replicate"])  # which is for the next test
def test_a_model_that_asks_for_too_much_is_refused_and_the_server_lives(name: str, wire: Wire, folder: Path) -> None:
    bomb = folder / "root" / f"{name}.xml"
    bomb.write_text(f"<mujoco>{HUNGRY[name]}</mujoco>")
    assert str(bomb) in refusal(wire, bomb)
    assert wire.ask("import_xml", path="ball")["blueprint_class_path"]


PLAIN = '<worldbody><camera name="c" resolution="64 64"/></worldbody>'


@pytest.mark.parametrize(
    ("limit", "value", "content"),
    [
        ("model_bytes", 1, PLAIN),
        ("model_file_bytes", 1, PLAIN),
        ("camera_side", 63, PLAIN),
        ("model_cpu_s", 1, HUNGRY["replicate"]),
        ("model_wall_s", 1, HUNGRY["replicate"]),
    ],
    ids=["model_bytes", "model_file_bytes", "camera_side", "model_cpu_s", "model_wall_s"],
)
def test_the_limit_that_a_model_exceeds_is_named(limit: str, value: int, content: str, folder: Path) -> None:
    model = folder / "root" / "too_much.xml"
    model.write_text(f"<mujoco>{content}</mujoco>")
    limits = Limits(**({"model_cpu_s": 60, "model_wall_s": 60} | {limit: value}))
    with SimulatedServer(model_roots=[folder / "root"], limits=limits) as server, Wire(server) as wire:
        wire.hello()
        assert limit in refusal(wire, model)


HANGING = "import time; time.sleep(600)"
# In both, a process that nobody knows is left, and ends only when it is ended.
LEFT_WITH_THE_PIPE = """
import os, sys, time
alive = os.open("{alive}", os.O_WRONLY)
sys.stdin.buffer.read(9)
if os.fork() == 0:
    time.sleep(600)
"""
LEFT_AT_WORK = """
import os, signal
alive = os.open("{alive}", os.O_WRONLY)
from urlab_client._sandbox import process
def work(job):
    os.kill(os.getppid(), signal.SIGKILL)
    while True:
        sum(range(10**9))  # which heeds no signal
process._work = work
process.serve()
"""
LEFT_ITS_GROUP = LEFT_WITH_THE_PIPE.replace("    time.", "    os.setsid(); os.write(alive, b'%d' % os.getpid()); time.")


@pytest.fixture
def compile_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str]]:
    """Have a model compiled by a program of the test's, and return why that failed."""
    monkeypatch.setattr(process, "_children", process._Children())
    monkeypatch.setattr(process, "_END_S", 0.1)

    def compile_with(program: str, wall_s: float) -> str:
        monkeypatch.setattr(process._Child, "program", program)
        monkeypatch.setattr(process, "_GRACE_S", wall_s - 1)
        with pytest.raises(Refusal) as refused:
            importer.build_confined(tmp_path / "x.xml", tmp_path / "snapshot", (tmp_path,), Limits(model_wall_s=1))
        return refused.value.message

    yield compile_with
    process._children.close()


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[process._Child]:
    """The processes that are started for models."""
    started: list[process._Child] = []
    start = process._Child.__init__
    monkeypatch.setattr(process._Child, "__init__", lambda self: (started.append(self), start(self))[1])
    return started


def test_a_process_that_never_answers_is_waited_for_once(
    compile_with: Callable[..., str], started: list[process._Child]
) -> None:
    assert compile_with(HANGING, 0.1).endswith("x.xml: compilation took more than the limit model_wall_s, 1 s")
    assert len(started) == 1


@pytest.mark.parametrize(
    ("program", "wall_s", "reason"),
    [
        (LEFT_WITH_THE_PIPE, 1.0, "model_wall_s"),
        (LEFT_ITS_GROUP, 1.0, "model_wall_s"),
        (LEFT_AT_WORK, 600.0, "ended without an answer"),
    ],
    ids=["holds the pipe", "left its group", "at work"],
)
def test_what_a_killed_process_has_forked_delays_no_answer_and_is_ended(
    program: str,
    wall_s: float,
    reason: str,
    tmp_path: Path,
    compile_with: Callable[..., str],
    started: list[process._Child],
) -> None:
    os.mkfifo(tmp_path / "alive")
    alive = os.open(tmp_path / "alive", os.O_RDONLY | os.O_NONBLOCK)
    assert reason in compile_with(program.replace("{alive}", str(tmp_path / "alive")), wall_s)
    os.set_blocking(alive, True)
    with os.fdopen(alive, "rb") as pipe:
        if program is LEFT_ITS_GROUP:  # no model can; it is the answer that matters
            os.kill(int(os.read(alive, 64)), signal.SIGKILL)
        assert pipe.read() == b""  # none of them has it open any longer
    pipes = [pipe for child in started for pipe in (child.process.stdin, child.process.stdout) if pipe is not None]
    eventually(lambda: all(pipe.closed for pipe in pipes))


def test_an_import_writes_nowhere_but_in_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the kernel does not see to that."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    (tmp_path / "m.obj").write_text(TRIANGLE)
    (tmp_path / "figure.xml").write_text(FIGURE.format(file="m.obj"))
    importer.write_snapshot(tmp_path / "figure.xml", tmp_path / "snapshot")
    assert {one.suffix for one in (tmp_path / "snapshot").iterdir()} == {".xml", ".obj"}


def test_models_do_not_wait_for_each_other(tmp_path: Path, compile_with: Callable[..., str]) -> None:
    os.mkfifo(tmp_path / "begun")
    begun = os.open(tmp_path / "begun", os.O_RDWR)
    program = f"""
import fcntl, os, sys
from urlab_client._sandbox import process
sys.stdin.buffer.read(9)
os.write(os.open({str(tmp_path / "begun")!r}, os.O_WRONLY), b".")
fcntl.flock(os.open({str(tmp_path)!r}, os.O_RDONLY), fcntl.LOCK_SH)
sys.stdout.buffer.write(process._framed(process._Answer(failed="done")))
sys.stdout.flush()
sys.stdin.read()
"""
    import fcntl  # not on Windows

    held = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with ThreadPoolExecutor(3) as threads:
        outcomes = [threads.submit(compile_with, program, 60.0) for _ in range(3)]
        for _ in outcomes:  # all of them, before any has its answer
            os.read(begun, 1)
        os.close(held)
        assert [outcome.result().endswith("x.xml: done") for outcome in outcomes] == [True] * 3
    os.close(begun)


BODY = '<worldbody><body name="b"><joint name="j"/><geom name="g" size=".1"/></body></worldbody>'
LARGE = {
    "sensors": ('<sensor><contact geom1="g" num="2000000"/></sensor>', "2000000 numbers", "sensor_values"),
    "more sensors": ('<sensor><contact geom1="g" num="8500000"/></sensor>', "bytes", "data_bytes"),
    "far more sensors": ('<sensor><contact geom1="g" num="1000000000"/></sensor>', "memory", "model_memory_bytes"),
    "arena": ('<size memory="70M"/>', "73404", "data_bytes"),
    "user data": ('<size nuserdata="8500000"/>', "68004", "data_bytes"),
    "constraints": ('<size njmax="2000000000"/>', "memory", "model_memory_bytes"),
    "iterations": ('<option iterations="2147483647" tolerance="0"/>', "2147483647", "solver_iterations"),
    "timestep": ('<option timestep="0"/>', "timestep must be a positive number", "timestep"),
}


@pytest.mark.parametrize("kind", LARGE)
def test_what_its_simulation_takes_is_bounded_too(kind: str, wire: Wire, folder: Path) -> None:
    part, number, limit = LARGE[kind]
    model = folder / "root" / "small_file.xml"
    model.write_text(f"<mujoco>{part}{BODY}</mujoco>")
    message = refusal(wire, model)
    assert number in message
    assert limit in message


def test_the_level_as_a_whole_is_bounded_before_play(folder: Path) -> None:
    for name, count in (("one", 40), ("other", 1)):
        (folder / "root" / name).mkdir()
        (folder / "root" / name / "feeler.xml").write_text(
            f'<mujoco>{BODY}<sensor><contact geom1="g" num="{count}"/></sensor></mujoco>'
        )
    limits = Limits(sensor_values=100)
    with SimulatedServer(model_roots=[folder / "root"], limits=limits) as server, Wire(server) as wire:
        wire.hello()
        wire.ask("create_level", name="lab")
        wire.ask("ensure_manager")
        blueprint = wire.ask("import_xml", path="other/feeler.xml")["blueprint_class_path"]
        wire.ask("spawn_grid", blueprint=blueprint, base_actor_id="f", count_x=3, count_y=1)
        wire.ask("import_xml", path="one/feeler.xml", force_reimport=True)  # what was spawned grows
        failed = wire.ask("begin_pie")
        assert failed["state"] == "compile_failed"
        assert "120 numbers together, more than the limit sensor_values, 100" in failed["compile_error"]
        assert "sensor_values" in wire.refusal("spawn_actor", blueprint=blueprint, actor_id="more")[1]
        wire.ask("stop_pie")
        wire.ask("destroy_actor", target="f_0_0")
        assert wire.ask("begin_pie")["state"] == "ready"


def test_options_of_a_model_have_ranges_where_they_count(folder: Path) -> None:
    model = folder / "secret_options.xml"
    model.write_text(f'<mujoco><option iterations="2147483647" tolerance="0"/>{BODY}</mujoco>')
    with pytest.raises(ModelError, match="iterations must be from 0 to the limit solver_iterations, 10000"):
        SimulatedServer(model, mjcf_options=True, play=True).start()
    with SimulatedServer(model, play=True):  # without, they do not count
        pass


def test_entities_are_not_expanded(wire: Wire, folder: Path) -> None:
    laughs = "".join(f'<!ENTITY l{i + 1} "{f"&l{i};" * 10}">' for i in range(9))
    bomb = folder / "root" / "laughs.xml"
    bomb.write_text(f'<!DOCTYPE mujoco [<!ENTITY l0 "ha">{laughs}]><mujoco><custom>&l9;</custom></mujoco>')
    assert "document type" in refusal(wire, bomb)


def test_what_a_model_names_may_lie_below_the_roots(wire: Wire, folder: Path) -> None:
    inside = folder / "root" / "inside.xml"
    inside.write_text(FIGURE.format(file="meshes/../meshes/figure.obj"))
    assert wire.ask("import_xml", path=str(inside))["imported_now"] is True


@pytest.mark.parametrize(
    "text",
    [
        FIGURE.format(file="../secret.obj"),
        FIGURE.format(file="meshes/../../secret.obj"),
        FIGURE.format(file="&#x2e;./secret.obj"),
        FIGURE.format(file="..\\secret.obj"),
        FIGURE.format(file="{folder}/secret.obj"),
        pytest.param(FIGURE.format(file="link.obj"), id="a link"),
        pytest.param(FIGURE.format(file="linked/secret.obj"), id="below a link"),
        FIGURE.format(file="secret.obj").replace("<asset>", '<compiler meshdir=".."/><asset>'),
        FIGURE.format(file="secret.obj").replace("<asset>", "<compiler\nassetdir = '{folder}'/><asset>"),
        FIGURE.format(file="x/secret.obj").replace("<asset>", '<compiler strippath="true" meshdir=".."/><asset>'),
        '<mujoco><include file="../secret.xml"/></mujoco>',
        '<mujoco><include file="middle.xml"/></mujoco>',
        '<mujoco><asset><model name="m" file="../secret.xml"/></asset></mujoco>',
        '<mujoco><asset><texture name="t" type="cube" fileright="../secret.obj"/></asset></mujoco>',
    ],
)
def test_what_a_model_names_elsewhere_is_refused(text: str, wire: Wire, folder: Path) -> None:
    root = folder / "root"
    for link, target in ((root / "link.obj", folder / "secret.obj"), (root / "linked", folder)):
        if not link.is_symlink():
            link.symlink_to(target)
    (root / "middle.xml").write_text('<mujoco><include file="../secret.xml"/></mujoco>')
    thief = root / "thief.xml"
    thief.write_text(text.replace("{folder}", str(folder)))
    message = refusal(wire, thief)
    assert "outside the folders" in message
    assert "secret" in message or "link" in message


THEFT = FIGURE.format(file="{folder}/secret.obj")
INCLUDING = '<mujoco><include file="{file}"/></mujoco>'
ATTACHING = (
    '<mujoco><asset><model name="a" file="{file}"/></asset>'
    '<worldbody><attach model="a" prefix="x_"/></worldbody></mujoco>'
)
DISGUISES = {
    "blanks": " " * 256,
    "newlines": "\n" * 256,
    "vertical tab": "\v",
    "form feed": "\f",
    "byte order marks": "\ufeff \ufeff",
    "junk": "This is a poem. ",
    "comment": '<!-- file=" -->',
    "declaration": '<?xml version="1.0" encoding="utf-16"?>',
}


@pytest.mark.parametrize("names", [INCLUDING, ATTACHING, None], ids=["included", "attached", "itself"])
@pytest.mark.parametrize("disguise", DISGUISES)
def test_no_disguise_hides_what_a_model_names(disguise: str, names: str | None, wire: Wire, folder: Path) -> None:
    root = folder / "root"
    model = root / "model_in_disguise.xml"
    model.write_text(DISGUISES[disguise] + THEFT.replace("{folder}", str(folder)), "utf-8")
    if names is not None:
        (root / "part.xml").write_bytes(model.read_bytes())
        model.write_text(names.format(file="part.xml"))
    message = refusal(wire, model)
    assert "outside the folders" in message
    assert "secret.obj" in message


@pytest.mark.parametrize(
    "text",
    [
        ATTACHING.format(file="part.mjz"),
        ATTACHING.format(file="part.ZIP"),
        ATTACHING.format(file="part.mjz/model.xml"),
        INCLUDING.format(file="part.mjz/model.xml"),
        FIGURE.format(file="part.mjz"),
    ],
)
def test_archives_are_not_opened(text: str, wire: Wire, folder: Path) -> None:
    for name in ("part.mjz", "part.ZIP"):
        with zipfile.ZipFile(folder / "root" / name, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("model.xml", THEFT.replace("{folder}", str(folder)))
    model = folder / "root" / "packed.xml"
    model.write_text(text)
    assert "an archive, whose content is not looked into: unpack it" in refusal(wire, model)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('<mujoco><include file="part&sol;x.xml"/></mujoco>', "not understood"),
        ('<mujoco><include file="part\n.xml"/></mujoco>', "not understood"),
        ('<mujoco><include file="pipe"/></mujoco>', "not a regular file"),
        (ATTACHING.format(file="meshes/figure.obj"), "empty, or not XML"),
        ("<mujoco><worldbody></mujoco", "see line 1"),
        ("", "empty, or not XML"),
        ("a poem", "empty, or not XML"),
    ],
)
def test_what_is_not_understood_is_refused(text: str, reason: str, wire: Wire, folder: Path) -> None:
    pipe = folder / "root" / "pipe"
    if not pipe.exists():
        os.mkfifo(pipe)
    model = folder / "root" / "riddle.xml"
    model.write_text(text)
    assert reason in refusal(wire, model)


def test_a_process_that_compiles_starts_without_a_word(
    wire: Wire, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    process._children.close()
    model = folder / "root" / "first.xml"
    model.write_text(f"<mujoco>{BODY}</mujoco>")
    assert wire.ask("import_xml", path=str(model))["imported_now"] is True
    assert capfd.readouterr().err == ""


def test_mujoco_s_own_leniency_is_understood(wire: Wire, folder: Path) -> None:
    model = folder / "root" / "lenient.xml"
    model.write_text(
        "\n\v A robot:\n<!------ It's \"in\" here -->\n<mujoco\fmodel = 'bot'>"
        "<asset><mesh name='m' file='meshes&#47;figure.obj' /></asset >"
        "<worldbody><body><geom\ttype='mesh'\nmesh='m'/></body></worldbody></mujoco>\n"
    )
    assert wire.ask("import_xml", path=str(model))["imported_now"] is True


INCLUDES = "<mujoco><include file='{}'/></mujoco>"


@pytest.mark.parametrize(
    ("files", "limits", "problem"),
    [
        ({"m.xml": INCLUDES.format("inner/a.xml"), "inner/a.xml": INCLUDES.format("../m.xml")}, {}, ""),
        ({"m.xml": INCLUDES.format("gone.xml")}, {}, ""),
        ({"m.xml": INCLUDES.format("inner"), "inner/a.xml": "not read"}, {}, ""),
        ({"m.xml": INCLUDES.format("x" * 300)}, {}, ""),
        (
            {"m.xml": INCLUDES.format("../beside.xml")},
            {},
            "it names {0}/../beside.xml, which lies outside the folders this server may read models from ({0})",
        ),
        ({"m.xml": INCLUDES.format("out.xml")}, {}, "it names {0}/out.xml, which lies outside"),
        (
            {"m.xml": INCLUDES.format("inner/a.xml"), "inner/a.xml": INCLUDES.format("../../beside.xml")},
            {},
            "it names {0}/inner/../../beside.xml, which lies outside",
        ),
        ({"m.xml": INCLUDES.format("pipe")}, {}, "it names {0}/pipe, which is not a regular file"),
        ({"m.xml": INCLUDES.format("a.xml"), "a.xml": "<mujoco>"}, {"most_files": 1}, "the limit model_files, 1"),
        (
            {"m.xml": INCLUDES.format("a.xml"), "a.xml": "<" * 99},
            {"most_bytes": 98},
            "{0}/a.xml is larger than the limit model_file_bytes, 98",
        ),
        ({"m.xml": INCLUDES.format("a.xml"), "a.xml": "<"}, {}, "it names {0}/a.xml; it is not XML"),
        ({"m.xml": "<"}, {}, "it is not XML that is understood here: see line 1"),
    ],
)
def test_what_a_model_names_lies_in_its_folders(
    tmp_path: Path, files: dict[str, str], limits: dict[str, int], problem: str
) -> None:
    """What the child checks before MuJoCo reads a model."""
    root = tmp_path.resolve() / "models"
    (root / "inner").mkdir(parents=True)
    (tmp_path / "beside.xml").write_text("<mujoco/>", encoding="utf-8")
    (root / "out.xml").symlink_to(tmp_path / "beside.xml")
    os.mkfifo(root / "pipe")
    for name, text in files.items():
        (root / name).write_text(text, encoding="utf-8")
    allowed = {"most_bytes": 1000, "most_files": 10, **limits}
    if not problem:
        references.check_references(root / "m.xml", (root,), **allowed)
        return
    with pytest.raises(references.Outside) as refused:
        references.check_references(root / "m.xml", (root,), **allowed)
    assert problem.format(root) in str(refused.value)


@pytest.mark.skipif(not is_available(), reason="the kernel has no Landlock")
def test_the_kernel_keeps_mujoco_from_files_that_a_check_missed(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = (
        "from urlab_client._sandbox import process\n"
        "from urlab_client.server.assets import importer\n"
        "importer.check_references = lambda *arguments: None\n"
        "process.serve()\n"
    )
    monkeypatch.setattr(process, "_children", process._Children())
    monkeypatch.setattr(process._Child, "program", program)
    for name, file in (("inside", "meshes/figure.obj"), ("outside", str(folder / "secret.obj"))):
        model = folder / "root" / f"{name}.xml"
        model.write_text(FIGURE.format(file=file))
        (tmp_path / name).mkdir()
        order = (model, tmp_path / name / "snapshot", (folder / "root",), LIMITS)
        if name == "inside":
            assert importer.build_confined(*order).n_bytes
        else:
            with pytest.raises(Refusal, match="MuJoCo rejects"):
                importer.build_confined(*order)
    process._children.close()
    assert not [*(tmp_path / "outside").rglob("*.obj")]


@pytest.mark.skipif(not is_available(), reason="the kernel has no Landlock")
def test_a_confined_process_opens_nothing_else(tmp_path: Path) -> None:
    for name in ("read", "write", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
    (tmp_path / "read" / "link").symlink_to(tmp_path / "other" / "file")
    program = (
        "import os, pathlib, socket, sys\n"
        "from urlab_client._sandbox.confinement import confine_files\n"
        "here = pathlib.Path(sys.argv[1])\n"
        "kept = open(here / 'other' / 'file')\n"
        "server = socket.create_server(('127.0.0.1', 0))\n"
        "assert confine_files([here / 'read', here / 'missing'], [here / 'write'])\n"
        "def denied(what, *arguments):\n"
        "    try:\n"
        "        what(*arguments)\n"
        "    except PermissionError:\n"
        "        return True\n"
        "assert kept.read() == 'other'\n"
        "assert open(here / 'read' / 'file').read() == 'read'\n"
        "assert os.listdir(here / 'read')\n"
        "open(here / 'write' / 'new', 'w').write('x')\n"
        "os.remove(here / 'write' / 'new')\n"
        "assert denied(open, here / 'other' / 'file')\n"
        "assert denied(open, here / 'read' / 'link')\n"
        "assert denied(open, here / 'read' / 'new', 'w')\n"
        "assert denied(os.listdir, here)\n"
        "assert denied(os.execv, '/bin/true', ['true'])\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=True)


def test_a_server_says_when_the_kernel_does_not_help(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(open_server, "is_available", lambda: False)
    with caplog.at_level("INFO"), SimulatedServer():
        pass
    assert [(record.levelname, "no Landlock" in record.message) for record in caplog.records][:1] == [("INFO", True)]
    caplog.clear()
    with SimulatedServer(host="0.0.0.0", insecure_no_auth=True):
        pass
    assert [record.message for record in caplog.records if "no Landlock" in record.message]


PATHS = [
    "../secret.xml", "{root}/../secret.xml", "{folder}/secret.xml", "linked.xml", "{root}/linked.xml", "", ".", "..",
    "secret.xml\0", "\0", "C:\\Windows\\win.ini", "C:secret.xml", "\\\\host\\share\\x.xml", "//host/share/x.xml",
    "file:///etc/passwd", "~/x.xml", "/dev/zero", "/proc/self/mem", "CON", "x" * 4000, "a/" * 2000, "root/../../x.xml",
]  # fmt: skip


@pytest.mark.parametrize("path", PATHS)
def test_paths_that_lead_out(path: str, wire: Wire, folder: Path) -> None:
    link = folder / "root" / "linked.xml"
    if not link.is_symlink():
        link.symlink_to(folder / "secret.xml")
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*") if file.is_file()}
    text = path.replace("{root}", str(folder / "root")).replace("{folder}", str(folder))
    assert wire.refusal("import_xml", path=text)[0] in ("import_failed", "missing_field")
    assert wire.refused("load_level", level_path=text) in ("load_level_failed", "missing_field")
    assert wire.refused("create_level", name=text) in ("create_level_failed", "missing_field")
    assert before == {file: file.stat().st_mtime_ns for file in folder.rglob("*") if file.is_file()}


def test_recordings_stay_where_they_belong(folder: Path) -> None:
    with (
        SimulatedServer("ball", model_roots=[folder / "root"], play=True, unpaused=True, step_mode="direct") as server,
        Wire(server) as wire,
    ):
        wire.hello()
        wire.ask("recording_start")
        wire.ask("step", n_steps=3)
        wire.ask("recording_stop")
        fence = folder / "root" / "fence"
        fence.symlink_to(folder)
        fenced = os.path.lexists(fence)  # Wine makes none, and does not say so
        outside = sorted(folder.iterdir())
        for path in (*PATHS, str(fence / "out.json"), str(folder / "out.json")):
            text = path.replace("{root}", str(folder / "root")).replace("{folder}", str(folder))
            if text:
                reply = wire.raw({"op": "recording_save", "session_id": wire.session_id, "path": text})
                if reply["op"] != "error":  # an odd name, but in the folder of recordings
                    assert Path(reply["absolute_path"]).resolve().is_relative_to(server.saved_dir), text
                reply = wire.raw({"op": "replay_load", "session_id": wire.session_id, "path": text})
                assert reply["op"] == "replay_load_ok" or reply["code"] == "path_not_readable", text
        assert sorted(folder.iterdir()) == outside
        assert os.path.lexists(fence) == fenced


def test_a_level_that_a_client_opens_names_no_files_elsewhere(folder: Path, tmp_path: Path) -> None:
    levels = tmp_path / "Levels"
    levels.mkdir()
    crate = {"name": "Crate_0", "kind": "static_mesh", "mesh": {"shape": "file", "file": str(folder / "secret.obj")}}
    blueprint = {"source": "x.xml", "record": str(folder / "blueprint.json")}
    robot = {"name": "b", "kind": "articulation", "blueprint": "b"}
    for name, blueprints, actor in (("thief", {}, crate), ("other", {"b": blueprint}, robot)):
        level = {"format": "urlab-level", "version": 1, "blueprints": blueprints, "actors": [actor]}
        (levels / f"{name}.json").write_bytes(msgspec.json.encode(level))
    with SimulatedServer(saved_dir=tmp_path, model_roots=[folder / "root"]) as server, Wire(server) as wire:
        wire.hello()
        for name in ("thief", "other"):
            code, message = wire.refusal("load_level", level_path=name)
            assert code == "load_level_failed"
            assert "outside the folders" in message


def test_a_record_that_a_client_may_have_written_is_not_adopted(folder: Path, tmp_path: Path) -> None:
    """What it says was compiled, in a snapshot that never was, would be read with nothing in the way."""
    home = folder / "root" / "forged"
    (home / "0123456789abcdef").mkdir(parents=True)
    (home / "0123456789abcdef" / "model.xml").write_text(FIGURE.format(file=folder / "secret.obj"))
    record = {"stem": "b", "source": "b.xml", "source_digest": "", "digest": "0123456789abcdef", "model_name": "b"}
    record |= {"imported_at": "2026-01-01T00:00:00Z", "joints": [], "actuators": [], "actuator_types": {}}
    (home / "blueprint.json").write_bytes(msgspec.json.encode(record | {"sensors": [], "cameras": []}))
    (home / "b.xml").write_text(FIGURE.format(file=folder / "secret.obj"))
    level = {
        "format": "urlab-level",
        "version": 1,
        "blueprints": {
            "b": {"source": f"{home}/b.xml", "digest": "0123456789abcdef", "record": f"{home}/blueprint.json"}
        },
        "actors": [{"name": "b", "kind": "articulation", "blueprint": "b"}],
    }
    (tmp_path / "Levels").mkdir()
    (tmp_path / "Levels" / "forged.json").write_bytes(msgspec.json.encode(level))
    with SimulatedServer(saved_dir=tmp_path, model_roots=[folder / "root"]) as server, Wire(server) as wire:
        wire.hello()
        code, message = wire.refusal("load_level", level_path="forged")
    assert code == "load_level_failed"
    assert "secret.obj, which lies outside the folders" in message
    assert not [*tmp_path.rglob("*.obj")]


def test_whoever_runs_the_server_may_name_any_file(folder: Path) -> None:
    with SimulatedServer(folder / "secret.xml", model_roots=[folder / "root"]) as server, Wire(server) as wire:
        wire.hello()
        assert len(wire.ask("list_actors")["actors"]) == 2


def test_a_child_that_was_killed_is_replaced(wire: Wire, folder: Path) -> None:
    model = folder / "root" / "again.xml"
    model.write_text('<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>')
    wire.ask("import_xml", path=str(model))
    assert process._children.idle is not None
    child = process._children.idle.process
    child.kill()
    child.wait(30)
    assert wire.ask("import_xml", path=str(model), force_reimport=True)["imported_now"] is True


@pytest.mark.parametrize("count", [0, 3])
def test_pictures_of_a_model_that_lie_about_their_size(count: int, wire: Wire, folder: Path) -> None:
    bomb = folder / "root" / "lies.png"
    bomb.write_bytes(
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 2**31 - 1, 2**31 - 1, 8, 6, 0, 0, 0) * count
    )
    model = folder / "root" / "lies.xml"
    model.write_text('<mujoco><asset><texture name="t" type="2d" file="lies.png"/></asset></mujoco>')
    assert "lies" in refusal(wire, model)


async def test_physics_and_streams_go_on_while_a_model_compiles(folder: Path) -> None:
    bomb = folder / "root" / "slow.xml"
    bomb.write_text(f"<mujoco>{PLAIN}</mujoco>")
    quick = folder / "root" / "quick.xml"
    quick.write_text('<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>')
    limits = Limits(camera_side=63)
    async with (
        SimulatedServer("arm", play=True, unpaused=True, model_roots=[bomb.parent], limits=limits) as server,
        URLabClient(**server.client_options(), step_mode="live") as client,
    ):
        await client.discover()
        await client.scene.import_xml(str(quick))
        assert process._children.idle is not None
        child = process._children.idle.process
        child.send_signal(signal.SIGSTOP)  # it takes as long as the rest does
        try:
            compiling = asyncio.create_task(client.scene.import_xml(str(bomb), timeout=None))
            await asyncio.sleep(0)  # it has its turn before the next call
            with pytest.raises(URLabTimeoutError, match="another call held"):
                await client.scene.current_level(timeout=0.1)
            async with client.state_stream("all") as states:
                for _ in range(20):
                    await states.receive()
            assert client.connected
            assert not compiling.done()
        finally:
            child.send_signal(signal.SIGCONT)
        with pytest.raises(ImportFailed, match="the limit camera_side"):
            await compiling
        await client.scene.current_level()
