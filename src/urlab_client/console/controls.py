"""Viewers' control of the simulation: ops, set-points, steps. Changes require the lease."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import anyio
import numpy as np
from msgspec import structs

from urlab_client.console.description import WorldDescription
from urlab_client.console.lease import DrivingLease, Viewer
from urlab_client.console.ops import encode, perform
from urlab_client.enums import StepMode
from urlab_client.errors import URLabError
from urlab_client.protocol.base import Effect, Request
from urlab_client.protocol.codec import op_of
from urlab_client.protocol.messages.runtime import SetControlSource, SetPaused, SetSimSpeed, SetTwist
from urlab_client.protocol.messages.session import ArticulationCommand, Step
from urlab_client.protocol.messages.streams import (
    StateSnapshot,
)

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabClient

_PERIOD_S = 1 / 60


class Console(Protocol):
    """The part of the console session that the controls use."""

    client: URLabClient
    lease: DrivingLease
    snapshot: StateSnapshot | None
    world: WorldDescription

    def note(self, kind: str, who: str, what: str, text: str, ms: float | None = None) -> None:
        """Add a line to the log."""
        ...

    def tell(self) -> None:
        """Notify all viewers of a change."""
        ...

    def redescribe(self) -> None:
        """Describe the world again."""
        ...

    def watched_cameras(self) -> list[str]:
        """Return the cameras that viewers watch."""
        ...


class Controls:
    """The controls of one console, and settings that the server does not report.

    Attributes:
        running: Whether direct mode is stepped in real time.
        speed: Pacing of live mode, percent, if a viewer has set it.
        source: The control source, if a viewer has chosen it.
        twists: Commanded velocities by articulation: x, y, yaw.
        before_step: Callback invoked before each step that the console makes in direct mode.
    """

    def __init__(self, console: Console) -> None:
        self.running: bool = False
        self.speed: float | None = None
        self.source: str | None = None
        self.twists: dict[str, tuple[float, float, float]] = {}
        self.before_step: Callable[[], None] = lambda: None
        self._console = console
        self._client = console.client
        self._lease = console.lease
        self._wake_runner = asyncio.Event()
        self._seeded: set[str] = set()
        self._pending: set[str] = set()
        self._commanded = asyncio.Event()

    def begin_anew(self) -> None:
        """Discard the state of the previous play session."""
        self._seeded.clear()
        self.twists.clear()

    def commands(self, key: str) -> bool:
        """Return whether a viewer has commanded this articulation since play began."""
        return key in self._seeded

    async def do(self, viewer: Viewer, request: Request[Any]) -> object:
        """Perform an op for a viewer.

        Raises:
            NotDriving: The op changes something, and another viewer has the controls.
            URLabError: As the client raises.
        """
        op = op_of(request)
        if isinstance(request, SetPaused) and request.paused:
            self._lease.interrupt(viewer)  # any viewer may stop
        elif op.effect is not Effect.READ:
            self._lease.use(viewer)
        began = time.perf_counter()
        try:
            reply = await perform(self._client, request)
        except (URLabError, ValueError, TypeError, KeyError) as error:
            self._console.note("error", viewer.name, op.name, str(error), 1e3 * (time.perf_counter() - began))
            raise
        if op.effect is not Effect.READ:
            arguments = encode(structs.asdict(request)).decode()
            self._console.note("call", viewer.name, op.name, arguments, 1e3 * (time.perf_counter() - began))
        self._follow(request, reply)
        return reply

    def _follow(self, request: Request[Any], reply: Any) -> None:
        """Remember settings that the server does not report."""
        match request:
            case SetSimSpeed():
                self.speed = reply.percent
            case SetControlSource(articulation=None):
                self.source = reply.source
            case SetTwist():
                self.twists[request.articulation] = (reply.linear[0], reply.linear[1], reply.angular[2])
            case _:
                pass
        if op_of(request).name == "configure_controller":
            self._console.redescribe()

    def set_points(self, viewer: Viewer, values: Mapping[str, Mapping[str, float]]) -> None:
        """Set set-points by articulation and actuator. In live mode the newest are sent immediately.

        Raises:
            NotDriving: Another viewer has the controls.
            KeyError: An articulation or actuator is unknown; nothing was set.
            ValueError: A value is not a finite number; nothing was set.
        """
        found = {key: (self._client.articulations[key], given) for key, given in values.items()}
        for art, given in found.values():
            for name, value in given.items():
                art.actuators[name]  # raises
                if not np.isfinite(value):
                    raise ValueError(f"{name}: {value} is not a set-point")
        self._lease.use(viewer)
        for key, (art, given) in found.items():
            self._seed(key, art)
            art.set_ctrl(given)
            self._pending.add(key)
        self._commanded.set()

    def _seed(self, key: str, art: URLabArticulation) -> None:
        """Hold the current pose before a first set-point, which sends all set-points of the articulation."""
        if key in self._seeded:
            return
        self._seeded.add(key)
        if self._console.snapshot is None or key not in self._console.snapshot.per_articulation or art.ctrl_array.any():
            return
        state = self._console.snapshot.per_articulation[key]
        for actuator in art.actuators.values():
            at = actuator.ctrl_local
            if art.controller is not None and actuator.joint is not None:
                actuator.set_control(float(state.qpos[art.joints[actuator.joint].qpos_local_offset]))
            elif state.ctrl is not None:
                art.ctrl_array[at] = state.ctrl[at]

    async def send_set_points(self) -> None:
        """Send set-points in live mode, one request at a time."""
        while True:
            await self._commanded.wait()
            self._commanded.clear()
            keys, self._pending = self._pending, set()
            if self._client.step_mode is not StepMode.LIVE:
                continue  # the next step takes them along
            commands = {
                key: ArticulationCommand(ctrl=self._client.articulations[key].ctrl_array.tolist())
                for key in keys
                if key in self._client.articulations
            }
            try:
                await self._client.call(Step(n_steps=0, per_articulation=commands))  # refused by the client if it steps
            except (URLabError, ValueError) as error:
                if self._client.step_mode is StepMode.LIVE:  # otherwise the next step takes them along
                    self._console.note("error", "console", "set-points", str(error))

    async def step(self, viewer: Viewer, n_steps: int) -> dict[str, Any]:
        """Step in direct mode, with the set-points and pictures of the cameras that are watched.

        Raises:
            NotDriving: Somebody else has the controls.
            ValueError: The mode is another one.
        """
        if self._client.step_mode is not StepMode.DIRECT:
            raise ValueError(f"stepping needs direct mode, not {self._client.step_mode}")
        self._lease.use(viewer)
        return await self._step(n_steps)

    async def _step(self, n_steps: int) -> dict[str, Any]:
        for key, art in self._client.articulations.items():
            self._seed(key, art)
        self.before_step()
        watched = dict.fromkeys(self._console.watched_cameras(), "latest")
        reply = await self._client.step(n_steps, include_cameras=watched or False)
        return {"time": reply.time, "step": reply.step}

    async def run(self, viewer: Viewer, running: bool) -> None:
        """Run or stop physics in any mode; any viewer may stop it.

        Raises:
            NotDriving: It was to run, and somebody else has the controls.
        """
        if running:
            self._lease.use(viewer)
        else:
            self._lease.interrupt(viewer)
        if self._client.step_mode is StepMode.LIVE:
            await self.do(viewer, SetPaused(paused=not running))
        else:
            self.running = running
            self._console.note("call", viewer.name, "run" if running else "stop", "")
            self._wake_runner.set()
        self._console.tell()

    async def keep_stepping(self) -> None:
        """Step in real time in direct mode while `running`; missed steps are not made up for."""
        while True:
            if not self.running or self._client.step_mode is not StepMode.DIRECT:
                self._wake_runner.clear()
                await self._wake_runner.wait()
                continue
            began = time.monotonic()
            stepped = False
            try:
                await self._step(max(1, round(_PERIOD_S / (self._console.world.timestep or _PERIOD_S))))
                stepped = True
            except (URLabError, ValueError, KeyError) as error:  # the program that mounts the console may write a NaN
                self._console.note("error", "console", "step", str(error))
            finally:
                self.running = self.running and stepped
            await anyio.sleep(max(0.0, began + _PERIOD_S - time.monotonic()))
