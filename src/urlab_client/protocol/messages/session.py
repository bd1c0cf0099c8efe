"""Ops of the client itself: `hello`, `meta`, `step`, `reset`, `forward`, and the state blocks they share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, TypeAlias

import msgspec
from msgspec import Struct, field

from urlab_client.enums import CameraMode
from urlab_client.protocol.base import ControlRequest, Effect, Floats, Int32, Needs, Op, QuatWXYZ, Reply, Request, doc
from urlab_client.values import html
from urlab_client.values.pictures import Pixels, decode_camera, shown_png, thumbnail
from urlab_client.values.plain import Serializable
from urlab_client.values.rotation import Vec3

NOT_SENT: Final = msgspec.Raw()
"""Value of an undecoded field that is absent; encoding omits a field that holds this very object."""


# Some servers omit these fields, the simulated one never does: msgspec omits only defaults made by `dict` and `list`.
def _empty_map() -> dict[str, Any]:
    return {}


def _empty_list() -> list[Any]:
    return []


class ErrorReply(Reply, tag="error", kw_only=True, omit_defaults=True):
    """The server refused a request."""

    code: Annotated[str, doc("Short stable code.")]
    message: Annotated[str, doc("Human-readable text; absent from one plugin reply.")] = ""
    absolute_path: Annotated[str | None, doc("Path that `recording_save` could not write.")] = None
    owner: Annotated[str | None, doc("Owner of the robot, or `(unclaimed)`; with a refused claim or write.")] = None
    lease_id: Annotated[str | None, doc("Lease of the holder, with code `busy`.")] = None


class Clock(Serializable, Struct, kw_only=True, frozen=True):
    """A point in time as two integers, truncated, not rounded."""

    sec: Annotated[int, doc("Whole seconds.")]
    nsec: Annotated[int, doc("Nanoseconds within the second.")]


class TwistState(Serializable, Struct, kw_only=True):
    """The last commanded twist, not a measured velocity."""

    linear: Annotated[Vec3, doc("(vx, vy, 0), m/s, base frame.")]
    angular: Annotated[Vec3, doc("(0, 0, yaw rate), rad/s, base frame.")]


class BodyPose(Serializable, Struct, kw_only=True):
    """World pose of one body."""

    xpos: Annotated[Vec3, doc("Position, metres, world frame.")]
    xquat: QuatWXYZ


class ArticulationState(Serializable, Struct, kw_only=True, omit_defaults=True, eq=False):
    """State of one articulation. Arrays follow its joints or actuators in ascending MuJoCo id."""

    qpos: Annotated[Floats, doc("Joint positions, shape (nq of the articulation,).")]
    qvel: Annotated[Floats, doc("Joint velocities, shape (nv of the articulation,).")]
    ctrl: Annotated[
        Floats | None,
        doc(
            "`mjData.ctrl`, as applied after any controller: the inputs of each actuator, nearly always one, in "
            "actuator order. Level standard."
        ),
    ] = None
    act: Annotated[
        Floats | None,
        doc("First activation of the actuator of each input, 0 if stateless; ordered as `ctrl`. Level standard."),
    ] = None
    sensors: Annotated[
        dict[str, list[float]] | None, doc("Raw `sensordata` by unprefixed sensor name. Level standard.")
    ] = None
    user: Annotated[
        dict[str, Any] | None, doc("User channels that the robot declares, by name. Level standard, from the beta on.")
    ] = None
    bodies: Annotated[dict[str, BodyPose] | None, doc("World pose by unprefixed body name. Level full.")] = None
    actuator_force: Annotated[
        Floats | None,
        doc("`mjData.actuator_force`: the outputs of each actuator, nearly always one, in actuator order. Level full."),
    ] = None
    twist: Annotated[TwistState | None, doc("Commanded twist, at every level.")] = None
    actions: Annotated[int | None, doc("Bit field of pressed action keys, bits 0 to 9.")] = None


class EntityState(Serializable, Struct, kw_only=True, omit_defaults=True, eq=False):
    """State of one dynamic body outside any articulation."""

    xpos: Annotated[Vec3, doc("Position, metres, world frame.")]
    xquat: QuatWXYZ
    qpos: Annotated[Floats | None, doc("Free joint position, shape (7,): xyz, quaternion wxyz.")] = None
    qvel: Annotated[Floats | None, doc("Free joint velocity, shape (6,): linear world, angular body frame.")] = None


class CameraFrame(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Pixels of one camera, top row first."""

    width: Annotated[int, doc("Pixels per row.")]
    height: Annotated[int, doc("Rows.")]
    frame_id: Annotated[int | None, doc("Snapshot of the state that the picture shows; the alpha sends none.")] = None
    sim_time: Annotated[float | None, doc("Its simulation time, seconds; the alpha sends none.")] = None
    dtype: Annotated[str, doc("`bgra8`, or `float32` for depth in centimetres.")]
    data: Annotated[bytes, doc("width * height * 4 bytes.")]

    def _repr_png_(self) -> bytes | None:
        return shown_png(*_pixels(self))

    def _repr_html_(self) -> None:  # the picture itself says more than a table
        return None


