from __future__ import annotations

import errno
import json
import os
import shutil
import sys
import threading
from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from wire import files_of_at_most
from worlds import BALL_BODY, BOT, GYMNASIUM, Workspace, mjcf, write_obj, write_stl

from urlab_client._platform.files import replaced, write_whole
from urlab_client.server.assets import content, importer
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.assets.bundled_robots import bundled_models
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.assets.importer import mujoco_messages
from urlab_client.server.editor.levels import level_package
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.temporary_folder import TemporaryFolder

BALL = mjcf(BALL_BODY, model="ball")


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path)


def arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Everything numeric in a model, but where its strings and files are."""
    names = [name for name in dir(model) if not name.startswith(("_", "name_")) and "pathadr" not in name]
    values = {name: getattr(model, name) for name in names if name not in ("names_map", "paths")}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def compiled(blueprint: Blueprint) -> mujoco.MjModel:
    return blueprint.spec.copy().compile()


# Importing


def test_an_import_is_named_after_the_file(workspace: Workspace) -> None:
    path = str(workspace.write("robot.xml", BOT))

    first, imported_first = workspace.content.import_xml(path)
    again, imported_again = workspace.content.import_xml(path)
    forced, imported_forced = workspace.content.import_xml(path, force_reimport=True)

    assert (imported_first, imported_again, imported_forced) == (True, False, True)
    assert first.class_path == again.class_path == forced.class_path == "/Game/MuJoCoImports/robot.robot_C"
    assert first.package_path == "/Game/MuJoCoImports/robot"
    assert first.model_name == "bot"
    assert (first.joints, first.actuators) == (("root", "j"), ("m",))
    assert (first.sensors, first.cameras) == (("s",), ("cam",))


ODD_NAMES = {"my-robot v1.2": "my_robot_v1_2", "a+b": "a_b"}
if sys.getfilesystemencoding() != "ascii":
    ODD_NAMES["ünïcode"] = "ünïcode"


@pytest.mark.parametrize(("file", "stem"), ODD_NAMES.items())
def test_odd_characters_of_a_file_name_become_underscores(workspace: Workspace, file: str, stem: str) -> None:
    blueprint, _ = workspace.content.import_xml(str(workspace.write(f"{file}.xml", BALL)))

    assert blueprint.short_name == stem
    assert compiled(blueprint).nbody == 2


def test_mujocos_default_name_is_no_model_name(workspace: Workspace) -> None:
    blueprint, _ = workspace.content.import_xml(str(workspace.write("nameless.xml", mjcf(BALL_BODY))))

    assert blueprint.model_name == ""


def test_a_relative_path_is_looked_up_in_the_model_roots(tmp_path: Path) -> None:
    roots = [tmp_path / "one", tmp_path / "two"]
    for root in roots:
        (root / "sub").mkdir(parents=True)
    (roots[1] / "sub" / "ball.xml").write_text(BALL)
    content = ContentRoot(tmp_path / "saved", model_roots=roots)

    blueprint, _ = content.import_xml("sub/ball.xml")

    assert blueprint.source == str(roots[1] / "sub" / "ball.xml")


def test_bundled_models_need_no_root(tmp_path: Path) -> None:
    content = ContentRoot(tmp_path)

    by_name, _ = content.import_xml("ball")
    by_path, imported_now = content.import_xml(str(bundled_models()["ball"]))

    assert by_name.source == "bundled:ball"
    assert by_path is by_name
    assert not imported_now


def test_a_bundled_name_is_no_file(workspace: Workspace) -> None:
    workspace.write("ball", BOT)
    workspace.write("ball.xml", BOT)

    assert workspace.content.import_xml("ball")[0].model_name == "ball"


@pytest.mark.parametrize("way", ["absolute", "dots", "link"])
def test_files_outside_the_model_roots_are_refused(tmp_path: Path, workspace: Workspace, way: str) -> None:
    secret = tmp_path / "secret.xml"
    secret.write_text(BALL)
    (workspace.models / "link.xml").symlink_to(secret)
    path = {"absolute": str(secret), "dots": "../secret.xml", "link": "link.xml"}[way]

    with pytest.raises(Refusal) as refused:
        workspace.content.import_xml(path)

    assert refused.value.code == "import_failed"
    assert str(workspace.models) in refused.value.message
    assert "--model-root" in refused.value.message
    assert workspace.content.import_xml(str(secret), trusted=True)[1]


def test_a_link_within_the_model_roots_may_be_followed(workspace: Workspace) -> None:
    workspace.write("versions/ball-2.xml", BALL)
    (workspace.models / "ball.xml").symlink_to(workspace.models / "versions" / "ball-2.xml")

    assert workspace.content.import_xml("ball.xml")[0].short_name == "ball_2"


@pytest.mark.parametrize(
    ("path", "code", "text"),
    [
        ("", "missing_field", "path"),
        ("nowhere.xml", "import_failed", "nowhere.xml does not exist"),
        (".", "import_failed", "is a folder"),
        ("a\0b.xml", "import_failed", "usable path"),
        pytest.param(
            "x" * 5000, "import_failed", "does not exist" if sys.platform == "win32" else "usable path", id="too long"
        ),
        ("bundled:rocket", "import_failed", "quadruped"),
    ],
)
def test_unusable_paths_are_refused(workspace: Workspace, path: str, code: str, text: str) -> None:
    with pytest.raises(Refusal) as refused:
        workspace.content.import_xml(path)

    assert refused.value.code == code
    assert text in refused.value.message


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (mjcf('<body name="b">\n<geom size="0.1" colour="red"/></body>'), "unrecognized attribute: 'colour'"),
        (mjcf('<body name="b"><joint/></body>'), "mass and inertia of moving bodies must be larger than mjMINVAL"),
        ("not XML", "XML"),
        (mjcf("", head='<asset><mesh file="none.obj"/></asset>'), "none.obj"),
        (mjcf("", head='<include file="none.xml"/>'), "none.xml"),
        ("", "empty"),
        (mjcf("", tail='<keyframe><key mpos="1 2 3"/></keyframe>'), "invalid mpos size"),
        (mjcf('\n<body name="b">\n<geom name="g" size="-1"/></body>'), "Element name 'g', id 0, line 3"),
    ],
)
@pytest.mark.parametrize("trusted", [False, True])
def test_mujocos_reason_for_rejecting_a_file_is_passed_on(
    workspace: Workspace, text: str, cause: str, *, trusted: bool
) -> None:
    path = workspace.write("broken.xml", text)

    with pytest.raises(Refusal) as refused:
        workspace.content.import_xml(str(path), trusted=trusted)

    assert refused.value.code == "import_failed"
    assert cause in refused.value.message
    assert str(path) in refused.value.message
    assert "\n" not in refused.value.message
    assert not workspace.content.blueprints
    assert not list(workspace.saved.glob("MuJoCoImports/*"))


def test_a_failed_reimport_leaves_the_blueprint_as_it_was(workspace: Workspace) -> None:
    path = workspace.write("ball.xml", BALL)
    before, _ = workspace.content.import_xml(str(path))
    path.write_text("broken")

    with pytest.raises(Refusal):
        workspace.content.import_xml(str(path), force_reimport=True)

    assert workspace.content.blueprints["ball"] is before
    assert compiled(before).nbody == 2


# Snapshots


@pytest.fixture
def workshop(workspace: Workspace) -> Path:
    """A model with an include, an attached part, and meshes of one name in two folders."""
    write_obj(workspace.models / "robot" / "meshes" / "part.obj", 0.1)
    write_stl(workspace.models / "robot" / "meshes" / "shell.stl", 0.2)
    write_obj(workspace.models / "gripper" / "meshes" / "part.obj", 0.3)
    workspace.write("robot/limits.xml", '<mujocoinclude><default><joint range="-90 90"/></default></mujocoinclude>')
    workspace.write(
        "gripper/gripper.xml",
        mjcf(
            '<body name="hand"><joint name="grip"/><geom type="mesh" mesh="part"/></body>',
            model="gripper",
            head='<compiler meshdir="meshes"/><asset><mesh file="part.obj"/></asset>',
            tail='<actuator><position name="grip" joint="grip" kp="3"/></actuator>',
        ),
    )
    return workspace.write(
        "robot/robot.xml",
        mjcf(
            '<body name="base" euler="10 20 30"><joint name="turn"/><geom type="mesh" mesh="part"/>'
            '<geom type="mesh" mesh="shell"/><attach model="gripper" body="hand" prefix="tool_"/></body>',
            model="robot",
            head='<compiler meshdir="meshes"/><include file="limits.xml"/><asset><mesh file="part.obj"/>'
            '<mesh file="shell.stl"/><model name="gripper" file="../gripper/gripper.xml"/></asset>',
            tail='<actuator><velocity name="turn" joint="turn" kv="2"/></actuator>'
            '<keyframe><key name="half" qpos="0.123456789012345678 0.5"/></keyframe>',
        ),
    )


@pytest.mark.mujoco("3.16")
def test_a_snapshot_needs_nothing_of_its_source(workspace: Workspace, workshop: Path) -> None:
    original = mujoco.MjModel.from_xml_path(str(workshop))
    blueprint, _ = workspace.content.import_xml(str(workshop))
    workspace.models.rename(workspace.models.with_name("gone"))

    found = ContentRoot(workspace.saved).find_blueprint(blueprint.class_path)

    assert found is not None
    copies = arrays(compiled(found))
    for name, value in arrays(original).items():
        if name != "actuator_ctrlspec":  # what a servo's control means; older releases refuse the attribute
            np.testing.assert_array_equal(copies[name], value, err_msg=name)
    assert dict(found.actuator_types) == {"turn": "velocity", "tool_grip": "position"}
    assert found.model_name == "robot"


@pytest.mark.mujoco("3.16")
def test_what_the_server_is_started_with_has_its_meshes_compiled_once(workspace: Workspace, workshop: Path) -> None:
    cache = mujoco.mj_getCache()
    before = mujoco.mj_getCacheSize(cache)

    blueprint, _ = workspace.content.import_xml(str(workshop), trusted=True)

    once = mujoco.mj_getCacheSize(cache) - before
    scene = mujoco.MjSpec()
    scene.attach(blueprint.spec.copy(), frame=scene.worldbody.add_frame(), prefix="workshop_")
    assert scene.compile().nmesh == 3
    assert mujoco.mj_getCacheSize(cache) - before == once > 0


@pytest.mark.mujoco("3.16")
def test_later_edits_of_the_source_change_nothing_until_forced(
    workspace: Workspace, workshop: Path, caplog: pytest.LogCaptureFixture
) -> None:
    blueprint, _ = workspace.content.import_xml(str(workshop))
    before = compiled(blueprint).mesh_vert.copy()
    write_obj(workspace.models / "robot" / "meshes" / "part.obj", 0.7)
    workshop.write_text(workshop.read_text().replace('name="turn"/>', 'name="turn"/><site name="new"/>'))

    kept, _ = workspace.content.import_xml(str(workshop))
    assert "has changed since it was imported" in caplog.text
    np.testing.assert_array_equal(compiled(kept).mesh_vert, before)

    renewed, _ = workspace.content.import_xml(str(workshop), force_reimport=True)
    assert compiled(renewed).nsite == 1
    assert compiled(renewed).mesh_vert.max() > 2 * before.max()
    np.testing.assert_array_equal(compiled(blueprint).mesh_vert, before)  # a play session may still run on it


def test_two_files_of_one_stem_are_one_blueprint(workspace: Workspace, caplog: pytest.LogCaptureFixture) -> None:
    first, _ = workspace.content.import_xml(str(workspace.write("a/robot.xml", BOT)))

    second, imported_now = workspace.content.import_xml(str(workspace.write("b/robot.xml", BALL)))

    assert second is first
    assert not imported_now
    assert "blueprint 'robot'" in caplog.text


def test_only_the_last_two_snapshots_are_kept(workspace: Workspace) -> None:
    path = workspace.write("ball.xml", BALL)
    for size in (0.1, 0.2, 0.3, 0.4):
        path.write_text(BALL.replace('size="0.1"', f'size="{size}"'))
        blueprint, _ = workspace.content.import_xml(str(path), force_reimport=True)

    folders = [entry for entry in blueprint.folder.parent.iterdir() if entry.is_dir()]

    assert len(folders) == 2
    assert blueprint.folder in folders


@pytest.mark.mujoco("3.16")
def test_importing_again_mends_a_damaged_snapshot(workspace: Workspace, workshop: Path) -> None:
    blueprint, _ = workspace.content.import_xml(str(workshop))
    before = tree(blueprint.folder)
    part = next(blueprint.folder.rglob("*.obj"))
    part.write_bytes(part.read_bytes().replace(b"v", b"#"))
    again, _ = workspace.content.import_xml(str(workshop), force_reimport=True)
    assert tree(again.folder) == before


@pytest.mark.mujoco("3.16")
def test_importing_the_same_content_makes_the_same_snapshot(workspace: Workspace, workshop: Path) -> None:
    first, _ = workspace.content.import_xml(str(workshop))
    second, _ = workspace.content.import_xml(str(workshop), force_reimport=True)

    assert tree(second.folder) == tree(first.folder)
    assert second.folder == first.folder


@pytest.mark.parametrize("damage", ["{", '{"x": ' + "[" * 100_000, ""], ids=["record", "depth", "snapshot"])
def test_a_damaged_blueprint_is_left_out(workspace: Workspace, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    good, _ = workspace.content.import_xml(str(workspace.write("good.xml", BALL)))
    bad, _ = workspace.content.import_xml(str(workspace.write("bad.xml", BALL)))
    record = workspace.content.snapshot_record(bad)
    if damage:
        record.write_text(damage)
    else:
        (bad.folder / "model.xml").unlink()

    assert list(ContentRoot(workspace.saved).blueprints) == [good.stem]
    assert str(record) in caplog.text


def test_a_removed_blueprint_stays_away(workspace: Workspace) -> None:
    workspace.content.import_xml(str(workspace.write("ball.xml", BALL)))

    workspace.content.remove_blueprint("ball")

    assert not workspace.content.blueprints
    assert not ContentRoot(workspace.saved).blueprints


def test_a_content_root_that_cannot_be_written_refuses_imports(tmp_path: Path) -> None:
    (tmp_path / "saved").write_text("a file where the folder should be")
    blocked = ContentRoot(tmp_path / "saved")

    with pytest.raises(Refusal, match="import_failed: cannot store"):
        blocked.import_xml("ball")


def tree(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("size", [0, 100, 1000])  # the archive, the model in it, or the record does not fit
def test_an_import_onto_a_full_disk_is_refused_and_leaves_nothing(workspace: Workspace, size: int) -> None:
    workspace.content.import_xml(str(workspace.write("bot.xml", BOT)))
    before = tree(workspace.saved)
    text = "".join(f'<geom name="more{n}" pos="{n} 0 0" size="0.1"/>' for n in range(200))
    workspace.write("bot.xml", BOT.replace("</worldbody>", f"{text}</worldbody>"))
    other = workspace.write("other.xml", mjcf(f'<body name="b"><joint/>{text}</body>'))

    with files_of_at_most(size):
        for path in (str(other), "arm", str(workspace.models / "bot.xml")):
            with pytest.raises(Refusal, match="import_failed: cannot store the snapshot"):
                workspace.content.import_xml(path, force_reimport=True, trusted=True)
        (workspace.saved / "snapshot").mkdir()
        order = importer._Order(str(other), str(workspace.saved / "snapshot" / "s"), [str(workspace.models)], Limits())
        with pytest.raises(ValueError, match=r"^cannot store the snapshot"):
            importer.build_order(msgspec.msgpack.encode(order))  # in a process whose files have a limit of their own
        shutil.rmtree(workspace.saved / "snapshot")

    assert tree(workspace.saved) == before
    assert list(workspace.content.blueprints) == list(ContentRoot(workspace.saved).blueprints) == ["bot"]
    assert workspace.content.import_xml("arm")[1]


def test_a_snapshot_whose_record_cannot_be_written_does_not_stay(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(content, "write_whole", full)
    with pytest.raises(Refusal, match=r"import_failed: cannot store .* No space left"):
        workspace.content.import_xml("arm")
    assert tree(workspace.saved) == {}
    assert not workspace.content.blueprints


def test_what_a_killed_server_left_is_swept_at_the_start(workspace: Workspace) -> None:
    workspace.content.import_xml("ball")
    before = tree(workspace.saved)
    imports = workspace.saved / "MuJoCoImports"
    left = imports / ".import-gone"
    (left / "snapshot").mkdir(parents=True)
    (left / "snapshot" / "model.xml").write_text("<mujoco/>")
    (left / ".alive").touch()

    with TemporaryFolder(imports, ".import-") as busy:  # another server imports
        assert list(ContentRoot(workspace.saved).blueprints) == ["ball"]
        assert busy.path.exists()
        assert not left.exists()

    assert tree(workspace.saved) == before
    assert [folder.name for folder in imports.iterdir()] == ["ball"]


@pytest.mark.parametrize("field", ["digest", "stem"])
@pytest.mark.parametrize("name", ["../../elsewhere", "..", "/elsewhere", ""])
def test_records_name_no_folders_elsewhere(
    workspace: Workspace, field: str, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    blueprint, _ = workspace.content.import_xml("ball")
    (workspace.saved / "elsewhere").mkdir()
    shutil.copy(blueprint.folder / "model.xml", workspace.saved / "elsewhere")
    record = workspace.content.snapshot_record(blueprint)
    record.write_text(json.dumps(json.loads(record.read_text()) | {field: name}))

    assert not ContentRoot(workspace.saved).blueprints
    assert "cannot be the names of folders" in caplog.text


# Names and keyframes


def test_every_element_gets_a_name(workspace: Workspace) -> None:
    body = (
        "<body><joint/><joint axis='0 1 0'/><geom size='0.1'/><geom type='box' size='0.1 0.1 0.1'/><site/><camera/>"
        "<body><joint type='slide'/><geom size='0.1'/></body></body>"
        "<body name='named'><freejoint/><geom name='Geom_Sphere' size='0.1'/></body><light/>"
    )
    tail = (
        "<actuator><motor joint='HingeJoint'/></actuator>"
        "<sensor><gyro site='tip'/><jointactuatorfrc joint='j'/></sensor><keyframe><key/><key/></keyframe>"
    )
    body = body.replace("<joint/>", "<joint name='j'/>").replace("<site/>", "<site name='tip'/><site/>")
    tail = tail.replace("HingeJoint", "j")
    blueprint, _ = workspace.content.import_xml(str(workspace.write("plain.xml", mjcf(body, tail=tail))))
    spec = blueprint.spec

    assert [item.name for item in spec.bodies[1:]] == ["worldbody_Body", "worldbody_Body_Body", "named"]
    assert [item.name for item in spec.joints] == ["j", "HingeJoint", "SlideJoint", "FreeJoint"]
    assert sorted(item.name for item in spec.geoms) == ["Geom_Box", "Geom_Sphere", "Geom_Sphere1", "Geom_Sphere2"]
    assert [item.name for item in spec.sites] == ["tip", "Site"]
    assert [item.name for item in spec.cameras] == ["Camera"]
    assert [item.name for item in spec.lights] == ["Light"]
    assert [item.name for item in spec.actuators] == ["MotorActuator"]
    assert [item.name for item in spec.sensors] == ["GyroSensor", "JointactuatorfrcSensor"]
    assert [item.name for item in spec.keys] == ["Keyframe", "Keyframe1"]
    assert blueprint.actuators == ("MotorActuator",)


def test_actuators_are_reported_as_the_element_that_authored_them(workspace: Workspace) -> None:
    elements = {
        "motor": "",
        "general": "",
        "position": 'kp="3"',
        "velocity": 'kv="3"',
        "intvelocity": 'kp="3" actrange="-1 1"',
        "damper": 'ctrlrange="0 1"',
        "cylinder": "",
        "muscle": 'lengthrange="0 1"',
        "dcmotor": 'motorconst="1" resistance="1"',
    }
    actuators = "".join(f'<{kind} name="{kind}" joint="j" {more}/>' for kind, more in elements.items())
    actuators += '<adhesion name="adhesion" body="b" ctrlrange="0 1"/><position class="servo" name="classy" joint="j"/>'
    text = mjcf(
        '<body name="b"><joint name="j"/><geom size="0.1"/></body>',
        head='<default><default class="servo"><position kp="7"/></default></default>',
        tail=f"<actuator>{actuators}</actuator>",
    )
    workspace.content.import_xml(str(workspace.write("kinds.xml", text)))

    types = ContentRoot(workspace.saved).blueprints["kinds"].actuator_types

    assert dict(types) == {kind: kind for kind in elements} | {
        "general": "motor",
        "adhesion": "adhesion",
        "classy": "position",
    }


# Quiet


CONFLICT = mjcf(
    '<body name="b"><joint name="j"/><geom size="0.1"/><attach model="child" body="c" prefix="c_"/></body>',
    model="parent",
    head='<option timestep="0.001"/><asset><model name="child" file="child.xml"/></asset>',
    tail='<keyframe><key name="k" qpos="1 2"/></keyframe>',
)
CHILD = mjcf(
    '<body name="c"><joint name="j"/><geom size="0.1"/></body>', model="child", head='<option timestep="0.01"/>'
)


@pytest.mark.mujoco("3.10")
def test_importing_prints_nothing_and_logs_once(
    workspace: Workspace,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    workspace.write("child.xml", CHILD)

    workspace.content.import_xml(str(workspace.write("parent.xml", CONFLICT)))

    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
    assert len(caplog.records) == 1
    assert "Attach conflict" in caplog.text


@pytest.mark.mujoco("3.16")
def test_a_deprecated_attribute_is_logged_and_not_raised(
    workspace: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    content = ContentRoot(workspace.saved, model_roots=[GYMNASIUM])

    blueprint, _ = content.import_xml("half_cheetah.xml")

    assert "settotalmass" in caplog.text
    assert compiled(blueprint).nu == 6


@pytest.mark.mujoco("3.10")
def test_warnings_that_other_threads_cause_reach_the_handler_that_was_there() -> None:
    theirs: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(theirs.append)
    root = mujoco.MjSpec()
    child = mujoco.MjSpec.from_string(CHILD)
    try:
        with mujoco_messages() as ours:
            other = threading.Thread(
                target=lambda: root.attach(child, frame=root.worldbody.add_frame(), prefix="other_")
            )
            other.start()
            other.join()
        assert mujoco.get_mju_user_warning() is not None
    finally:
        mujoco.set_mju_user_warning(before)

    assert ours == []
    assert len(theirs) == 1


# Level names


@pytest.mark.parametrize(
    ("name", "package"),
    [
        ("lab", "/Game/Levels/lab"),
        ("/Game/Levels/lab", "/Game/Levels/lab"),
        ("/game/Tests/My Level-2", "/Game/Tests/My Level-2"),
        ("sub/lab", "/Game/Levels/sub/lab"),
        ("/Game/Levels/lab.lab", "/Game/Levels/lab"),
        ("/Game/Tests/Lab.lab", "/Game/Tests/Lab"),
        ("sub/lab.lab", "/Game/Levels/sub/lab"),
    ],
)
def test_level_names_expand_to_package_paths(name: str, package: str) -> None:
    assert level_package(name) == package


@pytest.mark.parametrize(
    "name",
    [
        "",
        "..",
        "../lab",
        "/Engine/lab",
        "/Game/",
        "/Game/../lab",
        "a/../b",
        "lab.json",
        "a\\b",
        "C:lab",
        "lab\0",
        "lab ",
        ".lab",
        "x" * 300,
        "/Game/MuJoCoImports/robot/blueprint",
        "/Game/urlab/Replays/recording",
        "/Game/Levels/lab.other",
        "/Game/Levels/lab.lab.lab",
        "/Game/lab.lab/lab",
        "lab.",
    ],
)
def test_names_that_could_leave_the_content_root_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="not a level's name"):
        level_package(name)


@given(st.text(max_size=30) | st.text("/.\\~ab_- \0:", max_size=12).map(lambda text: f"/Game/{text}"))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_no_level_file_lies_outside_the_content_root(tmp_path: Path, name: str) -> None:
    content = ContentRoot(tmp_path)
    try:
        file = content.level_file(level_package(name))
    except ValueError:
        return
    resolved = Path(os.path.normpath(file))
    assert resolved == file
    assert file.is_relative_to(content.root)
    assert file.suffix == ".json"


# Files


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "level.json"
    write_whole(path, b"old")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, b"new")

    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["level.json"]


def test_files_get_the_mode_that_every_program_gives_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without asking for the umask, which sets it, for a moment, for the files that other threads create."""
    before = os.umask(0o027)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "umask", None)
            write_whole(tmp_path / "whole", b"")
            with replaced(tmp_path / "replaced"):
                pass
    finally:
        os.umask(before)
    assert {file.name: oct(file.stat().st_mode & 0o777) for file in tmp_path.iterdir()} == {
        "whole": "0o640",
        "replaced": "0o640",
    }


def test_the_record_is_readable_json(workspace: Workspace) -> None:
    blueprint, _ = workspace.content.import_xml(str(workspace.write("bot.xml", BOT)))

    record = json.loads(workspace.content.snapshot_record(blueprint).read_text())

    assert record["format"] == "urlab-blueprint"
    assert record["source"] == str(workspace.models / "bot.xml")
    assert record["actuator_types"] == {"m": "motor"}
