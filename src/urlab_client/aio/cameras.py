"""Cameras as the handshake describes them, with the newest frame received."""

from __future__ import annotations

from typing import Any

import numpy as np

from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.streams.pictures import LatestPicture
from urlab_client.aio.streams.publishers import Publishers, SharedFrame
from urlab_client.aio.streams.sources import Camera
from urlab_client.aio.streams.stream import BUFFER_BYTES, BUFFER_ITEMS, Stream
from urlab_client.enums import CameraMode
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.messages.streams import CameraSample, StreamPolicy, StreamPolicyName
from urlab_client.values.descriptions import CameraDescription
from urlab_client.values.html import fields
from urlab_client.values.names import Local
from urlab_client.values.pictures import Pixels, thumbnail

__all__ = ["SharedFrame", "URLabCameraView"]


class LocalCamera(Local):
    """What both clients share of `URLabCameraView`: everything that sends nothing."""

    __slots__ = ()

    _state: LatestPicture

    @property
    def delivered(self) -> bool:
        """False if the last step that requested a frame got none; `latest_frame` is then older than the state."""
        return self._state.delivered

    @property
    def name(self) -> str:
        """Name without the articulation's prefix."""
        return self._state.camera.name

    @property
    def info(self) -> CameraInfo:
        """Description from the handshake."""
        return self._state.camera.info

    @property
    def latest_frame(self) -> Pixels | None:
        """Newest frame: real (H, W, 4) RGBA, depth (H, W) metres, otherwise (H, W, 4) BGRA.

        Each frame is a new array, which later frames do not overwrite. Until the next frame arrives, all callers get
        the same array.
        """
        return self._state.newest()[0]

    @property
    def sim_time(self) -> float | None:
        """Simulation time of the newest frame, seconds; None in live mode unless the server sends it."""
        return self._state.newest()[1]

    @property
    def frame_id(self) -> int | None:
        """Id of the state snapshot that the newest frame shows, comparable to `StepOk.frame_id`; None if not sent."""
        return self._state.newest()[2]

    @property
    def mode(self) -> CameraMode | str:
        """Meaning of the pixels; a plain string for a mode that this client does not know."""
        return self._state.camera.mode

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
        """Return name, mode, resolution and field of view."""
        width, height = self.resolution
        return CameraDescription(name=self.name, mode=str(self.mode), width=width, height=height, fovy=self.fovy)


class URLabCameraView(LocalCamera):
    """One camera. Frames arrive with `client.step(include_cameras=…)`, and automatically in live mode."""

    def __init__(self, name: str, info: CameraInfo, publishers: Publishers) -> None:
        # For the client. Not declared above, to keep them out of the façade.
        self.camera: Camera = Camera(name, info)
        self.pictures: LatestPicture = LatestPicture(publishers.camera(self.camera, asked=False))
        super().__init__(self.pictures)
        self._publishers = publishers

    async def capture(self, *, timeout: Timeout = DEFAULT) -> CameraSample:
        """Take a picture now, in any step mode, without a step; it also becomes `latest_frame`.

        The picture shows the simulation as it is after this call, and no simulation time passes. In `direct` and
        `puppet` mode the client briefly switches the server to live mode, paused, which takes a few requests;
        `step(include_cameras=…)` is faster for a picture of every step. A camera that is switched off is switched on
        for the duration of the call. Servers of the alpha do not number their pictures; with them, this returns the
        second picture that arrives after the call.

        Args:
            timeout: Seconds to wait; None waits without limit. The default is the client's timeout; it is at least 30 s
                before the first picture of this camera, because the server may still be initialising OpenGL.

        Returns:
            The picture; `.png()` and `.jpeg()` encode it.

        Raises:
            PictureTimeout: No picture arrived in time: the camera is off in the editor, or the server cannot render.
            NoActiveManager: No play session is running.
            ModeLocked: The project is locked to a mode that delivers pictures only with steps.
            URLabError: The camera is no longer in the scene.
        """
        (sample,) = await self._publishers.capture([self.camera], timeout)
        return sample

    def frames(
        self,
        policy: StreamPolicy | StreamPolicyName = "latest",
        *,
        max_rate: float | None = None,
        buffer: int = BUFFER_ITEMS,
        buffer_bytes: int = BUFFER_BYTES,
        timeout: Timeout = DEFAULT,
    ) -> Stream[CameraSample]:
        """Stream the camera's pictures as the server publishes them.

        Servers of the alpha publish pictures in live mode only, the plugin without time or number. Newer servers
        publish them in every mode, once per state. While the simulation stands still, a camera that this call switches
        on sends the present state if it has not sent it before; nothing else arrives.

        Args:
            policy: `latest`, or `all` within the limits of the buffer.
            max_rate: Maximum number of pictures per second, with `latest`; each is the newest at its time. None for no
                limit.
            buffer: Maximum number of buffered pictures, with `all`.
            buffer_bytes: Maximum number of buffered bytes, with `all`.
            timeout: Seconds that iteration waits for each picture. The default is the client's timeout for the first
                one and no limit after that. The default for the first one is at least 30 s if the server is connected
                and in live mode, because it may still be initialising OpenGL. None waits without limit.

        Raises:
            ValueError: The policy is unknown, the buffer is empty, or `max_rate` is not above 0 or used with another
                policy than `latest`.
            ClientClosed: The client was closed.
        """
        self._publishers.check_open()
        return Stream(
            self._publishers.camera(self.camera, policy),
            policy=policy,
            max_rate=max_rate,
            buffer=buffer,
            buffer_bytes=buffer_bytes,
            timeout=timeout,
            default_timeout=self._publishers.default_timeout,
        )

    def shared_frame(self) -> SharedFrame | None:
        """Return the newest picture without copying it, for `transport="shm"`; see `SharedFrame` for its lifetime.

        None unless the client is receiving the camera's pictures from shared memory: in live mode, or in any mode while
        a stream of `frames` is open.
        """
        return self._publishers.shared_frame(self.camera)

    def __repr__(self) -> str:
        return f"<URLabCameraView {self.name!r} {self.mode} {self.resolution[0]}x{self.resolution[1]}>"

    def _repr_html_(self) -> str:
        frame = self.latest_frame
        shown = None if frame is None else thumbnail(frame, self.mode, self.name)
        return fields(
            "URLabCameraView", {**self.describe().to_dict(), "sim_time": self.sim_time, "latest_frame": shown}
        )
