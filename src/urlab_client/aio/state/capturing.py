"""Pictures without a step: `camera.capture()` and `client.capture()`.

In live mode, newer servers render on request. Older servers only publish pictures, so the client waits for one that was
taken after the call. In `direct` and `puppet`, a request for pictures would be a step, so the client switches the
server to paused live mode for the duration of the capture.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from typing import Final

from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.session.turn import Turn
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.state.step_pictures import first_picture_s
from urlab_client.aio.streams.pictures import PictureListener
from urlab_client.aio.streams.sources import Camera
from urlab_client.enums import StepMode
from urlab_client.errors import ModeLocked, NoActiveManager, PictureTimeout, URLabError, URLabTimeoutError
from urlab_client.protocol.codec import op_of
from urlab_client.protocol.messages.session import Meta, Step
from urlab_client.protocol.messages.sim import PieStatus
from urlab_client.protocol.messages.streams import CameraSample, StreamPolicy
from urlab_client.values.layouts import BytesLike
from urlab_client.values.pictures import decode_camera

_RENDER_S: Final = 2.0
_AGAIN_S: Final = 0.05
_MOVES_S: Final = 0.25
"""Seconds in which simulation time advances in live mode unless paused, even at 5 % of real time."""

_HINT = (
    "Check that the camera is switched on in the editor and that the server can render. Without OpenGL it sends no "
    "pictures; its log shows what it found."
)
_ASSUMED = "The server's step mode is unknown, and outside live mode it may publish no pictures."


async def take_pictures(state: SimState, cameras: Sequence[Camera], timeout: Timeout) -> list[CameraSample]:
    """Return a picture of each camera, taken after this call.

    Raises:
        URLabError: A camera is no longer in the scene; nothing was sent.
        PictureTimeout: A camera delivered no picture in time.
        NoActiveManager: No play session is running.
        ModeLocked: The project pins a mode in which only steps deliver pictures.
    """
    first = Meta if state.session.read_only else Step
    async with state.session.turn(first, timeout=timeout, each=True) as turn:
        state.require_handshake("capture")
        if state.hello is not None and not state.hello.manager_present:
            raise NoActiveManager("no_active_manager", "no play session is running. Nothing was sent.", op="capture")
        views = _views(state, cameras)
        taking = _Taking(state, turn, views, _deadline(state, views, timeout))
        try:
            if state.mode.assumed and not state.session.read_only:
                await _learn_mode(state, turn)
            if state.mode.live or state.mode.assumed:
                await taking.in_live_mode(certain=not state.mode.assumed)
            else:
                async with state.mode.stopped_live(turn):
                    await taking.in_live_mode(certain=True)
                taking.note_time(state.clocks.sim_time)
        except ModeLocked as locked:
            locked.hint = "In this mode, pictures come with steps: call client.step(include_cameras=…)."
            raise
    return taking.delivered()


def _views(state: SimState, cameras: Sequence[Camera]) -> list[URLabCameraView]:
    present = {id(view.camera): view for view in state.objects.views()}
    missing = [camera.name for camera in cameras if id(camera) not in present]
    if missing:
        raise URLabError(
            f"capture: camera {missing[0]!r} is no longer in the scene. Nothing was sent.",
            hint="Call client.camera() to get a camera of the current scene.",
        )
    return [present[id(camera)] for camera in cameras]


def _deadline(state: SimState, views: Sequence[URLabCameraView], timeout: Timeout) -> float | None:
    seconds = state.session.default_timeout if timeout is DEFAULT else timeout
    if seconds is None:
        return None
    if timeout is DEFAULT:
        seconds = max(seconds, first_picture_s(views))
    return asyncio.get_running_loop().time() + seconds


async def _learn_mode(state: SimState, turn: Turn) -> None:
    """Determine the server's mode, because outside live mode a request for pictures might be a step."""
    before = (await turn.call(PieStatus())).sim_time
    if before is None:
        return
    await turn.aside(asyncio.sleep(_MOVES_S))
    if (await turn.call(PieStatus())).sim_time != before:
        state.mode.note(StepMode.LIVE)  # no other client holds the session, so physics runs on its own
    else:
        await state.mode.find_out(turn)


