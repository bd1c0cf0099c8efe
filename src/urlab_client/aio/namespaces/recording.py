"""`client.recording` and `client.replay`."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.namespaces._base import Namespace, fill
from urlab_client.aio.namespaces._ops import ReplayOps
from urlab_client.aio.session.session import Session
from urlab_client.aio.session.turn import Turn
from urlab_client.aio.state.sim_state import SimState
from urlab_client.errors import RecordingAlreadyActive, RecordingNotActive
from urlab_client.protocol.messages.recording import (
    RecordingClear,
    RecordingSave,
    RecordingStart,
    RecordingStop,
    ReplayListSessions,
    ReplayLoad,
    ReplaySetActive,
    ReplayStart,
    ReplayStop,
)
from urlab_client.values.types import RecordingHandle, RecordingSummary, ReplaySession, ReplayStatus

_RECORDING = "recording"
_FRAMES = "recorded frames"
_SESSION = "replay session"
_FLOAT32_MAX = 3.4028234663852886e38  # the server's value for "no limit"


class RecordingNamespace(Namespace):
    """Recording joint states on the server. The properties reflect this client's own calls."""

    def __init__(self, session: Session, state: SimState) -> None:
        super().__init__(session)
        self._state = state
        self._summary = RecordingSummary(0, 0.0)
        self._last_saved: Path | None = None

    @property
    def is_active(self) -> bool:
        """Whether a recording is running."""
        return self._state.recording

    @property
    def frame_count(self) -> int:
        """Number of frames in the recording that was stopped last."""
        return self._summary.frame_count

    @property
    def sim_duration(self) -> float:
        """Duration of the recording that was stopped last, seconds of simulation time."""
        return self._summary.sim_duration_s

    @property
    def last_saved_path(self) -> Path | None:
        """Path of the recording that was saved last, on the server's machine."""
        return self._last_saved

    async def start(
        self, name: str | None = None, max_duration_s: float | None = None, *, timeout: Timeout = DEFAULT
    ) -> RecordingHandle:
        """Start recording.

        Args:
            name: Accepted but not used; the server names the session.
            max_duration_s: Seconds of simulation time to keep; older frames are dropped. None for no limit.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            RecordingAlreadyActive: A recording is already running.
        """
        request = RecordingStart(name=name, max_duration_s=max_duration_s)
        async with self._session.turn(RecordingStart, timeout=timeout) as turn:
            return await self._start(request, turn)

    async def _start(self, request: RecordingStart, turn: Turn) -> RecordingHandle:
        try:
            with self._session.settling(_RECORDING, partial(self._start, request)):
                reply = await turn.call(request)
        except RecordingAlreadyActive:
            self._state.recording = True
            raise
        self._state.recording = True
        limit = reply.max_duration_s
        return RecordingHandle(name=reply.name, max_duration_s=math.inf if limit >= _FLOAT32_MAX else limit)

    async def stop(self, *, timeout: Timeout = DEFAULT) -> RecordingSummary:
        """Stop recording.

        Raises:
            RecordingNotActive: No recording is running.
        """
        async with self._session.turn(RecordingStop, timeout=timeout) as turn:
            await self._stop(turn)
            return self._summary

    async def _stop(self, turn: Turn) -> None:
        try:
            with self._session.settling(_RECORDING, self._stop):
                self._summary = fill(RecordingSummary, await turn.call(RecordingStop()))
        except RecordingNotActive:
            self._state.recording = False
            raise
        self._state.recording = False

    async def save(self, path: str | Path | None = None, *, timeout: Timeout = DEFAULT) -> Path:
        """Write the active session to a JSON file on the server's machine and return its absolute path.

        Args:
            path: File name in the server's replay directory; default `recording.json`.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            PathNotWritable: The file cannot be written, or there is nothing to save.
        """
        reply = await self._call(RecordingSave(path=None if path is None else str(path)), timeout)
        self._last_saved = Path(reply.absolute_path)
        return self._last_saved

    async def clear(self, *, timeout: Timeout = DEFAULT) -> None:
        """Discard the recorded frames."""
        async with self._session.turn(RecordingClear, timeout=timeout) as turn:
            with self._session.settling(_FRAMES, self._forget_frames):
                await turn.call(RecordingClear())
            await self._forget_frames(turn)

    async def _forget_frames(self, turn: Turn) -> None:
        del turn  # to clear again could discard what was recorded since
        self._summary = RecordingSummary(0, 0.0)


