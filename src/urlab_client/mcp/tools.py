"""The tools: those that change nothing, those that move robots, and those that change the scene.

Play restarts after each change of the scene, because the simulation is compiled again.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import anyio.to_thread
import msgspec
from msgspec import Meta, Struct, structs

from urlab_client.aio.client_types import Diagnosis, Finding, Verdict
from urlab_client.enums import StepMode
from urlab_client.errors import ImportFailed
from urlab_client.mcp import hands
from urlab_client.mcp.call import Call
from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.hands import Position, Quaternion, Waypoint
from urlab_client.mcp.results import (
    UNITS,
    Contacts,
    Done,
    Edited,
    HandMoved,
    HandPose,
    Log,
    Object,
    Picture,
    Recorded,
    RobotState,
    Touch,
    World,
    label,
)
from urlab_client.values.names import did_you_mean
from urlab_client.values.rotation import normalized, xyzw

if TYPE_CHECKING:
    from urlab_client.aio import URLabCameraView, URLabClient

Robot = Annotated[str, Meta(description="Name from `look`.")]
Positive = Annotated[float, Meta(gt=0)]
Targets = Annotated[dict[str, float], Meta(min_length=1)]
Actor = Annotated[str, Meta(description="Name from `look`.", min_length=1)]
NewId = Annotated[str, Meta(pattern=r"^[A-Za-z]\w{0,63}$")]
HandName = Annotated[str, Meta(description="Site or body; default: the one that `look` lists.")]
Speed = Annotated[float, Meta(description="m/s.", gt=0, le=2)]

_RESTARTS = "Play restarts: the simulation begins anew, and all that has moved is back at its initial state."


class Placed(Struct, frozen=True, forbid_unknown_fields=True):
    """One robot or object and where it is.

    Attributes:
        id: Id of your choice: letters, digits and `_`. What has this id already is moved.
        model: One of `models` in `look`; not needed for what is there already.
        position: Of its model's origin.
    """

    id: NewId
    position: Position
    model: str = ""
    quaternion: Quaternion | None = None


_RECORDED_S = 0.02


@tool(Needs.NOTHING, wants="nothing", idempotent=True)
async def look(call: Call) -> World:
    """Describe the world, in one frame: robots with joints, actuators, sensors and limits; poses of hands and objects;
    cameras.

    Call this first. Angles are in radians, lengths in metres, the z axis points up. Without a connection it says what
    is missing.
    """
    client, holder, missing = call.client, call.console.lease.holder, await call.missing()
    model, known = client.model, client.describe()
    arts = {one.name: one for one in known.articulations}
    ids = {key: one.actor_id or key for key, one in arts.items()}
    robots = [structs.replace(one, name=ids[key]) for key, one in arts.items() if one.actuators]
    things = [one for one in arts.values() if not one.actuators]
    objects = [Object(ids[one.name], one.pose, fixed=not (one.free_base or one.joints)) for one in things]
    objects += [Object(one.name, one.pose, fixed=not one.free_base) for one in known.entities]
    models = set(call.models)
    if call.limits.edit and not missing:
        models |= {one.short_name for one in await client.outliner.list_blueprints()}
    return World(
        connection=missing or "connected",
        units=UNITS,
        playing=known.playing,
        robots=robots,
        hands=[] if missing or not known.playing else await anyio.to_thread.run_sync(hands.hands, client),
        objects=objects,
        cameras=[f"{ids[key]}/{camera.name}" for key, one in arts.items() for camera in one.cameras]
        + [camera.name for camera in known.cameras],
        models=sorted(models) if call.limits.edit else [],
        keyframes=[] if model is None else [model.key(number).name for number in range(model.nkey)],
        driver=None if holder is None else "you" if holder is call.caller else holder.name,
    )


@tool(Needs.NOTHING, idempotent=True)
async def state(call: Call, robot: Robot) -> RobotState:
    """Read a robot: joint positions and velocities, set-points and sensor readings."""
    described = call.robot(robot).describe()
    return RobotState(
        robot=described.actor_id or described.name,
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
        camera: One of `cameras` in `look`.
        size: Maximum length of the longer side, pixels.
    """
    sample = await _camera(call.client, camera).capture()
    jpeg = await anyio.to_thread.run_sync(partial(sample.jpeg, max_size=size))
    return Picture(camera=camera, kind=str(sample.mode)), jpeg


