"""Models over the wire, over a raw socket: what a client of the beta may send, and what is refused."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from raw_shm import RawShm
from wire import Wire, files_of_at_most

from urlab_client.server import Limits, SimulatedServer
from urlab_client.server.assets.uploads import IDLE_S, MAX_OPEN

MESH = b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
XML = b"""
<mujoco model="sent">
  <asset><mesh name="part" file="part.obj"/></asset>
  <worldbody><body><joint name="j" type="hinge"/><geom type="mesh" mesh="part"/></body></worldbody>
</mujoco>
"""


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def manifest(xml: bytes = XML, **files: bytes) -> dict[str, Any]:
    assets = [
        {"name": name.replace("_", "."), "sha256": digest(data), "size": len(data)} for name, data in files.items()
    ]
    return {"xml_sha256": digest(xml), "total_bytes": len(xml) + sum(map(len, files.values())), "assets": assets}


def chunk(upload: str, data: bytes, name: str = "", **fields: Any) -> dict[str, Any]:
    kind = "asset" if name else "xml"
    return {"upload_id": upload, "kind": kind, "name": name, "offset": 0, "total": len(data), "data": data, **fields}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[SimulatedServer]:
    limits = Limits(model_cpu_s=1, model_memory_bytes=256 * 2**20)
    with SimulatedServer(dialect="beta", saved_dir=tmp_path / "saved", limits=limits) as server:
        yield server


@pytest.fixture
def wire(server: SimulatedServer) -> Iterator[Wire]:
    with Wire(server) as wire:
        wire.hello()
        yield wire


def test_a_model_is_sent_and_spawned(wire: Wire) -> None:
    """Beta statements 59 and 62."""
    said = manifest(part_obj=MESH)
    opened = wire.ask("upload_model_manifest", **said)
    assert (opened["need_xml"], opened["need_assets"]) == (True, ["part.obj"])
    upload = opened["upload_id"]
    half = len(MESH) // 2
    first = wire.ask("upload_model_chunk", **chunk(upload, MESH[:half], "part.obj", total=len(MESH)))
    assert (first["received"], first["complete"]) == (half, False)
    last = wire.ask("upload_model_chunk", **chunk(upload, MESH[half:], "part.obj", total=len(MESH), offset=half))
    assert (last["name"], last["received"], last["complete"]) == ("part.obj", len(MESH), True)
    assert wire.ask("upload_model_chunk", **chunk(upload, XML))["name"] == "<xml>"

    again = wire.ask("upload_model_manifest", **said)
    assert (again["need_xml"], again["need_assets"]) == (False, [])

    done = wire.ask("upload_model_commit", upload_id=upload)
    assert done["imported"] is True
    assert "nq" not in done
    assert wire.refused("upload_model_commit", upload_id=upload) == "unknown_upload"
    (blueprint,) = wire.ask("list_blueprints")["blueprints"]
    assert blueprint["blueprint_class_path"] == done["blueprint_class_path"]
    job = wire.raw(
        {
            "op": "spawn_actor",
            "session_id": wire.session_id,
            "blueprint": done["blueprint_class_path"],
            "actor_id": "sent",
        }
    )
    for status in wire.until("op_status", job_id=job["job_id"]):
        if status["state"] != "running":
            assert status["result"]["op"] == "spawn_actor_ok"
            break


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"xml_sha256": "abc"}, "bad_request"),
        ({"xml_sha256": None}, "bad_request"),
        *(({"assets": [asset]}, "bad_request") for asset in ({}, None, "a.stl", {"name": "a.stl", "size": 0})),
        ({"assets": [{"name": "a.stl", "sha256": digest(b"")}]}, "payload_too_large"),
        ({"xml_sha256": digest(XML).upper()}, "bad_request"),
        ({"total_bytes": 2**30}, "payload_too_large"),
        *(
            ({"assets": [{"name": name, "sha256": digest(b""), "size": 0}]}, "bad_request")
            for name in ("a/b.stl", "..", "", "a\\b.stl", "C:x.stl", "model.xml", "Model.XML", "nul.stl", "a\nb")
        ),
        ({"assets": [{"name": "a.stl", "sha256": "0" * 63, "size": 0}]}, "bad_request"),
        # One file on some systems, with the content of either.
        (
            {"assets": [{"name": n, "sha256": digest(n.encode()), "size": 5} for n in ("a.stl", "A.STL")]},
            "bad_request",
        ),
        ({"assets": [{"name": "a.stl", "sha256": digest(b""), "size": 2**27}]}, "payload_too_large"),
        ({"assets": [{"name": "a.stl", "sha256": digest(b""), "size": -1}]}, "payload_too_large"),
        (
            {"assets": [{"name": f"{i}.stl", "sha256": digest(b""), "size": 2**26} for i in range(9)]},
            "payload_too_large",
        ),
        ({"assets": [{"name": f"{i}.stl", "sha256": digest(b""), "size": 0} for i in range(4097)]}, "bad_request"),
    ],
)
def test_manifests_that_are_refused(wire: Wire, tmp_path: Path, change: dict[str, Any], code: str) -> None:
    """Beta statement 58."""
    assert wire.refused("upload_model_manifest", **{**manifest(), **change}) == code
    assert not list(tmp_path.glob("saved/Uploads/.upload-*"))


def test_names_that_differ_in_letter_case_may_mean_the_same_content(wire: Wire) -> None:
    assets = [{"name": name, "sha256": digest(b"same"), "size": 4} for name in ("a.stl", "A.stl")]
    opened = wire.ask("upload_model_manifest", **{**manifest(), "assets": assets, "total_bytes": len(XML) + 4})
    assert opened["need_assets"] == ["a.stl", "A.stl"]


def test_uploads_that_are_open(wire: Wire, server: SimulatedServer) -> None:
    """Beta statement 58: the seventeenth is refused, until one was idle for long enough."""
    for _ in range(MAX_OPEN):
        wire.ask("upload_model_manifest", **manifest())
    assert wire.refused("upload_model_manifest", **manifest()) == "bad_request"
    core = server._running.core  # type: ignore[union-attr]
    now = core.uploads.clock()
    core.uploads.clock = lambda: now + IDLE_S + 1
    upload = wire.ask("upload_model_manifest", **manifest())["upload_id"]
    assert wire.ask("upload_model_chunk", **chunk(upload, XML))["complete"]


def test_chunks_that_are_refused(wire: Wire) -> None:
    """Beta statements 60 and 61."""
    said = manifest(part_obj=MESH)
    upload = wire.ask("upload_model_manifest", **said)["upload_id"]

    def refused(**change: Any) -> str:
        return wire.refused("upload_model_chunk", **{**chunk(upload, MESH, "part.obj"), **change})

    assert refused(kind="mesh") == "bad_request"
    assert refused(offset=-1) == "bad_request"
    assert refused(total=2**26 + 1) == "payload_too_large"
    assert refused(total=2**26) == "bad_request", "of another size than the manifest says"
    assert refused(data=b"") == "bad_request"
    assert refused(offset=1) == "bad_request"
    assert refused(upload_id="x") == "unknown_upload"
    assert refused(name="other.obj") == "bad_request"
    assert refused(total=len(MESH) + 1) == "bad_request"
    assert refused(data=bytes(len(MESH))) == "hash_mismatch"
    assert wire.refused("upload_model_commit", upload_id=upload) == "bad_request"
    assert wire.ask("upload_model_chunk", **chunk(upload, MESH, "part.obj"))["complete"]
    assert wire.ask("upload_model_chunk", **chunk(upload, MESH, "part.obj"))["received"] == len(MESH)
    assert wire.refused("upload_model_commit", upload_id=upload) == "bad_request"
    assert wire.refused("upload_model_commit", upload_id="") == "bad_request"
    assert wire.ask("upload_model_chunk", **chunk(upload, XML))["complete"]
    assert wire.ask("upload_model_commit", upload_id=upload)["imported"]


@pytest.mark.parametrize(
    "xml",
    [
        b"no XML",
        b"<mujoco><include file='/etc/hostname'/></mujoco>",
        b"<mujoco><include file='../../secret.xml'/></mujoco>",
        b"<mujoco><asset><mesh name='m' file='missing.obj'/></asset></mujoco>",
        b"<mujoco><worldbody>"
        + b"".join(b"<replicate count='500'>" for _ in range(3))
        + b"<geom size='1'/>"
        + b"</replicate>" * 3
        + b"</worldbody></mujoco>",
    ],
    ids=["text", "absolute include", "include outside", "missing", "bomb"],
)
def test_documents_that_are_refused(wire: Wire, tmp_path: Path, xml: bytes) -> None:
    (tmp_path / "saved").mkdir(exist_ok=True)
    (tmp_path / "saved" / "secret.xml").write_text("<mujoco/>")
    upload = wire.ask("upload_model_manifest", **manifest(xml))["upload_id"]
    wire.ask("upload_model_chunk", **chunk(upload, xml))
    assert wire.refused("upload_model_commit", upload_id=upload) == "import_failed"
    assert wire.refused("upload_model_commit", upload_id=upload) == "unknown_upload"
    assert wire.ask("list_blueprints")["blueprints"] == []
    assert not list(tmp_path.glob("saved/Uploads/.upload-*"))


def test_a_model_that_runs_is_described(wire: Wire) -> None:
    xml = b"<mujoco model='plain'><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    wire.raw({"op": "ensure_manager", "session_id": wire.session_id})
    wire.ask("begin_pie", timeout_s=20)
    upload = wire.ask("upload_model_manifest", **manifest(xml), step_mode="direct")["upload_id"]
    wire.ask("upload_model_chunk", **chunk(upload, xml))
    done = wire.ask("upload_model_commit", upload_id=upload)
    assert (done["nq"], done["nbody"]) == (0, 1)  # of the empty level
    assert done["mjb"]
    assert wire.ask("set_mode", mode="live")["previous_mode"] == "direct"


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Wire]:
    """A client of a server whose cache holds two documents and a half."""
    limits = Limits(upload_cache_bytes=len(XML) * 5 // 2)
    with SimulatedServer(dialect="beta", saved_dir=tmp_path, limits=limits) as server, Wire(server) as wire:
        wire.hello()
        yield wire


def used(wire: Wire, xml: bytes) -> bool:
    """Use a document for an upload, send it if it must be sent, and return whether it had to be."""
    opened = wire.ask("upload_model_manifest", **manifest(xml))
    if opened["need_xml"]:
        wire.ask("upload_model_chunk", **chunk(opened["upload_id"], xml))
    wire.refused("upload_model_commit", upload_id=opened["upload_id"])  # the mesh is missing, the upload is closed
    return opened["need_xml"]


def test_the_document_used_longest_ago_gives_way(small: Wire) -> None:
    one, two, three = XML, XML.replace(b"sent", b"two_"), XML.replace(b"sent", b"more")
    assert [used(small, xml) for xml in (one, two, one, three, one, two)] == [True, True, False, True, False, True]


def stored(root: Path) -> list[Path]:
    return [file for file in root.rglob("Uploads/**/*") if file.is_file() and file.name != ".alive"]


def test_what_is_under_way_is_bounded_too(small: Wire, tmp_path: Path) -> None:
    def held() -> list[int]:
        return [file.stat().st_size for file in stored(tmp_path)]

    assert used(small, XML)
    other = [XML.replace(b"sent", name) for name in (b"two_", b"more", b"last")]
    for xml in other[:2]:  # most of each, for which the document in the cache gives way
        upload = small.ask("upload_model_manifest", **manifest(xml))["upload_id"]
        small.ask("upload_model_chunk", **chunk(upload, xml[:-1], total=len(xml)))
    assert held() == [len(XML) - 1] * 2
    upload = small.ask("upload_model_manifest", **manifest(other[2]))["upload_id"]
    code, message = small.refusal("upload_model_chunk", **chunk(upload, other[2]))
    assert code == "payload_too_large"
    assert f"would take {3 * len(XML) - 2} bytes, more than the limit upload_cache_bytes" in message
    assert held() == [len(XML) - 1] * 2


def test_a_file_that_a_full_disk_cuts_short_does_not_stay_on_it(wire: Wire, tmp_path: Path) -> None:
    upload = wire.ask("upload_model_manifest", **manifest())["upload_id"]
    half = len(XML) // 2
    wire.ask("upload_model_chunk", **chunk(upload, XML[:half], total=len(XML)))
    with files_of_at_most(half + 1):
        assert "File too large" in wire.refusal("upload_model_chunk", **chunk(upload, XML))[1]
        assert not stored(tmp_path)
    assert wire.ask("upload_model_chunk", **chunk(upload, XML))["complete"]


def test_no_upload_begins_where_nothing_can_be_stored(wire: Wire, tmp_path: Path) -> None:
    (tmp_path / "saved").mkdir(exist_ok=True)
    (tmp_path / "saved" / "Uploads").touch()
    code, message = wire.refusal("upload_model_manifest", **manifest())
    assert (code, message.startswith("the upload cannot be stored: ")) == ("internal_error", True)


@pytest.mark.parametrize("damage", [b"", b"<mujoco/>", XML.replace(b"sent", b"bent")])
@pytest.mark.parametrize("part", ["document", "mesh"])
def test_a_damaged_file_in_the_cache_is_asked_for_again(part: str, damage: bytes, wire: Wire, tmp_path: Path) -> None:
    document = XML.replace(b"hinge", b"slide")
    said = manifest(document, part_obj=MESH)
    data, name = (document, "") if part == "document" else (MESH, "part.obj")
    damaged = tmp_path / "saved" / "Uploads" / "cache" / digest(data)
    upload = wire.ask("upload_model_manifest", **said)["upload_id"]
    wire.ask("upload_model_chunk", **chunk(upload, document))
    wire.ask("upload_model_chunk", **chunk(upload, MESH, "part.obj"))
    damaged.write_bytes(damage[: len(data)].ljust(len(data) if damage else 0))
    again = wire.ask("upload_model_manifest", **said)
    assert (again["need_xml"], again["need_assets"]) == ((not name), [name] if name else [])
    wire.ask("upload_model_chunk", **chunk(upload, data, name))
    damaged.write_bytes(damage[: len(data)].ljust(len(data) if damage else 0))
    code, message = wire.refusal("upload_model_commit", upload_id=upload)
    assert (code, f"{name or '<xml>'} must be sent first" in message) == ("bad_request", True)
    wire.ask("upload_model_chunk", **chunk(upload, data, name))
    assert wire.ask("upload_model_commit", upload_id=upload)["imported"]


def test_a_large_chunk_goes_over_zmq_alone(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Beta statement 63."""
    data = bytes(2 * 2**20)
    base = tmp_path_factory.getbasetemp()
    with SimulatedServer(dialect="beta", saved_dir=tmp_path, shm_dir=base) as server, Wire(server) as wire:
        wire.hello()
        assert server.shm_dir is not None
        with RawShm(server.shm_dir, doorbell=True) as shm:
            assert shm.requests.header[2] < len(data), "it does not fit into a slot"
        upload = wire.ask("upload_model_manifest", **manifest(zeros_bin=data))["upload_id"]
        assert wire.ask("upload_model_chunk", **chunk(upload, data, "zeros.bin"))["complete"]
