"""Checks that drive robots: steps held against plain MuJoCo, resets, modes, options, claims, leases, state streams."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from urlab_client.conformance.bench import Bench, Twin, decoded
from urlab_client.conformance.declarations import (
    ALPHA,
    BETA,
    NEWER,
    OLDER,
    Body,
    Differs,
    Group,
    NotTried,
    check,
    expecting,
    has,
    holds,
    same,
)
from urlab_client.conformance.wire import OWNER, Message, plain
from urlab_client.errors import RPC_ERRORS, UNCLAIMED
from urlab_client.protocol import shm
from urlab_client.protocol.rows import BaseStateRow, JointRow, SensorRow, decode_row
from urlab_client.protocol.topics import StreamTopic, TopicKind

play: Callable[..., Callable[[Body], Body]] = partial(check, group=Group.PLAY)

_SUBSTEPS: Final = 10
_ROW: Final = 2e-6
_NOBODY: Final[dict[str, Any]] = {"articulation": "nobody"}
_STILL: Final[dict[str, Any]] = {"linear": [0.0, 0.0, 0.0]}


# Steps


@play("Session 10.2", "Simulation 1.8", needs=("robot",))
async def one_step(bench: Bench) -> None:
    """One step is one mj_step on the model of the handshake, number by number"""
    twin = Twin(bench)
    twin.agrees(bench.start)
    reply = bench.start
    for scale in (1.0, -2.0):
        twin.inputs(scale)
        reply = await twin.step(tolerance=1e-12)
    exact = [
        np.array_equal(bench.vector(reply, "qvel", robot), twin.data.qvel[robot.layout.qvel_adr])
        for robot in bench.robots
    ]
    bench.measured["one_step_is_bitwise_equal"] = all(exact)


@play("Session 10.2", "Session 9.3.2", "Simulation 2.4", needs=("robot",))
async def many_steps(bench: Bench) -> None:
    """Single steps and several in one request agree with MuJoCo, in state, time and step counter"""
    twin = Twin(bench)
    twin.inputs()
    replies = [await twin.step() for _ in range(_SUBSTEPS)]
    has(replies[-1], step=_SUBSTEPS)
    has(await twin.step(_SUBSTEPS), step=2 * _SUBSTEPS)


@play("Session 8.1")
async def clocks(bench: Bench) -> None:
    """The clocks of a reply are its time as two integers, and the server's UTC"""
    reply = await bench.step(n_steps=7)
    now = time.time()
    sim = reply["sim_time"]["sec"] + reply["sim_time"]["nsec"] * 1e-9
    same("sim_time in seconds", float(reply["time"]), sim, 2e-9)
    holds(0 <= reply["sim_time"]["nsec"] < 1e9, "nanoseconds", reply["sim_time"])
    wall = reply["wall_time"]["sec"] + reply["wall_time"]["nsec"] * 1e-9
    bench.measured["clock_offset_s"] = round(wall - now, 3)
    holds(abs(wall - now) < 86_400, "UTC of the server, within a day of this machine's", reply["wall_time"])


@play("Session 8.2", "Simulation 8", needs=("robot",))
async def observations(bench: Bench) -> None:
    """Controls, activations and sensors have the model's lengths, and MuJoCo's values"""
    await bench.greet(observations="standard")
    await bench.restart()
    twin = Twin(bench)
    twin.inputs()
    reply = await twin.step(_SUBSTEPS, observations="standard")
    same("ctrl", twin.values, bench.vector(reply, "ctrl"))
    same("length of act", len(twin.values), len(bench.vector(reply, "act")))
    for robot in bench.robots:
        told: dict[str, Any] = bench.state(reply, robot).get("sensors") or {}
        same(f"sensors of {robot.key}", sorted(robot.layout.sensors), sorted(told))
        for name, sensor in robot.layout.sensors.items():
            start, size = twin.model.sensor_adr[sensor], twin.model.sensor_dim[sensor]
            same(name, twin.data.sensordata[start : start + size], np.array(told[name]), 1e-9)