async def jpeg_of(client: URLabClient, camera: str) -> bytes:
    """Take a picture and return it as a JPEG file."""
    sample = await _camera(client, camera).capture()
    return await anyio.to_thread.run_sync(sample.jpeg)


def _camera(client: URLabClient, name: str) -> URLabCameraView:
    owner, _, short = name.rpartition("/")
    robot = client.articulations.get(owner)
    return client.camera(name if robot is None else f"{robot.prefix}/{short}")


@tool(Needs.SESSION, idempotent=True)
async def contacts(call: Call, most: Annotated[int, Meta(ge=1, le=200)] = 30) -> Contacts:
    """List which bodies touch, where, and with what force.

    Args:
        most: Maximum number of contacts to return.
    """
    found = await call.client.runtime.get_contacts(max_contacts=most)
    touching = [
        Touch(
            (label(call.client, one.body1, one.geom1), label(call.client, one.body2, one.geom2)),
            one.pos,
            one.dist,
            one.force[0],
        )
        for one in found.contacts
    ]
    return Contacts(contacts=touching, truncated=found.truncated)


@tool(Needs.NOTHING, wants="nothing", idempotent=True)
async def explain(call: Call) -> Diagnosis:
    """Find out why a robot does not move: connection, play, pause, modes, controllers, set-points.

    Call this when something did not move as expected. Findings with verdict `problem` say what to do.
    """
    if missing := await call.missing():
        return Diagnosis([Finding(Verdict.PROBLEM, "server", missing)])
    return await call.client.explain()


@tool(Needs.NOTHING, wants="nothing")
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


@tool(Needs.NOTHING, idempotent=True)
async def hand_pose(call: Call, robot: Robot, hand: HandName | None = None) -> HandPose:
    """Read the pose of a robot's hand, and its gripper."""
    found = call.robot(robot)
    ik = await anyio.to_thread.run_sync(hands.solver, call.client, found, hand)
    return hands.pose_of(found, ik)


@tool(Needs.DRIVE, idempotent=True)
async def move_hand(
    call: Call,
    robot: Robot,
    *,
    position: Position | None = None,
    quaternion: Quaternion | None = None,
    gripper: float | None = None,
    speed: Speed = 0.25,
    hand: HandName | None = None,
) -> HandMoved:
    """Move a hand to a pose, in a straight line where possible, then set its gripper; wait until it is there, within
    1 cm.

    Refuses what is out of reach, and ways on which the robot would run into itself or something fixed, and says how far
    it gets; then nothing has moved. It may push what can move. Without `quaternion`, the hand keeps its orientation if
    it can.

    Args:
        gripper: Set-point of the gripper, within the limits of `look`.
    """
    if (position, quaternion, gripper) == (None, None, None):
        raise ValueError("move_hand takes at least one of position, quaternion and gripper.")
    return await hands.follow(call, robot, [Waypoint(position, quaternion, gripper)], hand, speed)


@tool(Needs.DRIVE, idempotent=True)
async def follow(
    call: Call,
    robot: Robot,
    poses: Annotated[list[Waypoint], Meta(min_length=1, max_length=20)],
    speed: Speed = 0.25,
    hand: HandName | None = None,
) -> HandMoved:
    """Move a hand through several poses, like `move_hand` for each. The whole way is checked before anything moves."""
    return await hands.follow(call, robot, poses, hand, speed)


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


@tool(Needs.DRIVE, discards="The simulation begins anew.", idempotent=True)
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


@tool(Needs.DRIVE, wants="server", discards="The play session ends, with its state.", only="stop", idempotent=True)
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


