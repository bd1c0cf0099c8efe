"""The robot in Foxglove's 3-D panel: each geom that MuJoCo's viewers show, where it is, as large as it is."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from urlab_client.integrations._feed.geometry import scene_update, shapes_of
from urlab_client.integrations._feed.messages import SceneEntity, Time

SCENE = """
<mujoco>
  <asset>
    <material name="red" rgba="1 0 0 1"/>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1" inertia="shell"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="arm">
      <geom name="upper" type="capsule" fromto="0 0 0  0 0 2" size="0.25" material="red"/>
      <geom name="roll" type="cylinder" size="0.5 0.125" pos="1 2 3" euler="0 90 0" rgba="0 1 0 0.5"/>
      <geom name="egg" type="ellipsoid" size="0.1 0.2 0.3"/>
      <geom name="case" type="box" size="0.1 0.2 0.3"/>
      <geom name="wedge" type="mesh" mesh="wedge"/>
      <geom name="collides" type="box" size="9 9 9" group="3"/>
      <geom name="clear" type="box" size="9 9 9" rgba="1 1 1 0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def drawn() -> dict[str, SceneEntity]:
    model = mujoco.MjModel.from_xml_string(SCENE)
    update = scene_update(shapes_of(model, ["world", "arm"]), Time(1, 2))
    assert [deletion.type for deletion in update.deletions] == [1], "in place of all that was drawn before"
    return {entity.frame_id: entity for entity in update.entities}


def numbers(vector: object) -> list[float]:
    return [getattr(vector, axis) for axis in "xyz"]


def test_each_is_drawn_in_the_frame_of_its_body(drawn: dict[str, SceneEntity]) -> None:
    assert set(drawn) == {"world", "arm"}
    assert all(entity.frame_locked for entity in drawn.values())
    (floor,) = drawn["world"].cubes
    assert numbers(floor.size) == pytest.approx([40, 40, 0.002]), "MuJoCo's plane without a size has no end"


def test_a_capsule_is_a_cylinder_with_two_round_ends(drawn: dict[str, SceneEntity]) -> None:
    upper, roll = drawn["arm"].cylinders
    assert numbers(upper.size) == pytest.approx([0.5, 0.5, 2])
    assert numbers(upper.pose.position) == pytest.approx([0, 0, 1])
    assert (upper.color.r, upper.color.g, upper.color.a) == (1, 0, 1), "the material's colour"
    egg, *ends = sorted(drawn["arm"].spheres, key=lambda one: one.size.z != pytest.approx(0.6))
    assert numbers(egg.size) == pytest.approx([0.2, 0.4, 0.6])
    assert sorted(end.pose.position.z for end in ends) == pytest.approx([0, 2])
    assert all(numbers(end.size) == pytest.approx([0.5] * 3) for end in ends)
    assert numbers(roll.size) == pytest.approx([1, 1, 0.25])
    assert numbers(roll.pose.position) == pytest.approx([1, 2, 3])
    turn = roll.pose.orientation
    assert [turn.w, turn.x, turn.y, turn.z] == pytest.approx([np.sqrt(0.5), 0, np.sqrt(0.5), 0])
    assert (roll.color.g, roll.color.a) == (1, 0.5)


def test_what_collides_or_is_transparent_is_left_out(drawn: dict[str, SceneEntity]) -> None:
    (case,) = drawn["arm"].cubes
    assert numbers(case.size) == pytest.approx([0.2, 0.4, 0.6])


def test_a_mesh_has_its_triangles_where_mujoco_has_them(drawn: dict[str, SceneEntity]) -> None:
    (mesh,) = drawn["arm"].triangles
    assert len(mesh.points) == 4
    assert sorted(set(mesh.indices)) == [0, 1, 2, 3]
    rotation = np.zeros(9)
    turn = mesh.pose.orientation
    mujoco.mju_quat2Mat(rotation, np.array([turn.w, turn.x, turn.y, turn.z]))
    points = np.array([numbers(point) for point in mesh.points])
    placed = points @ rotation.reshape(3, 3).T + numbers(mesh.pose.position)
    wanted = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert all(np.abs(placed - corner).max(axis=1).min() < 1e-6 for corner in wanted)
