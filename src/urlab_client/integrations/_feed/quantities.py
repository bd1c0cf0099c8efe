"""Quantities and units of recorded values, for axis labels, and names of components. No I/O."""

from __future__ import annotations

from typing import Final

from urlab_client.integrations._feed.scene import SceneLayout

_UNKNOWN = "reading"

_SENSORS: Final[dict[str, str]] = {
    "touch": "contact force (N)",
    "accelerometer": "linear acceleration (m/s²)",
    "velocimeter": "linear velocity (m/s)",
    "gyro": "angular velocity (rad/s)",
    "force": "force (N)",
    "torque": "torque (N m)",
    "magnetometer": "magnetic flux",
    "rangefinder": "distance (m)",
    "camprojection": "image position (pixels)",
    "jointpos": "joint position (rad, m)",
    "jointvel": "joint velocity (rad/s, m/s)",
    "tendonpos": "tendon length (m)",
    "tendonvel": "tendon velocity (m/s)",
    "actuatorpos": "actuator length",
    "actuatorvel": "actuator velocity",
    "actuatorfrc": "actuator force (N, N m)",
    "jointactfrc": "joint force (N m, N)",
    "tendonactfrc": "tendon force (N)",
    "ballquat": "orientation (w, x, y, z)",
    "ballangvel": "angular velocity (rad/s)",
    "jointlimitpos": "distance to limit (rad, m)",
    "jointlimitvel": "velocity to limit (rad/s, m/s)",
    "jointlimitfrc": "limit force (N m, N)",
    "tendonlimitpos": "distance to limit (m)",
    "tendonlimitvel": "velocity to limit (m/s)",
    "tendonlimitfrc": "limit force (N)",
    "framepos": "position (m)",
    "framequat": "orientation (w, x, y, z)",
    "framexaxis": "x axis",
    "frameyaxis": "y axis",
    "framezaxis": "z axis",
    "framelinvel": "linear velocity (m/s)",
    "frameangvel": "angular velocity (rad/s)",
    "framelinacc": "linear acceleration (m/s²)",
    "frameangacc": "angular acceleration (rad/s²)",
    "subtreecom": "centre of mass (m)",
    "subtreelinvel": "linear velocity (m/s)",
    "subtreeangmom": "angular momentum (kg m²/s)",
    "geomdist": "distance (m)",
    "geomnormal": "normal",
    "geomfromto": "segment (m)",
    "e_potential": "potential energy (J)",
    "e_kinetic": "kinetic energy (J)",
    "clock": "time (s)",
}
_QUATERNIONS = frozenset({"ballquat", "framequat"})
_SEPARATOR = "."


def quantities(layout: SceneLayout, field: str, names: list[str]) -> list[str]:
    """Return quantity and unit of each value of a field, as axis labels.

    Args:
        layout: Layout of the articulation.
        field: Field name as in `Table.columns`.
        names: Names of the values.
    """
    match field:
        case "qpos":
            return [_position(layout, name) for name in names]
        case "qvel":
            return [_velocity(layout, name) for name in names]
        case "sensors":
            return [_SENSORS.get(_kind(layout, name), _kind(layout, name) or _UNKNOWN) for name in names]
        case "pose":
            return ["position (m)" if name in "xyz" else "orientation (w, x, y, z)" for name in names]
        case "ctrl" | "set_points":
            return ["control" if field == "ctrl" else "set-point"] * len(names)
        case _:
            return [field] * len(names)


def component_name(layout: SceneLayout, name: str) -> str:
    """Return the name of a sensor's value with its axis, `imu.x` for `imu.0`, if sensors of its kind have axes."""
    sensor, dot, index = name.rpartition(_SEPARATOR)
    kind = layout.sensors.get(sensor, "")
    if not dot or not index.isdecimal() or not kind:
        return name
    axes = "wxyz" if kind in _QUATERNIONS else "xyz"
    return f"{sensor}.{axes[int(index)]}" if int(index) < len(axes) and kind in _SENSORS else name


def _kind(layout: SceneLayout, name: str) -> str:
    return layout.sensors.get(name) or layout.sensors.get(name.rpartition(_SEPARATOR)[0], "")


def _position(layout: SceneLayout, name: str) -> str:
    component = name.rpartition(_SEPARATOR)[2]
    if component in ("x", "y", "z"):
        return "position (m)"
    if component in ("qw", "qx", "qy", "qz"):
        return "orientation (w, x, y, z)"
    if layout.slides is None:
        return "position (rad, m)"
    return "position (m)" if name in layout.slides else "angle (rad)"


def _velocity(layout: SceneLayout, name: str) -> str:
    component = name.rpartition(_SEPARATOR)[2]
    if component in ("vx", "vy", "vz"):
        return "velocity (m/s)"
    if component in ("wx", "wy", "wz"):
        return "angular velocity (rad/s)"
    if layout.slides is None:
        return "velocity (rad/s, m/s)"
    return "velocity (m/s)" if name in layout.slides else "angular velocity (rad/s)"
