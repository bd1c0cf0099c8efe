"""Debug drawing: primitives with a time to live, and one line of text.

For the `debug` handlers, which add to a `Drawings`, and for `snapshot`, which reads from it. Robot cameras do not show
it, so that it does not get into training data. Positions are metres and rotations quaternions (x, y, z, w), both in
MuJoCo's frame; colours are red, green and blue in 0..1, in steps of 1/255.
"""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.server.limits import Limits
from urlab_client.values.rotation import IDENTITY, Quat, Vec3

logger: logging.Logger = logging.getLogger("urlab_client.server")

MARKER_RADIUS_M: Final = 0.05
OVERLAY_S: Final = 10.0

_HEAD_SPREAD: Final = 0.45
"""Half the width of an arrow's head, as a share of its length."""


@dataclass(frozen=True, kw_only=True)
class Stroke:
    """One geom of debug drawing; a line, if it has an end.

    Attributes:
        size: As MuJoCo has it for this kind; of lines their width, where 1 is the usual thickness.
    """

    kind: mujoco.mjtGeom
    at: Vec3
    color: Vec3
    size: Vec3 = (0.0, 0.0, 0.0)
    rotation: Quat = IDENTITY
    end: Vec3 | None = None
    text: str = ""


Primitive: TypeAlias = tuple[Stroke, ...]
"""What one op draws; several count as one."""


def sphere(at: Vec3, color: Vec3) -> Primitive:
    """Return a sphere of `MARKER_RADIUS_M`."""
    size = (MARKER_RADIUS_M, MARKER_RADIUS_M, MARKER_RADIUS_M)
    return (Stroke(kind=mujoco.mjtGeom.mjGEOM_SPHERE, at=at, color=color, size=size),)


def label(at: Vec3, text: str, color: Vec3) -> Primitive:
    """Return a text in the world."""
    return (Stroke(kind=mujoco.mjtGeom.mjGEOM_LABEL, at=at, color=color, size=(0.1, 0.1, 0.1), text=text),)


def line(start: Vec3, end: Vec3, color: Vec3, thickness: float = 1.0) -> Primitive:
    """Return a line segment; its usual thickness is 1."""
    size = (thickness, thickness, thickness)
    return (Stroke(kind=mujoco.mjtGeom.mjGEOM_LINE, at=start, end=end, color=color, size=size),)


def box(center: Vec3, half_extents: Vec3, rotation: Quat, color: Vec3) -> Primitive:
    """Return a box of lines."""
    kind = mujoco.mjtGeom.mjGEOM_LINEBOX
    return (Stroke(kind=kind, at=center, color=color, size=half_extents, rotation=rotation),)


def arrow(start: Vec3, end: Vec3, color: Vec3, head: float, thickness: float = 1.0) -> Primitive:
    """Return an arrow: its shaft, and the four edges of its head, which has this length, metres.

    What is too long or too large for numbers has no head.
    """
    tail: NDArray[np.float64] = np.array(start)
    tip: NDArray[np.float64] = np.array(end)
    length = math.dist(start, end)
    shaft = line(start, end, color, thickness)
    if not 0.0 < length < math.inf:
        return shaft
    along = (tip - tail) / length
    least: NDArray[np.float64] = np.eye(3)[np.argmin(np.abs(along))]
    side: NDArray[np.float64] = np.cross(along, least)
    side /= float(np.linalg.norm(side))
    other: NDArray[np.float64] = np.cross(along, side)
    with np.errstate(over="ignore"):
        barbs = np.array([tip - head * (along - _HEAD_SPREAD * out) for out in (side, -side, other, -other)])
    if not np.isfinite(barbs).all():
        return shaft
    edges = [line(end, (x, y, z), color, thickness) for x, y, z in barbs.tolist()]
    return (*shaft, *itertools.chain.from_iterable(edges))


@dataclass(frozen=True)
class _Marker:
    primitive: Primitive
    expires: float | None  # None: with the next frame


class Drawings:
    """What was drawn into the edited world and into the play world. Safe to use from several threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, *, limit: int = Limits.markers) -> None:
        """Create empty drawings.

        Args:
            clock: Seconds since any moment; never goes back.
            limit: Primitives kept per world; the oldest are removed.
        """
        self._clock = clock
        self._lock = threading.Lock()
        self._worlds: dict[bool, deque[_Marker]] = {False: deque(), True: deque()}
        self._overlay = ("", -math.inf)
        self._limit = limit

    def add(self, primitives: Sequence[Primitive], *, ttl: float, in_play: bool) -> None:
        """Draw.

        Args:
            ttl: Seconds to live; 0 for the next frame alone, negative until cleared.
        """
        now = self._clock()
        expires = math.inf if ttl < 0.0 else now + ttl if ttl > 0.0 else None
        with self._lock:
            entries = self._alive(in_play, now)
            entries.extend(_Marker(primitive, expires) for primitive in primitives)
            surplus = len(entries) - self._limit
            for _ in range(surplus):
                entries.popleft()
        if surplus > 0:
            logger.warning(
                "more than %d debug primitives (limit markers): the oldest are dropped; use clear_markers", self._limit
            )

    def clear(self, *, in_play: bool) -> None:
        """Remove everything drawn into a world."""
        with self._lock:
            self._worlds[in_play].clear()

    def take_frame(self, *, in_play: bool) -> list[Primitive]:
        """Return the primitives of the next frame, and remove those that last one frame."""
        with self._lock:
            entries = self._alive(in_play, self._clock())
            shown = [entry.primitive for entry in entries]
            self._worlds[in_play] = deque(entry for entry in entries if entry.expires is not None)
        return shown

    def set_overlay(self, text: str) -> None:
        """Show a line of text for ten seconds, instead of any other; empty text clears it."""
        with self._lock:
            self._overlay = (text, self._clock() + OVERLAY_S)

    @property
    def overlay(self) -> str:
        """The line of text; empty when there is none."""
        text, expires = self._overlay
        return text if self._clock() < expires else ""

    def _alive(self, in_play: bool, now: float) -> deque[_Marker]:
        entries = self._worlds[in_play]
        if any(entry.expires is not None and entry.expires <= now for entry in entries):
            entries = deque(entry for entry in entries if entry.expires is None or entry.expires > now)
            self._worlds[in_play] = entries
        return entries