def _pixels(frame: CameraFrame) -> tuple[Pixels, CameraMode]:
    mode = CameraMode.DEPTH if frame.dtype == "float32" else CameraMode.REAL
    return decode_camera(frame.data, mode, frame.width, frame.height).pixels, mode


class Perturbation(Serializable, Struct, kw_only=True, eq=False):
    """A mouse drag in the editor's viewport."""

    body_id: Annotated[int, doc("MuJoCo body id, above 0.")]
    version: Annotated[int, doc("Grows with each sample.")]
    xfrc: Annotated[Floats, doc("(fx, fy, fz, tx, ty, tz), N and N m, world frame, at the body's centre of mass.")]


class StateReply(Reply, kw_only=True, omit_defaults=True):
    """Common fields of the replies to `step`, `reset` and `forward`."""

    time: Annotated[float, doc("`mjData.time`, seconds.")]
    step: Annotated[int, doc("Step counter of the session; constant in live mode.")]
    per_articulation: Annotated[dict[str, ArticulationState], doc("State by articulation key.")] = field(
        default_factory=_empty_map
    )
    sim_time: Annotated[Clock | None, doc("`time` as two integers.")] = None
    wall_time: Annotated[Clock | None, doc("UTC when the reply was built.")] = None
    arts: Annotated[
        dict[str, ArticulationState] | None, doc("The beta's field for `per_articulation`, which then is the same.")
    ] = None

    def __post_init__(self) -> None:
        """Give replies of both generations the same shape."""
        if self.arts is not None:
            self.per_articulation = self.arts

    def __repr__(self) -> str:  # one line, without arrays and pixels
        robots = ", ".join(self.per_articulation) or "no robots"
        return f"<{type(self).__name__} step {self.step} at {self.time:.3f} s: {robots}>"


class ReplayProgress(Serializable, Struct, kw_only=True):
    """Progress of a replay."""

    current_frame: Annotated[int, doc("Index, from 0, of the newest frame reached.")]
    total_frames: Annotated[int, doc("Number of frames of the session.")]


_UPRIGHT: Final = 3


class StepOk(StateReply, tag="step_ok", kw_only=True):
    """State after the step."""

    entities: Annotated[dict[str, EntityState] | None, doc("Plain entities by name.")] = None
    cameras: Annotated[dict[str, CameraFrame] | None, doc("Frames, keyed exactly as requested.")] = None
    perturbation: Annotated[Perturbation | None, doc("Only if the project is locked to puppet mode.")] = None
    replay: Annotated[ReplayProgress | None, doc("While a recording plays; the plugin never sends it.")] = None
    frame_id: Annotated[
        int | None, doc("Number of the state snapshot, also sent with its pictures; the alpha sends none.")
    ] = None
    scene: Annotated[dict[str, EntityState] | None, doc("The beta's field for `entities`, which then is the same.")] = (
        None
    )

    def __post_init__(self) -> None:
        """See the base class."""
        super().__post_init__()
        if self.scene is not None:
            self.entities = self.scene

    def _shown(self) -> dict[str, Any]:
        shown = super()._shown()
        pictures = {name: thumbnail(*_pixels(frame), name) for name, frame in (self.cameras or {}).items()}
        robots: dict[str, dict[str, Any]] = shown["per_articulation"]
        if len(robots) <= _UPRIGHT:  # a row for each robot would be wide
            shown["per_articulation"] = {name: html.fields("", robot) for name, robot in robots.items()}
        return shown | {"time": f"{self.time:.3f} s", "sim_time": None, "wall_time": None, "cameras": pictures}


