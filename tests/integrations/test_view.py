"""Views of real robots: what Rerun and Foxglove are told is what MuJoCo says, and stepping never waits for them."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import io
import json
import socket
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from ports import free_port, free_ports
from waiting import DEADLINE_S, eventually, until

import urlab_client
from urlab_client.aio import URLabClient as AsyncClient
from urlab_client.cli import main
from urlab_client.errors import URLabError
from urlab_client.integrations._feed import samples
from urlab_client.integrations._feed.geometry import Kind, shapes_of
from urlab_client.integrations._feed.messages import CompressedImage, RawImage, Time
from urlab_client.integrations._feed.samples import CameraPicture, picture_message
from urlab_client.integrations._feed.scene import FollowedScene
from urlab_client.integrations.record import read_run, record
from urlab_client.integrations.view import foxglove_view, rerun_view, window_view
from urlab_client.integrations.view import view as viewing
from urlab_client.integrations.view.foxglove_view import FoxgloveBackend
from urlab_client.integrations.view.view import WindowBackend, show_recording
from urlab_client.server import SimulatedServer

pytestmark = pytest.mark.view


@pytest.fixture(scope="module")
def server() -> Iterator[SimulatedServer]:
    with SimulatedServer("quadruped", "arm", play=True) as made:
        yield made


@pytest.fixture
def client(server: SimulatedServer) -> Iterator[urlab_client.URLabClient]:
    with urlab_client.URLabClient(**server.client_options(), step_mode="direct") as made:
        made.discover()
        made.reset()
        yield made


def rows(path: Path, entity: str, component: str) -> list[tuple[dict[str, Any], Any]]:
    """Times and values of a component of an entity, as Rerun reads them."""
    from rerun.chunk import RrdReader

    found = []
    for chunk in RrdReader(str(path)).stream().to_chunks():
        if chunk.entity_path != entity:
            continue
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name.endswith(component)]
        for name in names:
            for row in range(batch.num_rows):
                times = {time: batch.column(time).cast("int64")[row].as_py() for time in chunk.timeline_names}
                found.append((times, batch.column(name)[row].as_py()))
    return sorted(found, key=lambda item: item[0].get("sim_time", -1))


def test_rerun_is_told_poses_joints_and_contacts(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    client.step(n_steps=500)
    path = tmp_path / "run.rrd"
    with rerun_view(client, save=path, sensors=True) as view:
        client.step(n_steps=3)
        time = client.sim_time
        arm = client.articulations["arm"]
        body = next(iter(client.articulations["quadruped"].bodies))
        expected = client.articulations["quadruped"].root_pos_w
        position = arm.get_qpos()
    assert view.stats.states >= 1
    assert view.error is None
    times, last = rows(path, f"/world/quadruped_{body}", "Transform3D:translation")[-1]
    assert np.allclose(np.ravel(last), expected, atol=1e-6)  # Rerun's are 32-bit
    assert times["sim_time"] == round(time * 1e9)
    assert {"sim_time", "wall_time", "step"} <= times.keys()
    for name, value in position.items():
        assert rows(path, f"/joints/arm/{name}", "Scalars:scalars")[-1][1] == [value]
    contacts = rows(path, "/world/contacts/points", "Points3D:positions")[-1][1]
    forces = rows(path, "/world/contacts/forces", "Arrows3D:vectors")[-1][1]
    assert len(contacts) == len(forces) > 3
    assert all(force[2] > 0 for force in forces)


def test_geometry_is_the_models(client: urlab_client.URLabClient) -> None:
    model = client.model
    names = [model.body(i).name or f"body_{i}" for i in range(model.nbody)]
    shapes = {(shape.body, shape.name): shape for shape in shapes_of(model, names)}
    visible = [i for i in range(model.ngeom) if model.geom_group[i] < 3 and model.geom_rgba[i][3] > 0]
    assert len(shapes) == len(visible) > 10
    for i in visible:
        shape = shapes[names[model.geom_bodyid[i]], model.geom(i).name or f"geom_{i}"]
        assert shape.position == tuple(model.geom_pos[i])
        if shape.kind is Kind.CAPSULE:
            assert shape.size[:2] == tuple(model.geom_size[i][:2])


def test_height_fields_and_meshes_become_triangles() -> None:
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset>
        <hfield name="h" nrow="2" ncol="3" size="1 2 3 0.1" elevation="0 0 0 1 1 1"/>
        <mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
        <worldbody><geom type="hfield" hfield="h"/><geom type="mesh" mesh="m"/></worldbody></mujoco>"""
    )
    field, mesh = shapes_of(model, ["world"])
    assert field.vertices is not None
    assert field.triangles is not None
    assert mesh.vertices is not None
    assert field.vertices.min(axis=0).tolist() == [-1, -2, 0]
    assert field.vertices.max(axis=0).tolist() == [1, 2, 3]
    corners = field.vertices[field.triangles]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()  # seen from above
    assert mesh.vertices.shape == (4, 3)


