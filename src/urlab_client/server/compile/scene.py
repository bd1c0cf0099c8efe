"""From the actors of a level to one MuJoCo model, and to documents of it.

For the code that starts play, and for the engine, which steps the result. Options, prefixes, keyframes and names
follow the plugin: see `compile_scene`. Nothing here steps, paces or talks to clients.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Final
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import copy_options, flat_model, saved_model
from urlab_client.server.assets.actors import Actor, scene_problem
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.assets.importer import mujoco_messages, one_line
from urlab_client.server.compile.composition import aims_at_world, attachable, compose, empty_scene, populate
from urlab_client.server.compile.mjcf_options import OptionPolicy
from urlab_client.server.compile.scene_index import ArticulationIndex, EntityIndex, index_articulation, index_entity
from urlab_client.server.limits import Limits, options_problem
from urlab_client.server.refusal import CompileFailed
from urlab_client.values.rotation import wxyz

_FILE: Final = re.compile(r'\b(file\w*)="([^"]*)"')


logger: logging.Logger = logging.getLogger("urlab_client.server")

_DEFAULT_LIMITS: Final = Limits()

Floats = NDArray[np.float64]

_SAME: Final = 1e-6


def attached_scene(spec: mujoco.MjSpec, actors: Sequence[Actor]) -> tuple[str, dict[str, bytes]] | None:
    """Return a scene as a document with attached robots, and all files it needs by their bare names.

    A robot's document is named after its compiled prefix, `PREFIXmodel.xml`, and so are its files. Robots of the same
    kind share the files of the first, because files are large, unlike documents.

    Returns:
        None for a scene that has to be one document: something in a robot aims at the world, which means the robot's
        own when it is attached.
    """
    blueprints = [(actor, actor.blueprint) for actor in actors if actor.blueprint is not None]
    if any(aims_at_world(blueprint.spec) for _, blueprint in blueprints):
        return None
    scene = empty_scene()
    scene.memory = spec.memory
    copy_options(spec.option, scene.option)
    documents: dict[str, bytes] = {}
    known: dict[Path, str] = {}
    files: dict[str, bytes] = {}
    for actor, blueprint in blueprints:
        if blueprint.folder not in known:
            known[blueprint.folder], own = _robot(attachable(blueprint, scene), actor.prefix)
            files |= own
        documents[f"{actor.prefix}model.xml"] = known[blueprint.folder].encode()

    def mark(actor: Actor, blueprint: Blueprint) -> None:
        del blueprint
        scene.worldbody.add_body(name=actor.prefix)

    populate(scene, actors, mark)
    scene.compile()
    text, own = flat_model(scene)
    return _with_robots(text, [actor for actor, _ in blueprints]), {**own, **files, **documents}


def _robot(spec: mujoco.MjSpec, prefix: str) -> tuple[str, dict[str, bytes]]:
    spec.compile()
    text, files = flat_model(spec)
    text = _FILE.sub(lambda match: f'{match[1]}="{prefix}{match[2]}"' if match[2] in files else match[0], text)
    return text, {f"{prefix}{name}": content for name, content in files.items()}


def _with_robots(text: str, actors: Sequence[Actor]) -> str:
    """Return a scene with robots where it has bodies that are called as their prefixes."""
    root = ET.fromstring(text)  # noqa: S314 - MuJoCo has just written it
    assets, world = root.find("asset"), root.find("worldbody")
    if assets is None:
        assets = ET.SubElement(root, "asset")
    if world is None:
        raise ValueError("MuJoCo wrote a scene without a world")
    marks = {body.get("name"): body for body in world.findall("body")}
    for actor in actors:
        prefix = actor.prefix
        ET.SubElement(assets, "model", name=prefix, file=f"{prefix}model.xml")
        mark = marks[prefix]
        mark.clear()
        mark.tag = "frame"
        mark.set("pos", _numbers(actor.location))
        mark.set("quat", _numbers(wxyz(actor.rotation)))
        ET.SubElement(mark, "attach", model=prefix, prefix=prefix)
    return ET.tostring(root, encoding="unicode")


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


@dataclass(frozen=True, eq=False)
class CompiledScene:
    """A compiled scene.

    Attributes:
        data: Its data, reset and with derived quantities computed.
        spec: The compiled `mujoco.MjSpec`; options of `model.opt` that changed since are not in it.
        actors: What it was compiled from, in spawn order.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    spec: mujoco.MjSpec
    articulations: tuple[ArticulationIndex, ...]
    actors: tuple[Actor, ...] = ()
    entities: tuple[EntityIndex, ...] = ()
    warnings: tuple[str, ...] = ()

    def mjb(self) -> bytes:
        """Return the live model in MuJoCo's binary format. The caller holds the model's lock."""
        return saved_model(self.model)

    def export(self, *, attached: bool = False) -> tuple[str, dict[str, bytes]]:
        """Return the scene as MJCF, and the content of every file it refers to, by bare name.

        Args:
            attached: Whether each robot has a document of its own among the files, which the scene attaches.
        """
        xml, files = self._attached if attached else self._flat
        return xml, dict(files)

    @cached_property
    def _attached(self) -> tuple[str, dict[str, bytes]]:
        with mujoco_messages():
            attached = attached_scene(self.spec, self.actors)
        return attached or self._flat

    @cached_property
    def _flat(self) -> tuple[str, dict[str, bytes]]:
        with mujoco_messages():
            return flat_model(self.spec, compiled=True)


