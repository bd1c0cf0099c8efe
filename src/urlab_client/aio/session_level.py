"""The default of `step(observations=…)`: the level chosen in `discover()`."""

from __future__ import annotations

import enum
from typing import Final

from urlab_client.enums import ObservationLevel


class SessionLevel(enum.Enum):
    """Type of `SESSION_LEVEL`. Its value is the level of a session that was opened without naming one."""

    SESSION_LEVEL = ObservationLevel.STANDARD

    def __repr__(self) -> str:  # shown as the default by help() and inspect.signature()
        return f"{self.value.value!r} or as chosen in discover()"


SESSION_LEVEL: Final = SessionLevel.SESSION_LEVEL
"""The level chosen in `discover()`, by default `standard`."""
