"""Checks that drive robots: steps held against plain MuJoCo, resets, modes, options, claims, leases, state streams."""

from __future__ import annotations

import asyncio
import itertools
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from urlab_client.conformance.bench import OWNER, Bench, Robot, decoded, holds, same
from urlab_client.conformance.declarations import ALPHA, BETA, NEWER, Differs, Group, NotTried, check
from urlab_client.conformance.frames import plain
from urlab_client.errors import RPC_ERRORS, UNCLAIMED, ProtocolError
from urlab_client.protocol import shm
from urlab_client.protocol.rows import BaseStateRow, JointRow, SensorRow, decode_row
from urlab_client.protocol.topics import StreamTopic, TopicKind

if TYPE_CHECKING:
    import mujoco

PLAY: Final = Group.PLAY
_ONE_STEP: Final = 1e-12
_MANY_STEPS: Final = 1e-9
_SUBSTEPS: Final = 10
_ROW: Final = 2e-6


def _local(bench: Bench) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the model and the state after a reset, with every controller's set-points at 0."""
    import mujoco

    data = mujoco.MjData(bench.compiled)
    mujoco.mj_forward(bench.compiled, data)
    return bench.compiled, data


def _idle(bench: Bench, robot: Robot | None = None, values: Any = None) -> dict[str, Any]:
    """Return the fields of a step in which no controller acts, and one robot's controls have the given values."""
    commands: dict[str, Any] = {}
    for one in bench.robots:
        numbers = values if one is robot and values is not None else np.zeros(len(one.layout.ctrl_adr))
        commands |= bench.drive(one, numbers)["per_articulation"]
    return {"per_articulation": commands}


def _inputs(bench: Bench, robot: Robot) -> NDArray[np.float64]:
    """Return small controls that float32 represents, different for each input."""
    count = len(robot.layout.ctrl_adr)
    return np.float64(0.0625) * (1 + np.arange(count) % 4) * np.where(np.arange(count) % 2, -1.0, 1.0)


def _agree(bench: Bench, reply: dict[str, Any], data: mujoco.MjData, tolerance: float) -> None:
    for robot in bench.robots:
        layout = robot.layout
        fields = {"qpos": data.qpos[layout.qpos_adr], "qvel": data.qvel[layout.qvel_adr]}
        for name, expected in fields.items():
            same(f"{name} of {robot.key}", expected, bench.vector(reply, name, robot), tolerance)


@check("Session 10.2", "Simulation 1.8", group=PLAY, needs=("robot",))
async def one_step(bench: Bench) -> None:
    """One step is one mj_step on the model of the handshake, number by number"""
    import mujoco

    start = await bench.direct()
    model, data = _local(bench)
    _agree(bench, start, data, _ONE_STEP)
    reply = start
    for values in (_inputs(bench, bench.robot), -2 * _inputs(bench, bench.robot)):
        data.ctrl[bench.robot.layout.ctrl_adr] = values
        reply = await bench.wire.ask("step", **_idle(bench, bench.robot, values))
        mujoco.mj_step(model, data)
        _agree(bench, reply, data, _ONE_STEP)
        same("time", float(data.time), float(reply["time"]), _ONE_STEP)
    exact = all(
        np.array_equal(bench.vector(reply, "qvel", robot), data.qvel[robot.layout.qvel_adr]) for robot in bench.robots
    )
    bench.measured["one_step_is_bitwise_equal"] = exact


@check("Session 10.2", "Session 9.3.2", "Simulation 2.4", group=PLAY, needs=("robot",))
async def many_steps(bench: Bench) -> None:
    """Single steps and several in one request agree with MuJoCo, in state, time and step counter"""
    import mujoco

    await bench.direct()
    model, data = _local(bench)
    values = _inputs(bench, bench.robot)
    data.ctrl[bench.robot.layout.ctrl_adr] = values
    reply: dict[str, Any] = {}
    for _ in range(_SUBSTEPS):
        reply = await bench.wire.ask("step", **_idle(bench, bench.robot, values))
        mujoco.mj_step(model, data)
    same("step", _SUBSTEPS, int(reply["step"]))
    _agree(bench, reply, data, _MANY_STEPS)
    reply = await bench.wire.ask("step", n_steps=_SUBSTEPS, **_idle(bench, bench.robot, values))
    mujoco.mj_step(model, data, nstep=_SUBSTEPS)
    same("step", 2 * _SUBSTEPS, int(reply["step"]))
    same("time", float(data.time), float(reply["time"]), _MANY_STEPS)
    _agree(bench, reply, data, _MANY_STEPS)


