"""An agent moves a hand: where it arrives, what is refused, and how far it got."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from agents import desk

from urlab_client.server import SimulatedServer
from urlab_client.server.assets.bundled_robots import bundled_models

DOWN = [1.0, 0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A heavy free box that a hand cannot push, a wall, and an arm that sags under its own weight."""
    folder = tmp_path_factory.mktemp("models")
    texts = {
        "safe": "<body name='safe' pos='0 0 .3'><freejoint/><geom type='box' size='.1 .4 .3' mass='5000'/></body>",
        "wall": "<geom name='wall' type='box' size='.02 .5 .5' pos='0 0 .5'/>",
    }
    for name, text in texts.items():
        (folder / f"{name}.xml").write_text(f"<mujoco model='{name}'><worldbody>{text}</worldbody></mujoco>")
    return {**bundled_models(), **{name: folder / f"{name}.xml" for name in texts}}


SAGGING = """
<mujoco model="sagging"><compiler angle="degree" autolimits="true"/><worldbody><body name="base"><body name="upper">
  <joint name="lift" axis="0 1 0" range="-90 90" damping="20"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
  <body name="lower" pos=".3 0 0"><joint name="bend" axis="0 1 0" range="-120 120" damping="10"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/><site name="tip" pos=".3 0 0"/></body>
</body></body></worldbody><actuator>
  <position name="lift" joint="lift" kp="150" ctrlrange="-1.57 1.57"/>
  <position name="bend" joint="bend" kp="60" ctrlrange="-2.1 2.1"/></actuator></mujoco>
"""


@pytest.fixture(scope="module")
def server(models: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedServer]:
    roots = [models["wall"].parent, models["arm"].parent]
    with SimulatedServer("arm", play=True, model_roots=roots, saved_dir=tmp_path_factory.mktemp("saved")) as running:
        yield running


async def test_a_hand_arrives_with_its_orientation_and_gripper(server: SimulatedServer) -> None:
    async with desk(server) as one:
        await one.call("reset")
        start = await one.call("hand_pose", robot="arm")
        assert (start["hand"], start["gripper_limits"]) == ("grip", [0, 0.04])
        turned = [math.cos(0.4), 0, 0, math.sin(0.4)]
        moved = await one.call(
            "move_hand", robot="arm", position=[0.45, 0.15, 0.3], quaternion=turned, gripper=0.03, speed=0.5
        )
        pose = moved["pose"]
        assert math.dist(pose["position"], [0.45, 0.15, 0.3]) < 0.005
        assert abs(sum(a * b for a, b in zip(pose["quaternion"], turned, strict=True))) > math.cos(0.02)
        fingers = (await one.call("state", robot="arm"))["joints"]
        assert fingers["right_finger"] == pytest.approx(0.03, abs=0.003)
        # Without an orientation the hand keeps its own; without a position it stays.
        moved = await one.call("move_hand", robot="arm", position=[0.5, 0.0, 0.3])
        assert abs(sum(a * b for a, b in zip(moved["pose"]["quaternion"], turned, strict=True))) > math.cos(0.02)
        moved = await one.call("move_hand", robot="arm", quaternion=DOWN, gripper=0.04)  # as far as it opens
        assert math.dist(moved["pose"]["position"], [0.5, 0.0, 0.3]) < 0.005
        world = await one.call("look")
        assert world["hands"] == [moved["pose"]]
        assert (world["robots"][0]["name"], world["objects"]) == ("arm", [])


async def test_what_a_hand_cannot_do_is_refused_before_it_moves(server: SimulatedServer) -> None:
    async with desk(server) as one:
        await one.call("reset")
        for arguments, words in (
            ({"position": [1.6, 0, 0.3]}, ["out of reach", "the nearest that 'grip' gets to is (1.0"]),
            ({"position": [0.0, 0.0, 0.1]}, ["would run into arm/", "The way is free up to"]),
            ({"gripper": 1.0}, ["gripper takes 0 to 0.04"]),
            ({}, ["at least one of position"]),
            ({"position": [0.5, 0, 0.3], "hand": "gripp"}, ["'grip'"]),
            ({"position": [0.5, 0, 0.3], "speed": 0.005}, ["up to 10 s"]),
            ({"position": [0.5, 0, 0.3], "quaternion": [0, 0, 0, 0]}, ["four zeros"]),
        ):
            said = await one.refused("move_hand", robot="arm", **arguments)
            assert all(word in said for word in words), said
        poses = [{"position": [0.5, 0, 0.3]}, {"position": [0.5, 0, 3]}]
        assert "Pose 2 of 2: (0.500, 0.000, 3.000) m is out of reach" in await one.refused(
            "follow", robot="arm", poses=poses
        )
        state = await one.call("state", robot="arm")
        assert (state["step"], set(state["joints"].values())) == (0, {0.0})


