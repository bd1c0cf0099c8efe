"""Models and archives of strangers: unpacked, checked and compiled in a child process with limits."""

from __future__ import annotations

import contextlib
import io
import stat
import struct
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from urlab_client._sandbox import process, references
from urlab_client._sandbox.confinement import is_available
from urlab_client.aio.model import archive as archive_module
from urlab_client.aio.model import compilation
from urlab_client.aio.model.archive import unpacked
from urlab_client.aio.model.compilation import flatten_confined

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
WITH_MESH = (
    '<mujoco><asset><mesh name="m" file="{}"/></asset><worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>'
)
NAMING = {
    "texture": '<mujoco><asset><texture name="t" type="2d" file="{}"/></asset></mujoco>',
    "cube": '<mujoco><asset><texture name="t" type="cube" fileright="{}"/></asset></mujoco>',
    "mesh": WITH_MESH,
    "hfield": '<mujoco><asset><hfield name="h" size="1 1 1 1" file="{}"/></asset></mujoco>',
    "skin": '<mujoco><asset><skin name="s" file="{}"/></asset></mujoco>',
    "model": '<mujoco><asset><model name="a" file="{}"/></asset></mujoco>',
    "include": '<mujoco><include file="{}"/></mujoco>',
    "flex": '<mujoco><worldbody><flexcomp name="f" type="mesh" file="{}"/></worldbody></mujoco>',
    "meshdir": '<mujoco><compiler meshdir="{}"/><asset><mesh name="m" file="t.obj"/></asset></mujoco>',
    "included": '<mujoco><include file="sub/part.txt"/></mujoco>',
}
LEADING_OUT = [
    "{folder}/t.obj", "/etc/passwd", "../../t.obj", "sub/../../../t.obj", "..\\..\\t.obj", "C:\\t.obj", "C:t.obj",
    "\\\\host\\share\\t.obj", "&#47;etc/passwd", "./../.././/t.obj",
]  # fmt: skip


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The child's working folder with an empty room for content, in this process."""
    monkeypatch.chdir(tmp_path)
    content = compilation._CONTENT
    content.mkdir(parents=True)
    return content


def zipped(files: dict[str, bytes], change: Callable[[zipfile.ZipInfo], None] = lambda _: None) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name)
            change(entry)
            archive.writestr(entry, content)
    return buffer.getvalue()


def unpack(data: bytes) -> list[str]:
    """Unpack an archive and return its files; nothing may be written elsewhere."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "crate.zip").write_bytes(data)
        try:
            unpacked(folder / "crate.zip", folder / "content")
            content = folder / "content"
            return [path.relative_to(content).as_posix() for path in content.rglob("*") if path.is_file()]
        finally:
            assert {path.name for path in folder.iterdir()} <= {"crate.zip", "content"}


@pytest.mark.parametrize("leading", LEADING_OUT)
@pytest.mark.parametrize("how", NAMING)
def test_a_model_names_no_file_but_its_own_whether_or_not_it_exists(room: Path, how: str, leading: str) -> None:
    for exists in (True, False):
        folder = Path.cwd() / ("there" if exists else "missing")
        if exists:
            folder.mkdir()
            (folder / "t.obj").write_text(MESH)
        (room / "m.xml").write_text(NAMING[how].format(leading.format(folder=folder)))
        if how == "included":
            (room / "sub").mkdir(exist_ok=True)
            (room / "sub" / "part.txt").write_text(WITH_MESH.format(leading.format(folder=folder)))
        with pytest.raises(ValueError, match="a model may name only files that come with it, by relative paths"):
            references.refuse_outside(room / "m.xml", room)


def test_a_model_names_its_own_files_from_where_they_lie(room: Path) -> None:
    for name, text in {
        "xml/m.xml": '<mujoco><compiler meshdir="../meshes"/><include file="parts/p.xml"/></mujoco>',
        "xml/parts/p.xml": WITH_MESH.format("t.obj"),
        "meshes/t.obj": MESH,
    }.items():
        (room / name).parent.mkdir(exist_ok=True, parents=True)
        (room / name).write_text(text)
    references.refuse_outside(room / "xml" / "m.xml", room)


UNWATCHED = """
from urlab_client._sandbox import process
from urlab_client.aio.model import compilation

compilation.refuse_outside = lambda *_: None
process.serve()
"""


@pytest.mark.skipif(not is_available(), reason="the kernel has no Landlock")
def test_what_names_hide_cannot_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process without its own look at the model."""
    (tmp_path / "child").mkdir()
    (tmp_path / "secret.obj").write_text(MESH)
    (tmp_path / "child" / "m.xml").write_text(WITH_MESH.format(tmp_path / "secret.obj"))
    monkeypatch.setattr(process._Child, "program", UNWATCHED)
    with pytest.raises(process.Refused):
        flatten_confined(tmp_path / "child" / "m.xml")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="there is no limit of memory")
def test_a_huge_texture_takes_no_more_memory_than_it_may(tmp_path: Path) -> None:
    texture = '<texture name="t" type="2d" builtin="flat" width="40000" height="40000"/>'
    (tmp_path / "m.xml").write_text(f"<mujoco><asset>{texture}</asset></mujoco>")
    with pytest.raises(ValueError, match="it needs more memory than 1024 MiB"):
        flatten_confined(tmp_path / "m.xml")


def test_work_that_is_broken_off_leaves_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Enough(Exception):
        pass

    def stop(_: int) -> None:
        raise Enough

    monkeypatch.setattr(process._Child, "program", "import time; time.sleep(3600)")
    started: list[process._Child] = []
    start = process._Child.__init__
    monkeypatch.setattr(process._Child, "__init__", lambda self: (started.append(self), start(self))[1])
    with pytest.raises(Enough):
        flatten_confined(tmp_path / "m.xml", stop)
    assert [child.process.returncode is not None for child in started] == [True]


