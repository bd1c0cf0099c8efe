"""The actors of a level: combined into one spec, and the boxes around each of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import MODEL_FILE, compiled_file, copy_options, merge_assets
from urlab_client.server.assets.actors import Actor, Mesh
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.assets.decomposition import convex_parts
from urlab_client.server.assets.importer import mujoco_messages, one_line
from urlab_client.server.compile.mjcf_options import OptionPolicy, adopt_options, ignored_options
from urlab_client.server.refusal import CompileFailed
from urlab_client.values.rotation import Vec3, rotate, wxyz

_SIZES: Final = (  # what `<size>` sets
    *("memory", "njmax", "nconmax", "nuserdata", "nkey"),
    *(f"nuser_{kind}" for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")),
)

FULL_BRIGHTNESS: Final = 5000.0
"""Intensity that corresponds to MuJoCo's full diffuse colour; the engine's default."""

_SPOT_CUTOFF: Final = 44.0
"""Unreal's default outer cone angle, degrees."""


def compose(
    actors: Sequence[Actor],
    articulations: Sequence[tuple[Actor, Blueprint]],
    warnings: list[str],
    options: OptionPolicy,
) -> tuple[mujoco.MjSpec, list[tuple[str, str | None]]]:
    """Return the spec of the whole scene, and the body and free joint of each converted mesh.

    Raises:
        CompileFailed: The options of its models cannot be merged.
    """
    spec = empty_scene()
    spec.copy_during_attach = True
    adopt_options(spec, articulations, options)
    warnings.extend(ignored_options(spec, articulations, options))
    children = {blueprint.folder: attachable(blueprint, spec) for _, blueprint in articulations}

    def attach(actor: Actor, blueprint: Blueprint) -> None:
        frame = spec.worldbody.add_frame(pos=actor.location, quat=wxyz(actor.rotation))
        spec.attach(children[blueprint.folder], frame=frame, prefix=actor.prefix)

    bodies = populate(spec, actors, attach)
    _restore_world_references(spec, {f"{actor.prefix}world" for actor, _ in articulations})
    merge_assets(spec, children)
    return spec, bodies


def empty_scene() -> mujoco.MjSpec:
    """Return the spec of an empty scene."""
    spec = mujoco.MjSpec()
    spec.modelname = "urlab"
    spec.compiler.degree = False
    return spec


def populate(
    spec: mujoco.MjSpec, actors: Sequence[Actor], place: Callable[[Actor, Blueprint], None]
) -> list[tuple[str, str | None]]:
    """Add actors to a scene, articulations by `place`; return the body and free joint of each converted mesh."""
    bodies: list[tuple[str, str | None]] = []
    for actor in actors:
        if actor.blueprint is not None:
            place(actor, actor.blueprint)
        elif actor.light is not None:
            add_light(spec, actor)
        elif actor.mesh is not None:
            converted = add_static_mesh(spec, actor, actor.mesh)
            if converted is not None:
                bodies.append(converted)
    return bodies


def _restore_world_references(spec: mujoco.MjSpec, prefixed: set[str]) -> None:
    """Remove the prefix that attaching adds to the world's name in lights and cameras that aim at it."""
    for element in (*spec.lights, *spec.cameras):
        if element.targetbody in prefixed:
            element.targetbody = "world"


def aims_at_world(spec: mujoco.MjSpec) -> bool:
    """Return whether lights or cameras aim at the world's origin, whose name attaching would change."""
    return any(element.targetbody == "world" for element in (*spec.lights, *spec.cameras))


def attachable(blueprint: Blueprint, parent: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a copy of the blueprint's spec that agrees with `parent` in whatever attaching would drop.

    Where they disagree MuJoCo keeps the parent's value as we want, but prints a warning for each attachment.
    """
    child = blueprint.spec.copy()
    copy_options(parent.option, child.option)
    child.visual.map.znear = parent.visual.map.znear
    child.visual.map.zfar = parent.visual.map.zfar
    child.visual.global_.realtime = parent.visual.global_.realtime
    for size in _SIZES:
        setattr(child, size, getattr(parent, size))
    return child


def add_light(spec: mujoco.MjSpec, actor: Actor) -> None:
    """Add a light actor to the world."""
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


def add_static_mesh(spec: mujoco.MjSpec, actor: Actor, mesh: Mesh) -> tuple[str, str | None] | None:
    """Add a static mesh actor; return its body and free joint if it is converted to a body."""
    pose = {"pos": actor.location, "quat": wxyz(actor.rotation)}
    convert = actor.quick_convert
    if convert is None:
        add_mesh(spec, spec.worldbody, actor, mesh, name=f"{actor.prefix}Mesh", contype=0, conaffinity=0, **pose)
        return None
    body = spec.worldbody.add_body(name=f"{actor.prefix}MjBody", mocap=convert.driven_by_unreal, **pose)
    joint: str | None = None
    if not convert.static and not convert.driven_by_unreal:
        joint = f"{actor.name}FreeJoint"
        body.add_freejoint(name=joint)
    name = unique_name("Geom_0_0", {geom.name for geom in spec.geoms})
    settings = {"solref": [0.02, 1.0], "solimp": [0.9, 0.95, 0.001, 0.5, 2.0], "friction": convert.friction}
    if convert.complex_mesh and mesh.shape == "file":
        _add_parts(spec, body, actor, mesh, convert.coacd_threshold, name=name, **settings)
    else:  # MuJoCo makes one convex hull of a mesh, and the primitives are convex
        add_mesh(spec, body, actor, mesh, name=name, **settings)
    return body.name, joint


def _add_parts(
    spec: mujoco.MjSpec, body: Any, actor: Actor, mesh: Mesh, threshold: float, *, name: str, **settings: Any
) -> None:
    for vertices, faces in convex_parts(Path(mesh.file), threshold):
        part = unique_name(name, {geom.name for geom in spec.geoms})
        asset = spec.add_mesh(
            name=f"{actor.prefix}{part}",
            uservert=vertices.ravel().tolist(),
            userface=faces.ravel().tolist(),
            scale=actor.scale,
        )
        shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": asset.name}
        body.add_geom(name=part, rgba=mesh.rgba, **shape, **settings)


def add_mesh(spec: mujoco.MjSpec, body: Any, actor: Actor, mesh: Mesh, *, name: str, **settings: Any) -> None:
    """Add the geom of a mesh to a body, with the actor's scale; `settings` are further attributes of the geom."""
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


def unique_name(name: str, taken: set[str]) -> str:
    """Return `name`, or its first numbered variant that is free."""
    candidates = itertools.chain([name], (f"{name}_{count}" for count in itertools.count(1)))
    return next(candidate for candidate in candidates if candidate not in taken)


Floats = NDArray[np.float64]

Box = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lowest and highest corner of an axis-aligned box, metres, world frame."""


def actor_bounds(actor: Actor, *, every_geom: bool = False) -> tuple[Vec3, Vec3] | None:
    """Return the lower and upper corner of the box around an actor at its authored pose, world frame, metres.

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
            add_mesh(spec, spec.worldbody, actor, actor.mesh, name="geom")
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
        return _boxes(compiled_file(folder / MODEL_FILE))


def box_around(model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.bool_]) -> Box:
    """Return the box around the chosen geoms, of which there must be one at least; none may be a plane.

    Args:
        geoms: Mask, shape (ngeom,).
    """
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    middle = data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotation, model.geom_aabb[geoms, :3])
    reach = np.einsum("nij,nj->ni", np.abs(rotation), model.geom_aabb[geoms, 3:])
    return (middle - reach).min(axis=0), (middle + reach).max(axis=0)