@play("Session 8.2", needs=("robot",))
async def levels(bench: Bench) -> None:
    """The observation levels add fields, and `full` has each body's pose as position and quaternion (w, x, y, z)"""
    fields: dict[str, set[str]] = {}
    for level in ("minimal", "standard", "full"):
        fields[level] = set(bench.state(await bench.step(observations=level)))
    await bench.step(observations="standard")
    same("fields at minimal", {"qpos", "qvel"}, fields["minimal"])
    same("fields at standard", {"qpos", "qvel", "ctrl", "act", "sensors"}, fields["standard"])
    same("fields at full", fields["standard"] | {"bodies", "actuator_force"}, fields["full"])
    await bench.restart()
    twin = Twin(bench)
    reply = await twin.step(observations="full")
    await bench.step(observations="standard")
    for robot in bench.robots:
        bodies = bench.state(reply, robot)["bodies"]
        for name in robot.layout.bodies.keys() & bodies.keys():
            body = robot.layout.bodies[name]
            same(f"xpos of {name}", twin.data.xpos[body], np.array(bodies[name]["xpos"]), 1e-6)
            same(f"xquat of {name}", twin.data.xquat[body], np.array(bodies[name]["xquat"]), 1e-6)


@play("Beta 36", "Beta 37", dialects=BETA, needs=("robots",))
async def level_of_one_reply(bench: Bench) -> None:
    """The level of a step holds for its reply alone"""
    await bench.greet(observations="minimal")
    await bench.restart()
    full = bench.state(await bench.step(observations="full"))
    same("missing at full", set(), {"bodies", "actuator_force"} - full.keys())
    same("fields of the next step", {"qpos", "qvel"}, set(bench.state(await bench.step())))
    await bench.greet(observations="standard")


@play("Session 8.3", dialects=OLDER)
async def entities(bench: Bench) -> None:
    """A step's reply has the robots' states and a map of entities"""
    reply = await bench.step()
    holds(isinstance(reply.get("entities"), dict), "a map entities", reply.get("entities"))
    same("missing fields", set(), {"per_articulation", "sim_time", "wall_time"} - reply.keys())


@play("Beta 30", "Beta 31", dialects=BETA)
async def reply_fields(bench: Bench) -> None:
    """Replies have the beta's fields, and those of reset and forward have no frame id"""
    base = {"op", "time", "step", "sim_time", "wall_time", "arts"}
    for op, more in {"step": {"frame_id", "scene"}, "reset": set[str](), "forward": set[str]()}.items():
        same(f"fields of {op}_ok", base | more, set(await bench.ask(op)))


@play("Beta 32", "Generation 2 19", "Generation 2 20", "Generation 2 21", dialects=NEWER)
async def frame_ids(bench: Bench) -> None:
    """Frame ids grow with each step, in the beta by one, and stand still between"""
    ids = [int((await bench.step(n_steps=n))["frame_id"]) for n in (1, 1, _SUBSTEPS, 1)]
    holds(ids[0] >= 1, "frame_id of 1 or more", ids[0])
    gaps = [after - before for before, after in itertools.pairwise(ids)]
    holds(set(gaps) == {1} if bench.dialect == "beta" else min(gaps) > 0, "growing frame_id, in the beta by 1", ids)


@play("Session 9.4", needs=("model",))
async def reset(bench: Bench) -> None:
    """A reset restores the model's state and counts from 0; an unknown keyframe is refused"""
    await bench.step(n_steps=_SUBSTEPS)
    await bench.refused("unknown_keyframe", "reset", keyframe_name="no such keyframe")
    has(await bench.ask("forward"), step=_SUBSTEPS)
    reply = await bench.ask("reset")
    has(reply, step=0)
    Twin(bench).agrees(reply)


@play("Session 9.4", "Simulation 1.6", needs=("keyframe", "robots"))
async def reset_to_keyframe(bench: Bench) -> None:
    """A reset to a keyframe gives the keyframe's state and time"""
    import mujoco

    twin = Twin(bench)
    for i in range(twin.model.nkey):
        mujoco.mj_resetDataKeyframe(twin.model, twin.data, i)
        if name := twin.model.key(i).name:
            twin.agrees(await bench.ask("reset", keyframe_name=name))


