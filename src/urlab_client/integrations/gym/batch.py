"""`URLabBatchEnv`: many copies of a scene, stepped in batch by MuJoCo itself, without a wire."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, Unpack

import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from urlab_client._mujoco import batch_class, spans
from urlab_client.aio.arguments import at_least
from urlab_client.aio.model.layout import ArticulationLayout
from urlab_client.enums import ControllerKind
from urlab_client.integrations.gym.engines import ThreadedBatch, WarpBatch
from urlab_client.integrations.gym.episode import MEASURED, EnvEpisode
from urlab_client.integrations.gym.pictures import BatchPictures, PictureScene
from urlab_client.integrations.gym.settings import EpisodeOptions, EpisodeSettings, client_defaults, served_address
from urlab_client.integrations.gym.spaces import Field, Observation
from urlab_client.integrations.gym.vectorized import Applied, Floats, Indices, Vectorized, put
from urlab_client.randomise.declaration import Randomisation
from urlab_client.randomise.variation import EpisodeDraws, Variation
from urlab_client.simulation.controller_config import ControllerConfig
from urlab_client.simulation.controllers import Actuated, Controller, PDController, attach_controller
from urlab_client.simulation.painting import VISIBLE, Visible
from urlab_client.sync._facade import aio_of
from urlab_client.sync.client import URLabClient
from urlab_client.values.names import NameMap
from urlab_client.values.pictures import to_rgb

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
        randomise: Randomisation | str | os.PathLike[str] | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        n_threads: int = 0,
        engine: Literal["mujoco", "warp"] = "mujoco",
        engine_options: Mapping[str, int] = MappingProxyType({}),
        client_options: Mapping[str, Any] = MappingProxyType({}),
        **options: Unpack[EpisodeOptions],
    ) -> None:
        """Fetch the scene and make the batch.

        Args:
            address: Source of the scene: `sim://MODEL`, with the options of the model, or a server during play.
            num_envs: Number of copies.
            randomise: See `URLabEnv`. Cameras have the same latency as a server's, but the jitter is drawn differently.
            autoreset_mode: `NEXT_STEP`, `SAME_STEP` or `DISABLED`.
            n_threads: Threads that step, including the calling thread; 0 for one per processor. No effect with `warp`.
            engine: Physics engine: `mujoco` steps on the CPU in float64, bit for bit like servers; `warp` (MuJoCo Warp)
                steps in float32, on an NVIDIA GPU if present. MuJoCo itself resets with both.
            engine_options: Options of `warp`: `contacts` and `constraints`, the largest number in one copy at any time,
                for which its arrays are sized.
            client_options: Further options of the client that fetches the scene.
            options: See `EpisodeOptions`. This process draws observed cameras in every step; with
                `render_mode="rgb_array"`, only `render` draws.

        Raises:
            URLabError: The scene cannot be fetched, or uses a feature that MuJoCo Warp lacks.
            RenderingUnavailable: Cameras are observed, and this machine cannot draw.
            MissingExtra: `engine` needs an extra that is not installed.
            KeyError: A camera or a body to push is unknown.
            ValueError: An option is out of range, `warp` is combined with a varying model, or the scene has no camera
                to render.
        """
        num_envs = at_least("num_envs", num_envs, 1)
        if engine not in ("mujoco", "warp"):
            raise ValueError(f"engine must be 'mujoco' or 'warp', not {engine!r}")
        if unknown := engine_options.keys() - ({"contacts", "constraints"} if engine == "warp" else set[str]()):
            raise ValueError(f"engine_options of {engine!r} must not contain {', '.join(sorted(unknown))}")
        settings = EpisodeSettings(**options)
        with URLabClient(served_address(address, None), **client_defaults(client_options)) as client:
            client.discover()
            first = EnvEpisode(aio_of(client), settings=settings)
            model, mapping, self._rendered = first.model, first.mapping, first.rendered_camera
            drawn = [*settings.cameras, *([self._rendered] if self._rendered else [])]
            self._scene = PictureScene.of(aio_of(client), model, drawn)
            self._controllers = {
                key: _controller(model, mapping.layout(key), str(found.kind), found.params)
                for key, articulation in client.articulations.items()
                if (found := articulation.controller)
            }
            self._target_type = np.float64 if client.server.features.exact_controls else np.float32
        declared = first.randomise if randomise is None else Randomisation.of(randomise)
        self.model: mujoco.MjModel = model
        self._pictures = BatchPictures(
            self._scene, settings.cameras, {} if declared is None else declared.latencies(settings.cameras)
        )
        self._batch: Any = (
            WarpBatch(model, num_envs, **engine_options)
            if engine == "warp"
            else (batch_class() or ThreadedBatch)(model, num_envs, n_threads)
        )
        # Bound before the first call: the batch computes a derived field only if it is bound.
        self._arrays = {name: self._batch.bind(name) for name in _BOUND}
        self._varied = None
        if declared is not None and declared.vary:
            self._varied = _CopyVariation(
                declared, model, self._batch, num_envs, self._controllers, prefixes=mapping.prefixes
            )
        for push in () if declared is None else declared.push:
            mapping.id("body", push.body)
        super().__init__(first, num_envs, autoreset_mode, declared)  # last: until `close` it holds the task
        if first.measures:
            self._measured = {name: self._arrays[name] for name in MEASURED}
        self._visible = [self._batch.bind(name) for name in VISIBLE]
        sensors = {key: [*mapping.layout(key).sensors.values()] for key in mapping.keys}
        self._sensors = {key: spans(model.sensor_adr[ids], model.sensor_dim[ids]) for key, ids in sensors.items()}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of the current state of each copy, shape (H, W, 3), RGB; None without a render mode.

        Raises:
            RenderingUnavailable: This machine cannot draw.
            TimeoutError: Drawing took too long.
        """
        if self._rendered is None:
            return None
        frames = self._pictures.draw([self._rendered], self._copies(np.arange(self.num_envs)))[self._rendered]
        return tuple(to_rgb(frame, self._scene.mode(self._rendered)) for frame in frames)

    def draws(self, index: int) -> dict[str, Any] | None:
        """Return the values drawn for an episode, as in `EpisodeDraws.to_dict`; None if nothing varies."""
        found = None if self._varied is None else self._varied.draws[index]
        return None if found is None else found.to_dict()

    def close_extras(self, **kwargs: Any) -> None:
        """Free the drawing context, and let the task serve another environment."""
        super().close_extras(**kwargs)
        self._pictures.close()

    def _copies(self, indices: Indices) -> list[Visible]:
        """Return what pictures of some copies show."""
        return [
            Visible(
                np.concatenate([values[i].ravel() for values in self._visible]),
                {} if self._varied is None else self._varied.look(i),
            )
            for i in indices.tolist()
        ]

    def _advance(
        self, fresh: Indices, keyframe: str | None, acting: Indices, applied: Applied
    ) -> Mapping[int, Exception]:
        if len(fresh):
            self._start(fresh, keyframe)
        if len(acting):
            self._act(acting, applied)
        moved = np.sort(np.concatenate([fresh, acting]))
        put(self._fields, moved, self._observe(moved))
        return {}

    def _start(self, indices: Indices, keyframe: str | None) -> None:
        key = -1 if keyframe is None else self.mapping.keyframe_id(keyframe)
        qpos, qvel = self._arrays["qpos"], self._arrays["qvel"]
        seeds, noise = self.episode_seeds(), self._settings.reset_noise
        if self._varied is not None:
            self._varied.begin(indices, seeds)
        self._batch.reset(indices, key)
        noisy = [self.mapping.scalar_joints(articulation, self.model) for articulation in self.mapping.keys]
        for i in map(int, indices):
            if self._varied is not None:
                self._varied.start(i, qpos[i], qvel[i])
            for joints in noisy if noise else ():
                noise.add(self.rngs[i], self.model, joints, qpos[i])
            if self._memory is not None:
                self._memory.begin(i, self.rngs[i], qpos[i], qvel[i])
        self._batch.forward(indices)
        self._step_count[indices] = 0
        if self._pictures.delays:
            for i, visible in zip(indices.tolist(), self._copies(indices), strict=True):
                self._pictures.begin(i, int(seeds[i]), visible)

    def _act(self, indices: Indices, applied: Applied) -> None:
        pushes, n_substeps = self._arrays["xfrc_applied"], self._settings.n_substeps
        for i, pushed in applied.forces.items():
            for body, force in pushed.items():
                pushes[i, self.mapping.id("body", body), :3] = force
        late = applied.late[indices]
        for begin, end in itertools.pairwise(np.unique([0, *late, n_substeps]).tolist()):
            waiting = (late > begin)[:, None]
            self._step(indices, np.where(waiting, applied.before[indices], applied.set_points[indices]), end - begin)
        pushes[list(applied.forces)] = 0.0
        self._step_count[indices] += n_substeps

    def _step(self, indices: Indices, set_points: Floats, n_steps: int) -> None:
        """Step some copies with these set-points, shape (n, n_actions)."""
        ctrl = self._arrays["ctrl"]
        targets: dict[str, NDArray[Any]] = {}
        for key, exact in self.mapping.split(set_points).items():
            values, controller = exact.astype(self._target_type), self._controllers.get(key)
            if controller is None or not controller.active:
                ctrl[np.ix_(indices, self.mapping.layout(key).ctrl_adr)] = values
            else:
                targets[key] = values
        if not targets:
            self._batch.step(indices, nstep=n_steps)
            return
        for _ in range(n_steps):
            self._control(indices, targets)
            self._batch.step(indices, nstep=1)

    def _control(self, indices: Indices, targets: Mapping[str, NDArray[Any]]) -> None:
        """Compute the controls from the controllers' targets and the current state."""
        ctrl, qpos, qvel = (self._arrays[name][indices] for name in ("ctrl", "qpos", "qvel"))
        for key, values in targets.items():
            if self._varied is not None:
                self._varied.use_factors(key, indices)
            self._controllers[key].write(values, qpos, qvel, ctrl)
        self._arrays["ctrl"][indices] = ctrl

    def _observe(self, indices: Indices) -> Observation:
        def read(key: str, field: Field) -> Floats:
            return self._read(self.mapping.layout(key), self._sensors[key], field)[indices]

        observation = self.mapping.observe(read)
        if self._settings.cameras:
            times = self._arrays["time"][indices].tolist()
            observation["cameras"] = self._pictures.observe(indices.tolist(), times, self._copies(indices))
        return observation

    def _state(self) -> tuple[Floats, Floats, Floats]:
        return self._arrays["qpos"], self._arrays["qvel"], self._arrays["time"]

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


