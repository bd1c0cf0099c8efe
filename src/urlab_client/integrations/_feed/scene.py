"""The scene of a client after a handshake: names, addresses and cameras, and poses computed with its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np
from msgspec import Struct

from urlab_client._mujoco import control_counts, model_names
from urlab_client.aio.articulation import URLabArticulation, compiled_prefixes
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.client import URLabClient
from urlab_client.aio.model.layout import FREE, ArticulationLayout, articulation_layouts
from urlab_client.aio.state.scene_objects import entities_of
from urlab_client.integrations._feed.messages import (
    CameraCalibration,
    ContactMessage,
    FrameTransform,
    JointState,
    Quaternion,
    Time,
    Vector3,
)
from urlab_client.integrations._variation import server_variation
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.session import ArticulationState, EntityState
from urlab_client.values.names import NameMap, cleaned_name, lasting_names

if TYPE_CHECKING:
    import mujoco

    from urlab_client.randomise.variation import Variation

_BALL, _SLIDE = 1, 2  # mjJNT_BALL, mjJNT_SLIDE
# From MuJoCo's camera axes (x right, y up, looking along -z) to an image's (x right, y down, looking along z).
_OPTICAL = np.array([0.0, 1.0, 0.0, 0.0])

_FREE_QPOS = ("x", "y", "z", "qw", "qx", "qy", "qz")
_FREE_QVEL = ("vx", "vy", "vz", "wx", "wy", "wz")


class SceneLayout(Struct, kw_only=True):
    """Name of each value of an articulation, in the order of the message's arrays; empty without a local model.

    `slides` are the names of slide joints, whose positions are metres, or None if unknown. `sensors` has the kind of
    each sensor by name, as in MJCF (`accelerometer`). With `prefix` its names begin in the compiled model.
    """

    qpos: list[str] = []
    qvel: list[str] = []
    ctrl: list[str] = []
    act: list[str] = []
    slides: list[str] | None = None
    sensors: dict[str, str] = {}
    prefix: str = ""


class RecordedCamera(NamedTuple):
    """What a recording says of a camera, as `URLabCameraView` does of a client's."""

    mode: str
    resolution: tuple[int, int]
    fovy: float


Lens = URLabCameraView | RecordedCamera


@dataclass(frozen=True, slots=True)
class CameraLayout:
    """A camera to record.

    Attributes:
        name: `ARTICULATION/CAMERA`, or the name of a scene-level camera.
        view: The client's camera, or what a recording says of one.
        model_id: Id in the compiled model; -1 if missing.
    """

    name: str
    view: Lens
    model_id: int


@dataclass(frozen=True, slots=True)
class FollowedScene:
    """The parts of a handshake that a recording needs. Immutable, because the writing thread uses it.

    Attributes:
        model: The local model, or None.
        called: Names of articulations here, by the client's keys that are names of the engine.
        layouts: Layouts by articulation.
        names: Names by articulation.
        entities: Offsets of the free joint in `qpos` and in `qvel`, or None, by name of the plain entity.
        mocap: Mocap ids of the plain entities that have one.
        cameras: Cameras to record, by the identity of the client's camera.
        variation: The server's randomisation, or None.
    """

    model: mujoco.MjModel | None
    called: dict[str, str]
    layouts: dict[str, ArticulationLayout]
    names: dict[str, SceneLayout]
    entities: dict[str, tuple[int, int] | None]
    mocap: dict[str, int]
    cameras: dict[int, CameraLayout]
    variation: Variation | None

    @classmethod
    def of(cls, client: URLabClient, cameras: Sequence[tuple[str, Lens]]) -> FollowedScene:
        plain = {name: one for name, one in client.entities.items() if not isinstance(one, URLabArticulation)}
        bodies = {name: (one.body_id, one.qpos_offset, one.qvel_offset) for name, one in plain.items()}
        prefixes = compiled_prefixes(client.articulations)
        called = lasting_names(prefixes)
        scene = cls._made(client.model, NameMap({called[key]: it for key, it in prefixes.items()}), bodies, cameras)
        model, others = scene.model, {key: name for key, name in called.items() if key != name}
        varied = None if model is None else server_variation(client, model, scene.layouts)
        return replace(scene, called=others, variation=varied)

    @classmethod
    def recorded(
        cls, model: mujoco.MjModel, prefixes: Mapping[str, str], cameras: Sequence[tuple[str, Lens]]
    ) -> FollowedScene:
        """Return the scene of a recording from its model and what its articulations' names begin with there."""
        infos = entities_of(model, frozenset(prefixes.values()))
        bodies = {name: (info.id, info.qpos_offset, info.qvel_offset) for name, info in infos.items()}
        return cls._made(model, NameMap(prefixes), bodies, cameras)

    @classmethod
    def _made(
        cls,
        model: mujoco.MjModel | None,
        prefixes: NameMap[str],
        bodies: Mapping[str, tuple[int, int | None, int | None]],
        cameras: Sequence[tuple[str, Lens]],
    ) -> FollowedScene:
        layouts = {key: ArticulationLayout() for key in prefixes}
        mocap: dict[str, int] = {}
        if model is not None:
            layouts = articulation_layouts(model, prefixes)
            mocap = {name: int(model.body_mocapid[body]) for name, (body, _, _) in bodies.items() if body >= 0}
        return cls(
            model=model,
            called={},
            layouts=layouts,
            names={key: _layout(model, layout, prefixes[key]) for key, layout in layouts.items()},
            entities={name: None if q is None or v is None else (q, v) for name, (_, q, v) in bodies.items()},
            mocap={name: number for name, number in mocap.items() if number >= 0},
            cameras={id(view): CameraLayout(name, view, camera_id(model, prefixes, name)) for name, view in cameras},
            variation=None,
        )


