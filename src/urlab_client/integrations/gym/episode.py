"""Episodes over one async client, shared by the single environment and the sessions of a vector environment."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import spans
from urlab_client.aio.articulation import URLabArticulation, compiled_prefixes
from urlab_client.aio.client import URLabClient
from urlab_client.aio.model.layout import articulation_layouts
from urlab_client.aio.model.mirror import require_local
from urlab_client.enums import CameraMode, ControlMode, ObservationLevel, StepMode
from urlab_client.errors import ModeLocked, URLabError
from urlab_client.integrations._variation import (
    WireVariation,
    controlled_actuators,
    server_variation,
)
from urlab_client.integrations.gym.settings import EpisodeSettings
from urlab_client.integrations.gym.spaces import (
    LEVELS,
    Field,
    Observation,
    Space,
    SpaceMapping,
    camera_space,
    with_cameras,
)
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.cameras import CameraDelay
from urlab_client.randomise.declaration import Randomisation
from urlab_client.randomise.variation import EpisodeDraws, declared_in
from urlab_client.values.pictures import Pixels, observed_pixels, to_rgb

MEASURED: Final = ("sensordata", "ctrl", "act")
"""What `EnvEpisode.measured` returns."""


class EnvEpisode:
    """One client that is reset and stepped as an environment.

    Attributes:
        client: The client.
        model: Its model.
        settings: Settings of the episodes.
        mapping: Its articulations as spaces.
        observation_space: The space of the observed fields and pictures.
        rendered_camera: The camera that `render` shows, or None.
        randomise: What varies from episode to episode, or None.
        over_wire: Variation by ops, for a server that varies nothing itself, or None.
        measures: Whether the task asks for what `measured` returns.
    """

    def __init__(
        self,
        client: URLabClient,
        *,
        settings: EpisodeSettings,
        randomise: Randomisation | None = None,
        earlier: EnvEpisode | None = None,
    ) -> None:
        """Set up the episodes of a client, which may replace that of `earlier` episodes; see `URLabEnv` for errors."""
        model = require_local(client.model, "An environment")
        if not client.articulations:
            raise URLabError(
                "The client has discovered no articulation to act on.",
                hint="Add a robot to the scene, and call discover() during play.",
            )
        if client.step_mode not in (StepMode.DIRECT, StepMode.PUPPET):
            raise URLabError(
                f"An environment steps physics itself, but the step mode is {client.step_mode}.",
                hint="Make the client with step_mode='direct'.",
            )
        self.client = client
        self.model: mujoco.MjModel = model
        self.settings = settings
        self.mapping: SpaceMapping = _space_mapping(client, model, settings)
        layouts = {key: self.mapping.layout(key) for key in self.mapping.keys}
        self._sensors = {key: [*layout.sensors] for key, layout in layouts.items()}
        self.measures: bool = settings.task is not None and settings.task.measured
        minimal = set(settings.fields) <= set(LEVELS["minimal"]) and not self.measures
        self._level = ObservationLevel.MINIMAL if minimal else ObservationLevel.STANDARD
        self.rendered_camera: str | None = _rendered_camera(client, settings)
        self._cameras = {name: client.camera(name) for name in filter(None, (*settings.cameras, self.rendered_camera))}
        self._frames: dict[str, Pixels] = {}
        self._step_before = 0
        images = {
            name: camera_space(self._cameras[name].mode, self._cameras[name].resolution) for name in settings.cameras
        }
        self.observation_space: Space = with_cameras(self.mapping, images)
        self.randomise: Randomisation | None = _in_force(client, model, randomise)
        self._variation = server_variation(client, model, layouts)
        self.over_wire: WireVariation | None = None
        if self._variation is None and self.randomise is not None and self.randomise.vary:
            before = None if earlier is None else earlier.over_wire
            self.over_wire = WireVariation(client, model, layouts, self.randomise, before)
            self._variation = self.over_wire.variation
        self._latencies = {} if self.randomise is None else self.randomise.latencies(self._cameras)
        self._draws: EpisodeDraws | None = None
        for push in () if self.randomise is None else self.randomise.push:
            self._pushed(push.body)

    def state(self) -> tuple[Floats, Floats, float]:
        """Return the positions and velocities of the whole scene, and the simulation time."""
        data = require_local(self.client.data, "The state of the scene")
        return data.qpos, data.qvel, data.time

    def measured(self) -> dict[str, Floats]:
        """Return `sensordata`, `ctrl` and `act` of the whole scene; see `States.measured`."""
        data, model = require_local(self.client.data, "The state of the scene"), self.model
        sensordata = np.zeros(model.nsensordata)
        for key in self.mapping.keys:
            ids = [*self.mapping.layout(key).sensors.values()]
            sensordata[spans(model.sensor_adr[ids], model.sensor_dim[ids])] = self._read(key, "sensors")
        return dict(zip(MEASURED, (sensordata, data.ctrl, data.act), strict=True))

    def draws(self) -> dict[str, Any] | None:
        """Return the values drawn for the episode, as in `EpisodeDraws.to_dict`; None if nothing was drawn."""
        return None if self._draws is None else self._draws.to_dict()

    async def reset(
        self,
        rng: np.random.Generator,
        keyframe: str | None = None,
        seed: int | None = None,
        begin: Callable[[np.random.Generator, Floats, Floats], None] | None = None,
    ) -> Observation:
        """Reset the simulation, set the set-points to zero and return the first observation.

        `seed` determines what varies; `begin` lets a task change the start in place: positions, shape (nq,), and
        velocities, shape (nv,).
        """
        client = self.client
        keyframe = self.settings.keyframe if keyframe is None else keyframe
        for articulation in client.articulations.values():
            articulation.ctrl_array[:] = 0.0
        if self._variation is not None and seed is not None:
            self._draws = self._variation.draw(seed)
            if self.over_wire is not None:
                await self.over_wire.apply(self._draws)
        await client.reset(keyframe, seed)
        qpos, qvel = map(np.array, self.state()[:2])
        if self.over_wire is not None and self._draws is not None:
            self.over_wire.variation.start(self._draws, qpos, qvel)
        if self.settings.reset_noise:
            for key in self.mapping.keys:
                self.settings.reset_noise.add(rng, self.model, self.mapping.scalar_joints(key, self.model), qpos)
        if begin is not None:
            begin(rng, qpos, qvel)
        await self._delay_cameras(seed)
        if not np.array_equal(qvel, self.state()[1]):
            try:
                await self._push(qpos, qvel)
            except ModeLocked as locked:
                locked.hint = "Start velocities are set in puppet mode: unpin the mode, or start at rest."
                raise
        else:
            await self._place(qpos)
            if self._cameras or any(observer.step_cameras(0) for observer in client.observers):
                await self._look(keyframe, seed, qpos)
        self._step_before = client.step_count
        return self._observe()

    @property
    def step_count(self) -> int:
        """Physics steps since the reset."""
        return self.client.step_count - self._step_before

    async def close(self) -> None:
        """Undo the variation by ops. If the server is gone, do nothing."""
        if self.over_wire is not None:
            with contextlib.suppress(URLabError):
                await self.over_wire.undo()

    async def step(
        self, set_points: Floats, forces: Mapping[str, Floats], before: Floats, late_steps: int
    ) -> Observation:
        """Apply set-points for `n_substeps` and return the observation after them; see `Applied`."""
        if late_steps:
            await self._apply(before, forces, late_steps, {})
        cameras = {name: "latest" if name in self._latencies else "sync" for name in self._cameras}
        await self._apply(set_points, forces, self.settings.n_substeps - late_steps, cameras)
        self._take_frames()
        return self._observe()

    async def _apply(
        self, set_points: Floats, forces: Mapping[str, Floats], n_steps: int, cameras: dict[str, str]
    ) -> None:
        for key, values in self.mapping.split(set_points).items():
            self.client.articulations[key].ctrl_array[:] = values
        for body, force in forces.items():
            articulation, name = self._pushed(body)
            articulation.apply_xfrc(name, force=force.tolist())
        await self.client.step(n_steps, include_cameras=cameras or False, observations=self._level)

    async def _place(self, qpos: Floats) -> None:
        """Place the articulations whose positions in `qpos` differ from the scene's."""
        runtime, now = self.client.runtime, np.array(self.state()[0])
        moved = [
            (key, address)
            for key in self.mapping.keys
            if not np.array_equal(qpos[address := self.mapping.layout(key).qpos_adr], now[address])
        ]
        for key, address in moved:
            await runtime.set_qpos(key, qpos[address], by_name=True)
        if moved:
            await runtime.forward()

    def _pushed(self, body: str) -> tuple[URLabArticulation, str]:
        """Return the articulation of a body, and the body's name in it."""
        meant = self.mapping.id("body", body)
        for articulation in self.client.articulations.values():
            for found in articulation.bodies.values():
                if found.id == meant:
                    return articulation, found.name
        raise ValueError(f"push: body {body!r} belongs to no articulation")

    async def _delay_cameras(self, seed: int | None) -> None:
        if self._latencies:
            delays = {
                name: CameraDelay(delay_s=late.delay_s, jitter_s=late.jitter_s, clock="sim", seed=(seed or 0) + 1)
                for name, late in self._latencies.items()
            }
            await self.client.runtime.set_camera_delay(delays)

    async def _look(self, keyframe: str | None, seed: int | None, qpos: Floats) -> None:
        """Take the frames of the current state, also for a recording.

        A puppet step changes the solver's warm start. The reset is therefore repeated, so that rollouts with and
        without cameras are the same.
        """
        try:
            await self._push(*self.state()[:2])
        except ModeLocked:
            if self._cameras:
                raise
            return  # the recording has no picture of the start, and conversions say so
        if self.client.step_mode is not StepMode.PUPPET:
            await self.client.reset(keyframe, seed)
            await self._place(qpos)

    async def _push(self, qpos: Floats, qvel: Floats) -> None:
        """Set positions and velocities of the whole scene, and take the frames of that state.

        Only a puppet step sets velocities, and only it draws without integrating.
        """
        client, mode = self.client, self.client.step_mode
        data = require_local(client.data, "The state of the scene")
        if mode is not StepMode.PUPPET:
            await client.runtime.set_mode(StepMode.PUPPET)
        try:
            data.qpos[:], data.qvel[:] = qpos, qvel
            await client.step(0, include_cameras=dict.fromkeys(self._cameras, "sync") or False)
            self._take_frames()
        finally:
            if mode is not StepMode.PUPPET:
                await client.runtime.set_mode(mode)

    def _take_frames(self) -> None:
        for name, view in self._cameras.items():
            frame = view.latest_frame
            if name in self._latencies and not view.delivered and name in self._frames:
                continue  # no frame is old enough yet: keep the last one
            if frame is None or not view.delivered:
                raise URLabError(
                    f"The server sent no frame of camera {name!r}.",
                    hint="Run `urlab doctor` to check whether the server can draw.",
                )
            self._frames[name] = frame

    def _observe(self) -> Observation:
        """Return the current observation, without what a task adds."""
        observation = self.mapping.observe(self._read)
        if self.settings.cameras:
            observation["cameras"] = {
                name: observed_pixels(self._frames[name], self._cameras[name].mode) for name in self.settings.cameras
            }
        return observation

    def rendered(self) -> NDArray[np.uint8] | None:
        """Return the last picture for `render`, shape (H, W, 3), RGB; None if there is none yet."""
        frame = self._frames.get(self.rendered_camera or "")
        return (
            None
            if frame is None or self.rendered_camera is None
            else to_rgb(frame, self._cameras[self.rendered_camera].mode)
        )

    def _read(self, key: str, field: Field) -> Floats:
        articulation = self.client.articulations[key]
        match field:
            case "qpos":
                return articulation.qpos_array
            case "qvel":
                return articulation.qvel_array
            case "ctrl":
                return articulation.last_applied_ctrl
            case "act":
                return articulation.act_array
            case "sensors":
                readings = articulation.get_sensors()
                found = [readings[name] for name in self._sensors[key]]
                return np.concatenate(found) if found else np.zeros(0)


