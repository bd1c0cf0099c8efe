from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from urlab_client.values.rotation import (
    Quat,
    Vec3,
    euler_to_quat,
    normalized,
    quat_to_euler,
    rotate,
    swap_frame,
    wxyz,
    xyzw,
)

angles = st.floats(-720.0, 720.0)
eulers = st.tuples(angles, angles, angles)
components = st.floats(-10.0, 10.0)
unit_quats = (
    st.tuples(components, components, components, components).filter(lambda q: max(map(abs, q)) > 1e-3).map(normalized)
)
vectors = st.tuples(components, components, components)

HALF = math.sqrt(0.5)


def about(axis: int, degrees: float) -> Quat:
    half = math.radians(degrees) / 2.0
    vector = [0.0, 0.0, 0.0]
    vector[axis] = math.sin(half)
    return (*vector, math.cos(half))


def multiply(a: Quat, b: Quat) -> Quat:
    """Hamilton's product: the rotation `b` followed by `a`."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def same_rotation(a: Quat, b: Quat, tolerance: float = 1e-9) -> bool:
    return abs(abs(sum(p * q for p, q in zip(a, b, strict=True))) - 1.0) < tolerance


@pytest.mark.parametrize(
    ("euler", "spawned", "drawn"),
    [
        ((0, 0, 90), (0, 0, 0.707107, 0.707107), (0, 0, -0.707107, 0.707107)),
        ((0, -45, 0), (0, 0.382683, 0, 0.923880), (0, 0.382683, 0, 0.923880)),
        ((90, 0, 0), (-0.707107, 0, 0, 0.707107), (0.707107, 0, 0, 0.707107)),
        ((10, 20, 30), (-0.038135, -0.189308, 0.239298, 0.951549), (0.038135, -0.189308, -0.239298, 0.951549)),
    ],
)
def test_euler_angles_of_the_wire_table(euler: Vec3, spawned: Quat, drawn: Quat) -> None:
    quat = euler_to_quat(euler)

    assert quat == pytest.approx(spawned, abs=1e-6)
    assert swap_frame(quat) == pytest.approx(drawn, abs=1e-6)


def test_camera_pose_of_the_conformance_checks() -> None:
    quat = swap_frame(euler_to_quat((0, -30, 45)))

    assert same_rotation(quat, (0.0990, 0.2391, -0.3696, 0.8924), 1e-4)


@given(eulers)
def test_spawn_angles_turn_about_the_axes_of_mujoco(euler: Vec3) -> None:
    roll, pitch, yaw = euler
    expected = multiply(about(2, yaw), multiply(about(1, -pitch), about(0, -roll)))

    assert same_rotation(euler_to_quat(euler), expected)


@given(eulers)
def test_unreal_angles_turn_about_mirrored_axes(euler: Vec3) -> None:
    roll, pitch, yaw = euler
    expected = multiply(about(2, -yaw), multiply(about(1, -pitch), about(0, roll)))

    assert same_rotation(swap_frame(euler_to_quat(euler)), expected)


@given(angles, angles)
def test_a_light_shines_along_its_x_axis(pitch: float, yaw: float) -> None:
    direction = rotate(swap_frame(euler_to_quat((33.0, pitch, yaw))), (1.0, 0.0, 0.0))
    p, y = math.radians(pitch), math.radians(yaw)

    assert direction == pytest.approx((math.cos(p) * math.cos(y), -math.cos(p) * math.sin(y), math.sin(p)), abs=1e-9)


@given(st.floats(-180.0, 180.0), st.floats(-89.0, 89.0), st.floats(-180.0, 180.0))
def test_a_rotator_survives_the_way_through_a_quaternion(roll: float, pitch: float, yaw: float) -> None:
    back = quat_to_euler(euler_to_quat((roll, pitch, yaw)))

    assert same_rotation(euler_to_quat(back), euler_to_quat((roll, pitch, yaw)))
    assert back[1] == pytest.approx(pitch, abs=1e-6)


@given(unit_quats)
def test_every_rotation_has_a_rotator(quat: Quat) -> None:
    roll, pitch, yaw = quat_to_euler(quat)

    assert same_rotation(euler_to_quat((roll, pitch, yaw)), quat, 1e-5)
    assert -90.0 <= pitch <= 90.0
    assert -180.0 <= roll <= 180.0
    assert -180.0 <= yaw <= 180.0


@pytest.mark.parametrize("pitch", [90.0, -90.0])
@pytest.mark.parametrize(("roll", "yaw"), [(0.0, 0.0), (30.0, 0.0), (0.0, 40.0), (-70.0, 110.0)])
def test_the_poles_have_a_rotator(roll: float, pitch: float, yaw: float) -> None:
    quat = euler_to_quat((roll, pitch, yaw))
    back = quat_to_euler(quat)

    assert back[1] == pitch
    assert same_rotation(euler_to_quat(back), quat, 1e-6)


@given(unit_quats, vectors)
def test_the_frames_mirror_each_other(quat: Quat, vector: Vec3) -> None:
    x, y, z = vector
    mirrored = rotate(swap_frame(quat), (x, -y, z))

    assert swap_frame(swap_frame(quat)) == quat
    assert (mirrored[0], -mirrored[1], mirrored[2]) == pytest.approx(rotate(quat, vector), abs=1e-9)


@given(unit_quats, unit_quats, vectors)
def test_a_product_turns_by_one_after_the_other(a: Quat, b: Quat, vector: Vec3) -> None:
    assert rotate(multiply(a, b), vector) == pytest.approx(rotate(a, rotate(b, vector)), abs=1e-9)


@given(unit_quats)
def test_the_orders_of_components_are_inverse(quat: Quat) -> None:
    assert wxyz(quat) == (quat[3], *quat[:3])
    assert xyzw(wxyz(quat)) == quat


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e300])
def test_normalising_takes_any_length(scale: float) -> None:
    assert normalized((0.0, scale, 0.0, scale)) == pytest.approx((0.0, HALF, 0.0, HALF))


@pytest.mark.parametrize("quat", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 1.0)])
def test_what_is_no_rotation_is_refused(quat: Quat) -> None:
    with pytest.raises(ValueError, match="quaternion"):
        normalized(quat)
