"""A view in Rerun: its viewer, its page in a browser, another machine's viewer, or a file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import quote

import numpy as np

from urlab_client._installation import need
from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.enums import CameraMode
from urlab_client.errors import URLabError
from urlab_client.integrations._feed.geometry import Kind, Shape, shapes_of
from urlab_client.integrations._feed.messages import FrameTransform, Time
from urlab_client.integrations._feed.samples import CameraPicture, State, compressed
from urlab_client.integrations._feed.scene import FollowedScene, Simulation, calibration
from urlab_client.integrations._flavours import flavoured, in_flavour
from urlab_client.integrations.view.view import AsyncView, Moment, View, ViewBackend
from urlab_client.sync.client import URLabClient

if TYPE_CHECKING:
    import rerun

_NS = 1_000_000_000
_JPEG_QUALITY = 80
_NEWTON_M = 0.002  # length of a contact's arrow for each newton


class RerunBackend(ViewBackend):
    """Shows states in Rerun."""

    def __init__(
        self, *, save: Path | None, connect: str | None, web: bool, web_port: int, grpc_port: int = 9876, sensors: bool
    ) -> None:
        need("rerun", "PIL", extra="rerun")
        self._save, self._connect, self._web = save, connect, web
        self._web_port, self._grpc_port = web_port, grpc_port
        self._sensors = sensors
        self._cameras: set[str] = set()
        self._static: dict[str, type[rerun.AsComponents]] = {}
        self._stream: rerun.RecordingStream | None = None

    @property
    def address(self) -> str:
        # Without the address of the data the page shows Rerun's welcome.
        data = quote(f"rerun+http://127.0.0.1:{self._grpc_port}/proxy", safe="")
        return f"http://127.0.0.1:{self._web_port}/?url={data}" if self._web else ""

    @property
    def _recording(self) -> rerun.RecordingStream:
        if self._stream is None:
            raise URLabError("The view is not open.")
        return self._stream

    def open(self) -> None:
        import rerun as rr

        recording = rr.RecordingStream("urlab")
        if self._save is not None:
            self._save.open("wb").close()  # Rerun does not report when it cannot write
            recording.save(self._save)
        elif self._connect is not None:
            recording.connect_grpc(self._connect)
        elif self._web:
            address = recording.serve_grpc(grpc_port=self._grpc_port)
            try:
                rr.serve_web_viewer(web_port=self._web_port, open_browser=False, connect_to=address)
            except RuntimeError as error:
                recording.disconnect()
                raise URLabError(
                    f"rerun_view: port {self._web_port} cannot be used: {error}",
                    hint="Another program may hold it; choose another with web_port (--port).",
                ) from None
        else:
            recording.spawn(port=self._grpc_port)
        self._stream = recording

    def use(self, simulation: Simulation, scene: FollowedScene) -> None:
        import rerun as rr

        recording = self._recording
        before, self._static = self._static, {}
        self._cameras = set()
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for shape in shapes_of(simulation.model, simulation.bodies):
            where = f"{_body(shape.body)}/{rr.escape_entity_path_part(shape.name)}"
            drawn = _drawn(shape)
            self._static[where] = type(drawn)
            w, x, y, z = shape.orientation
            pose = rr.Transform3D(translation=shape.position, quaternion=rr.Quaternion(xyzw=[x, y, z, w]))
            recording.log(where, pose, drawn, static=True)
        for where in before.keys() - self._static.keys():
            # Static data stays at all times, so robots that are gone are cleared.
            recording.log(where, before[where].cleared(), static=True)  # type: ignore[attr-defined]  # of each archetype

    def show(self, moment: Moment) -> None:
        import rerun as rr

        recording = self._recording
        self._set_times(moment.ns, moment.wall_ns)
        recording.set_time("step", sequence=moment.step)
        simulation = moment.simulation
        for frame in simulation.transforms(Time.of(moment.ns)):
            recording.log(self._entity_of(moment.scene, frame), _transform(frame))
        if moment.state is not None:
            self._show_values(moment.state, moment.scene)
        if moment.contacts:
            contacts = simulation.contacts()
            origins = np.array([(c.position.x, c.position.y, c.position.z) for c in contacts]).reshape(-1, 3)
            forces = np.array([(c.force.x, c.force.y, c.force.z) for c in contacts]).reshape(-1, 3)
            labels = [f"{c.body1} / {c.body2}" for c in contacts]
            recording.log("world/contacts/points", rr.Points3D(origins, radii=0.008, labels=labels, show_labels=False))
            recording.log("world/contacts/forces", rr.Arrows3D(vectors=_NEWTON_M * forces, origins=origins))

    def show_picture(self, picture: CameraPicture, ns: int) -> None:
        import rerun as rr

        recording, camera = self._recording, picture.camera
        where = _camera(camera.name)
        self._set_times(ns, picture.wall_ns)
        pixels = picture.pixels()
        height, width = pixels.shape[:2]
        if where not in self._cameras:
            self._cameras.add(where)
            matrix = np.reshape(calibration(camera, Time(0, 0)).K, (3, 3))
            pinhole = rr.Pinhole(
                image_from_camera=matrix, width=width, height=height, camera_xyz=rr.ViewCoordinates.RDF
            )
            recording.log(where, pinhole, static=True)
        if pixels.dtype == np.float32:
            recording.log(f"{where}/image", rr.DepthImage(pixels, meter=1.0))
        else:
            real = camera.view.mode == CameraMode.REAL
            data = compressed(pixels, camera.view.mode, _JPEG_QUALITY if real else None)
            media = "image/jpeg" if real else "image/png"
            recording.log(f"{where}/image", rr.EncodedImage(contents=data, media_type=media))

    def close(self) -> None:
        recording, self._stream = self._recording, None
        recording.flush(timeout_sec=5.0)
        recording.disconnect()

    def _set_times(self, ns: int, wall_ns: int) -> None:
        recording = self._recording
        recording.set_time("sim_time", duration=np.timedelta64(ns, "ns"))
        recording.set_time("wall_time", timestamp=np.datetime64(wall_ns, "ns"))

    def _entity_of(self, scene: FollowedScene, frame: FrameTransform) -> str:
        name = frame.child_frame_id
        return _camera(name) if any(camera.name == name for camera in scene.cameras.values()) else _body(name)

    def _show_values(self, state: State, scene: FollowedScene) -> None:
        import rerun as rr

        recording = self._recording
        part = rr.escape_entity_path_part
        for key, articulation in state.reply.per_articulation.items():
            names = scene.names.get(key)
            if names is not None and len(names.qpos) == len(articulation.qpos):
                for name, value in zip(names.qpos, articulation.qpos.tolist(), strict=True):
                    recording.log(f"joints/{part(key)}/{part(name)}", rr.Scalars(value))
            if self._sensors:
                for name, values in (articulation.sensors or {}).items():
                    recording.log(f"sensors/{part(key)}/{part(name)}", rr.Scalars(values))


def _body(name: str) -> str:
    import rerun as rr

    return f"world/{rr.escape_entity_path_part(name)}"


def _camera(name: str) -> str:
    import rerun as rr

    return "world/cameras/" + "/".join(rr.escape_entity_path_part(part) for part in name.split("/"))


def _transform(frame: FrameTransform) -> rerun.Transform3D:
    import rerun as rr

    at, turned = frame.translation, frame.rotation
    return rr.Transform3D(
        translation=[at.x, at.y, at.z], quaternion=rr.Quaternion(xyzw=[turned.x, turned.y, turned.z, turned.w])
    )


def _drawn(shape: Shape) -> rerun.AsComponents:
    import rerun as rr

    solid = rr.components.FillMode.Solid
    x, y, z = shape.size
    rgba = [shape.rgba]
    match shape.kind:
        case Kind.BOX:
            return rr.Boxes3D(half_sizes=[(x, y, z)], colors=rgba, fill_mode=solid)
        case Kind.ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=[(x, y, z)], colors=rgba, fill_mode=solid)
        case Kind.CYLINDER:
            return rr.Cylinders3D(lengths=[2 * y], radii=[x], colors=rgba, fill_mode=solid)
        case Kind.CAPSULE:
            # Rerun's origin is the lower end, MuJoCo's the centre.
            middle = [(0.0, 0.0, -y)]
            return rr.Capsules3D(lengths=[2 * y], radii=[x], translations=middle, colors=rgba, fill_mode=solid)
        case Kind.MESH:
            vertices = np.zeros((0, 3)) if shape.vertices is None else shape.vertices
            return rr.Mesh3D(vertex_positions=vertices, triangle_indices=shape.triangles, albedo_factor=shape.rgba)


@flavoured(AsyncView, View)
def rerun_view(
    client: AsyncClient | URLabClient,
    *,
    save: str | os.PathLike[str] | None = None,
    connect: str | None = None,
    web: bool = False,
    web_port: int = 9090,
    grpc_port: int = 9876,
    cameras: Sequence[str] | Literal["all"] = (),
    camera_hz: float = 10.0,
    contacts: bool = True,
    sensors: bool = False,
    max_hz: float = 30.0,
) -> AsyncView | View:
    """Show a client's simulation in Rerun; a context manager of the client's flavour.

    The newest state is shown, at most `max_hz` times per second; skipped states are counted, and stepping never
    waits. Bodies are under `world/BODY`, metres, right-handed, z up, their geoms below them; joint
    positions under `joints/ARTICULATION/JOINT`, radians or metres; contacts under `world/contacts`, their forces in
    newtons as arrows of 2 mm each; pictures under `world/cameras/NAME`. The timelines are `sim_time`, which continues
    across resets, `wall_time` and `step`. After another handshake the new scene replaces the old one.

    Args:
        client: A client after `discover()`, during play, with its local model.
        save: Write to this `.rrd` file instead of showing anything, replacing an existing file.
        connect: Send to a viewer at another address, `rerun+http://HOST:9876/proxy`, which may start later.
        web: Serve Rerun's page for browsers instead of opening a window. Rerun serves page and data on all interfaces
            of this machine without authentication, and has no option for that.
        web_port: Port of the page.
        grpc_port: Port of the data, for the page and the window.
        cameras: Cameras to show, `ARTICULATION/CAMERA` or a scene-level name; `all` for all of them.
            In `direct` mode they are drawn with the step in which they are due, which then takes longer.
        camera_hz: Maximum number of pictures per second of simulation time.
        contacts: Show contacts, computed from the state with the client's local model.
        sensors: Show sensor readings under `sensors/ARTICULATION/SENSOR`.
        max_hz: Maximum number of states shown per second of wall time.

    Raises:
        ImportError: The extra `rerun` is not installed.
        ValueError: An option is out of range, or two destinations are given.

    Entering the block raises `OSError` if the file cannot be created, `KeyError` for an unknown camera, and
    `URLabError` before `discover()` or without a local model.
    """
    if (save is not None) + (connect is not None) + web > 1:
        raise ValueError("give one of save, connect and web")
    path = None if save is None else Path(save)
    backend = RerunBackend(save=path, connect=connect, web=web, web_port=web_port, grpc_port=grpc_port, sensors=sensors)
    options: dict[str, Any] = {"cameras": cameras, "camera_hz": camera_hz, "max_hz": max_hz, "contacts": contacts}
    return in_flavour(client, AsyncView, View, backend, "rerun_view", **options)
