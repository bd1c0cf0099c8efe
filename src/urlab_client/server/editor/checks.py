"""Checks of the actor properties in a request: names, numbers, rotations, poses."""

from __future__ import annotations

import math
from collections.abc import Iterable
from ctypes import c_float

from urlab_client.server.assets.actors import UNIT_SCALE
from urlab_client.server.refusal import Refusal
from urlab_client.values.rotation import Quat, Vec3, euler_to_quat, normalized


def require(value: str, name: str) -> None:
    """Refuse with `missing_field` if a name is empty."""
    if not value:
        raise Refusal("missing_field", f"{name} must not be empty")


def float32(value: float) -> float:
    """Round to single precision, as the plugin stores it."""
    return c_float(value).value


def refuse_infinite(values: Iterable[float], names: str, code: str) -> None:
    """Refuse with `code` unless all numbers are finite."""
    if not all(math.isfinite(value) for value in values):
        raise Refusal(code, f"{names} must be finite numbers")


def refuse_scale(scale: Vec3, code: str) -> None:
    """Refuse with `code` unless the scale is 1."""
    if scale != UNIT_SCALE:
        raise Refusal(
            code,
            f"an articulation cannot be scaled by {list(scale)}: MuJoCo has no scale for a placed model; "
            "change the sizes in the MJCF",
        )


def rotation(quat: Quat | None, euler: Vec3 | None, code: str) -> Quat | None:
    """Return the rotation in a spawn request, unnormalised; None if it contains none."""
    if quat is not None or euler is None:
        return quat
    refuse_infinite(euler, "rotation_euler", code)
    return euler_to_quat(euler)


def pose(location: Vec3, rotation: Quat, code: str) -> tuple[Vec3, Quat]:
    """Return position and unit quaternion; refuse an invalid pose with `code`."""
    refuse_infinite(location, "location", code)
    try:
        return location, normalized(rotation)
    except ValueError as error:
        raise Refusal(code, f"rotation_quat: {error}") from None
