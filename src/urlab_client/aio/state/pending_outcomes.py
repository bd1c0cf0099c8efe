"""Requests whose replies were lost, so that nobody knows whether they were executed."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Protocol

from urlab_client.aio.model.articulation_state import Carried, give_back
from urlab_client.aio.session import Session
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import (
    InternalError,
    ModeLocked,
    ServerUnreachable,
    ShuttingDown,
    StepTimeout,
    URLabRPCError,
)

__all__ = ["PendingOutcomes", "leaves_open"]

# These refusals leave open whether the op was executed. All others mean that it was not.
_UNDECIDED = (StepTimeout, ShuttingDown, InternalError)


class Counters(Protocol):
    """Where the client stands: a part of its state."""

    session: Session
    step_count: int
    sim_time: float


class PendingOutcomes:
    """Requests that may or may not have been executed. Forgotten with the next reply that tells the step counter.

    Attributes:
        steps: Steps, or in puppet mode pushes.
        since: Step counter before the first of them.
        time: Simulation time before the first of them, seconds.
        connects: Connections made when the latest of them was sent.
        queued: Whether the server said that it has queued steps.
        carried: What steps carried, each with the number of steps that must have been executed for it to have acted.
        reset: Whether a reset is among them.
        keyframe: Compiled keyframe of that reset.
        mode: Step mode that was asked for, or None.
        paused: Whether physics may be paused for pictures, see `stopped_live`.
        play: Whether a start of play was broken off, so that another world may be playing than the client knows.
    """

    def __init__(self) -> None:
        self.connects: int = 0
        self.mode: StepMode | str | None = None
        self.paused = False
        self.play = False
        self.clear()

    def __bool__(self) -> bool:
        return self.steps > 0 or self.reset

    def clear(self) -> None:
        """Forget steps and resets: a reply told the state."""
        self.steps: int = 0
        self.since: int = 0
        self.time: float = 0.0
        self.queued: bool = False
        self.reset: bool = False
        self.keyframe: str | None = None
        self.carried: list[tuple[int, Carried]] = []

    def add_steps(self, state: Counters, error: BaseException, steps: int, carried: Carried) -> None:
        """Note that steps were sent and `error` came instead of their reply."""
        self._note(state)
        self.steps += steps
        if carried:
            self.carried.append((self.steps, carried))
        self.queued = self.queued or isinstance(error, StepTimeout)

    def add_reset(self, state: Counters, keyframe: str | None) -> None:
        """Note that a reset was sent and an error came instead of its reply."""
        self._note(state)
        self.reset = True
        self.keyframe = keyframe

    def give_back(self, applied: int) -> None:
        """Buffer again what was carried by steps that were not executed."""
        for needed, carried in reversed(self.carried):
            if needed > applied:
                give_back(carried)

    @contextmanager
    def about_mode(self, mode: StepMode | str) -> Generator[None]:
        """Note, unless the body succeeds or is refused, that the server is to be brought into `mode`."""
        try:
            yield
        except BaseException as error:
            if isinstance(error, ModeLocked):
                self.mode = None
            elif leaves_open(error):
                self.mode = mode
            raise
        self.mode = None

    def _note(self, state: Counters) -> None:
        if not self:
            self.since, self.time = state.step_count, state.sim_time
        self.connects = state.session.transport.stats.connects


def leaves_open(error: BaseException) -> bool:
    """Return whether a request that left and failed in this way may have been executed."""
    if isinstance(error, URLabRPCError):
        return isinstance(error, _UNDECIDED)
    return not isinstance(error, (ServerUnreachable, TypeError, ValueError))
