"""Advancing a scene's data with MuJoCo, in slices short enough to stop between two of them."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Container
from dataclasses import dataclass, field
from typing import Final

import mujoco

from urlab_client.protocol.messages.session import Step
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.physics.articulations import Articulations
from urlab_client.server.physics.controllers import ArticulationControl
from urlab_client.server.physics.scheduling import MujocoCall, shutting_down

SLICE_S: Final = 0.05
"""About how long a direct request integrates between two looks at the stop flag."""

MAX_SLICE: Final = 1000
"""Sub-steps in such a slice at most, for models that get slower while they run."""

logger: logging.Logger = logging.getLogger("urlab_client.server")

Hook = Callable[[], None]


def call_hooks(hooks: list[Hook]) -> None:
    """Call each hook; one that raises is logged and removed."""
    for hook in tuple(hooks):
        try:
            hook()
        except Exception:
            logger.exception("%r failed and will not be called again", hook)
            if hook in hooks:
                hooks.remove(hook)


@dataclass(eq=False)
class Snapshots:
    """Numbers the snapshots of the state.

    Attributes:
        number: Number of the newest snapshot.
        episode: Number of resets so far.
        hooks: Called for each snapshot and at each reset. One that raises is logged and removed.
    """

    number: int = 0
    episode: int = 0
    hooks: list[Hook] = field(default_factory=list[Hook])

    def take(self) -> None:
        self.number += 1
        call_hooks(self.hooks)

    def restart(self) -> None:
        self.episode += 1
        call_hooks(self.hooks)


class Integrator:
    """Calls MuJoCo for the engine, under its lock.

    Attributes:
        substep_s: What a sub-step of the newest slice took, seconds; infinite before the first.
        on_substep: Called after each sub-step. A hook that raises is logged and removed.
    """

    def __init__(
        self,
        scene: CompiledScene,
        articulations: Articulations,
        call: MujocoCall,
        stopping: Callable[[], bool],
    ) -> None:
        self._model = scene.model
        self._data = scene.data
        self._articulations = articulations
        self._call = call
        self._stopping = stopping
        self.substep_s: float = math.inf
        self.on_substep: list[Hook] = []

    def advance(self, n_steps: int, raw: Container[ArticulationControl]) -> None:
        """Integrate a direct step.

        Args:
            raw: Articulations whose controller has no say.
        """
        mj_step, model, data = mujoco.mj_step, self._model, self._data
        apply_controls = self._articulations.apply_controls
        every_substep = self.on_substep or self._articulations.any_controlled(raw)
        if not every_substep:
            apply_controls(raw)
        while n_steps > 0:
            if self._stopping():
                raise shutting_down()
            count = min(n_steps, MAX_SLICE, max(1, int(SLICE_S / self.substep_s)))
            started = time.perf_counter()
            with self._call:
                if every_substep:
                    for _ in range(count):
                        apply_controls(raw)
                        mj_step(model, data)
                        call_hooks(self.on_substep)
                else:
                    mj_step(model, data, count)
            self.substep_s = max((time.perf_counter() - started) / count, 1e-9)
            n_steps -= count

    def advance_live(self) -> None:
        with self._call:
            mujoco.mj_step(self._model, self._data)
            call_hooks(self.on_substep)

    def push(self, state: Step) -> None:
        """Write the state of a puppet step, but for arrays of a wrong length, and compute what follows."""
        data = self._data
        for values, target in ((state.qpos, data.qpos), (state.qvel, data.qvel), (state.ctrl, data.ctrl)):
            if values is not None and len(values) == len(target):
                target[:] = values
        data.time = state.time or 0.0
        self.forward()

    def forward(self) -> None:
        with self._call:
            mujoco.mj_forward(self._model, self._data)
