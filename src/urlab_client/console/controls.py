"""Viewers' control of the simulation: ops, set-points, steps. Changes require the lease."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import anyio
import msgspec
import numpy as np
from msgspec import Struct, structs

from urlab_client.aio.controllers import URLabPDController
from urlab_client.console.description import home_of
from urlab_client.console.lease import DrivingLease, Viewer
from urlab_client.console.messages import encode, rounded
from urlab_client.console.pictures import Cameras
from urlab_client.console.shared_view import SharedView
from urlab_client.enums import StepMode
from urlab_client.errors import URLabError
from urlab_client.protocol.base import Effect, Op, Request
from urlab_client.protocol.codec import from_wire_array, op_of
from urlab_client.protocol.messages.cameras import (
    SetCameraDelay,
    SetCameraDelayOk,
    SetCameraStreaming,
    SetCameraStreamingOk,
)
from urlab_client.protocol.messages.runtime import (
    ConfigureController,
    ConfigureControllerOk,
    SetControlSource,
    SetMode,
    SetModeOk,
    SetPaused,
    SetSimOptions,
    SetSimOptionsOk,
    SetSimSpeed,
    SetTwist,
)
from urlab_client.protocol.messages.session import (
    ArticulationCommand,
    ArticulationState,
    Forward,
    Hello,
    Reset,
    ResetOk,
    Step,
)
from urlab_client.protocol.messages.sim import BeginPie, BeginPieOk, StopPie, StopPieOk
from urlab_client.protocol.registry import OPS

if TYPE_CHECKING:
    import mujoco

    from urlab_client.aio import Actuator, URLabArticulation, URLabClient

SERVED: dict[str, Op] = {name: op for name, op in OPS.items() if op.request is not Hello}
"""The ops that viewers may perform, by name; the console itself holds the session."""

_PERIOD_S = 1 / 60
_MOST_STEPS = 200  # in one request, so that a viewer can stop them
_NOTICEABLE = 0.01  # difference of set-points that nobody takes for a rounding
_FREQUENCY, _DAMPING = 40.0, 0.4
"""Frequency in rad/s and damping ratio of a joint that holds its pose."""


def parse(op: Op, body: bytes) -> Request[Any]:
    """Decode a request from JSON."""
    try:
        request = msgspec.json.decode(body or b"{}", type=op.request, dec_hook=from_wire_array)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{op.name}: {error}") from None
    request.session_id = ""
    return request


class SteppedTo(Struct):
    """Simulation time in seconds, and number of physics steps, after a step."""

    time: float
    step: int


class Controls:
    """The controls of one console, and settings that the server does not report.

    Attributes:
        running: Whether direct mode is stepped in real time.
        speed: Pacing of live mode, percent, if a viewer has set it.
        source: The control source, if a viewer has chosen it.
        twists: Commanded velocities by articulation: x, y, yaw.
        holding: The robots that hold their home pose, until set-points come for them.
        chosen_mode: The step mode that a viewer has chosen last.
    """

    def __init__(
        self,
        client: URLabClient,
        lease: DrivingLease,
        view: SharedView,
        cameras: Cameras,
        before_step: Callable[[], None],
    ) -> None:
        self.running: bool = False
        self._suspended = False
        self.speed: float | None = None
        self.source: str | None = None
        self.twists: dict[str, tuple[float, float, float]] = {}
        self.holding: dict[str, _PoseHold] = {}
        self.chosen_mode: StepMode | None = None
        self._client = client
        self._lease = lease
        self._view = view
        self._cameras = cameras
        self._before_step = before_step
        self._wake_runner = asyncio.Event()
        self._seeded: dict[str, list[float]] = {}  # with which set-points a robot was kept as it was
        self._driven: set[str] = set()  # by viewers
        self._session = ""  # in which all of this was
        self._pending: set[str] = set()
        self._commanded = asyncio.Event()
        self._pictures_due = 0.0
        self._halted = False  # by a viewer, since a number of steps began

    def begin_anew(self, *, ended: bool = False) -> None:
        """Discard the set-points of an earlier session or play session, which would drive the robots of the next.

        Another controller may take them for something else: torques for angles. A robot that was held is held on, if
        it still can be.

        Args:
            ended: Whether play has ended.
        """
        self._suspended = False
        if not ended and self._session == self._client.session_id:
            return  # set-points may have come for it already
        self._session = self._client.session_id
        held, robots = [*self.holding], self._client.articulations
        for key in {*self._seeded, *held}:
            if key in robots and self._wrote(key, robots[key]):
                self._forget(key)
        self._driven.clear()
        self._pending.clear()
        self._seeded.clear()
        self.twists.clear()
        self.holding.clear()
        if not ended and self._client.step_mode is StepMode.DIRECT:
            for key in held:
                with contextlib.suppress(KeyError, ValueError):
                    self.holding[key] = _PoseHold(self._client.model, robots[key])

    def _wrote(self, key: str, art: URLabArticulation) -> bool:
        """Return whether the set-points of a robot are the console's, not those of the program around it."""
        return key in self._driven or key in self.holding or self._seeded.get(key) == art.ctrl_array.tolist()

    def commands(self, key: str) -> bool:
        """Return whether a viewer has commanded this articulation since play began."""
        return key in self._seeded

    async def do(self, viewer: Viewer, request: Request[Any]) -> object:
        """Perform an op for a viewer."""
        op = op_of(request)
        if isinstance(request, StopPie):
            self.running = False  # before a step meets no simulation
        if isinstance(request, SetPaused) and request.paused:
            self._lease.interrupt(viewer)  # any viewer may stop
        elif op.effect is not Effect.READ:
            self._lease.use(viewer)
        began = time.perf_counter()
        try:
            reply = await _perform(self._client, request)
        except (URLabError, ValueError, TypeError, KeyError) as error:
            if op.effect is not Effect.READ:  # whoever reads is told; the page does so by itself, again and again
                self._view.note("error", viewer.name, op.name, str(error), 1e3 * (time.perf_counter() - began))
            raise
        if op.effect is not Effect.READ:
            given = {name: value for name, value in structs.asdict(request).items() if name != "session_id"}
            self._view.note("call", viewer.name, op.name, encode(given).decode(), 1e3 * (time.perf_counter() - began))
        self._follow(viewer, request, reply)
        return reply

    def _follow(self, viewer: Viewer, request: Request[Any], reply: Any) -> None:
        """Remember settings that the server does not report."""
        match request:
            case SetSimSpeed():
                self.speed = reply.percent
            case SetControlSource(articulation=None):
                self.source = reply.source
            case SetTwist():
                self.twists[request.articulation] = (reply.linear[0], reply.linear[1], reply.angular[2])
            case SetMode():
                self.chosen_mode = StepMode(reply.current_mode)
                for key in [*self.holding] if self.chosen_mode is not StepMode.DIRECT else ():
                    self._let_go(viewer, key)
            case Reset():
                self._start_again(reply)
            case ConfigureController():
                self._view.describe_world()
            case _:
                pass

    def _start_again(self, reply: ResetOk) -> None:
        """After a reset, command the pose and the forces of its start, as MuJoCo does, and no earlier set-points."""
        for key, start in reply.per_articulation.items():
            art = self._client.articulations.get(key)
            if art is None or key in self.holding:
                continue
            # What a controller makes of the set-points from before may be in the state: it is to keep the pose instead.
            start = start if art.controller is None else structs.replace(start, ctrl=None)  # noqa: PLW2901
            if not self._wrote(key, art) and not self._inherited(key, art, start):
                continue
            self._forget(key)
            _keep(art, start)
            self._seeded[key] = art.ctrl_array.tolist()
            self._pending.add(key)
            self._commanded.set()

    def _inherited(self, key: str, art: URLabArticulation, start: ArticulationState) -> bool:
        """Return whether the server would apply set-points of an earlier client again after a reset in live mode."""
        before = None if self._view.snapshot is None else self._view.snapshot.per_articulation.get(key)
        ours = art.control_owner is None and not art.ctrl_array.any()
        if self._client.step_mode is not StepMode.LIVE or before is None or not ours:
            return False
        applied, first = applied_set_points(art, before), applied_set_points(art, start)
        return applied is not None and first is not None and not np.allclose(applied, first, rtol=0.0, atol=_NOTICEABLE)

    def _forget(self, key: str) -> None:
        """Discard a robot's set-points."""
        self._driven.discard(key)
        self._pending.discard(key)
        if art := self._client.articulations.get(key):
            art.ctrl_array[:] = 0.0

    def set_points(self, viewer: Viewer, values: Mapping[str, Mapping[str, float]], *, noted: bool = True) -> None:
        """Set set-points by articulation and actuator, or none if a name is unknown.

        In live mode the newest are sent immediately. The log says once who sets which, while they follow one another.
        """
        robots = self._client.articulations
        found = [(robots.key(name), robots[name], given) for name, given in values.items()]
        for _, art, given in found:
            for name in given:
                art.actuators[name]  # raises
        self._lease.use(viewer)
        self.begin_anew()
        for key, art, given in found:
            self._let_go(viewer, key)
            self._seed(key, art)
            art.set_ctrl(given)
            self._driven.add(key)
            self._pending.add(key)
            if noted and given:
                self._view.note_burst(viewer.name, "set-points", key, given)
        self._commanded.set()

    async def hold(self, viewer: Viewer, name: str, holding: bool) -> None:
        """Make a robot with torque motors hold its home pose, or let it go.

        A law that balances a robot must not be late, so this needs direct mode, and chooses it.
        """
        key = self._client.articulations.key(name)
        self.begin_anew()
        if holding:
            hold = _PoseHold(self._client.model, self._client.articulations[key])
            if self._client.step_mode is not StepMode.DIRECT:
                await self.do(viewer, SetMode(mode=StepMode.DIRECT))
            self.holding[key] = hold
        else:
            self._let_go(viewer, key)

    def _let_go(self, viewer: Viewer, key: str) -> None:
        """End the torques that hold a robot's pose, if any do."""
        held = self.holding.pop(key, None)
        if held is not None:
            held.let_go()
            self._pending.add(key)
            self._commanded.set()
            self._view.note("call", viewer.name, "let go", key)

    def _seed(self, key: str, art: URLabArticulation) -> None:
        """Hold the current pose before a first set-point, which sends all set-points of the articulation."""
        if key in self._seeded:
            return
        state = None if self._view.snapshot is None else self._view.snapshot.per_articulation.get(key)
        free = not art.ctrl_array.any()  # of commands by the program around the console
        if free:
            _keep(art, state)
            if key in self.holding:
                self.holding[key].note_written()
        self._seeded[key] = art.ctrl_array.tolist() if free else []

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
                    self._view.note("error", "console", "set-points", str(error))

    async def step(self, viewer: Viewer, n_steps: int) -> SteppedTo:
        """Step in direct mode, with the set-points and pictures of the cameras that are watched."""
        if self._client.step_mode is not StepMode.DIRECT:
            raise ValueError(f"stepping needs direct mode, not {self._client.step_mode}")
        self._lease.use(viewer)
        self._pictures_due = 0.0
        self._halted = False
        self._view.note("call", viewer.name, "step", encode({"n_steps": n_steps}).decode())
        return await self._step(n_steps)

    async def _step(self, n_steps: int) -> SteppedTo:
        self.begin_anew()
        for key, art in self._client.articulations.items():
            self._seed(key, art)
        while True:
            self._before_step()
            self.holding = {key: hold for key, hold in self.holding.items() if hold.renew()}
            taken = min(n_steps, self._per_period if self.holding else _MOST_STEPS)
            began = time.monotonic()
            watched = dict.fromkeys(self._cameras.watched(), "latest") if began >= self._pictures_due else {}
            reply = await self._client.step(taken, include_cameras=watched or False)
            if watched:  # they take half of the time at most: drawing may be slower than physics
                self._pictures_due = 2 * time.monotonic() - began
            n_steps -= taken
            if not n_steps or self._halted:
                return SteppedTo(reply.time, reply.step)

    @property
    def _per_period(self) -> int:
        return max(1, round(_PERIOD_S / (self._view.world.timestep or _PERIOD_S)))

    async def run(self, viewer: Viewer, running: bool) -> None:
        """Run or stop physics in any mode; any viewer may stop it."""
        if running:
            self._lease.use(viewer)
        else:
            self._lease.interrupt(viewer)
        if running and self._client.step_mode not in (StepMode.LIVE, StepMode.DIRECT):
            raise ValueError(f"in mode {self._client.step_mode} no physics runs: choose live or direct")
        self._suspended = False
        self._halted = not running
        if self._client.step_mode is StepMode.LIVE:
            await self.do(viewer, SetPaused(paused=not running))
        else:
            self.running = running
            self._view.note("call", viewer.name, "run" if running else "stop", "")
            self._wake_runner.set()
        self._view.notify()

    def suspend(self) -> None:
        """Take no steps until `resume`."""
        self._suspended, self.running = self._suspended or self.running, False

    def resume(self) -> None:
        """Step again if steps were taken before `suspend`, and nobody has stopped or begun them since."""
        if self._suspended and self._client.step_mode is StepMode.DIRECT:
            self.running = True
            self._wake_runner.set()
            self._view.notify()
        self._suspended = False

    async def keep_stepping(self) -> None:
        """Step in real time in direct mode while `running`; missed steps are not made up for."""
        while True:
            if not self.running or self._client.step_mode is not StepMode.DIRECT:
                if self.running:  # until another mode was chosen
                    self.running = False
                    self._view.notify()
                self._wake_runner.clear()
                await self._wake_runner.wait()
                continue
            began = time.monotonic()
            stepped = False
            try:
                await self._step(self._per_period)
                stepped = True
            except (URLabError, ValueError, KeyError) as error:  # the program that mounts the console may write a NaN
                self._view.note("error", "console", "step", str(error))
            finally:
                self.running = self.running and stepped
            await anyio.sleep(max(0.0, began + _PERIOD_S - time.monotonic()))


