"""A server of the beta, written from the description of its wire and from nothing else of this project.

It shares neither code nor dialect tables with the simulated server, so that a misreading in those does not pass for
the truth. Physics is a counter: what is tested against it is what the client says and makes of the answers.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from functools import cache
from typing import Any

import mujoco
import numpy as np
from scripted import ScriptedServer

__all__ = ["BETA_OPS", "ScriptedBeta"]

Request = dict[str, Any]
Reply = dict[str, Any]

_RUNTIME = (
    "set_mode set_paused set_sim_speed set_control_source set_twist set_qpos set_mocap_pose read_mocap_pose "
    "get_contacts list_keyframes configure_controller set_sim_options claim_control release_control "
    "set_user_channels set_camera_streaming set_camera_delay"
)
_SCENE = (
    "import_xml create_level ensure_manager destroy_asset current_level snapshot duplicate_actor actor_hierarchy "
    "load_level save_level spawn_actor spawn_grid spawn_light remove_actor set_actor_transform op_status"
)
_UPLOAD = "upload_model_manifest upload_model_chunk upload_model_commit"
BETA_OPS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("step", "reset"), ("manager_required", "")),
    "forward": ("manager_required", "runtime"),
    **dict.fromkeys(_RUNTIME.split(), ("manager_required", "runtime")),
    **dict.fromkeys(_SCENE.split(), ("editor_only", "scene")),
    **dict.fromkeys(_UPLOAD.split(), ("no_manager", "scene")),
    **dict.fromkeys(("begin_pie", "stop_pie", "pie_status"), ("editor_only", "sim")),
    **dict.fromkeys(("list_actors", "find_actors", "list_blueprints"), ("editor_only", "outliner")),
    **dict.fromkeys(("acquire_lease", "release_lease"), ("no_manager", "farm")),
}
"""Category and namespace of the ops that it lists."""

ROBOT = """
<mujoco model="arm">
  <option timestep="0.002"/>
  <worldbody>
    <body name="hand">
      <joint name="j" type="hinge" axis="0 1 0" damping="1"/>
      <geom size="0.1"/>
      <camera name="wrist"/>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="j"/></actuator>
  <sensor><jointpos name="at" joint="j"/></sensor>
  <keyframe><key name="up" qpos="1" ctrl="0"/></keyframe>
