"""Tools that move robots."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from urlab_client.enums import StepMode
from urlab_client.mcp.call import Call
from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.looking import Robot
from urlab_client.mcp.results import Done, Recorded

__all__: list[str] = []

Positive = Annotated[float, Meta(gt=0)]
Targets = Annotated[dict[str, float], Meta(min_length=1)]

_RECORDED_S = 0.02


@tool(Needs.DRIVE)
async def run(call: Call, seconds: Positive | None = None, steps: Annotated[int, Meta(ge=1)] | None = None) -> Done:
    """Let simulation time pass: step in mode `direct`, watch in mode `live`. Give `seconds` or `steps`.

    Args:
        seconds: Simulation time, seconds; one physics step at least.
        steps: Physics steps, instead of `seconds`; in mode `direct` only.
    """
    model, live = call.client.model, call.client.step_mode is StepMode.LIVE
    timestep = 0.0 if live or model is None else float(model.opt.timestep)
    if (seconds is None) == (steps is None):
        raise ValueError("run takes either `seconds` or `steps`.")
    if steps is not None and not timestep:
        raise ValueError("In this mode time passes automatically: give `seconds` instead of `steps`.")
    left = call.within(max(timestep, seconds or 0.0) if steps is None else steps * timestep)
    # A recording has a state for each reply.
    piece = left if call.console.recordings.running is None else max(_RECORDED_S, timestep)
    passed = 0.0
    while left - passed > max(timestep / 2, 1e-9):
        passed += await call.client.run_for(min(piece, left - passed))
    return Done(done="Time passed.", passed=passed)


@tool(Needs.DRIVE, idempotent=True)
async def move_to(
    call: Call, robot: Robot, joints: Targets, tolerance: Positive = 0.01, timeout: Positive = 5.0
) -> Done:
    """Move joints to positions and wait until they have settled.

    For joints with a position servo: `look` lists an actuator for it that takes `position`. Others are moved with
    `set_actuators` and `run`. Refuses positions beyond a joint's limits. Fails with the reason if a joint has not
    settled in time; it continues towards its target as more time passes.

    Args:
        joints: Joint name to position: rad or m.
        tolerance: Largest remaining distance: rad or m.
        timeout: Longest simulation time, seconds.
    """
    found = call.robot(robot)
    passed = await found.move_to(joints, tolerance=tolerance, timeout=call.within(timeout))
    reached = ", ".join(f"{name} {float(found.joints[name].position):.4g}" for name in joints)
    return Done(done=f"{found.name} has settled: {reached}.", passed=passed)


@tool(Needs.DRIVE, idempotent=True)
async def set_actuators(call: Call, robot: Robot, set_points: Targets) -> Done:
    """Set set-points of actuators; the others keep theirs. They take effect as time passes, so call `run` afterwards.

    Args:
        set_points: Actuator name to value, in the unit and within the limits that `look` shows.
    """
    found = call.robot(robot)
    found.set_ctrl(set_points, out_of_range="error")
    if call.client.step_mode is StepMode.LIVE:
        await call.client.step()  # sends them
    return Done(done=f"{found.name} has new set-points: {', '.join(set_points)}.")


@tool(Needs.DRIVE, destructive=True, idempotent=True)
async def reset(call: Call, keyframe: str | None = None, joints: dict[str, dict[str, float]] | None = None) -> Done:
    """Reset the simulation to its initial state. Set-points are kept. Also use it when the simulation has diverged.

    Args:
        keyframe: Keyframe to start from; default: the initial state.
        joints: Robot to joint to position, to start from: rad or m.
    """
    for name, positions in (joints or {}).items():
        for joint, position in positions.items():
            found = call.robot(name).joints[joint]
            low, high = found.limits or (-math.inf, math.inf)
            if not low <= position <= high:
                takes = f"{low:g} to {high:g} {found.unit}"
                raise ValueError(f"joint {joint!r} of {name!r} takes {takes}, got {position:g}. Nothing was reset.")
    await call.client.reset(keyframe, per_articulation_qpos=joints)
    return Done(done="The simulation was reset.")


@tool(Needs.DRIVE, play=False, destructive=True, idempotent=True)
async def play(call: Call, action: Literal["start", "stop", "pause", "resume"]) -> Done:
    """Start or stop the play session, without which there are no robots; pause or resume time in mode `live`.

    Args:
        action: start, stop: the play session; pause, resume: time, in mode `live`.
    """
    match action:
        case "start":
            await call.client.sim.start()
            return Done(done="Play has started.")
        case "stop":
            await call.client.sim.stop()
            return Done(done="Play has ended. There are no robots until it starts again.")
        case _ if call.client.step_mode is not StepMode.LIVE:
            raise ValueError(f"In mode {call.client.step_mode} time passes only while a tool steps: call run.")
        case _:
            await call.client.runtime.set_paused(action == "pause")
            return Done(done="Time stands still." if action == "pause" else "Time passes.")


@tool(Needs.DRIVE)
async def record(call: Call, action: Literal["start", "stop"], cameras: bool = False) -> Recorded:
    """Record an episode: `start`, then move the robot, then `stop`. Writes an MCAP file with all states.

    Args:
        action: What to do.
        cameras: Whether to also record pictures of all cameras.
    """
    if action == "start":
        return Recorded(await call.console.recordings.start(cameras=cameras), running=True)
    return msgspec.convert(await call.console.recordings.stop(), Recorded, from_attributes=True)