@check("Session 8.1", group=PLAY)
async def clocks(bench: Bench) -> None:
    """The clocks of a reply are its time as two integers, and the server's UTC"""
    await bench.direct()
    reply = await bench.wire.ask("step", n_steps=7)
    now = time.time()
    value = float(reply["time"])
    sim = reply["sim_time"]["sec"] + reply["sim_time"]["nsec"] * 1e-9
    holds(abs(sim - value) < 2e-9, f"sim_time of {value}", reply["sim_time"])
    holds(float(sim).is_integer() or 0 <= reply["sim_time"]["nsec"] < 1e9, "nanoseconds", reply["sim_time"])
    wall = reply["wall_time"]["sec"] + reply["wall_time"]["nsec"] * 1e-9
    bench.measured["clock_offset_s"] = round(wall - now, 3)
    holds(abs(wall - now) < 86_400, "UTC of the server, within a day of this machine's", reply["wall_time"])


@check("Session 8.2", "Simulation 8", group=PLAY, needs=("robot",))
async def observations(bench: Bench) -> None:
    """Controls, activations and sensors have the model's lengths, and MuJoCo's values"""
    import mujoco

    await bench.greet(observations="standard")
    await bench.direct()
    model, data = _local(bench)
    values = _inputs(bench, bench.robot)
    data.ctrl[bench.robot.layout.ctrl_adr] = values
    fields = _idle(bench, bench.robot, values)
    reply = await bench.wire.ask("step", n_steps=_SUBSTEPS, observations="standard", **fields)
    mujoco.mj_step(model, data, nstep=_SUBSTEPS)
    same("ctrl", values, bench.vector(reply, "ctrl"), 0.0)
    same("length of act", len(values), len(bench.vector(reply, "act")))
    for robot in bench.robots:
        told = bench.states(reply)[robot.key].get("sensors")
        same(f"sensors of {robot.key}", sorted(robot.layout.sensors), sorted(told or {}))
        for name, sensor in robot.layout.sensors.items():
            start, size = model.sensor_adr[sensor], model.sensor_dim[sensor]
            same(name, data.sensordata[start : start + size], np.array(told[name]), _MANY_STEPS)


@check("Session 8.2", group=PLAY, needs=("robot",))
async def levels(bench: Bench) -> None:
    """The observation levels add fields, and `full` has each body's pose as position and quaternion (w, x, y, z)"""
    import mujoco

    await bench.direct()
    model, data = _local(bench)
    await bench.wire.ask("step", **_idle(bench))
    mujoco.mj_step(model, data)
    replies = {level: await bench.wire.ask("step", observations=level) for level in ("minimal", "standard", "full")}
    await bench.wire.ask("step", observations="standard")
    extra = {"twist", "actions", "user"}
    fields = {level: set(bench.states(reply)[bench.robot.key]) - extra for level, reply in replies.items()}
    same("fields at minimal", {"qpos", "qvel"}, fields["minimal"])
    same("fields at standard", {"qpos", "qvel", "ctrl", "act", "sensors"}, fields["standard"])
    same("fields at full", fields["standard"] | {"bodies", "actuator_force"}, fields["full"])
    await bench.direct()
    reply = await bench.wire.ask("step", observations="full", **_idle(bench))
    await bench.wire.ask("step", observations="standard")
    for robot in bench.robots:
        bodies = bench.states(reply)[robot.key]["bodies"]
        for name, body in robot.layout.bodies.items():
            if name in bodies:
                same(f"xpos of {name}", data.xpos[body], np.array(bodies[name]["xpos"]), 1e-6)
                same(f"xquat of {name}", data.xquat[body], np.array(bodies[name]["xquat"]), 1e-6)


@check("Beta 36", "Beta 37", group=PLAY, dialects=BETA, needs=("robots",))
async def level_of_one_reply(bench: Bench) -> None:
    """The level of a step holds for its reply alone"""
    await bench.greet(observations="minimal")
    await bench.direct()
    full = bench.states(await bench.wire.ask("step", observations="full"))[bench.robot.key]
    same("bodies at full", True, "bodies" in full and "actuator_force" in full)
    after = set(bench.states(await bench.wire.ask("step"))[bench.robot.key])
    same("fields of the next step", {"qpos", "qvel"}, after - {"twist", "actions", "user"})
    await bench.greet(observations="standard")


@check("Session 8.3", group=PLAY, dialects=("alpha", "june"))
async def entities(bench: Bench) -> None:
    """A step's reply has the robots' states and a map of entities"""
    await bench.direct()
    reply = await bench.wire.ask("step")
    holds(isinstance(reply.get("entities"), dict), "a map entities", reply.get("entities"))
    same("fields", set(), {"per_articulation", "sim_time", "wall_time"} - reply.keys())


@check("Beta 30", "Beta 31", group=PLAY, dialects=BETA)
async def reply_fields(bench: Bench) -> None:
    """Replies have the beta's fields, and those of reset and forward have no frame id"""
    await bench.direct()
    base = {"op", "time", "step", "sim_time", "wall_time", "arts"}
    same("fields of step_ok", base | {"frame_id", "scene"}, set(await bench.wire.ask("step")))
    for op in ("reset", "forward"):
        same(f"fields of {op}_ok", base, set(await bench.wire.ask(op)))


