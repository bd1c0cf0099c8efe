"""The actors of a level, combined into one spec."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import mujoco

from urlab_client._mujoco import merge_assets
from urlab_client.server.assets.actors import Actor
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.compile.mjcf_options import OptionPolicy, adopt_options, copy_options, ignored_options
from urlab_client.server.compile.static_meshes import add_light, add_static_mesh
from urlab_client.values.rotation import wxyz


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


_SIZES: Final = (  # what `<size>` sets
    *("memory", "njmax", "nconmax", "nuserdata", "nkey"),
    *(f"nuser_{kind}" for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")),
)
