"""Requests whose replies were lost, so that the client cannot know whether they were executed."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Protocol

from urlab_client.aio.model.articulation_state import Carried, give_back
from urlab_client.aio.session.session import Session, leaves_open
from urlab_client.enums import StepMode
from urlab_client.errors import ModeLocked, StepTimeout


class Counters(Protocol):
    """The part of the client's state that locates it in the simulation."""

    session: Session
    step_count: int
    sim_time: float


class PendingOutcomes:
    """Requests that may or may not have been executed. Cleared by the next reply that contains the step counter.

    Attributes:
        steps: Number of steps or, in puppet mode, pushes.
        since: Step counter before the first request.
        time: Simulation time before the first request, seconds.
        connects: Number of connections opened when the latest request was sent.
        queued: Whether the server reported that it has queued steps.
        carried: Wrenches of the steps, each with the number of steps after which they have acted.
        reset: Whether one of the requests is a reset.
        keyframe: Compiled keyframe of that reset.
        seed: Seed of that reset.
        mode: Requested step mode, or None.
        paused: Whether physics may be paused for pictures; see `stopped_live`.
        play: Whether a start of play was interrupted, so that the server may play another world than the client knows.
        handshake: Whether a handshake was interrupted, so that the client may know the world of an earlier one.
    """

    def __init__(self) -> None:
        self.connects: int = 0
        self.mode: StepMode | str | None = None
        self.paused = False
        self.play = False
        self.handshake = False
        self.clear()

    def __bool__(self) -> bool:
        return self.steps > 0 or self.reset

    def clear(self) -> None:
        """Clear steps and resets because a reply contained the state."""
        self.steps: int = 0
        self.since: int = 0
        self.time: float = 0.0
        self.queued: bool = False
        self.reset: bool = False
        self.keyframe: str | None = None
        self.seed: int | None = None
        self.carried: list[tuple[int, Carried]] = []

    def add_steps(self, state: Counters, error: BaseException, steps: int, carried: Carried) -> None:
        """Record steps that were sent and failed with `error` instead of a reply."""
        self._note(state)
        self.steps += steps
        if carried:
            self.carried.append((self.steps, carried))
        self.queued = self.queued or isinstance(error, StepTimeout)

    def add_reset(self, state: Counters, keyframe: str | None, seed: int | None) -> None:
        """Record a reset that was sent and failed with an error instead of a reply."""
        self._note(state)
        self.reset = True
        self.keyframe = keyframe
        self.seed = seed

    def give_back(self, applied: int) -> None:
        """Buffer the wrenches of steps that were not executed again."""
        for needed, carried in reversed(self.carried):
            if needed > applied:
                give_back(carried)

    @contextmanager
    def about_mode(self, mode: StepMode | str) -> Generator[None]:
        """Record `mode` as pending unless the body succeeds or the server refuses it."""
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
