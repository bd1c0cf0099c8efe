"""`URLabVectorEnv`: several sessions, each with its own server, driven concurrently from one event loop."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from urlab_client.aio.background import background_task
from urlab_client.aio.client import URLabClient
from urlab_client.aio.launch import SCHEME, with_model_options, with_option
from urlab_client.errors import URLabError, refused_for_good
from urlab_client.integrations.gym.episode import EnvEpisode
from urlab_client.integrations.gym.settings import EpisodeOptions, EpisodeSettings, client_defaults
from urlab_client.integrations.gym.spaces import Observation
from urlab_client.integrations.gym.task import States, joined
from urlab_client.integrations.gym.vectorized import Applied, Indices, Vectorized, put
from urlab_client.protocol.base import Floats
from urlab_client.randomise.declaration import Randomisation
from urlab_client.sync._portal import Portal


def _processors() -> int:
    """Return how many servers may start at the same time: each occupies a processor until it is up."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Session:
    """One environment: its client, and the arguments for starting it again."""

    def __init__(
        self,
        address: str,
        starts: asyncio.Semaphore,
        client_options: Mapping[str, Any],
        *,
        settings: EpisodeSettings,
        randomise: Randomisation | None,
        index: int,
    ) -> None:
        self.address = address
        self._index = index
        self.restarts = -1
        self.episode: EnvEpisode | None = None
        self._starts = starts
        self._client_options = client_options
        self._settings = settings
        self._randomise = randomise
        self._opening: asyncio.Task[None] | None = None
        self._earlier: EnvEpisode | None = None

    async def reset(self, rng: np.random.Generator, keyframe: str | None, seed: int | None) -> Observation:
        """Start an episode. Without a session, start one; cancelling this call does not stop that."""
        if self.episode is None:
            opening = self._opening or self.reopen()
            await asyncio.shield(opening)
        if self.episode is None:
            raise URLabError("The environment was closed.")
        return await self.episode.reset(rng, keyframe, seed)

    async def step(self, forces: Mapping[str, Floats], applied: Applied) -> Observation:
        """Apply set-points and forces for one action."""
        if self.episode is None:
            raise URLabError("The environment failed earlier.", hint="Reset it to start it again.")
        i = self._index
        now, before = (
            {key: values[i] for key, values in each.items()} for each in (applied.set_points, applied.before)
        )
        return await self.episode.step(now, forces, applied.actions[i], before, int(applied.late[i]))

    def reopen(self) -> asyncio.Task[None]:
        """Drop the session and begin to start a new one, which the next reset waits for."""
        if self._opening is None:
            self._opening = background_task("urlab-environment", self._reopen())
            self._opening.add_done_callback(self._opened)
        return self._opening

    async def close(self) -> None:
        """Close the client, and let the task serve another environment."""
        self._settings.release()
        if self._opening is not None:
            self._opening.cancel()
            await asyncio.wait((self._opening,))
        if self.episode is not None:
            await self.episode.close()
        await self._close_client()

    async def open(self) -> None:
        """Start the session as soon as a start slot is free."""
        async with self._starts:
            client = URLabClient(with_model_options(self.address), **self._client_options)
            try:
                await client.discover()
                self.episode = self._earlier = EnvEpisode(
                    client,
                    settings=self._settings,
                    randomise=self._randomise,
                    earlier=self._earlier,
                    index=self._index,
                )
            except BaseException:
                await client.close()
                raise
        self.restarts += 1

    async def _reopen(self) -> None:
        await self._close_client()
        await self.open()

    async def _close_client(self) -> None:
        episode, self.episode = self.episode, None
        if episode is not None:
            await episode.client.close()

    def _opened(self, task: asyncio.Task[None]) -> None:
        self._opening = None  # a waiting reset raises its error; otherwise the next reset tries again


