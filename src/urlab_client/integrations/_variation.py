"""How a client's episodes vary: by its server, or by an environment through ops. Loads MuJoCo only where it is used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from urlab_client.aio.articulation import compiled_prefixes
from urlab_client.aio.client_types import ClientObserver
from urlab_client.aio.controllers import URLabPDController
from urlab_client.aio.model.layout import ArticulationLayout
from urlab_client.enums import ControllerKind
from urlab_client.randomise.declaration import Randomisation, UnsupportedRandomisation, Vary

if TYPE_CHECKING:
    import mujoco

    from urlab_client.aio.client import URLabClient
    from urlab_client.randomise.variation import EpisodeDraws, Variation


def server_variation(
    client: URLabClient, model: mujoco.MjModel, layouts: Mapping[str, ArticulationLayout]
) -> Variation | None:
    """Return how the server of a client varies its scene, or None if it does not."""
    from urlab_client.randomise.variation import Variation, declared_in

    declared = declared_in(model)
    if declared is None:
        return None
    return Variation(declared, model, controlled_actuators(client, layouts), compiled_prefixes(client.articulations))


def wire_variation(client: URLabClient) -> WireVariation | None:
    """Return what an environment varies by ops on this client, or None if no environment does."""
    return next((found for found in client.observers if isinstance(found, WireVariation)), None)


class WireVariation(ClientObserver):
    """Variation by ops around the reset that starts an episode, for a server that varies nothing itself.

    One of its client's observers, so that recordings, which see the client but not the environment, find it there.

    Attributes:
        declaration: What varies.
        draws: The values drawn for the current episode; None before the first.
        variation: The variation; it draws the same numbers as a server that varies its own scene.
    """

    def __init__(
        self,
        client: URLabClient,
        model: mujoco.MjModel,
        layouts: Mapping[str, ArticulationLayout],
        declared: Randomisation,
        earlier: WireVariation | None = None,
    ) -> None:
        """Look up what varies, and refuse what no op changes.

        `earlier` is the variation of an earlier session with the server, which may have left gravity and gains varied;
        if None, the current gravity and gains count as unvaried.
        """
        from urlab_client.randomise.quantities import START, elements_of
        from urlab_client.randomise.variation import Variation, field_of

        self.declaration = declared
        self.draws: EpisodeDraws | None = None
        controlled, prefixes = controlled_actuators(client, layouts), compiled_prefixes(client.articulations)

        def settable(vary: Vary) -> bool:
            if vary.what in ("kp", "kv"):
                return controlled.issuperset(elements_of(vary, model, controlled, prefixes).ids.tolist())
            return vary.what in START or vary.what == "gravity"

        refused = [vary.what for vary in declared.vary if not settable(vary)]
        if refused:
            raise UnsupportedRandomisation(tuple(dict.fromkeys(refused)), str(client.address))
        self.variation: Variation = (
            Variation(declared, model, controlled, prefixes) if earlier is None else earlier.variation
        )
        self._client = client
        if (before := wire_variation(client)) is not None:
            client.remove_observer(before)
        client.add_observer(self)
        self._fields: dict[str, NDArray[Any]] = {
            name: np.array(field_of(model, name)) for name in self.variation.fields
        }
        self._controllers: dict[str, tuple[URLabPDController, NDArray[np.intp]]] = {}
        self._gains: dict[str, dict[str, dict[str, float]]] = {}  # unvaried, by articulation, gain and actuator
        for key, articulation in client.articulations.items() if self.variation.varied_gains else ():
            controller = articulation.controller
            if isinstance(controller, URLabPDController):
                actuators = [layouts[key].actuators[name] for name in controller.kp]
                self._controllers[key] = controller, np.array(actuators, dtype=np.intp)
                self._gains[key] = {name: dict(controller.params[name]) for name in self.variation.varied_gains}
        if earlier is not None:
            self._gains |= earlier._gains  # noqa: SLF001  # its own class

    async def apply(self, draws: EpisodeDraws) -> None:
        """Set the quantities that a reset does not change: gravity, and the gains of controllers."""
        self.draws = draws
        self.variation.write(draws, self._fields.__getitem__)
        await self._set(draws)

    async def undo(self) -> None:
        """Restore gravity and gains if an episode has varied them."""
        self._client.remove_observer(self)
        if self.draws is not None:
            self.draws = None
            self.variation.restore(self._fields.__getitem__)
            await self._set(None)

    async def _set(self, draws: EpisodeDraws | None) -> None:
        if "opt.gravity" in self._fields:
            await self._client.runtime.set_sim_options(gravity=self._fields["opt.gravity"])
        for key, (controller, actuators) in self._controllers.items():
            gains = self._gains[key]
            if draws is not None:
                factors = self.variation.gain_factors(draws, actuators)
                gains = {
                    name: dict(zip(by, (np.array([*by.values()]) * factors[name]).tolist(), strict=True))
                    for name, by in gains.items()
                }
            await controller.set_gains(gains.get("kp"), gains.get("kv"))


def controlled_actuators(client: URLabClient, layouts: Mapping[str, ArticulationLayout]) -> frozenset[int]:
    """Return the model ids of the actuators that a controller with gains drives."""
    controlled: set[int] = set()
    for key, layout in layouts.items():
        controller = client.articulations[key].controller
        if controller is not None and controller.kind == ControllerKind.PD:
            controlled.update(layout.actuators[name] for name in controller.params["kp"])
    return frozenset(controlled)
