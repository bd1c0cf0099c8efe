"""Models of servers that are neither on this machine nor known by their key: compiled in a child, with limits."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hello import hello_ok
from msgspec.structs import replace

from urlab_client._sandbox import process, references
from urlab_client._sandbox.process import ProcessLimits
from urlab_client.aio import URLabClient
from urlab_client.aio import client as client_module
from urlab_client.aio.model import compilation
from urlab_client.errors import ProtocolError

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BODY = '<body><freejoint/><geom size=".1"/></body>'
HUGE = f'<mujoco><worldbody><replicate count="1000000">{BODY}</replicate></worldbody></mujoco>'
BALLS = "".join(
    f'<body pos="{i * 0.15} 0 {0.05 + 0.1 * (i % 2)}"><freejoint/><geom size=".1"/></body>' for i in range(8)
)
# Contacts, and a solver that is never content.
ENDLESS = (
    '<mujoco><option solver="PGS" iterations="2000000000" tolerance="0"/>'
    f'<worldbody><geom type="plane" size="1 1 1"/>{BALLS}</worldbody></mujoco>'
)


@pytest.fixture
def told(scripted: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., URLabClient]:
    """Make a client of a server that sends this model and seems to be on another machine."""
    monkeypatch.setattr(client_module, "is_local", lambda address: False)

    def make(xml: str, assets: dict[str, bytes] | None = None, **options: Any) -> URLabClient:
        scripted.on("hello", hello_ok(mjcf_compiled=xml, vfs_assets=assets or {}))
        return URLabClient("tcp://127.0.0.1", step_port=scripted.port, **options)

    return make


async def test_it_is_compiled_with_the_files_that_came_with_it(told: Callable[..., URLabClient]) -> None:
    xml = (
        '<mujoco><compiler meshdir="/nowhere/meshes"/><asset><mesh name="m" file="m.obj"/></asset>'
        '<worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>'
    )
    async with told(xml, {"m.obj": MESH.encode()}) as client:
        await client.discover()
        assert client.model is not None
        assert client.model.nmeshvert == 4
        assert client.model_is_approximate


async def test_it_reads_no_file_of_this_machine(told: Callable[..., URLabClient], tmp_path: Path) -> None:
    secret = tmp_path / "secret.obj"
    secret.write_text(MESH)
    async with told(f'<mujoco><asset><mesh file="{secret}"/></asset></mujoco>') as client:
        with pytest.raises(ProtocolError, match=r"a file of this machine.*local_model=False"):
            await client.discover()
        assert client.model is None


@pytest.mark.parametrize(
    "xml",
    [
        '<mujoco><compiler meshdir="{folder}"/><asset><mesh file="secret.obj"/></asset></mujoco>',
        '<mujoco><compiler strippath="true" meshdir="{folder}"/><asset><mesh file="x/secret.obj"/></asset></mujoco>',
        '<mujoco><include file="{file}"/></mujoco>',
        '<mujoco><asset><hfield name="h" size="1 1 1 1" file="{escaped}"/></asset></mujoco>',
        '<mujoco><asset><texture name="t" type="2d" file="/dev/zero"/></asset></mujoco>',
    ],
)
def test_however_it_names_a_file_of_this_machine_it_is_refused(tmp_path: Path, xml: str) -> None:
    secret = tmp_path / "secret.obj"
    secret.write_text(MESH)
    named = xml.format(file=secret, folder=tmp_path, escaped=str(secret).replace("/", "&#47;"))
    with pytest.raises(ValueError, match="a file of this machine"):
        references.refuse_local_files(named, {})


INCLUDING = '<mujoco><include file="sub/part.xml"/></mujoco>'
ATTACHING = '<mujoco><asset><model name="a" file="part.xml"/></asset></mujoco>'


async def test_documents_that_came_with_it_read_none_either(told: Callable[..., URLabClient], tmp_path: Path) -> None:
    secret = tmp_path / "secret.obj"
    secret.write_text(MESH)
    part = f'<mujoco><asset><mesh name="m" file="{secret}"/></asset></mujoco>'
    async with told(INCLUDING, {"part.xml": part.encode()}) as client:
        with pytest.raises(ProtocolError, match=r"a file of this machine.*local_model=False"):
            await client.discover()
    for disguise in ("", " " * 256, "\v", "\ufeff\ufeff", "A poem. ", '<!-- file=" -->'):
        for xml in (INCLUDING, ATTACHING):
            with pytest.raises(ValueError, match=r"secret\.obj, a file of this machine"):
                references.refuse_local_files(xml, {"part.xml": (disguise + part).encode()})


PART = (
    '<mujoco><asset><mesh name="m" file="{file}"/></asset>'
    '<worldbody><body name="b"><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
)
ATTACHED = (
    '<mujoco><asset><model name="a" file="part.xml"/></asset>'
    '<worldbody><frame><attach model="a" body="b" prefix="x"/></frame></worldbody></mujoco>'
)
UNWATCHED = """
from urlab_client._sandbox import process
from urlab_client.aio.model import compilation

