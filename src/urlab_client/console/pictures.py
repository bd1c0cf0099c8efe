"""Pictures of the cameras for browsers: one stream and one encoder per camera, however many watch."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING, Any, NamedTuple

import anyio
import anyio.to_thread
import msgspec
import numpy as np

from urlab_client.aio.background import background_task, kept_running
from urlab_client.console.messages import PictureHead
from urlab_client.console.shared_view import SharedView
from urlab_client.enums import CameraMode, StepMode
from urlab_client.errors import URLabError, URLabTimeoutError
from urlab_client.protocol.messages.streams import CameraSample
from urlab_client.values.pictures import jpeg

if TYPE_CHECKING:
    from urlab_client.aio import Stream, URLabCameraView, URLabClient
    from urlab_client.console.replay import Replay
    from urlab_client.integrations.record.contents import RecordedPicture

OF_SCENE = "-/"
"""Begins the path of a camera that belongs to no articulation."""

_FASTEST_S = 1 / 30
_LOOK_S = 0.5
_CAPTURE_S = 5.0
_QUALITY = 80


class Cameras:
    """The cameras of one console, by their paths: `ARTICULATION/CAMERA`, or `-/CAMERA` for those of the scene."""

    def __init__(self, client: URLabClient, view: SharedView) -> None:
        self._replay: Replay | None = None
        self._client = client
        self._view = view
        self._feeds: dict[str, Feed] = {}

    def camera(self, path: str) -> URLabCameraView | None:
        """Return a camera, None if there is none."""
        owner, _, name = path.partition("/")
        if owner == "-":
            return self._client.global_cameras.get(name)
        art = self._client.articulations.get(owner)
        return None if art is None else art.cameras.get(name)

    def feed(self, path: str) -> Feed | None:
        """Return the pictures of a camera, None if there is none."""
        camera = self.camera(path)
        if camera is None:
            return None
        feed = self._feeds.get(path)
        if feed is None or feed.camera is not camera:
            feed = self._feeds[path] = Feed(self, self._client, camera, path, self._view)
        return feed

    def replay_of(self, path: str) -> Replay | None:
        """Return the replay that the pictures of a camera come from, None if they are the simulation's."""
        return self._replay if self._replay is not None and path in self._replay.cameras else None

    def watched(self) -> list[str]:
        """Return the cameras that viewers watch, by the names that `step` takes."""
        return [path.removeprefix(OF_SCENE) for path, feed in self._feeds.items() if feed.watched]

    def begin_anew(self) -> None:
        """Forget the cameras of the previous play session that nobody watches."""
        self._feeds = {path: one for path, one in self._feeds.items() if one.watched or self.camera(path) is one.camera}

    async def show(self, replay: Replay | None) -> None:
        """Show the pictures of a recording, or of the simulation again."""
        self._replay = replay
        for feed in [*self._feeds.values()]:
            await feed.renew()


class EncodedPicture(NamedTuple):
    """One JPEG, and the `frame` for browsers: length of the head (4 bytes, little-endian), head, and JPEG.

    `seq` is its number among the pictures of its feed.
    """

    seq: int
    jpeg: bytes
    frame: bytes