</mujoco>
"""

# Engine's object name, actor id, public name.
ROBOTS = (("arm_C_0", "arm a", "arm_a"), ("arm_C_1", "", "arm_C_1"))

SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <asset>
    <model name="arm_C_0_" file="arm_C_0_model.xml"/>
    <model name="arm_C_1_" file="arm_C_1_model.xml"/>
  </asset>
  <worldbody>
    <frame pos="0 0 1" quat="1 0 0 0"><attach model="arm_C_0_" prefix="arm_C_0_"/></frame>
    <frame pos="1 0 1" quat="1 0 0 0"><attach model="arm_C_1_" prefix="arm_C_1_"/></frame>
    <body name="crate" pos="0 2 0"><freejoint name="crate_free"/><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""
ASSETS = {f"{name}_model.xml": ROBOT.encode() for name, _, _ in ROBOTS}


@cache
def _compiled() -> tuple[bytes, int, int]:
    model = mujoco.MjModel.from_xml_string(SCENE, ASSETS)
    buffer = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes(), model.nq, model.nv


class ScriptedBeta(ScriptedServer):
    """Answers as the beta does; a test changes `answers` where it wants something else.

    Args:
        skew: Whether it runs another MuJoCo, whose binary model cannot be loaded here.
        reads_owner: Whether it knows the field `control_owner`.
        without: Ops that it does not list.

    Attributes:
        capabilities: What its instance says it can do.
        owners: Owner by the robot's object name.
        time: Simulation time.
        frame: Number of the latest snapshot.
        ctrl: Set-points by object name.
        streaming: Whether a camera streams over ZeroMQ and over shared memory, by its name.
        jobs: Running jobs: polls left, and the result.
        running: Polls that answer `running` before a job ends.
        uploads: Bytes of the open upload's files that have arrived, by name.
    """

    def __init__(self, *, skew: bool = False, reads_owner: bool = True, without: tuple[str, ...] = ()) -> None:
        self.skew = skew
        self.capabilities = ["render_sync", "render_async", "shm_rpc", "model_upload", "content_cache"]
        self.reads_owner = reads_owner
        self.owners: dict[str, str] = {}
        self.session = ""
        self.sessions = 0
        self.playing = True
        self.mode = "live"
        self.paused = True
        self.time = 0.0
        self.steps = 0
        self.frame = 0
        self.ctrl: dict[str, list[float]] = {name: [0.0] for name, _, _ in ROBOTS}
        self.streaming: dict[str, tuple[bool, bool]] = {}
        self.jobs: dict[str, list[Any]] = {}
        self.uploads: dict[str, bytes] = {}
        self.started = 0
        self.running = 2
        self.direct_results: dict[str, Callable[[Request], Reply]] = {}
        super().__init__()
        offered = {name: told for name, told in BETA_OPS.items() if name not in without}
        self.answers = {name: self._checked(name) for name in offered}
        self.answers["hello"] = self.hello
        listed = [{"name": name, "category": told[0], "namespace": told[1]} for name, told in offered.items()]
        self.on("meta", {"op": "meta_ok", "ops": listed})

    def of(self, name: str) -> list[Request]:
        """Take all requests that arrived so far and return those of an op."""
        found: list[Request] = []
        while not self.seen.empty():
            request = self.seen.get_nowait()
            if request["op"] == name:
                found.append(request)
        return found

    def arrived(self) -> list[Request]:
        """Take all requests that arrived so far and return them."""
        found: list[Request] = []
        while not self.seen.empty():
            found.append(self.seen.get_nowait())
        return found

    # What it answers.

    def _checked(self, name: str) -> Callable[[Request], Reply]:
        def answer(request: Request) -> Reply:
            if request.get("session_id") != self.session or not self.session:
                return error("session_expired", "another client said hello")
            if BETA_OPS[name][0] == "manager_required" and not self.playing:
                return error("no_active_manager", "begin play first")
            return getattr(self, f"_{name}", self._plain)(request)

        return answer

    def _plain(self, request: Request) -> Reply:
        return {"op": f"{request['op']}_ok"}

    def hello(self, request: Request) -> Reply:
        """Open a session and describe everything."""
        self.sessions += 1
        self.session = f"{self.sessions:08d}-0000-0000-0000-000000000000"
        self.steps = 0
        return self.handshake(assets=bool(request.get("include_assets")))

    def handshake(self, *, assets: bool = False, version: str = "urlab/0.2") -> Reply:
        """The reply to `hello`."""
        mjb, _, _ = _compiled()
        reply: Reply = {
            "op": "hello_ok",
            "session_id": self.session,
            "urlab_version": version,
            "mujoco_version_int": 3011001.0 if self.skew else float(mujoco.mj_version()),
            "mujoco_version": "3.11.1" if self.skew else mujoco.mj_versionString(),
            "manager_present": self.playing,
        }
        if not self.playing:
            return {**reply, "articulations": []}
        binary = b"not for this MuJoCo" if self.skew else mjb
        reply["instance"] = self.instance()
        reply["mjb"] = binary
        reply["mjb_base64"] = base64.b64encode(binary).decode()
        reply["mjb_size"] = float(len(binary))
        if assets:
            reply["mjcf_compiled"] = SCENE
            reply["vfs_assets"] = dict(ASSETS)
        reply["articulations"] = [self.robot(*names) for names in ROBOTS]
        reply["entities"] = {}
        reply["global_cameras"] = {}
        return reply

    def instance(self) -> Reply:
        """Which server it is."""
        return {
            "instance_id": "live",
            "index": -1.0,
            "pid": 4711.0,
            "host": "lab-7",
            "step_port": float(self.port),
            "state_port": float(self.port + 1),
            "cam_base_port": float(self.port + 2),
            "manager_present": True,
            "busy": False,
            "urlab_version": "urlab/0.2",
            "capabilities": list(self.capabilities),
        }

    def robot(self, name: str, actor_id: str, public: str) -> Reply:
        """An entry of `articulations`."""
        camera = f"{public}/wrist"
        return {
            "prefix": public,
            "actor_id": actor_id,
            "actor_name": name,
            "default_control_mode": "raw",
            "actuator_types": {"m": "motor"},
            "original_names": {"actuators": {}, "joints": {}, "sensors": {}, "bodies": {}},
            "camera_topics": {
                camera: {
                    "mode": "real",
                    "resolution": [4.0, 2.0],
                    "fovy": 45.0,
                    "zmq_endpoint": f"tcp://0.0.0.0:{self.port + 2}",
                    "zmq_topic": camera,
                }
            },
        }

    def state(self, op: str) -> Reply:
        """The fields of every reply with state."""
        seconds = int(self.time)
        return {
            "op": op,
            "time": self.time,
            "step": float(self.steps),
            "sim_time": {"sec": float(seconds), "nsec": float(int((self.time - seconds) * 1e9))},
            "wall_time": {"sec": 1750000000.0, "nsec": 0.0},
        }

    def arts(self) -> Reply:
        """State of the robots."""
        return {
            public: {
                "qpos": [self.time],
                "qvel": [1.0],
                "ctrl": list(self.ctrl[name]),
                "act": [0.0],
                "sensors": {"at": [self.time]},
                "user": {"mode": "idle"},
                "twist": {"linear": [0.0, 0.0, 0.0], "angular": [0.0, 0.0, 0.0]},
                "actions": 0.0,
            }
            for name, _, public in ROBOTS
        }

    def crate(self) -> Reply:
        """State of the scene."""
        return {
            "crate": {
                "xpos": [0.0, 2.0, 0.0],
                "xquat": [1.0, 0.0, 0.0, 0.0],
                "qpos": [0.0, 2.0, 0.0, 1.0, 0.0, 0.0, 0.0],
                "qvel": [0.0] * 6,
            }
        }

    def _step(self, request: Request) -> Reply:
        commands = request.get("per_articulation") or {}
        for key, command in commands.items():
            if command.keys() & {"ctrl", "ctrl_map", "xfrc_applied"}:
                refused = self.gate(key, request)
                if refused is not None:
                    return refused
        for key, command in commands.items():
            name = found(key)
            for place, value in enumerate(command.get("ctrl", ())[:1] if name else ()):
                self.ctrl[str(name)][place] = float(value)
        if self.mode == "direct":
            self.time += 0.002 * max(1, int(request.get("n_steps", 1)))
            self.steps += max(1, int(request.get("n_steps", 1)))
            self.frame += 1
        elif self.mode == "puppet":
            self.time = float(request.get("time", 0.0))
            self.steps += 1
            self.frame += 1
        return {**self.state("step_ok"), "frame_id": float(self.frame), "arts": self.arts(), "scene": self.crate()}

    def _reset(self, request: Request) -> Reply:
        self.time, self.steps = 0.0, 0
        return {**self.state("reset_ok"), "arts": self.arts()}

    def _forward(self, request: Request) -> Reply:
        return {**self.state("forward_ok"), "arts": self.arts()}

    def _set_mode(self, request: Request) -> Reply:
        wanted = {"streaming": "live", "auto": "live"}.get(request["mode"], request["mode"])
        if wanted not in {"live", "direct", "puppet"}:
            return error("bad_mode", wanted)
        previous, self.mode = self.mode, wanted
        if previous != wanted and wanted != "live":
            self.paused = False
        return {"op": "set_mode_ok", "previous_mode": previous, "current_mode": wanted}

    def _set_paused(self, request: Request) -> Reply:
        self.paused = bool(request["paused"])
        return {"op": "set_paused_ok", "paused": self.paused}

    # Claims.

    def owner(self, request: Request) -> str:
        """In whose name a request comes."""
        return (self.reads_owner and request.get("control_owner")) or request["session_id"]

    def gate(self, key: str, request: Request) -> Reply | None:
        """Refuse a write to a robot that is not the writer's."""
        name = found(key)
        holder = self.owners.get(name, "(unclaimed)") if name else "(unclaimed)"
        if holder == self.owner(request):
            return None
        return error("not_control_owner", f"{key} is not yours", owner=holder)

    def _claim_control(self, request: Request) -> Reply:
        name = found(request["articulation"])
        if name is None:
            return error("unknown_articulation", request["articulation"])
        holder, wants = self.owners.get(name), self.owner(request)
        if holder not in {None, wants} and not request.get("force"):
            return error("control_claimed", f"{name} belongs to {holder}", owner=holder)
        self.owners[name] = wants
        return {"op": "claim_control_ok", "articulation": name, "owner": wants, "ttl_s": request.get("ttl_s", 0.0)}

    def _release_control(self, request: Request) -> Reply:
        name = found(request["articulation"])
        if name is None:
            return error("unknown_articulation", request["articulation"])
        refused = self.gate(name, request)
        if refused is not None:
            return refused
        del self.owners[name]
        return {"op": "release_control_ok", "articulation": name}

    def _set_twist(self, request: Request) -> Reply:
        if found(request["articulation"]) is None:
            return error("unknown_articulation", request["articulation"])
        return self.gate(request["articulation"], request) or {
            "op": "set_twist_ok",
            "articulation": request["articulation"],
            "linear": [0.0, 0.0, 0.0],
            "angular": [0.0, 0.0, 0.0],
        }

    def _set_qpos(self, request: Request) -> Reply:
        by_name = request.get("target_by") == "actor_name"
        name = found(request["target"]) if by_name else next((n for n, i, _ in ROBOTS if i == request["target"]), None)
        if name is None:
            return error("unknown_articulation", request["target"])
        return self.gate(name, request) or {
            "op": "set_qpos_ok",
            "target": request["target"],
            "actor_name": name,
            "actor_id": next(actor_id for known, actor_id, _ in ROBOTS if known == name),
            "qpos": [float(value) for value in request["qpos"]],
            "free_base_shortcut": False,
        }

    def _set_control_source(self, request: Request) -> Reply:
        key = request.get("articulation")
        if key is not None:
            return self.gate(key, request) or {"op": "set_control_source_ok", "source": "zmq", "scope": "articulation"}
        if any(holder != self.owner(request) for holder in self.owners.values()):
            return error("not_control_owner", "somebody controls a robot", owner=next(iter(self.owners.values())))
        return {"op": "set_control_source_ok", "source": request["source"], "scope": "global"}

    def _set_user_channels(self, request: Request) -> Reply:
        return {"op": "set_user_channels_ok", "applied": 1.0, "rejected": {"arm_a/nope": "undeclared_or_kind_mismatch"}}

    # Cameras.

    def known_cameras(self, request: Request) -> Reply:
        """What a request says of the cameras that there are, by their own names."""
        names = {f"{public}/wrist".lower(): f"{public}/wrist" for _, _, public in ROBOTS}
        return {names[name.lower()]: how for name, how in request["cameras"].items() if name.lower() in names}

    def _set_camera_streaming(self, request: Request) -> Reply:
        cameras: Reply = {}
        for name, how in self.known_cameras(request).items():
            both = bool(how) if not isinstance(how, dict) else not how
            zmq = both or (isinstance(how, dict) and bool(how.get("zmq")))
            shm = both or (isinstance(how, dict) and bool(how.get("shm")))
            self.streaming[name] = (zmq, shm)
            cameras[name] = {"streaming": zmq or shm, "zmq": zmq, "shm": shm}
            if zmq:
                cameras[name] |= {"zmq_endpoint": f"tcp://127.0.0.1:{self.port + 2}", "zmq_topic": name}
        return {"op": "set_camera_streaming_ok", "cameras": cameras}

    def _set_camera_delay(self, request: Request) -> Reply:
        cameras = {
            name: {
                "delay_s": float(how.get("delay_s", 0.0)),
                "jitter_s": float(how.get("jitter_s", 0.0)),
                "clock": how.get("clock", "sim"),
                "on_state_change": how.get("on_state_change", True),
                "max_fps": float(how.get("max_fps", 0.0)),
            }
            for name, told in self.known_cameras(request).items()
            for how in (told if isinstance(told, dict) else {"delay_s": told},)
        }
        return {"op": "set_camera_delay_ok", "cameras": cameras}

    # Editor.

    def job(self, result: Reply) -> Reply:
        """Begin a job that ends with a result."""
        self.started += 1
        self.jobs[f"job_{self.started}"] = [self.running, result]
        return {"op": "op_started", "job_id": f"job_{self.started}", "state": "running"}

    def _op_status(self, request: Request) -> Reply:
        name = request["job_id"]
        if name not in self.jobs:
            return error("unknown_job", f"{name} is not known")
        left, result = self.jobs[name]
        if left:
            self.jobs[name][0] -= 1
            return {"op": "op_status_ok", "job_id": name, "state": "running"}
        del self.jobs[name]
        state = "failed" if result["op"] == "error" else "done"
        return {"op": "op_status_ok", "job_id": name, "state": state, "result": result}

    def _import_xml(self, request: Request) -> Reply:
        return self.job(
            {
                "op": "import_xml_ok",
                "blueprint_class_path": "/Game/MuJoCoImports/arm.arm_C",
                "blueprint_short_name": "arm",
                "imported_now": True,
            }
        )

    # Models over the wire: one upload, of which everything is missing.

    def _upload_model_manifest(self, request: Request) -> Reply:
        self.uploads.clear()
        return {
            "op": "upload_model_manifest_ok",
            "upload_id": "upload_1",
            "need_xml": True,
            "need_assets": [asset["name"] for asset in request["assets"]],
        }

    def _upload_model_chunk(self, request: Request) -> Reply:
        name = request.get("name") or "<xml>"
        data = self.uploads[name] = self.uploads.get(name, b"") + request["data"]
        return {
            "op": "upload_model_chunk_ok",
            "name": name,
            "received": float(len(data)),
            "complete": len(data) == request["total"],
        }

    def _upload_model_commit(self, request: Request) -> Reply:
        return {
            "op": "upload_model_commit_ok",
            "imported": True,
            "blueprint_class_path": "/Game/MuJoCoImports/model.model_C",
            "blueprint_short_name": "model",
        }

    def _remove_actor(self, request: Request) -> Reply:
        if request["target"] == "nobody":
            return self.job(error("destroy_failed", "no such actor"))
        return self.job({"op": "remove_actor_ok", "requires_pie_restart": True})

    def _current_level(self, request: Request) -> Reply:
        return {"op": "current_level_ok", "level_path": "/Game/Levels/lab"}

    def _pie_status(self, request: Request) -> Reply:
        return {"op": "pie_status_ok", "state": "ready" if self.playing else "off", "compile_error": ""}

    def _begin_pie(self, request: Request) -> Reply:
        if not self.playing:
            self.playing, self.mode, self.paused = True, "live", True
            self.time, self.steps, self.frame = 0.0, 0, 0
            self.owners.clear()
            self.streaming.clear()
        return {
            "op": "begin_pie_ok",
            "state": "ready",
            "compile_error": "",
            "handshake_payload": self.handshake(version="urlab/0.1"),
        }

    def _stop_pie(self, request: Request) -> Reply:
        self.playing = False
        self.owners.clear()
        return {"op": "stop_pie_ok"}


def error(code: str, message: str, **more: Any) -> Reply:
    """An error reply."""
    return {"op": "error", "code": code, "message": message, **more}


def found(key: str) -> str | None:
    """The object name of a robot, by any of its three names, letter case ignored."""
    wanted = key.lower()
    return next((names[0] for names in ROBOTS if wanted in {name.lower() for name in names if name}), None)