@play("Session 9.4", needs=("robot",))
async def reset_joints(bench: Bench) -> None:
    """A reset sets the joints that it names, and ignores unknown ones"""
    layout, model = bench.robot.layout, bench.compiled
    single = next((name for name, joint in layout.joints.items() if model.jnt_type[joint] >= _SLIDE), None)
    if single is None:
        raise NotTried("needs a hinge or a slide")
    reply = await bench.ask("reset", per_articulation_qpos={bench.robot.key: {single: 0.125, "nothing": 1.0}})
    at = int(np.flatnonzero(layout.qpos_adr == model.jnt_qposadr[layout.joints[single]])[0])
    same(f"position of {single}", 0.125, float(bench.vector(reply, "qpos")[at]))


_SLIDE: Final = 2  # mjJNT_SLIDE; hinges follow


@play("Session 9.5", needs=("robots",))
async def forward(bench: Bench) -> None:
    """Forward leaves time, counter and positions"""
    before = await bench.step(n_steps=3)
    after = await bench.ask("forward")
    has(after, 0.0, time=before["time"], step=before["step"])
    same("qpos", bench.vector(before, "qpos"), bench.vector(after, "qpos"))


@play("Session 10.1", "Session 9.3.2", needs=("robot",))
async def set_points(bench: Bench) -> None:
    """Set-points by name win over those by place, unknown names and surplus values are ignored"""
    twin = Twin(bench)
    twin.inputs()
    name = next(iter(bench.robot.layout.actuators))
    reply = await bench.step(**bench.drive([*twin.values, 9.0], ctrl_map={name: 0.5, "nothing": 1.0}))
    twin.values[0] = 0.5
    same("ctrl", twin.values, bench.vector(reply, "ctrl"))
    same("ctrl of the step after", twin.values, bench.vector(await bench.step(**bench.drive()), "ctrl"))


@play("Beta 35", dialects=BETA, needs=("robot",))
async def exact_set_points(bench: Bench) -> None:
    """A set-point comes back as it was sent, by name in single precision at worst"""
    reply = await bench.step(**bench.drive([0.1]))
    same("ctrl", 0.1, float(bench.vector(reply, "ctrl")[0]))
    name = next(iter(bench.robot.layout.actuators))
    got = float(bench.vector(await bench.step(**bench.drive(ctrl_map={name: 0.1})), "ctrl")[0])
    holds(got in {0.1, float(np.float32(0.1))}, "0.1 or its float32", got)


@play("Session 10.1", dialects=ALPHA, needs=("robot",))
async def single_set_points(bench: Bench) -> None:
    """A set-point comes back in single precision"""
    reply = await bench.step(**bench.drive([0.1]))
    same("ctrl", float(np.float32(0.1)), float(bench.vector(reply, "ctrl")[0]))


@play("Beta 38", "Session 9.3.2", needs=("robot",))
async def wrenches(bench: Bench) -> None:
    """A wrench acts as in MuJoCo, in its own step alone"""
    twin = Twin(bench)
    name, body = next(iter(bench.robot.layout.bodies.items()))
    twin.data.xfrc_applied[body] = wrench = [1.5, -2.0, 3.0, 0.1, 0.2, -0.3]
    await twin.step(3, command={"xfrc_applied": {f"{bench.robot.info.compiled_prefix}_{name}": wrench}})
    twin.data.xfrc_applied[body] = 0
    await twin.step(3)


@play("Session 9.3.3", "Beta 39", "Beta 40", needs=("model", "robots"))
async def puppet(bench: Bench) -> None:
    """A puppet push is shown as it was sent; without time the clock is 0, a wrong length is ignored"""
    twin = Twin(bench)
    await bench.enter("puppet", paused=True)
    twin.data.qvel[:], twin.data.time = np.linspace(-0.25, 0.25, twin.model.nv), 1.25
    qvel: list[float] = twin.data.qvel.tolist()
    reply = await bench.step(qpos=twin.data.qpos.tolist(), qvel=qvel, time=1.25)
    twin.agrees(reply)
    twin.data.time = 0.0
    after = await bench.step(qpos=[1.0], qvel=qvel)
    twin.agrees(after)
    has(after, step=reply["step"] + 1, perturbation=None)


