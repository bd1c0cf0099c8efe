"""`URLabBatchEnv`: many copies of a scene, stepped in batch by MuJoCo itself, without a wire."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal

import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from urlab_client._mujoco import batch_class
from urlab_client.aio.launch import with_model_options
from urlab_client.aio.model.layout import ArticulationLayout
from urlab_client.aio.model.mirror import model_names
from urlab_client.enums import ControllerKind
from urlab_client.errors import UnknownKeyframe, URLabError
from urlab_client.integrations.gym.batch_variation import BatchVariation
from urlab_client.integrations.gym.env import RewardFn, TerminationFn
from urlab_client.integrations.gym.episode import client_defaults, compiled_prefixes, fields_of, first_camera
from urlab_client.integrations.gym.late_cameras import LateCameras
from urlab_client.integrations.gym.pictures import VISIBLE, BatchPictures, PictureScene, Visible
from urlab_client.integrations.gym.spaces import (
    Field,
    Observation,
    SpaceMapping,
    SpaceMode,
    with_cameras,
)
from urlab_client.integrations.gym.starts import ResetNoise
from urlab_client.integrations.gym.task import (
    EpisodeSettings,
    Start,
    States,
    Task,
    TaskScene,
    add_observed,
    check_alone,
    with_task,
)
from urlab_client.integrations.gym.threaded_batch import ThreadedBatch
from urlab_client.integrations.gym.vectorized import Floats, Found, Indices, Vectorized, check_render_mode
from urlab_client.integrations.gym.warp_batch import WarpBatch
from urlab_client.randomise.declaration import Randomisation
from urlab_client.randomise.variation import declared_in
from urlab_client.simulation.controller_config import ControllerConfig
from urlab_client.simulation.controllers import Actuated, Controller, PassthroughController, PDController
from urlab_client.sync._facade import aio_of
from urlab_client.sync.client import URLabClient
from urlab_client.values.names import compiled_names
from urlab_client.values.pictures import Pixels, observed_pixels, to_rgb

_BOUND: Final = ("qpos", "qvel", "ctrl", "act", "sensordata", "time", "xfrc_applied")


class URLabBatchEnv(Vectorized):
    """Many copies of one scene in this process, stepped by `mujoco.batch` on a thread pool.

    MuJoCo before 3.17 lacks this module; Python threads then step the copies, with the same results.

    The environment fetches the compiled scene from a server once and then no longer needs the server. Observations,
    rewards and autoreset equal those of `URLabVectorEnv`, bit for bit for the same seeds and actions, as long as no
    wrench is applied. Pictures are equal, too, if the same driver draws them: this process uses the code and the
    settings of a simulated server. Controllers act before each physics step, as on the server, with the parameters
    that they had when the scene was fetched.
    """

    def __init__(
        self,
        address: str,
        num_envs: int,
        *,
        space_mode: SpaceMode | None = None,
        observations: str | Sequence[str] | None = None,
        reward_fn: RewardFn | None = None,
        termination_fn: TerminationFn | None = None,
        max_episode_steps: int | None = None,
        cameras: Sequence[str] | None = None,
        n_substeps: int | None = None,
        reset_noise: float | ResetNoise | None = None,
        keyframe: str | None = None,
        render_mode: Literal["rgb_array"] | None = None,
        render_camera: str | None = None,
        task: Task | None = None,
        randomise: Randomisation | str | os.PathLike[str] | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        n_threads: int = 0,
        engine: Literal["mujoco", "warp"] = "mujoco",
        engine_options: Mapping[str, int] = MappingProxyType({}),
        client_options: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        """Fetch the scene and make the batch.

        Args:
            address: Source of the scene: `sim://MODEL`, with the options of the model, or a server during play.
            num_envs: Number of copies.
            space_mode: See `URLabEnv`.
            observations: See `URLabEnv`.
            reward_fn: See `URLabVectorEnv`.
            termination_fn: See `URLabVectorEnv`.
            max_episode_steps: See `URLabEnv`.
            cameras: See `URLabEnv`. This process draws them in every step.
            n_substeps: See `URLabEnv`.
            reset_noise: See `URLabEnv`.
            keyframe: See `URLabEnv`.
            render_mode: None or `rgb_array`. With `rgb_array`, only `render` draws; steps cost the same.
            render_camera: Camera that `render` shows; the first colour camera of the scene by default.
            task: See `URLabEnv`. One instance serves all environments.
            randomise: See `URLabEnv`. Cameras have the same latency as a server's, but the jitter is drawn differently.
            autoreset_mode: `NEXT_STEP`, `SAME_STEP` or `DISABLED`.
            n_threads: Threads that step, including the calling thread; 0 for one per processor. No effect with `warp`.
            engine: Physics engine: `mujoco` steps on the CPU in float64, bit for bit like servers; `warp` (MuJoCo Warp)
                steps in float32, on an NVIDIA GPU if present. MuJoCo itself resets with both.
            engine_options: Options of `warp`: `contacts` and `constraints`, the largest number in one copy at any time,
                for which its arrays are sized.
            client_options: Further options of the client that fetches the scene.

        Raises:
            URLabError: The scene cannot be fetched, or uses a feature that MuJoCo Warp lacks.
            RenderingUnavailable: Cameras are observed, and this machine cannot draw.
            MissingExtra: `engine` needs an extra that is not installed.
            KeyError: A camera is unknown.
            ValueError: An option is out of range, `warp` is combined with a varying model, or the scene has no camera
                to render.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        if engine not in ("mujoco", "warp"):
            raise ValueError(f"engine must be 'mujoco' or 'warp', not {engine!r}")
        if unknown := engine_options.keys() - ({"contacts", "constraints"} if engine == "warp" else set[str]()):
            raise ValueError(f"engine_options of {engine!r} must not contain {', '.join(sorted(unknown))}")
        check_render_mode(render_mode)
        check_alone(task, reward_fn=reward_fn, termination_fn=termination_fn)
        settings = EpisodeSettings.of(
            task,
            observations=observations,
            n_substeps=n_substeps,
            max_episode_steps=max_episode_steps,
            keyframe=keyframe,
            reset_noise=reset_noise,
            space_mode=space_mode,
            cameras=cameras,
        )
        shown = None if render_mode is None else _Shown(render_camera)
        fetched = _fetch(with_model_options(address), client_defaults(client_options), settings.cameras, shown)
        model, prefixes, pictures = fetched.model, fetched.prefixes, fetched.pictures
        declared = declared_in(model) if randomise is None else Randomisation.of(randomise)
        mapping = SpaceMapping(
            model, prefixes, fields_of(settings.observations), settings.space_mode, settings.articulations
        )
        super().__init__(
            num_envs=num_envs,
            mapping=mapping,
            observation_space=with_task(
                with_cameras(mapping, {name: pictures.space(name) for name in settings.cameras}), task
            ),
            reward_fn=reward_fn,
            termination_fn=termination_fn,
            max_episode_steps=settings.max_episode_steps,
            autoreset_mode=autoreset_mode,
            task=task,
            randomise=declared,
        )
        self.model = model
        self._goals: list[dict[str, Floats]] = [{} for _ in range(num_envs)]
        if task is not None:
            task.setup(TaskScene(model, mapping))
        self._n_substeps = settings.n_substeps
        self._noise = settings.reset_noise
        self._start_keyframe = settings.keyframe
        self.render_mode = render_mode
        self._cameras = tuple(settings.cameras)
        self._rendered = fetched.rendered
        self._picture_scene = pictures
        self._pictures = BatchPictures(pictures) if self._cameras else None
        self._batch: Any = (
            WarpBatch(model, num_envs, **engine_options)
            if engine == "warp"
            else (batch_class() or ThreadedBatch)(model, num_envs, n_threads)
        )
        # Bound before the first call: the batch computes a derived field only if it is bound.
        self._arrays = {name: self._batch.bind(name) for name in _BOUND}
        self._visible = [self._batch.bind(name) for name in VISIBLE]
        self._late = LateCameras(declared, self._cameras)
        self._prefixes = prefixes
        self._target_type = np.float64 if fetched.exact_controls else np.float32
        self._keyframes = {name: i for i, name in enumerate(model_names(model, "key"))}
        self._noisy = {
            key: np.array([mapping.layout(key).joints[name] for name in mapping.joint_names(key, model)], dtype=np.intp)
            for key in mapping.keys
        }
        self._sensors = {key: _sensor_addresses(model, mapping.layout(key)) for key in mapping.keys}
        self._controllers = {
            key: _controller(model, mapping.layout(key), kind, params)
            for key, (kind, params) in fetched.controllers.items()
        }
        self._varied = None
        if declared is not None and declared.vary:
            self._varied = BatchVariation(declared, model, self._batch, num_envs, self._controllers)
        self._bodies = {name: i for i, name in enumerate(model_names(model, "body"))}
        for push in () if declared is None else declared.push:
            self._body(push.body)
        self._step_count = np.zeros(num_envs, dtype=np.int64)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of the current state of each copy, shape (H, W, 3), RGB; None without a render mode.

        Raises:
            RenderingUnavailable: This machine cannot draw.
            TimeoutError: Drawing took too long.
        """
        if self._rendered is None:
            return None
        copies = np.arange(self.num_envs)
        mode = self._picture_scene.mode(self._rendered)
        drawn = self._draw([self._rendered], copies, self._visible_states(copies))
        return tuple(to_rgb(frame, mode) for frame in drawn[self._rendered])

    def draws(self, index: int) -> dict[str, Any] | None:
        """Return the values drawn for an episode, as in `EpisodeDraws.to_dict`; None if nothing varies."""
        found = None if self._varied is None else self._varied.draws[index]
        return None if found is None else found.to_dict()

    def close_extras(self, **kwargs: Any) -> None:
        """Free the drawing context."""
        pictures, self._pictures = self._pictures, None
        if pictures is not None:
            pictures.close()

    def _seen(self, indices: Indices) -> dict[str, NDArray[Any]]:
        """Return the camera observations of some copies."""
        states, late = self._visible_states(indices), self._late
        drawn = self._draw([name for name in self._cameras if name not in late.names], indices, states)
        for name in late.names:
            times = self._arrays["time"][indices].tolist()
            shown = [late.shown(name, *each) for each in zip(indices.tolist(), times, states, strict=True)]
            drawn |= self._draw([name], indices, shown)
        return {
            name: np.stack([observed_pixels(frame, self._picture_scene.mode(name)) for frame in drawn[name]])
            for name in self._cameras
        }

    def _visible_states(self, indices: Indices) -> list[Floats]:
        """Return the states of some copies in the form of `Visible.state`."""
        return [np.concatenate([values[i].ravel() for values in self._visible]) for i in indices.tolist()]

    def _draw(self, cameras: Sequence[str], indices: Indices, states: Sequence[Floats]) -> dict[str, list[Pixels]]:
        """Return the pictures of cameras in some copies, given their states."""
        if not cameras:
            return {}
        if self._pictures is None:
            self._pictures = BatchPictures(self._picture_scene)
        looks = [{} if self._varied is None else self._varied.look(i) for i in indices.tolist()]
        return self._pictures.draw(cameras, [Visible(*each) for each in zip(states, looks, strict=True)])

    def _reset_and_step(self, fresh: Indices, acting: Indices, set_points: Mapping[str, Floats]) -> tuple[Found, Found]:
        nothing: Found = (None, {})
        return (
            self._reset_some(fresh, self._keyframe) if len(fresh) else nothing,
            self._step_some(acting, set_points) if len(acting) else nothing,
        )

    def _reset_some(self, indices: Indices, keyframe: str | None) -> Found:
        keyframe = self._start_keyframe if keyframe is None else keyframe
        key = -1 if keyframe is None else self._keyframe_id(keyframe)
        if self._varied is not None:
            self._varied.begin(indices, self.episode_seeds())
        self._batch.reset(indices, key)
        if self._varied is not None:
            for i in map(int, indices):
                self._varied.start(i, self._arrays["qpos"][i])
            self._batch.forward(indices)
        if self._noise:
            qpos = self._arrays["qpos"]
            for i in map(int, indices):
                for key in self.mapping.keys:
                    joints = self._noisy[key]
                    address = self.model.jnt_qposadr[joints]
                    qpos[i, address] = self._noise.drawn(self._rngs[i], self.model, joints, qpos[i, address])
            self._batch.forward(indices)
        if self.task is not None:
            qpos = self._arrays["qpos"]
            for i in map(int, indices):
                start = Start(self.task.scene, qpos[i].copy())
                self.task.reset(self._rngs[i], start)
                qpos[i], self._goals[i] = start.qpos, start.goal
            self._batch.forward(indices)
        self._step_count[indices] = 0
        if self._late.names:
            seeds = self.episode_seeds()
            for i, state in zip(indices.tolist(), self._visible_states(indices), strict=True):
                self._late.begin(i, int(seeds[i]), state)
        return self._observe(indices), {}

    def _step_some(self, indices: Indices, set_points: Mapping[str, Floats]) -> Found:
        ctrl = self._arrays["ctrl"]
        targets: dict[str, NDArray[Any]] = {}
        for key, values in set_points.items():
            controller = self._controllers.get(key)
            if controller is None or not controller.active:
                ctrl[np.ix_(indices, self.mapping.layout(key).ctrl_adr)] = values[indices]
            else:
                targets[key] = values[indices].astype(self._target_type)
        forces, pushes = self._forces(indices), self._arrays["xfrc_applied"]
        for i, pushed in forces.items():
            for body, force in pushed.items():
                pushes[i, self._body(body), :3] = force
        if targets:
            for _ in range(self._n_substeps):
                self._control(indices, targets)
                self._batch.step(indices, nstep=1)
        else:
            self._batch.step(indices, nstep=self._n_substeps)
        pushes[list(forces)] = 0.0
        self._step_count[indices] += self._n_substeps
        return self._observe(indices), {}

    def _control(self, indices: Indices, targets: Mapping[str, NDArray[Any]]) -> None:
        """Compute the controls from the controllers' targets and the current state."""
        ctrl, qpos, qvel = (self._arrays[name][indices] for name in ("ctrl", "qpos", "qvel"))
        for key, values in targets.items():
            if self._varied is not None:
                self._varied.use_factors(key, indices)
            self._controllers[key].write(values, qpos, qvel, ctrl)
        self._arrays["ctrl"][indices] = ctrl

    def _clocks(self) -> dict[str, NDArray[Any]]:
        return {"sim_time": self._arrays["time"].copy(), "step_count": self._step_count.copy()}

    def _observe(self, indices: Indices) -> Observation:
        def read(key: str, field: Field) -> Floats:
            return self._read(self.mapping.layout(key), self._sensors[key], field)[indices]

        observation = self.mapping.observe(read)
        if self.task is not None:
            observation = add_observed(observation, self.task, self.task.observe(self._states(indices)))
        if self._cameras:
            observation["cameras"] = self._seen(indices)
        return observation

    def _states(self, indices: Indices) -> States:
        if self.task is None:
            raise URLabError("This environment has no task.")
        arrays = self._arrays
        qpos, qvel, time = (arrays[name][indices] for name in ("qpos", "qvel", "time"))
        return States(self.task.scene, qpos, qvel, time, [self._goals[i] for i in map(int, indices)])

    def _read(self, layout: ArticulationLayout, sensors: Indices, field: Field) -> Floats:
        match field:
            case "qpos":
                return self._arrays["qpos"][:, layout.qpos_adr]
            case "qvel":
                return self._arrays["qvel"][:, layout.qvel_adr]
            case "ctrl":
                return self._arrays["ctrl"][:, layout.ctrl_adr]
            case "act":
                act = np.zeros((self.num_envs, len(layout.ctrl_adr)))
                act[:, layout.act_from] = self._arrays["act"][:, layout.act_adr]
                return act
            case "sensors":
                return self._arrays["sensordata"][:, sensors]

    def _body(self, name: str) -> int:
        found = self._bodies.get(name, self._bodies.get(name.replace("/", "_", 1)))
        if found is None:
            raise ValueError(f"push: unknown body {name!r}; the bodies are: {', '.join(self._bodies)}")
        return found

    def _keyframe_id(self, name: str) -> int:
        wanted = {name, *compiled_names(name, self._prefixes)}
        found = [full for full in self._keyframes if full in wanted]
        if len(found) != 1:
            raise UnknownKeyframe(
                "unknown_keyframe", f"{name!r} does not name exactly one of {', '.join(self._keyframes) or 'none'}"
            )
        return self._keyframes[found[0]]


