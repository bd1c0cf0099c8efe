"""Letting simulation time pass until a condition holds: `run_for()`, `wait_until()` and `move_to()`.

They work in every step mode: in `direct` and `puppet` the client steps, in `live` it waits. Limits are in simulation
time, so they mean the same on a slow machine. A wall-clock timeout detects simulation time that stands still.
"""

from __future__ import annotations

import inspect
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable, Mapping
from contextlib import aclosing

from urlab_client.aio.arguments import finite, mapping
from urlab_client.aio.articulation import URLabArticulation
from urlab_client.aio.background import running_loop
from urlab_client.aio.client_types import Diagnosis, Verdict
from urlab_client.aio.model.elements import Joint, ScalarJoint
from urlab_client.aio.session.session import server_restarted
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.streams.stream import Stream
from urlab_client.enums import OutOfRange, StepMode
from urlab_client.errors import NotSettled, URLabTimeoutError
from urlab_client.protocol.messages.session import StepOk

_CHECK_S = 0.01  # simulation time between two checks of a predicate
_SLICE_S = 0.1  # simulation time per request without a predicate: a slow scene still finishes it within its deadline
_MOVING = 0.01  # rad/s or m/s: a joint that is slower than this is stuck
_AT_REST_S = 0.1  # a joint has settled if it would stay within the tolerance for this long


class Motion:
    """Lets simulation time pass."""

    def __init__(
        self,
        state: SimState,
        *,
        step: Callable[[int], Awaitable[StepOk]],
        explain: Callable[[], Awaitable[Diagnosis]],
        locate: Callable[[], Awaitable[None]],
    ) -> None:
        self._state = state
        self._session = state.session
        self._step = step
        self._explain = explain
        self._locate = locate  # asks the server for the state if it is not known yet
        # Seconds of wall-clock time within which simulation time must advance.
        self._stall_timeout = state.session.default_timeout

    async def run_for(self, seconds: float) -> float:
        """See `URLabClient.run_for`."""
        seconds = finite("run_for", seconds)
        if seconds < 0:
            raise ValueError(f"run_for takes 0 seconds or more, got {seconds:g}.")
        passed, _ = await self._until(lambda: False, "run_for", seconds, _SLICE_S)
        return passed

    async def wait_until(self, predicate: Callable[[], object], timeout: float) -> float:
        """See `URLabClient.wait_until`."""

        if not callable(predicate):
            raise TypeError(f"wait_until takes a function without arguments, got {predicate!r:.80}.")

        def holds() -> bool:
            answer = predicate()
            if inspect.isawaitable(answer):
                if inspect.iscoroutine(answer):
                    answer.close()  # avoids Python's warning that it was never awaited
                raise TypeError("wait_until takes a plain function, not a coroutine function.")
            return bool(answer)

        limit = _positive("wait_until: timeout", timeout)
        passed, held = await self._until(holds, "wait_until", limit, _CHECK_S)
        if not held:
            raise URLabTimeoutError(
                f"wait_until: the condition did not hold within {limit:g} s of simulation time.",
                hint=await self._findings(),
            )
        return passed

    async def move_to(
        self, articulation: URLabArticulation, targets: Mapping[str, float], tolerance: float, timeout: float
    ) -> float:
        """See `URLabArticulation.move_to`."""
        tolerance, limit = _positive("move_to: tolerance", tolerance), _positive("move_to: timeout", timeout)
        aims = [
            _Aim(articulation, name, target)
            for name, target in mapping("move_to", targets, "joint names to numbers").items()
        ]
        for aim in aims:
            aim.actuator.set_control(aim.set_point)
        passed, settled = await self._until(
            lambda: all(aim.settled(tolerance) for aim in aims), "move_to", limit, _CHECK_S
        )
        if not settled:
            left = {aim.joint.name: aim.left() for aim in aims if not aim.settled(tolerance)}
            joints = articulation.joints
            texts = [f"{name!r} is {abs(error):.3g} {joints[name].unit} away" for name, error in left.items()]
            raise NotSettled(
                f"move_to: {articulation.name!r} did not settle within {limit:g} s of simulation time: "
                f"{', '.join(texts)}.",
                remaining=left,
                hint=await self._findings() or self._still_moving(joints[name] for name in left),
            )
        return passed

    async def _until(self, done: Callable[[], bool], what: str, limit: float, slice_s: float) -> tuple[float, bool]:
        """Let time pass until `done` or the limit; return the seconds that passed, and the last result of `done`."""
        state = self._state
        live = state.mode.live
        if state.mode.current is StepMode.DIRECT:  # in puppet mode the state is the client's own
            await self._locate()
        if done():
            return 0.0, True
        start = last = state.clocks.sim_time
        restarts = self._session.restarts
        passed = 0.0
        steps = self._stepped_times(lambda: limit - passed, slice_s)
        async with aclosing(self._live_times(what) if live else steps) as times:
            async for now in times:
                self._check_restarts(what, restarts)
                if live:  # the client's own time may be stale: count from the first snapshot
                    start, live = now, False
                elif now < last:  # a reset sets the clock back, and what passed before counts too
                    start = now - passed
                last, passed = now, now - start
                if done():
                    return passed, True
                if passed >= limit:
                    break
        return passed, False

    async def _stepped_times(self, left: Callable[[], float], slice_s: float) -> AsyncGenerator[float, None]:
        state = self._state
        model = state.mirror.model
        timestep = 0.0 if model is None else float(model.opt.timestep)
        while left() > timestep / 2:
            before = state.clocks.sim_time
            n = max(1, round(min(left(), slice_s) / timestep)) if timestep else 1
            await self._step(n)
            timestep = timestep or max(0.0, state.clocks.sim_time - before)
            yield state.clocks.sim_time

    async def _live_times(self, what: str) -> AsyncGenerator[float, None]:
        loop = running_loop()
        if any(record.driven for record in self._state.objects.records.values()):  # set-points must be sent
            await self._step(1)
        newest, since, restarts = -1.0, loop.time(), self._session.restarts
        async with Stream(self._state.publishers.state(), policy="latest") as snapshots:
            while True:
                now = (await snapshots.receive(timeout=self._stall_timeout)).time
                self._check_restarts(what, restarts)  # a new server is paused: time stands still there
                if now != newest:
                    newest, since = now, loop.time()
                    yield now
                elif self._stall_timeout is not None and loop.time() - since > self._stall_timeout:
                    raise URLabTimeoutError(
                        f"{what}: simulation time has stood still at {now:.3f} s for {self._stall_timeout:g} s.",
                        hint=await self._findings(),
                    )

    def _check_restarts(self, what: str, before: int) -> None:
        if self._session.restarts != before:  # the session may already be one with the new server
            raise server_restarted(what, self._session.transport.endpoint)

    @staticmethod
    def _still_moving(joints: Iterable[Joint]) -> str | None:
        moving = [repr(joint.name) for joint in joints if abs(float(joint.velocity)) > _MOVING]
        return f"Still moving: {', '.join(moving)}. Allow a longer timeout." if moving else None

    async def _findings(self) -> str | None:
        """Return the problems that keep robots from moving, as found by `explain()`."""
        found = (await self._explain()).findings
        return " ".join(f"{one.subject}: {one.text}" for one in found if one.verdict is Verdict.PROBLEM) or None


