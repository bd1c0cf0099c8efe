"""From staged set-points to `mjData.ctrl`, one articulation at a time.

For the engine, which applies them before every sub-step, and for the op handlers, which stage and configure. Nothing
here locks or steps: the caller holds the engine's lock.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import mujoco
import numpy as np

from urlab_client._mujoco import contiguous
from urlab_client.server.compile.scene_index import ArticulationIndex
from urlab_client.simulation.controller_config import ControllerConfig
from urlab_client.simulation.controllers import (
    Actuated,
    Controller,
    Float32s,
    Float64s,
    attach_controller,
    first_controls,
    float32,
    float32_array,
)


class ControlSource(StrEnum):
    """Whose set-points reach the actuators."""

    ZMQ = "zmq"
    UI = "ui"


class SetPoints:
    """Staged set-points of one articulation, one number per control; they persist until overwritten.

    Attributes:
        network: Written by `step` and the control topic, shape (n controls,).
        ui: Written by the application that embeds the server; no op writes them, shape (n controls,).
        source: Which of the two is applied.
    """

    __slots__ = ("_places", "network", "source", "ui")

    network: Float32s | Float64s
    ui: Float32s | Float64s
    source: ControlSource

    def __init__(self, neutral: Sequence[float] | Float64s, places: Mapping[str, int], *, exact: bool = False) -> None:
        """Start from neutral controls.

        Args:
            neutral: Controls after a reset, in the articulation's order, shape (n controls,).
            places: Short and compiled actuator names to the position of the actuator's first control.
            exact: Keep what is staged by position as it is; else everything is rounded to float32.
        """
        self.network = np.array(neutral, dtype=np.float64) if exact else float32_array(neutral).copy()
        self.ui = self.network.copy()
        self.source = ControlSource.ZMQ
        folded: dict[str, int] = {}
        for name, place in places.items():
            folded.setdefault(name.casefold(), place)
        self._places = {**folded, **places}

    @property
    def selected(self) -> Float32s | Float64s:
        return self.network if self.source is ControlSource.ZMQ else self.ui

    def stage(self, values: Sequence[float] | Float64s) -> None:
        """Stage network set-points by position; surplus ones are ignored, missing ones keep their value.

        Numbers beyond the range of float32 become infinite, as in C; the caller keeps NumPy from warning of that.
        """
        if len(values) == len(self.network):
            self.network[:] = values
        else:
            count = min(len(values), len(self.network))
            self.network[:count] = values[:count]

    def stage_named(self, values: Mapping[str, float]) -> None:
        """Stage network set-points by short or compiled actuator name; unknown names are ignored.

        A name stands for the actuator's first control; the further ones of a multi-input actuator have positions only.
        """
        places = self._places
        for name, value in values.items():
            place = places.get(name)
            if place is None:
                place = places.get(name.casefold())
            if place is not None:
                self.network[place] = float32(value)


@dataclass(slots=True)
class Twist:
    """Commanded base velocity, stored and reported only; nothing in the simulation reads it.

    Attributes:
        vx: Forward velocity, m/s, base frame.
        vy: Leftward velocity, m/s, base frame.
        yaw_rate: rad/s, base frame.
        actions: Bit field of pressed action keys, bits 0 to 9.
    """

    vx: float = 0.0
    vy: float = 0.0
    yaw_rate: float = 0.0
    actions: int = 0

    def set(self, linear: Sequence[float], angular: Sequence[float]) -> None:
        """Store `linear[0]`, `linear[1]` (m/s) and `angular[2]` (rad/s) as float32; missing elements are 0."""
        self.vx = float32(linear[0]) if len(linear) > 0 else 0.0
        self.vy = float32(linear[1]) if len(linear) > 1 else 0.0
        self.yaw_rate = float32(angular[2]) if len(angular) > 2 else 0.0

    @property
    def linear(self) -> tuple[float, float, float]:
        """(vx, vy, 0), m/s."""
        return (self.vx, self.vy, 0.0)

    @property
    def angular(self) -> tuple[float, float, float]:
        """(0, 0, yaw rate), rad/s."""
        return (0.0, 0.0, self.yaw_rate)


class ArticulationControl:
    """Everything that is commanded about one articulation: set-points, controller and twist.

    Attributes:
        index: Where the articulation lives in the model.
        set_points: Its staged set-points.
        controller: Its controller, or None.
        twist: Its commanded twist.
    """

    index: ArticulationIndex
    set_points: SetPoints
    controller: Controller | None
    twist: Twist

    def __init__(
        self,
        model: mujoco.MjModel,
        index: ArticulationIndex,
        neutral: Float64s,
        config: ControllerConfig | None = None,
        *,
        exact: bool = False,
    ) -> None:
        """Bind to a compiled model.

        Args:
            neutral: `mjData.ctrl` of the whole model after a reset, shape (nu,).
        """
        self.index = index
        places: dict[str, int] = {}
        for name, place in zip(index.actuator_names, first_controls(model, index.actuators).tolist(), strict=True):
            places[f"{index.prefix}{name}"] = place
        places.update({name: places[f"{index.prefix}{name}"] for name in index.actuator_names})
        self._ctrl_places = contiguous(index.ctrl_adr.astype(np.intp))
        self.set_points = SetPoints(neutral[self._ctrl_places], places, exact=exact)
        actuated = Actuated(index.actuators, index.actuator_names, index.ctrl_adr)
        self.controller = None if config is None else attach_controller(model, actuated, config)
        self.twist = Twist()

    def controlled(self, *, raw: bool = False) -> bool:
        """Whether a controller decides the controls, unless the request is `raw`."""
        return not raw and self.controller is not None and self.controller.active

    def apply(self, qpos: Float64s, qvel: Float64s, ctrl: Float64s, *, raw: bool = False) -> None:
        """Write the articulation's entries of `ctrl` (shape (nu,)) for the state `qpos`, `qvel`.

        Args:
            qpos: `mjData.qpos`, shape (nq,).
            qvel: `mjData.qvel`, shape (nv,).
            ctrl: `mjData.ctrl`, written in place, not clamped to `ctrlrange`.
        """
        controller = self.controller
        if controller is not None and controller.active and not raw:
            controller.write(self.set_points.selected, qpos, qvel, ctrl)
        else:
            ctrl[self._ctrl_places] = self.set_points.selected