class ArticulationCommand(Serializable, Struct, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """Command of a direct or live step for one articulation."""

    ctrl: Annotated[list[float] | None, doc("Set-points, in the order of the state's `ctrl`.")] = None
    ctrl_map: Annotated[dict[str, float] | None, doc("Set-points by actuator name; overrides `ctrl`. Direct only.")] = (
        None
    )
    control_mode: Annotated[str | None, doc("`raw` bypasses the controller for this request. Direct only.")] = None
    xfrc_applied: Annotated[
        dict[str, list[float]] | None, doc("(fx, fy, fz, tx, ty, tz) by body, world frame. Direct only.")
    ] = None


CameraChoice: TypeAlias = bool | Mapping[str, str | dict[str, float] | None]
"""Pictures that a step requests: all or none, or camera name to the kind of picture."""


class Step(ControlRequest[StepOk], tag="step", kw_only=True, forbid_unknown_fields=True, eq=False):
    """Advance physics, or exchange state, according to the step mode."""

    n_steps: Annotated[Int32, doc("Sub-steps; values below 1 count as 1. Direct only.")] = 1
    observations: Annotated[str | None, doc("Observation level; sticky on the server.")] = None
    include_cameras: Annotated[
        CameraChoice,
        doc("True, or camera name to `sync`, `latest` or (not in the alpha) `{frame_id: N}` for picture N or later."),
    ] = False
    wait_cameras: Annotated[bool, doc("Wait for pictures of this step. Not in the alpha.")] = False
    render: Annotated[
        str | None, doc("`sync` renders for this step and waits, `async` does not wait. Not in the alpha.")
    ] = None
    camera_timeout_ms: Annotated[float | None, doc("Longest wait for pictures, milliseconds; 200 by default.")] = None
    per_articulation: Annotated[dict[str, ArticulationCommand] | None, doc("Commands by articulation key.")] = None
    qpos: Annotated[Floats | None, doc("Full `mjData.qpos`, shape (nq,). Puppet only.")] = None
    qvel: Annotated[Floats | None, doc("Full `mjData.qvel`, shape (nv,). Puppet only.")] = None
    ctrl: Annotated[Floats | None, doc("Full `mjData.ctrl`, shape (nu,). Puppet only.")] = None
    time: Annotated[float | None, doc("`mjData.time`, seconds; absent sets 0. Puppet only.")] = None


class ResetOk(StateReply, tag="reset_ok", kw_only=True):
    """State after the reset; `step` is 0."""


class Reset(Request[ResetOk], tag="reset", kw_only=True):
    """Reset the simulation, optionally to a keyframe, then override joints."""

    keyframe_name: Annotated[str | None, doc("Compiled keyframe name, prefix included.")] = None
    seed: Annotated[int | None, doc("Stored by the server; no effect on MuJoCo.")] = None
    per_articulation_qpos: Annotated[
        dict[str, dict[str, float]] | None, doc("First coordinate of a joint, by articulation key and joint name.")
    ] = None


class ForwardOk(StateReply, tag="forward_ok", kw_only=True):
    """State after `mj_forward`."""


class Forward(Request[ForwardOk], tag="forward", kw_only=True):
    """Run `mj_forward`: kinematics and dynamics without integration. Time and step counter do not change."""


class ControllerInfo(Serializable, Struct, kw_only=True):
    """Controller attached to an articulation."""

    kind: Annotated[str, doc("`pd`; `base` for the plugin's passthrough controller.")]
    params: Annotated[dict[str, Any], doc("Current parameters.")]
    schema: Annotated[dict[str, dict[str, Any]], doc("Parameter name to `{type, dtype, min}`.")]


class CameraInfo(Serializable, Struct, kw_only=True):
    """One camera of an articulation."""

    mode: Annotated[str, doc("`real`, `depth`, `semantic` or `instance`.")]
    resolution: Annotated[tuple[int, int], doc("(width, height), pixels.")]
    fovy: Annotated[float, doc("Vertical field of view, degrees.")]
    zmq_endpoint: Annotated[str, doc("Publisher endpoint as bound: the host may be 0.0.0.0.")]
    zmq_topic: Annotated[str, doc("Topic without the trailing space that messages carry.")]


class OriginalNames(Serializable, Struct, kw_only=True):
    """Live short name to MJCF name, for elements whose name had to change."""

    actuators: Annotated[dict[str, str], doc("Renamed actuators.")] = {}
    joints: Annotated[dict[str, str], doc("Renamed joints.")] = {}
    sensors: Annotated[dict[str, str], doc("Renamed sensors.")] = {}
    bodies: Annotated[dict[str, str], doc("Renamed bodies.")] = {}


class ArticulationInfo(Serializable, Struct, kw_only=True, omit_defaults=True):
    """One articulation as the handshake describes it."""

    prefix: Annotated[str, doc("Articulation key, no trailing underscore.")]
    actor_id: Annotated[str, doc("Stable id; empty if unset.")]
    actor_name: Annotated[
        str | None, doc("Engine's object name, the prefix of compiled names; in the alpha that is `prefix`.")
    ] = None
    default_control_mode: Annotated[str, doc("`ue_controller` with a controller attached, otherwise `raw`.")] = field(
        default_factory=str
    )
    controller: Annotated[ControllerInfo | None, doc("The attached controller.")] = None
    actuator_types: Annotated[dict[str, str], doc("Authored kind by short actuator name.")] = field(
        default_factory=_empty_map
    )
    original_names: Annotated[OriginalNames, doc("Elements that were renamed; none from the beta on.")] = field(
        default_factory=OriginalNames
    )
    camera_topics: Annotated[dict[str, CameraInfo], doc("Cameras by name; in the beta `<prefix>/<name>`.")] = field(
        default_factory=_empty_map
    )

    @property
    def compiled_prefix(self) -> str:
        """Prefix of the compiled names of its elements, without the underscore."""
        return self.prefix if self.actor_name is None else self.actor_name


class EntityInfo(Serializable, Struct, kw_only=True, omit_defaults=True):
    """One dynamic body outside any articulation."""

    id: Annotated[int, doc("MuJoCo body id.")]
    has_free_base: Annotated[bool, doc("True if its first joint is free.")]
    free_joint_id: Annotated[int | None, doc("MuJoCo joint id, if it has a free joint.")] = None
    qpos_offset: Annotated[int | None, doc("Start of its 7 values in `mjData.qpos`.")] = None
    qvel_offset: Annotated[int | None, doc("Start of its 6 values in `mjData.qvel`.")] = None
    free_joint: Annotated[str | None, doc("Name of the free joint.")] = None


class RobotEntry(ArticulationInfo, kw_only=True):
    """One entry of `entities` on servers that list robots there; entries without `prefix` are not robots."""

    prefix: Annotated[str, doc("Articulation key; empty for what is not a robot.")] = ""
    actor_id: Annotated[str, doc("Stable id; empty when unset.")] = ""


class InstanceInfo(Serializable, Struct, kw_only=True):
    """Which of several servers this is."""

    instance_id: Annotated[str, doc("Configured id, else `live` or `instance_<index>`.")] = ""
    index: Annotated[int, doc("Index among the servers of a machine; -1 for none.")] = -1
    pid: Annotated[int, doc("Process id.")] = 0
    host: Annotated[str, doc("Host name.")] = ""
    step_port: Annotated[int, doc("RPC port.")] = 0
    state_port: Annotated[int, doc("Port of the state stream; 0 when not told.")] = 0
    cam_base_port: Annotated[int, doc("First port of the cameras.")] = 0
    manager_present: Annotated[bool, doc("True while a play session runs.")] = False
    busy: Annotated[bool, doc("Whether somebody holds the driver lease.")] = False
    urlab_version: Annotated[str, doc("Server version.")] = ""
    capabilities: Annotated[list[str], doc("What it can do besides; a missing one proves nothing.")] = field(
        default_factory=list[str]
    )


class ShmRpcInfo(Serializable, Struct, kw_only=True):
    """Where requests go in shared memory."""

    session: Annotated[str, doc("Name of the regions' session.")]
    req_path: Annotated[str, doc("File of the requests.")]
    rep_path: Annotated[str, doc("File of the replies.")]
    req_event: Annotated[str, doc("Event of the requests, Windows only.")] = ""
    rep_event: Annotated[str, doc("Event of the replies, Windows only.")] = ""
    req_stride: Annotated[int, doc("Bytes per slot of the requests.")] = 0
    rep_stride: Annotated[int, doc("Bytes per slot of the replies.")] = 0
    n_buffers: Annotated[int, doc("Slots of each.")] = 2
    header_size: Annotated[int, doc("Bytes before the first slot.")] = 64


class HelloOk(Reply, tag="hello_ok", kw_only=True, omit_defaults=True):
    """The handshake."""

    session_id: Annotated[str, doc("New session id, a lower-case GUID.")]
    urlab_version: Annotated[str, doc("Server version.")]
    mujoco_version_int: Annotated[int, doc("`mj_version()` of the server.")]
    mujoco_version: Annotated[str, doc("`mj_versionString()` of the server.")]
    manager_present: Annotated[bool, doc("True while a play session runs.")]
    instance: Annotated[InstanceInfo | None, doc("Which server this is; from the beta on, during play.")] = None
    shm_session_dir: Annotated[str | None, doc("Directory of the shared state region.")] = None
    shm_rpc: Annotated[ShmRpcInfo | None, doc("Where requests go in shared memory; the alpha does not tell.")] = None
    mjb: Annotated[bytes | None, doc("The compiled model in MuJoCo's binary format.")] = None
    mjb_base64: Annotated[
        msgspec.Raw,
        doc("The same bytes as text, sent under msgpack as well; not decoded, as it is larger."),
    ] = NOT_SENT
    mjb_size: Annotated[int | None, doc("Length of `mjb` in bytes.")] = None
    mjcf_compiled: Annotated[str | None, doc("The model as MJCF, with `include_assets`.")] = None
    vfs_assets: Annotated[dict[str, bytes] | None, doc("Asset bytes by bare file name, with `include_assets`.")] = None
    articulations: Annotated[list[ArticulationInfo], doc("Empty without a play session.")] = field(
        default_factory=_empty_list
    )
    entities: Annotated[
        dict[str, EntityInfo] | list[RobotEntry] | None,
        doc("Plain entities by name. Servers after the beta list the robots here instead."),
    ] = None
    global_cameras: Annotated[dict[str, CameraInfo] | None, doc("Scene-level cameras.")] = None

    def __post_init__(self) -> None:
        """Bring a handshake of any generation into one shape."""
        if isinstance(self.entities, list):
            known = {entry.prefix for entry in self.articulations}  # with these, if made of another one's fields
            new = [entry for entry in self.entities if entry.prefix and entry.prefix not in known]
            self.articulations = [*self.articulations, *new]

    @property
    def plain_entities(self) -> dict[str, EntityInfo]:
        """The plain entities by name; none where the server does not list them."""
        return self.entities if isinstance(self.entities, dict) else {}


class Hello(Request[HelloOk], tag="hello", kw_only=True):
    """Open a session. The previous one becomes invalid immediately."""

    client_version: Annotated[str | None, doc("Name of the client, for the server's log only.")] = None
    observations: Annotated[str | None, doc("Observation level of the session; if absent, the server's.")] = None
    encoding: Annotated[str | None, doc("`json` for readable replies, otherwise msgpack.")] = None
    include_assets: Annotated[bool, doc("Also send the model as MJCF with its assets.")] = False


class OpInfo(Serializable, Struct, kw_only=True, omit_defaults=True):
    """One op in the server's list."""

    name: Annotated[str, doc("Name of the op.")]
    category: Annotated[str, doc("`editor_only`, `manager_required` or `no_manager`.")]
    namespace: Annotated[str, doc("Namespace; empty for `step` and `reset`.")]
    required_fields: Annotated[list[str] | None, doc("Fields checked before the handler runs.")] = None
    reply_fields: Annotated[list[str] | None, doc("`name:type`, `?` marks optional fields.")] = None


class MetaOk(Reply, tag="meta_ok", kw_only=True):
    """The server's list of ops."""

    ops: Annotated[list[OpInfo], doc("Every registered op except `hello` and `meta`.")]


class Meta(Request[MetaOk], tag="meta", kw_only=True):
    """List the ops that the server offers. Needs no session."""


OPS: Final = (
    Op(request=Hello, method="discover", needs=Needs.NOTHING, effect=Effect.READ, timeout=30.0),
    Op(request=Meta, needs=Needs.NOTHING, effect=Effect.READ),
    Op(
        request=Step,
        needs=Needs.MANAGER,
        # Above the server's own limit of 5 s; otherwise its step_timeout would arrive too late.
        timeout=6.5,
        hot=True,
        errors=("not_control_owner", "step_timeout"),
        declares=(
            "op:string",
            "time:float",
            "step:int",
            "per_articulation:object",
            "sim_time:object?",
            "wall_time:object?",
        ),
    ),
    Op(
        request=Reset,
        needs=Needs.MANAGER,
        errors=("unknown_keyframe",),
        declares=("op:string", "time:float", "step:int"),
    ),
    Op(
        request=Forward,
        ns="runtime",
        needs=Needs.MANAGER,
        # Computes derived quantities and leaves the state unchanged, so repeating it has no effect.
        effect=Effect.READ,
        declares=("op:string", "time:float", "step:int", "per_articulation:object"),
    ),
)
