"""From the actors of a level to one MuJoCo model, and the tables that say whose is what in it.

For whoever starts play, and for the engine, which steps the result. Options, prefixes, keyframes and names follow the
plugin: see `compile_scene`. Nothing here steps, paces or talks to clients.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import (
    control_counts,
    control_starts,
    export_model,
    force_counts,
    force_starts,
    merge_assets,
)
from urlab_client.protocol.base import Vec3
from urlab_client.protocol.controller_text import CUSTOM_TEXT, ControllerText
from urlab_client.protocol.rotation import rotate, wxyz
from urlab_client.server.assets.actors import Actor, Mesh, scene_problem
from urlab_client.server.assets.content import Blueprint
from urlab_client.server.assets.decomposition import convex_parts
from urlab_client.server.assets.importer import mujoco_messages, one_line
from urlab_client.server.assets.option_ranges import options_problem
from urlab_client.server.limits import Limits

__all__ = [
    "ArticulationIndex",
    "CompileFailed",
    "CompiledScene",
    "EntityIndex",
    "SceneCamera",
    "actor_bounds",
    "compile_scene",
]

logger = logging.getLogger("urlab_client.server")

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]

DEFAULT_CAMERA_SIZE: Final = (640, 480)

FULL_BRIGHTNESS: Final = 5000.0
"""Intensity of a light that counts as MuJoCo's full diffuse colour; the engine's default."""

_SPOT_CUTOFF: Final = 44.0
"""Unreal's default outer cone angle, degrees."""

_SAME: Final = 1e-6
_DEFAULT_LIMITS: Final = Limits()


class CompileFailed(Exception):
    """MuJoCo rejects the scene.

    Attributes:
        message: MuJoCo's message on one line.
    """

    message: str

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


@dataclass(frozen=True, kw_only=True)
class SceneCamera:
    """A camera of an articulation.

    Attributes:
        name: Short name.
        id: Camera id in the model.
        mode: What its pixels mean: `real`, `depth`, `semantic` or `instance`.
        resolution: Width and height, pixels.
        fovy: Vertical field of view, degrees.
    """

    name: str
    id: int
    mode: str = "real"
    resolution: tuple[int, int] = DEFAULT_CAMERA_SIZE
    fovy: float = 45.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ArticulationIndex:
    """Where an articulation's elements are in the model. Ids ascend; names are short and parallel to the ids.

    Attributes:
        key: Actor name.
        prefix: `key` and an underscore: what its compiled names begin with.
        actor_id: Stable id given by the client; may be empty.
        model_name: The MJCF's `model` attribute, or its file stem.
        root_body: Lowest body id; 0, the world, if the MJCF has nothing but world geoms.
        bodies: Body ids.
        joints: Joint ids.
        actuators: Actuator ids.
        sensors: Sensor ids.
        body_names: Names of the bodies.
        joint_names: Names of the joints.
        actuator_names: Names of the actuators.
        sensor_names: Names of the sensors.
        qpos_adr: Index into `mjData.qpos` of every coordinate, in joint order.
        qvel_adr: Index into `mjData.qvel` of every velocity, in joint order.
        ctrl_adr: Index into `mjData.ctrl` of every control, in actuator order; an actuator may have several.
        act_adr: For every control the index into `mjData.act` of its actuator's first activation; -1 if stateless.
        force_adr: Index into `mjData.actuator_force` of every output, in actuator order; an actuator may have several.
        actuator_types: Actuator name to MJCF element; `motor` for `<general>`.
        cameras: The cameras.
        controller: The controller that the level or the MJCF gives it; None for none.
        original_names: Kind to (name in the model, name in the MJCF), where the two differ. They never do here.
    """

    key: str
    prefix: str
    actor_id: str
    model_name: str = ""
    root_body: int
    bodies: Ints
    joints: Ints
    actuators: Ints
    sensors: Ints
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    actuator_names: tuple[str, ...]
    sensor_names: tuple[str, ...]
    qpos_adr: Ints
    qvel_adr: Ints
    ctrl_adr: Ints
    act_adr: Ints
    force_adr: Ints
    actuator_types: Mapping[str, str]
    cameras: tuple[SceneCamera, ...]
    controller: ControllerText | None = None
    original_names: Mapping[str, Mapping[str, str]] = field(
        default_factory=lambda: {kind: {} for kind in ("actuators", "joints", "sensors", "bodies")}
    )


