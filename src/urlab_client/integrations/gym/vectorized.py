"""What all environments have in common, for n environments at once: disturbances, rewards, ends, autoreset, infos."""

from __future__ import annotations

import logging
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array
from numpy.typing import NDArray

from urlab_client.aio.arguments import integer
from urlab_client.errors import URLabError, refused_for_good
from urlab_client.integrations._feed.messages import Transition
from urlab_client.integrations.gym.disturbances import Disturbances
from urlab_client.integrations.gym.episode import EnvEpisode
from urlab_client.integrations.gym.settings import RewardFn, TerminationFn, keyframe_option
from urlab_client.integrations.gym.spaces import Observation, Space, SpaceMapping, mapped
from urlab_client.integrations.gym.task import (
    EpisodeEnd,
    Now,
    States,
    Task,
    judged,
    observed,
    succeeded,
    taken,
    with_task,
)
from urlab_client.randomise.declaration import Randomisation

log: logging.Logger = logging.getLogger("urlab_client.gym")

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
_NONE = np.zeros(0, dtype=np.intp)


class Applied(NamedTuple):
    """What all environments do during one action.

    Attributes:
        set_points: Set-points of all articulations, shape (environments, n_actions).
        before: Set-points that are in force during the first `late` physics steps of the action, likewise.
        late: Number of these physics steps, shape (environments,).
        forces: Forces on bodies, N, world frame, shape (3,), by environment; those without a push are omitted.
    """

    set_points: Floats
    before: Floats
    late: Indices
    forces: dict[int, Mapping[str, Floats]]


