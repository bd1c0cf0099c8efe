"""Commands that arrive on the control socket, and the actuators they are for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final, TypeAlias

import mujoco
import numpy as np

from urlab_client._mujoco import actuator_count, control_counts, control_starts
from urlab_client.server.physics.controllers import ArticulationControl
from urlab_client.server.streams.control_messages import (
    ActuatorInfo,
    CameraEndpoint,
    ControlPayload,
    JointGains,
    decode_gains,
)

NO_LIMIT: Final = 100.0
"""Control range of an actuator without one."""


class Actuators:
    """The actuators of all articulations by their ids in the model."""

    def __init__(self, model: mujoco.MjModel, controls: Iterable[ArticulationControl]) -> None:
        self._model = model
        self._controls = list(controls)
        self._owner = np.full(actuator_count(model), -1, dtype=np.intp)
        self._place = np.zeros(actuator_count(model), dtype=np.intp)
        for number, control in enumerate(self._controls):
            actuators = control.index.actuators
            widths = control_counts(model)[actuators]
            self._owner[actuators] = number
            self._place[actuators] = np.cumsum(widths) - widths

    def stage(self, command: ControlPayload, owned: Callable[[ArticulationControl], bool]) -> None:
        """Store set-points. Unknown ids are ignored; an actuator with several inputs gets its first.

        Args:
            owned: Returns whether an articulation is owned by a client that drives it by requests; its set-points are
                ignored, too.
        """
        known = (command.actuator_ids >= 0) & (command.actuator_ids < len(self._owner))
        ids, values = command.actuator_ids[known], command.values[known]
        owners = self._owner[ids]
        for number, control in enumerate(self._controls):
            mine = owners == number
            if mine.any() and not owned(control):
                control.set_points.network[self._place[ids[mine]]] = values[mine]

    def info(self, control: ArticulationControl, cameras: tuple[CameraEndpoint, ...]) -> ActuatorInfo:
        """Return the info message of an articulation."""
        model, index = self._model, control.index
        first = control_starts(model)[index.actuators]
        limited = model.actuator_ctrllimited[first].astype(bool)
        ranges = model.actuator_ctrlrange[first].astype(np.float32).astype(np.float64)
        return ActuatorInfo(
            robot=index.key,
            names=tuple(f"{index.prefix}{name}" for name in index.actuator_names),
            ids=index.actuators,
            mins=np.where(limited, ranges[:, 0], -NO_LIMIT),
            maxs=np.where(limited, ranges[:, 1], NO_LIMIT),
            cameras=cameras,
        )


StreamedCommand: TypeAlias = ControlPayload | tuple[str, dict[str, JointGains]]


def read_commands(frames: list[bytes]) -> Iterator[StreamedCommand]:
    """Read a message of the control socket; a frame without a partner is ignored.

    Raises:
        ProtocolError: A payload is malformed.
    """
    for topic, payload in zip(frames[::2], frames[1::2], strict=False):
        owner, is_gains, _ = topic.partition(b"/set_gains")
        where = topic.decode(errors="replace")
        yield (owner.decode(), decode_gains(payload, where)) if is_gains else ControlPayload.decode(payload, where)
