"""Cameras of a scene, and their latency.

A delayed camera keeps past states of the simulation rather than pictures. Its frames therefore have the right age
however rarely somebody asks, and only requested frames are drawn.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from urlab_client.protocol.messages.cameras import CameraDelayInForce
from urlab_client.protocol.messages.session import CameraFrame

DEFAULT_CAMERA_SIZE: Final = (640, 480)

CAPACITY: Final = 1000
"""Approximate number of past states kept per camera; at higher rates, states are skipped."""

_SLACK_S: Final = 1e-6  # sums of timesteps are not exact


@dataclass(frozen=True, kw_only=True)
class SceneCamera:
    """A camera of an articulation.

    Attributes:
        name: Short name.
        id: Camera id in the model.
        mode: What its pixels mean: `real`, `depth`, `semantic` or `instance`.
        resolution: Width and height, pixels.
        fovy: Vertical field of view, degrees.
    """

    name: str
    id: int
    mode: str = "real"
    resolution: tuple[int, int] = DEFAULT_CAMERA_SIZE
    fovy: float = 45.0


class Instant(NamedTuple):
    """A moment.

    Attributes:
        sim: Simulation time, seconds.
        wall: Monotonic time, seconds.
    """

    sim: float
    wall: float


@dataclass(eq=False)
class Past:
    """A state that a camera saw.

    Attributes:
        frame_id: Number of its snapshot.
        at: Time of the state on the camera's clock, seconds.
        deviation: Its share of the camera's jitter, -1 to 1.
        captured: The same as Unix seconds.
        state: The state, as `mj_getState` gives it.
        frame: Its picture, once it is drawn.
    """

    frame_id: int
    at: float
    deviation: float
    captured: float
    state: NDArray[np.float64]
    frame: CameraFrame | None = None


class Latency:
    """The latency of one camera, and the states that it has seen but may not have shown yet.

    Attributes:
        settings: The requested latency.
        withholds: Whether the camera shows past states instead of the current one.
        past: States that it shows now or later, oldest first.
    """

    def __init__(self, settings: CameraDelayInForce, seed: int, before: Latency | None = None) -> None:
        """Start to delay.

        Args:
            settings: The requested latency; its numbers are finite and not negative.
            seed: Seed of the jitter.
            before: The camera's latency until now; what the camera has seen is kept if the clock stays.
        """
        self.settings = settings
        self._random = random.Random(seed)  # noqa: S311 - nothing depends on its being hard to guess
        longest = settings.delay_s + settings.jitter_s
        self._spacing = max(longest / CAPACITY, 1.0 / settings.max_fps if settings.max_fps else 0.0)
        self.withholds: bool = self._spacing > 0.0
        keep = before is not None and self.withholds and before.settings.clock == settings.clock
        self.past: deque[Past] = before.past if before is not None and keep else deque()

    def skips(self, now: Instant) -> bool:
        """Return whether the current state follows the last one too closely to be kept."""
        return bool(self.past) and 0.0 < self._at(now) - self.past[-1].at < self._spacing - _SLACK_S

    def forget(self) -> None:
        """Forget what the camera saw before a reset, after which the simulation's clock starts anew."""
        if self.settings.clock == "sim":
            self.past.clear()

    def see(self, frame_id: int, now: Instant, captured: float, state: NDArray[np.float64]) -> None:
        """Keep a state, and forget those that will no longer be shown.

        Args:
            frame_id: Number of its snapshot.
            now: Its moment; not one that `skips`.
            captured: The same as Unix seconds.
            state: The state.
        """
        at, past = self._at(now), self.past
        if past and at < past[-1].at:
            past.clear()  # time was set back: later states have not happened
        if past and at == past[-1].at:
            past.pop()
        past.append(Past(frame_id, at, self._random.uniform(-1.0, 1.0), captured, state))
        while len(past) > 1 and self._is_due(past[1], at):
            past.popleft()

    def revealed(self, now: Instant) -> Past | None:
        """Return the newest state that the camera may show, if there is any."""
        at, past = self._at(now), self.past
        if not past or at < past[-1].at:
            return None
        return next((seen for seen in reversed(past) if self._is_due(seen, at)), None)

    def _at(self, now: Instant) -> float:
        return now.sim if self.settings.clock == "sim" else now.wall

    def _is_due(self, seen: Past, at: float) -> bool:
        late = self.settings.delay_s + self.settings.jitter_s * seen.deviation
        return seen.at + max(0.0, late) <= at + _SLACK_S