def _keep(art: URLabArticulation, state: ArticulationState | None) -> None:
    """Set the set-points that keep a robot as it is."""
    values = None if state is None else applied_set_points(art, state)
    if values is not None:
        art.ctrl_array[:] = values


def applied_set_points(art: URLabArticulation, state: ArticulationState) -> list[float] | None:
    """Return the set-points that the server applies, one per control; None if its state does not say.

    A state has forces instead where a PD controller makes them; its law, with the gains, gives the set-points back.
    """
    pd = art.controller if isinstance(art.controller, URLabPDController) else None
    if state.ctrl is None and pd is None:
        return None
    values = np.zeros(len(art.ctrl_array)) if state.ctrl is None else np.array(state.ctrl, np.float64)
    if pd is not None:
        for actuator in art.actuators.values():
            kp = pd.kp.get(actuator.name)
            if actuator.joint is None or kp is None:
                continue
            joint, at = art.joints[actuator.joint], actuator.ctrl_local.start
            position, velocity = state.qpos[joint.qpos_local_offset], state.qvel[joint.qvel_local_offset]
            damping = pd.kv.get(actuator.name, 0.0) * velocity
            values[at] = position + ((values[at] + damping) / kp if kp else 0.0)
    return rounded(values)


class _PoseHold:
    """Torques with which the motors of a robot hold its home pose, until somebody else writes set-points of them."""

    def __init__(self, model: mujoco.MjModel | None, art: URLabArticulation) -> None:
        motors = [one for one in art.actuators.values() if _turns(model, art, one)]
        if model is None or not motors:
            need = "that needs torque motors on hinge or slide joints, and a local model"
            raise ValueError(f"{art.prefix} cannot hold a pose: {need}")
        joints = [art.joints[one.joint or ""] for one in motors]
        driving, driven = [one.id for one in motors], [one.id for one in joints]
        self._art = art
        self._ctrl, self._qpos = [one.ctrl_local.start for one in motors], [one.qpos_local_offset for one in joints]
        self._qvel = [one.qvel_local_offset for one in joints]
        self._home = home_of(model, art)[model.jnt_qposadr[driven]]
        strength = model.actuator_gainprm[driving, 0] * model.actuator_gear[driving, 0]
        self._per_acceleration = model.dof_M0[model.jnt_dofadr[driven]] / strength
        self.note_written()

    def note_written(self) -> None:
        """Take the set-points of the motors for those of the hold."""
        self._written = self._art.ctrl_array[self._ctrl]

    def renew(self) -> bool:
        """Write the set-points of the next period, unless somebody else has; return whether they are written."""
        ctrl = self._art.ctrl_array
        if (ctrl[self._ctrl] != self._written).any():
            self.let_go()
            return False
        error, velocity = self._home - self._art.qpos_array[self._qpos], self._art.qvel_array[self._qvel]
        acceleration = _FREQUENCY**2 * error - 2 * _DAMPING * _FREQUENCY * velocity
        ctrl[self._ctrl] = self._per_acceleration * acceleration  # physics clamps it
        self.note_written()
        return True

    def let_go(self) -> None:
        """End the torques, except those that somebody else has written since."""
        ctrl = self._art.ctrl_array
        ctrl[self._ctrl] = np.where(ctrl[self._ctrl] == self._written, 0.0, ctrl[self._ctrl])


