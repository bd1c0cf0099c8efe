"""Tools that change nothing."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import anyio.to_thread
from msgspec import Meta
from PIL import Image

from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.driving import Limits
from urlab_client.mcp.results import Contacts, Explained, Log, Picture, RobotState, World
from urlab_client.mcp.toolset import Toolset
from urlab_client.mcp.wording import for_agents
from urlab_client.protocol.client_types import Finding, Verdict
from urlab_client.protocol.messages.streams import CameraSample
from urlab_client.protocol.picture_files import JPEG_QUALITY
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

    @tool(Needs.READ, idempotent=True)
    async def look(self) -> World:
        """Describe the world: robots with joints, actuators, sensors, cameras, units and limits; other bodies.

        Call this first. Angles are in radians, lengths in metres, the z axis points up.
        """
        blueprints = [one.short_name for one in await self.client.outliner.list_blueprints()]
        holder = self.console.lease.holder
        return self.stamped(
            World(
                scene=self.client.describe(),
                blueprints=blueprints,
                models=sorted(self.models),
                driver=None if holder is None else holder.name,
            )
        )

    @tool(Needs.READ, idempotent=True)
    async def state(self, robot: Robot) -> RobotState:
        """Read a robot: where its joints are and how fast they move, its set-points, what its sensors read."""
        described = self.robot(robot).describe()
        joints = [joint for joint in described.joints if isinstance(joint.position, float)]
        return self.stamped(
            RobotState(
                robot=described.name,
                pose=described.pose,
                joints={joint.name: joint.position for joint in joints if isinstance(joint.position, float)},
                velocities={joint.name: joint.velocity for joint in joints if isinstance(joint.velocity, float)},
                set_points={actuator.name: actuator.set_point for actuator in described.actuators},
                sensors={sensor.name: sensor.reading for sensor in described.sensors if sensor.reading is not None},
            )
        )

    @tool(Needs.READ, idempotent=True)
    async def picture(
        self,
        camera: Annotated[str, Meta(description="`ROBOT/CAMERA`, or the name of a camera of the scene; see `look`.")],
        size: Annotated[int, Meta(description="Longest side in pixels, at most.", ge=16, le=1024)] = 512,
    ) -> tuple[Picture, bytes]:
        """Take a picture with a camera as the world is now. No time passes. Depth is grey, near is bright."""
        sample = await self.client.camera(camera).capture()
        jpeg, width, height = await anyio.to_thread.run_sync(_shrunk, sample, size)
        shown = Picture(camera=camera, kind=str(sample.mode), width=width, height=height)
        return self.stamped(shown), jpeg

    @tool(Needs.READ, idempotent=True)
    async def contacts(
        self, most: Annotated[int, Meta(description="Return at most so many.", ge=1, le=200)] = 30
    ) -> Contacts:
        """List which bodies touch, where, and with what force."""
        found = await self.client.runtime.get_contacts(max_contacts=most)
        return self.stamped(Contacts(contacts=found.contacts, truncated=found.truncated))

    @tool(Needs.READ, idempotent=True)
    async def explain(self) -> Explained:
        """Find out why a robot does not move: connection, play, pause, modes, controllers, set-points.

        Call this when something did not move as expected. Findings with verdict `problem` come with what to do.
        """
        found = (await self.client.explain()).findings
        findings = [Finding(one.verdict, one.subject, for_agents(one.text)) for one in found]
        problems = sum(finding.verdict is Verdict.PROBLEM for finding in findings)
        return self.stamped(Explained(problems=problems, findings=findings))

    @tool(Needs.READ)
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
        return self.stamped(Log(entries=entries, next=self._told))


def _shrunk(sample: CameraSample, size: int) -> tuple[bytes, int, int]:
    """Return a picture as JPEG with its longest side within a size, its width and its height."""
    image = Image.open(io.BytesIO(sample.jpeg()))
    image.thumbnail((size, size))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue(), *image.size
