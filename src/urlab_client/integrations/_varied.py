"""Variation from episode to episode, as seen by the client."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from urlab_client.aio.model.layout import ArticulationLayout
from urlab_client.protocol.enums import ControllerKind

if TYPE_CHECKING:
    import mujoco

    from urlab_client.aio.client import URLabClient
    from urlab_client.randomise.declaration import Randomisation
    from urlab_client.randomise.variation import EpisodeDraws, Variation

__all__ = ["OVER_WIRE", "VariedOverWire", "controlled_actuators", "variation_of"]


@dataclass(eq=False)
class VariedOverWire:
    """What an environment varies by ops, on a server that varies nothing itself.

    Attributes:
        declaration: What varies.
        draws: The values drawn for the current episode; None before the first.
    """

    declaration: Randomisation
    draws: EpisodeDraws | None = None


OVER_WIRE: WeakKeyDictionary[URLabClient, VariedOverWire] = WeakKeyDictionary()
"""Variation by ops, by client. Recordings use it, because they see the client but not the environment."""


def variation_of(
    client: URLabClient, model: mujoco.MjModel, layouts: Mapping[str, ArticulationLayout]
) -> Variation | None:
    """Return how the server varies its scene, or None if it does not.

    Args:
        client: The client, after the handshake.
        model: The client's model.
        layouts: Layouts of the articulations in the model, by key.
    """
    from urlab_client.randomise.variation import Variation, declared_in  # noqa: PLC0415

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
