"""Requests whose replies were lost, so that the client cannot know whether they were executed."""

from __future__ import annotations

from urlab_client.aio.model.articulation_state import SentWrenches, restore_wrenches
from urlab_client.aio.state.clocks import Clocks
from urlab_client.errors import StepTimeout


class PendingOutcomes:
    """Requests that may or may not have been executed. Cleared by the next reply that contains the step counter.

    Attributes:
        steps: Number of steps or, in puppet mode, pushes.
        since: Step counter before the first request.
        time: Simulation time before the first request, seconds.
        connects: Number of connections opened when the latest request was sent.
        queued: Whether the server reported that it has queued steps.
        wrenches: Wrenches of the steps, each with the number of steps after which they have acted.
        reset: Whether one of the requests is a reset.
        keyframe: Compiled keyframe of that reset.
        seed: Seed of that reset.
        play: Whether a start of play was interrupted, so that the server may play another world than the client knows.
        handshake: Whether a handshake was interrupted, so that the client may know the world of an earlier one.
    """

    def __init__(self) -> None:
        self.connects: int = 0
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
        self.wrenches: list[tuple[int, SentWrenches]] = []

    def add_steps(
        self, clocks: Clocks, connects: int, error: BaseException, steps: int, wrenches: SentWrenches
    ) -> None:
        """Record steps that were sent and failed with `error` instead of a reply."""
        self._note(clocks, connects)
        self.steps += steps
        if wrenches:
            self.wrenches.append((self.steps, wrenches))
        self.queued = self.queued or isinstance(error, StepTimeout)

    def add_reset(self, clocks: Clocks, connects: int, keyframe: str | None, seed: int | None) -> None:
        """Record a reset that was sent and failed with an error instead of a reply."""
        self._note(clocks, connects)
        self.reset = True
        self.keyframe = keyframe
        self.seed = seed

    def restore_wrenches(self, applied: int) -> None:
        """Buffer the wrenches of steps that were not executed again."""
        for needed, wrenches in reversed(self.wrenches):
            if needed > applied:
                restore_wrenches(wrenches)

    def _note(self, clocks: Clocks, connects: int) -> None:
        if not self:
            self.since, self.time = clocks.step_count, clocks.sim_time
        self.connects = connects