@dataclass(frozen=True)
class _Shown:
    """Request to render a camera; None selects the first colour camera."""

    camera: str | None


@dataclass(frozen=True, kw_only=True)
class _Fetched:
    """What a batch needs from the server's scene.

    Attributes:
        model: The compiled scene.
        prefixes: Prefixes of the compiled names of articulations, by key.
        controllers: Kind and parameters of the attached controllers, by key.
        exact_controls: Whether the controllers receive set-points without rounding.
        pictures: What is needed to draw the scene.
        rendered: Camera that `render` shows, or None.
    """

    model: mujoco.MjModel
    prefixes: Mapping[str, str]
    controllers: Mapping[str, tuple[str, Mapping[str, Any]]]
    exact_controls: bool
    pictures: PictureScene
    rendered: str | None


def _fetch(address: str, client_options: Mapping[str, Any], cameras: Sequence[str], shown: _Shown | None) -> _Fetched:
    """Fetch a scene.

    Raises:
        URLabError: The scene cannot be fetched or has no articulation.
        KeyError: A camera is unknown.
        ValueError: The scene has no camera to render.
    """
    with URLabClient(address, **client_options) as client:
        client.discover()
        model = client.model
        if model is None or not client.articulations:
            raise URLabError(f"The server at {address} has no articulation.", hint="Start play first.")
        attached = {key: articulation.controller for key, articulation in client.articulations.items()}
        rendered = None if shown is None else shown.camera or first_camera(aio_of(client))
        return _Fetched(
            model=model,
            prefixes=compiled_prefixes(client),
            controllers={key: (str(found.kind), dict(found.params)) for key, found in attached.items() if found},
            exact_controls=client.server.features.exact_controls,
            pictures=PictureScene.of(aio_of(client), model, [*cameras, *([rendered] if rendered else [])]),
            rendered=rendered,
        )


def _controller(
    model: mujoco.MjModel, layout: ArticulationLayout, kind: str, params: Mapping[str, object]
) -> Controller:
    actuated = Actuated(np.array([*layout.actuators.values()], dtype=np.intp), (*layout.actuators,), layout.ctrl_adr)
    if kind != ControllerKind.PD:
        return PassthroughController(model, actuated)
    controller = PDController(model, actuated, ControllerConfig())
    controller.configure(params)
    return controller


def _sensor_addresses(model: mujoco.MjModel, layout: ArticulationLayout) -> Indices:
    ranges = [np.arange(model.sensor_dim[i], dtype=np.intp) + model.sensor_adr[i] for i in layout.sensors.values()]
    return np.concatenate(ranges) if ranges else np.zeros(0, dtype=np.intp)