def _in_force(client: URLabClient, model: mujoco.MjModel, randomise: Randomisation | None) -> Randomisation | None:
    """Return what varies: the given declaration, or the server's own, which must not differ from it."""
    declared = declared_in(model)
    if randomise is None:
        return declared
    if declared is not None and declared != randomise:
        raise URLabError(
            f"The server at {client.address} varies its scene differently.",
            hint="Omit `randomise`, or start the server with `urlab serve --randomise FILE`.",
        )
    return randomise


def _space_mapping(client: URLabClient, model: mujoco.MjModel, settings: EpisodeSettings) -> SpaceMapping:
    """Return the articulations of a discovered client as the spaces of an environment."""
    prefixes = compiled_prefixes(client.articulations)
    controlled = {
        key: layout
        for key, layout in articulation_layouts(model, prefixes).items()
        if client.articulations[key].control_mode is not ControlMode.RAW
    }
    return SpaceMapping(
        model,
        prefixes,
        settings.fields,
        settings.space_mode,
        settings.articulations,
        actions=settings.actions,
        targets=controlled_actuators(client, controlled),
    )


def _rendered_camera(client: URLabClient, settings: EpisodeSettings) -> str | None:
    """Return the camera that `render` shows, by default the first colour camera; None without a render mode."""
    if settings.render_mode is None:
        return None
    if settings.render_camera:
        return settings.render_camera
    views = {f"{key}/{name}": view for key, it in client.articulations.items() for name, view in it.cameras.items()}
    for name, view in (*views.items(), *client.global_cameras.items()):
        if view.mode == CameraMode.REAL:
            return name
    raise ValueError("the scene has no colour camera to render: add one to its MJCF, or use render_mode=None")