@check("Beta 32", "Generation 2 19", "Generation 2 20", "Generation 2 21", group=PLAY, dialects=NEWER)
async def frame_ids(bench: Bench) -> None:
    """Frame ids grow with each step, in the beta by one, and stand still between"""
    await bench.direct()
    ids = [int((await bench.wire.ask("step", n_steps=n))["frame_id"]) for n in (1, 1, _SUBSTEPS, 1)]
    holds(ids[0] >= 1, "frame_id of 1 or more", ids[0])
    gaps = [after - before for before, after in itertools.pairwise(ids)]
    if bench.dialect == "beta":
        same("growth of frame_id", [1, 1, 1], gaps)
    else:
        holds(min(gaps) > 0, "growing frame_id", ids)


@check("Session 9.4", group=PLAY, needs=("model",))
async def reset(bench: Bench) -> None:
    """A reset restores the model's state and counts from 0; an unknown keyframe is refused"""
    await bench.direct()
    await bench.wire.ask("step", n_steps=_SUBSTEPS)
    await bench.wire.refused("unknown_keyframe", "reset", keyframe_name="no such keyframe")
    same("step after a refused reset", _SUBSTEPS, int((await bench.wire.ask("forward"))["step"]))
    reply = await bench.wire.ask("reset")
    same("step", 0, int(reply["step"]))
    same("time", 0.0, float(reply["time"]))
    _agree(bench, reply, _local(bench)[1], _ONE_STEP)


@check("Session 9.4", "Simulation 1.6", group=PLAY, needs=("keyframe", "robots"))
async def reset_to_keyframe(bench: Bench) -> None:
    """A reset to a keyframe gives the keyframe's state and time"""
    import mujoco

    await bench.direct()
    model, data = _local(bench)
    for i in range(model.nkey):
        mujoco.mj_resetDataKeyframe(model, data, i)
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, i)
        if name:
            reply = await bench.wire.ask("reset", keyframe_name=name)
            same("time", float(data.time), float(reply["time"]), _ONE_STEP)
            _agree(bench, reply, data, _ONE_STEP)


@check("Session 9.4", group=PLAY, needs=("robot",))
async def reset_joints(bench: Bench) -> None:
    """A reset sets the joints that it names, and ignores unknown ones"""
    await bench.direct()
    layout, model = bench.robot.layout, bench.compiled
    single = next((name for name, joint in layout.joints.items() if model.jnt_type[joint] >= _SLIDE), None)
    if single is None:
        raise NotTried("needs a hinge or a slide")
    reply = await bench.wire.ask("reset", per_articulation_qpos={bench.robot.key: {single: 0.125, "nothing": 1.0}})
    at = int(np.flatnonzero(layout.qpos_adr == model.jnt_qposadr[layout.joints[single]])[0])
    same(f"position of {single}", 0.125, float(bench.vector(reply, "qpos")[at]))


_SLIDE: Final = 2  # mjJNT_SLIDE; hinges follow


@check("Session 9.5", group=PLAY, needs=("robots",))
async def forward(bench: Bench) -> None:
    """Forward leaves time, counter and positions"""
    await bench.direct()
    before = await bench.wire.ask("step", n_steps=3)
    after = await bench.wire.ask("forward")
    for field in ("time", "step"):
        same(field, before[field], after[field])
    same("qpos", bench.vector(before, "qpos"), bench.vector(after, "qpos"))


@check("Session 10.1", "Session 9.3.2", group=PLAY, needs=("robot",))
async def set_points(bench: Bench) -> None:
    """Set-points by name win over those by place, unknown names and surplus values are ignored"""
    await bench.direct()
    robot = bench.robot
    values = _inputs(bench, robot)
    name = next(iter(robot.layout.actuators))
    fields = bench.drive(robot, [*values, 9.0], ctrl_map={name: 0.5, "nothing": 1.0})
    reply = await bench.wire.ask("step", **fields)
    expected = values.copy()
    expected[0] = 0.5
    same("ctrl", expected, bench.vector(reply, "ctrl"))
    reply = await bench.wire.ask("step", **bench.drive(robot, []))
    same("ctrl of the step after", expected, bench.vector(reply, "ctrl"))


@check("Beta 35", group=PLAY, dialects=BETA, needs=("robot",))
async def exact_set_points(bench: Bench) -> None:
    """A set-point comes back as it was sent, by name in single precision at worst"""
    await bench.direct()
    reply = await bench.wire.ask("step", **bench.drive(bench.robot, [0.1]))
    same("ctrl", 0.1, float(bench.vector(reply, "ctrl")[0]))
    name = next(iter(bench.robot.layout.actuators))
    reply = await bench.wire.ask("step", **bench.drive(bench.robot, [], ctrl_map={name: 0.1}))
    got = float(bench.vector(reply, "ctrl")[0])
    holds(got in {0.1, float(np.float32(0.1))}, "0.1 or its float32", got)


@check("Session 10.1", group=PLAY, dialects=ALPHA, needs=("robot",))
async def single_set_points(bench: Bench) -> None:
    """A set-point comes back in single precision"""
    await bench.direct()
    reply = await bench.wire.ask("step", **bench.drive(bench.robot, [0.1]))
    same("ctrl", float(np.float32(0.1)), float(bench.vector(reply, "ctrl")[0]))


