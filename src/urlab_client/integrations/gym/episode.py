"""Episodes over one async client, shared by the single environment and the sessions of a vector environment."""

from __future__ import annotations

import contextlib
import fnmatch
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.aio.arguments import text
from urlab_client.aio.articulation import URLabArticulation
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.client import URLabClient
from urlab_client.enums import CameraMode, ObservationLevel, StepMode
from urlab_client.errors import URLabError
from urlab_client.integrations._episode_variation import variation_of
from urlab_client.integrations.gym.spaces import (
    LEVELS,
    Field,
    Observation,
    Space,
    SpaceMapping,
    camera_space,
    with_cameras,
)
from urlab_client.integrations.gym.task import EpisodeSettings, Start, States, Task, TaskScene, add_observed, with_task
from urlab_client.integrations.gym.wire_variation import WireVariation
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.cameras import CameraDelay
from urlab_client.protocol.messages.session import StepOk
from urlab_client.randomise.declaration import Randomisation
from urlab_client.randomise.variation import EpisodeDraws, declared_in
from urlab_client.sync.client import URLabClient as BlockingClient
from urlab_client.values.pictures import Pixels, observed_pixels, to_rgb


def client_defaults(options: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return client options with the defaults of environments filled in.

    Environments step physics themselves. A MuJoCo version other than the server's does not stop them; the client only
    warns about it.
    """
    return {"step_mode": "direct", "mujoco_version_check": False, **options}


def fields_of(observations: str | Sequence[str]) -> tuple[Field, ...]:
    """Return the fields of an observation level, or the given field names.

    Raises:
        ValueError: The level is unknown.
    """
    if not isinstance(observations, str):
        return tuple(observations)  # type: ignore[return-value]  # SpaceMapping rejects unknown names
    if observations not in LEVELS:
        raise ValueError(
            f"observations must be {' or '.join(map(repr, LEVELS))}, or a sequence of fields, not {observations!r}"
        )
    return LEVELS[observations]


class EnvEpisode:
    """One client that is reset and stepped as an environment.

    Attributes:
        client: The client, discovered and in `direct` or `puppet` mode.
        mapping: Its articulations as spaces.
        observation_space: Space of the mapping, with `cameras` added if cameras are observed.
        frames: The last frame of each requested camera.
        randomise: What varies from episode to episode, or None.
        over_wire: Variation by ops, for a server that varies nothing itself, or None.
    """

    def __init__(
        self,
        client: URLabClient,
        *,
        settings: EpisodeSettings,
        rendered: Sequence[str],
        task: Task | None = None,
        randomise: Randomisation | None = None,
        earlier: EnvEpisode | None = None,
    ) -> None:
        """Set up the episodes of a client.

        Args:
            client: The client.
            settings: Settings of the episodes.
            rendered: Further cameras whose frames `frames` must hold.
            task: Task that chooses the start and extends observations; set up here unless it already is.
            randomise: What varies from episode to episode. If None, the server's own declaration applies.
            earlier: Episodes of the earlier client that this client replaces.

        Raises:
            URLabError: The client has no model or no articulation, the client is in live mode, or the server varies
                its scene differently.
            UnsupportedRandomisation: The server varies nothing itself, and no op does.
            KeyError: A camera is unknown.
            ValueError: An option is out of range.
        """
        model = client.model
        if model is None or not client.articulations:
            raise URLabError(
                "The client has discovered no articulation to act on.",
                hint="Start play, then call discover() with local_model=True.",
            )
        if client.step_mode not in (StepMode.DIRECT, StepMode.PUPPET):
            raise URLabError(
                f"An environment steps physics itself, but the step mode is {client.step_mode}.",
                hint="Make the client with step_mode='direct'.",
            )
        self.client = client
        self.frames: dict[str, Pixels] = {}
        self._model = model
        fields = fields_of(settings.observations)
        self.mapping: SpaceMapping = SpaceMapping(
            model, compiled_prefixes(client), fields, settings.space_mode, settings.articulations
        )
        cameras = settings.cameras
        self._sensors = {key: [*self.mapping.layout(key).sensors] for key in self.mapping.keys}
        minimal = set(fields) <= set(LEVELS["minimal"])
        self._observed_cameras = tuple(cameras)
        self._level = ObservationLevel.MINIMAL if minimal else ObservationLevel.STANDARD
        self._cameras = {name: client_camera(client, name) for name in (*cameras, *rendered)}
        images = {name: camera_space(self._cameras[name].mode, self._cameras[name].resolution) for name in cameras}
        self.observation_space: Space = with_cameras(self.mapping, images)
        self._n_substeps = settings.n_substeps
        self._noise = settings.reset_noise
        self._keyframe = settings.keyframe
        self._task = task
        self._goal: dict[str, Floats] = {}
        self.randomise: Randomisation | None = _in_force(client, model, randomise)
        layouts = {key: self.mapping.layout(key) for key in self.mapping.keys}
        self._variation = variation_of(client, model, layouts)
        self.over_wire: WireVariation | None = None
        if self._variation is None and self.randomise is not None and self.randomise.vary:
            before = None if earlier is None else earlier.over_wire
            self.over_wire = WireVariation(client, model, layouts, self.randomise, before)
            self._variation = self.over_wire.variation
        latencies = () if self.randomise is None else self.randomise.camera
        self._latencies = {
            name: late for late in latencies for name in self._cameras if fnmatch.fnmatchcase(name, late.camera)
        }
        self._draws: EpisodeDraws | None = None
        for push in () if self.randomise is None else self.randomise.push:
            self._pushed(push.body)
        if task is not None:
            if not hasattr(task, "scene"):
                task.setup(TaskScene(model, self.mapping))
            self.observation_space = with_task(self.observation_space, task)

    def states(self) -> States:
        """Return the current state in the form passed to tasks, with n = 1.

        Raises:
            URLabError: The environment has no task, or the client has no local data.
        """
        data = self.client.data
        if self._task is None or data is None:
            raise URLabError("This environment has no task.")
        qpos, qvel = np.array(data.qpos)[None], np.array(data.qvel)[None]
        return States(self._task.scene, qpos, qvel, np.array([data.time]), [self._goal])

    def draws(self) -> dict[str, Any] | None:
        """Return the values drawn for the episode, as in `EpisodeDraws.to_dict`; None if nothing was drawn."""
        return None if self._draws is None else self._draws.to_dict()

    async def reset(
        self, rng: np.random.Generator, keyframe: str | None = None, seed: int | None = None
    ) -> Observation:
        """Reset the simulation, set the set-points to zero and return the first observation.

        Args:
            rng: The environment's generator.
            keyframe: Keyframe to start from instead of the one in the settings.
            seed: Seed of what varies; None if nothing varies.
        """
        client = self.client
        keyframe = self._keyframe if keyframe is None else keyframe
        for articulation in client.articulations.values():
            articulation.ctrl_array[:] = 0.0
        if self._variation is not None and seed is not None:
            self._draws = self._variation.draw(seed)
            if self.over_wire is not None:
                await self.over_wire.apply(self._draws)
        await client.reset(keyframe, seed)
        placed = await self._start_over_wire()
        overrides = self._noisy_positions(rng) if self._noise else None
        if overrides and self.over_wire is None:
            await client.reset(keyframe, seed, overrides)
        elif overrides:  # another reset would undo the start
            placed |= await self._place_joints(overrides)
            overrides = None
        placed |= await self._start_task(rng)
        if self._cameras:
            await self._delay_cameras(seed)
            await self._look(keyframe, seed, overrides, placed)
        return self._observe()

    async def close(self) -> None:
        """Undo the variation by ops. If the server is gone, do nothing."""
        if self.over_wire is not None:
            with contextlib.suppress(URLabError):
                await self.over_wire.undo()

    async def step(self, action: Any, forces: Mapping[str, Floats] = MappingProxyType({})) -> Observation:
        """Apply an action for `n_substeps` and return the observation after it.

        Args:
            action: The action.
            forces: Forces applied during the action, by body, N, world frame, shape (3,).

        Raises:
            ValueError: The action has the wrong shape or is not finite. Nothing was sent.
        """
        return await self.act(self.mapping.set_points(action), forces)

    async def act(self, set_points: Mapping[str, Floats], forces: Mapping[str, Floats]) -> Observation:
        """Step like `step`, given the set-points of each articulation, shape (n_ctrl,)."""
        for key, values in set_points.items():
            self.client.articulations[key].ctrl_array[:] = values
        for body, force in forces.items():
            articulation, name = self._pushed(body)
            articulation.apply_xfrc(name, force=force.tolist())
        cameras = {name: "latest" if name in self._latencies else "sync" for name in self._cameras}
        reply = await self.client.step(self._n_substeps, include_cameras=cameras or False, observations=self._level)
        self._take_frames()
        return self._observe(reply)

    def _noisy_positions(self, rng: np.random.Generator) -> dict[str, dict[str, float]]:
        """Return the current joint positions with noise added."""
        positions: dict[str, dict[str, float]] = {}
        for key in self.mapping.keys:
            articulation = self.client.articulations[key]
            names = self.mapping.joint_names(key, self._model)
            joints = self.mapping.layout(key).joints
            ids = np.array([joints[name] for name in names], dtype=np.intp)
            present = articulation.get_qpos()
            drawn = self._noise.drawn(rng, self._model, ids, np.array([present[name] for name in names]))
            positions[key] = dict(zip(names, drawn.tolist(), strict=True))
        return positions

    async def _start_task(self, rng: np.random.Generator) -> dict[str, Floats]:
        """Let the task choose the start; return the positions of each articulation that it moved."""
        task, data = self._task, self.client.data
        if task is None or data is None:
            return {}
        start = Start(task.scene, np.array(data.qpos))
        task.reset(rng, start)
        self._goal = start.goal
        return await self._place_changed(start.qpos)

    async def _start_over_wire(self) -> dict[str, Floats]:
        """Vary the start if the server does not; return the positions of each articulation that moved."""
        data = self.client.data
        if self.over_wire is None or self._draws is None or data is None:
            return {}
        qpos = np.array(data.qpos)
        self.over_wire.start(self._draws, qpos)
        return await self._place_changed(qpos)

    async def _place_joints(self, positions: Mapping[str, Mapping[str, float]]) -> dict[str, Floats]:
        """Set the positions of hinge and slide joints; return the positions of each articulation that moved."""
        data = self.client.data
        if data is None:
            return {}
        qpos = np.array(data.qpos)
        for key, by_name in positions.items():
            joints = self.mapping.layout(key).joints
            for name, position in by_name.items():
                qpos[self._model.jnt_qposadr[joints[name]]] = position
        return await self._place_changed(qpos)

    async def _place_changed(self, qpos: Floats) -> dict[str, Floats]:
        """Place the articulations whose positions in `qpos` differ from the scene's; return their positions."""
        data = self.client.data
        placed: dict[str, Floats] = {}
        for key in self.mapping.keys:
            address = self.mapping.layout(key).qpos_adr
            if data is not None and not np.array_equal(qpos[address], data.qpos[address]):
                placed[key] = qpos[address]
        await self._place(placed)
        return placed

    async def _place(self, placed: Mapping[str, Floats]) -> None:
        runtime = self.client.runtime
        for key, positions in placed.items():
            await runtime.set_qpos(key, positions, by_name=True)
        if placed:
            await runtime.forward()

    def _pushed(self, body: str) -> tuple[URLabArticulation, str]:
        """Return the articulation of a body, and the body's name in it.

        Raises:
            KeyError: The scene has no such body.
        """
        key, _, name = body.partition("/")
        articulation = self.client.articulations[key]
        articulation.bodies[name]
        return articulation, name

    async def _delay_cameras(self, seed: int | None) -> None:
        if self._latencies:
            delays = {
                name: CameraDelay(delay_s=late.delay_s, jitter_s=late.jitter_s, clock="sim", seed=(seed or 0) + 1)
                for name, late in self._latencies.items()
            }
            await self.client.runtime.set_camera_delay(delays)

    async def _look(
        self,
        keyframe: str | None,
        seed: int | None,
        overrides: Mapping[str, Mapping[str, float]] | None,
        placed: Mapping[str, Floats],
    ) -> None:
        """Take the frames of the current state. Only a puppet step draws without integrating.

        A puppet step changes the solver's warm start. The reset is therefore repeated, so that rollouts with and
        without cameras are the same.
        """
        client, mode = self.client, self.client.step_mode
        if mode is not StepMode.PUPPET:
            await client.runtime.set_mode(StepMode.PUPPET)
        await client.step(0, include_cameras=dict.fromkeys(self._cameras, "sync"))
        self._take_frames()
        if mode is not StepMode.PUPPET:
            await client.runtime.set_mode(mode)
            await client.reset(keyframe, seed, overrides)
            await self._place(placed)

    def _take_frames(self) -> None:
        for name, view in self._cameras.items():
            frame = view.latest_frame
            if name in self._latencies and not view.delivered and name in self.frames:
                continue  # no frame is old enough yet: keep the last one
            if frame is None or not view.delivered:
                raise URLabError(
                    f"The server sent no frame of camera {name!r}.",
                    hint="Run `urlab doctor` to check whether the server can draw.",
                )
            self.frames[name] = frame

    def _observe(self, reply: StepOk | None = None) -> Observation:
        """Return the current observation. Values in the reply of a step take precedence."""
        states = {} if reply is None else reply.per_articulation

        def read(key: str, field: Field) -> Floats:
            state = states.get(key)
            value: Any = None if state is None else getattr(state, field)
            if value is None:
                return self._read(key, field)
            return np.array([n for name in self._sensors[key] for n in value[name]]) if field == "sensors" else value

        observation = self.mapping.observe(read)
        if self._task is not None:
            observation = add_observed(observation, self._task, self._task.observe(self.states())[0])
        if self._observed_cameras:
            observation["cameras"] = {
                name: observed_pixels(self.frames[name], self._cameras[name].mode) for name in self._observed_cameras
            }
        return observation

    def rendered(self, name: str) -> NDArray[np.uint8] | None:
        """Return the last picture of a camera for `render`, shape (H, W, 3), RGB; None if there is none yet."""
        frame = self.frames.get(name)
        return None if frame is None else to_rgb(frame, self._cameras[name].mode)

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
                found = [np.atleast_1d(readings[name]) for name in self._sensors[key]]
                return np.concatenate(found) if found else np.zeros(0)


def _in_force(client: URLabClient, model: mujoco.MjModel, randomise: Randomisation | None) -> Randomisation | None:
    """Return what varies: the given declaration, or the server's own.

    Raises:
        URLabError: The server has a different declaration of its own.
    """
    declared = declared_in(model)
    if randomise is None:
        return declared
    if declared is not None and declared != randomise:
        raise URLabError(
            f"The server at {client.address} varies its scene differently.",
            hint="Omit `randomise`, or start the server with `urlab serve --randomise FILE`.",
        )
    return randomise


def compiled_prefixes(client: URLabClient | BlockingClient) -> dict[str, str]:
    """Return the prefix of the compiled names of each articulation."""
    return {key: articulation.compiled_prefix for key, articulation in client.articulations.items()}


def client_camera(client: URLabClient, name: str) -> URLabCameraView:
    """Return a camera by `ARTICULATION/CAMERA`, or a scene-level one by its name.

    Raises:
        KeyError: The camera does not exist.
    """
    key, slash, camera = text("the name of a camera", name).partition("/")
    if slash:
        return client.articulations[key].cameras[camera]
    return client.global_cameras[name]


def first_camera(client: URLabClient) -> str:
    """Return the first colour camera.

    Raises:
        ValueError: The scene has no colour camera.
    """
    for key, articulation in client.articulations.items():
        for name, view in articulation.cameras.items():
            if view.mode == CameraMode.REAL:
                return f"{key}/{name}"
    for name, view in client.global_cameras.items():
        if view.mode == CameraMode.REAL:
            return name
    raise ValueError("the scene has no colour camera to render: add one to its MJCF, or use render_mode=None")
