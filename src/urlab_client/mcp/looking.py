"""Tools that change nothing."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import anyio.to_thread
from msgspec import Meta

from urlab_client.aio.client_types import Diagnosis
from urlab_client.mcp.call import Call
from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.results import Contacts, Log, Picture, RobotState, World

Robot = Annotated[str, Meta(description="Name or actor id of a robot, as `look` lists it.")]


@tool(Needs.NOTHING, play=False, idempotent=True)
async def look(call: Call) -> World:
    """Describe the world: robots with joints, actuators, sensors, cameras, units and limits; other bodies.

    Call this first. Angles are in radians, lengths in metres, the z axis points up.
    """
    client, holder, edits = call.client, call.console.lease.holder, call.limits.edit
    model = client.model
    return World(
        scene=client.describe(),
        blueprints=[one.short_name for one in await client.outliner.list_blueprints()] if edits else [],
        models=sorted(call.models) if edits else [],
        keyframes=[] if model is None else [model.key(number).name for number in range(model.nkey)],
        driver=None if holder is None else "you" if holder is call.caller else holder.name,
    )


@tool(Needs.NOTHING, idempotent=True)
async def state(call: Call, robot: Robot) -> RobotState:
    """Read a robot: joint positions and velocities, set-points and sensor readings."""
    described = call.robot(robot).describe()
    return RobotState(
        robot=described.name,
        pose=described.pose,
        joints={joint.name: joint.position for joint in described.joints if isinstance(joint.position, float)},
        velocities={joint.name: joint.velocity for joint in described.joints if isinstance(joint.velocity, float)},
        set_points={actuator.name: actuator.set_point for actuator in described.actuators},
        sensors={sensor.name: sensor.reading for sensor in described.sensors if sensor.reading is not None},
    )


@tool(Needs.NOTHING, idempotent=True)
async def picture(call: Call, camera: str, size: Annotated[int, Meta(ge=16, le=1024)] = 512) -> tuple[Picture, bytes]:
    """Take a picture of the current world with a camera. No time passes. Depth is grey, with near pixels bright.

    Args:
        camera: `ROBOT/CAMERA`, or the name of a camera of the scene; see `look`.
        size: Maximum length of the longer side, pixels.
    """
    sample = await call.client.camera(camera).capture()
    jpeg = await anyio.to_thread.run_sync(partial(sample.jpeg, max_size=size))
    return Picture(camera=camera, kind=str(sample.mode)), jpeg


@tool(Needs.SESSION, idempotent=True)
async def contacts(call: Call, most: Annotated[int, Meta(ge=1, le=200)] = 30) -> Contacts:
    """List which bodies touch, where, and with what force.

    Args:
        most: Maximum number of contacts to return.
    """
    found = await call.client.runtime.get_contacts(max_contacts=most)
    return Contacts(contacts=found.contacts, truncated=found.truncated)


@tool(Needs.NOTHING, play=False, idempotent=True)
async def explain(call: Call) -> Diagnosis:
    """Find out why a robot does not move: connection, play, pause, modes, controllers, set-points.

    Call this when something did not move as expected. Findings with verdict `problem` say what to do.
    """
    return await call.client.explain()


@tool(Needs.NOTHING, play=False)
async def log(call: Call, since: int | None = None) -> Log:
    """Read the log: calls, errors and events, including those of people.

    Args:
        since: Number of the last entry that you know. Without it you get the entries since your last call of `log`.
    """
    start = call.caller.told if since is None else since
    entries = call.console.view.entries_after(start)
    call.caller.told = entries[-1].n if entries else start
    return Log(entries=entries, next=call.caller.told)