@check("Beta 38", "Session 9.3.2", group=PLAY, needs=("robot",))
async def wrenches(bench: Bench) -> None:
    """A wrench acts as in MuJoCo, in its own step alone"""
    import mujoco

    await bench.direct()
    model, data = _local(bench)
    name, body = next(iter(bench.robot.layout.bodies.items()))
    compiled = f"{bench.robot.info.compiled_prefix}_{name}"
    wrench = [1.5, -2.0, 3.0, 0.1, 0.2, -0.3]
    fields = _idle(bench)
    fields["per_articulation"][bench.robot.key]["xfrc_applied"] = {compiled: wrench}
    data.xfrc_applied[body] = wrench
    reply = await bench.wire.ask("step", n_steps=3, **fields)
    mujoco.mj_step(model, data, nstep=3)
    _agree(bench, reply, data, _MANY_STEPS)
    data.xfrc_applied[body] = 0
    reply = await bench.wire.ask("step", n_steps=3, **_idle(bench))
    mujoco.mj_step(model, data, nstep=3)
    _agree(bench, reply, data, _MANY_STEPS)


@check("Session 9.3.3", "Beta 39", "Beta 40", group=PLAY, needs=("model", "robots"))
async def puppet(bench: Bench) -> None:
    """A puppet push is shown as it was sent; without time the clock is 0, a wrong length is ignored"""
    await bench.direct()
    model, data = _local(bench)
    bench.later("set_mode", mode="direct")
    await bench.wire.ask("set_mode", mode="puppet")
    await bench.wire.ask("set_paused", paused=True)
    bench.later("set_paused", paused=False)
    data.qvel[:] = np.linspace(-0.25, 0.25, model.nv)
    reply = await bench.wire.ask("step", qpos=data.qpos.tolist(), qvel=data.qvel.tolist(), time=1.25)
    first = int(reply["step"])
    _agree(bench, reply, data, _ONE_STEP)
    same("time", 1.25, float(reply["time"]))
    reply = await bench.wire.ask("step", qpos=[1.0], qvel=data.qvel.tolist())
    _agree(bench, reply, data, _ONE_STEP)
    same("time without time", 0.0, float(reply["time"]))
    same("step", first + 1, int(reply["step"]))
    same("perturbation", None, reply.get("perturbation"))


@check("Beta 90", group=PLAY, dialects=BETA)
async def paused_puppet(bench: Bench) -> None:
    """Paused in puppet, nothing moves between pushes"""
    await bench.direct()
    bench.later("set_mode", mode="direct")
    await bench.wire.ask("set_mode", mode="puppet")
    await bench.wire.ask("set_paused", paused=True)
    bench.later("set_paused", paused=False)
    first = await bench.wire.ask("step", time=2.0)
    await asyncio.sleep(1.0)
    same("time", 2.0, float((await bench.wire.ask("forward"))["time"]))
    after = await bench.wire.ask("step", time=2.0)
    same("frame_id", int(first["frame_id"]) + 1, int(after["frame_id"]))


@check("Session 9.6", "Beta 42", group=PLAY)
async def modes(bench: Bench) -> None:
    """The step mode changes, says what it was, and unknown ones are refused"""
    await bench.direct()
    await bench.wire.refused("bad_mode", "set_mode", mode="no such mode")
    await bench.wire.refused("missing_field", "set_mode")
    bench.later("set_mode", mode="direct")
    before = "direct"
    words = {"live": "live", "streaming": "live"} | ({"auto": "live"} if bench.dialect == "beta" else {})
    for word, mode in words.items():
        reply = await bench.wire.ask("set_mode", mode=word)
        same("previous_mode", before, reply["previous_mode"])
        same("current_mode", mode, reply["current_mode"])
        before = mode


async def _live(bench: Bench, *, paused: bool) -> None:
    await bench.direct()
    bench.later("set_mode", mode="direct")
    await bench.wire.ask("set_mode", mode="live")
    await bench.wire.ask("set_paused", paused=paused)


@check("Session 9.3.1", "Session 9.7", "Beta 33", group=PLAY)
async def paused_live(bench: Bench) -> None:
    """Paused in live mode, steps return the same state and advance nothing"""
    await bench.direct()
    await bench.wire.ask("step", n_steps=3)
    bench.later("set_paused", paused=False)
    bench.later("set_mode", mode="direct")
    await bench.wire.ask("set_mode", mode="live")
    same("paused", True, (await bench.wire.ask("set_paused", paused=True))["paused"])
    await asyncio.sleep(0.1)
    first = await bench.wire.ask("step", n_steps=5)
    await asyncio.sleep(0.5)
    after = await bench.wire.ask("step", n_steps=5)
    for field in ("time", "step", *(["frame_id"] if bench.dialect == "beta" else [])):
        same(field, first[field], after[field])