class _Aim:
    """One joint on its way to its target."""

    def __init__(self, articulation: URLabArticulation, name: str, target: float) -> None:
        driven = None if name in articulation.joints else articulation.actuators.get(name)
        if driven is not None and driven.joint is not None:
            raise KeyError(f"move_to takes joints; {name!r} is an actuator, which moves the joint {driven.joint!r}.")
        joint = articulation.joints[name]
        what = f"move_to: joint {joint.name!r} of {articulation.name!r}"
        self.target = finite(what, target)
        if not isinstance(joint, ScalarJoint):
            message = f"{what} is a {joint.kind} joint; its position is not one number. Nothing was set."
            raise ValueError(message)  # noqa: TRY004  # a joint of the wrong kind, not an argument of the wrong type
        self.joint = joint
        low, high = joint.limits or (self.target, self.target)
        if not low <= self.target <= high:
            raise ValueError(f"{what} takes {low:g} to {high:g} {joint.unit}, got {self.target:g}. Nothing was set.")
        driving = [actuator for actuator in articulation.actuators.values() if actuator.joint == joint.name]
        servos = [actuator for actuator in driving if actuator.describe().takes == "position"]
        if not servos:
            takes = [f"{actuator.name!r} takes {actuator.describe().takes or 'something else'}" for actuator in driving]
            raise ValueError(f"{what} has no position servo: {', '.join(takes) or 'nothing drives it'}.")
        self.actuator = servos[0]
        self.set_point = self.actuator.set_point_for(self.target)
        self.actuator.checked(self.set_point, OutOfRange.ERROR)

    def left(self) -> float:
        return self.target - self.joint.position

    def settled(self, tolerance: float) -> bool:
        return abs(self.left()) <= tolerance and abs(self.joint.velocity) * _AT_REST_S <= tolerance


def _positive(what: str, value: float) -> float:
    number = finite(what, value)
    if number <= 0:
        raise ValueError(f"{what} takes a number above 0, got {number:g}.")
    return number
