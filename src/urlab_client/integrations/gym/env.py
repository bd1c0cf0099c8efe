"""`URLabEnv`: a Gymnasium environment over one client."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Self, Unpack

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from urlab_client.aio.articulation import URLabEntity
from urlab_client.errors import URLabError
from urlab_client.integrations.gym.episode import EnvEpisode
from urlab_client.integrations.gym.settings import (
    EpisodeOptions,
    EpisodeSettings,
    RewardFn,
    TerminationFn,
    client_defaults,
    served_address,
)
from urlab_client.integrations.gym.spaces import Observation, SpaceMapping, mapped
from urlab_client.integrations.gym.task import Task
from urlab_client.integrations.gym.vector import OverWire
from urlab_client.integrations.gym.vectorized import Applied, Indices, info_of, of_one
from urlab_client.randomise.declaration import Randomisation
from urlab_client.sync._facade import aio_of, portal_of
from urlab_client.sync._portal import Portal
from urlab_client.sync.articulation import URLabArticulation
from urlab_client.sync.client import URLabClient
from urlab_client.values.names import NameMap


class _Alone(OverWire):
    """A vector environment of one, over a client that it is given."""

    def __init__(self, episode: EnvEpisode, portal: Portal) -> None:
        super().__init__(episode, 1, AutoresetMode.DISABLED)
        self.episode = episode
        self._portal = portal

    def _ask_user(self, function: Callable[..., Any], *trees: Any) -> Any:
        *arrays, infos = trees
        return function(*map(of_one, arrays), info_of(infos))

    async def _episode(self, i: int, *, starting: bool) -> EnvEpisode:
        return self.episode

    def _advance(
        self, fresh: Indices, keyframe: str | None, acting: Indices, applied: Applied
    ) -> Mapping[int, Exception]:
        self._portal.call(self._move_one, 0, keyframe, applied if len(acting) else None)
        return {}


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

    If the simulation diverges, so that MuJoCo resets it, the episode is truncated with reward 0, and `info["error"]`
    has an exception.

    With `render_mode="rgb_array"`, `render` returns the frame of `render_camera`. Each step draws this frame, which
    takes time. Images never affect the physics.

    Attributes:
        client: The client.
        task: The task, or None.
        randomise: What varies from episode to episode, or None.
        reward_fn: The reward function. If None, rewards are 0.
        termination_fn: The termination function. If None, episodes never terminate.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - Gymnasium's

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
        settings = EpisodeSettings(**options)
        declared = None if randomise is None else Randomisation.of(randomise)
        episode = EnvEpisode(aio_of(client), settings=settings, randomise=declared)
        self._alone = _Alone(episode, portal_of(client))
        self.client = client
        self.task: Task | None = settings.task
        self.randomise: Randomisation | None = episode.randomise
        self.reward_fn: RewardFn | None = settings.reward_fn
        self.termination_fn: TerminationFn | None = settings.termination_fn
        self.render_mode: str | None = settings.render_mode
        self.action_space: gymnasium.Space[Any] = self._alone.single_action_space
        self.observation_space: gymnasium.Space[Any] = self._alone.single_observation_space
        self.metadata = {
            **self.metadata,
            "render_fps": 1.0 / (episode.model.opt.timestep * settings.n_substeps),
        }
        self._owns_client = owns_client

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
        if (declared := options.get("randomise")) is not None:
            declared = options["randomise"] = Randomisation.of(declared)
        client = URLabClient(served_address(address, declared), **client_defaults(client_options, address))
        try:
            client.discover()
            return cls(client, owns_client=True, **options)
        except BaseException:
            client.close()
            raise

    @property
    def mapping(self) -> SpaceMapping:
        """The client's articulations as spaces."""
        return self._alone.mapping

    @property
    def n_substeps(self) -> int:
        """Physics steps per action."""
        return self._alone.n_substeps

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
        self._alone.rngs = [self.np_random]
        observations, infos = self._alone.reset(seed=seed, options=options)
        self._np_random = self._alone.rngs[0]
        return of_one(observations), info_of(infos)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply an action for `n_substeps` physics steps.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called yet.
            ValueError: The action has the wrong shape or is not finite. Nothing was sent.
        """
        self._alone.reward_fn, self._alone.termination_fn = self.reward_fn, self.termination_fn  # may be replaced
        observations, rewards, terminated, truncated, infos = self._alone.step(
            mapped(lambda values: np.asarray(values)[None], action)
        )
        return of_one(observations), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info_of(infos)

    def draws(self) -> dict[str, Any] | None:
        """Return the values drawn for the episode, as plain data: `seed`, and under `varied` the draws by quantity.

        None if nothing varies, and before the first reset.
        """
        return self._alone.episode.draws()

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]  # Gymnasium's base names frames of all kinds
        """Return the frame of the last reset or step, shape (H, W, 3), RGB; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called yet.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render mode: make the environment with render_mode='rgb_array'")
            return None
        picture = self._alone.episode.rendered()
        if picture is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return picture

    def close(self) -> None:
        """Undo what this environment varied on the server, and close the client if the environment owns it.

        The task may then serve another environment.
        """
        self._alone.close()
        with contextlib.suppress(URLabError):  # the client may be closed already
            portal_of(self.client).call(self._alone.episode.close)
        if self._owns_client:
            self.client.close()
        super().close()