@play("Beta 90", "Beta 95", dialects=BETA)
async def paused_puppet(bench: Bench) -> None:
    """Paused in puppet, nothing moves between pushes, also after choosing the mode again"""
    await bench.enter("puppet", paused=True)
    first = await bench.step(time=2.0)
    await bench.ask("set_mode", mode="puppet")
    await asyncio.sleep(1.0)
    has(await bench.ask("forward"), time=2.0)
    has(await bench.step(time=2.0), frame_id=first["frame_id"] + 1)


# Modes, options and refusals


@play("Session 9.6", "Beta 42")
async def modes(bench: Bench) -> None:
    """The step mode changes, says what it was, and unknown ones are refused"""
    await bench.refused("bad_mode", "set_mode", mode="no such mode")
    await bench.refused("missing_field", "set_mode")
    before = "direct"
    words = ("live", "streaming", "auto") if bench.dialect == "beta" else ("live", "streaming")
    for word in words:
        has(await bench.ask("set_mode", mode=word), previous_mode=before, current_mode="live")
        before = "live"


@play("Session 9.3.1", "Session 9.7", "Beta 33")
async def paused_live(bench: Bench) -> None:
    """Paused in live mode, steps return the same state and advance nothing"""
    await bench.step(n_steps=3)
    await bench.ask("set_mode", mode="live")
    has(await bench.ask("set_paused", paused=True), paused=True)
    await asyncio.sleep(0.1)
    first = await bench.step(n_steps=5)
    await asyncio.sleep(0.5)
    stands = ("time", "step", "frame_id") if bench.dialect == "beta" else ("time", "step")
    has(await bench.step(n_steps=5), 0.0, **{field: first[field] for field in stands})


@play("Session 9.8", "Transports 3.4", needs=("model",))
async def live_rate(bench: Bench) -> None:
    """Live mode advances, and its speed is limited to 5 to 100 percent"""
    await bench.enter("live")
    bench.later("set_sim_speed", percent=100.0)
    for asked, expected in ((1000.0, 100.0), (1.0, 5.0), (100.0, 100.0)):
        has(await bench.ask("set_sim_speed", percent=asked), 0.0, percent=expected)
    first, began = await bench.step(), time.perf_counter()
    await asyncio.sleep(0.5)
    after, took = await bench.step(), time.perf_counter() - began
    passed = float(after["time"]) - float(first["time"])
    bench.measured["live_real_time_factor"] = round(passed / took, 3)
    holds(0 < passed < 2 * took, f"time to advance by at most {2 * took:.2f} s in {took:.2f} s", passed)


@play("Beta 34", dialects=BETA, needs=("robot",))
async def live_set_points(bench: Bench) -> None:
    """A set-point in live mode is applied"""
    if bench.robot.info.controller is not None:
        raise NotTried("needs a robot without a controller")
    await bench.enter("live")
    reply = await bench.step(per_articulation={bench.robot.key: {"ctrl": [0.25]}})
    for _ in range(40):
        if float(bench.vector(reply, "ctrl")[0]) == 0.25:
            return
        await asyncio.sleep(0.05)
        reply = await bench.step()
    raise Differs("ctrl 0.25 within 2 s", bench.vector(reply, "ctrl")[0])


@play("Beta 88", "Session 9.7")
async def paused_direct(bench: Bench) -> None:
    """Paused in direct mode a step times out on the server, and time stands"""
    before = await bench.step()
    await bench.ask("set_paused", paused=True)
    await bench.refused("step_timeout", "step")
    has(await bench.ask("forward"), 0.0, time=before["time"])
    if bench.dialect == "beta":
        await bench.ask("set_paused", paused=False)
        has(await bench.ask("forward"), 0.0, time=before["time"])


@play("Session 9.9", "Beta 89")
async def control_source(bench: Bench) -> None:
    """An unknown control source is refused"""
    await bench.refused("bad_value", "set_control_source", source="no such source")
    await bench.refused("missing_field", "set_control_source")


