"""How long a call may take: the `timeout` parameter that every op shares."""

from __future__ import annotations

import enum
from typing import Final, Literal, TypeAlias

__all__ = ["DEFAULT", "Default", "Timeout"]


class Default(enum.Enum):
    """Type of `DEFAULT`."""

    DEFAULT = "default"


DEFAULT: Final = Default.DEFAULT
"""Leave the deadline to the op and the client."""

Timeout: TypeAlias = float | Literal[Default.DEFAULT] | None
"""Seconds for queueing, sending and the reply together; None waits without limit."""