_NOTHING = Applied(np.zeros((0, 0)), np.zeros((0, 0)), _NONE, {})


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
        rngs: The generator of each environment's episodes.
        elapsed: Actions of each episode so far, shape (num_envs,). May be written in place, to stagger truncations.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - Gymnasium's
    mapping: SpaceMapping
    observation_space: Space
    action_space: Space
    single_observation_space: Space
    single_action_space: Space

    def __init__(
        self, first: EnvEpisode, num_envs: int, autoreset_mode: AutoresetMode, randomise: Randomisation | None
    ) -> None:
        """Set up the task, and arrays for environments like that of `first`."""
        settings = first.settings
        mapping = self.mapping = first.mapping
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
        self.single_observation_space = with_task(first.observation_space, self.task)
        self.single_action_space = mapping.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(mapping.action_space, num_envs)
        self._observations: Observation = create_empty_array(self.single_observation_space, num_envs)
        # Views of the part that the simulations fill, and of the task's.
        self._fields, self._of_task = self._observations, None
        if n_task and mapping.mode == "dict":
            self._fields = {key: values for key, values in self._observations.items() if key != "task"}
            self._of_task = self._observations["task"]
        elif n_task:
            self._fields, self._of_task = self._observations[:, :-n_task], self._observations[:, -n_task:]
        self._sensed: Observation = self._observations
        if self._observations_disturbed:
            self._sensed = create_empty_array(self.single_observation_space, num_envs)
        self._step_count = np.zeros(num_envs, dtype=np.int64)
        self.elapsed: NDArray[np.int64] = np.zeros(num_envs, dtype=np.int64)
        self._totals = np.zeros(num_envs)
        self._begun = np.zeros(num_envs, dtype=bool)
        self._ended = np.ones(num_envs, dtype=bool)
        self._started = False
        self._n_diverged = 0
        self._keyframe: str | None = None
        self._success: Bools | None = None
        self._all = np.arange(num_envs)
        self._all.flags.writeable = False
        self.rngs: list[np.random.Generator] = [np.random.default_rng() for _ in range(num_envs)]
        self._recent: States | None = None
        self._measured: Mapping[str, Floats] = {}  # of all environments, as in `States`
        self._memory = settings.memory(first.model, mapping, num_envs)

    @abstractmethod
    def _advance(
        self, fresh: Indices, keyframe: str | None, acting: Indices, applied: Applied
    ) -> Mapping[int, Exception]:
        """Reset some environments to a keyframe and step others; return the failures by index.

        `put` the observations of the others, without the task's part, into `_fields`.
        """

    @abstractmethod
    def _state(self) -> tuple[Floats, Floats, Floats]:
        """Return the positions, velocities and times of all environments, those of an action or episode ago included.

        Their shapes are (environments, nq), (environments, nv) and (environments,).
        """

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | NDArray[np.integer] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in all environments, or in some.

        Args:
            seed: Seed of environment 0; environment i gets `seed + i`. A sequence gives one seed per environment. None
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
        if isinstance(seed, (Sequence, np.ndarray)):
            seeds = [None if each is None else integer("seed", each) for each in seed]
        else:
            first = None if seed is None else integer("seed", seed)
            seeds = [None if first is None else first + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments")
        super().reset(seed=None)
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self.rngs[i] = np.random.default_rng(seeds[i])
        if self.task is not None and seed is None and self.max_episode_steps in (None, sys.maxsize):
            # What truncates such episodes, as `gymnasium.make` does, does not say so: it only resets. A seed begins
            # anew, and the same each time, so it must not advance a curriculum.
            self._tell_ends(self.task, mask & ~self._ended & (self.elapsed > 0), np.zeros(self.num_envs, dtype=bool))
        errors = self._move(np.flatnonzero(mask), keyframe)
        self._started = True
        refusal = next(filter(refused_for_good, errors.values()), None)
        if refusal is not None:
            raise refusal
        self._keyframe = keyframe
        return self._shown(), self._infos(errors)

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
        flat = self.mapping.flat(actions)  # validates before anything moves
        if flat.ndim != 2 or len(flat) != self.num_envs:
            raise ValueError(f"the actions have shape {flat.shape}; their first axis must be {self.num_envs} long")
        fresh, acting = _NONE, self._all
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and self._ended.any():
            fresh, acting = np.flatnonzero(self._ended), np.flatnonzero(~self._ended)
        before = None if self.reward_fn is None else mapped(np.copy, self._observations)
        self.elapsed += 1
        began = self._state()[2].copy()
        errors = self._move(fresh, self._keyframe, acting, flat)
        errors = {**errors, **self._diverged(acting, began, errors)}
        infos = self._infos(errors)
        rewards, terminated = self._judged(before, actions, errors, infos)
        if idle := [*fresh.tolist(), *errors]:
            rewards[idle], terminated[idle] = 0.0, False
        limit = self.max_episode_steps
        truncated = np.zeros(self.num_envs, dtype=bool) if limit is None else self.elapsed >= limit
        if errors:
            truncated[list(errors)] = True
        ended = terminated | truncated
        self._totals += rewards
        self._note(acting, errors, flat, rewards, terminated, truncated)
        over = ended.any()
        if over and self.task is not None:
            self._tell_ends(self.task, ended & ~self._ended, terminated)  # those that failed are marked already
        # Without autoreset, an environment may be stepped after the end of its episode.
        self._ended = ended | self._ended if self.autoreset_mode is AutoresetMode.DISABLED else ended
        if over and self.autoreset_mode is AutoresetMode.SAME_STEP:
            infos = self._same_step_reset(errors, infos)
        return self._shown(), rewards, terminated, truncated, infos

    def _diverged(self, acting: Indices, began: Floats, errors: Mapping[int, Exception]) -> dict[int, Exception]:
        """Return an error for each environment whose simulation was reset, or lost its numbers, during its action."""
        qpos, _, now = self._state()
        found: dict[int, Exception] = {}
        for i in acting[(now[acting] <= began[acting]) | ~np.isfinite(qpos[acting].sum(axis=1))].tolist():
            if i not in errors:
                what = f"Simulation time went from {began[i]:.3f} s to {now[i]:.3f} s"
                what = what if now[i] <= began[i] else "Joint positions stopped being finite"
                hint = "MuJoCo resets a simulation that diverges. Try a shorter timestep, or weaker gains."
                found[i] = URLabError(f"{what} during an action.", hint=hint)
        self._ended[[*found]] = True  # so that no task is told, as of other failures
        total = self._n_diverged + len(found)
        if total.bit_length() > self._n_diverged.bit_length():  # what is unstable is so in every episode
            last = [*found.values()][-1]
            log.warning("episodes that ended because their simulations diverged: %d; the last: %s", total, last)
        self._n_diverged = total
        return found

    def _note(self, indices: Indices, errors: Mapping[int, Exception], *told: NDArray[Any]) -> None:
        """Tell who records environments, if they did not fail, what led to their states; see `_transition`.

        Nobody records a batch, which has no client.
        """

    def _transition(self, i: int, actions: Floats | None = None, *judged: NDArray[Any]) -> Transition:
        """Return the start of an environment's episode, or its action with reward, termination and truncation."""
        told: dict[str, Any] = {} if self._success is None else {"success": bool(self._success[i])}
        told["goal"] = {name: np.ravel(values).astype(np.float64).tolist() for name, values in self._goal(i).items()}
        if actions is None:
            return Transition(actions=0, **told)
        if self.randomise is not None and self.randomise.delays_actions:
            meant = self.mapping.split(self.mapping.scaled(actions[i]))
            told["chosen"] = {self.mapping.names[key]: values.tolist() for key, values in meant.items()}
        reward, terminated, truncated = (values[i].item() for values in judged)
        told |= {"reward": reward, "terminated": terminated, "truncated": truncated}
        return Transition(actions=int(self.elapsed[i]), action=actions[i].tolist(), **told)

    @property
    def max_episode_steps(self) -> int | None:
        """Actions after which an episode is truncated, or None."""
        return self._settings.max_episode_steps

    @property
    def n_substeps(self) -> int:
        """Physics steps per action."""
        return self._settings.n_substeps

    def episode_seeds(self) -> NDArray[np.int64]:
        """Return the seed of each environment's episode, from which all variation follows; -1 if nothing varies."""
        found = np.full(self.num_envs, -1, dtype=np.int64)
        found[: len(self._disturbances)] = [disturbances.seed for disturbances in self._disturbances]
        return found

    def close_extras(self, **kwargs: Any) -> None:
        """Let the task serve another environment."""
        self._settings.release()

    def _move(
        self,
        fresh: Indices,
        keyframe: str | None,
        acting: Indices = _NONE,
        actions: Floats | None = None,
    ) -> Mapping[int, Exception]:
        """Start episodes and continue others; return the failures by index."""
        keyframe = self._settings.keyframe if keyframe is None else keyframe
        for i, disturbances in self._disturbed(fresh):
            disturbances.begin(self.rngs[i], keyframe)
        applied = _NOTHING if actions is None else self._applied(acting, self.mapping.scaled(actions))
        errors = self._advance(fresh, keyframe, acting, applied)
        moved = acting if not len(fresh) else np.sort(np.concatenate([fresh, acting]))
        if errors:
            moved, acted = (np.array([i for i in each if i not in errors], dtype=np.intp) for each in (moved, acting))
        else:
            moved, acted = self._all if len(moved) == self.num_envs else moved, acting
        if self.task is not None and len(moved):
            self._ask(self.task, moved, acted, actions)
        if self._observations_disturbed:
            for i, disturbances in self._disturbed(moved):
                put(self._sensed, i, disturbances.seen(of_one(self._observations, i)))
        if len(fresh):
            self.elapsed[fresh], self._totals[fresh], self._ended[fresh] = 0, 0.0, False
            self._note(fresh, errors)
        if errors:
            self._ended[list(errors)] = True
        return errors

    def _ask(self, task: Task, moved: Indices, acted: Indices, actions: Floats | None) -> None:
        """Let the task update what it keeps after actions; ask what it observes, and for success, after all moves."""
        self._recent = None
        if self._memory is not None and actions is not None and len(acted):
            self._recent = self._memory.updated(acted, actions[acted], self._now(acted))
        states = self._states(moved)
        found, success = observed(task, states), succeeded(task, states)
        if self._of_task is not None:
            self._of_task[moved] = found
        if success is not None:
            if self._success is None:
                self._success = np.zeros(self.num_envs, dtype=bool)
            self._success[moved], self._begun[moved] = success, True

    def _states(self, indices: Indices) -> States:
        """Return the states of some environments in the form passed to the task."""
        if self._memory is None:
            raise ValueError("this environment has no task")
        if self._recent is None or self._recent.index is not indices:
            self._recent = self._memory.states(indices, self._now(indices))
        return self._recent

    def _now(self, indices: Indices) -> Now:
        qpos, qvel, time = taken(indices, *self._state())
        return Now(qpos, qvel, time, dict(zip(self._measured, taken(indices, *self._measured.values()), strict=True)))

    def _judged(
        self, before: Observation, actions: Any, errors: Mapping[int, Exception], infos: dict[str, Any]
    ) -> tuple[Floats, Bools]:
        """Return the rewards and terminations of all environments, whether they took the action or not."""
        rewards, terminated = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)
        if self.task is not None and len(errors) < self.num_envs:  # otherwise there may be no goal
            rewards, terminated = judged(self.task, self._states(self._all), actions)
        if self.reward_fn is not None or self.termination_fn is not None:
            after = mapped(np.copy, self._observations)
            if self.reward_fn is not None:
                rewards[:] = self._ask_user(self.reward_fn, before, actions, after, infos)
            if self.termination_fn is not None:
                terminated[:] = self._ask_user(self.termination_fn, after, infos)
        return rewards, terminated

    def _ask_user(self, function: Callable[..., Any], *trees: Any) -> Any:
        """Call a function for rewards or terminations of all environments; the last of `trees` are the infos."""
        return function(*trees)

    def _tell_ends(self, task: Task, ended: Bools, terminated: Bools) -> None:
        for i in np.flatnonzero(ended).tolist():
            success = self._success is not None and bool(self._success[i])
            steps, total, goal = int(self.elapsed[i]), float(self._totals[i]), self._goal(i)
            task.ended(EpisodeEnd(i, success, bool(terminated[i]), steps, total, goal))

    def _goal(self, i: int) -> Mapping[str, Floats]:
        return {} if self._memory is None else self._memory.goal(i)

    def _same_step_reset(self, errors: Mapping[int, Exception], infos: dict[str, Any]) -> dict[str, Any]:
        ended = self._ended.copy()
        final = np.full(self.num_envs, None, dtype=object)
        shown = self._shown()
        for i in np.flatnonzero(ended):
            final[i] = of_one(shown, int(i))
        after = self._infos({**errors, **self._move(np.flatnonzero(ended), self._keyframe)})
        return {**after, "final_obs": final, "_final_obs": ended, "final_info": infos, "_final_info": ended}

    def _infos(self, errors: Mapping[int, Exception]) -> dict[str, Any]:
        """Return what is known about each environment, and below `_NAME` of which ones it is."""
        infos, everyone = dict[str, Any](), np.ones(self.num_envs, dtype=bool)
        for name, values in self._clocks().items():
            infos[name], infos[f"_{name}"] = values, everyone
        if self._success is not None:
            known = self._begun.copy()
            known[list(errors)] = False
            if known.any():
                infos["success"], infos["_success"] = self._success & known, known
        if errors:
            infos["error"], infos["_error"] = np.full(self.num_envs, None, dtype=object), np.zeros(self.num_envs, bool)
            for i, error in errors.items():
                infos["error"][i], infos["_error"][i] = error, True
        return infos

    def _clocks(self) -> dict[str, NDArray[Any]]:
        """Return the entries of `infos` that every environment has, by name."""
        clocks: dict[str, NDArray[Any]] = {"sim_time": self._state()[2].copy(), "step_count": self._step_count.copy()}
        return {**clocks, "episode_seed": self.episode_seeds()} if self._disturbances else clocks

    def _shown(self) -> Observation:
        """Return the observations with all disturbances. Rewards and terminations are computed from the true ones."""
        return mapped(np.copy, self._sensed)

    def _applied(self, indices: Indices, set_points: Floats) -> Applied:
        """Return what takes effect now in some environments, which may be pushed, and whose actions may be delayed."""
        delayed = self.randomise is not None and self.randomise.delays_actions
        before = set_points.copy() if delayed else set_points
        applied = Applied(set_points, before, np.zeros(self.num_envs, dtype=np.intp), {})
        for i, disturbances in self._disturbed(indices):
            if pushes := disturbances.forces():
                applied.forces[i] = pushes
            if delayed:
                applied.before[i], applied.set_points[i] = disturbances.delayed(set_points[i])
                applied.late[i] = disturbances.late_steps
        return applied

    def _disturbed(self, indices: Indices) -> list[tuple[int, Disturbances]]:
        """Return the disturbances of some environments."""
        return [(i, self._disturbances[i]) for i in indices.tolist()] if self._disturbances else []