async def test_a_wall_is_refused_and_what_cannot_be_pushed_is_told(
    server: SimulatedServer, models: dict[str, Path]
) -> None:
    async with desk(server, models=models) as one:
        wall = {"id": "barrier", "model": "wall", "position": [0.6, 0, 0]}
        await one.call("apply_scene", objects=[wall])
        said = await one.refused("move_hand", robot="arm", position=[0.7, 0, 0.464])
        assert re.search(r"(barrier would run into arm/|arm/\w+ would run into barrier)", said), said
        await one.call("reset")
        ground, safe = ({"id": n, "model": m, "position": p} for n, m, p in (
            ("ground", "floor", [0, 0, 0]), ("heavy", "safe", [0.62, 0, 0]),
        ))  # fmt: skip
        await one.call("apply_scene", objects=[ground, safe], remove=["barrier"])
        said = await one.refused("move_hand", robot="arm", position=[0.6, 0, 0.464])
        assert "obstructed on its way to pose 1 of 1" in said
        assert "touches heavy" in said
        assert "m and" in said
        await one.call("apply_scene", objects=[], remove=["heavy", "ground"])


async def test_a_pose_with_a_word_that_is_none_of_its_fields_is_refused(server: SimulatedServer) -> None:
    async with desk(server) as one:
        before = await one.call("hand_pose", robot="arm")
        said = await one.refused("follow", robot="arm", poses=[{"positon": [0.45, 0.15, 0.3], "gripper": 0.02}])
        assert "unknown field `positon`" in said
        assert (await one.call("hand_pose", robot="arm"))["position"] == before["position"]


@pytest.mark.parametrize("mode", ["direct", "live"])
async def test_a_weak_arm_is_corrected_until_its_hand_is_there(tmp_path: Path, mode: str) -> None:
    file = tmp_path / "sagging.xml"
    file.write_text(SAGGING)
    with SimulatedServer(str(file), play=True, unpaused=True) as server:
        async with desk(server, step_mode=mode) as one:
            target = [0.45, 0.0, 0.1]
            if mode == "live":
                await one.call("play", action="resume")
            moved = await one.call("move_hand", robot="sagging", position=target)
            assert math.dist(moved["pose"]["position"], target) < 0.01
            assert (moved["pose"]["hand"], moved["pose"]["gripper"]) == ("tip", None)
            assert "no gripper" in await one.refused("move_hand", robot="sagging", gripper=0.1)


MOTOR = """
<mujoco model="motor"><worldbody><body name="wheel"><joint name="axle"/><geom size=".1"/></body></worldbody>
<actuator><motor name="drive" joint="axle"/></actuator></mujoco>
"""
FORK = """
<mujoco model="fork"><worldbody><body name="stem"><joint name="axle" axis="0 0 1"/><geom size=".1"/>
<site name="left" pos=".2 .1 0"/><site name="right" pos=".2 -.1 0"/></body></worldbody>
<actuator><position name="axle" joint="axle" kp="20" kv="2"/></actuator></mujoco>
"""


async def test_a_robot_without_a_hand_says_so_and_one_of_several_is_named(tmp_path: Path) -> None:
    files = [tmp_path / "motor.xml", tmp_path / "fork.xml"]
    for file, text in zip(files, (MOTOR, FORK), strict=True):
        file.write_text(text)
    with SimulatedServer(*map(str, files), play=True) as server:
        async with desk(server) as one:
            assert "no joint with a position servo" in await one.refused("hand_pose", robot="motor")
            assert [hand["hand"] for hand in (await one.call("look"))["hands"]] == ["left", "right"]
            assert "several hands: pass `hand`, one of left, right" in await one.refused("hand_pose", robot="fork")
            right, stem = [
                (await one.call("hand_pose", robot="fork", hand=name))["position"] for name in ("right", "stem")
            ]
            assert [a - b for a, b in zip(right, stem, strict=True)] == pytest.approx([0.2, -0.1, 0])
