"""How a client's episodes vary: by its server, or by an environment through ops."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from urlab_client.aio.client_types import ClientObserver
from urlab_client.aio.model.layout import ArticulationLayout
from urlab_client.enums import ControllerKind

if TYPE_CHECKING:
    import mujoco

    from urlab_client.aio.client import URLabClient
    from urlab_client.randomise.declaration import Randomisation
    from urlab_client.randomise.variation import EpisodeDraws, Variation


class VariedByOps(ClientObserver):
    """What an environment varies by ops, on a server that varies nothing itself.

    One of its client's observers, so that recordings, which see the client but not the environment, find it there.

    Attributes:
        declaration: What varies.
        draws: The values drawn for the current episode; None before the first.
    """

    def __init__(self, declaration: Randomisation) -> None:
        self.declaration = declaration
        self.draws: EpisodeDraws | None = None


def varied_by_ops(client: URLabClient) -> VariedByOps | None:
    """Return what an environment varies by ops on this client, or None if no environment does."""
    return next((found for found in client.observers if isinstance(found, VariedByOps)), None)


def variation_of(
    client: URLabClient, model: mujoco.MjModel, layouts: Mapping[str, ArticulationLayout]
) -> Variation | None:
    """Return how the server varies its scene, or None if it does not.

    Args:
        client: The client, after the handshake.
        model: The client's model.
        layouts: Layouts of the articulations in the model, by key.
    """
    from urlab_client.randomise.variation import Variation, declared_in

    declared = declared_in(model)
    if declared is None:
        return None
    return Variation(declared, model, controlled_actuators(client, layouts))


def controlled_actuators(client: URLabClient, layouts: Mapping[str, ArticulationLayout]) -> frozenset[int]:
    """Return the model ids of the actuators that a controller with gains drives.

    Args:
        client: The client, after the handshake.
        layouts: Layouts of the articulations in the model, by key.
    """
    controlled: set[int] = set()
    for key, articulation in client.articulations.items():
        controller = articulation.controller
        if controller is not None and controller.kind == ControllerKind.PD:
            actuators = layouts[key].actuators
            controlled.update(actuators[name] for name in controller.params["kp"])
    return frozenset(controlled)
