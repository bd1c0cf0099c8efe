"""The configuration of a server: one record for all of its parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from urlab_client.enums import CameraMode, StepMode
from urlab_client.randomise.declaration import Randomisation
from urlab_client.server.compile.scene_index import ArticulationIndex
from urlab_client.server.dialects import ALPHA, Dialect
from urlab_client.server.faults import Faults
from urlab_client.server.limits import Limits
from urlab_client.server.transport.curve_authentication import CurveServer
from urlab_client.simulation.appearance import RenderQuality
from urlab_client.simulation.controller_config import ControllerConfig


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Configuration of a server; `SimulatedServer` describes and checks it."""

    models: tuple[str, ...] = ()
    play: bool = False
    unpaused: bool = False
    step_mode: StepMode = StepMode.AUTO
    host: str = "127.0.0.1"
    curve: CurveServer | None = None
    insecure_no_auth: bool = False
    limits: Limits = field(default_factory=Limits)
    step_port: int = 0
    state_port: int = 0
    ctrl_port: int = 0
    info_port: int = 0
    camera_port: int = 0
    saved_dir: Path | None = None
    model_roots: tuple[Path, ...] | None = None
    controllers: Mapping[str, ControllerConfig] = field(default_factory=dict[str, ControllerConfig])
    camera_modes: Mapping[str, CameraMode] = field(default_factory=dict[str, CameraMode])
    camera_size: tuple[int, int] | None = None
    render_quality: RenderQuality = "auto"
    mjcf_options: bool = False
    actor_names: Literal["model", "plugin"] = "model"
    faults: Faults | None = None
    shm_dir: Path | None = None
    dialect: Dialect = ALPHA
    user_channels: Mapping[str, Any] = field(default_factory=dict[str, Any])
    randomise: Randomisation | None = None
    instance_id: str = "live"
    index: int = -1

    def controller(self, index: ArticulationIndex) -> ControllerConfig | None:
        """Return the controller of an articulation: the configured one, otherwise that of the level or its MJCF."""
        for name in (index.actor_id, index.key, "*"):
            if name and name in self.controllers:
                return self.controllers[name]
        return None if index.controller is None else index.controller

    def camera_mode(self, index: ArticulationIndex, camera: str) -> CameraMode:
        """Return the mode of an articulation's camera."""
        for name in (index.actor_id, index.key):
            if name and f"{name}/{camera}" in self.camera_modes:
                return self.camera_modes[f"{name}/{camera}"]
        return CameraMode.REAL
