"""Ports at which a server can be started again."""

from __future__ import annotations

import contextlib
import os
import random
import socket

__all__ = ["free_port", "free_ports"]


# Each test process has its own, and none that the system gives to whoever asks for any.
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
_OWN = range(20_000 + _WORKER, 32_000, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))
_UNTRIED = iter(random.SystemRandom().sample(_OWN, len(_OWN)))


def free_port() -> int:
    """Return one that is free, another one each time."""
    return next(filter(_is_free, _UNTRIED))


def _is_free(port: int) -> bool:
    with socket.socket() as taken, contextlib.suppress(OSError):
        taken.bind(("127.0.0.1", port))
        return True
    return False


def free_ports() -> dict[str, int]:
    """Return all options of a simulated server that name ports."""
    return {f"{name}_port": free_port() for name in ("step", "state", "ctrl", "info", "camera")}
