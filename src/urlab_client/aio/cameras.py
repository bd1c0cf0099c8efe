"""Cameras as the handshake describes them, with the newest frame that arrived."""

from __future__ import annotations

from typing import Any

import numpy as np

from urlab_client.protocol.enums import CameraMode, known
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.rows import Pixels

__all__ = ["URLabCameraView"]


class URLabCameraView:
    """One camera. Frames arrive with `client.step(include_cameras=…)`."""

    name: str
    """Name without the articulation's prefix."""
    info: CameraInfo
    """The handshake's description."""
    latest_frame: Pixels | None
    """Newest frame: real (H, W, 4) RGBA, depth (H, W) metres, semantic and instance (H, W, 4) BGRA; yours to keep."""
    sim_time: float | None
    """Simulation time of the reply that carried the newest frame, seconds."""
    delivered: bool
    """False when the last step that asked for a frame got none: `latest_frame` is then older than the state."""

    def __init__(self, name: str, info: CameraInfo) -> None:
        self.name = name
        self.info = info
        self.latest_frame = None
        self.sim_time = None
        self.delivered = True

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

    def __repr__(self) -> str:
        return f"<URLabCameraView {self.name!r} {self.mode} {self.resolution[0]}x{self.resolution[1]}>"