def component(name: str, names: AbstractSet[str]) -> str:
    """Return the last part of the name of one of several values of a joint; empty for the value of a hinge or slide.

    Hinges and slides, too, may be called `x`, or have a dot in their names.
    """
    joint, dot, part = name.rpartition(".")
    groups = _FREE_QPOS[3:], _FREE_QVEL[3:]
    return part if any(all(joint + dot + other in names for other in group) for group in groups) else ""


class Simulation:
    """Computes poses and contacts of recorded states. Not thread-safe; the model is only read.

    Attributes:
        model: The model.
        data: The data computed last.
        bodies: Name of each body, which is also that of its frame.
    """

    def __init__(self, scene: FollowedScene, model: mujoco.MjModel) -> None:
        import mujoco

        self._scene = scene
        self.model: mujoco.MjModel = model
        self.data: mujoco.MjData = mujoco.MjData(model)
        self.bodies: list[str] = [name or f"body_{i}" for i, name in enumerate(model_names(model, "body"))]
        joints = model_names(model, "joint")
        scalar = np.flatnonzero(model.jnt_type > _BALL).tolist()
        self._joints = [(joints[i], int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])) for i in scalar if joints[i]]

    def take(
        self, articulations: Mapping[str, ArticulationState], entities: Mapping[str, EntityState], *, forces: bool
    ) -> None:
        """Set a state and compute its poses and contacts."""
        data = self.data
        for key, state in articulations.items():
            layout = self._scene.layouts.get(key)
            if layout is None:
                continue
            data.qpos[layout.qpos_adr] = state.qpos
            data.qvel[layout.qvel_adr] = state.qvel
            if state.ctrl is not None:
                data.ctrl[layout.ctrl_adr] = state.ctrl
            if state.act is not None and len(layout.act_adr):
                data.act[layout.act_adr] = state.act[layout.act_from]
        for name, entity in entities.items():
            offsets = self._scene.entities.get(name)
            if name in self._scene.mocap:
                data.mocap_pos[self._scene.mocap[name]] = entity.xpos
                data.mocap_quat[self._scene.mocap[name]] = entity.xquat
            elif offsets is not None and entity.qpos is not None and entity.qvel is not None:
                data.qpos[offsets[0] : offsets[0] + 7] = entity.qpos
                data.qvel[offsets[1] : offsets[1] + 6] = entity.qvel
        self._compute(forces)

    def start_from(self, qpos: Floats, qvel: Floats, *, forces: bool) -> None:
        """Set complete arrays of joint positions and velocities and compute poses and contacts."""
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        self._compute(forces)

    def _compute(self, forces: bool) -> None:
        import mujoco

        if forces:
            mujoco.mj_forward(self.model, self.data)
        else:
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_camlight(self.model, self.data)

    def joints(self) -> list[JointState]:
        qpos, qvel = self.data.qpos.tolist(), self.data.qvel.tolist()
        return [JointState(name, qpos[q], qvel[v]) for name, q, v in self._joints]

    def transforms(self, time: Time) -> list[FrameTransform]:
        """Return the poses of all bodies and of the recorded cameras in the world."""
        positions, rotations = self.data.xpos.tolist(), self.data.xquat.tolist()
        found = [_transform(time, self.bodies[i], positions[i], rotations[i]) for i in range(1, len(self.bodies))]
        for camera in self._scene.cameras.values():
            if camera.model_id >= 0:
                position, rotation = self._camera_pose(camera.model_id)
                found.append(_transform(time, camera.name, position.tolist(), rotation.tolist()))
        return found

    def contacts(self) -> list[ContactMessage]:
        """Return the contacts of a state that was set with forces."""
        import mujoco

        model, data = self.model, self.data
        found: list[ContactMessage] = []
        force = np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            mujoco.mj_contactForce(model, data, i, force)
            frame = contact.frame.reshape(3, 3)
            first, second = (int(geom) for geom in contact.geom)
            found.append(
                ContactMessage(
                    body1=self._owner(first),
                    body2=self._owner(second),
                    geom1=model.geom(first).name if first >= 0 else "",
                    geom2=model.geom(second).name if second >= 0 else "",
                    position=Vector3(*contact.pos.tolist()),
                    normal=Vector3(*frame[0].tolist()),
                    distance=float(contact.dist),
                    force=Vector3(*(frame.T @ force[:3]).tolist()),
                )
            )
        return found

    def _owner(self, geom: int) -> str:
        """Return the body of a geom; empty for a flex."""
        return self.bodies[int(self.model.geom_bodyid[geom])] if geom >= 0 else ""

    def _camera_pose(self, camera: int) -> tuple[Floats, Floats]:
        import mujoco

        looking, turned = np.zeros(4), np.zeros(4)
        mujoco.mju_mat2Quat(looking, self.data.cam_xmat[camera])
        mujoco.mju_mulQuat(turned, looking, _OPTICAL)
        return self.data.cam_xpos[camera], turned


