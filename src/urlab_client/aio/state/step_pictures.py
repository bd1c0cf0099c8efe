"""The pictures that a step brings: asked for by the names that mean one camera, handed back under the user's.

For the client's `step`. A picture that was to show the state after the step, and shows an older one, is withheld. On
servers that cannot draw for a step, the picture is taken from the camera's stream instead.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final

from urlab_client.aio.live.camera_source import FIRST_PICTURE_S
from urlab_client.protocol.enums import CameraTiming
from urlab_client.protocol.messages.session import CameraFrame, Step, StepOk

if TYPE_CHECKING:
    from urlab_client.aio.cameras import URLabCameraView
    from urlab_client.aio.state.sim_state import SimState
    from urlab_client.aio.turn import Turn

__all__ = ["StepPictures", "first_picture_s"]

log: logging.Logger = logging.getLogger("urlab_client.client")

_BLOCKING_S: Final = 3.0  # an alpha waits up to 2 s + 1 s for each picture
_RENDER_S: Final = 5.0


def first_picture_s(views: Iterable[URLabCameraView]) -> float:
    """Return how long a server may look for OpenGL before it draws: 0 where each camera has shown something."""
    return 0.0 if all(view.pictures.came for view in views) else FIRST_PICTURE_S


class StepPictures:
    """The pictures of one step.

    Args:
        state: The client's state, which knows the cameras.
        asked: What is wanted: all newest ones, none, or camera to `sync` or `latest`.

    Attributes:
        interruption: What broke off the wait for pictures.

    Raises:
        KeyError: There is no such camera, or several; nothing was sent.
    """

    def __init__(self, state: SimState, asked: bool | Mapping[str, str | None]) -> None:
        self._state = state
        self._features = state.session.features
        self._wanted: dict[str, str | None] = {}
        self._shown: dict[str, str] = {}
        self._sync: set[str] = set()
        self._all = self._listening = False
        self.interruption: asyncio.CancelledError | None = None
        if asked is False:  # as nearly every step has it
            return
        names = state.objects.camera_names()
        if isinstance(asked, bool):
            self._wanted = dict.fromkeys(names, str(CameraTiming.LATEST))
            shown = state.objects.shown_cameras(names)
            self._shown = {name: shown[name] for name in self._wanted}
        else:
            self._shown = {state.objects.camera_name(name): name for name in asked}
            self._wanted = {state.objects.camera_name(name): timing for name, timing in asked.items()}
        # Asked for all of them, a server that calls two cameras alike brings one. One that has cameras which it does
        # not announce shows them to nobody else.
        unique = all("/" not in name for name in self._shown.values())
        self._all = asked is True and (unique or state.objects.hidden_cameras)
        self._sync = {name for name, timing in self._wanted.items() if timing == CameraTiming.SYNC}

    def __bool__(self) -> bool:
        return bool(self._wanted) or self._all

    @property
    def seconds(self) -> float:
        """How long the server may take for them, besides the step itself."""
        views = [view for name in self._wanted if (view := self._state.objects.camera(name)) is not None]
        return self._drawing_s + first_picture_s(views)

    @property
    def _drawing_s(self) -> float:
        if not self._sync:
            return 0.0
        return _RENDER_S if self._features.renders_sync else _BLOCKING_S * len(self._sync)

    def ask(self, request: Step) -> None:
        """Write into a request what it is to ask for, if anything."""
        if not self:
            return
        request.include_cameras = True if self._all else dict(self._wanted)
        if self._sync and self._features.renders_sync:
            request.render = "sync"
            request.camera_timeout_ms = 1000.0 * _RENDER_S

    async def listen(self, turn: Turn) -> None:
        """Receive the streams in which pictures are looked for, before the step is taken; at most for seconds.

        Where cameras stream all the time, the first reply shows whether there is a need.
        """
        if not self._sync or self._features.renders_sync:
            return
        streams = self._state.step_streams
        self._listening = self._features.camera_switch or streams.needed
        if self._listening and self._listen(self._sync):
            await turn.aside(streams.opened())

    async def complete(self, turn: Turn, reply: StepOk) -> None:
        """Bring the pictures of a reply under the user's names: without those that are too old, with those of streams.

        The step is done by then, so its state is taken over before a cancellation shows: by `account`.
        """
        try:
            await self._catch_up(turn, reply)
        except asyncio.CancelledError as error:
            self.interruption = error
        self.take(reply)

    def account(self, reply: StepOk, *, came: bool) -> None:
        """Mark the cameras whose pictures did not come, after the reply was taken over.

        Args:
            reply: The reply.
            came: Whether the step was one that brings pictures.

        Raises:
            CancelledError: The wait for pictures was broken off.
        """
        if came:
            self._state.objects.note_missing_frames(self.names, reply)
        if self.interruption is not None:
            raise self.interruption

    async def _catch_up(self, turn: Turn, reply: StepOk) -> None:
        """Wait in the streams for the pictures that a reply has not, or in an older version, within their deadline."""
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
        found = await streams.pictures(late, reply.frame_id, turn.deadline(self._drawing_s))
        if found:
            reply.cameras = {**frames, **found}

    def _listen(self, names: Iterable[str]) -> bool:
        views = [(name, view) for name in names if (view := self._state.objects.camera(name)) is not None]
        return self._state.step_streams.listen(views, self._state.hello)

    def take(self, reply: StepOk) -> None:
        """Bring the pictures of a reply under the user's names, without those that are too old."""
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
        log.info("camera %s: its picture is of snapshot %d, the step of %d", name, frame.frame_id, step)
        return True

    @property
    def names(self) -> list[str]:
        """The user's names of the cameras whose pictures are to come."""
        return list(self._shown.values())