@dataclass(frozen=True, kw_only=True)
class EntityIndex:
    """A body that belongs to no articulation.

    Attributes:
        name: Compiled body name.
        body: Body id.
        free_joint: Name of its free joint, or None if it is fixed or driven.
        free_joint_id: Id of that joint; -1 without one.
        qpos_adr: Index of its 7 coordinates in `mjData.qpos`; -1 without a free joint.
        qvel_adr: Index of its 6 velocities in `mjData.qvel`; -1 without a free joint.
    """

    name: str
    body: int
    free_joint: str | None = None
    free_joint_id: int = -1
    qpos_adr: int = -1
    qvel_adr: int = -1


@dataclass(frozen=True, eq=False)
class CompiledScene:
    """A compiled scene.

    Attributes:
        model: The model.
        data: Its data, reset and with derived quantities computed.
        spec: The compiled `mujoco.MjSpec`; options of `model.opt` that changed since are not in it.
        articulations: In spawn order.
        entities: In spawn order.
        warnings: What the user should know about the scene.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    spec: mujoco.MjSpec
    articulations: tuple[ArticulationIndex, ...]
    entities: tuple[EntityIndex, ...] = ()
    warnings: tuple[str, ...] = ()

    def mjb(self) -> bytes:
        """Return the live model in MuJoCo's binary format. The caller holds whatever guards the model."""
        buffer = np.empty(mujoco.mj_sizeModel(self.model), dtype=np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        return buffer.tobytes()

    def mjcf(self) -> str:
        """Return the scene as MJCF. Its `file` attributes are bare names, the keys of `assets`."""
        return self._export[0]

    def assets(self) -> dict[str, bytes]:
        """Return the content of every file the MJCF names."""
        return dict(self._export[1])

    @cached_property
    def _export(self) -> tuple[str, dict[str, bytes]]:
        with mujoco_messages():
            xml, files = export_model(self.spec)
        names: dict[str, str] = {}
        for path in sorted(files):
            names[path] = _unique(path.rpartition("/")[2], set(names.values()))
        return (
            re.sub(
                r'\b(file\w*)="([^"]*)"', lambda match: f'{match[1]}="{names.get(match[2], Path(match[2]).name)}"', xml
            ),
            {names[path]: data for path, data in files.items()},
        )


def compile_scene(
    actors: Sequence[Actor],
    *,
    honour_mjcf_options: bool = False,
    camera_size: tuple[int, int] | None = None,
    limits: Limits = _DEFAULT_LIMITS,
) -> CompiledScene:
    """Compile the actors of a level into one model.

    Each articulation's MJCF is attached at the actor's pose with its name as prefix. Its `<option>`, `<visual>` and
    `<statistic>` have no effect, and of its `<size>` only the memory: the scene has MuJoCo's default options and the
    implicitfast integrator, as in the plugin. Keyframes hold the owner's part; everything else is at its reference, and
    a free joint's coordinates are not moved by the actor's pose. Cameras, lights and materials stay, but of floors that
    coincide and of suns that shine alike one is drawn.

    Args:
        actors: In spawn order.
        honour_mjcf_options: Take the `<option>` of the first articulation instead, integrator included.
        camera_size: Width and height of cameras whose MJCF gives no resolution.
        limits: Memory and sensors of the scene, and the ranges of its options; checked before it is simulated.

    Returns:
        The scene, stepped once and reset.

    Raises:
        CompileFailed: MuJoCo rejects it, or it exceeds a limit.
    """
    _refuse(scene_problem(actors, limits))
    articulations = [(actor, actor.blueprint) for actor in actors if actor.blueprint is not None]
    warnings: list[str] = []
    try:
        spec, entities = _compose(actors, articulations, warnings, honour_mjcf_options=honour_mjcf_options)
        _refuse(options_problem(spec.option, limits))
        model = spec.compile()
        memory = sum(max(blueprint.spec.memory, 0) for _, blueprint in articulations)
        if memory > model.narena:  # somebody found MuJoCo's own estimate too small
            spec.memory = memory
            model = spec.compile()
        _refuse(_size_problem(model, limits))
        if not honour_mjcf_options:
            model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        with mujoco_messages() as messages:
            data = mujoco.MjData(model)
            mujoco.mj_step(model, data)
            mujoco.mj_resetData(model, data)
            mujoco.mj_forward(model, data)
    except (ValueError, mujoco.FatalError) as error:
        message = one_line(error)
        if not honour_mjcf_options and "integrator" in message:
            message += " (scenes use implicitfast; start the server with --mjcf-options to take the model's own)"
        raise CompileFailed(message) from None
    warnings.extend(one_line(message) for message in messages)
    planes = _coinciding_planes(model)
    _draw_once(model, planes)
    warnings.extend(_floor_warning(model, members) for members in planes)
    for warning in warnings:
        logger.warning("%s", warning)
    indices = tuple(_index(model, actor, blueprint, camera_size) for actor, blueprint in articulations)
    _fit_offscreen_buffer(model, (camera.resolution for index in indices for camera in index.cameras))
    return CompiledScene(
        model, data, spec, indices, tuple(_entity(model, *names) for names in entities), tuple(warnings)
    )


def _refuse(problem: str) -> None:
    if problem:
        raise CompileFailed(problem)


def _size_problem(model: mujoco.MjModel, limits: Limits) -> str:
    """Return which limit the compiled scene exceeds where its parts gave no number, or nothing."""
    n_bytes = mujoco.mj_sizeModel(model) + model.narena
    if n_bytes > limits.scene_bytes:
        return f"the scene takes {n_bytes} bytes, more than the limit scene_bytes, {limits.scene_bytes}"
    if model.nsensordata > limits.sensor_values:
        return (
            f"its sensors give {model.nsensordata} numbers, more than the limit sensor_values, {limits.sensor_values}"
        )
    return ""


def actor_bounds(actor: Actor, *, every_geom: bool = False) -> tuple[Vec3, Vec3] | None:
    """Return the lower and upper corner of the box around an actor at its authored pose, world frame, metres.

    Args:
        actor: The actor.
        every_geom: Count geoms that collide with nothing, too.

    Returns:
        The corners; None for an actor without geoms. Planes are endless and do not count.

    Raises:
        CompileFailed: The actor's own model does not compile.
    """
    try:
        if actor.blueprint is not None:
            boxes = _blueprint_boxes(actor.blueprint.folder)
        elif actor.mesh is not None:
            spec = mujoco.MjSpec()
            _add_mesh(spec, spec.worldbody, actor, actor.mesh, name="geom")
            boxes = _boxes(spec.compile())
        else:
            return None
    except (ValueError, mujoco.FatalError) as error:
        raise CompileFailed(one_line(error)) from None
    chosen = boxes.solid | every_geom
    if not chosen.any():
        return None
    turn = np.array([rotate(actor.rotation, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]).T
    centers = boxes.centers[chosen] @ turn.T + np.array(actor.location)
    halves = np.einsum("nij,nj->ni", np.abs(turn @ boxes.axes[chosen]), boxes.halves[chosen])
    lower, upper = (centers - halves).min(axis=0).tolist(), (centers + halves).max(axis=0).tolist()
    return (lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])


def _compose(
    actors: Sequence[Actor],
    articulations: Sequence[tuple[Actor, Blueprint]],
    warnings: list[str],
    *,
    honour_mjcf_options: bool,
) -> tuple[mujoco.MjSpec, list[tuple[str, str | None]]]:
    """Return the spec of the whole scene, and the body and free joint of each converted mesh."""
    spec = mujoco.MjSpec()
    spec.modelname = "urlab"
    spec.compiler.degree = False
    spec.copy_during_attach = True
    if honour_mjcf_options and articulations:
        _copy_options(articulations[0][1].spec.option, spec.option)
    warnings.extend(_ignored_options(spec, articulations, honoured=honour_mjcf_options))
    children = {blueprint.folder: _attachable(blueprint, spec) for _, blueprint in articulations}
    bodies: list[tuple[str, str | None]] = []
    for actor in actors:
        if actor.blueprint is not None:
            frame = spec.worldbody.add_frame(pos=actor.location, quat=wxyz(actor.rotation))
            spec.attach(children[actor.blueprint.folder], frame=frame, prefix=actor.prefix)
        elif actor.light is not None:
            _add_light(spec, actor)
        elif actor.mesh is not None:
            converted = _add_static_mesh(spec, actor, actor.mesh)
            if converted is not None:
                bodies.append(converted)
    _restore_world_references(spec, {f"{actor.prefix}world" for actor, _ in articulations})
    merge_assets(spec, children)
    return spec, bodies


def _restore_world_references(spec: mujoco.MjSpec, prefixed: set[str]) -> None:
    """Undo the prefix that attaching gives the world's name where lights and cameras aim at it."""
    for element in (*spec.lights, *spec.cameras):
        if element.targetbody in prefixed:
            element.targetbody = "world"


def _attachable(blueprint: Blueprint, parent: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a copy of the blueprint's spec that agrees with `parent` in whatever attaching would drop.

    Where they disagree MuJoCo keeps the parent's value as we want, but prints a warning for each attachment.
    """
    child = blueprint.spec.copy()
    _copy_options(parent.option, child.option)
    child.visual.map.znear = parent.visual.map.znear
    child.visual.map.zfar = parent.visual.map.zfar
    child.visual.global_.realtime = parent.visual.global_.realtime
    for size in _SIZES:
        setattr(child, size, getattr(parent, size))
    return child


_SIZES: Final = (  # what `<size>` sets
    *("memory", "njmax", "nconmax", "nuserdata", "nkey"),
    *(f"nuser_{kind}" for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")),
)


@cache
def _option_names() -> tuple[str, ...]:
    return tuple(name for name in dir(mujoco.MjSpec().option) if not name.startswith("_"))


def _copy_options(source: Any, target: Any) -> None:
    for name in _option_names():
        value = getattr(source, name)
        if isinstance(value, np.ndarray):
            getattr(target, name)[:] = value
        else:
            setattr(target, name, value)


def _ignored_options(
    spec: mujoco.MjSpec, articulations: Iterable[tuple[Actor, Blueprint]], *, honoured: bool
) -> list[str]:
    """Return one warning that names the options of the models that will have no effect, or none."""
    default = mujoco.MjSpec().option
    applied = mujoco.MjSpec()
    _copy_options(spec.option, applied.option)
    if not honoured:
        applied.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ignored: list[str] = []
    for blueprint in {blueprint.folder: blueprint for _, blueprint in articulations}.values():
        own = blueprint.spec.option
        names = [
            name
            for name in _option_names()
            if not np.array_equal(getattr(own, name), getattr(default, name))
            and not np.array_equal(getattr(own, name), getattr(applied.option, name))
        ]
        if names:
            ignored.append(f"{blueprint.stem}: {', '.join(_option_text(name, getattr(own, name)) for name in names)}")
    if not ignored:
        return []
    reason = (
        "the first articulation's options apply"
        if honoured
        else "the plugin's defaults apply; --mjcf-options (sim://MODEL?mjcf-options) takes the first model's"
    )
    return [f"options of the models have no effect ({'; '.join(ignored)}): {reason}"]


def _option_text(name: str, value: Any) -> str:
    enumerations = {
        "integrator": mujoco.mjtIntegrator,
        "cone": mujoco.mjtCone,
        "jacobian": mujoco.mjtJacobian,
        "solver": mujoco.mjtSolver,
    }
    flags = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}
    if name in enumerations:
        return f"{name} {_constant(enumerations[name](value))}"
    if name in flags:
        names = [_constant(bit).lower() for bit in flags[name].__members__.values() if int(bit) & int(value)]
        return f"{name.removesuffix('flags')}d {' '.join(names)}"
    if isinstance(value, np.ndarray):
        return f"{name} ({' '.join(f'{number:g}' for number in value.tolist())})"
    return f"{name} {value:g}"


def _constant(member: Any) -> str:
    return str(member.name).partition("_")[2]


def _add_light(spec: mujoco.MjSpec, actor: Actor) -> None:
    light = actor.light
    if light is None:
        return
    types = {
        "directional": mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        "point": mujoco.mjtLightType.mjLIGHT_POINT,
        "spot": mujoco.mjtLightType.mjLIGHT_SPOT,
    }
    brightness = min(max(light.intensity / FULL_BRIGHTNESS, 0.0), 2.0)
    spec.worldbody.add_light(
        name=f"{actor.prefix}Light",
        type=types[light.kind],
        pos=actor.location,
        dir=rotate(actor.rotation, (1.0, 0.0, 0.0)),
        diffuse=[channel * brightness for channel in light.color],
        cutoff=_SPOT_CUTOFF if light.kind == "spot" else 45.0,
    )


def _add_static_mesh(spec: mujoco.MjSpec, actor: Actor, mesh: Mesh) -> tuple[str, str | None] | None:
    """Add a static mesh actor; return its body and free joint if it is converted to a body."""
    pose = {"pos": actor.location, "quat": wxyz(actor.rotation)}
    convert = actor.quick_convert
    if convert is None:
        _add_mesh(spec, spec.worldbody, actor, mesh, name=f"{actor.prefix}Mesh", contype=0, conaffinity=0, **pose)
        return None
    body = spec.worldbody.add_body(name=f"{actor.prefix}MjBody", mocap=convert.driven_by_unreal, **pose)
    joint: str | None = None
    if not convert.static and not convert.driven_by_unreal:
        joint = f"{actor.name}FreeJoint"
        body.add_freejoint(name=joint)
    name = _unique("Geom_0_0", {geom.name for geom in spec.geoms}, separator="_")
    settings = {"solref": [0.02, 1.0], "solimp": [0.9, 0.95, 0.001, 0.5, 2.0], "friction": convert.friction}
    if convert.complex_mesh and mesh.shape == "file":
        _add_parts(spec, body, actor, mesh, convert.coacd_threshold, name=name, **settings)
    else:  # MuJoCo makes one convex hull of a mesh, and the primitives are convex
        _add_mesh(spec, body, actor, mesh, name=name, **settings)
    return body.name, joint


def _add_parts(
    spec: mujoco.MjSpec, body: Any, actor: Actor, mesh: Mesh, threshold: float, *, name: str, **settings: Any
) -> None:
    for vertices, faces in convex_parts(Path(mesh.file), threshold):
        part = _unique(name, {geom.name for geom in spec.geoms}, separator="_")
        asset = spec.add_mesh(
            name=f"{actor.prefix}{part}",
            uservert=vertices.ravel().tolist(),
            userface=faces.ravel().tolist(),
            scale=actor.scale,
        )
        shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": asset.name}
        body.add_geom(name=part, rgba=mesh.rgba, **shape, **settings)


def _add_mesh(spec: mujoco.MjSpec, body: Any, actor: Actor, mesh: Mesh, *, name: str, **settings: Any) -> None:
    sx, sy, sz = (abs(factor) for factor in actor.scale)
    if mesh.shape == "file":
        asset = spec.add_mesh(name=f"{actor.prefix}{name}", file=mesh.file, scale=actor.scale)
        settings |= {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": asset.name}
    else:
        types = {
            "box": (mujoco.mjtGeom.mjGEOM_BOX, (sx, sy, sz)),
            "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, (sx, sy, sz)),
            "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, (max(sx, sy, sz),)),
            "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, (max(sx, sy), sz)),
            "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, (max(sx, sy), sz)),
            "plane": (mujoco.mjtGeom.mjGEOM_PLANE, (sx, sy)),
        }
        kind, factors = types[mesh.shape]
        size = [length * factor for length, factor in zip(mesh.size, factors, strict=True)]
        if mesh.shape == "plane":
            size.append(0.05)  # spacing of the grid lines, which are not drawn
        settings |= {"type": kind, "size": [*size, 0.0, 0.0][:3]}
    body.add_geom(name=name, rgba=mesh.rgba, **settings)


def _unique(name: str, taken: set[str], *, separator: str = "") -> str:
    """Return `name`, or the first of its numbered variants that is not taken."""
    stem, dot, suffix = name.partition(".")
    candidate, count = name, 0
    while candidate in taken:
        count += 1
        candidate = f"{stem}{separator or '_'}{count}{dot}{suffix}"
    return candidate


def _fit_offscreen_buffer(model: mujoco.MjModel, sizes: Iterable[tuple[int, int]]) -> None:
    """Make the buffer that offscreen rendering uses large enough for every camera."""
    screen = model.vis.global_
    for width, height in sizes:
        screen.offwidth = max(screen.offwidth, width)
        screen.offheight = max(screen.offheight, height)


def _coinciding_planes(model: mujoco.MjModel) -> list[list[int]]:
    """Return each set of two or more static, colliding planes that lie in one another, as floors inside robots do."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    static = model.body_weldid[model.geom_bodyid] == 0
    groups: list[tuple[Floats, float, list[int]]] = []
    for geom in np.flatnonzero((model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)) & solid & static).tolist():
        normal: Floats = data.geom_xmat[geom].reshape(3, 3)[:, 2].copy()
        offset = float(normal @ data.geom_xpos[geom])
        for other, at, members in groups:
            if np.abs(other - normal).max() < _SAME and abs(at - offset) < _SAME:
                members.append(geom)
                break
        else:
            groups.append((normal, offset, [geom]))
    return [members for _, _, members in groups if len(members) > 1]


def _draw_once(model: mujoco.MjModel, planes: list[list[int]]) -> None:
    """Hide what every robot brings along and a picture bears only once. Physics is not touched.

    Of coinciding floors one is drawn, as large as all together: drawn all, they flicker. Of directional lights that
    shine alike one stays on.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for members in planes:
        sizes: Floats = model.geom_size[members, :2]
        # Half size 0 is endless.
        drawn = members[int(np.argmax(np.where(sizes == 0.0, np.inf, sizes).sum(axis=1)))]
        turn: Floats = data.geom_xmat[drawn].reshape(3, 3)
        for other in members:
            if other == drawn:
                continue
            center = turn.T @ (data.geom_xpos[other] - data.geom_xpos[drawn])
            reach = np.abs(turn.T @ data.geom_xmat[other].reshape(3, 3))[:2, :2] @ model.geom_size[other, :2]
            size: Floats = model.geom_size[drawn, :2]
            model.geom_size[drawn, :2] = np.where(size == 0.0, 0.0, np.maximum(size, np.abs(center[:2]) + reach))
            model.geom_matid[other] = -1
            model.geom_rgba[other, 3] = 0.0
    suns: list[Floats] = []
    for light in np.flatnonzero(model.light_type == int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)).tolist():
        sun = np.concatenate([model.light_dir[light], model.light_diffuse[light]])
        if model.light_bodyid[light] == 0 and any(np.abs(sun - other).max() < _SAME for other in suns):
            model.light_active[light] = False
        else:
            suns.append(sun)


def _floor_warning(model: mujoco.MjModel, members: list[int]) -> str:
    names = ", ".join(model.geom(geom).name for geom in members[:4])
    return (
        f"{len(members)} floors coincide ({names}{', …' if len(members) > 4 else ''}): what stands on them has "
        f"{len(members)} contacts for one, which costs time and makes the ground a little stiffer"
    )


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes around the geoms of a model at its reference: centres (n, 3), axes (n, 3, 3), half sizes (n, 3)."""

    centers: Floats
    axes: Floats
    halves: Floats
    solid: NDArray[np.bool_]


def _boxes(model: mujoco.MjModel) -> _Boxes:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bounded = model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)
    axes: Floats = data.geom_xmat.reshape(-1, 3, 3)[bounded]
    aabb: Floats = model.geom_aabb[bounded]
    return _Boxes(
        centers=data.geom_xpos[bounded] + np.einsum("nij,nj->ni", axes, aabb[:, :3]),
        axes=axes,
        halves=aabb[:, 3:],
        solid=((model.geom_contype | model.geom_conaffinity) != 0)[bounded],
    )