def put(observations: Observation, indices: Indices | int, found: Observation) -> None:
    """Write observations of some environments into those of all."""
    if isinstance(observations, dict):
        entries = cast("dict[str, Observation]", observations)
        for key, entry in entries.items():
            put(entry, indices, found[key])
    else:
        observations[indices] = found


def of_one(observations: Observation, i: int = 0) -> Observation:
    """Return the observation or action of one environment among those of all, as views."""
    return mapped(lambda array: array[i], observations)


def need_same_step(env: VectorEnv[Any, Any, Any], library: str) -> None:
    """Refuse an environment that does not reset in the step that ends an episode, as a library does."""
    mode = env.metadata.get("autoreset_mode")
    if mode is not AutoresetMode.SAME_STEP:
        raise ValueError(
            f"{library} resets in the step that ends an episode: make the environment with "
            f"autoreset_mode=AutoresetMode.SAME_STEP, not {getattr(mode, 'name', mode)}"
        )


def info_of(infos: Mapping[str, Any], i: int = 0) -> dict[str, Any]:
    """Return the infos of one environment of a vector environment, with plain numbers."""
    names = [name for name in infos if not name.startswith(("_", "final_")) and infos[f"_{name}"][i]]
    return {name: _at(infos[name], i) for name in names}


def _at(values: Any, i: int) -> Any:
    """Return the entry of one environment; wrappers nest dictionaries."""
    if isinstance(values, dict):
        entries = cast("dict[str, Any]", values)
        return {name: _at(inner, i) for name, inner in entries.items() if not name.startswith("_")}
    return values[i].item() if isinstance(values[i], np.generic) else values[i]
