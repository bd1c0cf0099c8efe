"""The server's step mode: what the client knows of it, how it is changed, and how it is found out."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import AsyncGenerator, Callable, Generator

import anyio

from urlab_client.aio.session.session import Session, leaves_open
from urlab_client.aio.session.turn import Turn
from urlab_client.enums import LATER_MODE_NAMES, StepMode, known
from urlab_client.errors import BadMode, ModeLocked
from urlab_client.protocol.messages.runtime import SetMode, SetModeOk, SetPaused

log: logging.Logger = logging.getLogger("urlab_client.client")


class ModeState:
    """The step mode of one client's server.

    Attributes:
        wanted: Mode that the user requested.
        current: Mode in force, as far as this client knows.
        assumed: Whether `current` is an assumption that no reply has confirmed.
        word: The server's name of the mode in its last reply that contains it.
        promoted_from: Mode to restore on close after this client changed it; possibly one that only the server knows.
        paused: Whether this client has paused physics and nothing has resumed it since.
        unsettled: Mode to request again, because a request for it was abandoned or its reply was lost; or None.
        pause_unsettled: Whether physics may be paused for pictures; see `stopped_live`.
    """

    def __init__(self, session: Session, wanted: StepMode, on_change: Callable[[], None]) -> None:
        self.wanted = wanted
        self.current: StepMode = StepMode.LIVE
        self.assumed: bool = False
        self.word: str = ""
        self.promoted_from: StepMode | str | None = None
        self.paused: bool = False
        self.unsettled: StepMode | str | None = None
        self.pause_unsettled: bool = False
        self._session = session
        self._on_change = on_change

    @property
    def live(self) -> bool:
        """Whether the server is in live mode, as far as this client knows."""
        return self.current is StepMode.LIVE

    @property
    def puppet(self) -> bool:
        """Whether the client's model is the source of the state."""
        return self.current is StepMode.PUPPET

    def note(self, mode: StepMode) -> None:
        """Adopt the mode that a reply has shown."""
        self.assumed = False
        self.current = mode
        self._on_change()

    def assume(self, mode: StepMode) -> None:
        """Assume a mode until a reply shows the real one, because no op can query it without changing it."""
        self.note(mode)
        self.assumed = True

    def end_play(self) -> None:
        """Note that play has ended: the server is back in live mode."""
        self.note(StepMode.LIVE)
        self.paused = False
        self.promoted_from = None

    async def ask(self, turn: Turn, mode: StepMode | str) -> StepMode | str:
        """Switch the server to a mode, adopt the resulting mode and return the previous one.

        If the server accepts the request but returns an unknown name, that name is its own for the requested mode.

        Raises:
            ModeLocked: The project pins another mode, which is adopted if its name is known.
        """
        try:
            with self._unsettled_until_answered(mode):
                reply = await _request(turn, mode)
        except ModeLocked as locked:
            if locked.pinned is not None:
                self.note(locked.pinned)
            if locked.pinned is not mode:
                raise
            if mode is StepMode.DIRECT:
                # Play starts paused, and if the mode is pinned, no change of mode can resume it.
                await turn.call(SetPaused(paused=False))
            return mode
        previous, current = known(StepMode, reply.previous_mode), known(StepMode, reply.current_mode)
        self.word = reply.current_mode
        if not isinstance(current, StepMode):
            if previous == current:
                previous = self.current
            # A mode that this client does not know is the one that play began in.
            current = mode if isinstance(mode, StepMode) else StepMode.LIVE
            log.warning("the server calls step mode %s %r", current, reply.current_mode)
        try:
            if self._session.features.idles_in_puppet:
                await _pause_in_puppet(turn, previous if isinstance(previous, StepMode) else self.current, current)
        finally:
            self.note(current)
            if current is not StepMode.LIVE and previous is not current:  # a change of mode resumes physics
                self.paused = False
                self._session.unsettled.pop("pause", None)
        return previous

    async def settle(self, turn: Turn) -> None:
        """Restore the server's mode if a lost reply or an interrupted call left it uncertain."""
        if self.unsettled is not None:
            await self.ask(turn, self.unsettled)
        if self.pause_unsettled:
            await turn.call(SetPaused(paused=self._paused_between_steps))
            self.pause_unsettled = False

    @contextlib.asynccontextmanager
    async def stopped_live(self, turn: Turn) -> AsyncGenerator[None]:
        """Switch a server that steps on request to paused live mode for the duration of the body.

        The client's own step mode and the simulation stay unchanged. If restoring the mode fails, the client retries
        before the next step.

        Raises:
            ModeLocked: The project pins the mode; nothing was changed.
        """
        mode = self.current
        await _request(turn, mode)  # changes nothing, but fails if the mode is pinned
        self.unsettled, self.pause_unsettled = mode, True
        try:
            await turn.call(SetPaused(paused=True))  # first, because entering live mode does not pause
            await _request(turn, StepMode.LIVE)
            yield
        finally:
            with anyio.CancelScope(shield=True):  # its requests have deadlines
                await _request(turn, mode)
                await turn.call(SetPaused(paused=self._paused_between_steps))
            self.unsettled, self.pause_unsettled = None, False

    async def find_out(self, turn: Turn) -> None:
        """Determine the mode of a server whose time stands still, by switching to paused live mode and back.

        Only a change of mode reveals it. A mode that is unknown to this client stays an assumption.

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
                self.note(previous)
            if not self.live:
                await turn.call(SetPaused(paused=self._paused_between_steps))

    async def promote(self, turn: Turn, mode: StepMode) -> bool:
        """Switch to the mode that the client was created with; return whether the server was in another one.

        Raises:
            ModeLocked: The project pins another mode.
        """
        self.unsettled = mode  # until the server has accepted it, even if this call fails
        try:
            previous = await self.ask(turn, mode)
        except ModeLocked as locked:
            if locked.pinned is not None:
                raise
            self.assume(mode)  # the reply to the first step shows the pinned mode
            return False
        except BaseException as error:
            if leaves_open(error) and self.promoted_from is None:
                self.promoted_from = StepMode.LIVE  # play begins in live mode; the reply was lost
            raise
        changed = previous is not self.current
        if changed:
            self.promoted_from = previous
        return changed

    @contextlib.contextmanager
    def _unsettled_until_answered(self, mode: StepMode | str) -> Generator[None]:
        """Keep `mode` as unsettled unless the body succeeds or the server refuses it."""
        try:
            yield
        except BaseException as error:
            if isinstance(error, ModeLocked):
                self.unsettled = None
            elif leaves_open(error):
                self.unsettled = mode
            raise
        self.unsettled = None

    @property
    def _paused_between_steps(self) -> bool:
        """Whether physics pauses between steps, at the user's request or because it would idle in puppet mode."""
        return self.paused or (self.puppet and self._session.features.idles_in_puppet)


async def _request(turn: Turn, mode: StepMode | str) -> SetModeOk:
    try:
        return await turn.call(SetMode(mode=mode))
    except BadMode:
        # Servers after the beta use other names for the modes.
        later = LATER_MODE_NAMES.get(mode) if isinstance(mode, StepMode) else None
        return await turn.call(SetMode(mode=later or mode))


async def _pause_in_puppet(turn: Turn, previous: StepMode, current: StepMode) -> None:
    """Pause physics between the pushes of puppet mode and resume it afterwards."""
    if current is StepMode.PUPPET:
        await turn.call(SetPaused(paused=True))
    elif previous is StepMode.PUPPET and current is StepMode.LIVE:  # direct mode ends the pause itself
        await turn.call(SetPaused(paused=False))
