"""Changing the server's step mode and determining the current one."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import AsyncGenerator

import anyio

from urlab_client.aio.session.session import Turn, leaves_open
from urlab_client.aio.state.sim_state import SimState
from urlab_client.enums import LATER_MODE_NAMES, StepMode, known
from urlab_client.errors import BadMode, ModeLocked
from urlab_client.protocol.messages.runtime import SetMode, SetModeOk, SetPaused

log: logging.Logger = logging.getLogger("urlab_client.client")


async def ask_mode(state: SimState, turn: Turn, mode: StepMode | str) -> StepMode | str:
    """Switch the server to a step mode, adopt the resulting mode and return the previous one.

    If the server accepts the request but returns an unknown name, that name is its own for the requested mode.

    Raises:
        ModeLocked: The project pins another mode, which the state has adopted if its name is known.
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
            # Play starts paused, and if the mode is pinned, no change of mode can resume it.
            await turn.call(SetPaused(paused=False))
        return mode
    previous, current = known(StepMode, reply.previous_mode), known(StepMode, reply.current_mode)
    state.mode_word = reply.current_mode
    if not isinstance(current, StepMode):
        if previous == current:
            previous = state.mode
        current = (
            mode if isinstance(mode, StepMode) else StepMode.LIVE
        )  # a mode unknown to this client is the one that play began in
        log.warning("the server calls step mode %s %r", current, reply.current_mode)
    try:
        if state.session.features.idles_in_puppet:
            await _pause_in_puppet(turn, previous if isinstance(previous, StepMode) else state.mode, current)
    finally:
        state.mode = current
        if current is not StepMode.LIVE and previous is not current:  # a change of mode resumes physics
            state.paused = False
            state.session.unsettled.pop("pause", None)
    return previous


async def _request(turn: Turn, mode: StepMode | str) -> SetModeOk:
    try:
        return await turn.call(SetMode(mode=mode))
    except BadMode:
        # Servers after the beta use other names for the modes.
        later = LATER_MODE_NAMES.get(mode) if isinstance(mode, StepMode) else None
        return await turn.call(SetMode(mode=later or mode))


async def settle_mode(state: SimState, turn: Turn) -> None:
    """Restore the server's mode if a lost reply or an interrupted call left it uncertain."""
    pending = state.pending
    if pending.mode is not None:
        await ask_mode(state, turn, pending.mode)
    if pending.paused:
        await turn.call(SetPaused(paused=_paused_between_steps(state)))
        pending.paused = False


def _paused_between_steps(state: SimState) -> bool:
    """Return whether physics pauses between steps, at the user's request or because it would idle in puppet mode."""
    return state.paused or (state.mode is StepMode.PUPPET and state.session.features.idles_in_puppet)


@contextlib.asynccontextmanager
async def stopped_live(state: SimState, turn: Turn) -> AsyncGenerator[None]:
    """Switch a server that steps on request to paused live mode for the duration of the body.

    The client's own step mode and the simulation stay unchanged. If restoring the mode fails, the client retries before
    the next step.

    Raises:
        ModeLocked: The project pins the mode; nothing was changed.
    """
    mode = state.mode
    await _request(turn, mode)  # changes nothing, but fails if the mode is pinned
    state.pending.mode, state.pending.paused = mode, True
    try:
        await turn.call(SetPaused(paused=True))  # first, because entering live mode does not pause
        await _request(turn, StepMode.LIVE)
        yield
    finally:
        with anyio.CancelScope(shield=True):  # its requests have deadlines
            await _request(turn, mode)
            await turn.call(SetPaused(paused=_paused_between_steps(state)))
        state.pending.mode, state.pending.paused = None, False


async def learn_mode(state: SimState, turn: Turn) -> None:
    """Determine the step mode of a server whose time stands still, by switching to paused live mode and back.

    Only a change of mode reveals it. The state adopts the mode; one unknown to this client stays an assumption.

    Raises:
        ModeLocked: The project pins another mode than live.
    """
    with anyio.CancelScope(shield=True):  # its requests have deadlines
        await turn.call(SetPaused(paused=True))  # first, because entering live mode does not pause
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
            await turn.call(SetPaused(paused=_paused_between_steps(state)))


async def _pause_in_puppet(turn: Turn, previous: StepMode, current: StepMode) -> None:
    """Pause physics between the pushes of puppet mode and resume it afterwards."""
    if current is StepMode.PUPPET:
        await turn.call(SetPaused(paused=True))
    elif previous is StepMode.PUPPET and current is StepMode.LIVE:  # direct mode ends the pause itself
        await turn.call(SetPaused(paused=False))


async def promote(state: SimState, turn: Turn, mode: StepMode) -> bool:
    """Switch the server to the step mode that the client was created with, and record the mode to restore.

    Returns:
        Whether the server was in another mode.

    Raises:
        ModeLocked: The project pins another mode.
    """
    state.pending.mode = mode  # until the server has accepted it, even if this call fails
    try:
        previous = await ask_mode(state, turn, mode)
    except ModeLocked as locked:
        if locked.pinned is not None:
            raise
        state.assume_mode(mode)  # the reply to the first step shows the pinned mode
        return False
    except BaseException as error:
        if leaves_open(error) and state.promoted_from is None:
            state.promoted_from = StepMode.LIVE  # play begins in live mode; the reply was lost
        raise
    changed = previous is not state.mode
    if changed:
        state.promoted_from = previous
    return changed
