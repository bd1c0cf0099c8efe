"""`URLabEnv`: a Gymnasium environment over one client."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Self, Unpack

import gymnasium
import numpy as np
from numpy.typing import NDArray

from urlab_client.aio.articulation import URLabEntity
from urlab_client.aio.launch import SCHEME, with_model_options, with_option
from urlab_client.errors import URLabError
from urlab_client.integrations.gym.disturbances import Disturbances
from urlab_client.integrations.gym.episode import EnvEpisode
from urlab_client.integrations.gym.settings import (
    EpisodeOptions,
    EpisodeSettings,
    RewardFn,
    TerminationFn,
    client_defaults,
    keyframe_option,
)
from urlab_client.integrations.gym.spaces import Observation, SpaceMapping
from urlab_client.integrations.gym.task import EpisodeEnd, Task, judged, succeeded
from urlab_client.protocol.base import Floats
from urlab_client.randomise.declaration import Randomisation
from urlab_client.sync._facade import aio_of, portal_of
from urlab_client.sync.articulation import URLabArticulation
from urlab_client.sync.client import URLabClient
from urlab_client.values.names import NameMap

_FALLBACK_FPS: Final = 50.0


class URLabEnv(gymnasium.Env[Observation, Any]):
    """A Gymnasium environment over a discovered client in `direct` or `puppet` mode.

    An action determines the set-points of all actuators for `n_substeps` physics steps (see `Actions`). An observation
    holds the fields that `observations` names (see `SpaceMapping`). `info` contains `step_count` (physics steps since
    the reset) and `sim_time` (seconds), plain numbers that can be copied and pickled. Live objects are attributes of
    the environment, for example `env.unwrapped.articulations`.

    A reset returns the simulation to its initial state, or to the keyframe named by `options={"keyframe": NAME}`, and
    clears the set-points. `reset_noise` then adds uniform noise to the joint positions, within the joint ranges. The
    seed determines only this noise and what the task and `randomise` draw. Physics is deterministic: the same seed and
    actions give the same observations, bit for bit, on the same build of MuJoCo.

    With `render_mode="rgb_array"`, `render` returns the frame of `render_camera`. Each step draws this frame, which
    takes time. Images never affect the physics.

    Attributes:
        client: The client.
        task: The task, or None.
        randomise: What varies from episode to episode, or None.
        reward_fn: The reward function. If None, rewards are 0.
        termination_fn: The termination function. If None, episodes never terminate.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": _FALLBACK_FPS}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        client: URLabClient,
        *,
        randomise: Randomisation | str | os.PathLike[str] | None = None,
        owns_client: bool = False,
        **options: Unpack[EpisodeOptions],
    ) -> None:
        """Make an environment.

        Args:
            client: A client after `discover()`, during play.
            randomise: What varies from episode to episode, and what disturbs sensors and actuators: a
                `Randomisation`, or the path of its TOML file. Most model quantities need a server that varies them;
                see `connect`. On other servers, ops vary gravity, the start and the gains of PD controllers until
                `close()`. If None, the server's own declaration applies.
            owns_client: Whether `close` also closes the client.
            options: See `EpisodeOptions`.

        Raises:
            URLabError: The client has no model or no articulation, the client is in live mode, or the server varies
                its scene differently from `randomise`.
            UnsupportedRandomisation: The server varies nothing itself and has no op for what `randomise` varies.
            KeyError: A camera or a body to push is unknown.
            ValueError: An option is out of range, the scene has no camera to render, the task serves another
                environment, or one of its hooks or attributes is misspelt.
        """
        settings = self._settings = EpisodeSettings.of(**options)
        self.client = client
        self.render_mode = settings.render_mode
        self._episode = EnvEpisode(
            aio_of(client), settings=settings, randomise=None if randomise is None else Randomisation.of(randomise)
        )
        self.randomise: Randomisation | None = self._episode.randomise
        self.task: Task | None = settings.task
        task = settings.task
        n_task = 0 if task is None else task.n_observed
        self._disturbances = None
        if self.randomise is not None:
            self._disturbances = Disturbances(self.randomise, self.mapping, n_task, settings.n_substeps)
        self.action_space: gymnasium.Space[Any] = self.mapping.action_space
        self.observation_space: gymnasium.Space[Any] = self._episode.observation_space
        model = client.model
        self.metadata = {
            **self.metadata,
            "render_fps": 1.0 / (model.opt.timestep * settings.n_substeps) if model else _FALLBACK_FPS,
        }
        self.reward_fn: RewardFn | None = settings.reward_fn
        self.termination_fn: TerminationFn | None = settings.termination_fn
        self._max_episode_steps = settings.max_episode_steps
        self._owns_client = owns_client
        self._observation: Observation = None
        self._elapsed = 0
        self._total = 0.0

    @classmethod
    def connect(cls, address: str, *, client_options: Mapping[str, Any] = MappingProxyType({}), **options: Any) -> Self:
        """Make an environment that creates its own client in `direct` mode and closes it.

        Args:
            address: Address of the server. A server started for a `sim://` address honours the model's `<option>`,
                unless the address contains `?no-mjcf-options`, and varies what `randomise` declares.
            client_options: Further options of the client.
            options: Arguments of `URLabEnv`.

        Raises:
            URLabError: The server cannot be reached or has no articulation.
        """
        if address.startswith(SCHEME) and options.get("randomise") is not None:
            declared = options["randomise"] = Randomisation.of(options["randomise"])
            address = with_option(address, "randomise", declared.to_json())
        client = URLabClient(with_model_options(address), **client_defaults(client_options))
        try:
            client.discover()
            return cls(client, owns_client=True, **options)
        except BaseException:
            client.close()
            raise

    @property
    def mapping(self) -> SpaceMapping:
        """The client's articulations as spaces."""
        return self._episode.mapping

    @property
    def articulations(self) -> NameMap[URLabArticulation]:
        """The client's articulations by key."""
        return self.client.articulations

    @property
    def entities(self) -> NameMap[URLabEntity]:
        """The client's entities by name."""
        return self.client.entities

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of everything that the episodes draw. None continues with the current generator.
            options: `keyframe`: name of the keyframe to start from.

        Raises:
            ValueError: An option is unknown.
            UnknownKeyframe: No keyframe, or more than one, has this name.
        """
        super().reset(seed=seed)
        keyframe = keyframe_option(options)
        disturbances = self._disturbances
        episode_seed = None
        if disturbances is not None:
            episode_seed = disturbances.begin(self.np_random, keyframe or self._settings.keyframe)
        self._observation = portal_of(self.client).call(self._episode.reset, self.np_random, keyframe, episode_seed)
        self._elapsed, self._total = 0, 0.0
        info = self._info()
        success = None if self.task is None else succeeded(self.task, self._episode.states())
        if success is not None:
            info["success"] = bool(success[0])
        return self._seen(), info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply an action for `n_substeps` physics steps.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called yet.
            ValueError: The action has the wrong shape or is not finite. Nothing was sent.
        """
        if self._observation is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        before = self._observation
        set_points = before_late = self.mapping.set_points(action)  # validates before anything is drawn
        forces: dict[str, Floats] = {}
        disturbances, late_steps = self._disturbances, 0
        if disturbances is not None:
            forces, late_steps = disturbances.forces(), disturbances.late_steps
            if self.randomise is not None and self.randomise.delays_actions:
                before_late, set_points = disturbances.delayed(set_points)
        after = self._observation = portal_of(self.client).call(
            self._episode.step, set_points, forces, self.mapping.flat(action), before_late, late_steps
        )
        self._elapsed += 1
        info = self._info()
        if self.task is not None:
            return self._judged(self.task, action, info)
        reward = 0.0 if self.reward_fn is None else float(self.reward_fn(before, action, after, info))
        terminated = self.termination_fn is not None and bool(self.termination_fn(after, info))
        truncated = self._max_episode_steps is not None and self._elapsed >= self._max_episode_steps
        return self._seen(), reward, terminated, truncated, info

    def draws(self) -> dict[str, Any] | None:
        """Return the values drawn for the episode, as plain data: `seed`, and under `varied` the draws by quantity.

        None if nothing varies, and before the first reset.
        """
        return self._episode.draws()

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]  # Gymnasium's base names frames of all kinds
        """Return the frame of the last reset or step, shape (H, W, 3), RGB; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called yet.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render mode: make the environment with render_mode='rgb_array'")
            return None
        picture = self._episode.rendered()
        if picture is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return picture

    def close(self) -> None:
        """Undo what this environment varied on the server, and close the client if the environment owns it.

        The task may then serve another environment.
        """
        self._settings.release()
        with contextlib.suppress(URLabError):  # the client may be closed already
            portal_of(self.client).call(self._episode.close)
        if self._owns_client:
            self.client.close()
        super().close()

    def _judged(
        self, task: Task, action: Any, info: dict[str, Any]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        states = self._episode.states()
        actions: Any = np.asarray(action)[None]
        if self.mapping.mode == "dict":
            actions = {key: np.asarray(action[key])[None] for key in action}
        rewards, ends, success = judged(task, states, actions)
        reward, terminated = float(rewards[0]), bool(ends[0])
        truncated = self._max_episode_steps is not None and self._elapsed >= self._max_episode_steps
        self._total += reward
        if success is not None:
            info["success"] = bool(success[0])
        if terminated or truncated:
            done = info.get("success", False)
            task.ended(EpisodeEnd(0, done, terminated, self._elapsed, self._total, states.goal_of(0)))
        return self._seen(), reward, terminated, truncated, info

    def _info(self) -> dict[str, Any]:
        client = self.client
        info: dict[str, Any] = {"step_count": client.step_count, "sim_time": client.sim_time}
        if self._disturbances is not None:
            info["episode_seed"] = self._disturbances.seed
        return info

    def _seen(self) -> Observation:
        return self._observation if self._disturbances is None else self._disturbances.seen(self._observation)