def calibration(camera: CameraLayout, time: Time) -> CameraCalibration:
    """Return the pinhole parameters of a camera."""
    width, height = camera.view.resolution
    focal = height / 2 / float(np.tan(np.radians(camera.view.fovy) / 2))
    x, y = width / 2, height / 2
    return CameraCalibration(
        timestamp=time,
        frame_id=camera.name,
        width=width,
        height=height,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=[focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[focal, 0.0, x, 0.0, 0.0, focal, y, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def _transform(time: Time, child: str, position: list[float], rotation: list[float]) -> FrameTransform:
    w, x, y, z = rotation
    return FrameTransform(time, "world", child, Vector3(*position), Quaternion(x, y, z, w))


def camera_id(model: mujoco.MjModel | None, prefixes: Mapping[str, str], name: str) -> int:
    """Return the id of `ARTICULATION/CAMERA`, or of a camera of the scene; -1 if the model does not have it."""
    if model is None:
        return -1
    owner, slash, short = name.rpartition("/")
    wanted = cleaned_name(f"{prefixes.get(owner, owner)}_{short}" if slash else name)  # the beta cleans the same way
    return next((i for i in range(model.ncam) if cleaned_name(model.cam(i).name) == wanted), -1)


def _layout(model: mujoco.MjModel | None, layout: ArticulationLayout, prefix: str) -> SceneLayout:
    if model is None:
        return SceneLayout()
    qpos: list[str] = []
    qvel: list[str] = []
    for name, joint in layout.joints.items():
        kind = int(model.jnt_type[joint])
        if kind > _BALL:
            qpos.append(name)
            qvel.append(name)
        else:
            parts = slice(None) if kind == FREE else slice(3, None)
            qpos += [f"{name}.{part}" for part in _FREE_QPOS[parts]]
            qvel += [f"{name}.{part}" for part in _FREE_QVEL[parts]]
    ctrl: list[str] = []
    counts = control_counts(model)
    for name, actuator in layout.actuators.items():
        count = int(counts[actuator])
        ctrl += [name] if count == 1 else [f"{name}.{i}" for i in range(count)]
    slides = [name for name, joint in layout.joints.items() if int(model.jnt_type[joint]) == _SLIDE]
    kinds = _sensor_kinds()
    sensors = {name: kinds.get(int(model.sensor_type[sensor]), "") for name, sensor in layout.sensors.items()}
    return SceneLayout(qpos=qpos, qvel=qvel, ctrl=ctrl, act=list(ctrl), slides=slides, sensors=sensors, prefix=prefix)


def _sensor_kinds() -> dict[int, str]:
    """Return the MJCF name of each number in `model.sensor_type`."""
    import mujoco

    members = mujoco.mjtSensor.__members__
    return {int(member): name.removeprefix("mjSENS_").lower() for name, member in members.items()}


def to_metadata(layout: SceneLayout) -> dict[str, str]:
    return {"layout": msgspec.json.encode(layout).decode()}


def from_metadata(metadata: dict[str, str]) -> SceneLayout:
    return msgspec.json.decode(metadata.get("layout", "{}"), type=SceneLayout)