def _turns(model: mujoco.MjModel | None, art: URLabArticulation, actuator: Actuator) -> bool:
    """Return whether an actuator's set-point is a force on one coordinate, larger than zero."""
    if model is None or actuator.joint is None or actuator.describe().takes != "force":
        return False
    gain, gear = model.actuator_gainprm[actuator.id, 0], model.actuator_gear[actuator.id, 0]
    return bool(gain and gear) and art.joints[actuator.joint].kind in ("hinge", "slide")


async def _perform(client: URLabClient, request: Request[Any]) -> object:
    """Send a request, through the client's own method if that also updates state from the reply."""
    reply: object
    match request:
        case SetMode(mode=mode):
            previous = client.step_mode
            reply = SetModeOk(previous_mode=previous, current_mode=await client.runtime.set_mode(StepMode(mode)))
        case SetCameraStreaming(cameras=wanted):
            reply = SetCameraStreamingOk(cameras=await client.runtime.set_camera_streaming(wanted))
        case SetCameraDelay(cameras=delays):
            reply = SetCameraDelayOk(cameras=await client.runtime.set_camera_delay(delays))
        case BeginPie(level_path=level, timeout_s=limit):
            result = await client.sim.start(level, timeout_s=limit, raise_on_failure=False)
            reply = BeginPieOk(state=result.state, compile_error=result.compile_error)
        case StopPie():
            await client.sim.stop()
            reply = StopPieOk()
        case ConfigureController(articulation=key, params=params) if (art := client.articulations.get(key)) and (
            controller := art.controller
        ):
            reply = ConfigureControllerOk(articulation=key, params=await controller.configure(**params))
        case SetSimOptions(options=options):
            given = msgspec.to_builtins(options)
            reply = SetSimOptionsOk(options=await client.runtime.set_sim_options(**given))
        case Reset(keyframe_name=name, seed=seed, per_articulation_qpos=overrides):
            reply = await client.reset(name, seed, overrides)
        case Forward():
            reply = await client.runtime.forward()
        case _:
            reply = await client.call(request)
    return reply
