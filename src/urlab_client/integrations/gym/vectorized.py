"""Base of the vector environments: individually ending episodes, rewards in one call, and autoreset."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array
from numpy.typing import NDArray

from urlab_client.errors import refused_for_good
from urlab_client.integrations.gym.disturbances import Disturbances
from urlab_client.integrations.gym.settings import EpisodeSettings, RewardFn, TerminationFn, keyframe_option
from urlab_client.integrations.gym.spaces import Observation, Space, SpaceMapping, mapped
from urlab_client.integrations.gym.task import EpisodeEnd, States, Task, judged, succeeded
from urlab_client.randomise.declaration import Randomisation

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
_NONE = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True, slots=True)
class Applied:
    """What all environments do during one action.

    Attributes:
        actions: The actions, shape (environments, n_actions).
        set_points: Set-points of each articulation, shape (environments, n_ctrl).
        before: Set-points that are in force during the first `late` physics steps of the action, likewise.
        late: Number of these physics steps, shape (environments,).
    """

    actions: Floats
    set_points: Mapping[str, Floats]
    before: Mapping[str, Floats]
    late: Indices


_NOTHING = Applied(np.zeros((0, 0)), {}, {}, _NONE)


class Vectorized(VectorEnv[Observation, Any, Any], ABC):
    """Base of vector environments.

    One call computes the rewards or terminations of all environments, with a leading axis. The same functions work
    with `URLabEnv` if they index with `[..., i]` (see `SpaceMapping.field`).

    A failing environment does not raise. `infos["error"]` holds the exception at its index, its observation is the
    last one, it counts as truncated, and its next reset starts it again. The others continue.

    Attributes:
        mapping: The articulations as spaces.
        task: The task, or None.
        randomise: What varies from episode to episode, or None.
        reward_fn: The reward function. If None, rewards are 0.
        termination_fn: The termination function. If None, episodes never terminate.
        autoreset_mode: When environments whose episode ended are reset.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - Gymnasium's
    mapping: SpaceMapping
    observation_space: Space
    action_space: Space
    single_observation_space: Space
    single_action_space: Space

    def __init__(
        self,
        *,
        num_envs: int,
        settings: EpisodeSettings,
        mapping: SpaceMapping,
        observation_space: Space,
        autoreset_mode: AutoresetMode,
        randomise: Randomisation | None,
    ) -> None:
        self.mapping = mapping
        self.randomise = randomise
        self.task: Task | None = settings.task
        self.reward_fn: RewardFn | None = settings.reward_fn
        self.termination_fn: TerminationFn | None = settings.termination_fn
        self.render_mode: str | None = settings.render_mode
        self._settings = settings
        n_task = 0 if self.task is None else self.task.n_observed
        self._disturbances: list[Disturbances] = []
        if randomise is not None:
            self._disturbances = [
                Disturbances(randomise, mapping, n_task, settings.n_substeps) for _ in range(num_envs)
            ]
        self._observations_disturbed = randomise is not None and randomise.disturbs_observations
        self.num_envs = num_envs
        self.autoreset_mode: AutoresetMode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = observation_space
        self.single_action_space = mapping.action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(mapping.action_space, num_envs)
        self._observations: Observation = create_empty_array(observation_space, num_envs)
        self._sensed: Observation = None
        if self._observations_disturbed:
            self._sensed = create_empty_array(observation_space, num_envs)
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._totals = np.zeros(num_envs)
        self._ended = np.ones(num_envs, dtype=bool)
        self._started = False
        self._keyframe: str | None = None
        self._rngs = [np.random.default_rng() for _ in range(num_envs)]

    @abstractmethod
    def _advance(
        self, fresh: Indices, keyframe: str | None, acting: Indices, applied: Applied
    ) -> Mapping[int, Exception]:
        """Reset some environments to a keyframe and step others; return the failures by index.

        `put` the observations of the others into `_observations`.
        """

    @abstractmethod
    def _states(self, indices: Indices) -> States:
        """Return the states of some environments in the form passed to the task."""

    @abstractmethod
    def _clocks(self) -> dict[str, NDArray[Any]]:
        """Return the entries of `infos` that every environment has, by name."""

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in all environments, or in some.

        Args:
            seed: Seed of environment 0; environment i gets `seed + i`. A list gives one seed per environment. None
                continues with the current generators.
            options: `keyframe`: name of the keyframe to start from, also for later autoresets; `reset_mask`: boolean
                array of the environments to reset.

        Raises:
            ValueError: An option is unknown, or the mask or list has the wrong length.
            URLabRPCError: A server refused the reset of its environment, for example because it has no such keyframe.
                The other environments were reset.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(f"reset_mask needs {self.num_envs} booleans, at least one of them true")
        keyframe = keyframe_option(options)
        seeds = (
            [None if seed is None else seed + i for i in range(self.num_envs)] if not isinstance(seed, list) else seed
        )
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments")
        super().reset(seed=None)
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._rngs[i] = np.random.default_rng(seeds[i])
        errors = self._move(np.flatnonzero(mask), keyframe)
        self._started = True
        refusal = next(filter(refused_for_good, errors.values()), None)
        if refusal is not None:
            raise refusal
        self._keyframe = keyframe
        infos = self._infos(errors)
        self._add_success(infos, np.flatnonzero(~self._ended))
        return self._disturbed_observations(), infos

    def step(self, actions: Any) -> tuple[Observation, Floats, Bools, Bools, dict[str, Any]]:
        """Step all environments.

        With `AutoresetMode.NEXT_STEP`, environments whose episode ended in the previous step are reset instead, and
        their reward is 0.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called yet.
            ValueError: The actions have the wrong shape or are not finite. Nothing was sent.
        """
        if not self._started:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        set_points = self._set_points(actions)  # validates before anything moves
        next_step = self.autoreset_mode is AutoresetMode.NEXT_STEP
        resetting = self._ended if next_step else np.zeros(self.num_envs, dtype=bool)
        fresh, acting = np.flatnonzero(resetting), np.flatnonzero(~resetting)
        before = None if self.reward_fn is None else self._true_observations()
        errors = self._move(fresh, self._keyframe, acting, self._applied(acting, actions, set_points))
        infos = self._infos(errors)
        stepped = np.zeros(self.num_envs, dtype=bool)
        stepped[acting] = True
        stepped[list(errors)] = False
        rewards, terminated, states = self._judge(before, actions, stepped, infos)
        truncated = np.zeros(self.num_envs, dtype=bool)
        if self.max_episode_steps is not None:
            truncated[acting] = self._elapsed[acting] >= self.max_episode_steps
        truncated[list(errors)] = True
        self._ended = terminated | truncated
        self._totals += rewards
        if self.task is not None and states is not None:
            successes = infos.get("success", np.zeros(self.num_envs, dtype=bool)).tolist()
            for i in np.flatnonzero(self._ended & stepped).tolist():
                steps, total = int(self._elapsed[i]), float(self._totals[i])
                end = EpisodeEnd(i, successes[i], bool(terminated[i]), steps, total, states.goal_of(i))
                self.task.ended(end)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._same_step_reset(infos)
        return self._disturbed_observations(), rewards, terminated, truncated, infos

    @property
    def max_episode_steps(self) -> int | None:
        """Actions after which an episode is truncated, or None."""
        return self._settings.max_episode_steps

    def episode_seeds(self) -> NDArray[np.int64]:
        """Return the seed of each environment's episode, from which all variation follows; -1 if nothing varies."""
        found = np.full(self.num_envs, -1, dtype=np.int64)
        found[: len(self._disturbances)] = [disturbances.seed for disturbances in self._disturbances]
        return found

    def _move(
        self,
        fresh: Indices,
        keyframe: str | None,
        acting: Indices = _NONE,
        applied: Applied = _NOTHING,
    ) -> Mapping[int, Exception]:
        """Start episodes and continue others; return the failures by index."""
        keyframe = self._settings.keyframe if keyframe is None else keyframe
        for i, disturbances in self._disturbed(fresh):
            disturbances.begin(self._rngs[i], keyframe)
        errors = self._advance(fresh, keyframe, acting, applied)
        for i, disturbances in self._disturbed(np.concatenate([fresh, acting])) if self._observations_disturbed else ():
            put(self._sensed, i, disturbances.seen(_pick(self._observations, i)))
        self._elapsed[fresh], self._totals[fresh] = 0, 0.0
        self._elapsed[acting] += 1
        self._ended[fresh] = False
        self._ended[list(errors)] = True
        return errors

    def _judge(
        self, before: Observation, actions: Any, stepped: Bools, infos: dict[str, Any]
    ) -> tuple[Floats, Bools, States | None]:
        """Return rewards, terminations and, for a task, the states; add `success` to `infos`."""
        rewards = np.zeros(self.num_envs)
        terminated = np.zeros(self.num_envs, dtype=bool)
        after = None if self.reward_fn is None and self.termination_fn is None else self._true_observations()
        failed = infos.get("_error", np.zeros(self.num_envs, dtype=bool))
        states: States | None = None
        if self.task is not None and not failed.all():  # otherwise no state may exist
            states = self._states(np.arange(self.num_envs))
            rewards, terminated, success = judged(self.task, states, actions)
            if success is not None:
                infos["success"], infos["_success"] = success & ~failed, ~failed
        if self.reward_fn is not None:
            rewards[:] = self.reward_fn(before, actions, after, infos)
        if self.termination_fn is not None:
            terminated[:] = self.termination_fn(after, infos)
        rewards[~stepped] = 0.0
        return rewards, terminated & stepped, states

    def _same_step_reset(self, infos: dict[str, Any]) -> dict[str, Any]:
        ended = self._ended.copy()
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            final[i] = _pick(self._sensed if self._observations_disturbed else self._observations, int(i))
        errors = self._move(np.flatnonzero(ended), self._keyframe)
        after = self._infos({**_errors_in(infos), **errors})
        if "success" in infos:
            after["success"], after["_success"] = infos["success"].copy(), infos["_success"].copy()
            self._add_success(after, np.flatnonzero(ended))
        return {**after, "final_obs": final, "_final_obs": ended, "final_info": infos, "_final_info": ended}

    def _add_success(self, infos: dict[str, Any], fresh: Indices) -> None:
        """Add the `success` of episodes that have just begun: a reset reports it as a step does."""
        success = succeeded(self.task, self._states(fresh)) if self.task is not None and len(fresh) else None
        if success is None:
            return
        for name in ("success", "_success"):
            infos.setdefault(name, np.zeros(self.num_envs, dtype=bool))
        known = ~infos.get("_error", np.zeros(self.num_envs, dtype=bool))[fresh]
        infos["success"][fresh], infos["_success"][fresh] = success & known, known

    def _infos(self, errors: Mapping[int, Exception]) -> dict[str, Any]:
        everywhere = np.ones(self.num_envs, dtype=bool)
        infos: dict[str, Any] = {}
        clocks = self._clocks()
        if self._disturbances:
            clocks["episode_seed"] = self.episode_seeds()
        for name, values in clocks.items():
            infos[name], infos[f"_{name}"] = values, everywhere.copy()
        if errors:
            infos["error"] = np.full(self.num_envs, None, dtype=object)
            infos["_error"] = np.zeros(self.num_envs, dtype=bool)
            for i, error in errors.items():
                infos["error"][i], infos["_error"][i] = error, True
        return infos

    def _set_points(self, actions: Any) -> dict[str, Floats]:
        """Return the set-points of each articulation, shape (environments, n_ctrl)."""
        found = self.mapping.set_points(actions)
        for key, values in found.items():
            if values.ndim != 2 or len(values) != self.num_envs:
                raise ValueError(
                    f"the actions of {key} have shape {values.shape}; their first axis must be {self.num_envs} long"
                )
        return found

    def _true_observations(self) -> Observation:
        """Return the true observations, from which rewards and terminations are computed."""
        return mapped(np.copy, self._observations)

    def _disturbed_observations(self) -> Observation:
        """Return the observations with all disturbances."""
        return mapped(np.copy, self._sensed if self._observations_disturbed else self._observations)

    def _applied(self, indices: Indices, actions: Any, set_points: dict[str, Floats]) -> Applied:
        """Return what takes effect now in some environments, whose actions may be delayed."""
        flat, late = self.mapping.flat(actions), np.zeros(self.num_envs, dtype=np.intp)
        if self.randomise is None or not self.randomise.delays_actions:
            return Applied(flat, set_points, set_points, late)
        before, now = ({key: values.copy() for key, values in set_points.items()} for _ in range(2))
        for i, disturbances in self._disturbed(indices):
            earlier, later = disturbances.delayed({key: values[i] for key, values in set_points.items()})
            late[i] = disturbances.late_steps
            for key in set_points:
                before[key][i], now[key][i] = earlier[key], later[key]
        return Applied(flat, now, before, late)

    def _forces(self, indices: Indices) -> dict[int, dict[str, Floats]]:
        """Return the pushes during the next action, by environment; environments without a push are omitted."""
        if self.randomise is None or not self.randomise.push:
            return {}
        pushed = {i: disturbances.forces() for i, disturbances in self._disturbed(indices)}
        return {i: forces for i, forces in pushed.items() if forces}

    def _disturbed(self, indices: Indices) -> list[tuple[int, Disturbances]]:
        """Return the disturbances of some environments."""
        return [(i, self._disturbances[i]) for i in indices.tolist()] if self._disturbances else []


def _errors_in(infos: dict[str, Any]) -> dict[int, Exception]:
    return {int(i): infos["error"][i] for i in np.flatnonzero(infos["_error"])} if "error" in infos else {}


def put(observations: Observation, indices: Indices | int, found: Observation) -> None:
    """Write observations of some environments into those of all."""
    if isinstance(observations, dict):
        entries = cast("dict[str, Observation]", observations)
        for key, entry in entries.items():
            put(entry, indices, found[key])
    else:
        observations[indices] = found


def _pick(observations: Observation, index: int) -> Observation:
    return mapped(lambda array: array[index].copy(), observations)