@tool(Needs.EDIT, wants="server", discards=_RESTARTS, idempotent=True)
async def apply_scene(
    call: Call,
    objects: Annotated[list[Placed], Meta(max_length=50)],
    remove: Annotated[list[Actor], Meta(description="Robots and objects to remove.", max_length=50)] = [],  # noqa: B006
) -> Edited:
    """Place, move and remove several robots and objects at once. Restarts play, once: the simulation begins anew, with
    all robots at their initial state."""
    blueprints = {one.short_name: one.class_path for one in await call.client.outliner.list_blueprints()}
    actors = {row.actor_id for row in await call.client.outliner.list_actors() if row.actor_id}
    doomed = [await _target(call, name) for name in remove]
    gone = {one["target"] for one in doomed}
    for one in objects:  # before anything changes
        if one.id in actors - gone or one.model in blueprints or one.model in call.models:
            continue
        known = {*blueprints, *call.models}
        raise LookupError(f"No model is called {one.model!r}.{did_you_mean(one.model, known)} See `models` in look.")
    notes = ""
    async with call.client.scene.edit():
        for target in doomed:
            await call.client.scene.destroy_actor(**target)
        for one in objects:
            turn = _turn(one.quaternion)
            if one.id in actors - gone:
                await call.client.scene.set_actor_transform(one.id, location=one.position, rotation_quat=turn)
                continue
            if one.model not in blueprints:
                blueprints[one.model], note = await _imported(call, one.model)
                notes += note
            await call.client.scene.spawn_actor(
                blueprints[one.model], one.id, location=one.position, rotation_quat=turn
            )
    placed = ", ".join(one.id for one in objects)
    said = [f"Placed: {placed}."] if placed else []
    said += [f"Removed: {', '.join(remove)}."] if remove else []
    return _edited(call, " ".join(said) + notes)


async def _imported(call: Call, model: str) -> tuple[str, str]:
    """Turn a model into a blueprint; return its class and what an agent should know of it."""
    scene, file = call.client.scene, call.models[model]
    try:
        return (await scene.import_xml(str(file))).class_path, ""
    except ImportFailed:
        if not call.client.server.features.uploads:
            raise
        before = [one.class_path for one in await call.client.outliner.list_blueprints()]
        made = (await scene.upload_model(file)).class_path  # the server does not have the file, or may not read it
        replaced = f" {model} has replaced the model that was sent before: this server keeps one."
        return made, replaced if made in before else ""


@tool(Needs.EDIT, wants="server", discards=_RESTARTS, idempotent=True)
async def move(
    call: Call, actor: Actor, position: Position | None = None, quaternion: Quaternion | None = None
) -> Edited:
    """Move or turn a robot or object in the level. Restarts play: the simulation begins anew."""
    if position is None and quaternion is None:
        raise ValueError("move takes a position, a quaternion, or both.")
    target = await _target(call, actor)
    async with call.client.scene.edit():
        await call.client.scene.set_actor_transform(**target, location=position, rotation_quat=_turn(quaternion))
    return _edited(call, f"{actor} is moved.")


@tool(Needs.EDIT, wants="server", discards=_RESTARTS, idempotent=True)
async def remove(call: Call, actor: Actor) -> Edited:
    """Remove a robot or object from the level. Restarts play: the simulation begins anew."""
    return await apply_scene.function(call, [], [actor])


def _turn(quaternion: list[float] | None) -> list[float] | None:
    """Return an orientation in the order of the wire."""
    if quaternion is None:
        return None
    w, x, y, z = quaternion
    return [*xyzw(normalized((w, x, y, z)))]


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
    robots = [art for art in call.client.articulations.values() if art.actuators]
    named = {art.prefix: art.actor_id or art.name for art in call.client.articulations.values()}
    own = {art.prefix for art in robots}
    objects = [named.get(key, key) for key in call.client.entities if key not in own]
    return Edited(done, [named[art.prefix] for art in robots], objects)
