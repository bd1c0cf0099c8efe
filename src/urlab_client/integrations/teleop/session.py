"""`teleoperate`: episode after episode, an operator moves the hand while a recording runs."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Mapping
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from msgspec import Struct

from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.integrations._feed.messages import EpisodeOutcome
from urlab_client.integrations.teleop.hand import HandControl
from urlab_client.protocol.base import Floats
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.serializable import Serializable
from urlab_client.sync._facade import aio_of, portal_of
from urlab_client.sync.client import URLabClient

if TYPE_CHECKING:
    from urlab_client.integrations.gym import Task
    from urlab_client.integrations.record import AsyncRecorder, Recorder

__all__ = ["Operator", "TeleopCommand", "TeleopTally", "TeleopView", "teleoperate", "teleoperate_blocking"]

Verdict = EpisodeOutcome | Literal["quit"]


class TeleopCommand(Struct, frozen=True, kw_only=True):
    """What an operator does in one period.

    Attributes:
        linear: Velocity of the hand as a share of the largest, world frame.
        angular: Rate of turn likewise, about the world's axes.
        gripper: Towards its largest set-point (1) or its smallest (-1).
        verdict: Ends the episode as `success`, `failure` or `discarded`, or with `quit` all; None goes on.
    """

    linear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gripper: float = 0.0
    verdict: Verdict | None = None

    @property
    def moves(self) -> bool:
        """Whether it moves anything."""
        return any((*self.linear, *self.angular, self.gripper))


class TeleopView(Struct, frozen=True, kw_only=True):
    """What an operator sees in one period.

    Attributes:
        episode: Number of the episode, from 0 on.
        time: Simulated seconds since its beginning.
        position: Where the hand is, metres, world frame, shape (3,).
        quaternion: Its orientation (w, x, y, z), world frame, shape (4,).
        goal: What the episode is about, as the task has it.
        success: Whether the state is a success; None without a task that knows.
        blocked: Whether the hand's target could not move as it was told to.
        tally: Episodes up to now.
    """

    episode: int
    time: float
    position: Floats
    quaternion: Floats
    goal: Mapping[str, Floats]
    success: bool | None
    blocked: bool
    tally: TeleopTally


class TeleopTally(Serializable, Struct, frozen=True):
    """How many episodes ended how.

    Attributes:
        success: Successes.
        failure: Failures.
        discarded: Discarded episodes, and one that was broken off at the end.
    """

    success: int = 0
    failure: int = 0
    discarded: int = 0


class Operator(Protocol):
    """Who moves the hand: keys, a gamepad, or a script. Called once per period; may be a coroutine function."""

    def __call__(self, view: TeleopView, /) -> TeleopCommand | Awaitable[TeleopCommand]:
        """Return what to do in the next period."""
        ...


async def teleoperate(
    client: AsyncClient,
    operator: Operator,
    *,
    hand: HandControl | None = None,
    task: Task | None = None,
    recorder: AsyncRecorder | None = None,
    episodes: int | None = None,
    seconds: float | None = None,
    hz: float = 50.0,
    seed: int = 0,
    paced: bool = False,
) -> TeleopTally:
    """Let an operator move the hand, episode after episode, until it quits or there are enough.

    An episode begins with a reset, after which time stands still until the operator moves something, and ends with a
    verdict, which `recorder` notes with what the episode was about. What was broken off counts as discarded. Needs
    direct mode, in which nothing is lost and a period is always as long.

    Args:
        client: A discovered client in direct mode.
        operator: Decides on each period.
        hand: The control of the hand; by default that of the only robot's only site.
        task: Decides where episodes start and what they are about; see `urlab_client.integrations.gym.Task`.
        recorder: A recording of this client that is under way.
        episodes: Successes and failures after which to end; only the operator ends it for None.
        seconds: Simulated seconds after which an episode ends by itself: a success if the task says so, else a
            failure. No limit for None.
        hz: Periods per simulated second; with a task its actions are the periods.
        seed: Decides on the starts and goals of the episodes.
        paced: Let simulated time pass no faster than the clock, for a person.

    Returns:
        How many episodes ended how.

    Raises:
        URLabError: The client is not in direct mode or has no model, or the server refused something.
        ValueError: A number is out of range.
    """
    session = _Session(client, operator, hand=hand, task=task, recorder=recorder, hz=hz, seed=seed, paced=paced)
    for name, value in (("episodes", episodes), ("seconds", seconds)):
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be above 0 or None, not {value:g}")
    return await session.run(episodes, seconds)


def teleoperate_blocking(
    client: URLabClient,
    operator: Operator,
    *,
    hand: HandControl | None = None,
    task: Task | None = None,
    recorder: Recorder | None = None,
    episodes: int | None = None,
    seconds: float | None = None,
    hz: float = 50.0,
    seed: int = 0,
    paced: bool = False,
) -> TeleopTally:
    """Do what `teleoperate` does with a blocking client and a recorder of it."""
    return portal_of(client).call(
        teleoperate,
        aio_of(client),
        operator,
        hand=hand,
        task=task,
        recorder=None if recorder is None else recorder.aio,
        episodes=episodes,
        seconds=seconds,
        hz=hz,
        seed=seed,
        paced=paced,
    )


class _Session:
    """One call of `teleoperate`."""

    def __init__(
        self,
        client: AsyncClient,
        operator: Operator,
        *,
        hand: HandControl | None,
        task: Task | None,
        recorder: AsyncRecorder | None,
        hz: float,
        seed: int,
        paced: bool,
    ) -> None:
        model = client.model
        if model is None or client.step_mode is not StepMode.DIRECT:
            raise URLabError(
                f"Teleoperation steps physics itself, but the step mode is {client.step_mode}."
                if model is not None
                else "Teleoperation needs the local model, which this client does not have.",
                hint="Make the client with step_mode='direct', and call discover() during play.",
            )
        timestep = float(model.opt.timestep)
        if not 0 < hz <= 1.0 / timestep * (1.0 + 1e-9):
            raise ValueError(f"hz must be above 0 and at most one period per physics step, {1.0 / timestep:g}")
        self._client = client
        self._operator = operator
        self._recorder = recorder
        self._paced = paced
        self._rng = np.random.default_rng(seed)
        self._start = _Start(client) if task is None else _TaskStart(client, task)
        self._hand = HandControl(client) if hand is None else hand
        self._n_steps = self._start.n_steps or max(1, round(1.0 / (hz * timestep)))
        self._period = self._n_steps * timestep
        self._tally = TeleopTally()
        self._episode = 0

    async def run(self, episodes: int | None, seconds: float | None) -> TeleopTally:
        """Go on until the operator quits or there are enough episodes."""
        while episodes is None or self._tally.success + self._tally.failure < episodes:
            await self._start.reset(self._rng)
            self._hand.hold()
            verdict, moved = await self._drive(seconds)
            if moved:
                await self._judge("discarded" if verdict == "quit" else verdict)
            if verdict == "quit" or (self._recorder is not None and self._recorder.failed):
                break
        return self._tally

    async def _drive(self, seconds: float | None) -> tuple[Verdict, bool]:
        """Let the operator drive one episode; return how it ended, and whether anything moved."""
        client, began, moved = self._client, self._client.sim_time, False
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            view = self._view(client.sim_time - began)
            answer = self._operator(view)
            command = await answer if inspect.isawaitable(answer) else answer
            if command.verdict is not None:
                return command.verdict, moved
            if seconds is not None and view.time >= seconds - self._period / 2:
                return ("success" if view.success else "failure"), moved
            moved = moved or command.moves
            if moved:
                self._hand.drive(command.linear, command.angular, command.gripper, dt=self._period)
                await client.step(self._n_steps)
            due = max(due + self._period, loop.time() - self._period)
            await asyncio.sleep(max(0.0, due - loop.time()) if self._paced or not moved else 0.0)

    def _view(self, time: float) -> TeleopView:
        position, quaternion = self._hand.ik.pose()
        goal, success = self._start.look()
        return TeleopView(
            episode=self._episode,
            time=time,
            position=position,
            quaternion=quaternion,
            goal=goal,
            success=success,
            blocked=self._hand.blocked,
            tally=self._tally,
        )

    async def _judge(self, verdict: EpisodeOutcome) -> None:
        self._episode += 1
        self._tally = self._tally.replace(**{verdict: getattr(self._tally, verdict) + 1})
        if self._recorder is not None:
            await self._recorder.mark(verdict, goal=self._start.look()[0])


class _Start:
    """Episodes of a scene without a task: they begin where a reset leads."""

    n_steps: int | None = None

    def __init__(self, client: AsyncClient) -> None:
        self._client = client

    async def reset(self, rng: np.random.Generator) -> None:
        del rng
        for articulation in self._client.articulations.values():
            articulation.ctrl_array[:] = 0.0
        await self._client.reset()

    def look(self) -> tuple[Mapping[str, Floats], bool | None]:
        """Return what the episode is about, and whether its state is a success."""
        return {}, None


class _TaskStart(_Start):
    """Episodes of a task."""

    def __init__(self, client: AsyncClient, task: Task) -> None:
        from urlab_client.integrations.gym.episode import EnvEpisode  # noqa: PLC0415
        from urlab_client.integrations.gym.task import EpisodeSettings  # noqa: PLC0415

        super().__init__(client)
        settings = EpisodeSettings.of(
            task,
            observations=None,
            n_substeps=None,
            max_episode_steps=None,
            keyframe=None,
            reset_noise=None,
            space_mode=None,
            cameras=(),
        )
        self.n_steps = settings.n_substeps
        self._task = task
        self._episode = EnvEpisode(client, settings=settings, rendered=(), task=task)

    async def reset(self, rng: np.random.Generator) -> None:
        seed = None if self._episode.randomise is None else int(rng.integers(2**31))
        await self._episode.reset(rng, seed=seed)

    def look(self) -> tuple[Mapping[str, Floats], bool | None]:
        states = self._episode.states()
        found = self._task.success(states)
        return {name: values[0] for name, values in states.goal.items()}, None if found is None else bool(found[0])
