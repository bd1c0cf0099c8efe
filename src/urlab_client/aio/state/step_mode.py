"""How the client changes the server's step mode, and learns which one is in force."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import AsyncGenerator

import anyio

from urlab_client.aio.session import Turn
from urlab_client.aio.state.pending_outcomes import leaves_open
from urlab_client.aio.state.sim_state import SimState
from urlab_client.protocol.enums import LATER_MODE_NAMES, StepMode, known
from urlab_client.protocol.errors import BadMode, ModeLocked
from urlab_client.protocol.messages.runtime import SetMode, SetModeOk, SetPaused

__all__ = ["ask_mode", "learn_mode", "promote", "settle_mode", "stopped_live"]


log: logging.Logger = logging.getLogger("urlab_client.client")


async def ask_mode(state: SimState, turn: Turn, mode: StepMode | str) -> StepMode | str:
    """Bring the server into a step mode, take over the one in force, and return the one before.

    A word that this client does not know is the server's own for the mode that it was asked for, as it has agreed.

    Raises:
        ModeLocked: The project pins another one, which has been taken over if its name is known.
    """
    try:
        with state.pending.about_mode(mode):
            reply = await _request(turn, mode)
    except ModeLocked as locked:
        if locked.pinned is not None:
            state.mode = locked.pinned
        if locked.pinned is not mode:
            raise
        if mode is StepMode.DIRECT:
            # Play starts paused, and no change of mode can resume it where the mode is pinned.
            await turn.call(SetPaused(paused=False))
        return mode
    previous, current = known(StepMode, reply.previous_mode), known(StepMode, reply.current_mode)
    state.mode_word = reply.current_mode
    if not isinstance(current, StepMode):
        if previous == current:
            previous = state.mode
        current = mode if isinstance(mode, StepMode) else StepMode.LIVE  # others are what play began in
        log.warning("the server calls step mode %s %r", current, reply.current_mode)
    try:
        if state.session.features.idles_in_puppet:
            await _still_puppet(turn, previous if isinstance(previous, StepMode) else state.mode, current)
    finally:
        state.mode = current
        if current is not StepMode.LIVE:
            state.paused = False  # a change of mode resumes physics
    return previous


async def _request(turn: Turn, mode: StepMode | str) -> SetModeOk:
    try:
        return await turn.call(SetMode(mode=mode))
    except BadMode:
        # Servers after the beta call the modes by other names.
        later = LATER_MODE_NAMES.get(mode) if isinstance(mode, StepMode) else None
        return await turn.call(SetMode(mode=later or mode))


async def settle_mode(state: SimState, turn: Turn) -> None:
    """Bring the server into the mode that it is to be in, where a lost reply or a broken-off call left it in doubt."""
    pending = state.pending
    if pending.mode is not None:
        await ask_mode(state, turn, pending.mode)
    if pending.paused:
        await turn.call(SetPaused(paused=_rests(state)))
        pending.paused = False


def _rests(state: SimState) -> bool:
    """Whether physics is paused while this client does not step, by the user or because it would idle."""
    return state.paused or (state.mode is StepMode.PUPPET and state.session.features.idles_in_puppet)


@contextlib.asynccontextmanager
async def stopped_live(state: SimState, turn: Turn) -> AsyncGenerator[None]:
    """Bring a server that steps on request into live mode, paused, so that the body finds time standing still there.

    The client's own step mode stays what it is, and so does the simulation. If the way back fails, it is taken before
    the next step.

    Raises:
        ModeLocked: The project pins the mode; nothing was changed.
    """
    mode = state.mode
    await _request(turn, mode)  # changes nothing, but is refused where the mode is pinned
    state.pending.mode, state.pending.paused = mode, True
    try:
        await turn.call(SetPaused(paused=True))  # before: entering live mode does not pause
        await _request(turn, StepMode.LIVE)
        yield
    finally:
        with anyio.CancelScope(shield=True):  # its requests have deadlines
            await _request(turn, mode)
            await turn.call(SetPaused(paused=_rests(state)))
        state.pending.mode, state.pending.paused = None, False


async def learn_mode(state: SimState, turn: Turn) -> None:
    """Find out in which step mode time stands still, which only a change of mode tells: to live mode, paused, and back.

    The client's state takes it over; a mode without a name here stays an assumption.

    Raises:
        ModeLocked: The project pins another mode than live.
    """
    with anyio.CancelScope(shield=True):  # its requests have deadlines
        await turn.call(SetPaused(paused=True))  # before: entering live mode does not pause
        previous: StepMode | str = StepMode.LIVE
        try:
            previous = known(StepMode, (await _request(turn, StepMode.LIVE)).previous_mode)
        except ModeLocked as locked:
            if locked.pinned is not StepMode.LIVE:
                await turn.call(SetPaused(paused=False))
                raise
        if previous is not StepMode.LIVE:
            await _request(turn, previous)
        if isinstance(previous, StepMode):
            state.mode = previous
        if state.mode is not StepMode.LIVE:
            await turn.call(SetPaused(paused=_rests(state)))


async def _still_puppet(turn: Turn, previous: StepMode, current: StepMode) -> None:
    """Keep physics from taking steps of its own between the pushes of puppet mode, and undo that afterwards."""
    if current is StepMode.PUPPET:
        await turn.call(SetPaused(paused=True))
    elif previous is StepMode.PUPPET and current is StepMode.LIVE:  # direct mode takes the pause back itself
        await turn.call(SetPaused(paused=False))


async def promote(state: SimState, turn: Turn, mode: StepMode) -> None:
    """Bring the server into the step mode that the client was made with, and remember the one to go back to.

    Raises:
        ModeLocked: The project pins another one.
    """
    state.pending.mode = mode  # until the server has agreed, whatever comes between
    try:
        previous = await ask_mode(state, turn, mode)
    except ModeLocked as locked:
        if locked.pinned is not None:
            raise
        state.assume_mode(mode)  # which mode it is pinned to shows in the reply to the first step
        return
    except BaseException as error:
        if leaves_open(error) and state.promoted_from is None:
            state.promoted_from = StepMode.LIVE  # what play begins in; the reply would have told
        raise
    if previous is not state.mode:
        state.promoted_from = previous
