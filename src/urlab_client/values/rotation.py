"""Rotations of the editor ops: quaternions (x, y, z, w), Unreal rotators, and the way between the two frames.

MuJoCo's frame is right-handed with z up, Unreal's is left-handed: MuJoCo (x, y, z) is Unreal (x, -y, z). A rotator is
(roll, pitch, yaw) in degrees. Which frame a request's numbers belong to depends on the op: spawn ops and transforms
read them in MuJoCo's frame, lights, drawing and viewport ops in Unreal's.

Sources of the formulas: Unreal's `FRotator::Quaternion` and `FQuat::Rotator`, and the Euler-Rodrigues formula. Nothing
here knows of actors or ops.
"""

from __future__ import annotations

import math
from typing import Final, TypeAlias

Vec3: TypeAlias = tuple[float, float, float]
Quat: TypeAlias = tuple[float, float, float, float]

IDENTITY: Final[Quat] = (0.0, 0.0, 0.0, 1.0)

_UNIT: Final = 1e-14
"""Rounding leaves the square of a unit quaternion's length this close to 1."""

_POLE: Final = 0.4999995
"""Where Unreal treats pitch as 90 degrees: |z x - w y| beyond this."""


def wxyz(quat: Quat) -> Quat:
    """Return (x, y, z, w) in MuJoCo's order (w, x, y, z)."""
    x, y, z, w = quat
    return w, x, y, z


def xyzw(quat: Quat) -> Quat:
    """Return (w, x, y, z) in the wire's order (x, y, z, w)."""
    w, x, y, z = quat
    return x, y, z, w


def normalized(quat: Quat) -> Quat:
    """Return the unit quaternion along `quat`, either order; one of unit length already stays as it is.

    Raises:
        ValueError: A component is not finite, or all are zero.
    """
    if not all(math.isfinite(value) for value in quat):
        raise ValueError(f"a quaternion has finite components, not {list(quat)}")
    if abs(sum(value * value for value in quat) - 1.0) < _UNIT:
        return quat
    largest = max(abs(value) for value in quat)
    if largest == 0.0:
        raise ValueError("a quaternion of four zeros is not a rotation")
    # Scaling first keeps the squares within range, whatever the components are.
    a, b, c, d = (value / largest for value in quat)
    norm = math.sqrt(a * a + b * b + c * c + d * d)
    return a / norm, b / norm, c / norm, d / norm


def swap_frame(quat: Quat) -> Quat:
    """Turn a rotation (x, y, z, w) of Unreal's frame into MuJoCo's, or back: negating y is its own inverse."""
    x, y, z, w = quat
    return -x, y, -z, w


def euler_to_quat(euler: Vec3) -> Quat:
    """Return the quaternion (x, y, z, w) of a rotator, in the rotator's own frame.

    This is Unreal's `FRotator::Quaternion`. Read in MuJoCo's frame, as spawn ops do, the result is
    Rz(yaw) Ry(-pitch) Rx(-roll): positive pitch lifts the nose. Read in Unreal's frame and taken to MuJoCo's with
    `swap_frame`, as lights, drawing and viewport ops do, it is Rz(-yaw) Ry(-pitch) Rx(roll).

    Args:
        euler: (roll, pitch, yaw), degrees.
    """
    half_roll, half_pitch, half_yaw = (math.radians(math.fmod(angle, 360.0)) / 2.0 for angle in euler)
    sr, cr = math.sin(half_roll), math.cos(half_roll)
    sp, cp = math.sin(half_pitch), math.cos(half_pitch)
    sy, cy = math.sin(half_yaw), math.cos(half_yaw)
    return (
        cr * sp * sy - sr * cp * cy,
        -cr * sp * cy - sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def quat_to_euler(quat: Quat) -> Vec3:
    """Return the rotator (roll, pitch, yaw), degrees, of a unit quaternion (x, y, z, w) of Unreal's frame.

    This is Unreal's `FQuat::Rotator`. Pitch lies in -90..90; at the poles roll and yaw turn about the same axis and
    roll takes what is left.
    """
    x, y, z, w = quat
    singularity = z * x - w * y
    yaw = math.degrees(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    if abs(singularity) < _POLE:
        pitch = math.degrees(math.asin(2.0 * singularity))
        roll = math.degrees(math.atan2(-2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)))
    else:
        sign = math.copysign(1.0, singularity)
        pitch = sign * 90.0
        roll = _wrapped(sign * yaw - math.degrees(2.0 * math.atan2(x, w)))
    return roll, pitch, yaw


def rotate(quat: Quat, vector: Vec3) -> Vec3:
    """Rotate `vector` by a unit quaternion (x, y, z, w): v + 2 w (u x v) + 2 u x (u x v)."""
    x, y, z, w = quat
    vx, vy, vz = vector
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def _wrapped(angle: float) -> float:
    """Return `angle` in -180..180 degrees."""
    return math.remainder(angle, 360.0)