class _CopyVariation:
    """What varies in the copies of a batch, equal to the variation of a server's scene."""

    def __init__(
        self,
        declaration: Randomisation,
        model: mujoco.MjModel,
        batch: Any,
        nsim: int,
        controllers: Mapping[str, Controller],
        *,
        prefixes: NameMap[str],
    ) -> None:
        self._pd = {key: found for key, found in controllers.items() if isinstance(found, PDController)}
        controlled = frozenset(int(i) for found in self._pd.values() for i in found.bound_actuators)
        self._variation = Variation(declaration, model, controlled, prefixes)
        self._batch = batch
        self._fields: dict[str, NDArray[Any]] = {name: batch.expand(name) for name in self._variation.fields}
        self._visible: dict[str, NDArray[Any]] = {name: batch.expand(name) for name in self._variation.visible_fields}
        self._factors: dict[str, dict[str, NDArray[np.float32]]] = {}
        for key, found in self._pd.items():
            shape = (nsim, len(found.bound_actuators))
            self._factors[key] = {name: np.ones(shape, dtype=np.float32) for name in self._variation.varied_gains}
        self.draws: list[EpisodeDraws | None] = [None] * nsim

    def begin(self, indices: Indices, seeds: NDArray[np.int64]) -> None:
        """Write the models for the next episodes of some copies, which must then be reset."""
        for i in map(int, indices):
            draws = self.draws[i] = self._variation.draw(int(seeds[i]))
            self._variation.write(draws, {name: values[i] for name, values in self._fields.items()}.__getitem__)
            for key, found in self._pd.items():
                for name, factors in self._variation.gain_factors(draws, found.bound_actuators).items():
                    self._factors[key][name][i] = factors
        if self._variation.derives:
            self._batch.set_const(indices)

    def start(self, i: int, qpos: Floats, qvel: Floats) -> None:
        """Vary the start of a copy's episode in place: positions, shape (nq,), and velocities, shape (nv,)."""
        draws = self.draws[i]
        if draws is not None:
            self._variation.start(draws, qpos, qvel)

    def use_factors(self, key: str, indices: Indices) -> None:
        """Set the gain factors of some copies in the controller of an articulation."""
        found = self._pd.get(key)
        if found is not None:
            found.factors = {name: factors[indices] for name, factors in self._factors[key].items()}

    def look(self, i: int) -> dict[str, NDArray[Any]]:
        """Return the varying fields of a copy's model that affect pictures, by name."""
        return {name: values[i].copy() for name, values in self._visible.items()}


def _controller(
    model: mujoco.MjModel, layout: ArticulationLayout, kind: str, params: Mapping[str, object]
) -> Controller:
    actuated = Actuated(np.array([*layout.actuators.values()], dtype=np.intp), (*layout.actuators,), layout.ctrl_adr)
    config = ControllerConfig(ControllerKind.PD if kind == ControllerKind.PD else ControllerKind.PASSTHROUGH)
    controller = attach_controller(model, actuated, config)
    controller.configure(params)
    return controller
