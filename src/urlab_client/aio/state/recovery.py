"""What the client does about requests whose replies were lost: remembers them, and finds out what became of them."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from urlab_client.aio.deadline import DEFAULT, Timeout
from urlab_client.aio.model.articulation_state import Carried, give_back
from urlab_client.aio.session import Turn
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import (
    InternalError,
    ModeLocked,
    NoActiveManager,
    NoSession,
    NotReady,
    ServerUnreachable,
    SessionTakenOver,
    ShuttingDown,
    StepTimeout,
    URLabRPCError,
)
from urlab_client.protocol.messages.session import Forward, ForwardOk
from urlab_client.protocol.types import Resync

if TYPE_CHECKING:
    from urlab_client.aio.state.sim_state import SimState

__all__ = ["PendingOutcomes", "leaves_open", "resync"]

# These refusals leave open whether the op was executed. All others mean that it was not.
_UNDECIDED = (StepTimeout, ShuttingDown, InternalError)


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
        play: Whether a start of play was broken off, so that another world may be playing than the client knows.
    """

    def __init__(self) -> None:
        self.connects = 0
        self.mode: StepMode | str | None = None
        self.play = False
        self.clear()

    def __bool__(self) -> bool:
        return self.steps > 0 or self.reset

    def clear(self) -> None:
        """Forget steps and resets: a reply told the state."""
        self.steps = self.since = 0
        self.time = 0.0
        self.queued = self.reset = False
        self.keyframe: str | None = None
        self.carried: list[tuple[int, Carried]] = []

    def add_steps(self, state: SimState, error: BaseException, steps: int, carried: Carried) -> None:
        """Note that steps were sent and `error` came instead of their reply."""
        self._note(state)
        self.steps += steps
        if carried:
            self.carried.append((self.steps, carried))
        self.queued = self.queued or isinstance(error, StepTimeout)

    def add_reset(self, state: SimState, keyframe: str | None) -> None:
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

    def _note(self, state: SimState) -> None:
        if not self:
            self.since, self.time = state.step_count, state.sim_time
        self.connects = state.session.transport.stats.connects


def leaves_open(error: BaseException) -> bool:
    """Return whether a request that left and failed in this way may have been executed."""
    if isinstance(error, URLabRPCError):
        return isinstance(error, _UNDECIDED)
    return not isinstance(error, (ServerUnreachable, TypeError, ValueError))


async def resync(state: SimState, *, timeout: Timeout = DEFAULT) -> Resync:
    """Ask the server for counter and time, open a session where that is needed, and take the state over.

    `forward` is the only op that tells both in every mode. It integrates nothing and warm-starts nothing: the
    trajectory after it is the same, bit for bit.
    """
    async with state.session.turn(Forward, timeout=timeout) as turn:
        pending, state.pending = state.pending, PendingOutcomes()
        try:
            return await _resync(state, pending, turn)
        except BaseException:
            pending.mode = state.pending.mode or pending.mode
            state.pending = pending  # for the next attempt
            raise


async def _resync(state: SimState, pending: PendingOutcomes, turn: Turn) -> Resync:
    sent = pending.steps
    applied: int | None = None if sent else 0
    was_reset: bool | None = None
    before: ForwardOk | None = None
    held, renewed = True, False
    try:
        reply = before = await _look(turn)
    except (SessionTakenOver, NoSession):
        reply, held, renewed = None, False, True
    if before is not None:
        applied, was_reset = _compare(pending, before)
        # What broke off with a connection may still travel, and then meets a server that has moved on. In puppet mode
        # the next push overrides it anyway; elsewhere it is shut out with the session it belongs to.
        late = pending.connects != state.session.transport.stats.connects and state.mode is not StepMode.PUPPET
        renewed = late and not (applied == sent and (was_reset or not pending.reset))
    if renewed or pending.play:
        renewed = True
        await state.open(turn, state.level)
        reply = await _look(turn)
        if before is not None and reply is not None and applied is not None and reply.time != before.time:
            applied = _slipped_in(state, applied, reply.time - before.time)
    if reply is not None and pending.mode is not None:
        await state.ask_mode(turn, pending.mode)
        reply = await _look(turn)  # in live mode it has moved on meanwhile
    if reply is not None:
        if was_reset:
            state.absorb_reset(reply, pending.keyframe)
        else:
            state.absorb(reply, "forward", into_mirror=state.mode is not StepMode.PUPPET)
    if applied is not None:
        pending.give_back(applied)
    return Resync(
        session_held=held,
        session_renewed=renewed,
        playing=reply is not None,
        step=0 if reply is None else reply.step,
        time=0.0 if reply is None else reply.time,
        steps_sent=sent,
        steps_applied=applied,
        reset_applied=was_reset,
        settled=applied == sent or not pending.queued,
    )


async def _look(turn: Turn) -> ForwardOk | None:
    """Return where the simulation stands, None where no play runs."""
    try:
        return await turn.call(Forward())
    except (NoActiveManager, NotReady):
        return None


def _compare(pending: PendingOutcomes, reply: ForwardOk) -> tuple[int | None, bool | None]:
    """Return how many of the steps in doubt were executed, and whether the reset was, as far as that shows."""
    if not pending:
        return 0, None
    if not pending.reset:
        applied = reply.step - pending.since
        return (applied if 0 <= applied <= pending.steps else None), None
    if reply.step < pending.since or (pending.steps == 0 and reply.time < pending.time):
        return (None if pending.steps else 0), True
    if pending.steps:
        return None, None
    # A counter that was 0 is so after a reset, too.
    return 0, False if pending.since else None


def _slipped_in(state: SimState, applied: int, seconds: float) -> int | None:
    """Count the steps that were executed between the first look and the new session, whose counter is a new one."""
    model = state.mirror.model
    if model is None or seconds < 0:
        return None
    return applied + round(seconds / model.opt.timestep)