@play("Session 9.10", "Session 9.11", needs=("robots",))
async def bad_positions(bench: Bench) -> None:
    """Twists and positions of an unknown robot, and positions of a wrong length, are refused"""
    await bench.refused("unknown_articulation", "set_twist", **_NOBODY, **_STILL)
    name = {"target": bench.robot.info.actor_name or bench.robot.key, "target_by": "actor_name"}
    await bench.refused("unknown_articulation", "set_qpos", **{**name, "target": "nobody"}, qpos=[0.0])
    await bench.refused("dim_mismatch", "set_qpos", **name, qpos=[0.0] * 999)


@play("Session 9.12")
async def mocap(bench: Bench) -> None:
    """An unknown mocap body is refused"""
    await bench.refused("unknown_body", "set_mocap_pose", body="no such body", pos=[0.0, 0.0, 0.0])
    await bench.refused("unknown_body", "read_mocap_pose", body="no such body")


@play("Session 9.17", "Beta 64", "Simulation 1.4", needs=("model",))
async def options(bench: Bench) -> None:
    """A time step that is set is in force at the next step, and an unknown integrator is refused"""
    before = (await bench.ask("set_sim_options", options={}))["options"]
    has(before, timestep=float(bench.compiled.opt.timestep))
    bench.later("set_sim_options", options={k: before[k] for k in ("timestep", "integrator")})
    wanted = 0.002 if before["timestep"] != 0.002 else 0.004
    after = (await bench.ask("set_sim_options", options={"timestep": wanted, "integrator": "RK4"}))["options"]
    beta = bench.dialect == "beta"
    has(after, 0.0, timestep=wanted if beta else float(np.float32(wanted)), integrator="RK4" if beta else "rk4")
    has(await bench.step(n_steps=5), 1e-6, time=5 * wanted)
    await bench.refused("bad_value", "set_sim_options", options={"integrator": "no such integrator"})


# Claims and leases


async def _unclaim(bench: Bench) -> str:
    """Give the first robot up until the check is over; return its key."""
    key = bench.robot.key
    bench.later("claim_control", articulation=key, force=True)
    await bench.ask("release_control", articulation=key)
    return key


async def _refused_write(bench: Bench, owner: str, key: str, command: Any = None, **fields: Any) -> None:
    """Send a command to a robot that must be refused in the name of its owner."""
    commands: dict[str, Any] = {key: {"ctrl": []} if command is None else command}
    has(await bench.refused("not_control_owner", "step", per_articulation=commands, **fields), owner=owner)


@play("Beta 9", "Beta 10", "Beta 11", "Beta 18", dialects=BETA, needs=("robots",))
async def unclaimed(bench: Bench) -> None:
    """Commands to a robot that nobody claimed are refused, and time stands; a step without commands is not"""
    key = await _unclaim(bench)
    before = await bench.step()
    gated: tuple[dict[str, Any], ...] = ({"ctrl": [0.0]}, {"ctrl": []}, {"ctrl_map": {}}, {"xfrc_applied": {}})
    for command in gated:
        await _refused_write(bench, UNCLAIMED, key, command)
    has(await bench.ask("forward"), 0.0, time=before["time"])
    free: tuple[dict[str, Any], ...] = ({}, {key: {}}, {key: {"control_mode": "raw"}}, {"nobody": {}})
    for commands in free:
        await bench.step(per_articulation=commands)
    await _refused_write(bench, UNCLAIMED, "nobody")


@play("Beta 12", "Beta 13", "Beta 15", dialects=BETA, needs=("robots",))
async def claims(bench: Bench) -> None:
    """A robot is claimed by any of its names, for good or for a time"""
    info = bench.robot.info
    for name in {info.prefix, info.actor_id or info.prefix, info.actor_name or info.prefix}:
        reply = await bench.ask("claim_control", articulation=name)
        has(reply, 0.0, articulation=info.actor_name, ttl_s=0.0)
        holds(reply["owner"] in {OWNER, bench.wire.session_id}, "the owner that was sent", reply["owner"])
    bench.later("claim_control", articulation=info.prefix)
    has(await bench.ask("claim_control", articulation=info.prefix, ttl_s=5.0), 0.0, ttl_s=5.0)


