"""Cameras as the handshake describes them, with the newest frame that arrived."""

from __future__ import annotations

from typing import Any

import numpy as np

from urlab_client.aio.deadline import DEFAULT, Timeout
from urlab_client.aio.live.live_state import LatestPicture
from urlab_client.aio.live.publishers import Publishers, SharedFrame
from urlab_client.aio.streams import BUFFER_BYTES, BUFFER_ITEMS, Stream
from urlab_client.protocol.descriptions import CameraDescription
from urlab_client.protocol.enums import CameraMode, known
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.messages.streams import CameraSample, StreamPolicy
from urlab_client.protocol.picture_memory import PictureMemory
from urlab_client.protocol.pixels import Pixels

__all__ = ["SharedFrame", "URLabCameraView"]


class URLabCameraView:
    """One camera. Frames arrive with `client.step(include_cameras=…)`, and by themselves in live mode."""

    name: str
    """Name without the articulation's prefix."""
    info: CameraInfo
    """The handshake's description."""
    delivered: bool
    """False when the last step that asked for a frame got none: `latest_frame` is then older than the state."""

    def __init__(self, name: str, info: CameraInfo, publishers: Publishers) -> None:
        self.name = name
        self.info = info
        self.delivered = True
        self._publishers = publishers
        # For the client. Not declared above, so that the façade has none.
        self.memory: PictureMemory = PictureMemory()
        self.pictures: LatestPicture = LatestPicture(publishers.camera(self, asked=False))

    @property
    def latest_frame(self) -> Pixels | None:
        """Newest frame: real (H, W, 4) RGBA, depth (H, W) metres, else (H, W, 4) BGRA.

        Yours to keep: later frames are other arrays. Until one comes, this is the same array for all who ask.
        """
        return self.pictures.newest()[0]

    @property
    def sim_time(self) -> float | None:
        """Simulation time of the newest frame, seconds; in live mode None unless the server sends it along."""
        return self.pictures.newest()[1]

    @property
    def frame_id(self) -> int | None:
        """Which snapshot of the state the newest frame shows, to be compared with `StepOk.frame_id`; None if unsaid."""
        return self.pictures.frame_id()

    @property
    def mode(self) -> CameraMode | str:
        """What its pixels mean; a plain string for a mode this client does not know."""
        return known(CameraMode, self.info.mode)

    @property
    def resolution(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.info.resolution

    @property
    def fovy(self) -> float:
        """Vertical field of view, degrees."""
        return self.info.fovy

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8, or float32 for depth."""
        return np.dtype(np.float32 if self.mode == CameraMode.DEPTH else np.uint8)

    def describe(self) -> CameraDescription:
        """Return what it is."""
        width, height = self.resolution
        return CameraDescription(name=self.name, mode=str(self.mode), width=width, height=height, fovy=self.fovy)

    async def capture(self, *, timeout: Timeout = DEFAULT) -> CameraSample:
        """Take a picture now, in any step mode, without a step; it is then also `latest_frame`.

        It shows the simulation after this call, and time does not pass for it: in `direct` and `puppet` mode the
        server is brought into live mode for a moment, paused, which takes a few requests; a picture of every step is
        quicker with `step(include_cameras=…)`. A camera that is switched off is switched on for as long. A server of
        the alpha does not number its pictures: there the second one counts that arrives after the call.

        Args:
            timeout: Seconds to wait; None waits without limit. By default the client's, or 30 where that is less and
                no picture of this camera has come before: the server may still be looking for OpenGL.

        Returns:
            The picture; `.png()` and `.jpeg()` encode it.

        Raises:
            PictureTimeout: None came in time: the camera is off in the editor, or the server cannot draw.
            NoActiveManager: No play session runs.
            ModeLocked: The project pins a mode in which pictures come with steps only.
            URLabError: The camera is not in the scene any more.
        """
        (sample,) = await self._publishers.capture([self], timeout)
        return sample

    def frames(
        self,
        policy: str | StreamPolicy = "latest",
        *,
        max_rate: float | None = None,
        buffer: int = BUFFER_ITEMS,
        buffer_bytes: int = BUFFER_BYTES,
        timeout: Timeout = DEFAULT,
    ) -> Stream[CameraSample]:
        """Stream its pictures, as the server publishes them.

        A server of the alpha does so in live mode only, the plugin without time or number. Newer servers do in every
        mode, each state once: nothing comes while the simulation stands still.

        Args:
            policy: `latest`, or `all` within the buffer.
            max_rate: With `latest`, pictures per second at most, each the newest by then; None for as many as come.
            buffer: Pictures that may wait, with `all`.
            buffer_bytes: Bytes that may wait, with `all`.
            timeout: Seconds that iterating waits for each picture; by default the client's for the first one, or 30
                where that is less and the server is there and in live mode (it may still be looking for OpenGL), and
                then without limit; None waits.

        Raises:
            ValueError: Unknown policy, an empty buffer, or a rate that is not above 0 or not for this policy.
        """
        return Stream(
            self._publishers.camera(self, policy),
            policy=policy,
            max_rate=max_rate,
            buffer=buffer,
            buffer_bytes=buffer_bytes,
            timeout=timeout,
            default_timeout=self._publishers.default_timeout,
        )

    def shared_frame(self) -> SharedFrame | None:
        """Return the newest picture without copying it, for `transport="shm"`: see `SharedFrame` for what that means.

        None unless the camera's pictures are being received from shared memory, as in live mode, or in any mode while
        a stream of `frames` is open.
        """
        return self._publishers.shared_frame(self)

    def __repr__(self) -> str:
        return f"<URLabCameraView {self.name!r} {self.mode} {self.resolution[0]}x{self.resolution[1]}>"