MODEL = {"m.xml": b"<mujoco/>", "meshes/t.obj": MESH.encode()}


def attribute(name: str, value: int) -> Callable[[zipfile.ZipInfo], None]:
    return lambda entry: setattr(entry, name, value)


def patched(data: bytes, signature: bytes, offset: int, value: bytes) -> bytes:
    """Write into every header that begins with a signature."""
    changed = bytearray(data)
    at = data.find(signature)
    while at >= 0:
        changed[at + offset : at + offset + len(value)] = value
        at = data.find(signature, at + 4)
    return bytes(changed)


LOCAL, CENTRAL = b"PK\3\4", b"PK\1\2"


def claiming(method: int) -> bytes:
    data = patched(zipped(MODEL), LOCAL, 8, struct.pack("<H", method))
    return patched(data, CENTRAL, 10, struct.pack("<H", method))


def bomb(n_entries: int) -> bytes:
    """Many entries with one and the same data."""
    one = zipped({"m.xml": b"<mujoco/>"})
    start, end = one.find(CENTRAL), one.find(b"PK\5\6")
    entry, tail = one[start:end], one[end:]
    central = b"".join(entry.replace(b"m.xml", b"%05d" % number) for number in range(n_entries))
    counts = struct.pack("<HHLL", n_entries, n_entries, len(central), start)
    return one[:start] + central + tail[:8] + counts + tail[20:]


REFUSED = {
    "encrypted": (patched(zipped(MODEL), CENTRAL, 8, b"\1\0"), "pack it without a password"),
    "bzip2": (zipped(MODEL, attribute("compress_type", zipfile.ZIP_BZIP2)), "compressed by bzip2"),
    "lzma": (zipped(MODEL, attribute("compress_type", zipfile.ZIP_LZMA)), "compressed by lzma"),
    "deflate64": (claiming(9), "compressed by deflate64"),
    "unknown": (claiming(77), "compressed by method 77"),
    "deflated nonsense": (claiming(8), "damaged"),
    "truncated": (zipped(MODEL)[:-30], "not a ZIP archive"),
    "beheaded": (zipped(MODEL)[40:], "damaged"),
    "longer than said": (patched(zipped(MODEL), CENTRAL, 24, struct.pack("<L", 3)), "damaged"),
    "shorter than said": (patched(zipped(MODEL), CENTRAL, 24, struct.pack("<L", 3000)), "damaged"),
    "huge": (patched(zipped(MODEL), CENTRAL, 24, struct.pack("<L", 2**32 - 2)), "unpacks to more than 1073741824"),
    "overlapping": (bomb(2), "damaged"),
    "many": (bomb(5000), "has 5000 entries, more than 4096"),
    "a link": (
        zipped({**MODEL, "link": b"/etc/passwd"}, attribute("external_attr", (stat.S_IFLNK | 0o777) << 16)),
        "has 'm.xml', which is a link",
    ),
    "absolute": (zipped({**MODEL, "/tmp/a": b""}), "outside its own folder.*: '/tmp/a'"),
    "climbing": (zipped({**MODEL, "a/../../b": b""}), "outside its own folder"),
    "a drive": (zipped({**MODEL, "C:/a": b""}), "outside its own folder"),
    "backslashes": (zipped({**MODEL, "..\\a": b""}), "outside its own folder"),
    "a device": (zipped({**MODEL, "meshes/nul.obj": b""}), "not valid everywhere"),
    "null bytes": (zipped({**MODEL, "aXb": b""}).replace(b"aXb", b"a\0b"), "not valid everywhere"),
    "too long a name": (zipped({**MODEL, "a" * 250: b""}), "not valid everywhere"),
    "too long a path": (zipped({**MODEL, "/".join(["a" * 200] * 6): b""}), "not valid everywhere"),
    "twice": (zipped({**MODEL, "M.XML": b""}), "one on some systems: 'M.XML'"),
    "file and folder": (zipped({**MODEL, "meshes": b""}), "damaged"),
    "no model": (zipped({"a.txt": b""}), "must have one .xml file"),
    "two models": (zipped({"a.xml": b"", "b.xml": b""}), "must have one .xml file at its top"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_archives_that_are_refused(kind: str) -> None:
    data, said = REFUSED[kind]
    with pytest.raises(ValueError, match=said):
        unpack(data)


def test_archives_that_are_unpacked() -> None:
    deflated = zipped(MODEL, attribute("compress_type", zipfile.ZIP_DEFLATED))
    made_elsewhere = zipped({"crate/": b"", "crate/crate.xml": b"", "crate/m/ü.obj": b"", "__MACOSX/._crate.xml": b""})
    for data in (zipped(MODEL), deflated, made_elsewhere):
        assert len(unpack(data)) >= 2


def test_an_archive_unpacks_to_no_more_than_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    data = zipped({"m.xml": bytes(10_000)}, attribute("compress_type", zipfile.ZIP_DEFLATED))
    monkeypatch.setattr(archive_module, "_MAX_BYTES", 9_999)
    with pytest.raises(ValueError, match="unpacks to more than 9999 bytes"):
        unpack(data)


@given(st.data())
def test_damaged_archives_are_refused_or_unpacked(data: st.DataObject) -> None:
    method = data.draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))
    damaged = bytearray(zipped({**MODEL, "meshes/ü.obj": b"x"}, attribute("compress_type", method)))
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, len(damaged) - 1))
        damaged[at] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(damaged)) | st.none())
    with contextlib.suppress(ValueError):  # any other exception is a failure
        assert unpack(bytes(damaged[:cut]))