@play("Beta 14", "Beta 24", dialects=BETA, needs=("robots",))
async def others_are_refused(bench: Bench) -> None:
    """Another client's claim and commands are refused and name the owner; by force it takes over"""
    key = bench.robot.key
    claim = await bench.ask("claim_control", articulation=key)
    if claim["owner"] != OWNER:
        raise NotTried("needs a server that reads control_owner")
    bench.later("claim_control", articulation=key, force=True)
    other = {"articulation": key, "control_owner": "other"}
    has(await bench.refused("control_claimed", "claim_control", **other), owner=OWNER)
    await _refused_write(bench, OWNER, key, control_owner="somebody else")
    await _refused_write(bench, OWNER, key, control_owner=...)
    await bench.ask("claim_control", **other, force=True)
    bench.later("release_control", **other)
    await _refused_write(bench, "other", key)


@play("Beta 16", dialects=BETA, needs=("robots",))
async def claims_expire(bench: Bench) -> None:
    """A claim for half a second expires in silence, and lasts with writes"""
    key = bench.robot.key
    bench.later("claim_control", articulation=key)
    await bench.ask("claim_control", articulation=key, ttl_s=0.5)
    for _ in range(5):
        await asyncio.sleep(0.2)
        await bench.step(per_articulation={key: {"ctrl": []}})
    await asyncio.sleep(0.7)
    await _refused_write(bench, UNCLAIMED, key)


@play("Beta 17", dialects=BETA)
async def all_or_nothing(bench: Bench) -> None:
    """A step with one robot of ours and one of nobody's changes neither"""
    if len(bench.robots) < 2 or not len(bench.robot.layout.ctrl_adr):
        raise NotTried("needs two robots, one of them with an actuator")
    other = next(robot for robot in bench.robots if robot is not bench.robot)
    await bench.step(**bench.drive([0.0]))
    bench.later("claim_control", articulation=other.key)
    await bench.ask("release_control", articulation=other.key)
    commands = bench.drive([0.5])["per_articulation"] | {other.key: {"ctrl": []}}
    await bench.refused("not_control_owner", "step", per_articulation=commands)
    same("ctrl", 0.0, float(bench.vector(await bench.step(), "ctrl")[0]))


@play("Beta 19", "Beta 20", dialects=BETA, needs=("robots",))
async def releases(bench: Bench) -> None:
    """A robot is released once, and unknown ones are refused"""
    key = await _unclaim(bench)
    await bench.refused("not_control_owner", "release_control", articulation=key)
    await bench.refused("unknown_articulation", "release_control", **_NOBODY)
    await bench.refused("missing_field", "release_control")
    name = {"target": bench.robot.info.actor_name, "target_by": "actor_name"}
    await bench.refused("not_control_owner", "set_qpos", **name, qpos=[0.0])
    await bench.refused("not_control_owner", "set_twist", articulation=key, **_STILL)
    await bench.refused("unknown_articulation", "set_twist", **_NOBODY, **_STILL)


@play("Beta 22", dialects=BETA, needs=("robots",))
async def open_to_all(bench: Bench) -> None:
    """Resets, modes and forward need no claim"""
    await _unclaim(bench)
    await bench.restart()
    await bench.ask("forward")


@play("Beta 21", "Beta 89", dialects=BETA, needs=("robots",))
async def source_of_all(bench: Bench) -> None:
    """The control source of all robots is free while nobody holds one, and refused while another client does"""
    for robot in bench.robots:
        bench.later("claim_control", articulation=robot.key, force=True)
        await bench.ask("release_control", articulation=robot.key)
    await bench.refused("not_control_owner", "set_control_source", source="zmq", articulation=bench.robot.key)
    await bench.ask("set_control_source", source="zmq")
    other = {"articulation": bench.robot.key, "control_owner": "other"}
    await bench.ask("claim_control", **other)
    bench.later("release_control", **other)
    has(await bench.refused("not_control_owner", "set_control_source", source="zmq"), owner="other")


async def _lease(bench: Bench, **fields: Any) -> str:
    """Take the driver lease until the check is over; return its id."""
    reply = await bench.wire.raw("acquire_lease", owner="urlab conformance", **fields)
    if reply.get("code") == "busy":
        raise NotTried("needs a server without a lease")
    has(reply, op="acquire_lease_ok", ttl_s=float(fields.get("ttl_s", 60.0)))
    bench.later("release_lease", lease_id=reply["lease_id"])
    return str(reply["lease_id"])