compilation.refuse_local_files = process.confine_files = lambda *_: None
process.serve()
"""


@pytest.mark.parametrize(
    ("xml", "assets"),
    [
        (PART, {}),
        (INCLUDING, {"part.xml": PART}),
        (ATTACHED, {"part.xml": PART}),
    ],
)
def test_what_its_names_hide_from_the_client_cannot_be_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, xml: str, assets: dict[str, str]
) -> None:
    """The process without its own look at the model, and without Landlock."""
    secret = tmp_path / "secret.obj"
    secret.write_text(MESH)
    monkeypatch.setattr(process._Child, "program", UNWATCHED)
    with pytest.raises(process.Refused):
        compilation.compile_confined(
            xml.replace("{file}", str(secret)),
            {name: text.replace("{file}", str(secret)).encode() for name, text in assets.items()},
        )


def test_it_may_not_hide_names_in_entities() -> None:
    with pytest.raises(ValueError, match="document type"):
        references.refuse_local_files('<!DOCTYPE mujoco [<!ENTITY f "/etc/passwd">]><mujoco/>', {})


@pytest.mark.parametrize("limits", [compilation.LIMITS, compilation.UPLOAD_LIMITS], ids=["served", "uploaded"])
def test_the_limits_are_those_that_the_page_names(limits: ProcessLimits) -> None:
    page = " ".join((Path(__file__).parents[2] / "docs" / "security.md").read_text(encoding="utf-8").split())
    memory, processor = f"{limits.memory_bytes / 2**30:g} GiB of memory", f"{limits.cpu_s:g} s of processor time"
    assert f"may use {memory} (Linux), {processor} (Linux, macOS) and {limits.wall_s:g} s in total" in page


@pytest.mark.parametrize("xml", [HUGE, ENDLESS], ids=["huge", "endless"])
async def test_it_takes_no_more_time_than_it_may(
    told: Callable[..., URLabClient], monkeypatch: pytest.MonkeyPatch, xml: str
) -> None:
    monkeypatch.setattr(compilation, "LIMITS", replace(compilation.LIMITS, cpu_s=1))
    async with told(xml) as client:
        with pytest.raises(ProtocolError, match=r"more than 1 s of processor time.*trust_server=True"):
            await client.discover()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="there is no limit of memory")
async def test_it_takes_no_more_memory_than_it_may(
    told: Callable[..., URLabClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation, "LIMITS", replace(compilation.LIMITS, memory_bytes=64 * 2**20))
    texture = '<texture name="t" type="2d" builtin="flat" width="8000" height="8000"/>'
    async with told(f"<mujoco><asset>{texture}</asset></mujoco>") as client:
        with pytest.raises(ProtocolError, match=r"allocate memory.*trust_server=True"):
            await client.discover()


async def test_what_mujoco_says_of_it_is_passed_on(told: Callable[..., URLabClient]) -> None:
    async with told("<mujoco><worldbody><geom/></worldbody></mujoco>") as client:
        with pytest.raises(ProtocolError, match="size"):
            await client.discover()


async def test_a_trusted_server_has_no_limits(
    told: Callable[..., URLabClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(references, "_MOST_COMBINATIONS", -1)
    async with told(f"<mujoco><worldbody>{BODY}</worldbody></mujoco>", trust_server=True) as client:
        await client.discover()
        assert client.model is not None
