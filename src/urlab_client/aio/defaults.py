"""Defaults that stand for a value chosen elsewhere: by the op, the client or `discover()`."""

from __future__ import annotations

import enum
from typing import Final, Literal, TypeAlias

from urlab_client.enums import ObservationLevel


class Default(enum.Enum):
    """Type of `DEFAULT`."""

    DEFAULT = "default"

    def __repr__(self) -> str:  # shown by help() and inspect.signature(), where a program could write it, too
        return self.name


DEFAULT: Final = Default.DEFAULT
"""Use the default timeout of the op or the client."""

Timeout: TypeAlias = float | Literal[Default.DEFAULT] | None
"""Seconds for queueing, sending and receiving the reply together; None waits without limit."""


class SessionLevel(enum.Enum):
    """Type of `SESSION_LEVEL`. Its value is the level of a session that was opened without naming one."""

    SESSION_LEVEL = ObservationLevel.STANDARD

    def __repr__(self) -> str:  # shown as the default by help() and inspect.signature()
        return f"{self.value.value!r} or as chosen in discover()"


SESSION_LEVEL: Final = SessionLevel.SESSION_LEVEL
"""The level chosen in `discover()`, by default `standard`."""
