"""Variation of the model per copy of a batch and per episode, equal to the variation of a server's scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.protocol.base import Floats
from urlab_client.randomise.declaration import Randomisation
from urlab_client.randomise.variation import EpisodeDraws, Variation
from urlab_client.simulation.controllers import Controller, PDController

Indices = NDArray[np.intp]


class BatchVariation:
    """What varies in the copies of a batch.

    Args:
        declaration: The declaration.
        model: The compiled scene, without variation.
        batch: The batch that steps the copies: a `mujoco.batch.Batch` or its substitute.
        nsim: Number of copies.
        controllers: Controllers by articulation.

    Raises:
        ValueError: A name matches no element.
    """

    def __init__(
        self,
        declaration: Randomisation,
        model: mujoco.MjModel,
        batch: Any,
        nsim: int,
        controllers: Mapping[str, Controller],
    ) -> None:
        self._pd = {key: found for key, found in controllers.items() if isinstance(found, PDController)}
        controlled = frozenset(int(i) for found in self._pd.values() for i in found.bound_actuators)
        self._variation = Variation(declaration, model, controlled)
        self._batch = batch
        self._fields: dict[str, NDArray[Any]] = {name: batch.expand(name) for name in self._variation.fields}
        self._visible: dict[str, NDArray[Any]] = {name: batch.expand(name) for name in self._variation.visible_fields}
        self._factors: dict[str, dict[str, NDArray[np.float32]]] = {}
        for key, found in self._pd.items():
            shape = (nsim, len(found.bound_actuators))
            self._factors[key] = {name: np.ones(shape, dtype=np.float32) for name in self._variation.varied_gains}
        self.draws: list[EpisodeDraws | None] = [None] * nsim

    def begin(self, indices: Indices, seeds: NDArray[np.int64]) -> None:
        """Write the models for the next episodes of some copies, which must then be reset.

        Args:
            indices: The copies.
            seeds: Seeds of the episodes of all copies.
        """
        for i in map(int, indices):
            draws = self.draws[i] = self._variation.draw(int(seeds[i]))

            def field(name: str, i: int = i) -> NDArray[Any]:
                return self._fields[name][i]

            self._variation.write(draws, field)
            for key, found in self._pd.items():
                for name, factors in self._variation.gain_factors(draws, found.bound_actuators).items():
                    self._factors[key][name][i] = factors
        if self._variation.derives:
            self._batch.set_const(indices)

    def start(self, i: int, qpos: Floats) -> None:
        """Vary the start positions of a copy's episode in place, shape (nq,)."""
        draws = self.draws[i]
        if draws is not None:
            self._variation.start(draws, qpos)

    def use_factors(self, key: str, indices: Indices) -> None:
        """Set the gain factors of some copies in the controller of an articulation."""
        found = self._pd.get(key)
        if found is not None:
            found.factors = {name: factors[indices] for name, factors in self._factors[key].items()}

    def look(self, i: int) -> dict[str, NDArray[Any]]:
        """Return the varying fields of a copy's model that affect pictures, by name."""
        return {name: values[i].copy() for name, values in self._visible.items()}
