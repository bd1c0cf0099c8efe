"""The pictures of a step: requested by unique camera names and returned under the user's names.

For the client's `step`. A picture that should show the state after the step but shows an older one is dropped. If the
server cannot render for a step, the picture comes from the camera's stream instead.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final

from urlab_client.aio.streams.sources import FIRST_PICTURE_S
from urlab_client.enums import CameraTiming
from urlab_client.protocol.messages.session import CameraFrame, Step, StepOk

if TYPE_CHECKING:
    from urlab_client.aio.cameras import URLabCameraView
    from urlab_client.aio.session.turn import Turn
    from urlab_client.aio.state.sim_state import SimState

log: logging.Logger = logging.getLogger("urlab_client.client")

_BLOCKING_S: Final = 3.0  # an alpha waits up to 2 s + 1 s for each picture
_RENDER_S: Final = 5.0


def first_picture_s(views: Iterable[URLabCameraView]) -> float:
    """Return the seconds that a server may need to initialise OpenGL: 0 if each camera has delivered a picture."""
    return 0.0 if all(view.pictures.came for view in views) else FIRST_PICTURE_S


class StepPictures:
    """The pictures of one step.

    Attributes:
        interruption: Cancellation that interrupted the wait for pictures.

    Raises:
        KeyError: A name matches no camera or several; nothing was sent.
    """

    def __init__(self, state: SimState, asked: bool | Mapping[str, str | None]) -> None:
        self._state = state
        self._features = state.session.features
        self._wanted: dict[str, str | None] = {}
        self._shown: dict[str, str] = {}
        self._sync: set[str] = set()
        self._all = self._listening = False
        self.interruption: asyncio.CancelledError | None = None
        if asked is False:  # true for nearly every step
            return
        names = state.objects.camera_names()
        if isinstance(asked, bool):
            self._wanted = dict.fromkeys(names, str(CameraTiming.LATEST))
            shown = state.objects.shown_cameras(names)
            self._shown = {name: shown[name] for name in self._wanted}
        else:
            self._shown = {state.objects.camera_name(name): name for name in asked}
            self._wanted = {state.objects.camera_name(name): timing for name, timing in asked.items()}
        # If two cameras share a name, a request for all cameras returns only one of them. Unannounced cameras, however,
        # are returned only by such a request.
        unique = all("/" not in name for name in self._shown.values())
        self._all = asked is True and (unique or state.objects.hidden_cameras)
        self._sync = {name for name, timing in self._wanted.items() if timing == CameraTiming.SYNC}

    def __bool__(self) -> bool:
        return bool(self._wanted) or self._all

    @property
    def seconds(self) -> float:
        """Seconds that the server may take for the pictures in addition to the step."""
        views = [view for name in self._wanted if (view := self._state.objects.camera(name)) is not None]
        return self._rendering_s + first_picture_s(views)

    @property
    def _rendering_s(self) -> float:
        if not self._sync:
            return 0.0
        return _RENDER_S if self._features.renders_sync else _BLOCKING_S * len(self._sync)

    def ask(self, request: Step) -> None:
        if not self:
            return
        request.include_cameras = True if self._all else dict(self._wanted)
        if self._sync and self._features.renders_sync:
            request.render = "sync"
            request.camera_timeout_ms = 1000.0 * _RENDER_S

    async def listen(self, turn: Turn) -> None:
        """Subscribe to the streams of the pictures before the step. Takes a few seconds at most.

        If cameras always stream, the first reply shows whether the streams are needed.
        """
        if not self._sync or self._features.renders_sync:
            return
        streams = self._state.step_streams
        self._listening = self._features.camera_switch or streams.needed
        if self._listening and self._listen(self._sync):
            await turn.aside(streams.opened())

    async def complete(self, turn: Turn, reply: StepOk) -> None:
        """Rename a reply's pictures to the user's names, drop outdated ones and add those of streams.

        The step is already done, so a cancellation is deferred until its state has been applied; `account` raises it.
        """
        try:
            await self._catch_up(turn, reply)
        except asyncio.CancelledError as error:
            self.interruption = error
        self.take(reply)

    def account(self, reply: StepOk, *, came: bool) -> None:
        """Mark the cameras whose pictures are missing, after the reply was applied; raise an `interruption`."""
        if came:
            self._state.objects.note_missing_frames(self.names, reply)
        if self.interruption is not None:
            raise self.interruption

    async def _catch_up(self, turn: Turn, reply: StepOk) -> None:
        """Wait in the streams for pictures that are missing or outdated in a reply, within their deadline."""
        if not self._sync or self._features.renders_sync or reply.frame_id is None:
            return
        frames = reply.cameras or {}
        late = [
            name
            for name in sorted(self._sync)
            if name not in frames or self._too_old(name, frames[name], reply.frame_id)
        ]
        if not late:
            return
        streams = self._state.step_streams
        streams.needed = True
        if not self._listening:
            self._listen(late)
        found = await streams.pictures(late, reply.frame_id, turn.deadline(self._rendering_s))
        if found:
            reply.cameras = {**frames, **found}

    def _listen(self, names: Iterable[str]) -> bool:
        views = [(name, view.camera) for name in names if (view := self._state.objects.camera(name)) is not None]
        return self._state.step_streams.listen(views, self._state.hello)

    def take(self, reply: StepOk) -> None:
        """Rename the pictures of a reply to the user's names and drop outdated ones."""
        if reply.cameras is None:
            return
        reply.cameras = {
            self._shown.get(name, name): frame
            for name, frame in reply.cameras.items()
            if not self._too_old(name, frame, reply.frame_id)
        }

    def _too_old(self, name: str, frame: CameraFrame, step: int | None) -> bool:
        if name not in self._sync or frame.frame_id is None or step is None or frame.frame_id >= step:
            return False
        log.info("camera %s: its picture shows snapshot %d, but the step is snapshot %d", name, frame.frame_id, step)
        return True

    @property
    def names(self) -> list[str]:
        return list(self._shown.values())
