"""Cameras of a batch with latency, which show an earlier state, like a server's cameras."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from typing import Final

from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.cameras import CameraDelayInForce
from urlab_client.randomise.declaration import Randomisation
from urlab_client.simulation.cameras import Instant, Latency

_UNSEEN: Final = 0
"""Snapshot number; unused here."""


class LateCameras:
    """States recorded by the delayed cameras of all copies, one per action.

    Attributes:
        names: The delayed cameras.
    """

    def __init__(self, declared: Randomisation | None, cameras: Sequence[str]) -> None:
        """Look up the delayed cameras.

        Args:
            declared: The declaration. Its latencies name cameras by pattern; the last matching pattern applies.
            cameras: The observed cameras.
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
        """Begin an episode of a copy. Its cameras show the start without delay.

        Args:
            i: Index of the copy.
            seed: Seed of the jitter.
            state: State of the copy, an opaque array.
        """
        for name, settings in self._settings.items():
            self._latencies[name, i] = Latency(settings, seed)
            self._shown[name, i] = state

    def shown(self, name: str, i: int, time: float, state: Floats) -> Floats:
        """Record the state of a copy for a camera, and return the state that the camera shows now.

        Args:
            name: Name of the camera.
            i: Index of the copy.
            time: Simulation time of the copy, seconds.
            state: State of the copy.
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
