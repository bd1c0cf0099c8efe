"""Variation of the model and the start of episodes, from the seeds of resets. The caller holds the engine's lock."""

from __future__ import annotations

import copy
from functools import partial

import mujoco
import numpy as np

from urlab_client._mujoco import saved_model
from urlab_client.randomise.declaration import Randomisation
from urlab_client.randomise.variation import EpisodeDraws, Variation, field_of
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.physics.articulations import Articulations
from urlab_client.simulation.controllers import PDController
from urlab_client.values.names import robot_prefixes


class SceneVariation:
    """Varies a scene's model in place.

    Attributes:
        draws: The numbers of the episode; None before the first reset, when nothing is varied.
    """

    def __init__(self, scene: CompiledScene, declaration: Randomisation, articulations: Articulations) -> None:
        """Look up what varies, including the gains of the articulations' controllers. Nothing is varied yet.

        Raises:
            ValueError: A name matches no element.
        """
        self.draws: EpisodeDraws | None = None
        self._scene = scene
        found = (control.controller for control in articulations.controls.values())
        self._controllers = [controller for controller in found if isinstance(controller, PDController)]
        controlled = frozenset(int(i) for controller in self._controllers for i in controller.bound_actuators)
        robots = [(name, control.index) for name, control in articulations.controls.items()]
        prefixes = robot_prefixes((name, index.actor_id, index.key) for name, index in robots)
        self._variation = Variation(declaration, scene.model, controlled, prefixes)
        self._following = np.random.default_rng(0)

    @property
    def visible_fields(self) -> tuple[str, ...]:
        return self._variation.visible_fields

    def begin(self, seed: int | None) -> None:
        """Write the model of the next episode. The data must be reset afterwards: they are used for this.

        Args:
            seed: The episode's seed; None for one that follows from the last one given.
        """
        if seed is None:
            seed = int(self._following.integers(2**63))
        else:
            seed %= 2**64  # generators take no negative seeds
            self._following = np.random.default_rng(seed)
        self.draws = draws = self._variation.draw(seed)
        self._variation.write(draws, partial(field_of, self._scene.model))
        if self._variation.derives:
            mujoco.mj_setConst(self._scene.model, self._scene.data)
        for controller in self._controllers:
            controller.factors = self._variation.gain_factors(draws, controller.bound_actuators)

    def start(self) -> None:
        if self.draws is not None:
            self._variation.start(self.draws, self._scene.data.qpos, self._scene.data.qvel)

    def restore(self) -> None:
        if self.draws is not None:
            self.draws = None
            self._restore(self._scene.model)

    def mjb(self) -> bytes:
        """Return the model as it is without variation, in MuJoCo's binary format."""
        if self.draws is None:
            return self._scene.mjb()
        model = copy.copy(self._scene.model)
        self._restore(model)
        return saved_model(model)

    def _restore(self, model: mujoco.MjModel) -> None:
        self._variation.restore(partial(field_of, model))
        if self._variation.derives:
            mujoco.mj_setConst(model, mujoco.MjData(model))
