"""What older releases of MuJoCo lack is done in another way; here with the installed one, made to look older."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest

from urlab_client import URLabClient, _mujoco
from urlab_client.aio.model.upload import flatten
from urlab_client.protocol.base import DialectName
from urlab_client.protocol.messages.session import Hello
from urlab_client.server import SimulatedServer

OBJ = "v 0 0 0\nv {0} 0 0\nv 0 {0} 0\nv 0 0 {0}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"

SHORTCUTS = {
    "motor": "",
    "position": 'kp="3"',
    "velocity": 'kv="2"',
    "intvelocity": 'kp="2" actrange="-1 1"',
    "damper": 'kv="2" ctrlrange="0 1"',
    "cylinder": 'area="2"',
    "muscle": "",
    "dcmotor": 'motorconst="1 1" resistance="1"',
}


@pytest.fixture
def old(monkeypatch: pytest.MonkeyPatch) -> None:
    """A MuJoCo whose archives cannot be relied on, as before 3.16."""
    monkeypatch.setattr(_mujoco, "_writes_archives", lambda _: False)


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A model with a mesh and a texture in folders of their own."""
    folder = tmp_path / "robot"
    for part in ("meshes", "textures"):
        (folder / part).mkdir(parents=True)
    (folder / "meshes" / "part.obj").write_text(OBJ.format(0.5))
    (folder / "textures" / "t.png").write_bytes(PNG)
    file = folder / "robot.xml"
    file.write_text(
        '<mujoco model="robot"><compiler meshdir="meshes" texturedir="textures"/>'
        '<asset><mesh name="part" file="part.obj"/><texture name="t" type="2d" file="t.png"/></asset>'
        '<worldbody><body><joint name="j"/><geom type="mesh" mesh="part"/></body></worldbody></mujoco>'
    )
    return file


PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de"
    "0000000c49444154789c63f8cfc0000003010100c9fe92ef0000000049454e44ae426082"
)