async def _busy(bench: Bench) -> bool:
    await bench.greet()
    return bool(bench.plain_hello["instance"]["busy"])


@play("Beta 26", "Beta 27", "Beta 93", dialects=BETA)
async def leases(bench: Bench) -> None:
    """One lease at a time is given, which shows in the handshake; one of 0 seconds is free at once"""
    lease = await _lease(bench)
    has(await bench.refused("busy", "acquire_lease", owner="urlab conformance"), lease_id=lease)
    same("instance.busy", True, await _busy(bench))
    await bench.refused("bad_request", "release_lease", lease_id="nothing")
    await bench.ask("release_lease", lease_id=lease)
    same("instance.busy after the release", False, await _busy(bench))
    for _ in range(2):
        await _lease(bench, ttl_s=0.0)
    await bench.refused("bad_request", "release_lease", lease_id="")


@play("Beta 28", "Beta 29", dialects=BETA)
async def leases_expire(bench: Bench) -> None:
    """A lease refuses no step of another session, and ends with its time"""
    await _lease(bench, ttl_s=0.5)
    await bench.greet()
    await bench.step()
    await asyncio.sleep(0.7)
    lease = (await bench.ask("acquire_lease", owner="urlab conformance"))["lease_id"]
    bench.later("release_lease", lease_id=lease)


@play("Beta 46", dialects=BETA, needs=("robots",))
async def undeclared_channels(bench: Bench) -> None:
    """Writing an undeclared user channel succeeds and says so"""
    reply = await bench.ask("set_user_channels", arts={bench.robot.key: {"no_such_channel": 1.0}})
    has(reply, applied=0)
    holds("no_such_channel" in str(reply["rejected"]), "the channel among those rejected", reply["rejected"])


# Streams


@play("Beta 43", "Transports 3.3", dialects=BETA)
async def snapshots(bench: Bench) -> None:
    """In live mode only snapshots come, with the beta's fields"""
    await bench.enter("live")
    messages = await bench.state_messages(5)
    same("topics", {b"state/full"}, {message.topic for message in messages})
    told = [decoded(message) for message in messages]
    fields = {"op", "time", "step", "sim_time", "wall_time", "arts", "scene"}
    same("fields", fields, told[-1].keys() - {"user"})
    times = [float(snapshot["time"]) for snapshot in told]
    holds(times == sorted(times), "growing times", times)
    same("missing robots", set(), {robot.key for robot in bench.robots} - told[-1]["arts"].keys())


async def _heard(bench: Bench, act: Callable[[], Awaitable[Any]]) -> list[Message]:
    """Return the messages of the state stream while something is done in direct mode."""
    await asyncio.sleep(0.3)

    async def later() -> None:
        await asyncio.sleep(0.4)  # until the subscription stands
        await act()

    messages, _ = await asyncio.gather(bench.wire.listen(bench.state_endpoint, 1.5, lambda _: False), later())
    return messages


@play("Beta 44", "Session 10.3", dialects=BETA)
async def silence(bench: Bench) -> None:
    """In direct mode the state stream is silent"""
    same("messages", 0, len(await _heard(bench, lambda: bench.step(n_steps=3))))


@play("Transports 3.4", "Session 10.3", dialects=ALPHA)
async def direct_snapshots(bench: Bench) -> None:
    """In direct mode a step is followed by its snapshot, without rows"""
    replies: list[dict[str, Any]] = []

    async def steps() -> None:
        for _ in range(3):
            replies.append(await bench.step(n_steps=2))
            await asyncio.sleep(0.05)

    messages = await _heard(bench, steps)
    same("topics", {b"state/full"}, {message.topic for message in messages})
    times = [decoded(message)["time"] for message in messages]
    holds(replies[-1]["time"] in times, f"a snapshot of time {replies[-1]['time']}", times[-5:])


