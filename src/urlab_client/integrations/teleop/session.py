"""`teleoperate`: an operator moves the hand, episode by episode, while a recording runs."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from msgspec import Struct

from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.aio.model.mirror import require_local
from urlab_client.enums import StepMode
from urlab_client.errors import URLabError
from urlab_client.integrations._feed.messages import EpisodeOutcome
from urlab_client.integrations._flavours import blocking
from urlab_client.integrations.teleop.hand import HandControl
from urlab_client.protocol.base import Floats
from urlab_client.values.plain import Serializable

if TYPE_CHECKING:
    from urlab_client.integrations.gym import Task
    from urlab_client.integrations.gym.episode import EnvEpisode
    from urlab_client.integrations.gym.task import Memory
    from urlab_client.integrations.record import AsyncRecorder, Recorder

Verdict = EpisodeOutcome | Literal["quit"]


class TeleopCommand(Struct, frozen=True, kw_only=True):
    """The command of an operator for one period.

    Attributes:
        linear: Velocity of the hand as a fraction of the largest speed, world frame.
        angular: Angular velocity as a fraction of the largest angular speed, about the world axes.
        gripper: Rate from -1 (towards the smallest set-point) to 1 (towards the largest).
        verdict: `success`, `failure` or `discarded` ends the episode; `quit` ends the session; None continues.
    """

    linear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gripper: float = 0.0
    verdict: Verdict | None = None

    @property
    def moves(self) -> bool:
        """Whether the command moves anything."""
        return any((*self.linear, *self.angular, self.gripper))


class TeleopView(Struct, frozen=True, kw_only=True, eq=False):
    """What an operator sees in one period.

    Attributes:
        episode: Number of the episode, starting at 0.
        time: Simulated time since the start of the episode, seconds.
        position: Position of the hand, metres, world frame, shape (3,).
        quaternion: Orientation of the hand, (w, x, y, z), world frame, shape (4,).
        goal: Goal of the episode, as in `Start.goal` of the task.
        success: Whether the state is a success; None if no task defines it.
        blocked: Whether the target of the hand could not follow the last command.
        tally: Episodes so far.
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
    """Number of episodes by outcome.

    Attributes:
        success: Successful episodes.
        failure: Failed episodes.
        discarded: Discarded episodes, including one interrupted by the end of the session.
    """

    success: int = 0
    failure: int = 0
    discarded: int = 0


class Operator(Protocol):
    """Source of commands: keys, a gamepad or a script. Called once per period; may be a coroutine function."""

    def __call__(self, view: TeleopView, /) -> TeleopCommand | Awaitable[TeleopCommand]:
        """Return the command for the next period."""
        ...


async def teleoperate(
    client: AsyncClient,
    operator: Operator,
    *,
    hand: HandControl | None = None,
    task: Task | None = None,
    recorder: AsyncRecorder | Recorder | None = None,
    episodes: int | None = None,
    seconds: float | None = None,
    hz: float = 50.0,
    seed: int = 0,
    paced: bool = False,
) -> TeleopTally:
    """Let an operator move the hand, episode by episode, until it quits or has completed enough episodes.

    An episode begins with a reset. Simulated time stands still until the operator moves something. The episode ends
    with a verdict, which `recorder` stores together with the goal. An interrupted episode counts as discarded. This
    function needs direct mode, in which every command takes effect and all periods have the same length.

    Args:
        client: A discovered client in direct mode.
        operator: Source of the command for each period.
        hand: Control of the hand; by default, of the only site of the only robot.
        task: Task that sets the starts and goals of episodes; see `urlab_client.integrations.gym.Task`.
        recorder: A running recording of this client.
        episodes: Number of successes and failures after which to stop. If None, only the operator stops.
        seconds: Simulated seconds after which an episode ends, as a success if the task reports one, otherwise as a
            failure. None means no limit.
        hz: Periods per simulated second. With a task, its actions are the periods.
        seed: Seed of the starts and goals of the episodes.
        paced: Whether to limit simulated time to real time, for a human operator.

    Returns:
        Number of episodes by outcome.

    Raises:
        URLabError: The client is not in direct mode or has no model, or the server refused a request.
        ValueError: A number is out of range.
    """
    session = _Session(client, operator, hand=hand, task=task, recorder=recorder, hz=hz, seed=seed, paced=paced)
    for name, value in (("episodes", episodes), ("seconds", seconds)):
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be above 0 or None, not {value:g}")
    return await session.run(episodes, seconds)