def compile_scene(
    actors: Sequence[Actor],
    *,
    options: OptionPolicy = "ignored",
    camera_size: tuple[int, int] | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
    limits: Limits = _DEFAULT_LIMITS,
) -> CompiledScene:
    """Compile the actors of a level into one model.

    Each articulation's MJCF is attached at the actor's pose with its name as prefix. Its `<visual>` and `<statistic>`
    have no effect, and of its `<size>` only the memory. Unless asked for, its `<option>` has none, either: the scene
    has MuJoCo's default options and the implicitfast integrator, as in the plugin of June 2026. Keyframes hold the
    owner's part; everything else is at its reference, and a free joint's coordinates are not moved by the actor's pose.
    Cameras, lights and materials stay, but of floors that coincide and of suns that shine alike one is drawn.

    Args:
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
        spec, entities = compose(actors, articulations, warnings, options)
        for name, content in texts.items():
            text = spec.add_text()
            text.name, text.data = name, content
        _refuse(options_problem(spec.option, limits))
        model = spec.compile()
        memory = sum(max(blueprint.spec.memory, 0) for _, blueprint in articulations)
        if memory > model.narena:  # the user found MuJoCo's own estimate too small
            spec.memory = memory
            model = spec.compile()
        _refuse(_size_problem(model, limits))
        if options == "ignored":
            model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        with mujoco_messages() as messages:
            data = mujoco.MjData(model)
            mujoco.mj_step(model, data)
            mujoco.mj_resetData(model, data)
            mujoco.mj_forward(model, data)
    except (ValueError, mujoco.FatalError) as error:
        message = one_line(error)
        if options == "ignored" and "integrator" in message:
            message += " (scenes use implicitfast; start the server with --mjcf-options to take the model's own)"
        raise CompileFailed(message) from None
    warnings.extend(one_line(message) for message in messages)
    planes = coinciding_planes(model)
    draw_once(model, planes)
    warnings.extend(floor_warning(model, members) for members in planes)
    for warning in warnings:
        logger.warning("%s", warning)
    indices = tuple(index_articulation(model, actor, blueprint, camera_size) for actor, blueprint in articulations)
    _fit_offscreen_buffer(model, (camera.resolution for index in indices for camera in index.cameras))
    return CompiledScene(
        model,
        data,
        spec,
        indices,
        tuple(actors),
        tuple(index_entity(model, *names) for names in entities),
        tuple(warnings),
    )


def _refuse(problem: str) -> None:
    if problem:
        raise CompileFailed(problem)


def _size_problem(model: mujoco.MjModel, limits: Limits) -> str:
    """Return which limit the scene exceeds, or nothing; for numbers that are known only after compilation."""
    n_bytes = mujoco.mj_sizeModel(model) + model.narena
    if n_bytes > limits.scene_bytes:
        return f"the scene takes {n_bytes} bytes, more than the limit scene_bytes, {limits.scene_bytes}"
    if model.nsensordata > limits.sensor_values:
        return (
            f"its sensors give {model.nsensordata} numbers, more than the limit sensor_values, {limits.sensor_values}"
        )
    return ""


def _fit_offscreen_buffer(model: mujoco.MjModel, sizes: Iterable[tuple[int, int]]) -> None:
    """Make the buffer that offscreen rendering uses large enough for every camera."""
    screen = model.vis.global_
    for width, height in sizes:
        screen.offwidth = max(screen.offwidth, width)
        screen.offheight = max(screen.offheight, height)


def coinciding_planes(model: mujoco.MjModel) -> list[list[int]]:
    """Return the sets of static, colliding planes that coincide, such as the floors of several robots' models."""
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


def draw_once(model: mujoco.MjModel, planes: list[list[int]]) -> None:
    """Hide duplicates of floors and suns. Physics is not affected.

    One of several coinciding floors is drawn, as large as all together, because overlapping floors flicker. One of
    several directional lights with the same direction and colour stays on.
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


def floor_warning(model: mujoco.MjModel, members: list[int]) -> str:
    """Return a warning about floors that coincide."""
    names = ", ".join(model.geom(geom).name for geom in members[:4])
    return (
        f"{len(members)} floors coincide ({names}{', …' if len(members) > 4 else ''}): what stands on them has "
        f"{len(members)} contacts for one, which costs time and makes the ground a little stiffer"
    )
