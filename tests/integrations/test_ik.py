"""Inverse kinematics: poses of frames in the world to joints within their limits."""

from __future__ import annotations

import math
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.integrations.ik import InverseKinematics, UnreachableTarget
from urlab_client.server import ControllerConfig, SimulatedServer

RIGHT_ANGLE = (math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4))


@pytest.fixture(scope="module")
def client() -> Iterator[URLabClient]:
    """A client of an arm beside a quadruped with a PD controller, both away from the world's origin."""
    pd = {"quadruped": ControllerConfig(kp=60.0, kv=2.0)}
    with SimulatedServer("arm", "quadruped", play=True, controllers=pd) as server:
        address = f"{server.address}:{server.step_port}"
        with URLabClient(address, step_mode="direct") as client:
            client.discover()
            yield client


@pytest.fixture
def ik(client: URLabClient) -> InverseKinematics:
    client.reset()
    return InverseKinematics(client, "arm", site="grip")


def test_the_hand_arrives_where_it_was_asked_to_be(client: URLabClient, ik: InverseKinematics) -> None:
    before, _ = ik.pose()
    aim = before + np.array([-0.1, 0.15, -0.05])
    solution = ik.solve(aim, RIGHT_ANGLE)
    assert solution.reached
    arm = client.articulations["arm"]
    arm.set_ctrl(solution.set_points, out_of_range="error")
    client.run_for(2.0)
    position = arm.get_sensors()["grip_position"]  # the server's own figures
    quaternion = arm.get_sensors()["grip_orientation"]
    assert np.linalg.norm(position - aim) < 0.002
    assert abs(quaternion @ RIGHT_ANGLE) > math.cos(0.01)
    assert np.allclose(ik.pose()[0], position, atol=1e-3)


def test_what_stands_still_is_outside_of_the_problem(client: URLabClient, ik: InverseKinematics) -> None:
    assert "left_finger" not in ik.joints
    assert set(InverseKinematics(client, "arm", body="hand").joints) == set(ik.joints)
    some = InverseKinematics(client, "arm", site="grip", joints=["shoulder_lift", "elbow"])
    solution = some.solve(some.pose({"elbow": 0.3, "shoulder_lift": -0.1})[0])
    assert list(solution.joints) == ["shoulder_lift", "elbow"]
    assert solution.joints["elbow"] == pytest.approx(0.3, abs=0.02)


def test_joints_are_found_by_every_name_that_means_them(client: URLabClient, ik: InverseKinematics) -> None:
    for elbow in ("arm/elbow", "arm_elbow"):
        assert InverseKinematics(client, "arm", site="grip", joints=[elbow]).joints == ("elbow",)
        assert np.array_equal(ik.pose({elbow: 0.3})[0], ik.pose({"elbow": 0.3})[0])
        aim = ik.pose({"elbow": 0.3})[0]
        assert ik.solve(aim, start={elbow: 0.3}, starts=1) == ik.solve(aim, start={"elbow": 0.3}, starts=1)
        joints = ik.solve(aim).joints
        spelled = {elbow if name == "elbow" else name: position for name, position in joints.items()}
        assert ik.set_points(spelled) == ik.set_points(joints)
        assert ik.collisions([spelled]) == ik.collisions([joints])
    with pytest.raises(KeyError, match="the chain to 'grip' has no joint 'arm/left_finger'"):
        ik.pose({"arm/left_finger": 0.0})


def test_a_foot_below_a_free_base_moves_by_its_own_leg(client: URLabClient) -> None:
    client.reset()
    quadruped = client.articulations["quadruped"]
    foot = next(name for name in quadruped.bodies if name.endswith("shin") or "calf" in name or "foot" in name)
    leg = InverseKinematics(client, "quadruped", body=foot)
    assert len(leg.joints) == 3
    angles = {name: float(quadruped.joints[name].position) + 0.1 for name in leg.joints}
    solution = leg.solve(leg.pose(angles)[0], tolerance=1e-4)
    assert leg.pose(solution.joints)[0] == pytest.approx(leg.pose(angles)[0], abs=1e-4)


def test_solutions_keep_within_limits(ik: InverseKinematics, client: URLabClient) -> None:
    joints = client.articulations["arm"].joints
    rng = np.random.default_rng(3)
    for _ in range(8):
        solution = ik.solve(ik.pose()[0] + rng.uniform(-0.8, 0.8, 3), nearest=True, starts=2)
        for name, position in solution.joints.items():
            low, high = joints[name].limits or (-math.inf, math.inf)
            assert low <= position <= high