@check("Session 9.8", "Transports 3.4", group=PLAY, needs=("model",))
async def live_rate(bench: Bench) -> None:
    """Live mode advances, and its speed is limited to 5 to 100 percent"""
    await _live(bench, paused=False)
    bench.later("set_sim_speed", percent=100.0)
    for asked, expected in ((1000.0, 100.0), (1.0, 5.0), (100.0, 100.0)):
        same("percent", expected, float((await bench.wire.ask("set_sim_speed", percent=asked))["percent"]))
    first, began = await bench.wire.ask("step"), time.perf_counter()
    await asyncio.sleep(0.5)
    after, took = await bench.wire.ask("step"), time.perf_counter() - began
    passed = float(after["time"]) - float(first["time"])
    bench.measured["live_real_time_factor"] = round(passed / took, 3)
    holds(0 < passed < 2 * took, f"time to advance by at most {2 * took:.2f} s in {took:.2f} s", passed)


@check("Beta 34", group=PLAY, dialects=BETA, needs=("robot",))
async def live_set_points(bench: Bench) -> None:
    """A set-point in live mode is applied"""
    await _live(bench, paused=False)
    command = {"per_articulation": {bench.robot.key: {"ctrl": [0.25]}}}
    if bench.robot.info.controller is not None:
        raise NotTried("needs a robot without a controller")
    await bench.wire.ask("step", **command)
    for _ in range(40):
        if float(bench.vector(await bench.wire.ask("step"), "ctrl")[0]) == 0.25:
            return
        await asyncio.sleep(0.05)
    raise Differs("ctrl 0.25 within 2 s", bench.vector(await bench.wire.ask("step"), "ctrl")[0])


@check("Beta 88", "Session 9.7", group=PLAY)
async def paused_direct(bench: Bench) -> None:
    """Paused in direct mode a step times out on the server, and time stands"""
    await bench.direct()
    before = await bench.wire.ask("step")
    bench.later("set_paused", paused=False)
    await bench.wire.ask("set_paused", paused=True)
    await bench.wire.refused("step_timeout", "step")
    same("time", float(before["time"]), float((await bench.wire.ask("forward"))["time"]))
    if bench.dialect == "beta":
        await bench.wire.ask("set_paused", paused=False)
        same("time after the pause", float(before["time"]), float((await bench.wire.ask("forward"))["time"]))


@check("Session 9.9", "Beta 89", group=PLAY)
async def control_source(bench: Bench) -> None:
    """An unknown control source is refused"""
    await bench.wire.refused("bad_value", "set_control_source", source="no such source")
    await bench.wire.refused("missing_field", "set_control_source")


@check("Session 9.10", "Session 9.11", group=PLAY, needs=("robots",))
async def bad_positions(bench: Bench) -> None:
    """Twists and positions of an unknown robot, and positions of a wrong length, are refused"""
    await bench.wire.refused("unknown_articulation", "set_twist", articulation="nobody", linear=[0.0, 0.0, 0.0])
    name = {"target": bench.robot.info.actor_name or bench.robot.key, "target_by": "actor_name"}
    await bench.wire.refused("unknown_articulation", "set_qpos", **{**name, "target": "nobody"}, qpos=[0.0])
    await bench.wire.refused("dim_mismatch", "set_qpos", **name, qpos=[0.0] * 999)


@check("Session 9.12", group=PLAY)
async def mocap(bench: Bench) -> None:
    """An unknown mocap body is refused"""
    await bench.wire.refused("unknown_body", "set_mocap_pose", body="no such body", pos=[0.0, 0.0, 0.0])
    await bench.wire.refused("unknown_body", "read_mocap_pose", body="no such body")


@check("Session 9.17", "Beta 64", "Simulation 1.4", group=PLAY, needs=("model",))
async def options(bench: Bench) -> None:
    """A time step that is set is in force at the next step, and an unknown integrator is refused"""
    await bench.direct()
    before = (await bench.wire.ask("set_sim_options", options={}))["options"]
    same("timestep", float(bench.compiled.opt.timestep), float(before["timestep"]), 1e-9)
    bench.later("set_sim_options", options={k: before[k] for k in ("timestep", "integrator")})
    wanted = 0.002 if before["timestep"] != 0.002 else 0.004
    after = (await bench.wire.ask("set_sim_options", options={"timestep": wanted, "integrator": "RK4"}))["options"]
    exact = wanted if bench.dialect == "beta" else float(np.float32(wanted))
    same("timestep", exact, float(after["timestep"]))
    same("integrator", "RK4" if bench.dialect == "beta" else "rk4", after["integrator"])
    reply = await bench.wire.ask("step", n_steps=5)
    holds(abs(float(reply["time"]) - 5 * wanted) < 1e-6, f"time {5 * wanted}", reply["time"])
    await bench.wire.refused("bad_value", "set_sim_options", options={"integrator": "no such integrator"})


# Claims and leases


async def _others(bench: Bench, robot: Robot, **fields: Any) -> dict[str, Any]:
    command: dict[str, Any] = {"per_articulation": {robot.key: {"ctrl": []}}}
    return await bench.wire.raw("step", **command, control_owner="somebody else", **fields)