def test_stepping_never_waits_and_the_newest_state_is_shown(
    client: urlab_client.URLabClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    going = threading.Event()
    drain: Callable[[Any], None] = viewing.Viewing._drain

    def slowly(self: Any) -> None:
        assert going.wait(30)
        drain(self)

    monkeypatch.setattr(viewing.Viewing, "_drain", slowly)
    path = tmp_path / "run.rrd"
    with rerun_view(client, save=path) as view:
        for _ in range(100):
            client.step()
        assert view.stats.dropped_states == 100  # the first state, that of the start, and all but the last
        going.set()
        time = client.sim_time
    body = next(iter(client.articulations["quadruped"].bodies))
    shown = rows(path, f"/world/quadruped_{body}", "Transform3D:translation")
    assert [times["sim_time"] for times, _ in shown] == [round(time * 1e9)]


async def published(client: AsyncClient, key: str) -> None:
    """Wait until some states of this articulation have arrived, whatever the client was told of it."""
    seen = 0
    async with client.state_stream(timeout=DEADLINE_S) as states:
        async with asyncio.timeout(DEADLINE_S):
            while seen < 5:
                seen += key in (await states.receive()).per_articulation


@pytest.mark.parametrize("looks_on", [False, True])
async def test_the_first_frame_has_the_time_of_its_state(looks_on: bool, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    with SimulatedServer("arm", play=True, unpaused=True) as server:
        options = server.client_options()
        async with AsyncClient(**options) as driver, AsyncClient(**options, read_only=looks_on) as client:
            await driver.discover()
            await driver.run_for(0.2)
            await client.discover(handshake=driver.handshake() if looks_on else None)
            client._state._live.stop()  # as if nothing had been published since
            async with rerun_view(client, save=path) as view:
                await until(lambda: view.stats.states >= 2)
    shown = rows(path, "/world/arm_forearm", "Transform3D:translation")
    assert shown[0][0]["sim_time"] >= 200_000_000


async def test_live_mode_is_followed_and_another_servers_robots_replace_the_first(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run.rrd"
    ports = free_ports()
    first = SimulatedServer("arm", play=True, **ports)
    with contextlib.ExitStack() as servers:
        servers.enter_context(first)
        async with AsyncClient(**first.client_options(), step_mode="live", rcv_timeout_ms=30_000) as client:
            await client.discover()
            await client.runtime.set_paused(False)
            async with rerun_view(client, save=path, cameras=["wrist"]) as view:
                await until(lambda: view.stats.states >= 6)  # the one at the start has no joint values
                servers.close()
                servers.enter_context(SimulatedServer("quadruped", play=True, **ports))
                await published(client, "quadruped")
                await client.discover()
                await client.runtime.set_paused(False)
                before = view.stats.states
                await until(lambda: view.stats.states >= before + 6)  # one of the arm may still have been waiting
    assert view.error is None
    assert len(rows(path, "/joints/arm/elbow", "Scalars:scalars")) >= 5
    assert len(rows(path, "/joints/quadruped/FL_hip", "Scalars:scalars")) >= 5
    assert "the new scene lacks a camera" in caplog.text
    assert "'wrist'" in caplog.text


@pytest.mark.opengl
def test_rerun_is_shown_what_the_cameras_see(tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "run.rrd"
    modes = {"arm/wrist": "depth", "arm/overview": "real"}
    with (
        SimulatedServer("arm", play=True, camera_modes=modes, camera_size=(80, 60)) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        client.reset()
        with rerun_view(client, save=path, cameras="all", camera_hz=1000, max_hz=1000) as view:
            client.step()
            eventually(lambda: view.stats.frames == 2)
            cameras = client.articulations["arm"].cameras
            depth, colour = cameras["wrist"].latest_frame, cameras["overview"].latest_frame
            size, time = cameras["overview"].resolution, client.sim_time
            fovy = client.model.camera("arm_overview").fovy[0]
    assert depth is not None
    assert colour is not None
    ((times, (buffer,)),) = rows(path, "/world/cameras/arm/wrist/image", "DepthImage:buffer")
    assert times["sim_time"] == round(time * 1e9)
    assert np.array_equal(np.frombuffer(bytes(buffer), "<f4").reshape(depth.shape), depth)
    ((_, (jpeg,)),) = rows(path, "/world/cameras/arm/overview/image", "EncodedImage:blob")
    with Image.open(io.BytesIO(bytes(jpeg))) as image:
        assert image.size == size
        assert np.abs(np.asarray(image, float) - colour[..., :3]).mean() < 3  # what JPEG costs
    ((_, (matrix,)),) = rows(path, "/world/cameras/arm/overview", "Pinhole:image_from_camera")
    focal = size[1] / 2 / np.tan(np.radians(fovy / 2))
    assert np.allclose(np.reshape(matrix, (3, 3)).T, [[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    assert rows(path, "/world/cameras/arm/overview", "Transform3D:translation")


def test_a_window_without_a_display_says_what_is_missing(
    client: urlab_client.URLabClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(urlab_client.URLabError, match="no display: neither DISPLAY") as caught, window_view(client):
        pass
    assert "`urlab console`" in (caught.value.hint or "")


class Window:
    """What `mujoco.viewer.launch_passive` returns, without a screen."""

    def __init__(self, model: Any, data: Any, **_: Any) -> None:
        self.model, self.data, self.open = model, data, True
        self.shown: list[tuple[float, list[float]]] = []

    def is_running(self) -> bool:
        return self.open

    def lock(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def sync(self) -> None:
        self.shown.append((self.data.time, self.data.qpos.tolist()))

    def close(self) -> None:
        self.open = False


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[Window]:
    made: list[Window] = []

    def launch(*arguments: Any, **options: Any) -> Window:
        made.append(Window(*arguments, **options))
        return made[-1]

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setitem(sys.modules, "mujoco.viewer", types.SimpleNamespace(launch_passive=launch))  # type: ignore[arg-type]
    return made


def test_a_window_shows_what_is_stepped_and_is_closed_at_the_end(
    client: urlab_client.URLabClient, windows: list[Window]
) -> None:
    with window_view(client) as view:
        client.articulations["arm"].set_ctrl({"elbow": 0.5})
        client.step(n_steps=200)
        qpos, now = client.data.qpos.tolist(), client.sim_time
    (window,) = windows
    assert view.error is None
    assert window.shown[-1] == (pytest.approx(now), pytest.approx(qpos))
    assert not window.open


def test_a_view_ends_when_its_window_is_closed(client: urlab_client.URLabClient, windows: list[Window]) -> None:
    with window_view(client) as view:
        client.step()
        eventually(lambda: bool(windows and windows[0].shown))
        windows[0].open = False
        eventually(lambda: view.closed)
        before = len(windows[0].shown)
        client.step(n_steps=5)
    assert view.error is None
    assert len(windows[0].shown) == before


CRATE = """<mujoco><worldbody><body name="crate" pos="2 0 1"><freejoint name="crate_free"/><geom size="0.1"/></body>
</worldbody></mujoco>"""


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two episodes of a robot, another with a free base, and a falling crate, of which the server has gone."""
    path, crate = tmp_path / "run.mcap", tmp_path / "crate.xml"
    crate.write_text(CRATE)
    with (
        SimulatedServer("arm", "quadruped", crate, play=True) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, path):
            for _ in range(2):
                client.reset()
                client.articulations["arm"].set_ctrl({"elbow": 0.5})
                for _ in range(50):
                    client.step()
    return path


def test_a_recording_alone_shows_its_robots_and_begins_again_until_the_view_ends(
    recording: Path, windows: list[Window]
) -> None:
    run = read_run(recording)
    columns = run.table().columns
    order = ("arm/qpos", "quadruped/qpos", "crate/qpos")  # of the model
    recorded = np.hstack([columns[key].values for key in order]).tolist()

    def over() -> bool:
        shown = [qpos for _, qpos in windows[0].shown] if windows else []
        return recorded[-1] in shown and recorded[0] in shown[shown.index(recorded[-1]) :]

    stats = show_recording(run, WindowBackend(), over=over)
    (window,) = windows
    assert all(qpos in recorded for _, qpos in window.shown)
    assert stats.states == len(window.shown)
    assert not window.open


def test_rerun_gets_a_whole_recording_at_once(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.rrd"
    assert main(["view", str(recording), "--rerun", "--save", str(path), "--max-hz", "1000"]) == 0
    table = read_run(recording).table()
    assert f"{len(table)} states" in capsys.readouterr().out
    elbow = table.columns["arm/qpos"].values[:, table.columns["arm/qpos"].names.index("elbow")]
    found = rows(path, "/joints/arm/elbow", "Scalars:scalars")
    assert [value for _, (value,) in found] == elbow.tolist()
    assert [times["sim_time"] for times, _ in found] == np.rint(1e9 * table.time).astype(int).tolist()
    for body, key in (("quadruped_trunk", "quadruped/qpos"), ("crate_crate", "crate/qpos")):
        moved = rows(path, f"/world/{body}", "Transform3D:translation")
        assert np.allclose(np.ravel(moved[-1][1]), table.columns[key].values[-1, :3], atol=1e-6)
    assert rows(path, "/world/contacts/forces", "Arrows3D:vectors")


async def test_foxglove_gets_a_recordings_states_with_their_set_points(recording: Path) -> None:
    from websockets.asyncio.client import connect

    run, over, listening = read_run(recording), threading.Event(), asyncio.Event()
    backend, loop = FoxgloveBackend(host="127.0.0.1", port=0, sensors=True), asyncio.get_running_loop()
    shown = asyncio.create_task(
        asyncio.to_thread(
            show_recording,
            run,
            backend,
            over=over.is_set,
            opened=lambda: loop.call_soon_threadsafe(listening.set),
        )
    )
    try:
        await asyncio.wait_for(listening.wait(), DEADLINE_S)
        async with connect(backend.address, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
            seen = Foxglove(socket)
            state: dict[str, Any] = {"step": 0}
            while not state["step"]:  # that before the first step has no set-points yet
                await seen.until("/state/arm")
                state = json.loads(seen.newest["/state/arm"])
    finally:
        over.set()
        await asyncio.wait_for(shown, DEADLINE_S)
    table = run.table()
    at = np.flatnonzero((table.episode == state["episode"]) & (table.step == state["step"]))
    assert state["set_points"] == table.columns["arm/set_points"].values[at[0]].tolist()
    assert 0.5 in state["set_points"]
    assert state["qpos"] == table.columns["arm/qpos"].values[at[0]].tolist()


def test_a_recordings_plain_entities_are_found_in_its_model() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='arm_base'><geom size='.1'/></body><body name='crate'><freejoint/>"
        "<geom size='.1'/></body><body name='target' mocap='true'/></worldbody></mujoco>"
    )
    scene = FollowedScene.recorded(model, {"arm": "arm"}, [])
    assert scene.layouts["arm"].bodies == {"base": 1}
    assert scene.entities == {"crate": (0, 0), "target": None}
    assert scene.mocap == {"target": 0}


@pytest.mark.opengl
def test_a_recordings_pictures_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded, path = tmp_path / "run.mcap", tmp_path / "run.rrd"
    with (
        SimulatedServer("arm", play=True, camera_modes={"arm/wrist": "depth"}, camera_size=(80, 60)) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, recorded, cameras="all", camera_hz=100):
            client.step(n_steps=5)
            client.step(n_steps=20)
        depth = client.articulations["arm"].cameras["wrist"].latest_frame
    assert main(["view", str(recorded), "--rerun", "--save", str(path)]) == 0
    assert "2 states, 4 pictures shown" in capsys.readouterr().out
    _, (buffer,) = rows(path, "/world/cameras/arm/wrist/image", "DepthImage:buffer")[-1]
    assert depth is not None
    assert np.array_equal(np.frombuffer(bytes(buffer), "<f4").reshape(depth.shape), depth)
    assert len(rows(path, "/world/cameras/arm/overview/image", "EncodedImage:blob")) == 2
    assert rows(path, "/world/cameras/arm/overview", "Pinhole:image_from_camera")


def test_a_port_of_reruns_page_that_another_program_holds_is_named(client: urlab_client.URLabClient) -> None:
    held, grpc = free_port(), free_port()

    def is_free() -> bool:
        try:
            socket.create_server(("0.0.0.0", grpc)).close()
        except OSError:
            return False
        return True

    with (
        socket.create_server(("0.0.0.0", held)),
        pytest.raises(URLabError, match=rf"rerun_view: port {held} cannot be used.* choose another"),
        rerun_view(client, web=True, web_port=held, grpc_port=grpc),
    ):
        pass
    assert eventually(is_free), "the port of the data"


def test_wrong_arguments_are_refused(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="max_hz"):
        rerun_view(client, save=tmp_path / "a.rrd", max_hz=0)
    with pytest.raises(ValueError, match="one of save, connect and web"):
        rerun_view(client, save=tmp_path / "a.rrd", web=True)
    with pytest.raises(KeyError, match="arm/wrist"), rerun_view(client, save=tmp_path / "a.rrd", cameras=["nose"]):
        pass
    with pytest.raises(OSError, match="missing"), rerun_view(client, save=tmp_path / "missing" / "a.rrd"):
        pass
    with foxglove_view(client, port=0) as view:
        port = int(view.address.rpartition(":")[2])
        with pytest.raises(urlab_client.URLabError, match=str(port)), foxglove_view(client, port=port):
            pass
    with pytest.raises(urlab_client.URLabError, match="A view opens once"), view:
        pass


# Foxglove


AGAIN_S = 1.0
"""Foxglove's server advertises a channel a moment before it takes subscriptions to it; one that comes then is lost."""


class Foxglove:
    """What a browser gets to see: channels by topic, the newest message of each."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.channels: dict[str, dict[str, Any]] = {}
        self.topics: dict[int, str] = {}  # of all that there ever were
        self.newest: dict[str, bytes] = {}

    async def until(self, *topics: str) -> None:
        """Read until there is a message of each topic, later than this call."""
        for topic in topics:
            self.newest.pop(topic, None)
        began = asked = time.monotonic()
        while missing := [topic for topic in topics if topic not in self.newest]:
            assert time.monotonic() - began < DEADLINE_S, f"no message of {missing}"
            if time.monotonic() - asked > AGAIN_S:
                asked = time.monotonic()
                await self._subscribe([self.channels[topic] for topic in missing if topic in self.channels])
            try:
                async with asyncio.timeout(AGAIN_S):
                    message = await self.socket.recv()
            except TimeoutError:
                continue
            if isinstance(message, bytes):
                if message[0] == 1:
                    self.newest[self.topics[int.from_bytes(message[1:5], "little")]] = message[13:]
                continue
            told = json.loads(message)
            if told["op"] == "advertise":
                await self._subscribe(told["channels"])
            elif told["op"] == "unadvertise":
                for number in told["channelIds"]:
                    del self.channels[self.topics.pop(number)]

    async def _subscribe(self, channels: list[dict[str, Any]]) -> None:
        for channel in channels:
            self.channels[channel["topic"]] = channel
            self.topics[channel["id"]] = channel["topic"]
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
        await self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


async def test_foxglove_is_told_frames_geometry_joints_and_contacts(server: SimulatedServer) -> None:
    from websockets.asyncio.client import connect

    async with AsyncClient(**server.client_options(), step_mode="direct") as client, asyncio.timeout(60):
        await client.discover()
        await client.reset()
        await client.step(n_steps=500)
        async with (
            foxglove_view(client, port=0) as view,
            connect(view.address, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket,
        ):
            seen = Foxglove(socket)
            await seen.until("/tf", "/scene")
            await client.step()
            shown = None  # what is subscribed to begins with the state before the step
            async with asyncio.timeout(DEADLINE_S):
                while shown != client.sim_time:
                    await seen.until("/tf", "/joint_states", "/contacts", "/contact_markers", "/state/arm")
                    shown = json.loads(seen.newest["/state/arm"])["sim_time"]
            robot, arm = client.articulations["quadruped"], client.articulations["arm"]
            body = f"quadruped_{next(iter(robot.bodies))}"
            frames = {f["child_frame_id"]: f for f in json.loads(seen.newest["/tf"])["transforms"]}
            assert list(frames[body]["translation"].values()) == robot.root_pos_w.tolist()
            assert frames[body]["parent_frame_id"] == "world"
            joints = {j["name"]: j["position"] for j in json.loads(seen.newest["/joint_states"])["joints"]}
            assert all(joints[f"arm_{name}"] == value for name, value in arm.get_qpos().items())
            kinds = {topic: channel["schemaName"] for topic, channel in seen.channels.items()}
    assert kinds == {
        "/tf": "foxglove.FrameTransforms",
        "/joint_states": "foxglove.JointStates",
        "/scene": "foxglove.SceneUpdate",
        "/contact_markers": "foxglove.SceneUpdate",
        "/contacts": "urlab.Contacts",
        "/state/arm": "urlab.ArticulationState",
        "/state/quadruped": "urlab.ArticulationState",
    }
    update = json.loads(seen.newest["/scene"])
    entities = {entity["id"]: entity for entity in update["entities"]}
    assert entities[body]["frame_id"] == body
    assert entities.keys() <= frames.keys() | {"world"}
    kinds_of_shapes = ("cubes", "spheres", "cylinders", "triangles")
    drawn = [shape for entity in update["entities"] for kind in kinds_of_shapes for shape in entity[kind]]
    assert len(drawn) > 10
    contacts = json.loads(seen.newest["/contacts"])["contacts"]
    (markers,) = json.loads(seen.newest["/contact_markers"])["entities"]
    assert len(markers["spheres"]) == len(contacts) > 3
    for sphere, contact in zip(markers["spheres"], contacts, strict=True):
        assert sphere["pose"]["position"] == contact["position"]
    assert markers["arrows"]


@pytest.mark.opengl
async def test_pictures_are_compressed_only_for_somebody_who_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    from websockets.asyncio.client import connect

    made: list[CompressedImage | RawImage] = []

    def compressing(picture: CameraPicture, stamp: Time, quality: int | None, _: Any) -> CompressedImage | RawImage:
        made.append(picture_message(picture, stamp, quality))
        return made[-1]

    monkeypatch.setattr(samples, "picture_message", compressing)
    with SimulatedServer("arm", play=True, camera_size=(80, 60)) as server:
        async with (
            AsyncClient(**server.client_options(), step_mode="live") as client,
            asyncio.timeout(60),
        ):
            await client.discover()
            await client.runtime.set_paused(False)
            async with foxglove_view(client, port=0, cameras=["wrist"]) as view:
                await until(lambda: view.stats.frames >= 5)
                assert len(made) == 1  # tells the topic's schema
                async with connect(view.address, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
                    await Foxglove(socket).until("/camera/arm/wrist")
    assert len(made) > 1


@pytest.mark.opengl
async def test_another_servers_robots_and_cameras_replace_the_first_in_foxglove() -> None:
    from PIL import Image
    from websockets.asyncio.client import connect

    def drawn(seen: Foxglove) -> set[str]:
        update = json.loads(seen.newest["/scene"])
        assert [deletion["type"] for deletion in update["deletions"]] == [1]  # all that there was before
        return {entity["id"].partition("_")[0] for entity in update["entities"]}

    options: dict[str, Any] = {"play": True, "camera_size": (80, 60), **free_ports()}
    with contextlib.ExitStack() as servers:
        reach = servers.enter_context(SimulatedServer("arm", **options)).client_options()
        async with AsyncClient(**reach, step_mode="live", rcv_timeout_ms=30_000) as client, asyncio.timeout(100):
            await client.discover()
            await client.runtime.set_paused(False)
            async with (
                foxglove_view(client, port=0, cameras="all") as view,
                connect(view.address, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket,
            ):
                seen = Foxglove(socket)
                await seen.until("/tf", "/scene", "/state/arm", "/camera/arm/wrist")
                assert "arm" in drawn(seen)
                servers.close()
                servers.enter_context(SimulatedServer("quadruped", **options))
                await published(client, "quadruped")
                await client.discover()
                await client.runtime.set_paused(False)
                await seen.until("/tf", "/scene", "/state/quadruped", "/camera/quadruped/side")
                while "quadruped" not in drawn(seen):  # but once more the arm, sent before it was gone
                    await seen.until("/scene")
                assert "arm" not in drawn(seen)
                frames = {frame["child_frame_id"] for frame in json.loads(seen.newest["/tf"])["transforms"]}
                size = client.articulations["quadruped"].cameras["side"].resolution
    assert view.error is None
    assert "/state/quadruped" in seen.channels
    assert "/state/arm" not in seen.channels
    assert list(seen.topics.values()).count("/state/quadruped") == 1  # nothing of it before the handshake
    assert "quadruped/side" in frames
    assert not any(frame.startswith("arm") for frame in frames)
    picture = json.loads(seen.newest["/camera/quadruped/side"])
    with Image.open(io.BytesIO(base64.b64decode(picture["data"]))) as image:
        assert (image.format, image.size) == ("JPEG", size)
