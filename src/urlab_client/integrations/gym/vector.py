"""`URLabVectorEnv`: several sessions, each with its own server, driven concurrently from one event loop."""

from __future__ import annotations

import asyncio
import contextlib
import os
from abc import abstractmethod
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from urlab_client._platform.processors import processor_count
from urlab_client.aio.arguments import at_least
from urlab_client.aio.background import background_task
from urlab_client.aio.client import URLabClient
from urlab_client.aio.launch import SCHEME, with_option
from urlab_client.errors import ClientClosed, URLabError, refused_for_good
from urlab_client.integrations._feed.follower import Follower
from urlab_client.integrations.gym.episode import MEASURED, EnvEpisode
from urlab_client.integrations.gym.settings import EpisodeOptions, EpisodeSettings, client_defaults, served_address
from urlab_client.integrations.gym.vectorized import Applied, Floats, Indices, Vectorized, put
from urlab_client.randomise.declaration import Randomisation
from urlab_client.sync._portal import Portal


class OverWire(Vectorized):
    """Environments that are each over a client of their own."""

    def __init__(self, first: EnvEpisode, num_envs: int, autoreset_mode: AutoresetMode) -> None:
        super().__init__(first, num_envs, autoreset_mode, first.randomise)
        self._qpos = np.tile(first.model.qpos0, (num_envs, 1))
        self._qvel = np.zeros((num_envs, first.model.nv))
        self._time = np.zeros(num_envs)
        self._clients: dict[int, URLabClient] = {}
        if first.measures:
            widths = first.model.nsensordata, first.model.nu, first.model.na
            self._measured = {name: np.zeros((num_envs, width)) for name, width in zip(MEASURED, widths, strict=True)}

    @abstractmethod
    async def _episode(self, i: int, *, starting: bool) -> EnvEpisode:
        """Return the episodes of an environment, for a reset (`starting`) or a step."""

    async def _move_one(self, i: int, keyframe: str | None, applied: Applied | None) -> None:
        """Reset an environment, or apply its part of what all do."""
        episode = await self._episode(i, starting=applied is None)
        if applied is None:
            seed = self._disturbances[i].seed if self._disturbances else None
            begin = None if self._memory is None else partial(self._memory.begin, i)
            observation = await episode.reset(self.rngs[i], keyframe, seed, begin)
        else:
            now, before, late, forces = applied
            observation = await episode.step(now[i], forces.get(i, {}), before[i], int(late[i]))
        self._clients[i] = episode.client
        put(self._fields, i, observation)
        self._qpos[i], self._qvel[i], self._time[i] = episode.state()
        if episode.measures:
            for name, values in episode.measured().items():
                self._measured[name][i] = values
        self._step_count[i] = episode.step_count

    def _state(self) -> tuple[Floats, Floats, Floats]:
        return self._qpos, self._qvel, self._time

    def _note(self, indices: Indices, errors: Mapping[int, Exception], *told: NDArray[Any]) -> None:
        for i in indices.tolist():
            for observer in self._clients[i].observers if i not in errors else ():
                if isinstance(observer, Follower) and observer.note is not None:
                    observer.note(self._transition(i, *told))


@dataclass(eq=False)
class _Session:
    """The client of one environment, and how to start it again."""

    address: str
    client_options: Mapping[str, Any]
    settings: EpisodeSettings
    randomise: Randomisation | None
    starts: asyncio.Semaphore
    restarts: int = -1
    episode: EnvEpisode | None = None
    opening: asyncio.Task[None] | None = None
    earlier: EnvEpisode | None = None

    async def ready(self) -> EnvEpisode:
        """Return the episodes. Without a client, start one; cancelling this call does not stop that."""
        if self.episode is None:
            opening = self.opening or self.reopen()
            await asyncio.shield(opening)
        if self.episode is None:
            raise URLabError("The environment was closed.")
        return self.episode

    def reopen(self) -> asyncio.Task[None]:
        """Drop the session and begin to start a new one, which the next reset waits for."""
        if self.opening is None:
            self.opening = background_task("urlab-environment", self._reopen())
        return self.opening

    async def close(self) -> None:
        """Close the client."""
        if self.opening is not None:
            self.opening.cancel()
            await asyncio.wait((self.opening,))
        if self.episode is not None:
            await self.episode.close()
        await self._close_client()

    async def open(self) -> None:
        """Start the session as soon as a start slot is free."""
        async with self.starts:
            client = URLabClient(self.address, **self.client_options)
            try:
                await client.discover()
                self.episode = self.earlier = EnvEpisode(
                    client, settings=self.settings, randomise=self.randomise, earlier=self.earlier
                )
            except BaseException:
                await client.close()
                raise
        self.restarts += 1

    async def _reopen(self) -> None:
        try:
            await self._close_client()
            await self.open()
        finally:
            self.opening = None  # a waiting reset raises its error; otherwise the next reset tries again

    async def _close_client(self) -> None:
        episode, self.episode = self.episode, None
        if episode is not None:
            await episode.client.close()