class Feed:
    """The newest picture of one camera, encoded once; receives only while a viewer watches.

    After an unexpected error, it begins anew following a pause.
    """

    def __init__(
        self, cameras: Cameras, client: URLabClient, camera: URLabCameraView, path: str, view: SharedView
    ) -> None:
        self.camera = camera
        self._cameras = cameras
        self._client = client
        self._path = path
        self._view = view
        self._newest: EncodedPicture | None = None
        self._watchers = 0
        self._changed = asyncio.Condition()
        self._task: asyncio.Task[None] | None = None
        self._seq = 0
        self._last: Any = None

    @property
    def watched(self) -> bool:
        """Whether a viewer watches."""
        return self._watchers > 0

    @contextlib.asynccontextmanager
    async def watch(self) -> AsyncGenerator[None]:
        """Keep the feed running while the block runs."""
        self._watchers += 1
        self._start()
        try:
            yield
        finally:
            self._watchers -= 1
            if not self._watchers:
                await self._stop()

    def _start(self) -> None:
        if self._task is None:
            running = kept_running("urlab-web-camera", self._run, self._note_failure)
            self._task = background_task("urlab-web-camera", running)

    def _note_failure(self, error: URLabError) -> None:
        self._view.note("error", "console", f"camera {self._path}", str(error))

    async def _stop(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait((task,))

    async def renew(self) -> None:
        """Begin anew: pictures come from a recording now, or no longer."""
        await self._stop()
        self._newest = self._last = None
        if self._watchers:
            self._start()

    async def after(self, seq: int) -> EncodedPicture:
        """Return the newest picture once it is newer than number `seq`."""
        async with self._changed:
            while self._newest is None or self._newest.seq <= seq:
                await self._changed.wait()
            return self._newest

    async def frames(self) -> AsyncGenerator[bytes, None]:
        """Yield the newest `frame` whenever the reader is ready for one."""
        seq = 0
        while True:
            picture = await self.after(seq)
            seq = picture.seq
            yield picture.frame

    async def _run(self) -> None:
        while True:
            try:
                if self._cameras.replay_of(self._path) is not None:
                    await self._follow_recording()
                else:
                    await self._follow_simulation()
            except (URLabError, OSError):
                await anyio.sleep(_LOOK_S)  # the connection is being restored, or the file is damaged; the log says so

    async def _follow_simulation(self) -> None:
        async with self.camera.frames("latest") as frames:
            while True:
                began = time.monotonic()
                if self._client.step_mode is StepMode.LIVE:
                    with contextlib.suppress(URLabTimeoutError):
                        sample = await self._next(frames)
                        await self._publish(sample.pixels, sample.recv_wall_time_ns, sample.sim_time)
                else:
                    pixels = self.camera.latest_frame  # of the newest reply
                    if pixels is not None and pixels is not self._last:
                        self._last = pixels
                        await self._publish(pixels, time.time_ns(), self.camera.sim_time)
                await anyio.sleep(max(0.0, began + _FASTEST_S - time.monotonic()))

    async def _next(self, frames: Stream[CameraSample]) -> CameraSample:
        try:
            return await frames.receive(timeout=_LOOK_S)
        except URLabTimeoutError:
            # Newer servers publish nothing while physics is paused, and draw when they are asked to.
            if not self._client.server.features.live_pictures_in_steps:
                raise
            return await self.camera.capture(timeout=_CAPTURE_S)

    async def _follow_recording(self) -> None:
        at = shown = -1.0
        while (replay := self._cameras.replay_of(self._path)) is not None:
            if at != replay.at:
                at = replay.at
                found = await replay.picture(self._path)
                if found is not None and found[0] != shown:
                    shown = found[0]
                    encoded = await anyio.to_thread.run_sync(_jpeg_of, found[1], abandon_on_cancel=True)
                    head = PictureHead(self._seq + 1, time.time_ns() / 1e6, shown, found[1].mode, recorded=True)
                    await self._show(encoded, head)
            await anyio.sleep(_FASTEST_S)

    async def _publish(self, pixels: Any, received_ns: int, sim_time: float | None) -> None:
        mode = str(self.camera.mode)
        encoded = await anyio.to_thread.run_sync(jpeg, pixels, mode, _QUALITY, abandon_on_cancel=True)
        await self._show(encoded, PictureHead(self._seq + 1, received_ns / 1e6, sim_time, mode))

    async def _show(self, encoded: bytes, head: PictureHead) -> None:
        self._seq = head.seq
        described = msgspec.json.encode(head)
        frame = len(described).to_bytes(4, "little") + described + encoded
        async with self._changed:
            self._newest = EncodedPicture(head.seq, encoded, frame)
            self._changed.notify_all()


def _jpeg_of(picture: RecordedPicture) -> bytes:
    """Return a recorded picture as a browser shows it; one that is a JPEG already as it is."""
    if getattr(picture.message, "format", "") == "jpeg":
        return picture.message.data
    pixels = picture.pixels()
    # Recorded colours are RGB or RGBA in every mode, unlike those of a camera.
    return jpeg(pixels, CameraMode.DEPTH if pixels.dtype == np.float32 else CameraMode.REAL, _QUALITY)
