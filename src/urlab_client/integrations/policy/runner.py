"""Runs a policy on a client: checks that it fits, then acts, steps and counts."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Final

import numpy as np
from msgspec import Struct

from urlab_client.aio.articulation import URLabArticulation
from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.aio.defaults import DEFAULT
from urlab_client.enums import ActuatorType, ControllerKind, ControlMode, StepMode
from urlab_client.errors import URLabError
from urlab_client.integrations._flavours import blocking
from urlab_client.integrations.policy.mapping import PolicyMapping, PolicyMismatch, RobotState
from urlab_client.integrations.policy.policy import Policy
from urlab_client.protocol.base import Floats
from urlab_client.values.plain import Serializable

_STANDSTILL_S: Final = 5.0
_SMOOTHING_S: Final = 0.5
_TIMESTEP_TOLERANCE: Final = 1e-9

OnAction = Callable[["PolicyRun"], None]
"""Callback invoked after each action with the run so far."""


class PolicyRun(Serializable, Struct):
    """The result of running a policy.

    Attributes:
        articulation: Key of the robot.
        step_mode: Step mode of the session.
        actions: Number of actions.
        steps: Number of physics steps; 0 in live mode, where they are not counted.
        sim_time: Simulated time, seconds.
        wall_time: Wall time, seconds.
        falls: Number of falls, each followed by a reset.
        upright_time: Simulated time until the first fall, seconds, or `sim_time`.
        distance: Distance covered by the base, metres, as the sum of straight lines between resets.
        forward: Part of `distance` along the heading at each start, metres.
        velocity_error: Root mean square of commanded minus actual horizontal velocity, m/s, base frame, smoothed over
            half a second.
        reward: Mean reward per action.
        goal_error: Distance of a sensor from the goal at the end, in the sensor's unit; None if no sensor measures it.
        late: Number of actions that were more than one period late, in live mode.
    """

    articulation: str
    step_mode: StepMode
    actions: int = 0
    steps: int = 0
    sim_time: float = 0.0
    wall_time: float = 0.0
    falls: int = 0
    upright_time: float = 0.0
    distance: float = 0.0
    forward: float = 0.0
    velocity_error: float = 0.0
    reward: float = 0.0
    goal_error: float | None = None
    late: int = 0

    @property
    def steps_per_second(self) -> float:
        """Physics steps per second of wall time."""
        return self.steps / self.wall_time if self.wall_time else 0.0


def require(client: AsyncClient, policy: Policy, articulation: str | None = None) -> URLabArticulation:
    """Check that a policy can control its robot through a client in its current state, and return the robot.

    Args:
        client: A discovered client.
        policy: The policy.
        articulation: Key, actor id or class name of the robot, instead of the declared one.

    Raises:
        PolicyMismatch: The policy cannot control the robot. The message names what was found, what is required, and
            how to change it.
        PolicyFileError: The sizes of the network differ from the declaration.
    """
    spec, source = policy.spec, policy.source
    if client.model is None or not client.articulations:
        raise PolicyMismatch(
            f"{source}: the client has discovered no articulation to act on.",
            hint="Start play, then call discover() with local_model=True.",
        )
    name = articulation or spec.robot
    robot = client.articulations.get(name)
    if robot is None:
        raise PolicyMismatch(
            f"{source}: robot: no articulation is called {name!r}; the articulations are: "
            f"{', '.join(client.articulations)}.",
            hint="Name one of them, by its key, actor id or class name.",
        )
    if client.step_mode not in spec.step_modes:
        wanted = " or ".join(map(repr, map(str, spec.step_modes)))
        raise PolicyMismatch(
            f"{source}: the session steps in {str(client.step_mode)!r} mode; step_modes requires {wanted}.",
            hint=f"Make the client with step_mode={str(spec.step_modes[0])!r}. If the server pins its mode, change "
            "the mode there.",
        )
    timestep = float(client.model.opt.timestep)
    if abs(timestep - spec.timestep) > _TIMESTEP_TOLERANCE:
        raise PolicyMismatch(
            f"{source}: physics has a timestep of {timestep:g} s; timestep requires {spec.timestep:g} s.",
            hint=f"Call client.runtime.set_sim_options(timestep={spec.timestep:g}).",
        )
    mapping = policy.bind(robot)
    _require_control(robot, mapping, source)
    return robot


def _require_control(robot: URLabArticulation, mapping: PolicyMapping, source: str) -> None:
    """Check that set-points have the meaning that the declaration requires."""
    action, key, controller = mapping.spec.action, robot.prefix, robot.controller
    active = controller is not None and robot.control_mode is not ControlMode.RAW
    if action.via == "controller":
        if controller is None or controller.kind != ControllerKind.PD:
            actual = "no controller" if controller is None else f"a {controller.kind} controller"
            raise PolicyMismatch(
                f"{source}: {key!r} has {actual}; action.via = 'controller' requires a PD controller.",
                hint=f"Serve it with --controller {robot.actor_id or key}=pd, or add one in the editor.",
            )
        if not active:
            raise PolicyMismatch(
                f"{source}: the controller of {key!r} is bypassed; action.via = 'controller' requires it.",
                hint="Set articulation.control_mode = 'ue_controller'.",
            )
        bound = controller.params.get("kp", {})
        if missing := [actuator.name for actuator in mapping.actuators if actuator.name not in bound]:
            raise PolicyMismatch(f"{source}: the controller of {key!r} does not drive {', '.join(missing)}.")
    elif active:
        raise PolicyMismatch(
            f"{source}: {key!r} has an active controller; action.via = {action.via!r} requires that set-points reach "
            "the actuators unchanged.",
            hint="In direct mode, set articulation.control_mode = 'raw'. Or serve the robot without a controller.",
        )
    servo = action.kind == "joint_position" and action.via == "actuators"
    required = ActuatorType.POSITION if servo else ActuatorType.MOTOR
    if other := [actuator for actuator in mapping.actuators if actuator.type not in (None, required)]:
        raise PolicyMismatch(
            f"{source}: actuator {other[0].name!r} of {key!r} is a {other[0].type}; action.kind = {action.kind!r} via "
            f"{action.via!r} requires a {required}.",
            hint="Change action.kind or action.via to match the robot.",
        )


async def run(
    client: AsyncClient,
    policy: Policy,
    *,
    articulation: str | None = None,
    seconds: float = 10.0,
    seed: int | None = None,
    until_fall: bool = False,
    on_action: OnAction | None = None,
) -> PolicyRun:
    """Run a policy on its robot for some simulated seconds.

    The run starts with a reset, and resets after each fall. In direct mode, physics advances by `decimation` steps per
    action. In live mode, the run unpauses physics, which advances on its own, and sends one action per period of the
    simulation clock. A PD controller uses the declared gains during the run; afterwards its own gains are restored.

    Args:
        client: A discovered client.
        policy: The policy.
        articulation: Key, actor id or class name of the robot, instead of the declared one.
        seconds: Duration, simulated seconds.
        seed: Seed of the first reset, which determines what the server varies.
        until_fall: Whether to end the run at the first fall.
        on_action: Callback invoked with the run so far after each action.

    Raises:
        PolicyMismatch: The policy cannot control this robot in this session. Nothing was moved.
        URLabError: The server refused a request, or in live mode physics is paused, or somebody else resets it.
    """
    robot = require(client, policy, articulation)
    wanted = before = dict[str, dict[str, float]]()
    controller = robot.controller if policy.spec.action.via == "controller" else None
    if controller is not None:
        wanted = policy.bind(robot).gains()
        before = {name: {key: controller.params[name][key] for key in wanted[name]} for name in wanted}
    try:
        if controller is not None:
            await controller.configure(timeout=DEFAULT, **wanted)
        return await _PolicyLoop(client, robot, policy, on_action).until(seconds, seed, until_fall=until_fall)
    finally:
        if controller is not None and client.connected:
            with contextlib.suppress(URLabError):  # best effort: play may have ended
                await controller.configure(timeout=DEFAULT, **before)


run_blocking = blocking(run)
"""Run a policy like `run`, with a blocking client."""


class _PolicyLoop:
    """One run of a policy and its statistics."""

    def __init__(
        self, client: AsyncClient, robot: URLabArticulation, policy: Policy, on_action: OnAction | None
    ) -> None:
        self._client = client
        self._robot = robot
        self._policy = policy
        self._mapping = policy.bind(robot)
        self._on_action = on_action
        self._live = client.step_mode is StepMode.LIVE
        self._cameras = [f"{robot.prefix}/{term.camera}" for term in policy.spec.pictures]
        self._look = dict.fromkeys(self._cameras, "latest" if self._live else "sync") or False
        self._result = PolicyRun(articulation=robot.prefix, step_mode=client.step_mode)
        self._rewards = 0.0
        self._squared_error = 0.0
        self._velocity: Floats = np.zeros(2)  # commanded minus actual, smoothed
        self._start: Floats = np.zeros(3)
        self._heading: Floats = np.array([1.0, 0.0])
        self._travelled = (0.0, 0.0)

    async def until(self, seconds: float, seed: int | None, *, until_fall: bool) -> PolicyRun:
        loop = asyncio.get_running_loop()
        client, result, period = self._client, self._result, self._policy.spec.period
        await self._restart(seed)
        if self._live:
            await client.runtime.set_paused(False)
        started = loop.time()
        while not result.actions or result.sim_time < seconds - period / 2:
            last_action = self._policy.action
            if self._live:
                await self._live_action()
            else:
                await self._direct_action()
            self._count(last_action, loop.time() - started)
            if self._on_action is not None:
                self._on_action(result)
            if self._mapping.fallen(RobotState.of(self._robot)):
                result.falls += 1
                if until_fall:
                    break
                await self._restart()
        return result

    async def _restart(self, seed: int | None = None) -> None:
        self._travelled = (self._result.distance, self._result.forward)
        await self._client.reset(self._policy.spec.keyframe, seed)
        if self._cameras:
            await self._client.capture(self._cameras)
        self._policy.reset()
        self._velocity = np.zeros(2)
        self._last_time = self._began = self._client.sim_time
        self._due = self._began
        if self._robot.has_free_base:
            self._start = self._robot.qpos_array[:3].copy()
            w, x, y, z = self._robot.qpos_array[3:7]
            self._heading = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)])

    async def _direct_action(self) -> None:
        client, policy, spec = self._client, self._policy, self._policy.spec
        policy.act(self._robot)
        if spec.action.via != "client":
            await client.step(spec.decimation, include_cameras=self._look)
        else:
            for _ in range(spec.decimation - 1):
                await client.step()
                policy.hold(self._robot)
            await client.step(include_cameras=self._look)
        self._require_pictures()
        self._result.steps += spec.decimation

    async def _live_action(self) -> None:
        """Send an action, and wait until the simulation clock has advanced by one period."""
        client, period = self._client, self._policy.spec.period
        loop = asyncio.get_running_loop()
        self._policy.act(self._robot, client.sim_time - self._began)
        await client.step()  # sends the set-points and reads the state
        self._due += period
        seen, deadline = client.sim_time, loop.time() + _STANDSTILL_S
        while (missing := self._due - client.sim_time) > 0:
            if client.sim_time < self._last_time:
                raise URLabError(
                    f"The simulation clock went back from {self._last_time:.2f} s to {client.sim_time:.2f} s: somebody "
                    "else reset the simulation.",
                    hint="Run the policy again.",
                )
            if client.sim_time > seen:
                seen, deadline = client.sim_time, loop.time() + _STANDSTILL_S
            elif loop.time() > deadline:
                raise URLabError(
                    f"Physics stands still at {client.sim_time:.2f} s.",
                    hint="If it is paused, call client.runtime.set_paused(False). Otherwise run `urlab doctor`.",
                )
            await asyncio.sleep(missing)
            await client.step(include_cameras=self._look)
        if missing < -period:
            self._result.late += 1
            self._due = client.sim_time

    def _require_pictures(self) -> None:
        """Raise an error if a picture is from an earlier state."""
        for term in self._policy.spec.pictures:
            if not self._robot.cameras[term.camera].delivered:
                raise URLabError(
                    f"The server sent no picture of camera {term.camera!r} of {self._robot.prefix!r}.",
                    hint="Run `urlab doctor` to check whether the server can draw.",
                )

    def _count(self, last_action: Floats, wall_time: float) -> None:
        result, policy, state = self._result, self._policy, RobotState.of(self._robot)
        elapsed = self._client.sim_time - self._last_time
        self._last_time = self._client.sim_time
        result.actions += 1
        result.wall_time = wall_time
        result.sim_time += elapsed
        if not result.falls:
            result.upright_time = result.sim_time
        self._rewards += float(self._mapping.reward(state, policy.command, policy.action, last_action))
        result.reward = self._rewards / result.actions
        left = self._mapping.goal_error(state, policy.goal)
        result.goal_error = None if left is None else float(left)
        if self._robot.has_free_base:
            way = state.qpos[:2] - self._start[:2]
            result.distance = self._travelled[0] + float(np.hypot(*way))
            result.forward = self._travelled[1] + float(way @ self._heading)
            error = policy.command[:2] - state.linear_velocity[:2]
            # Walking makes the base sway; smoothing leaves the mean velocity.
            self._velocity += min(1.0, elapsed / _SMOOTHING_S) * (error - self._velocity)
            self._squared_error += float(self._velocity @ self._velocity)
            result.velocity_error = (self._squared_error / result.actions) ** 0.5
