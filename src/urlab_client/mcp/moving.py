"""Tools that move robots, through the console's lease and within limits."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.driving import Progress
from urlab_client.mcp.looking import Looking, Robot
from urlab_client.mcp.results import Done, Recorded
from urlab_client.protocol.enums import StepMode

__all__ = ["Moving"]

Seconds = Annotated[float, Meta(description="Simulation time, seconds.", gt=0)]
Targets = Annotated[dict[str, float], Meta(description="Joint name to position: rad or m.", min_length=1)]

_RECORDED_S = 0.02


class Moving(Looking):
    """Tools that move robots."""

    @tool(Needs.DRIVE)
    async def run(
        self,
        progress: Progress,
        seconds: Seconds | None = None,
        steps: Annotated[int, Meta(description="Physics steps, instead of `seconds`.", ge=1)] | None = None,
    ) -> Done:
        """Let simulation time pass: step in mode `direct`, watch in mode `live`. Give `seconds` or `steps`."""
        if (seconds is None) == (steps is None):
            raise ValueError("run takes either `seconds` or `steps`.")
        model = self.client.model
        if steps is not None:
            if self.client.step_mode is StepMode.LIVE or model is None:
                raise ValueError("In this mode time passes by itself: give `seconds` instead of `steps`.")
            seconds = steps * float(model.opt.timestep)
        limit = self.driving.seconds(seconds or 0.0)

        async def work() -> float:
            passed = 0.0
            # A recording has a state for each reply.
            piece = _RECORDED_S if self.console.recordings.running is not None else limit
            while limit - passed > _RECORDED_S / 100:
                passed += await self.client.run_for(min(piece, limit - passed))
            return passed

        passed = await self.driving.drive(work, progress, limit)
        return Done(done="Time passed.", passed=passed)

    @tool(Needs.DRIVE, idempotent=True)
    async def move_to(
        self,
        progress: Progress,
        robot: Robot,
        joints: Targets,
        tolerance: Annotated[float, Meta(description="How near is near enough: rad or m.", gt=0)] = 0.01,
        timeout: Seconds = 5.0,
    ) -> Done:
        """Move joints to positions and wait until they have settled there.

        For joints with a position servo; others are moved with `set_actuators` and `run`. Refuses positions beyond a
        joint's limits. Fails with the reason when a joint has not settled in time.
        """
        found, limit = self.robot(robot), self.driving.seconds(timeout)
        passed = await self.driving.drive(
            lambda: found.move_to(joints, tolerance=tolerance, timeout=limit), progress, limit
        )
        reached = ", ".join(f"{name} {float(found.joints[name].position):.4g}" for name in joints)
        return Done(done=f"{found.name} has settled: {reached}.", passed=passed)

    @tool(Needs.DRIVE, idempotent=True)
    async def set_actuators(
        self,
        progress: Progress,
        robot: Robot,
        set_points: Annotated[
            dict[str, float],
            Meta(description="Actuator name to value, in the unit that `look` shows.", min_length=1),
        ],
    ) -> Done:
        """Tell actuators what to do; the others keep what they were told. Acts as time passes: call `run` then."""
        found = self.robot(robot)

        async def work() -> None:
            found.set_ctrl(set_points, out_of_range="error")
            if self.client.step_mode is StepMode.LIVE:
                await self.client.step()  # hands them over

        await self.driving.drive(work, progress)
        return Done(done=f"{found.name}: {len(set_points)} set-points are set.")

    @tool(Needs.DRIVE, destructive=True, idempotent=True)
    async def reset(
        self,
        progress: Progress,
        keyframe: Annotated[str | None, Meta(description="Keyframe to start from; default: the initial state.")] = None,
        joints: Annotated[
            dict[str, dict[str, float]] | None, Meta(description="Robot to joint to position, to start from: rad or m.")
        ] = None,
    ) -> Done:
        """Put the simulation back to its beginning. Set-points stay. Use it also when a simulation has diverged."""
        for name, positions in (joints or {}).items():
            for joint, position in positions.items():
                low, high = self.robot(name).joints[joint].limits or (position, position)
                if not low <= position <= high:
                    raise ValueError(f"joint {joint!r} of {name!r} takes {low:g} to {high:g}, got {position:g}.")
        await self.driving.drive(lambda: self.client.reset(keyframe, per_articulation_qpos=joints), progress)
        return Done(done="The simulation is at its beginning.")

    @tool(Needs.DRIVE, destructive=True, idempotent=True)
    async def play(
        self,
        progress: Progress,
        action: Annotated[
            Literal["start", "stop", "pause", "resume"],
            Meta(description="start, stop: the play session; pause, resume: time, in mode `live`."),
        ],
    ) -> Done:
        """Start or stop the play session, without which there are no robots; pause or resume time in mode `live`."""
        if action in {"pause", "resume"} and self.client.step_mode is not StepMode.LIVE:
            raise ValueError(f"In mode {self.client.step_mode} time passes only while a tool lets it: call run.")

        async def work() -> None:
            match action:
                case "start":
                    await self.client.sim.start()
                case "stop":
                    await self.client.sim.stop()
                case _:
                    await self.client.runtime.set_paused(action == "pause")

        await self.driving.drive(work, progress)
        return Done(done=f"{action}: done.")

    @tool(Needs.DRIVE)
    async def record(
        self,
        progress: Progress,
        action: Literal["start", "stop"],
        cameras: Annotated[bool, Meta(description="Whether to record pictures of all cameras, too.")] = False,
    ) -> Recorded:
        """Record an episode: `start`, then move the robot, then `stop`. Writes an MCAP file with all states."""
        recordings = self.console.recordings
        if action == "start":
            file = await self.driving.drive(lambda: recordings.start(cameras=cameras), progress)
            return Recorded(file, running=True)
        return msgspec.convert(await recordings.stop(), Recorded)
