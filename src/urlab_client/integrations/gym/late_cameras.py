"""Cameras of a batch that show what they saw some time ago, as a server's do."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from typing import Final

from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.cameras import CameraDelayInForce
from urlab_client.randomise.declaration import Randomisation
from urlab_client.server.render.latency import Instant, Latency

__all__ = ["LateCameras"]

_UNSEEN: Final = 0
"""Number of a snapshot, which nobody asks for here."""


class LateCameras:
    """What the delayed cameras of all copies have seen. Each action is a moment at which they see.

    Attributes:
        names: The cameras that are delayed.
    """

    def __init__(self, declared: Randomisation | None, cameras: Sequence[str]) -> None:
        """Look up what is delayed.

        Args:
            declared: What varies; its latencies go by patterns, of which the last that fits counts.
            cameras: Cameras that are observed.
        """
        self._settings = {
            name: CameraDelayInForce(
                delay_s=late.delay_s, jitter_s=late.jitter_s, clock="sim", on_state_change=True, max_fps=0.0
            )
            for late in (() if declared is None else declared.camera)
            for name in cameras
            if fnmatch.fnmatchcase(name, late.camera)
        }
        self.names: tuple[str, ...] = tuple(self._settings)
        self._latencies: dict[tuple[str, int], Latency] = {}
        self._shown: dict[tuple[str, int], Floats] = {}

    def begin(self, i: int, seed: int, state: Floats) -> None:
        """Begin an episode of a copy, whose cameras see its start at once.

        Args:
            i: The copy.
            seed: Seed of the jitter.
            state: Its state, as numbers of any meaning.
        """
        for name, settings in self._settings.items():
            self._latencies[name, i] = Latency(settings, seed)
            self._shown[name, i] = state

    def shown(self, name: str, i: int, time: float, state: Floats) -> Floats:
        """Let a camera see the state of a copy, and return the state that it shows.

        Args:
            name: The camera.
            i: The copy.
            time: Its simulation time, seconds.
            state: Its state.
        """
        latency, now = self._latencies[name, i], Instant(time, 0.0)
        if not latency.withholds:
            return state
        if not latency.skips(now):
            latency.see(_UNSEEN, now, 0.0, state)
        seen = latency.revealed(now)
        if seen is not None:
            self._shown[name, i] = seen.state
        return self._shown[name, i]