@check("Beta 9", "Beta 10", "Beta 11", "Beta 18", group=PLAY, dialects=BETA, needs=("robots",))
async def unclaimed(bench: Bench) -> None:
    """Commands to a robot that nobody claimed are refused, and time stands; a step without commands is not"""
    await bench.direct()
    bench.later("claim_control", articulation=bench.robot.key)
    await bench.wire.ask("release_control", articulation=bench.robot.key)
    before = await bench.wire.ask("step")
    gated: tuple[dict[str, Any], ...] = ({"ctrl": [0.0]}, {"ctrl": []}, {"ctrl_map": {}}, {"xfrc_applied": {}})
    for command in gated:
        reply = await bench.wire.refused("not_control_owner", "step", per_articulation={bench.robot.key: command})
        same("owner", UNCLAIMED, reply.get("owner"))
    same("time", float(before["time"]), float((await bench.wire.ask("forward"))["time"]))
    key = bench.robot.key
    free: tuple[dict[str, Any], ...] = ({}, {key: {}}, {key: {"control_mode": "raw"}}, {"nobody": {}})
    for commands in free:
        await bench.wire.ask("step", per_articulation=commands)
    reply = await bench.wire.refused("not_control_owner", "step", per_articulation={"nobody": {"ctrl": []}})
    same("owner", UNCLAIMED, reply.get("owner"))


@check("Beta 12", "Beta 13", "Beta 15", group=PLAY, dialects=BETA, needs=("robots",))
async def claims(bench: Bench) -> None:
    """A robot is claimed by any of its names, for good or for a time"""
    info = bench.robot.info
    for name in {info.prefix, info.actor_id or info.prefix, info.actor_name or info.prefix}:
        reply = await bench.wire.ask("claim_control", articulation=name)
        same("articulation", info.actor_name, reply["articulation"])
        same("ttl_s", 0.0, float(reply["ttl_s"]))
        holds(reply["owner"] in {OWNER, bench.wire.session_id}, "the owner that was sent", reply["owner"])
    reply = await bench.wire.ask("claim_control", articulation=info.prefix, ttl_s=5.0)
    same("ttl_s", 5.0, float(reply["ttl_s"]))
    await bench.wire.ask("claim_control", articulation=info.prefix)


@check("Beta 14", "Beta 24", group=PLAY, dialects=BETA, needs=("robots",))
async def others_are_refused(bench: Bench) -> None:
    """Another client's claim and commands are refused and name the owner; by force it takes over"""
    await bench.direct()
    key = bench.robot.key
    claim = await bench.wire.ask("claim_control", articulation=key)
    if claim["owner"] != OWNER:
        raise NotTried("needs a server that reads control_owner")
    bench.later("claim_control", articulation=key, force=True)
    refusal = await bench.wire.refused("control_claimed", "claim_control", articulation=key, control_owner="other")
    same("owner", OWNER, refusal.get("owner"))
    reply = await _others(bench, bench.robot)
    same("code of another's step", "not_control_owner", reply.get("code"))
    same("owner", OWNER, reply.get("owner"))
    reply = await bench.wire.raw("step", per_articulation={key: {"ctrl": []}}, control_owner=...)
    same("code of a step without control_owner", "not_control_owner", reply.get("code"))
    await bench.wire.ask("claim_control", articulation=key, control_owner="other", force=True)
    bench.later("release_control", articulation=key, control_owner="other")
    refusal = await bench.wire.refused("not_control_owner", "step", per_articulation={key: {"ctrl": []}})
    same("owner", "other", refusal.get("owner"))


@check("Beta 16", group=PLAY, dialects=BETA, needs=("robots",))
async def claims_expire(bench: Bench) -> None:
    """A claim for half a second expires in silence, and lasts with writes"""
    await bench.direct()
    key = bench.robot.key
    command: dict[str, Any] = {"per_articulation": {key: {"ctrl": []}}}
    bench.later("claim_control", articulation=key)
    await bench.wire.ask("claim_control", articulation=key, ttl_s=0.5)
    for _ in range(5):
        await asyncio.sleep(0.2)
        await bench.wire.ask("step", **command)
    await asyncio.sleep(0.7)
    same("owner", UNCLAIMED, (await bench.wire.refused("not_control_owner", "step", **command)).get("owner"))


@check("Beta 17", group=PLAY, dialects=BETA)
async def all_or_nothing(bench: Bench) -> None:
    """A step with one robot of ours and one of nobody's changes neither"""
    if len(bench.robots) < 2 or not len(bench.robot.layout.ctrl_adr):
        raise NotTried("needs two robots, one of them with an actuator")
    await bench.direct()
    other = next(robot for robot in bench.robots if robot is not bench.robot)
    await bench.wire.ask("step", **bench.drive(bench.robot, [0.0]))
    bench.later("claim_control", articulation=other.key)
    await bench.wire.ask("release_control", articulation=other.key)
    fields = bench.drive(bench.robot, [0.5])
    fields["per_articulation"][other.key] = {"ctrl": []}
    await bench.wire.refused("not_control_owner", "step", **fields)
    same("ctrl", 0.0, float(bench.vector(await bench.wire.ask("step"), "ctrl")[0]))


