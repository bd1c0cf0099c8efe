"""Another model and start for each episode, by the seed of its reset.

For the engine, which begins an episode with each reset, and for the handshake, which tells of the model without
variation. The caller holds the engine's lock.
"""

from __future__ import annotations

import copy
from functools import partial

import mujoco
import numpy as np

from urlab_client.randomise.declaration import Randomisation
from urlab_client.randomise.variation import EpisodeDraws, Variation, field_of
from urlab_client.server.compile.scene import CompiledScene, saved_model
from urlab_client.server.physics.articulations import Articulations
from urlab_client.simulation.controllers import PDController


class SceneVariation:
    """Varies a scene's model in place.

    Attributes:
        draws: The numbers of the episode; None before the first reset, when nothing is varied.
    """

    def __init__(self, scene: CompiledScene, declaration: Randomisation, articulations: Articulations) -> None:
        """Look up what varies; nothing is varied yet.

        Args:
            scene: The scene as compiled.
            declaration: What to vary.
            articulations: Their controllers' gains vary, too.

        Raises:
            ValueError: A name fits no element.
        """
        self.draws: EpisodeDraws | None = None
        self._scene = scene
        self._controllers = [
            control.controller
            for control in articulations.controls.values()
            if isinstance(control.controller, PDController)
        ]
        controlled = frozenset(int(i) for controller in self._controllers for i in controller.bound_actuators)
        self._variation = Variation(declaration, scene.model, controlled)
        self._field = partial(field_of, scene.model)
        self._following = np.random.default_rng(0)

    @property
    def visible_fields(self) -> tuple[str, ...]:
        """Varied fields of the model that pictures depend on."""
        return self._variation.visible_fields

    def begin(self, seed: int | None) -> None:
        """Write the model of the next episode; the data, which are used for it, have to be reset after that.

        Args:
            seed: The episode's seed; None for one that follows from the last one given.
        """
        if seed is None:
            seed = int(self._following.integers(2**63))
        else:
            seed %= 2**64  # generators take no negative seeds
            self._following = np.random.default_rng(seed)
        self.draws = draws = self._variation.draw(seed)
        self._variation.write(draws, self._field)
        if self._variation.derives:
            mujoco.mj_setConst(self._scene.model, self._scene.data)
        for controller in self._controllers:
            controller.factors = self._variation.gain_factors(draws, controller.bound_actuators)

    def start(self) -> None:
        """Vary where the episode starts, after the reset."""
        if self.draws is not None:
            self._variation.start(self.draws, self._scene.data.qpos)

    def restore(self) -> None:
        """Write the model as it is without variation."""
        if self.draws is not None:
            self.draws = None
            self._variation.restore(self._field)
            if self._variation.derives:
                mujoco.mj_setConst(self._scene.model, mujoco.MjData(self._scene.model))

    def mjb(self) -> bytes:
        """Return the model as it is without variation, in MuJoCo's binary format."""
        if self.draws is None:
            return self._scene.mjb()
        model = copy.copy(self._scene.model)
        self._variation.restore(partial(field_of, model))
        if self._variation.derives:
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return saved_model(model)
