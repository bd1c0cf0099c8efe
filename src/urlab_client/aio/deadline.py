"""How long a call may take: the `timeout` parameter that every op shares."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import Final, Literal, TypeAlias

from urlab_client.aio.event_loop import running_loop

__all__ = ["DEFAULT", "Default", "Timeout", "shared"]


class Default(enum.Enum):
    """Type of `DEFAULT`."""

    DEFAULT = "default"


DEFAULT: Final = Default.DEFAULT
"""Leave the deadline to the op and the client."""

Timeout: TypeAlias = float | Literal[Default.DEFAULT] | None
"""Seconds for queueing, sending and the reply together; None waits without limit."""


def shared(timeout: Timeout) -> Callable[[], Timeout]:
    """Return what tells how much of `timeout` is left from now on: one limit for several requests in a row.

    The default and None stand for each request by itself.
    """
    if timeout is DEFAULT or timeout is None:
        return lambda: timeout
    loop = running_loop()
    end = loop.time() + timeout
    return lambda: max(0.0, end - loop.time())
