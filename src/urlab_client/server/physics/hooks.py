"""Who is told of each step, and the numbers of the states."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

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
