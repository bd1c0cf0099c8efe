"""Where the plugin's wire falls short of the API, the client makes the API true.

The scripted plugin answers as the real one does: engine actor names as keys, no entities, depth in centimetres, frames
left out, defaults that do not rebind, a sticky observation level.
"""

from __future__ import annotations

import asyncio
import json
import pickle
from collections.abc import Callable
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest
from hello import hello_ok
from waiting import DEADLINE_S, until

import urlab_client
from urlab_client import NoActiveManager, PIEState, UnknownName, URLabPIEError, URLabVersionMismatch
from urlab_client.aio import URLabClient
from urlab_client.enums import ActuatorType, CameraMode, ControllerKind, StepMode
from urlab_client.errors import ControllerSchemaViolation, NotReady, ProtocolError, UnknownKeyframe, UnknownOp
from urlab_client.protocol.messages.session import HelloOk


def robot(key: str, x: float) -> str:
    """A two-joint robot as it is compiled in a scene: all names prefixed."""
    return f"""
      <body name="{key}_base" pos="{x} 0 1"><freejoint name="{key}_root"/>
        <geom name="{key}_g" size=".1" mass="1"/>
        <body name="{key}_upper"><joint name="{key}_elbow" range="-1 1" limited="true"/>
          <geom name="{key}_u" size=".05" pos="0 0 .2" mass=".1"/>
          <body name="{key}_lower"><joint name="{key}_wrist"/><geom name="{key}_l" size=".05" pos="0 0 .4" mass=".1"/>
        </body></body></body>"""


def actuators(key: str) -> str:
    return f"""<motor name="{key}_elbow" joint="{key}_elbow"/><position name="{key}_wrist" joint="{key}_wrist"/>"""


KEYS = ["robot", "robot_2", "arm_C_0"]
XML = f"""
<mujoco><worldbody>{"".join(robot(key, x) for x, key in enumerate(KEYS))}
  <body name="crate_MjBody" pos="0 3 1"><freejoint name="crateFreeJoint"/><geom size=".1" mass="1"/></body>
  <body name="door" mocap="true" pos="0 5 1"><geom size=".1"/></body>
  <body name="pillar" pos="0 7 1"><geom size=".1"/></body>
</worldbody>
<actuator>{"".join(actuators(key) for key in KEYS)}</actuator>
<sensor>{"".join(f'<jointpos name="{key}_elbow" joint="{key}_elbow"/>' for key in KEYS)}</sensor>
<keyframe>{"".join(f'<key name="{key}_home" time="1.5"/>' for key in ("robot", "arm_C_0"))}
<key name="robot_2_squat"/></keyframe>
</mujoco>"""

PD = {"kp": {"elbow": 100.0, "wrist": 100.0}, "kv": {"elbow": 5.0, "wrist": 5.0}}
PD |= {"torque_limit": {"elbow": 200.0, "wrist": 200.0}, "default_kp": 100.0, "default_kv": 5.0}
PD |= {"default_torque_limit": 200.0}
SCHEMA = {name: {"type": "per_joint", "dtype": "float32", "min": 0.0} for name in ("kp", "kv", "torque_limit")}
SCHEMA |= {f"default_{name}": {"type": "scalar", "dtype": "float32", "min": 0.0} for name in SCHEMA}


def camera(mode: str) -> dict[str, Any]:
    return {
        "mode": mode,
        "resolution": [2.0, 1.0],
        "fovy": 45.0,
        "zmq_endpoint": "tcp://0.0.0.0:5558",
        "zmq_topic": "robot/camera/c1",
    }


