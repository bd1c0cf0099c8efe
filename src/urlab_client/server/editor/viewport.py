"""The viewport's camera: where it is, what it follows and how it shows the world.

For the `viewport` handlers and for the renderer. It contains only state, so the ops need no OpenGL.
Positions are metres in MuJoCo's frame; the camera's rotation is Unreal's rotator (roll, pitch, yaw), degrees, as in the
editor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from urlab_client.values.rotation import Quat, Vec3, euler_to_quat, normalized, quat_to_euler, rotate, swap_frame

ASPECT: Final = 16.0 / 9.0
"""Width by height of the viewport."""

DEFAULT_OFFSET: Final[Vec3] = (0.0, -2.0, 1.0)
"""Position of the camera relative to a tracked actor, in the actor's frame, metres."""

MAX_SMOOTHING: Final = 0.99

TICK_HZ: Final = 60.0
"""Rate of the editor's ticks. Each moves the camera closer to the tracked actor."""

_MIN_FOV: Final = 1.0
_MAX_FOV: Final = 170.0
_SMALLEST_M: Final = 0.1


class ViewMode(StrEnum):
    """How the viewport shows the world."""

    LIT = "lit"
    UNLIT = "unlit"
    WIREFRAME = "wireframe"
    COLLISION = "collision"
    REFLECTIONS = "reflections"


@dataclass(frozen=True, kw_only=True)
class ViewportCamera:
    """A perspective camera; its local +x looks forward, +z is up.

    Attributes:
        location: Position, metres.
        euler: Unreal's view rotator: (roll, pitch, yaw), degrees.
        fov: Horizontal field of view, degrees.
    """

    location: Vec3
    euler: Vec3
    fov: float

    @property
    def rotation(self) -> Quat:
        """Orientation in MuJoCo's frame, (x, y, z, w)."""
        return swap_frame(euler_to_quat(self.euler))

    @property
    def forward(self) -> Vec3:
        """Direction of view, MuJoCo's frame."""
        return rotate(self.rotation, (1.0, 0.0, 0.0))

    @property
    def up(self) -> Vec3:
        """Direction of the picture's upper edge, MuJoCo's frame."""
        return rotate(self.rotation, (0.0, 0.0, 1.0))

    def fovy(self, aspect: float) -> float:
        """Return the vertical field of view, degrees, of a picture with this width by height."""
        return 2.0 * math.degrees(math.atan(self._tangent / aspect))

    def framing(self, low: Vec3, high: Vec3) -> ViewportCamera:
        """Return the camera moved so that the box between two corners fits the view; the direction stays."""
        center = _combine(low, high, 0.5)
        radius = max(math.dist(low, high) / 2.0, _SMALLEST_M)
        distance = radius * max(ASPECT, 1.0) / self._tangent
        return replace(self, location=_along(center, self.forward, -distance))

    @property
    def _tangent(self) -> float:
        return math.tan(math.radians(min(max(self.fov, _MIN_FOV), _MAX_FOV)) / 2.0)


@dataclass(frozen=True, kw_only=True)
class Track:
    """What the camera follows.

    Attributes:
        offset: Camera position in the actor's frame, metres.
        smoothing: Share of the old pose kept at each tick, 0 to 0.99.
    """

    actor_name: str
    offset: Vec3 = DEFAULT_OFFSET
    smoothing: float = 0.0


_DEFAULT_VIEW: Final = ViewportCamera(location=(-3.0, -3.0, 2.5), euler=(0.0, -25.0, -45.0), fov=90.0)


class Viewport:
    """The one perspective viewport of a server.

    Attributes:
        view: The camera as last placed; `follow` moves it while an actor is tracked.
        track: What the camera follows, or None.
    """

    def __init__(self) -> None:
        self.view: ViewportCamera = _DEFAULT_VIEW
        self.mode = ViewMode.LIT
        self.track: Track | None = None
        self._followed_at: float | None = None

    def place(self, location: Vec3, *, euler: Vec3 | None = None, fov: float | None = None) -> None:
        """Move the camera.

        Args:
            location: Position, metres.
            euler: (roll, pitch, yaw) of Unreal's view, degrees; None keeps it.
            fov: Horizontal field of view, degrees; None keeps it.
        """
        old = self.view
        self.view = ViewportCamera(
            location=location, euler=old.euler if euler is None else euler, fov=old.fov if fov is None else fov
        )

    def start_tracking(self, track: Track) -> None:
        """Follow an actor, instead of any other."""
        smoothing = min(max(track.smoothing, 0.0), MAX_SMOOTHING) if not math.isnan(track.smoothing) else 0.0
        self.track = replace(track, smoothing=smoothing)
        self._followed_at = None

    def stop_tracking(self) -> bool:
        """Stop following, and return whether an actor was tracked."""
        track, self.track = self.track, None
        return track is not None

    def follow(self, location: Vec3, rotation: Quat, now: float) -> None:
        """Move the camera towards the tracked actor, once for each of the editor's ticks that has passed.

        Args:
            location: Position of the tracked actor, metres.
            rotation: Its rotation, a unit quaternion (x, y, z, w), MuJoCo's frame.
            now: Monotonic time, seconds.
        """
        track = self.track
        if track is None:
            return
        ticks = 1.0 if self._followed_at is None else max(0.0, now - self._followed_at) * TICK_HZ
        self._followed_at = now
        share = 1.0 - track.smoothing**ticks if ticks else 0.0
        place = _along(location, rotate(rotation, track.offset), 1.0)
        old = self.view
        wanted = _looking(place, location, old.euler)
        roll, pitch, yaw = (
            before + math.remainder(after - before, 360.0) * share
            for before, after in zip(old.euler, wanted, strict=True)
        )
        self.view = replace(old, location=_combine(old.location, place, share), euler=(roll, pitch, yaw))


def rotator(quat: Quat | None, euler: Vec3 | None) -> Vec3 | None:
    """Return the rotator (roll, pitch, yaw), degrees, of a viewport or drawing op; None if the request contains none.

    Args:
        quat: (x, y, z, w) in Unreal's frame; takes precedence.
        euler: The rotator itself, degrees.

    Raises:
        ValueError: A number is not finite, or the quaternion is zero.
    """
    if quat is not None:
        return quat_to_euler(normalized(quat))
    if euler is not None and not all(map(math.isfinite, euler)):
        raise ValueError(f"angles must be finite numbers, not {list(euler)}")
    return euler


def _looking(place: Vec3, target: Vec3, otherwise: Vec3) -> Vec3:
    """Return the rotator of a camera at `place` that looks at `target`, upright."""
    dx, dy, dz = (end - start for start, end in zip(place, target, strict=True))
    if dx == dy == dz == 0.0:
        return otherwise
    flat = math.hypot(dx, dy)
    yaw = -math.degrees(math.atan2(dy, dx)) if flat > 0.0 else otherwise[2]
    return 0.0, math.degrees(math.atan2(dz, flat)), yaw


def _along(start: Vec3, direction: Vec3, distance: float) -> Vec3:
    x, y, z = (a + b * distance for a, b in zip(start, direction, strict=True))
    return x, y, z


def _combine(start: Vec3, end: Vec3, share: float) -> Vec3:
    x, y, z = (a + (b - a) * share for a, b in zip(start, end, strict=True))
    return x, y, z
