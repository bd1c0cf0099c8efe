"""Tools that change nothing."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated

import anyio.to_thread
from msgspec import Meta

from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.driving import Limits
from urlab_client.mcp.results import Contacts, Log, Picture, RobotState, World
from urlab_client.mcp.toolset import Toolset
from urlab_client.protocol.client_types import Diagnosis
from urlab_client.web.console_session import ConsoleSession

__all__ = ["Looking"]

Robot = Annotated[str, Meta(description="Name of a robot, as `look` lists it.")]


class Looking(Toolset):
    """Tools that change nothing.

    Args:
        console: The session.
        limits: What the agent may do.
        models: Files that can be imported, by the names that the agent sees.
    """

    def __init__(self, console: ConsoleSession, limits: Limits, models: Mapping[str, Path]) -> None:
        super().__init__(console, limits)
        self.models = models
        self._told = 0

    @tool(Needs.NOTHING, idempotent=True)
    async def look(self) -> World:
        """Describe the world: robots with joints, actuators, sensors, cameras, units and limits; other bodies.

        Call this first. Angles are in radians, lengths in metres, the z axis points up.
        """
        blueprints = await self.client.outliner.list_blueprints() if self.limits.edit else []
        holder = self.console.lease.holder
        return World(
            scene=self.client.describe(),
            blueprints=[one.short_name for one in blueprints],
            models=sorted(self.models) if self.limits.edit else [],
            driver=None if holder is None else holder.name,
        )

    @tool(Needs.NOTHING, idempotent=True)
    async def state(self, robot: Robot) -> RobotState:
        """Read a robot: where its joints are and how fast they move, its set-points, what its sensors read."""
        described = self.robot(robot).describe()
        joints = [joint for joint in described.joints if isinstance(joint.position, float)]
        return RobotState(
            robot=described.name,
            pose=described.pose,
            joints={joint.name: joint.position for joint in joints if isinstance(joint.position, float)},
            velocities={joint.name: joint.velocity for joint in joints if isinstance(joint.velocity, float)},
            set_points={actuator.name: actuator.set_point for actuator in described.actuators},
            sensors={sensor.name: sensor.reading for sensor in described.sensors if sensor.reading is not None},
        )

    @tool(Needs.NOTHING, idempotent=True)
    async def picture(
        self,
        camera: Annotated[str, Meta(description="`ROBOT/CAMERA`, or the name of a camera of the scene; see `look`.")],
        size: Annotated[int, Meta(description="Longest side in pixels, at most.", ge=16, le=1024)] = 512,
    ) -> tuple[Picture, bytes]:
        """Take a picture with a camera as the world is now. No time passes. Depth is grey, near is bright."""
        sample = await self.client.camera(camera).capture()
        jpeg = await anyio.to_thread.run_sync(partial(sample.jpeg, max_size=size))
        return Picture(camera=camera, kind=str(sample.mode)), jpeg

    @tool(Needs.SESSION, idempotent=True)
    async def contacts(
        self, most: Annotated[int, Meta(description="Return at most so many.", ge=1, le=200)] = 30
    ) -> Contacts:
        """List which bodies touch, where, and with what force."""
        found = await self.client.runtime.get_contacts(max_contacts=most)
        return Contacts(contacts=found.contacts, truncated=found.truncated)

    @tool(Needs.NOTHING, idempotent=True)
    async def explain(self) -> Diagnosis:
        """Find out why a robot does not move: connection, play, pause, modes, controllers, set-points.

        Call this when something did not move as expected. Findings with verdict `problem` come with what to do.
        """
        return await self.client.explain()

    @tool(Needs.NOTHING)
    async def log(
        self,
        since: Annotated[
            int | None,
            Meta(description="Number of the last entry that you know; default: what is new since the last call"),
        ] = None,
    ) -> Log:
        """Read what happened: calls, errors and events, of people, too."""
        start = self._told if since is None else since
        entries = [entry for entry in self.console.entries if entry.n > start]
        self._told = entries[-1].n if entries else start
        return Log(entries=entries, next=self._told)