@pytest.mark.usefixtures("old")
def test_a_model_is_written_with_its_files(robot: Path, tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_file(str(robot))
    spec.compile()

    _mujoco.write_model(spec, tmp_path / "copy")

    original = mujoco.MjModel.from_xml_path(str(robot))
    _mujoco.check_copy(robot, _mujoco.compiled_file(tmp_path / "copy" / "model.xml"))
    robot.parent.rename(tmp_path / "gone")
    copy = _mujoco.compiled_file(tmp_path / "copy" / "model.xml")
    np.testing.assert_allclose(copy.body_mass, original.body_mass)
    assert copy.ntex == 1


@pytest.mark.usefixtures("old")
def test_a_scene_is_exported_with_the_files_of_all_its_robots(robot: Path, tmp_path: Path) -> None:
    robots = []
    for name, size in (("small", 0.1), ("large", 0.9)):  # files of one name, with different content
        source = tmp_path / f"source-{name}"
        shutil.copytree(robot.parent, source)
        (source / "meshes" / "part.obj").write_text(OBJ.format(size))
        child = mujoco.MjSpec.from_file(str(source / "robot.xml"))
        child.compile()
        _mujoco.write_model(child, tmp_path / name)
        robots.append(tmp_path / name)
    scene = mujoco.MjSpec()
    for folder in robots:
        child = mujoco.MjSpec.from_file(str(folder / "model.xml"))
        scene.attach(child, frame=scene.worldbody.add_frame(), prefix=f"{folder.name}_")
    _mujoco.merge_assets(scene, robots)
    model = scene.compile()

    xml, files = _mujoco.flat_model(scene, compiled=True)

    again = mujoco.MjModel.from_xml_string(xml, files)
    np.testing.assert_allclose(again.mesh_vert, model.mesh_vert, atol=1e-6)
    assert np.ptp(model.mesh_vert) > 0.5


@pytest.mark.usefixtures("old")
def test_a_copy_with_the_wrong_files_is_refused(robot: Path) -> None:
    copy = _mujoco.compiled_file(robot)
    (robot.parent / "meshes" / "other.obj").write_text(OBJ.format(0.9))
    robot.write_text(robot.read_text().replace("part.obj", "other.obj"))
    with pytest.raises(ValueError, match="files in separate folders"):
        _mujoco.check_copy(robot, copy)


@pytest.mark.usefixtures("old")
def test_a_file_that_is_elsewhere_is_refused(robot: Path, tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_file(str(robot))
    spec.compile()
    spec.meshes[0].file = "nowhere.obj"
    with pytest.raises(ValueError, match=r"nowhere|files in separate folders"):
        _mujoco.write_model(spec, tmp_path / "copy")


@pytest.mark.parametrize("shortcut", SHORTCUTS)
def test_the_kind_of_an_actuator_is_known_by_its_parameters(shortcut: str) -> None:
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>'
        f'<actuator><{shortcut} joint="j" {SHORTCUTS[shortcut]}/></actuator></mujoco>'
    )

    class Older:
        """The actuator without `type`."""

        def __getattr__(self, name: str) -> object:
            if name == "type":
                raise AttributeError(name)
            return getattr(spec.actuators[0], name)

    assert _mujoco.actuator_kind(Older()) == shortcut
    assert _mujoco.actuator_kind(spec.actuators[0]) == shortcut


def test_attributes_of_a_newer_release_are_left_out_and_named() -> None:
    xml = (
        '<mujoco><worldbody><body><joint name="j" novelty="1 2"/><geom size="0.1" glow="3" name="g"/></body>'
        '<body><joint name="k" novelty="4"/><geom size="0.2"/></body></worldbody></mujoco>'
    )
    model, left_out = _mujoco.without_newer_attributes(xml, {}, mujoco.MjModel.from_xml_string)
    assert left_out == ["joint.novelty", "geom.glow"]
    assert (model.njnt, model.ngeom) == (2, 2)
    assert model.geom("g").size[0] == 0.1


def test_attributes_with_keywords_of_a_newer_release_are_left_out_and_named() -> None:
    xml = (
        '<mujoco><worldbody><body name="novel"><joint name="novel" type="novel"/><geom size="0.1" name="novel"/></body>'
        '</worldbody><actuator><motor joint="novel" ctrllimited="novel" name="novel"/></actuator></mujoco>'
    )
    model, left_out = _mujoco.without_newer_attributes(xml, {}, mujoco.MjModel.from_xml_string)
    assert left_out == ["motor.ctrllimited", "joint.type"]
    assert model.actuator("novel").trnid[0] == model.joint("novel").id


@pytest.mark.parametrize("body", ["<novelty/>", '<geom size="-1"/>', '<geom size="1" type=" novel"/><geom/>'])
def test_whatever_else_a_newer_release_writes_is_an_error(body: str) -> None:
    with pytest.raises(ValueError, match=r"novel|size"):
        _mujoco.without_newer_attributes(
            f"<mujoco><worldbody>{body}</worldbody></mujoco>", {}, mujoco.MjModel.from_xml_string
        )


def test_attributes_of_a_newer_release_are_left_out_of_attached_documents() -> None:
    scene = (
        '<mujoco><asset><model name="a_" file="a_model.xml"/><model name="b_" file="b_model.xml"/></asset><worldbody>'
        '<frame><attach model="a_" prefix="a_"/></frame><frame><attach model="b_" prefix="b_"/></frame>'
        "</worldbody></mujoco>"
    )
    robot = b'<mujoco><worldbody><body name="hand"><geom size="0.1" glow="3"/></body></worldbody></mujoco>'
    files = {"a_model.xml": robot, "b_model.xml": robot, "notes.txt": b"\xff"}
    model, left_out = _mujoco.without_newer_attributes(scene, files, mujoco.MjModel.from_xml_string)
    assert left_out == ["geom.glow"]
    assert (model.body("a_hand").id, model.body("b_hand").id) == (1, 2)


SCHEMA = {
    line.partition(":")[0]: set(line.partition(":")[2].split())
    for line in (Path(__file__).parent / "data" / "mujoco-3.8-schema.txt").read_text("utf-8").splitlines()
}
"""The attributes of each element in MuJoCo 3.8, from its `mj_printSchema`."""

SERVOS = f"""
<mujoco model="servos">
  <default>
    <default class="fast"><position kp="2"/></default>
    <default class="slow"><velocity kv="3"/></default>
  </default>
  <worldbody><light pos="0 0 3"/><body><joint name="j"/><geom size="0.1"/></body></worldbody>
  <actuator>
    {"".join(f'<{kind} joint="j" lengthrange="0 1" {rest}/>' for kind, rest in SHORTCUTS.items())}
    <position joint="j" class="fast"/><velocity joint="j" class="slow"/>
    <general joint="j" gainprm="4" biastype="affine" biasprm="0 -4 -1"/>
  </actuator>
</mujoco>"""


def newer(documents: Mapping[str, str | bytes]) -> set[str]:
    """What MuJoCo 3.8 does not know of some documents."""
    elements = [element for text in documents.values() for element in ET.fromstring(text).iter()]
    unknown = {element.tag for element in elements} - SCHEMA.keys()
    return unknown | {
        f"{element.tag}.{name}" for element in elements for name in {*element.keys()} - SCHEMA.get(element.tag, set())
    }


def assert_same_actuators(model: mujoco.MjModel, original: mujoco.MjModel, copies: int = 1) -> None:
    for name in ("dyntype", "dynprm", "gaintype", "gainprm", "biastype", "biasprm"):
        ours, theirs = (getattr(one, f"actuator_{name}") for one in (model, original))
        np.testing.assert_allclose(ours, np.concatenate([theirs] * copies), err_msg=name)


@pytest.fixture
def servos(tmp_path: Path) -> Path:
    """A robot with all kinds of actuators that MuJoCo 3.8 has."""
    file = tmp_path / "servos.xml"
    file.write_text(SERVOS)
    return file


@pytest.mark.parametrize("dialect", ["alpha", "beta"])
def test_the_oldest_release_knows_all_that_a_server_writes(dialect: DialectName, servos: Path, tmp_path: Path) -> None:
    saved = tmp_path / "saved"
    with (
        SimulatedServer(servos, servos, play=True, dialect=dialect, saved_dir=saved) as server,
        URLabClient(address=server.address, step_port=server.step_port) as client,
    ):
        hello = client.call(Hello(include_assets=True))
    assert hello.mjcf_compiled is not None
    assert hello.vfs_assets is not None
    sent = {"scene": hello.mjcf_compiled, **hello.vfs_assets}
    stored = {str(file): file.read_bytes() for file in saved.rglob("*.xml")}
    assert stored
    assert newer(sent) | newer(stored) == set()
    model = mujoco.MjModel.from_xml_string(hello.mjcf_compiled, dict(hello.vfs_assets))
    assert_same_actuators(model, mujoco.MjModel.from_xml_path(str(servos)), copies=2)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_oldest_release_knows_all_that_is_sent(servos: Path, compiled: bool) -> None:
    spec = mujoco.MjSpec.from_file(str(servos))
    spec.compile()
    xml, files = _mujoco.flat_model(spec, compiled=compiled)
    assert newer({"document": xml}) == set()
    assert_same_actuators(mujoco.MjModel.from_xml_string(xml, files), mujoco.MjModel.from_xml_path(str(servos)))


@pytest.mark.mujoco("3.12")
def test_what_an_actuator_of_a_newer_release_is_told_stays(servos: Path) -> None:
    pid = '<pid joint="j" input="pos" kp="3"/><pid joint="j" input="pos vel" kp="3"/>'
    servos.write_text(SERVOS.replace("</actuator>", f"{pid}</actuator>"))
    original = mujoco.MjModel.from_xml_path(str(servos))
    flat = flatten(servos)
    model = mujoco.MjModel.from_xml_string(flat.xml.decode(), flat.files)
    np.testing.assert_array_equal(model.actuator_ctrlspec, original.actuator_ctrlspec)


NEWER = re.compile(
    r"\.(nactuator|actuator_(ctrl|out)(adr|num)|mj_resetCtrl|mju_threadpool|dedup_assets|savecompiled|encode\(str)\b"
    r"|from mujoco\.batch|model\.opt = "
)
"""What releases that are allowed do not have."""


def test_one_module_alone_uses_what_older_releases_lack() -> None:
    package = Path(_mujoco.__file__).parent
    found = [
        f"{path.relative_to(package)}:{number}: {line.strip()}"
        for path in package.rglob("*.py")
        if path.name != "_mujoco.py"
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if NEWER.search(line)
    ]
    assert found == []


@pytest.mark.mujoco("3.16")
@pytest.mark.parametrize("compiled", [False, True])
def test_parts_that_are_attached_bring_their_own_files(tmp_path: Path, compiled: bool) -> None:
    for folder, size in (("robot/meshes", 0.1), ("robot/hand/meshes", 0.9)):  # of one name, with different content
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "a&b.obj").write_text(OBJ.format(size))
        (tmp_path / folder / "side.png").write_bytes(PNG)
    sides = " ".join(f'file{side}="side.png"' for side in ("right", "left", "up", "down", "front", "back"))
    assets = (
        '<compiler meshdir="meshes" texturedir="meshes"/><asset><mesh name="m" file="a&amp;b.obj"/>'
        f'<texture name="c" type="cube" {sides}/>{{}}</asset>'
    )
    body = '<worldbody><body name="b"><geom type="mesh" mesh="m"/>{}</body></worldbody>'
    (tmp_path / "robot" / "hand" / "hand.xml").write_text(f"<mujoco>{assets.format('')}{body.format('')}</mujoco>")
    hand = '<model name="hand" file="hand/hand.xml"/>'
    attached = '<attach model="hand" body="b" prefix="hand_"/>'
    robot = tmp_path / "robot" / "robot.xml"
    robot.write_text(f"<mujoco>{assets.format(hand)}{body.format(attached)}</mujoco>")
    spec = mujoco.MjSpec.from_file(str(robot))
    original = spec.compile()

    xml, files = _mujoco.flat_model(spec, compiled=compiled)

    again = mujoco.MjModel.from_xml_string(xml, files)
    np.testing.assert_allclose(again.mesh_vert, original.mesh_vert, atol=1e-6)
    assert again.ntex == 2
    assert sorted(name.partition("-")[2] for name in files) == ["a_b.obj", "a_b_0.obj", "side.png", "side_0.png"]
