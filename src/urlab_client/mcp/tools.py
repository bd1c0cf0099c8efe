"""The tools: those that change nothing, those that move robots, and those that change the scene.

Play restarts after each change of the scene, because the simulation is compiled again.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, Any, Literal

import anyio.to_thread
import msgspec
from msgspec import Meta

from urlab_client.aio.client_types import Diagnosis
from urlab_client.enums import StepMode
from urlab_client.errors import ImportFailed
from urlab_client.mcp.call import Call
from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.results import Contacts, Done, Edited, Log, Picture, Recorded, RobotState, World
from urlab_client.values.names import did_you_mean

Robot = Annotated[str, Meta(description="Name or actor id of a robot, as `look` lists it.")]
Positive = Annotated[float, Meta(gt=0)]
Targets = Annotated[dict[str, float], Meta(min_length=1)]
Metres = Annotated[float, Meta(ge=-1e4, le=1e4)]
Position = Annotated[list[Metres], Meta(description="(x, y, z) in the world, metres.", min_length=3, max_length=3)]
Actor = Annotated[str, Meta(description="Name or actor id of a robot or body, as `look` lists it.", min_length=1)]
NewId = Annotated[str, Meta(pattern=r"^[A-Za-z]\w{0,63}$")]
Degrees = Annotated[float, Meta(ge=-360, le=360)]

_RECORDED_S = 0.02


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
    start = call.caller.last_read if since is None else since
    entries = call.console.view.entries_after(start)
    call.caller.last_read = entries[-1].n if entries else start
    return Log(entries=entries, next=call.caller.last_read)


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


@tool(Needs.EDIT, play=False)
async def import_model(call: Call, model: str) -> Edited:
    """Turn a model into a blueprint, which `spawn` then places. Takes a name, never a path.

    Args:
        model: One of `models`, as `look` lists them.
    """
    if model not in call.models:
        raise LookupError(f"No model is called {model!r}.{did_you_mean(model, call.models)} See `models` in look.")
    scene, file = call.client.scene, call.models[model]
    done = "The blueprint {!r} is there; spawn places it."
    try:
        blueprint = await scene.import_xml(str(file))
    except ImportFailed:
        if not call.client.server.features.uploads:
            raise
        before = [one.short_name for one in await call.client.outliner.list_blueprints()]
        blueprint = await scene.upload_model(file)  # the server does not have the file, or may not read it
        if blueprint.short_name in before:
            done += " It has replaced the model that was sent before: this server keeps one."
    return _edited(call, done.format(blueprint.short_name))


@tool(Needs.EDIT, play=False)
async def spawn(call: Call, blueprint: str, actor_id: NewId, position: Position, yaw: Degrees = 0.0) -> Edited:
    """Place a robot or body. Restarts play: the simulation starts from the beginning, with all robots at their initial
    state.

    Args:
        blueprint: One of `blueprints`, as `look` lists them; `import_model` makes more.
        actor_id: Id of your choice for the new actor: letters, digits and `_`.
        position: Position of its origin: (x, y, z) in the world, metres.
        yaw: Rotation about the vertical axis, degrees.
    """
    known = {one.short_name: one.class_path for one in await call.client.outliner.list_blueprints()}
    if blueprint not in known:
        advice = "import_model makes one of it." if blueprint in call.models else "See `blueprints` in look."
        raise LookupError(f"No blueprint is called {blueprint!r}.{did_you_mean(blueprint, known)} {advice}")
    if any(row.actor_id == actor_id for row in await call.client.outliner.list_actors()):
        raise ValueError(f"There is already an actor {actor_id!r}: move moves it, remove removes it.")
    async with call.client.scene.edit():
        await call.client.scene.spawn_actor(
            known[blueprint], actor_id, location=position, rotation_euler=(0.0, 0.0, yaw)
        )
    placed = _edited(call, f"{actor_id} is placed.")
    if (robot := call.client.articulations.get(actor_id)) is not None:
        placed.done = f"{actor_id} is placed: it is the robot {robot.name!r}."
    return placed


@tool(Needs.EDIT, play=False, idempotent=True)
async def move(call: Call, actor: Actor, position: Position) -> Edited:
    """Move a robot or body in the level. Restarts play: the simulation starts from the beginning."""
    target = await _target(call, actor)
    async with call.client.scene.edit():
        await call.client.scene.set_actor_transform(**target, location=position)
    return _edited(call, f"{actor} is moved.")


@tool(Needs.EDIT, play=False, destructive=True, idempotent=True)
async def remove(call: Call, actor: Actor) -> Edited:
    """Remove a robot or body from the level. Restarts play: the simulation starts from the beginning."""
    target = await _target(call, actor)
    async with call.client.scene.edit():
        await call.client.scene.destroy_actor(**target)
    return _edited(call, f"{actor} is removed.")


async def _target(call: Call, named: str) -> dict[str, Any]:
    """Return what ops call an actor: its id, or otherwise the engine's name."""
    listed = await call.client.outliner.list_actors()
    rows = [row for row in listed if row.actor_id or row.is_articulation or row.has_quick_convert]
    art = call.client.articulations.get(named)
    names = {named} if art is None else {named, art.actor_id, art.compiled_prefix}
    for row in rows:
        if row.actor_id and row.actor_id in names:
            return {"target": row.actor_id, "by_name": False}
    for row in rows:
        if row.name in names:
            return {"target": row.name, "by_name": True}
    known = [row.actor_id or row.name for row in rows]
    raise LookupError(f"No actor is called {named!r}.{did_you_mean(named, known)} There are: {', '.join(known)}.")


def _edited(call: Call, done: str) -> Edited:
    robots = call.client.articulations
    return Edited(done, list(robots), [name for name in call.client.entities if name not in robots])