@check("Beta 19", "Beta 20", group=PLAY, dialects=BETA, needs=("robots",))
async def releases(bench: Bench) -> None:
    """A robot is released once, and unknown ones are refused"""
    key = bench.robot.key
    bench.later("claim_control", articulation=key)
    await bench.wire.ask("release_control", articulation=key)
    await bench.wire.refused("not_control_owner", "release_control", articulation=key)
    await bench.wire.refused("unknown_articulation", "release_control", articulation="nobody")
    await bench.wire.refused("missing_field", "release_control")
    name = {"target": bench.robot.info.actor_name, "target_by": "actor_name"}
    await bench.wire.refused("not_control_owner", "set_qpos", **name, qpos=[0.0])
    await bench.wire.refused("not_control_owner", "set_twist", articulation=key, linear=[0.0, 0.0, 0.0])
    await bench.wire.refused("unknown_articulation", "set_twist", articulation="nobody", linear=[0.0, 0.0, 0.0])


@check("Beta 22", group=PLAY, dialects=BETA, needs=("robots",))
async def open_to_all(bench: Bench) -> None:
    """Resets, modes and forward need no claim"""
    key = bench.robot.key
    bench.later("claim_control", articulation=key)
    await bench.wire.ask("release_control", articulation=key)
    await bench.direct()
    await bench.wire.ask("forward")


@check("Beta 26", "Beta 27", "Beta 93", group=PLAY, dialects=BETA)
async def leases(bench: Bench) -> None:
    """One lease at a time is given, which shows in the handshake; one of 0 seconds is free at once"""
    first = await bench.wire.raw("acquire_lease", owner="urlab conformance")
    if first.get("code") == "busy":
        raise NotTried("needs a server without a lease")
    same("op", "acquire_lease_ok", first.get("op"))
    bench.later("release_lease", lease_id=first["lease_id"])
    same("ttl_s", 60.0, float(first["ttl_s"]))
    refusal = await bench.wire.refused("busy", "acquire_lease", owner="urlab conformance")
    same("lease_id", first["lease_id"], refusal.get("lease_id"))
    await bench.greet()
    same("instance.busy", True, bench.plain_hello["instance"]["busy"])
    await bench.wire.refused("bad_request", "release_lease", lease_id="nothing")
    await bench.wire.ask("release_lease", lease_id=first["lease_id"])
    await bench.greet()
    same("instance.busy after the release", False, bench.plain_hello["instance"]["busy"])
    for _ in range(2):
        await bench.wire.ask("acquire_lease", owner="urlab conformance", ttl_s=0.0)
    await bench.wire.refused("bad_request", "release_lease", lease_id="")


@check("Beta 46", group=PLAY, dialects=BETA, needs=("robots",))
async def undeclared_channels(bench: Bench) -> None:
    """Writing an undeclared user channel succeeds and says so"""
    reply = await bench.wire.ask("set_user_channels", arts={bench.robot.key: {"no_such_channel": 1.0}})
    same("applied", 0, int(reply["applied"]))
    holds("no_such_channel" in str(reply["rejected"]), "the channel among those rejected", reply["rejected"])


# Streams


@check("Beta 43", "Transports 3.3", group=PLAY, dialects=BETA)
async def snapshots(bench: Bench) -> None:
    """In live mode only snapshots come, with the beta's fields"""
    await _live(bench, paused=False)
    messages = await bench.state_messages(5)
    holds(messages, f"messages at {bench.state_endpoint}", "none within 5 s")
    same("topics", {b"state/full"}, {message.topic for message in messages})
    snapshot = decoded(messages[-1])
    fields = {"op", "time", "step", "sim_time", "wall_time", "arts", "scene"}
    same("fields", fields, snapshot.keys() - {"user"})
    times = [float(decoded(message)["time"]) for message in messages]
    holds(times == sorted(times), "growing times", times)
    same("robots", {robot.key for robot in bench.robots} - snapshot["arts"].keys(), set())


@check("Beta 44", "Session 10.3", group=PLAY, dialects=BETA)
async def silence(bench: Bench) -> None:
    """In direct mode the state stream is silent"""
    await bench.direct()
    await asyncio.sleep(0.3)

    async def steps() -> None:
        await asyncio.sleep(0.4)
        await bench.wire.ask("step", n_steps=3)

    messages, _ = await asyncio.gather(bench.state_messages(1, 1.0), steps())
    same("messages", 0, len(messages))


