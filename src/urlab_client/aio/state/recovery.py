"""Determining the outcome of requests whose replies were lost."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from urlab_client.aio.client_types import Resync
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.session.session import STOP
from urlab_client.aio.session.turn import Turn
from urlab_client.aio.state.discovery import Discovery, read_state
from urlab_client.aio.state.progress import PendingOutcomes
from urlab_client.aio.state.sim_state import SimState
from urlab_client.enums import StepMode
from urlab_client.errors import NoSession, SessionTakenOver, URLabRPCError
from urlab_client.protocol.messages.session import Forward, ForwardOk

log: logging.Logger = logging.getLogger("urlab_client.client")


async def resync(state: SimState, discovery: Discovery, *, timeout: Timeout = DEFAULT) -> Resync:
    """Request step counter and time from the server, open a session if needed, and apply the state.

    `forward` is the only op that returns both in every mode. It neither integrates nor changes the warm start, so the
    trajectory after it is bitwise identical.
    """
    async with state.session.turn(Forward, timeout=timeout) as turn:
        pending, state.pending = state.pending, PendingOutcomes()
        mode, state.mode.unsettled = state.mode.unsettled, None
        try:
            return await _resync(state, discovery, pending, mode, turn)
        except BaseException:
            state.mode.unsettled = state.mode.unsettled or mode
            pending.handshake = state.pending.handshake or pending.handshake
            state.pending = pending  # for the next attempt
            raise


async def _resync(
    state: SimState, discovery: Discovery, pending: PendingOutcomes, mode: StepMode | str | None, turn: Turn
) -> Resync:
    sent = pending.steps
    applied: int | None = None if sent else 0
    was_reset: bool | None = None
    before: ForwardOk | None = None
    held, renewed = True, False
    if not pending.play:  # a later start of play leaves nothing to stop
        await _settle(state, turn, [STOP])
    try:
        reply = before = await read_state(turn)
    except (SessionTakenOver, NoSession):
        reply, held, renewed = None, False, True
    if before is not None:
        applied, was_reset = _compare(pending, before)
        # A request interrupted by a lost connection may still be in transit and reach the server later. In puppet mode
        # the next push overrides it; in other modes the server rejects it once its session has been replaced.
        connects = state.session.transport.stats.connects
        late = pending.connects != connects and not state.mode.puppet
        renewed = late and not (applied == sent and (was_reset or not pending.reset))
        renewed = renewed or (bool(state.session.unsettled) and state.session.unsettled_on != connects)
    # Without a handshake, or if one was interrupted, the client may know another world than the one that plays.
    if renewed or pending.play or pending.handshake or state.hello is None:
        renewed = True
        await discovery.open(turn, state.level)
        reply = await read_state(turn)
        if before is not None and reply is not None and applied is not None and reply.time != before.time:
            applied = _with_late_steps(state, applied, reply.time - before.time)
    if reply is not None and mode is not None:
        await state.mode.ask(turn, mode)
        reply = await read_state(turn)  # in live mode the simulation has advanced meanwhile
    if reply is not None:
        if was_reset:
            state.reset_seed = pending.seed
            state.absorb_reset(reply, pending.keyframe)
        else:
            state.absorb(reply, "forward", into_mirror=not state.mode.puppet)
        await _settle(state, turn, list(state.session.unsettled))
        await turn.aside(state.publishers.camera_switch.settle())
    if applied is not None:
        pending.restore_wrenches(applied)
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


async def _settle(state: SimState, turn: Turn, subjects: Iterable[str]) -> None:
    for what in subjects:
        if (settle := state.session.unsettled.get(what)) is not None:
            try:
                await settle(turn)
            except URLabRPCError as refusal:  # which tells, too
                log.info("%s was in doubt: %s", what, refusal)


def _compare(pending: PendingOutcomes, reply: ForwardOk) -> tuple[int | None, bool | None]:
    """Return how many pending steps were executed and whether the reset was; None if unknown."""
    if not pending:
        return 0, None
    if not pending.reset:
        applied = reply.step - pending.since
        return (applied if 0 <= applied <= pending.steps else None), None
    if reply.step < pending.since or (pending.steps == 0 and reply.time < pending.time):
        return (None if pending.steps else 0), True
    if pending.steps:
        return None, None
    # A counter that was 0 before a reset is 0 after it, too.
    return 0, False if pending.since else None


def _with_late_steps(state: SimState, applied: int, seconds: float) -> int | None:
    """Add the steps executed between the first reply and the new session, whose counter starts anew."""
    model = state.mirror.model
    if model is None or seconds < 0:
        return None
    return applied + round(seconds / model.opt.timestep)
