"""Replies in which only numbers change, encoded once and filled in from then on.

For the handlers of ops that answer many times a second. Between two steps of a scene nothing changes in the bytes of a
reply but the numbers in it: each is a float64 in a place of its own. The first reply of a kind is made the usual way,
with marks in place of numbers. Where a mark turns up in its bytes, later replies get the number it stands for, at a
third of the cost.
"""

from __future__ import annotations

import copy
import dataclasses
import struct
from collections.abc import Mapping, Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.dialects import ALPHA, Dialect
from urlab_client.protocol.enums import ObservationLevel
from urlab_client.protocol.messages.session import Clock, StepOk
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.physics.controllers import ArticulationControl, Twist
from urlab_client.server.physics.observe import Observer, sim_seconds, wall_seconds

__all__ = ["StepReplies"]

Floats = NDArray[np.float64]

_FLOAT64: Final = b"\xcb"
_BIG_ENDIAN: Final = np.dtype(">f8")
_MARK: Final = 2.0**52
"""The first mark: whole, so that it also fits where integers go, and as good as never a constant of a reply."""

_CLOCKS: Final = 7
"""Time, step counter, seconds and nanoseconds of both clocks, and the snapshot's number."""


class StepReplies:
    """Encodes the replies to `step` of a scene."""

    def __init__(
        self, scene: CompiledScene, controls: Mapping[str, ArticulationControl], dialect: Dialect = ALPHA
    ) -> None:
        """Prepare for a scene.

        Args:
            scene: The scene.
            controls: `Articulations.controls` of the engine that steps it; holds the twists.
            dialect: What the replies look like.
        """
        self._scene = scene
        self._dialect = dialect
        self._controls = controls
        self._twists = [control.twist for control in controls.values()]
        self._sources = _arrays(scene.data)
        self._templates: dict[ObservationLevel, _ReplyTemplate] = {}

    def encode(self, level: ObservationLevel, time: float, step: int, frame_id: int = 0) -> bytes:
        """Return the msgpack frame of a `StepOk` without cameras and replay. The caller holds the engine's lock.

        Args:
            level: Which fields it has.
            time: `mjData.time`, seconds.
            step: Step counter.
            frame_id: Number of the snapshot, in dialects that tell it.
        """
        template = self._templates.get(level)
        if template is None:
            template = self._templates[level] = self._cut(level)
        numbers = [time, step, *sim_seconds(time), *wall_seconds(), frame_id]
        for twist in self._twists:
            numbers += (twist.vx, twist.vy, twist.yaw_rate, twist.actions)
        return template.fill(numbers)

    def _cut(self, level: ObservationLevel) -> _ReplyTemplate:
        temporary_folder = mujoco.MjData(self._scene.model)
        controls = {key: copy.copy(control) for key, control in self._controls.items()}
        marks = iter(range(int(_MARK), int(_MARK) + _CLOCKS + 4 * len(controls)))
        time, step, sec, nsec, wall_sec, wall_nsec, frame_id = (next(marks) for _ in range(_CLOCKS))
        for control in controls.values():
            control.twist = Twist(next(marks), next(marks), next(marks), next(marks))
        first = _MARK + _CLOCKS + 4 * len(controls)
        for array in _arrays(temporary_folder):
            array[:] = np.arange(first, first + len(array))
            first += len(array)
        observer = Observer(dataclasses.replace(self._scene, data=temporary_folder), controls)
        reply = StepOk(
            time=time,
            step=step,
            sim_time=Clock(sec=sec, nsec=nsec),
            wall_time=Clock(sec=wall_sec, nsec=wall_nsec),
            per_articulation=observer.articulations(level),
            entities=observer.entities(),
            frame_id=frame_id if self._dialect.frame_ids else None,
        )
        return _ReplyTemplate(encode_reply(self._dialect.shaped(reply)), _CLOCKS + 4 * len(controls), self._sources)


class _ReplyTemplate:
    """The bytes of a reply, and where which number goes."""

    def __init__(self, marked: bytes, scalars: int, sources: Sequence[Floats]) -> None:
        """Find the marks.

        Args:
            marked: The reply, with the number `_MARK + i` where the i-th number goes.
            scalars: How many numbers come one by one, before those in arrays.
            sources: The arrays that the others are read from, one after the other.
        """
        places, numbers = _find_marks(marked, scalars + sum(map(len, sources)))
        # Arrays that this reply shows nothing of are not read.
        self._sources: list[memoryview] = []
        kept = np.arange(scalars)
        first = scalars
        for source in sources:
            indices = np.arange(first, first + len(source))
            first += len(source)
            if np.isin(indices, numbers).any():
                self._sources.append(source.data.cast("B"))
                kept = np.concatenate((kept, indices))
        self._places = places
        self._order = np.searchsorted(kept, numbers)
        self._pack = struct.Struct(f"={scalars}d").pack
        self._frame = np.frombuffer(bytearray(marked), np.uint8)
        # The eight bytes from each byte on as a word, so that one assignment writes all of them.
        self._overlay: NDArray[np.uint64] = np.ndarray(max(0, len(marked) - 7), np.uint64, self._frame, strides=(1,))

    def fill(self, scalars: Sequence[float]) -> bytes:
        """Return the bytes with the numbers of now."""
        numbers = np.frombuffer(b"".join((self._pack(*scalars), *self._sources)))
        # Swapped before they are scattered, which takes longer for numbers of foreign byte order.
        self._overlay[self._places] = numbers[self._order].astype(_BIG_ENDIAN).view(np.uint64)
        return self._frame.tobytes()


def _find_marks(frame: bytes, count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the offsets of the marks' eight bytes, and which numbers they stand for."""
    places: list[int] = []
    numbers: list[int] = []
    # Text is UTF-8, in which no byte of this value stands before one that a mark begins with.
    at = frame.find(_FLOAT64)
    while 0 <= at <= len(frame) - 9:
        number = struct.unpack_from(">d", frame, at + 1)[0] - _MARK
        if 0 <= number < count:
            places.append(at + 1)
            numbers.append(int(number))
            at += 8
        at = frame.find(_FLOAT64, at + 1)
    return np.array(places, dtype=np.intp), np.array(numbers, dtype=np.intp)


def _arrays(data: mujoco.MjData) -> list[Floats]:
    """Return flat views of everything that an observation may show."""
    return [
        data.qpos,
        data.qvel,
        data.ctrl,
        data.act,
        data.sensordata,
        data.actuator_force,
        data.xpos.reshape(-1),
        data.xquat.reshape(-1),
    ]
