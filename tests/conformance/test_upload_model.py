"""`scene.upload_model` against the simulated server's beta, in both flavours."""

from __future__ import annotations

import asyncio
from pathlib import Path

import mujoco
import pytest

from urlab_client import URLabAsset, URLabClient, URLabTimeoutError
from urlab_client.aio import URLabClient as AsyncClient
from urlab_client.errors import ImportFailed, UnknownOp
from urlab_client.server import Cut, Delay, Drop, Fault, Faults, Refuse, SimulatedServer
from urlab_client.types import UploadProgress

MESH = "v 0 0 0\nv {0} 0 0\nv 0 {0} 0\nv 0 0 {0}\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
ROBOT = """
<mujoco model="crab">
  <include file="limits.xml"/>
  <asset><mesh name="left" file="left/claw.obj"/><mesh name="right" file="right/claw.obj"/></asset>
  <worldbody>
    <body name="shell"><joint name="hip"/><geom type="mesh" mesh="left"/><geom type="mesh" mesh="right"/></body>
  </worldbody>
  <actuator><motor name="m" joint="hip"/></actuator>
</mujoco>
"""


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A model whose two meshes have one name in two folders, and which includes a file."""
    folder = tmp_path / "here"
    for side, size in (("left", 0.1), ("right", 0.2)):
        (folder / side).mkdir(parents=True)
        (folder / side / "claw.obj").write_text(MESH.format(size))
    (folder / "limits.xml").write_text('<mujocoinclude><default><joint range="-10 10"/></default></mujocoinclude>')
    (folder / "crab.xml").write_text(ROBOT)
    return folder / "crab.xml"


def test_a_model_of_this_machine_is_driven_on_a_server_that_cannot_read_it(robot: Path) -> None:
    with (
        SimulatedServer(dialect="beta") as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        seen: list[UploadProgress] = []
        handles = client.scene.apply_scene("lab", [URLabAsset("crab", str(robot))])
        assert set(handles) == {"crab"}
        blueprint = client.scene.upload_model(robot, on_progress=seen.append)
        assert not seen, "the server has all files already"
        assert blueprint.class_path.endswith("_C")
        client.sim.start()
        crab = client.articulations["crab"]
        crab.ctrl_array[:] = 1.0
        client.step(20)
        assert crab.dof_qvel[0] > 0.0
        assert client.model is not None
        assert client.model.nmesh == 2


async def test_a_spec_is_sent_and_progress_is_told(robot: Path) -> None:
    spec = mujoco.MjSpec.from_file(str(robot))
    spec.body("shell").add_geom(size=[0.01, 0, 0])
    with SimulatedServer(dialect="beta") as server:
        async with AsyncClient(**server.client_options()) as client:
            await client.discover()
            seen: list[UploadProgress] = []
            await client.scene.upload_model(spec, on_progress=seen.append)
            assert seen[-1].sent_bytes == seen[-1].total_bytes
            assert len({progress.file for progress in seen}) == 3
            broken = robot.with_name("broken.xml")
            broken.write_text("<mujoco><nonsense/></mujoco>")
            with pytest.raises(ValueError, match="MuJoCo rejects"):
                await client.scene.upload_model(broken)
            with pytest.raises(FileNotFoundError, match="nowhere"):
                await client.scene.upload_model("nowhere.xml")
            task = asyncio.create_task(client.scene.upload_model(robot))
            await asyncio.sleep(0)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert (await client.scene.upload_model(robot)).imported_now


def test_the_alpha_takes_no_models(robot: Path) -> None:
    with SimulatedServer() as server, URLabClient(**server.client_options()) as client:
        client.discover()
        with pytest.raises(UnknownOp, match=r"does not accept uploaded models.*import_xml"):
            client.scene.upload_model(robot)
        with pytest.raises(ImportFailed):
            client.scene.apply_scene("lab", [URLabAsset("crab", str(robot))])


def test_a_model_goes_over_zmq_and_its_import_takes_its_time(robot: Path, memory: Path) -> None:
    """Beta statements 81, 82 and 85."""
    faults = Faults()
    slow = faults.add(Delay(op="upload_model_commit", seconds=2.5))
    with (
        SimulatedServer("arm", play=True, dialect="beta", shm_dir=memory, faults=faults) as server,
        URLabClient(**server.client_options(), transport="shm", step_mode="direct", rcv_timeout_ms=2000) as client,
    ):
        client.discover()
        client.step()
        client.step()
        before = client.transport_stats.over_shm
        assert before > 0
        assert client.scene.upload_model(robot).class_path
        assert client.transport_stats.over_shm == before
        assert slow.seen == 1


@pytest.mark.parametrize(
    "fault",
    [Cut(op="upload_model_chunk", times=1), Refuse(op="upload_model_chunk", code="unknown_upload", times=1)],
    ids=["cut", "forgotten"],
)
def test_an_upload_goes_on_after_a_cut_connection_or_where_the_server_forgot_it(robot: Path, fault: Fault) -> None:
    with (
        SimulatedServer(dialect="beta", faults=Faults(fault)) as server,
        URLabClient(**server.client_options()) as client,
    ):
        client.discover()
        seen: list[UploadProgress] = []
        assert client.scene.upload_model(robot, on_progress=seen.append).imported_now
        assert seen[-1].sent_bytes == seen[-1].total_bytes


def test_a_chunk_whose_reply_was_lost_is_not_sent_again(robot: Path) -> None:
    """Beta statement 81."""
    with (
        SimulatedServer(dialect="beta", faults=Faults(Drop(op="upload_model_chunk"))) as server,
        URLabClient(**server.client_options()) as client,
    ):
        client.discover()
        sent = client.transport_stats.sent
        with pytest.raises(URLabTimeoutError, match="upload_model_chunk"):
            client.scene.upload_model(robot, timeout=3)
        assert client.transport_stats.sent == sent + 2, "the manifest and one chunk"


@pytest.mark.parametrize(
    ("limit", "value", "words"),
    [
        ("MAX_BLOB_BYTES", 40, "has [0-9]+ bytes; servers take 40$"),
        ("MAX_ASSETS", 1, "has 2 files; servers take 1$"),
        ("MAX_MODEL_BYTES", 100, "has [0-9]+ bytes; servers take 100$"),
    ],
)
def test_a_model_beyond_the_limits_of_servers_is_refused_before_it_is_sent(
    robot: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: int, words: str
) -> None:
    monkeypatch.setattr(f"urlab_client.aio.model.upload.{limit}", value)
    with SimulatedServer(dialect="beta") as server, URLabClient(**server.client_options()) as client:
        client.discover()
        with pytest.raises(ValueError, match=f"upload_model: .*crab.xml {words}"):
            client.scene.upload_model(robot)