teleoperate_blocking = blocking(teleoperate)
"""Teleoperate like `teleoperate`, with a blocking client and its recorder."""


@dataclass
class _Session:
    """One call of `teleoperate`."""

    client: AsyncClient
    operator: Operator
    hand: HandControl | None
    task: Task | None
    recorder: AsyncRecorder | Recorder | None
    hz: float
    seed: int
    paced: bool

    def __post_init__(self) -> None:
        client = self.client
        model = require_local(client.model, "Teleoperation")
        if client.step_mode is not StepMode.DIRECT:
            raise URLabError(
                f"Teleoperation steps physics itself, but the step mode is {client.step_mode}.",
                hint="Make the client with step_mode='direct'.",
            )
        timestep = float(model.opt.timestep)
        if not 0 < self.hz <= 1.0 / timestep * (1.0 + 1e-9):
            raise ValueError(f"hz must be above 0 and at most one period per physics step, {1.0 / timestep:g}")
        self._rng = np.random.default_rng(self.seed)
        self._n_steps = max(1, round(1.0 / (self.hz * timestep)))
        self._starts: EnvEpisode | None = None
        self._memory: Memory | None = None
        if self.task is not None:
            from urlab_client.integrations.gym.episode import EnvEpisode
            from urlab_client.integrations.gym.settings import EpisodeSettings

            settings = EpisodeSettings(task=self.task, cameras=())
            self._n_steps = settings.n_substeps
            self._starts = EnvEpisode(client, settings=settings)
            self._memory = settings.memory(model, self._starts.mapping, 1)
        self._hand = HandControl(client) if self.hand is None else self.hand
        self._period = self._n_steps * timestep
        self._tally = TeleopTally()
        self._episode = 0

    async def run(self, episodes: int | None, seconds: float | None) -> TeleopTally:
        """Run episodes until the operator quits or enough are complete."""
        while episodes is None or self._tally.success + self._tally.failure < episodes:
            await self._reset()
            self._hand.hold()
            verdict, moved = await self._drive(seconds)
            if moved:
                await self._judge("discarded" if verdict == "quit" else verdict)
            if verdict == "quit" or (self.recorder is not None and self.recorder.failed):
                break
        return self._tally

    async def _drive(self, seconds: float | None) -> tuple[Verdict, bool]:
        """Run one episode; return its verdict, and whether anything moved."""
        client, began, moved = self.client, self.client.sim_time, False
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            view = self._view(client.sim_time - began)
            answer = self.operator(view)
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
            await asyncio.sleep(max(0.0, due - loop.time()) if self.paced or not moved else 0.0)

    def _view(self, time: float) -> TeleopView:
        position, quaternion = self._hand.ik.pose()
        goal, success = self._goal_and_success()
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
        if self.recorder is not None:
            marking = self.recorder.mark(verdict, goal=self._goal_and_success()[0])
            if inspect.isawaitable(marking):
                await marking

    async def _reset(self) -> None:
        if self._starts is None:
            for articulation in self.client.articulations.values():
                articulation.ctrl_array[:] = 0.0
            await self.client.reset()
        else:
            seed = None if self._starts.randomise is None else int(self._rng.integers(2**31))
            begin = None if self._memory is None else partial(self._memory.begin, 0)
            await self._starts.reset(self._rng, seed=seed, begin=begin)

    def _goal_and_success(self) -> tuple[Mapping[str, Floats], bool | None]:
        """Return the goal of the episode, and whether the current state is a success."""
        if self._starts is None or self._memory is None or self.task is None:
            return {}, None
        from urlab_client.integrations.gym.task import Now

        qpos, qvel, time = self._starts.state()
        measured = {name: values[None] for name, values in self._starts.measured().items()}
        now = Now(qpos[None].copy(), qvel[None].copy(), np.array([time]), measured)
        states = self._memory.states(np.zeros(1, dtype=np.intp), now)
        found = self.task.success(states)
        return {name: values[0] for name, values in states.goal.items()}, None if found is None else bool(found[0])