class _Taking:
    """One call, with the pictures received so far."""

    def __init__(self, state: SimState, turn: Turn, views: Sequence[URLabCameraView], deadline: float | None) -> None:
        self._state = state
        self._turn = turn
        self._views = views
        self._deadline = deadline
        self._found: dict[int, CameraSample] = {}

    async def in_live_mode(self, *, certain: bool) -> None:
        state, features = self._state, self._state.session.features
        try:
            async with asyncio.timeout_at(self._deadline):
                if certain and features.renders_sync:
                    await self._ask()
                else:
                    # The number of a snapshot: numbered pictures must not be older.
                    reply = await self._turn.call(Step()) if certain and features.camera_switch else None
                    await self._watch(None if reply is None else reply.frame_id)
        except URLabTimeoutError:
            raise
        except TimeoutError:
            late = [view.name for view in self._views if id(view) not in self._found]
            raise PictureTimeout(
                f"capture: no picture of {', '.join(map(repr, late))} arrived in time.",
                cameras=late,
                hint=_ASSUMED if state.mode.assumed else _HINT,
            ) from None

    def note_time(self, sim_time: float) -> None:
        """Set the simulation time of pictures for which the server sends none."""
        for sample in self._found.values():
            if sample.sim_time is None:
                sample.sim_time = sim_time

    def delivered(self) -> list[CameraSample]:
        """Return the pictures and store each as the newest one of its camera."""
        for view in self._views:
            sample = self._found[id(view)]
            view.pictures.deliver(sample.pixels, sample.sim_time, sample.frame_id)
            view.pictures.delivered = True
        return [self._found[id(view)] for view in self._views]

    async def _ask(self) -> None:
        objects, turn = self._state.objects, self._turn
        names = {id(objects.camera(name)): name for name in objects.camera_names()}
        missing = {names[id(view)]: view for view in self._views if id(view) in names}
        while True:
            request = Step(include_cameras=dict.fromkeys(missing, "sync"), render="sync")
            request.camera_timeout_ms = 1000.0 * _RENDER_S
            seconds = _RENDER_S + first_picture_s(missing.values())
            reply = await turn.call(request, takes=(op_of(Step).timeout or 0.0) + seconds)
            for name, frame in (reply.cameras or {}).items():
                if name in missing and (frame.frame_id or 0) >= (reply.frame_id or 0):
                    view = missing.pop(name)
                    size = frame.width, frame.height
                    self._keep(view, frame.data, size, frame_id=frame.frame_id, sim_time=frame.sim_time)
            if not missing:
                return
            await turn.aside(asyncio.sleep(_AGAIN_S))

    async def _watch(self, least: int | None) -> None:
        publishers = self._state.publishers
        listeners = [PictureListener(publishers.camera(view.camera, StreamPolicy.ALL)) for view in self._views]
        try:
            for listener in listeners:
                listener.source.attach(listener)
            await self._turn.aside(self._receive(listeners, least))
        finally:
            for listener in listeners:
                listener.source.detach(listener)

    async def _receive(self, listeners: Sequence[PictureListener], least: int | None) -> None:
        for _ in range(2):  # iterations of the loop that drain the sockets
            await asyncio.sleep(0)
        for listener in listeners:
            listener.forget()
        for view, listener in zip(self._views, listeners, strict=True):
            stamp, payload = await listener.next()
            if stamp is None or least is None:
                _, payload = await listener.next()  # without numbers, the first may have been in transit
            else:
                while stamp is not None and stamp.frame_id < least:
                    stamp, payload = await listener.next()
            self._keep(view, payload, view.resolution)

    def _keep(
        self,
        view: URLabCameraView,
        payload: BytesLike,
        size: tuple[int, int],
        *,
        frame_id: int | None = None,
        sim_time: float | None = None,
    ) -> None:
        image = decode_camera(payload, view.mode, *size, memory=view.camera.memory, where=view.name)
        self._found[id(view)] = CameraSample(
            camera=view.name,
            mode=view.mode,
            pixels=image.pixels,
            frame_id=image.frame_id if frame_id is None else frame_id,
            sim_time=image.sim_time if sim_time is None else sim_time,
            capture_time=image.capture_time,
            recv_wall_time_ns=time.time_ns(),
        )
