"""A scene as documents: one for the scene, which attaches one for each robot.

For the handshake of dialects with `Dialect.robots_attached`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import mujoco

from urlab_client._mujoco import flat_model
from urlab_client.server.assets.actors import Actor
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.compile.composition import aims_at_world, attachable, empty_scene, populate
from urlab_client.server.compile.mjcf_options import copy_options
from urlab_client.values.rotation import wxyz

_FILE: Final = re.compile(r'\b(file\w*)="([^"]*)"')


def attached_scene(spec: mujoco.MjSpec, actors: Sequence[Actor]) -> tuple[str, dict[str, bytes]] | None:
    """Return a scene as a document with attached robots, and all files it needs by their bare names.

    A robot's document is named after its compiled prefix, `PREFIXmodel.xml`, and so are its files. Robots of the same
    kind share the files of the first, because files are large, unlike documents.

    Args:
        spec: The compiled scene, for its options.
        actors: What it was compiled from, in spawn order.

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