class URLabVectorEnv(Vectorized):
    """Environments over several servers at once, in lockstep.

    Each environment has its own session and, with `sim://`, its own server process. One event loop in a background
    thread sends the requests of a step concurrently. `infos` contains `step_count`, `sim_time` and `restarts` as
    arrays, and `error` after a failure (see `Vectorized`). An environment that loses its connection or takes too long
    loses its client, too, and with `sim://` its server; one that refuses a request keeps both. Replacements start in
    the background. The environment returns at the first reset that finds them ready within `step_timeout`; it never
    delays the others for longer than that.

    At most one server per processor starts at the same time.
    """

    def __init__(
        self,
        addresses: str | Sequence[str],
        num_envs: int | None = None,
        *,
        randomise: Randomisation | str | os.PathLike[str] | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        step_timeout: float = 10.0,
        start_timeout: float = 60.0,
        client_options: Mapping[str, Any] = MappingProxyType({}),
        **options: Unpack[EpisodeOptions],
    ) -> None:
        """Start the sessions.

        Args:
            addresses: One `sim://` address for all environments, or one address per environment. Servers started here
                honour the model's `<option>`, unless the address contains `?no-mjcf-options`.
            num_envs: Number of environments; required only with a single address.
            randomise: See `URLabEnv`.
            autoreset_mode: `NEXT_STEP`, `SAME_STEP` or `DISABLED`.
            step_timeout: Longest time for a step or reset of one environment, seconds.
            start_timeout: Longest time for the start of one server, seconds, counted from its own start.
            client_options: Further options of the clients.
            options: See `EpisodeOptions`. With `render_mode="rgb_array"`, every step draws a picture of each
                environment.

        Raises:
            URLabError: A session cannot be started. The message names its index.
            ValueError: An option is out of range, or the spaces of the environments differ.
        """
        if isinstance(addresses, str):
            if num_envs is None or not addresses.startswith(SCHEME):
                raise ValueError(
                    "a single address needs num_envs and the scheme sim://; otherwise list one address per environment"
                )
            addresses = [addresses] * num_envs
        if num_envs not in (None, len(addresses)) or not addresses:
            raise ValueError(f"num_envs is {num_envs}, but there are {len(addresses)} addresses")
        for name, seconds in (("step_timeout", step_timeout), ("start_timeout", start_timeout)):
            if seconds <= 0:
                raise ValueError(f"{name} must be above 0 seconds, not {seconds}")
        settings = EpisodeSettings.of(**options)
        declared = None if randomise is None else Randomisation.of(randomise)
        if declared is not None:
            text = declared.to_json()
            addresses = [with_option(a, "randomise", text) for a in addresses]
        self._step_timeout = step_timeout
        self._addresses = tuple(addresses)
        client_options = client_defaults(client_options)
        starts = asyncio.Semaphore(_processors())
        self._sessions = [
            _Session(
                with_option(address, "start-timeout", f"{start_timeout:g}", default=True),
                starts,
                client_options,
                settings=settings,
                randomise=declared,
                index=i,
            )
            for i, address in enumerate(addresses)
        ]
        self._portal = Portal()
        try:
            first = self._portal.call(self._open_all)
        except BaseException:
            self.close_extras()
            raise
        super().__init__(
            num_envs=len(addresses),
            settings=settings,
            mapping=first.mapping,
            observation_space=first.observation_space,
            autoreset_mode=autoreset_mode,
            randomise=first.randomise,
        )
        self._seen: dict[int, States] = {}
        self._pictures: dict[int, NDArray[np.uint8]] = {}
        self._sim_time = np.zeros(self.num_envs)
        self._step_count = np.zeros(self.num_envs, dtype=np.int64)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return the picture of each environment after the last reset or step, shape (H, W, 3), RGB.

        An environment that failed shows its last picture, or black if it has none. None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called yet.
        """
        if self.render_mode is None:
            return None
        for i, session in enumerate(self._sessions):
            if session.episode is not None and (picture := session.episode.rendered()) is not None:
                self._pictures[i] = picture
        if not self._pictures:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        black = np.zeros_like(next(iter(self._pictures.values())))
        return tuple(self._pictures.get(i, black) for i in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the clients and the servers that they started."""
        self._portal.close(self._close_all)

    async def _open_all(self) -> EnvEpisode:
        found = await asyncio.gather(*(session.open() for session in self._sessions), return_exceptions=True)
        for i, failure in enumerate(found):
            if failure is not None:
                raise URLabError(f"Environment {i} at {self._addresses[i]}: {failure}") from failure
        episodes = [session.episode for session in self._sessions if session.episode is not None]
        spaces = [(e.mapping.action_space, e.observation_space) for e in episodes]
        for i, pair in enumerate(spaces):
            if pair != spaces[0]:
                raise ValueError(f"environment {i} at {self._addresses[i]} has different spaces from environment 0")
        return episodes[0]

    async def _close_all(self) -> None:
        await asyncio.gather(*(session.close() for session in self._sessions), return_exceptions=True)

    def _advance(
        self, fresh: Indices, keyframe: str | None, acting: Indices, applied: Applied
    ) -> Mapping[int, Exception]:
        calls: dict[int, Callable[[], Coroutine[Any, Any, Observation]]] = {}
        for i in map(int, fresh):
            seed = self._disturbances[i].seed if self._disturbances else None
            calls[i] = partial(self._sessions[i].reset, self._rngs[i], keyframe, seed)
        forces = self._forces(acting)
        for i in map(int, acting):
            calls[i] = partial(self._sessions[i].step, forces.get(i, {}), applied)
        errors: dict[int, Exception] = {}
        for i, result in self._portal.call(self._all, calls).items():
            if isinstance(result, Exception):
                errors[i] = result
            else:
                put(self._observations, i, result)
        return errors

    def draws(self, index: int) -> dict[str, Any] | None:
        """Return the values drawn for the episode of an environment; see `URLabEnv.draws`."""
        episode = self._sessions[index].episode
        return None if episode is None else episode.draws()

    def _states(self, indices: Indices) -> States:
        for i in map(int, indices):
            episode = self._sessions[i].episode
            if episode is not None:
                self._seen[i] = episode.states()
        return joined([self._seen.get(i) for i in map(int, indices)])

    def _clocks(self) -> dict[str, NDArray[Any]]:
        for i, session in enumerate(self._sessions):
            if session.episode is not None:
                client = session.episode.client
                self._sim_time[i], self._step_count[i] = client.sim_time, client.step_count
        restarts = np.array([session.restarts for session in self._sessions], dtype=np.int64)
        return {"sim_time": self._sim_time.copy(), "step_count": self._step_count.copy(), "restarts": restarts}

    async def _all(self, calls: Mapping[int, Callable[[], Coroutine[Any, Any, Observation]]]) -> dict[int, Any]:
        """Return the observation or the failure of each environment; begin to replace those that were lost."""
        tasks = {i: asyncio.create_task(call()) for i, call in calls.items()}
        late: set[asyncio.Task[Observation]] = set()
        try:
            # One deadline for all: a deadline per environment would cost a tenth of the client's work.
            await asyncio.wait(tasks.values(), timeout=self._step_timeout)
        finally:
            for task in tasks.values():
                if not task.done():
                    late.add(task)
                    task.cancel()
            if late:
                await asyncio.wait(late)
        results: dict[int, Any] = {}
        for i, task in tasks.items():
            if task in late and task.cancelled():
                what = "did not answer" if self._sessions[i].episode else "is still starting"
                results[i] = TimeoutError(f"environment {i} {what} within {self._step_timeout:g} s")
                continue
            try:
                results[i] = task.result()
            except Exception as error:  # noqa: BLE001 - reported in `infos`
                error.add_note(f"environment {i} at {self._addresses[i]}")
                results[i] = error
        for i, result in results.items():
            if isinstance(result, Exception) and not refused_for_good(result):
                self._sessions[i].reopen()
        return results