class ReplayNamespace(ReplayOps):
    """Playing recordings back. Requires step mode `direct` or `puppet`."""

    def __init__(self, session: Session, state: SimState) -> None:
        super().__init__(session)
        self._state = state
        self._session_name: str | None = None

    @property
    def active_session(self) -> str | None:
        """Name of the session that this client made active last."""
        return self._session_name

    async def load(self, path: str | Path, *, timeout: Timeout = DEFAULT) -> ReplaySession:
        """Load a recording from the server's replay directory and make it active.

        Raises:
            PathNotReadable: The file is missing or is not a recording.
        """
        async with self._session.turn(ReplayLoad, timeout=timeout) as turn:
            return await self._load(str(path), turn)

    async def _load(self, path: str, turn: Turn) -> ReplaySession:
        with self._session.settling(_SESSION, partial(self._load, path)):
            self._session_name = name = (await turn.call(ReplayLoad(path=path))).name
        return ReplaySession(name=name)

    async def set_active(self, name: str, *, timeout: Timeout = DEFAULT) -> None:
        """Make a loaded session the active one.

        Raises:
            ReplaySessionNotFound: No session has this name.
        """
        async with self._session.turn(ReplaySetActive, timeout=timeout) as turn:
            await self._activate(name, turn)

    async def _activate(self, name: str, turn: Turn) -> None:
        with self._session.settling(_SESSION, partial(self._activate, name)):
            await turn.call(ReplaySetActive(name=name))
        self._session_name = name

    async def start(self, *, timeout: Timeout = DEFAULT) -> ReplayStatus:
        """Play the active session.

        Raises:
            ReplayRequiresStepped: The step mode is live.
        """
        async with self._session.turn(ReplayStart, timeout=timeout) as turn:
            return await self._start(turn)

    async def _start(self, turn: Turn) -> ReplayStatus:
        with self._session.settling(_RECORDING, self._note_start):
            status = fill(ReplayStatus, await turn.call(ReplayStart()))
        await self._note_start(turn)
        self._session_name = status.active_session
        return status

    async def _note_start(self, turn: Turn) -> None:
        """A replay ends recording and resumes physics. To start it again would begin it again."""
        del turn
        self._state.mode.paused = self._state.recording = False
        self._session.unsettled.pop("pause", None)

    async def stop(self, *, timeout: Timeout = DEFAULT) -> None:
        """Stop playing."""
        await self._call(ReplayStop(), timeout)

    async def play(self, path_or_name: str | Path, *, loop: bool = False, timeout: Timeout = DEFAULT) -> ReplaySession:
        """Play a loaded session by name, or load a recording and play it.

        Args:
            path_or_name: Name of a loaded session, otherwise a file in the server's replay directory.
            loop: Accepted but not used; servers play sessions in a loop until stopped.
            timeout: Seconds to wait for each op; None waits without limit.

        Raises:
            PathNotReadable: `path_or_name` is neither a session nor a recording.
            ReplayRequiresStepped: The step mode is live.
        """
        name = str(path_or_name)
        # In one turn: otherwise another task could activate another session before this one starts.
        async with self._session.turn(ReplayListSessions, timeout=timeout, each=True) as turn:
            if name in (await turn.call(ReplayListSessions())).sessions:
                await self._activate(name, turn)
            else:
                name = (await self._load(name, turn)).name
            await self._start(turn)
        return ReplaySession(name=name)