class Plugin:
    """The simulation behind a scripted server."""

    def __init__(self, scripted: Any) -> None:
        self.scripted = scripted
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.cameras: dict[str, Any] = {}
        self.mode = "live"
        self.level = "standard"
        self.step_count = 0
        self.requests: list[dict[str, Any]] = []
        for op in ("hello", "step", "reset", "forward", "set_mode", "configure_controller"):
            scripted.on(op, getattr(self, op))

    def articulation(self, key: str) -> dict[str, Any]:
        entry: dict[str, Any] = {
            "prefix": key,
            "actor_id": f"id_{key}",
            "default_control_mode": "raw",
            "actuator_types": {"elbow": "motor", "wrist": "hydraulic"},
            "original_names": {
                "actuators": {},
                "joints": {"elbow": "elbow_joint"} if key == "robot" else {},
                "sensors": {},
                "bodies": {},
            },
            "camera_topics": {"c1": camera("real"), "c10": camera("depth")} if key == "robot" else {},
        }
        if key == "robot":
            entry |= {
                "default_control_mode": "ue_controller",
                "controller": {"kind": "pd", "params": PD, "schema": SCHEMA},
            }
        if key == "robot_2":
            entry |= {
                "default_control_mode": "ue_controller",
                "controller": {"kind": "base", "params": {}, "schema": {}},
            }
        return entry

    def hello(self, request: dict[str, Any]) -> dict[str, Any]:
        self.level = request.get("observations", self.level)
        buffer = np.zeros(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        return hello_ok(
            mjb=buffer.tobytes(),
            mjb_size=float(len(buffer)),
            articulations=[self.articulation(key) for key in KEYS],
            entities={},
            global_cameras={},
        )

    def set_mode(self, request: dict[str, Any]) -> dict[str, Any]:
        previous, self.mode = self.mode, request["mode"]
        return {"op": "set_mode_ok", "previous_mode": previous, "current_mode": self.mode}

    def state(self, op: str) -> dict[str, Any]:
        blocks = {}
        for i, key in enumerate(KEYS):
            q, v = self.data.qpos[9 * i : 9 * i + 9], self.data.qvel[8 * i : 8 * i + 8]
            block: dict[str, Any] = {"qpos": q.tolist(), "qvel": v.tolist(), "actions": 0.0}
            if self.level != "minimal":
                block |= {
                    "ctrl": self.data.ctrl[2 * i : 2 * i + 2].tolist(),
                    "act": [0.0, 0.0],
                    "sensors": {"elbow": [float(q[7])]},
                }
            if self.level == "full":
                block |= {"bodies": {}, "actuator_force": [1.0, 2.0]}
            blocks[key] = block
        return {
            "op": op,
            "time": self.data.time,
            "step": float(self.step_count),
            "sim_time": {"sec": 0.0, "nsec": 0.0},
            "wall_time": {"sec": 1.0, "nsec": 100.0},
            "per_articulation": blocks,
        }

    def step(self, request: dict[str, Any]) -> dict[str, Any]:
        self.requests.append(request)
        self.level = request.get("observations", self.level)
        if self.mode == "puppet":
            self.data.qpos[:], self.data.qvel[:] = request["qpos"], request["qvel"]
            self.data.ctrl[:], self.data.time = request["ctrl"], request["time"]
            mujoco.mj_forward(self.model, self.data)
            self.step_count += 1
        else:
            mujoco.mj_step(self.model, self.data, request.get("n_steps", 1))
            self.step_count += request.get("n_steps", 1)
        reply = self.state("step_ok") | {"entities": {}}
        asked = request.get("include_cameras")
        frames = {name: frame for name, frame in self.cameras.items() if asked is True or name in (asked or {})}
        return reply | ({"cameras": frames} if frames else {})

    def reset(self, request: dict[str, Any]) -> dict[str, Any]:
        self.requests.append(request)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        return self.state("reset_ok")

    def forward(self, _: dict[str, Any]) -> dict[str, Any]:
        return self.state("forward_ok")

    def configure_controller(self, request: dict[str, Any]) -> dict[str, Any]:
        self.requests.append(request)
        params = json.loads(json.dumps(PD))
        for name, value in request["params"].items():
            params[name] = {**params[name], **value} if isinstance(value, dict) else value
        return {"op": "configure_controller_ok", "articulation": request["articulation"], "params": params}


@pytest.fixture
def plugin(scripted: Any) -> Plugin:
    return Plugin(scripted)


@pytest.fixture
def connect(scripted: Any, request: pytest.FixtureRequest) -> Callable[..., URLabClient]:
    def make(**options: Any) -> URLabClient:
        return URLabClient(f"tcp://127.0.0.1:{scripted.port}", **{"step_mode": "direct", **options})

    return make


async def test_entities_are_found_in_the_model(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        assert set(client.entities) == {*KEYS, "crate_MjBody", "door"}, "the pillar is welded to the world"
        crate, door = client.entities["crate_MjBody"], client.entities["door"]
        assert crate.has_free_base
        assert crate.free_joint == "crateFreeJoint"
        assert (crate.qpos_offset, crate.qvel_offset) == (27, 24)
        assert np.allclose(crate.root_pos_w, [0, 3, 1])
        assert not door.has_free_base
        assert door.qpos_offset is None
        assert np.allclose(door.root_pos_w, [0, 5, 1])
        assert client.entities["robot"] is client.articulations["robot"]


async def test_a_wrench_on_a_plain_entity_travels_under_its_compiled_name(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        client.entities["crate_MjBody"].apply_xfrc(force=(1, 2, 3), torque=(4, 5, 6))
        await client.step()
        await client.step()
        first, second = plugin.requests
        sent = first["per_articulation"]["crate_MjBody"]["xfrc_applied"]
        assert sent == {"crate_MjBody": [1, 2, 3, 4, 5, 6]}
        assert "crate_MjBody" not in second["per_articulation"]


async def test_a_wrench_applied_while_a_step_travels_goes_with_the_next(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        body = "crate_MjBody"
        crate = client.entities[body]
        plugin.scripted.on("step", None)
        crate.apply_xfrc(force=(1, 0, 0))
        travelling = asyncio.create_task(client.step())
        await until(plugin.scripted.held.qsize)
        crate.apply_xfrc(force=(2, 0, 0))
        plugin.scripted.on("step", plugin.step)
        plugin.scripted.release(plugin.step({}))
        await travelling
        await client.step()
        await client.step()
        sent = [request.get("per_articulation", {}).get(body) for request in plugin.requests]
        assert sent == [None, {"xfrc_applied": {body: [2, 0, 0, 0, 0, 0]}}, None]


async def test_a_wrench_whose_step_is_refused_gives_way_to_a_newer_one(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        body = "crate_MjBody"
        crate = client.entities[body]
        plugin.scripted.on("step", None)
        crate.apply_xfrc(force=(1, 0, 0))
        travelling = asyncio.create_task(client.step())
        await until(plugin.scripted.held.qsize)
        crate.apply_xfrc(force=(2, 0, 0))
        plugin.scripted.on("step", plugin.step)
        plugin.scripted.release({"op": "error", "code": "not_ready", "message": "not now"})
        with pytest.raises(NotReady):
            await travelling
        await client.step()
        await client.step()
        sent = [request.get("per_articulation", {}).get(body) for request in plugin.requests]
        assert sent == [{"xfrc_applied": {body: [2, 0, 0, 0, 0, 0]}}, None]


async def test_engine_names_are_found_by_what_users_know(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        assert client.articulations["arm"] is client.articulations["arm_C_0"]
        assert client.articulations["id_arm_C_0"] is client.articulations["arm_C_0"]
        assert client.articulations_by_id["id_robot"].prefix == "robot"
        with pytest.raises(UnknownName, match=r"no articulation 'robbot'. Did you mean 'robot'"):
            client.articulations["robbot"]
        art = client.articulations["robot"]
        assert art.resolve_joint("elbow_joint") == "elbow"
        assert art.resolve_joint("robot_elbow") == "elbow"
        assert art.resolve_actuator("nonsense") is None


async def test_names_never_bleed(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        for key in KEYS:
            art = client.articulations[key]
            assert list(art.joints) == ["root", "elbow", "wrist"]
            assert list(art.actuators) == ["elbow", "wrist"]
            assert list(art.bodies) == ["base", "upper", "lower"]
            assert list(art.sensors) == ["elbow"]
            assert art.free_joint == f"{key}_root"
        client.articulations["robot_2"].set_ctrl({"elbow": 0.5})
        await client.step()
        sent = plugin.requests[0]["per_articulation"]
        assert sent["robot_2"]["ctrl"] == [0.5, 0.0]
        assert sent["robot"]["ctrl"] == [0.0, 0.0]


async def test_unknown_enum_values_stay_strings(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        actuators = client.articulations["robot"].actuators
        assert actuators["elbow"].type is ActuatorType.MOTOR
        assert actuators["wrist"].type == "hydraulic"


async def test_controller_kinds(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        assert client.articulations["robot"].controller.kind is ControllerKind.PD
        assert client.articulations["robot_2"].controller.kind is ControllerKind.PASSTHROUGH
        assert client.articulations["arm_C_0"].controller is None


async def test_defaults_rebind_every_joint(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        controller = client.articulations["robot"].controller
        kp = controller.kp
        await controller.set_defaults(kp=250)
        assert dict(kp) == {"elbow": 250.0, "wrist": 250.0}
        assert controller.params["default_kp"] == 250.0
        assert dict(controller.kv) == {"elbow": 5.0, "wrist": 5.0}


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({"kp": {"knee": 1.0}}, "kp: no actuator 'knee'; available: elbow, wrist"),
        ({"kp": 3.0}, "kp takes a mapping"),
        ({"kp": {"elbow": "stiff"}}, r"kp\['elbow'\] takes a number"),
        ({"default_kv": -1}, "default_kv must be at least 0"),
        ({"default_kv": float("nan")}, "default_kv must be at least 0"),
        ({"default_kv": "stiff"}, "default_kv takes a number"),
        ({"stiffness": 3.0}, "no parameter is called 'stiffness'"),
    ],
)
async def test_bad_parameters_are_refused_before_sending(
    plugin: Any, connect: Any, params: dict[str, Any], problem: str
) -> None:
    async with connect() as client:
        await client.discover()
        with pytest.raises(ControllerSchemaViolation, match=problem) as info:
            await client.articulations["robot"].controller.configure(**params)
        assert info.value.code == "controller_schema_violation"
        assert info.value.message.startswith("robot: ")
        assert info.value.message.endswith("Nothing was sent.")
        assert plugin.requests == []


async def test_pixels_become_what_the_reference_says(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        cams = client.articulations["robot"].cameras
        real = {"width": 2.0, "height": 1.0, "dtype": "bgra8", "data": bytes([1, 2, 3, 0, 4, 5, 6, 7])}
        depth = {"width": 2.0, "height": 1.0, "dtype": "float32", "data": np.array([150, 25], "<f4").tobytes()}
        plugin.cameras = {"robot/c1": real, "robot/c10": depth}
        await client.step(include_cameras={"c1": "sync", "robot/c10": "latest"})
        assert cams["c1"].latest_frame.tolist() == [[[3, 2, 1, 255], [6, 5, 4, 255]]]
        assert cams["c10"].mode is CameraMode.DEPTH
        assert cams["c10"].latest_frame.dtype == np.float32
        assert cams["c10"].latest_frame.tolist() == [[1.5, 0.25]]
        assert cams["c10"].sim_time == pytest.approx(0.002)


async def test_a_camera_that_delivers_nothing_is_marked(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        one, ten = client.articulations["robot"].cameras.values()
        frame = {"width": 2.0, "height": 1.0, "dtype": "bgra8", "data": bytes(8)}
        plugin.cameras = {"c1": frame}
        await client.step(include_cameras=True)
        assert (one.delivered, ten.delivered) == (True, False)
        plugin.cameras = {}
        await client.step(include_cameras={"robot/c1": "latest"})
        assert not one.delivered
        assert one.sim_time == pytest.approx(0.002)
        await client.step()
        assert not one.delivered


async def test_a_frame_of_the_wrong_size_spoils_the_whole_reply(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        plugin.cameras = {"c1": {"width": 2.0, "height": 1.0, "dtype": "bgra8", "data": b"1234567"}}
        before = client.data.qpos.copy()
        with pytest.raises(ProtocolError, match="7 bytes, expected 8"):
            await client.step(10, include_cameras=True)
        assert client.articulations["robot"].cameras["c1"].latest_frame is None
        assert np.array_equal(client.data.qpos, before)
        assert client.sim_time == 0.0


async def test_an_unknown_camera_is_told_before_sending(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        with pytest.raises(KeyError) as told:
            await client.step(include_cameras={"c2": "sync"})
        assert str(told.value) == "no camera 'c2'. Known: 'robot/c1' and 'robot/c10'."
        with pytest.raises(KeyError, match=r"^no camera 'robot/c2'\. Did you mean 'robot/c1' or 'robot/c10'\?"):
            client.camera("robot/c2")
        assert plugin.requests == []


async def test_a_vector_of_the_wrong_length_spoils_the_whole_reply(plugin: Any, scripted: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        broken = plugin.state("step_ok")
        broken["per_articulation"]["robot"]["qpos"][0] = 99.0
        broken["per_articulation"]["arm_C_0"]["qvel"].append(1.0)
        scripted.on("step", broken)
        with pytest.raises(ProtocolError, match=r"qvel of articulation 'arm_C_0' has 9 values, but its model has 8"):
            await client.step()
        assert client.articulations["robot"].qpos_array[0] == 0.0


async def test_keyframes_by_their_short_name(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        await client.reset(keyframe_name="squat")
        assert plugin.requests[-1]["keyframe_name"] == "robot_2_squat"
        with pytest.raises(UnknownKeyframe, match="could mean 'robot_home' or 'arm_C_0_home'"):
            await client.reset(keyframe_name="home")
        with pytest.raises(UnknownKeyframe, match="Known: 'robot_home', 'arm/home' and 'squat'"):
            await client.reset(keyframe_name="sleep")


async def test_the_level_of_one_step_does_not_stick(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover(observations="minimal")
        await client.step()
        await client.step(observations="full")
        reply = await client.step()
        assert [request.get("observations") for request in plugin.requests] == [None, "full", "minimal"]
        assert reply.per_articulation["robot"].sensors is None


async def test_the_level_of_a_step_that_failed_does_not_stick(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover(observations="minimal")
        plugin.scripted.on("step", None)
        lost = asyncio.create_task(client.step(observations="full", timeout=DEADLINE_S))
        await until(plugin.scripted.held.qsize)
        lost.cancel()
        await asyncio.wait((lost,))
        plugin.step({"observations": "full"})  # it was executed all the same
        plugin.scripted.on("step", plugin.step)
        reply = await client.step()
        assert plugin.requests[-1]["observations"] == "minimal"
        assert reply.per_articulation["robot"].sensors is None


async def test_puppet_takes_set_points_and_mirrors_a_reset(plugin: Any, connect: Any) -> None:
    async with connect(step_mode="puppet") as client:
        await client.discover()
        art = client.articulations["robot"]
        art.set_ctrl({"elbow": 0.5})
        client.data.ctrl[5] = 0.25
        await client.step(3)
        assert plugin.requests[-1]["ctrl"] == [0.5, 0, 0, 0, 0, 0.25]
        assert client.data.time == pytest.approx(0.006)
        assert plugin.data.time == client.data.time
        assert np.array_equal(plugin.data.qpos, client.data.qpos)
        await client.reset()
        assert client.data.time == 0.0
        assert np.array_equal(client.data.qpos, client.model.qpos0)


async def test_a_mouse_drag_reaches_the_local_physics(plugin: Any, scripted: Any, connect: Any) -> None:
    async with connect(step_mode="puppet") as client:
        await client.discover()
        body = client.articulations["robot"].body_id
        drag = {"body_id": float(body), "version": 1.0, "xfrc": [0.0, 0.0, 50.0, 0.0, 0.0, 0.0]}
        scripted.on("step", lambda request: plugin.step(request) | {"perturbation": drag})
        await client.step()
        assert client.data.xfrc_applied[body].tolist() == drag["xfrc"]
        before = client.data.qvel[2]
        scripted.on("step", plugin.step)
        await client.step()
        assert client.data.qvel[2] > before, "the drag acts in the next local step"
        assert not client.data.xfrc_applied.any(), "and ends with it"
        scripted.on("step", lambda request: plugin.step(request) | {"perturbation": drag | {"body_id": 999.0}})
        with pytest.raises(ProtocolError, match="perturbation of body 999"):
            await client.step()


async def test_a_wrench_in_puppet_mode_warns(plugin: Any, connect: Any) -> None:
    async with connect(step_mode="puppet") as client:
        await client.discover()
        client.articulations["robot"].apply_xfrc(force=(0, 0, 1))
        with pytest.warns(UserWarning, match="inert in puppet mode"):
            await client.step()


async def test_another_mujoco_build_is_named(plugin: Any, scripted: Any, connect: Any) -> None:
    hello = plugin.hello({})
    scripted.on("hello", hello | {"mujoco_version": "3.7.0", "mujoco_version_int": 3007000.0})
    async with connect() as client:
        with pytest.raises(URLabVersionMismatch, match=r"MuJoCo 3\.7\.0.*mujoco==3\.7\.0") as info:
            await client.discover()
        assert info.value.client_version == mujoco.mj_versionString()


async def test_a_development_build_of_the_same_version_is_noticed(plugin: Any, scripted: Any, connect: Any) -> None:
    hello = plugin.hello({})
    header = bytearray(hello["mjb"])
    header[8] ^= 1
    scripted.on("hello", hello | {"mjb": bytes(header)})
    async with connect() as client:
        with pytest.raises(URLabVersionMismatch):
            await client.discover()


async def test_without_the_check_the_model_is_compiled_here(plugin: Any, scripted: Any, connect: Any) -> None:
    asked: list[bool] = []

    def hello(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request.get("include_assets", False))
        reply = plugin.hello(request) | {"mujoco_version": "3.7.0"}
        return reply | ({"mjcf_compiled": XML, "vfs_assets": {}} if asked[-1] else {})

    scripted.on("hello", hello)
    async with connect(mujoco_version_check=False) as client:
        with pytest.warns(UserWarning, match="only approximates"):
            await client.discover()
        assert asked == [False, True]
        assert client.model_is_approximate
        await client.step(5)
        assert client.articulations["robot"].root_pos_w[2] < 1.0


async def test_play_stopped_by_somebody_else(plugin: Any, scripted: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        held = client.articulations["robot"]
        scripted.on("step", {"op": "error", "code": "no_active_manager", "message": "step"})
        with pytest.raises(NoActiveManager):
            await client.step()
        assert not client.manager_present
        scripted.on("step", plugin.step)
        await client.discover()
        assert client.manager_present
        assert client.articulations["robot"] is held
        await client.step(5)
        assert held.root_pos_w[2] < 1.0


async def test_start_waits_through_compiling(plugin: Any, scripted: Any, connect: Any) -> None:
    hello = plugin.hello({})
    states = iter(["compiling", "compiling", "ready"])
    begun = iter([{"state": "timeout"}, {"state": "ready", "handshake_payload": hello}])
    scripted.on("begin_pie", lambda _: {"op": "begin_pie_ok", "compile_error": "", **next(begun)})
    scripted.on("pie_status", lambda _: {"op": "pie_status_ok", "state": next(states), "compile_error": ""})
    scripted.on("hello", {k: v for k, v in hello.items() if k != "mjb"} | {"manager_present": False})
    progress: list[PIEState] = []
    async with connect() as client:
        await client.discover()
        result = await client.sim.start(on_progress=lambda status: progress.append(status.state))
        assert result.is_ready
        assert result.handshake_payload["mujoco_version"] == mujoco.mj_versionString()
        assert progress == [PIEState.COMPILING, PIEState.COMPILING, PIEState.READY]
        assert client.step_mode is StepMode.DIRECT
        assert len(client.articulations) == 3


async def test_stop_waits_until_play_has_ended(plugin: Any, scripted: Any, connect: Any) -> None:
    states = iter(["ready", "ready", "off"])
    scripted.on("stop_pie", {"op": "stop_pie_ok"})
    scripted.on("pie_status", lambda _: {"op": "pie_status_ok", "state": next(states), "compile_error": ""})
    async with connect() as client:
        await client.discover()
        await client.sim.stop()
        assert next(states, None) is None
        assert not client.manager_present


async def test_a_step_count_that_is_none(plugin: Any, connect: Any) -> None:
    async with connect() as client:
        await client.discover()
        with pytest.raises(TypeError, match="integer"):
            await client.step("3")
        assert plugin.requests == []


async def test_a_model_that_does_not_compile(plugin: Any, scripted: Any, connect: Any) -> None:
    log = "Error: mass and inertia of moving bodies must be larger than mjMINVAL"
    scripted.on("begin_pie", {"op": "begin_pie_ok", "state": "compile_failed", "compile_error": log})
    async with connect() as client:
        await client.discover()
        with pytest.raises(URLabPIEError, match="mass and inertia") as info:
            await client.sim.start()
        assert info.value.message == log
        assert info.value.state is PIEState.COMPILE_FAILED
        assert (await client.sim.start(raise_on_failure=False)).compile_error == log


async def test_the_spawn_echo_is_corrected(plugin: Any, scripted: Any, connect: Any) -> None:
    echo = {
        "op": "spawn_actor_ok",
        "actor_id": "a",
        "actor_name": "robot_C_0",
        "actor_path": "/Game/Levels/lab.lab:PersistentLevel.robot_C_0",
        "blueprint_class_path": "/Game/MuJoCoImports/robot.robot_C",
        "was_existing": False,
        "location": [0.01, -0.02, 0.005],
        "rotation_quat": [0.0, 0.0, 0.0, 1.0],
        "requires_pie_restart": True,
    }
    scripted.on("spawn_actor", echo)
    async with connect() as client:
        await client.discover()
        handle = await client.scene.spawn_actor("/Game/MuJoCoImports/robot", "a", location=(1, 2, 0.5))
        assert handle.location == (1.0, 2.0, 0.5)


async def test_the_viewport_answers_under_another_name(scripted: Any, plugin: Any, connect: Any) -> None:
    scripted.on("set_viewport_mode", {"op": "set_mode_ok", "mode": "Lit"})
    async with connect() as client:
        await client.discover()
        assert await client.viewport.set_mode("Lit") == "Lit"


async def test_an_op_the_server_lacks_is_refused_before_sending(plugin: Any, scripted: Any, connect: Any) -> None:
    scripted.on("meta", {"op": "meta_ok", "ops": [{"name": "step", "category": "manager_required", "namespace": ""}]})
    async with connect(step_mode="auto") as client:
        await client.discover()
        with pytest.raises(UnknownOp, match="Nothing was sent") as refused:
            await client.scene.current_level()
    assert refused.value.op == "current_level"


async def test_a_server_that_cannot_list_its_ops_is_asked_for_them(plugin: Any, scripted: Any, connect: Any) -> None:
    scripted.on("meta", {"op": "error", "code": "unknown_op", "message": "meta"})
    scripted.on("current_level", {"op": "current_level_ok", "level_path": "/Game/Levels/lab"})
    async with connect() as client:
        await client.discover()
        assert await client.scene.current_level() == "/Game/Levels/lab"


async def test_a_newer_server_may_say_more(plugin: Any, scripted: Any, connect: Any) -> None:
    hello = plugin.hello({})
    hello["weather"] = {"wind": "/x"}
    hello["articulations"][0]["tint"] = [1.0, 0.0, 0.0]
    scripted.on("hello", hello)
    async with connect() as client:
        await client.discover()
        assert len(client.articulations) == 3


async def test_json_end_to_end(plugin: Any, scripted: Any, connect: Any) -> None:
    seen: list[bytes] = []

    def as_json(answer: Any) -> Any:
        def call(request: dict[str, Any]) -> bytes:
            reply = answer(request)
            if "mjb" in reply:
                import base64

                reply["mjb__b64__"] = base64.b64encode(reply.pop("mjb")).decode()
            seen.append(msgspec.json.encode(reply))
            return seen[-1]

        return call

    from urlab_client.protocol.registry import OPS

    meta = {"op": "meta_ok", "ops": [{"name": n, "category": str(o.needs), "namespace": o.ns} for n, o in OPS.items()]}
    for op in ("hello", "step", "set_mode"):
        scripted.on(op, as_json(getattr(plugin, op)))
    scripted.on("meta", as_json(lambda _: meta))
    async with connect(encoding="json") as client:
        await client.discover()
        assert scripted.request("hello")["encoding"] == "json"
        await client.step(5)
        assert client.model is not None
        assert client.articulations["robot"].root_pos_w[2] < 1.0
    assert json.loads(seen[0])["session_id"]


def test_a_client_does_not_pickle_but_its_description_does(connect: Any) -> None:
    client = connect(rcv_timeout_ms=1234)
    with pytest.raises(TypeError, match=r"client\.config"):
        pickle.dumps(client)
    assert URLabClient().step_mode is StepMode.LIVE, "until a server says otherwise"
    with pytest.raises(TypeError, match="cannot be pickled"):
        pickle.dumps(urlab_client.URLabClient())
    config = pickle.loads(pickle.dumps(client.config))
    assert config == client.config
    assert msgspec.json.decode(msgspec.json.encode(config), type=urlab_client.ClientConfig) == config
    twin = URLabClient(**config.options())
    assert twin.config == client.config
    assert urlab_client.ClientConfig(address="tcp://localhost") == URLabClient("tcp://localhost").config, "defaults"


def test_the_handshake_struct_needs_no_extras() -> None:
    hello = msgspec.convert(hello_ok(), HelloOk, strict=False)
    assert hello.mjb is None