class URLabVectorEnv(OverWire):
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
            addresses = [addresses] * at_least("num_envs", num_envs, 1)
        if num_envs not in (None, len(addresses)) or not addresses:
            raise ValueError(f"num_envs is {num_envs}, but there are {len(addresses)} addresses")
        for name, seconds in (("step_timeout", step_timeout), ("start_timeout", start_timeout)):
            if seconds <= 0:
                raise ValueError(f"{name} must be above 0 seconds, not {seconds}")
        settings = EpisodeSettings(**options)
        declared = None if randomise is None else Randomisation.of(randomise)
        self._step_timeout = step_timeout
        self._addresses = tuple(addresses)
        starts = asyncio.Semaphore(processor_count())
        self._sessions = [
            _Session(
                served_address(address, declared),
                client_defaults(client_options, address, len(addresses)),
                settings,
                declared,
                starts,
            )
            for address in (with_option(a, "start-timeout", f"{start_timeout:g}", default=True) for a in addresses)
        ]
        self._portal = Portal()
        self._recordings = contextlib.AsyncExitStack()
        try:
            super().__init__(self._portal.call(self._open_all), len(addresses), autoreset_mode)
        except BaseException:
            self._portal.close(self._close_all)
            raise
        self._pictures: dict[int, NDArray[np.uint8]] = {}

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

    @contextlib.contextmanager
    def recording(self, folder: str | os.PathLike[str], **options: Any) -> Generator[list[Path]]:
        """Record environment i into `folder/i.mcap` while the block runs; yield the files.

        An environment that loses its client is recorded until then, and all of them until `close`.

        Args:
            folder: The folder, which is made if necessary.
            options: Options of `urlab_client.integrations.record.record`.

        Raises:
            FileExistsError: A file exists, and `overwrite` was not given.
            RecordingError: Writing failed.
        """
        from urlab_client.integrations.record import record

        Path(folder).mkdir(parents=True, exist_ok=True)
        files: list[Path] = []
        stack = contextlib.AsyncExitStack()
        self._recordings.push_async_callback(stack.aclose)
        try:
            for i, session in enumerate(self._sessions):
                episode = self._portal.call(session.ready)
                files.append(Path(folder) / f"{i}.mcap")
                self._portal.call(stack.enter_async_context, record(episode.client, files[-1], **options))
            yield files
        finally:
            with contextlib.suppress(ClientClosed):  # `close` has ended them
                self._portal.call(stack.aclose)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the clients and the servers that they started, and let the task serve another environment."""
        super().close_extras(**kwargs)
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
        with contextlib.suppress(URLabError):  # which the writer has logged
            await self._recordings.aclose()
        await asyncio.gather(*(session.close() for session in self._sessions), return_exceptions=True)

    def draws(self, index: int) -> dict[str, Any] | None:
        """Return the values drawn for the episode of an environment; see `URLabEnv.draws`."""
        episode = self._sessions[index].episode
        return None if episode is None else episode.draws()

    def _clocks(self) -> dict[str, NDArray[Any]]:
        restarts = np.array([session.restarts for session in self._sessions], dtype=np.int64)
        return {**super()._clocks(), "restarts": restarts}

    async def _episode(self, i: int, *, starting: bool) -> EnvEpisode:
        session = self._sessions[i]
        if not starting and session.episode is None:
            raise URLabError("The environment failed earlier.", hint="Reset it to start it again.")
        return await session.ready()

    def _advance(
        self, fresh: Indices, keyframe: str | None, acting: Indices, applied: Applied
    ) -> Mapping[int, Exception]:
        return self._portal.call(self._move_all, fresh.tolist(), keyframe, acting.tolist(), applied)

    async def _move_all(
        self, fresh: list[int], keyframe: str | None, acting: list[int], applied: Applied
    ) -> dict[int, Exception]:
        """Reset and step environments; return the failures, and begin to replace the clients that were lost."""
        tasks = {i: asyncio.create_task(self._move_one(i, keyframe, None)) for i in fresh}
        tasks |= {i: asyncio.create_task(self._move_one(i, keyframe, applied)) for i in acting}
        try:
            # One deadline for all: a deadline per environment would cost a tenth of the client's work.
            await asyncio.wait(tasks.values(), timeout=self._step_timeout)
        finally:
            late = [task for task in tasks.values() if not task.done()]
            for task in late:
                task.cancel()
            if late:
                await asyncio.wait(late)
        errors: dict[int, Exception] = {}
        for i, task in tasks.items():
            if task in late and task.cancelled():
                what = "did not answer" if self._sessions[i].episode else "is still starting"
                errors[i] = TimeoutError(f"environment {i} {what} within {self._step_timeout:g} s")
                continue
            try:
                task.result()
            except Exception as error:  # noqa: BLE001 - reported in `infos`
                error.add_note(f"environment {i} at {self._addresses[i]}")
                errors[i] = error
        for i, failure in errors.items():
            if not refused_for_good(failure):
                self._sessions[i].reopen()
        return errors
