"""Pictures of the cameras for browsers: one stream and one encoder per camera, however many watch."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, Callable
from typing import TYPE_CHECKING, Any, Protocol

import anyio
import anyio.to_thread
import msgspec
import numpy as np

from urlab_client.aio.background import background_task, kept_running
from urlab_client.console.messages import PictureHead
from urlab_client.enums import CameraMode, StepMode
from urlab_client.errors import URLabError, URLabTimeoutError
from urlab_client.protocol.messages.streams import CameraSample
from urlab_client.values.pictures import jpeg

if TYPE_CHECKING:
    from urlab_client.aio import Stream, URLabCameraView, URLabClient
    from urlab_client.integrations.record.contents import RecordedPicture

_FASTEST_S = 1 / 30
_LOOK_S = 0.5
_CAPTURE_S = 5.0
_QUALITY = 80


class EncodedPicture:
    """One encoded picture.

    Attributes:
        seq: Number among the pictures of its feed.
        received_ns: When it reached this process, UTC in nanoseconds.
        jpeg: The encoded bytes.
        head: Header for the browser, JSON.
    """

    def __init__(
        self, seq: int, received_ns: int, sim_time: float | None, mode: str, encoded: bytes, *, recorded: bool
    ) -> None:
        self.seq = seq
        self.received_ns = received_ns
        self.jpeg = encoded
        self.head: bytes = msgspec.json.encode(PictureHead(seq, received_ns / 1e6, sim_time, mode, recorded))

    def frame(self) -> bytes:
        """Return length of the head (4 bytes, little-endian), head, and JPEG."""
        return len(self.head).to_bytes(4, "little") + self.head + self.jpeg


class PictureRecording(Protocol):
    """Source of a camera's pictures while a recording of them is replayed."""

    @property
    def at(self) -> float:
        """The replay's position, seconds."""
        ...

    def has_pictures(self, camera: str) -> bool:
        """Return whether it has pictures of a camera, and is shown."""
        ...

    async def picture(self, camera: str) -> tuple[float, RecordedPicture] | None:
        """Return the present picture of a camera and its time."""
        ...


class Feed:
    """The newest picture of one camera, encoded once; receives only while a viewer watches.

    Args:
        client: The client.
        view: The camera.
        path: Its name, as `ARTICULATION/CAMERA`.
        recording: The replay, which may be inactive.
        failed: Called with each unexpected error; the feed begins anew after a pause.

    Attributes:
        newest: The newest picture, or None.
        view: The camera.
    """

    def __init__(
        self,
        client: URLabClient,
        view: URLabCameraView,
        path: str,
        recording: PictureRecording,
        failed: Callable[[URLabError], None],
    ) -> None:
        self.newest: EncodedPicture | None = None
        self._client = client
        self.view = view
        self._path = path
        self._recording = recording
        self._failed = failed
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
    async def watch(self) -> AsyncGenerator[Feed]:
        """Keep the feed running while the block runs."""
        self._watchers += 1
        self._start()
        try:
            yield self
        finally:
            self._watchers -= 1
            if not self._watchers:
                await self._stop()

    def _start(self) -> None:
        if self._task is None:
            running = kept_running("urlab-web-camera", self._run, self._failed)
            self._task = background_task("urlab-web-camera", running)

    async def _stop(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait((task,))

    async def renew(self) -> None:
        """Begin anew: pictures come from a recording now, or no longer."""
        await self._stop()
        self.newest = self._last = None
        if self._watchers:
            self._start()

    async def after(self, seq: int) -> EncodedPicture:
        """Return the newest picture once it is newer than number `seq`."""
        async with self._changed:
            while self.newest is None or self.newest.seq <= seq:
                await self._changed.wait()
            return self.newest

    async def _run(self) -> None:
        while True:
            try:
                if self._recording.has_pictures(self._path):
                    await self._follow_recording()
                else:
                    await self._follow_simulation()
            except (URLabError, OSError):
                await anyio.sleep(_LOOK_S)  # the connection is being restored, or the file is damaged; the log says so

    async def _follow_simulation(self) -> None:
        async with self.view.frames("latest") as frames:
            while True:
                began = time.monotonic()
                if self._client.step_mode is StepMode.LIVE:
                    await self._take_from(frames)
                else:
                    await self._take_from_replies()
                await anyio.sleep(max(0.0, began + _FASTEST_S - time.monotonic()))

    async def _follow_recording(self) -> None:
        at = shown = -1.0
        while self._recording.has_pictures(self._path):
            if at != self._recording.at:
                at = self._recording.at
                found = await self._recording.picture(self._path)
                if found is not None and found[0] != shown:
                    shown = found[0]
                    encoded = await anyio.to_thread.run_sync(_jpeg_of, found[1], abandon_on_cancel=True)
                    await self._show(encoded, time.time_ns(), shown, found[1].mode, recorded=True)
            await anyio.sleep(_FASTEST_S)

    async def _take_from(self, frames: Stream[CameraSample]) -> None:
        with contextlib.suppress(URLabTimeoutError):
            try:
                await self._take(await frames.receive(timeout=_LOOK_S))
            except URLabTimeoutError:
                # Newer servers publish nothing while physics is paused, and draw when they are asked to.
                if self._client.server.features.live_pictures_in_steps:
                    await self._take(await self.view.capture(timeout=_CAPTURE_S))

    async def _take(self, sample: CameraSample) -> None:
        await self._publish(sample.pixels, sample.recv_wall_time_ns, sample.sim_time)

    async def _take_from_replies(self) -> None:
        pixels = self.view.latest_frame
        if pixels is not None and pixels is not self._last:
            self._last = pixels
            await self._publish(pixels, time.time_ns(), self.view.sim_time)

    async def _publish(self, pixels: Any, received_ns: int, sim_time: float | None) -> None:
        mode = str(self.view.mode)
        encoded = await anyio.to_thread.run_sync(jpeg, pixels, mode, _QUALITY, abandon_on_cancel=True)
        await self._show(encoded, received_ns, sim_time, mode, recorded=False)

    async def _show(
        self, encoded: bytes, received_ns: int, sim_time: float | None, mode: str, *, recorded: bool
    ) -> None:
        self._seq += 1
        async with self._changed:
            self.newest = EncodedPicture(self._seq, received_ns, sim_time, mode, encoded, recorded=recorded)
            self._changed.notify_all()


def _jpeg_of(picture: RecordedPicture) -> bytes:
    """Return a recorded picture as a browser shows it; one that is a JPEG already as it is."""
    if getattr(picture.message, "format", "") == "jpeg":
        return picture.message.data
    pixels = picture.pixels()
    # Recorded colours are RGB or RGBA in every mode, unlike those of a camera.
    return jpeg(pixels, CameraMode.DEPTH if pixels.dtype == np.float32 else CameraMode.REAL, _QUALITY)
