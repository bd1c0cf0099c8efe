"""Replies in which only numbers change, encoded once and filled in from then on.

For `step`. Between two steps of a scene, nothing in a reply changes but its numbers, and each is a float64 in a place
of its own. The first reply of a level is encoded as all replies are, with marks in place of numbers. Later replies get
the number that each mark stands for. Without templates a step takes 7 % longer with one robot, and 22 % with sixteen.
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

from urlab_client.enums import ObservationLevel
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.messages.session import Clock, StepOk
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.dialects import ALPHA, Dialect
from urlab_client.server.physics.controllers import ArticulationControl, Twist
from urlab_client.server.physics.observe import Observer, sim_seconds, wall_seconds

_FLOAT64: Final = 0xCB
"""What precedes a number in msgpack."""

_MARK: Final = 2**52
"""The first mark. As a float64, `_MARK + i` is `_MARK_BITS + i`, and whole, so that it also fits where integers go."""

_MARK_BITS: Final = np.uint64(0x4330_0000_0000_0000)

_CLOCKS: Final = 7
"""Time, step counter, seconds and nanoseconds of both clocks, and the snapshot's number."""


class StepReplies:
    """Encodes the replies to `step` of a scene."""

    def __init__(
        self, scene: CompiledScene, controls: Mapping[str, ArticulationControl], dialect: Dialect = ALPHA
    ) -> None:
        self._scene = scene
        self._dialect = dialect
        self._controls = controls
        self._twists = [control.twist for control in controls.values()]
        self._pack = struct.Struct(f"={_CLOCKS + 4 * len(controls)}d").pack
        self._arrays = [array.data.cast("B") for array in _arrays(scene.data)]
        self._templates: dict[ObservationLevel, _ReplyTemplate] = {}

    def encode(self, level: ObservationLevel, time: float, step: int, frame_id: int = 0) -> bytes:
        """Return the msgpack frame of a `StepOk` without cameras and replay. The caller holds the engine's lock."""
        scalars = [time, step, *sim_seconds(time), *wall_seconds(), frame_id]
        for twist in self._twists:
            scalars += (twist.vx, twist.vy, twist.yaw_rate, twist.actions)
        numbers = np.frombuffer(b"".join((self._pack(*scalars), *self._arrays)))
        template = self._templates.get(level)
        if template is None:
            template = self._templates[level] = _ReplyTemplate(self._marked(level), len(numbers))
        return template.fill(numbers)

    def _marked(self, level: ObservationLevel) -> bytes:
        """Return a reply with `_MARK + i` where the i-th number goes."""
        marked_data = mujoco.MjData(self._scene.model)
        controls = {key: copy.copy(control) for key, control in self._controls.items()}
        scalars = _CLOCKS + 4 * len(controls)
        marks = iter(range(_MARK, _MARK + scalars))
        time, step, sec, nsec, wall_sec, wall_nsec, frame_id = (next(marks) for _ in range(_CLOCKS))
        for control in controls.values():
            control.twist = Twist(next(marks), next(marks), next(marks), next(marks))
        first = _MARK + scalars
        for array in _arrays(marked_data):
            array[:] = np.arange(first, first + len(array))
            first += len(array)
        observer = Observer(dataclasses.replace(self._scene, data=marked_data), controls)
        reply = StepOk(
            **observer.state(level, time, step),
            entities=observer.entities(),
            frame_id=frame_id if self._dialect.frame_ids else None,
        )
        reply.sim_time, reply.wall_time = Clock(sec=sec, nsec=nsec), Clock(sec=wall_sec, nsec=wall_nsec)
        return encode_reply(self._dialect.shaped(reply))


class _ReplyTemplate:
    """The bytes of a reply, and where which number goes."""

    def __init__(self, marked: bytes, count: int) -> None:
        self._frame = np.frombuffer(bytearray(marked), np.uint8)
        # The eight bytes from each byte on as a word, so that one assignment writes all numbers.
        self._words: NDArray[np.uint64] = np.ndarray(len(marked) - 7, np.uint64, self._frame, strides=(1,))
        places = np.flatnonzero(self._frame[:-8] == _FLOAT64) + 1
        numbers = self._words[places].byteswap() - _MARK_BITS
        # Nothing else looks like a mark: this byte precedes none of a mark's first ones in text, which is UTF-8, nor
        # inside a mark.
        found = numbers < count
        self._places, self._order = places[found], numbers[found].astype(np.intp)

    def fill(self, numbers: NDArray[np.float64]) -> bytes:
        """Return the bytes with these numbers in place of the marks."""
        # Swapped before they are scattered, which takes longer for numbers of foreign byte order.
        self._words[self._places] = numbers[self._order].view(np.uint64).byteswap()
        return self._frame.tobytes()


def _arrays(data: mujoco.MjData) -> Sequence[NDArray[np.float64]]:
    """Return flat views of everything that an observation may show."""
    shown = (data.qpos, data.qvel, data.ctrl, data.act, data.sensordata, data.actuator_force, data.xpos, data.xquat)
    return [array.reshape(-1) for array in shown]
