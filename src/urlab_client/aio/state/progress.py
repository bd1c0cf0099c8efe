"""How far the simulation is: the clocks of the last state, and requests with lost replies that may have moved it."""

from __future__ import annotations

import logging

from urlab_client.aio.model.articulation_state import SentWrenches, restore_wrenches
from urlab_client.errors import StepTimeout
from urlab_client.protocol.messages.session import Clock, StateReply
from urlab_client.protocol.messages.streams import StateSnapshot

log: logging.Logger = logging.getLogger("urlab_client.client")

# By the server's clock. A larger difference means that the clock was set, not that messages were reordered.
_OVERTAKEN_S = 1.0

_ZERO = Clock(sec=0, nsec=0)


class Clocks:
    """Step counter and clocks, as the attributes of the client show them; zero before the first state.

    Attributes:
        step_count: Steps since the last handshake or reset.
        set_back: How often a step has set the simulation time back since then.
    """

    def __init__(self) -> None:
        self.step_count: int = 0
        self.sim_time: float = 0.0
        self.sim_clock: Clock = _ZERO
        self.wall_clock: Clock = _ZERO
        self.recv_wall_time_ns: int = 0
        self.set_back: int = 0

    def note_set_back(self, before: float) -> None:
        """Note that a step has set the time back, which MuJoCo does to a simulation that diverges."""
        self.set_back += 1
        if self.set_back & (self.set_back - 1) == 0:  # what is unstable is so at every step
            times = f" ({self.set_back} times so far)" if self.set_back > 1 else ""
            text = "simulation time went from %g s to %g s in a step: it diverged, unless another client reset it%s"
            log.warning(text, before, self.sim_time, times)

    def absorb(self, state: StateReply | StateSnapshot, received_ns: int) -> None:
        """Take counter and clocks from a state that was received at that time."""
        self.step_count = state.step
        self.sim_time = state.time
        self.recv_wall_time_ns = received_ns
        if state.sim_time is not None:
            self.sim_clock = state.sim_time
        if state.wall_time is not None:
            self.wall_clock = state.wall_time

    def overtook(self, snapshot: StateSnapshot) -> bool:
        """Return whether a snapshot was sent before the state that these clocks show, but received after it."""
        mine, its = self.wall_clock, snapshot.wall_time
        age = mine.sec - its.sec + (mine.nsec - its.nsec) / 1e9
        return 0 < age < _OVERTAKEN_S

    def restart(self) -> None:
        """Set counter and simulation time to zero, as a new play session does."""
        self.step_count = 0
        self.sim_time = 0.0
        self.sim_clock = _ZERO
        self.set_back = 0


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
