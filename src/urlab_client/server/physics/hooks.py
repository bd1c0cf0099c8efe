"""Functions that physics calls at each sub-step or tick."""

from __future__ import annotations

import logging
from collections.abc import Callable

__all__ = ["Hook", "call_hooks"]

logger = logging.getLogger("urlab_client.server")

Hook = Callable[[], None]


def call_hooks(hooks: list[Hook]) -> None:
    """Call each; one that raises is logged and removed."""
    for hook in tuple(hooks):
        try:
            hook()
        except Exception:
            logger.exception("%r failed and is not called again", hook)
            if hook in hooks:
                hooks.remove(hook)