@play("Transports 3.1", "Transports 3.3", dialects=OLDER)
async def tick(bench: Bench) -> None:
    """A tick has the rows of the handshake's robots, and ends in a snapshot at level standard"""
    await bench.enter("live")
    messages = await bench.state_messages(3)
    keys = {robot.key for robot in bench.robots}
    for message in messages:
        with expecting("a topic of the wire"):
            topic = StreamTopic.parse(message.topic)
        rows = topic.kind in {TopicKind.JOINT, TopicKind.BASE_STATE, TopicKind.SENSOR, TopicKind.TWIST}
        holds(not rows or topic.owner in keys, f"a row of {sorted(keys)}", message.topic)
    snapshot = decoded(messages[-1])
    fields = {"op", "time", "step", "sim_time", "wall_time", "per_articulation", "entities"}
    same("fields of state/full", fields, set(snapshot))
    for robot in bench.robots:
        missing = {"qpos", "qvel", "ctrl", "act", "sensors"} - bench.state(snapshot, robot).keys()
        same(f"missing fields of {robot.key} at standard", set(), missing)


@play("Transports 3.2", dialects=OLDER, needs=("robots", "model"))
async def rows(bench: Bench) -> None:
    """Rows have the stated lengths, and the values of the snapshot behind them"""
    await bench.enter("live", paused=True)
    await bench.ask("reset")
    await asyncio.sleep(0.3)
    messages = await bench.state_messages(3)
    ends = [i for i, message in enumerate(messages) if message.topic == b"state/full"]
    holds(len(ends) >= 2, "two ticks", len(ends))
    snapshot = decoded(messages[ends[-1]])
    judged = [_judge_row(bench, snapshot, message) for message in messages[ends[-2] + 1 : ends[-1]]]
    holds(any(judged), "rows of joints or sensors", "none")


def _judge_row(bench: Bench, snapshot: dict[str, Any], message: Message) -> bool:
    """Hold a row against the snapshot behind it; return whether it is of a kind and robot that can be judged."""
    with expecting(f"a row of {message.topic!r}"):
        topic = StreamTopic.parse(message.topic)
        row = decode_row(topic, message.payload)
    robot = next((robot for robot in bench.robots if robot.key == topic.owner), None)
    if robot is None:
        return False
    qpos = bench.vector(snapshot, "qpos", robot)
    match row:
        case JointRow():
            at = np.flatnonzero(robot.layout.qpos_adr == bench.compiled.jnt_qposadr[row.id])
            same(f"position of {topic}", qpos[at[:1]], np.array([row.position]), _ROW)
        case BaseStateRow():
            same(f"quaternion of {topic}, w x y z", qpos[3:7], np.roll(row.quat_xyzw, 1), _ROW)
            same(f"position of {topic}", qpos[:3], np.asarray(row.position), _ROW)
        case SensorRow():
            same(f"length of {topic}", int(bench.compiled.sensor_dim[row.id]), len(row.values))
        case _:
            return False
    return True


@play("Transports 6.7", needs=("shm",))
async def state_region(bench: Bench) -> None:
    """The state region has the snapshots of live mode"""
    await bench.enter("live")
    await asyncio.sleep(0.3)
    with expecting(f"{shm.STATE_FILE} with a snapshot"):
        region = (Path(bench.plain_hello["shm_session_dir"]) / shm.STATE_FILE).read_bytes()
        header = shm.parse_header(region)
        holds(header.sequence > 0, "a publication", header.sequence)
        start = shm.HEADER_SIZE + header.latest_idx * header.stride
        size = int.from_bytes(region[start : start + shm.SIZE_PREFIX], "little")
        snapshot = plain(region[start + shm.SIZE_PREFIX : start + shm.SIZE_PREFIX + size])
    has(snapshot, op="state_full")


@check("Fields 1", "Session 3.1", "Session 11", last=True)
async def every_reply(bench: Bench) -> None:
    """Every reply of this run so far has the declared fields, float64 numbers, and known codes"""
    same("undeclared codes", {}, {code: op for code, op in bench.wire.refusals.items() if code not in RPC_ERRORS})
    same("numbers that are not float64", {}, bench.wire.numbers)
    same("departures from the declarations", {}, {op: sorted(lines) for op, lines in bench.wire.odd.items()})