@lru_cache(maxsize=64)
def _blueprint_boxes(folder: Path) -> _Boxes:
    with mujoco_messages():
        return _boxes(mujoco.MjModel.from_xml_path(str(folder / "model.xml")))


def _index(
    model: mujoco.MjModel, actor: Actor, blueprint: Blueprint, camera_size: tuple[int, int] | None
) -> ArticulationIndex:
    """Find an articulation's elements by their exact compiled names, which no other prefix can be mistaken for."""

    def find(kind: int, names: Iterable[str]) -> tuple[Ints, tuple[str, ...]]:
        ids = {name: mujoco.mj_name2id(model, kind, f"{actor.prefix}{name}") for name in names}
        # Bodies that compilation fused away are in the spec, but not in the model.
        found = sorted((index, name) for name, index in ids.items() if index >= 0)
        return np.array([index for index, _ in found], dtype=np.int32), tuple(name for _, name in found)

    objects = mujoco.mjtObj
    bodies, body_names = find(objects.mjOBJ_BODY, (body.name for body in blueprint.spec.bodies[1:]))
    joints, joint_names = find(objects.mjOBJ_JOINT, blueprint.joints)
    actuators, actuator_names = find(objects.mjOBJ_ACTUATOR, blueprint.actuators)
    sensors, sensor_names = find(objects.mjOBJ_SENSOR, blueprint.sensors)
    cameras, camera_names = find(objects.mjOBJ_CAMERA, blueprint.cameras)
    positions, velocities = _joint_widths(model, joints)
    controls = control_counts(model)[actuators]
    return ArticulationIndex(
        key=actor.name,
        prefix=actor.prefix,
        actor_id=actor.actor_id,
        model_name=blueprint.model_name or blueprint.stem,
        root_body=int(bodies[0]) if bodies.size else 0,
        bodies=bodies,
        joints=joints,
        actuators=actuators,
        sensors=sensors,
        body_names=body_names,
        joint_names=joint_names,
        actuator_names=actuator_names,
        sensor_names=sensor_names,
        qpos_adr=_spans(model.jnt_qposadr[joints], positions),
        qvel_adr=_spans(model.jnt_dofadr[joints], velocities),
        ctrl_adr=_spans(control_starts(model)[actuators], controls),
        act_adr=np.repeat(model.actuator_actadr[actuators], controls).astype(np.int32),
        force_adr=_spans(force_starts(model)[actuators], force_counts(model)[actuators]),
        actuator_types=MappingProxyType({name: blueprint.actuator_types[name] for name in actuator_names}),
        cameras=tuple(
            _camera(model, int(index), name, camera_size) for index, name in zip(cameras, camera_names, strict=True)
        ),
        controller=_controller(actor, blueprint),
    )


