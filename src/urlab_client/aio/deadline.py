"""The `timeout` parameter of every op."""

from __future__ import annotations

import enum
from typing import Final, Literal, TypeAlias


class Default(enum.Enum):
    """Type of `DEFAULT`."""

    DEFAULT = "default"


DEFAULT: Final = Default.DEFAULT
"""Use the default timeout of the op or the client."""

Timeout: TypeAlias = float | Literal[Default.DEFAULT] | None
"""Seconds for queueing, sending and receiving the reply together; None waits without limit."""
