"""Servers that are kept from one test to the next."""

from __future__ import annotations

from urlab_client.enums import StepMode
from urlab_client.server import SimulatedServer

__all__ = ["rest"]


def rest(server: SimulatedServer) -> None:
    """Let physics wait for steps: in live mode it goes on in real time, or publishes what does not change."""
    running = server._running.core.play.current
    if running is not None and running.engine.pinned_mode is None:
        running.engine.set_mode(StepMode.DIRECT)