def _controller(actor: Actor, blueprint: Blueprint) -> ControllerText | None:
    """Return the controller that the level gives an articulation, or else its MJCF."""
    authored = [text.data for text in blueprint.spec.texts if text.name == CUSTOM_TEXT]
    text = actor.controller or next(iter(authored), "")
    try:
        return ControllerText.parse(text) if text else None
    except ValueError as error:
        raise CompileFailed(f"{blueprint.stem}: custom text '{CUSTOM_TEXT}': {error}") from None


def _joint_widths(model: mujoco.MjModel, joints: Ints) -> tuple[Ints, Ints]:
    """Return how many coordinates and velocities each joint has."""
    kinds = model.jnt_type[joints]
    free, ball = kinds == int(mujoco.mjtJoint.mjJNT_FREE), kinds == int(mujoco.mjtJoint.mjJNT_BALL)
    return np.select([free, ball], [7, 4], 1).astype(np.int32), np.select([free, ball], [6, 3], 1).astype(np.int32)


def _spans(starts: Ints, lengths: Ints) -> Ints:
    """Return the concatenation of the ranges start, start + 1, … of the given lengths."""
    spans = [np.arange(start, start + length, dtype=np.int32) for start, length in zip(starts, lengths, strict=True)]
    return np.concatenate(spans) if spans else np.empty(0, dtype=np.int32)


def _camera(model: mujoco.MjModel, index: int, name: str, size: tuple[int, int] | None) -> SceneCamera:
    width, height = (int(pixels) for pixels in model.cam_resolution[index])
    if width * height <= 1:  # MuJoCo's 1x1 says that the MJCF gives none
        width, height = size or DEFAULT_CAMERA_SIZE
    return SceneCamera(name=name, id=index, resolution=(width, height), fovy=float(model.cam_fovy[index]))


def _entity(model: mujoco.MjModel, body: str, joint: str | None) -> EntityIndex:
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
    if joint is None:
        return EntityIndex(name=body, body=index)
    joint_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    return EntityIndex(
        name=body,
        body=index,
        free_joint=joint,
        free_joint_id=joint_id,
        qpos_adr=int(model.jnt_qposadr[joint_id]),
        qvel_adr=int(model.jnt_dofadr[joint_id]),
    )
