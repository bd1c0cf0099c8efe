"""The pace of live mode: when the next iteration is due, at a speed relative to real time."""

from __future__ import annotations

import math
import time
from typing import Final

import mujoco

from urlab_client.simulation.controllers import float32

MIN_SPEED: Final = 5.0
MAX_SPEED: Final = 100.0

IDLE_S: Final = 0.1
"""Longest sleep of the physics thread while nothing integrates."""

MAX_LAG_S: Final = 0.02
"""A live step later than this counts as a stall and is not caught up; smaller delays are jitter."""

MIN_PERIOD_S: Final = 1e-5
MAX_PERIOD_S: Final = 3600.0

HOLD_S: Final = 0.005
"""Interval at which a live loop that runs late, and so never sleeps, releases the lock for `GIVE_WAY_S`."""

GIVE_WAY_S: Final = 0.0005


class LivePacing:
    """Keeps the iterations of live mode on a grid of time slots."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Pace a model's time step at the speed of real time; the first iteration is due immediately."""
        self._model = model
        self._speed = MAX_SPEED
        self._slot = -math.inf
        self._last_rest = -math.inf

    @property
    def speed(self) -> float:
        """Speed in force, percent of real time, 5 to 100, a float32."""
        return float32(min(max(self._speed, MIN_SPEED), MAX_SPEED))

    @speed.setter
    def speed(self, percent: float) -> None:
        self._speed = float(percent)

    def restart(self) -> None:
        """Make the next iteration due immediately."""
        self._slot = -math.inf

    def take_slot(self, *, idle: bool) -> float:
        """Take the next slot if it is due.

        Returns:
            0 if the slot was taken, otherwise the seconds to wait before the next call.
        """
        now = time.perf_counter()
        due = self._slot + (IDLE_S if idle else self._period())
        if now < due:
            return min(due - now, IDLE_S)
        self._slot = now if now - due > MAX_LAG_S else due
        return 0.0

    @property
    def rest_due(self) -> bool:
        """Whether the loop has held the lock for so long that it should release it."""
        return time.perf_counter() - self._last_rest > HOLD_S

    def rested(self) -> None:
        """Note that the lock was free for a while."""
        self._last_rest = time.perf_counter()

    def _period(self) -> float:
        """Seconds between two live iterations."""
        period = float(self._model.opt.timestep) * 100.0 / self.speed
        return min(period, MAX_PERIOD_S) if period > MIN_PERIOD_S else MIN_PERIOD_S