@check("Transports 3.1", "Transports 3.3", group=PLAY, dialects=("alpha", "june"))
async def tick(bench: Bench) -> None:
    """A tick has the rows of the handshake's robots, and ends in a snapshot at level standard"""
    await _live(bench, paused=False)
    messages = await bench.state_messages(3)
    holds(messages, f"messages at {bench.state_endpoint}", "none within 5 s")
    keys = {robot.key for robot in bench.robots}
    for message in messages:
        try:
            topic = StreamTopic.parse(message.topic)
        except ProtocolError as error:
            raise Differs("a topic of the wire", str(error)) from error
        rows = topic.kind in {TopicKind.JOINT, TopicKind.BASE_STATE, TopicKind.SENSOR, TopicKind.TWIST}
        holds(not rows or topic.owner in keys, f"a row of {sorted(keys)}", message.topic)
    snapshot = decoded(messages[-1])
    fields = {"op", "time", "step", "sim_time", "wall_time", "per_articulation", "entities"}
    same("fields of state/full", fields, set(snapshot))
    for robot in bench.robots:
        state = snapshot["per_articulation"].get(robot.key)
        holds(state and {"qpos", "qvel", "ctrl", "act", "sensors"} <= state.keys(), f"{robot.key} at standard", state)


@check("Transports 3.2", group=PLAY, dialects=("alpha", "june"), needs=("robots", "model"))
async def rows(bench: Bench) -> None:
    """Rows have the stated lengths, and the values of the snapshot behind them"""
    await _live(bench, paused=True)
    await bench.wire.ask("reset")
    await asyncio.sleep(0.3)
    messages = await bench.state_messages(3)
    ends = [i for i, message in enumerate(messages) if message.topic == b"state/full"]
    holds(len(ends) >= 2, "two ticks", len(ends))
    model = bench.compiled
    states = bench.states(decoded(messages[ends[-1]]))
    owners = {robot.key: robot for robot in bench.robots}
    seen = 0
    for message in messages[ends[-2] + 1 : ends[-1]]:
        topic = StreamTopic.parse(message.topic)
        robot = owners.get(topic.owner)
        try:
            row = decode_row(topic, message.payload)
        except ProtocolError as error:
            raise Differs(f"a row of {topic}", str(error)) from error
        if robot is None:
            continue
        qpos = np.array(states[robot.key]["qpos"])
        if isinstance(row, JointRow):
            at = np.flatnonzero(robot.layout.qpos_adr == model.jnt_qposadr[row.id])
            same(f"position of {topic}", qpos[at[:1]], np.array([row.position]), _ROW)
        elif isinstance(row, BaseStateRow):
            same(f"quaternion of {topic}, w x y z", qpos[3:7], np.roll(row.quat_xyzw, 1), _ROW)
            same(f"position of {topic}", qpos[:3], np.asarray(row.position), _ROW)
        elif isinstance(row, SensorRow):
            same(f"length of {topic}", int(model.sensor_dim[row.id]), len(row.values))
        else:
            continue
        seen += 1
    holds(seen, "rows of joints or sensors", "none")


@check("Transports 3.4", "Session 10.3", group=PLAY, dialects=ALPHA)
async def direct_snapshots(bench: Bench) -> None:
    """In direct mode a step is followed by its snapshot, without rows"""
    await bench.direct()
    await asyncio.sleep(0.3)
    target = 0.0

    async def steps() -> None:
        nonlocal target
        await asyncio.sleep(0.4)
        for _ in range(3):
            target = float((await bench.wire.ask("step", n_steps=2))["time"])
            await asyncio.sleep(0.05)

    messages, _ = await asyncio.gather(bench.wire.listen(bench.state_endpoint, 1.5, lambda _: False), steps())
    same("topics", {b"state/full"}, {message.topic for message in messages})
    times = [float(decoded(message)["time"]) for message in messages]
    holds(target in times, f"a snapshot of time {target}", times[-5:])


@check("Transports 6.7", group=PLAY, needs=("shm",))
async def state_region(bench: Bench) -> None:
    """The state region has the snapshots of live mode"""
    await _live(bench, paused=False)
    await asyncio.sleep(0.3)
    path = Path(bench.plain_hello["shm_session_dir"]) / shm.STATE_FILE
    try:
        region = path.read_bytes()
    except OSError as error:
        raise Differs(f"{shm.STATE_FILE}", str(error)) from error
    header = shm.parse_header(region)
    holds(header.sequence > 0, "a publication", header.sequence)
    start = shm.HEADER_SIZE + header.latest_idx * header.stride
    size = int.from_bytes(region[start : start + 4], "little")
    try:
        snapshot = plain(region[start + 4 : start + 4 + size])
    except ValueError as error:
        raise Differs("a snapshot", str(error)) from error
    same("op", "state_full", snapshot.get("op"))


@check("Fields 1", "Session 3.1", "Session 11", last=True)
async def every_reply(bench: Bench) -> None:
    """Every reply of this run so far has the declared fields, float64 numbers, and known codes"""
    same("undeclared codes", {}, {code: op for code, op in bench.wire.refusals.items() if code not in RPC_ERRORS})
    same("numbers that are not float64", {}, bench.wire.numbers)
    same("departures from the declarations", {}, {op: sorted(lines) for op, lines in bench.wire.odd.items()})