def test_a_target_out_of_reach_is_reported_with_the_nearest(ik: InverseKinematics) -> None:
    aim = ik.pose()[0] + [3.0, 0.0, 0.0]
    with pytest.raises(
        UnreachableTarget, match=r"'grip' of 'arm' does not reach .* nearest found is 2\.\d+ m"
    ) as caught:
        ik.solve(aim)
    nearest = ik.solve(aim, nearest=True)
    assert not nearest.reached
    assert nearest == caught.value.nearest
    assert pickle.loads(pickle.dumps(caught.value)).nearest == nearest
    with pytest.raises(UnreachableTarget, match="rad from the orientation"):
        ik.solve(aim, RIGHT_ANGLE, starts=1)


@pytest.mark.parametrize(
    ("arguments", "options", "said"),
    [
        (([0.4, math.nan, 0.4],), {}, "position takes finite numbers, got nan at index 1"),
        (([0.4, 0.4],), {}, r"position takes 3 numbers, got an array of shape \(2,\)"),
        (([0.4, 0.0, 0.4], [0, 0, 0, 0]), {}, "quaternion is all zeros"),
        (([0.4, 0.0, 0.4], [math.inf, 0, 0, 0]), {}, "quaternion takes finite numbers"),
        (([0.4, 0.0, 0.4],), {"starts": 0}, "starts must be at least 1"),
        (([0.4, 0.0, 0.4],), {"tolerance": 0.0}, "tolerance must be above 0"),
        (([0.4, 0.0, 0.4],), {"start": {"elbow": math.nan}}, "start: joint 'elbow' takes a finite number"),
    ],
)
def test_bad_targets_are_refused(ik: InverseKinematics, arguments: tuple, options: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ik.solve(*arguments, **options)


def test_bad_frames_are_refused(client: URLabClient, ik: InverseKinematics) -> None:
    with pytest.raises(KeyError, match=r"has no site 'gripp'.*grip"):
        InverseKinematics(client, "arm", site="gripp")
    with pytest.raises(ValueError, match="either site=NAME or body=NAME"):
        InverseKinematics(client, "arm")
    with pytest.raises(ValueError, match="joint 'right_finger' has no position servo that moves site 'grip'"):
        InverseKinematics(client, "arm", site="grip", joints=["right_finger"])
    with pytest.raises(ValueError, match="no position-controlled joint moves body 'base'"):
        InverseKinematics(client, "arm", body="base")
    with pytest.raises(Exception, match="Name the articulation: the scene has arm, quadruped"):
        InverseKinematics(client, site="grip")
    with pytest.raises(KeyError, match=r"^the chain to 'grip' has no joint 'left_finger'"):
        ik.solve([0.4, 0.0, 0.4], start={"left_finger": 0.0})


def test_a_servo_that_is_told_less_than_its_joint_can_do_is_the_limit(tmp_path: Path) -> None:
    model = tmp_path / "swing.xml"
    model.write_text(
        "<mujoco><compiler angle='radian'/><worldbody><body name='rod'>"
        "<joint name='swing' axis='0 0 1' range='-3 3' limited='true'/>"
        "<geom type='capsule' fromto='0 0 0 1 0 0' size='.02'/><site name='tip' pos='1 0 0'/></body></worldbody>"
        "<actuator><position name='swing' joint='swing' gear='2' kp='50' ctrlrange='-1 1'/></actuator></mujoco>",
        encoding="utf-8",
    )
    with (
        SimulatedServer(str(model), play=True, model_roots=[tmp_path]) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        ik = InverseKinematics(client, site="tip")
        with pytest.raises(UnreachableTarget) as caught:
            ik.solve([math.cos(1.0), math.sin(1.0), 0.0])
        assert caught.value.nearest.joints == pytest.approx({"swing": 0.5}, abs=1e-3)  # of length over gear
        reached = ik.solve([math.cos(0.4), math.sin(0.4), 0.0])
        assert reached.set_points == pytest.approx({"swing": 0.8}, abs=2e-3)


def test_a_path_collides_where_the_robot_would_run_into_itself(ik: InverseKinematics) -> None:
    folded = ik.solve((0.0, 0.0, 0.1), nearest=True).joints
    still = dict.fromkeys(ik.joints, 0.0)
    assert ik.collisions([still, still]) is None
    hit = ik.collisions([still, folded])
    assert hit is not None
    assert hit[0] == 1
    assert all(name.startswith("arm_") for name in hit[1:])
    assert ik.gripper is not None
    assert ik.gripper.name == "gripper"
    assert ik.set_points(still) == still
