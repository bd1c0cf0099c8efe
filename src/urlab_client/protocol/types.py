"""Typed values that the API hands to users or takes from them. All are msgspec Structs; positions are metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, Protocol, TypeVar

from msgspec import Struct
from msgspec.structs import asdict

from urlab_client.protocol.enums import PIEState, StepMode, Transport
from urlab_client.protocol.features import Features
from urlab_client.protocol.messages.session import InstanceInfo

__all__ = [
    "ActorBounds",
    "ActorHierarchyNode",
    "ActorInfo",
    "BlueprintInfo",
    "CameraPose",
    "ClientConfig",
    "Contact",
    "ContactsResult",
    "Diagnosis",
    "Finding",
    "JobStatus",
    "KeyframeInfo",
    "MocapPose",
    "PIEStartResult",
    "PIEStatus",
    "RecordingHandle",
    "RecordingSummary",
    "ReplaySession",
    "ReplayStatus",
    "Resync",
    "SceneActor",
    "SceneSnapshot",
    "ServerInfo",
    "SimOptions",
    "URLabAsset",
    "URLabBlueprint",
    "URLabLightHandle",
    "URLabSpawnHandle",
    "Verdict",
]

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

A_co = TypeVar("A_co", covariant=True)


class HasArticulations(Protocol[A_co]):
    """A client of either flavour."""

    @property
    def articulations_by_id(self) -> Mapping[str, A_co]: ...


class Verdict(StrEnum):
    """How serious a finding is."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


class Finding(Struct, frozen=True):
    """One thing that `client.explain()` looked at.

    Attributes:
        verdict: `OK`, `NOTE` (worth knowing) or `PROBLEM` (keeps robots from moving).
        subject: What it is about: `server`, `play`, an articulation's key, …
        text: What is the case, and what to do about it.
    """

    verdict: Verdict
    subject: str
    text: str


class Diagnosis(Struct, frozen=True):
    """What `client.explain()` found, from the sockets inwards; `print()` shows it line by line.

    Attributes:
        findings: In the order of examination.
    """

    findings: list[Finding]

    @property
    def healthy(self) -> bool:
        """Whether nothing keeps the robots from moving."""
        return all(finding.verdict is not Verdict.PROBLEM for finding in self.findings)

    def __str__(self) -> str:
        return "\n".join(f"{finding.verdict:<8}{finding.subject}: {finding.text}" for finding in self.findings)


class Resync(Struct, frozen=True, kw_only=True):
    """What `client.resync()` found out.

    Attributes:
        session_held: Whether the server still knew the session: it neither restarted nor was taken over.
        session_renewed: Whether a new session was opened: because the old one was gone, or so that a request which
            may still travel is refused when it arrives.
        playing: Whether a play session runs. Without one there is no state: `step` and `time` are 0.
        step: The server's step counter; counts from the session's beginning or the last reset.
        time: Simulation time, seconds.
        steps_sent: Steps in doubt: sent since the last reply, their own replies lost. Pushes in puppet mode.
        steps_applied: How many of those were executed; None where it cannot be known, because the session was gone or
            something else moved the counter as well.
        reset_applied: Whether a reset in doubt was executed; None if there was none, or it cannot be known.
        settled: Whether nothing that was in doubt can still take effect. False when the server has queued steps that it
            could not do yet, as after `StepTimeout`.
    """

    session_held: bool
    session_renewed: bool
    playing: bool
    step: int = 0
    time: float = 0.0
    steps_sent: int = 0
    steps_applied: int | None = None
    reset_applied: bool | None = None
    settled: bool = True


class ClientConfig(Struct, frozen=True, kw_only=True):
    """The arguments a client was made with; see `URLabClient` for their meaning."""

    address: str = "tcp://localhost"
    step_mode: StepMode = StepMode.AUTO
    step_port: int = 5559
    state_port: int = 5555
    ctrl_port: int = 5556
    info_port: int = 5557
    mujoco_version_check: bool = True
    local_model: bool = True
    rcv_timeout_ms: int = 5000
    auto_promote_step_mode: bool = True
    transport: Transport = Transport.ZMQ
    shm_dir: str | None = None
    encoding: str = "msgpack"
    server_key: str | None = None
    client_key: str | None = None
    trust_server: bool = False
    live_pictures: bool = True
    claim_control: bool = True

    def options(self) -> dict[str, Any]:
        """Return the constructor's arguments: `URLabClient(**config.options())`."""
        return asdict(self)


class ServerInfo(Struct, frozen=True, kw_only=True):
    """What a server is and can do; see `client.server`.

    Attributes:
        features: What it can do. Its `generation` is a name for people.
        instance: Which of several servers it is; None before play, and from servers that do not tell.
        urlab_version: Its version; not to be relied on.
        mujoco_version: Version of its MuJoCo.
        step_mode: What it called the step mode when the mode was last set; empty before.
    """

    features: Features
    instance: InstanceInfo | None = None
    urlab_version: str = ""
    mujoco_version: str = ""
    step_mode: str = ""

    @property
    def generation(self) -> str:
        """`alpha`, `june`, `beta`, `3`, or empty before `discover()`."""
        return self.features.generation


class URLabAsset(Struct):
    """One robot to place with `scene.apply_scene`.

    Attributes:
        actor_id: Stable id of the actor.
        xml: Absolute path of the MJCF file on the server's machine.
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w); wins over `rotation_euler`.
        rotation_euler: (roll, pitch, yaw) in degrees, Unreal's rotator convention.
        scale: Scale factors.
    """

    actor_id: str
    xml: str
    location: Sequence[float] = (0, 0, 0)
    rotation_quat: Sequence[float] | None = None
    rotation_euler: Sequence[float] | None = None
    scale: Sequence[float] = (1, 1, 1)


class URLabBlueprint(Struct, frozen=True):
    """An imported MJCF, ready for `scene.spawn_actor`.

    Attributes:
        class_path: Class path, for example `/Game/MuJoCoImports/robot.robot_C`.
        short_name: Asset name.
        imported_now: True if this call made it, False if it existed.
    """

    class_path: str
    short_name: str
    imported_now: bool


class URLabSpawnHandle(Struct, frozen=True):
    """A placed actor.

    Attributes:
        actor_id: Stable id given by the client.
        actor_name: Engine actor name; the articulation key once play runs.
        actor_path: Full object path.
        blueprint_class_path: Class path it was made from.
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame.
        was_existing: True if an existing actor was moved.
        requires_pie_restart: True if the running play session does not show it yet.
    """

    actor_id: str
    actor_name: str
    actor_path: str
    blueprint_class_path: str
    location: Vec3 = (0.0, 0.0, 0.0)
    rotation_quat: Quat = (0.0, 0.0, 0.0, 1.0)
    was_existing: bool = False
    requires_pie_restart: bool = False

    def runtime(self, client: HasArticulations[A_co]) -> A_co | None:
        """Return this actor's articulation in `client`, or None before play or while it is not part of it."""
        return client.articulations_by_id.get(self.actor_id)


class URLabLightHandle(Struct, frozen=True):
    """A placed light.

    Attributes:
        actor_id: Stable id given by the client; may be empty.
        actor_name: Engine actor name.
        actor_path: Full object path.
        kind: `directional`, `point` or `spot`.
        intensity: In Unreal's unit for that kind.
        color: Red, green, blue in [0, 1].
        location: Position in the world frame, metres.
        rotation_euler: (roll, pitch, yaw), degrees, Unreal frame.
        requires_pie_restart: True if the running play session does not show it yet.
    """

    actor_id: str
    actor_name: str
    actor_path: str
    kind: str
    intensity: float
    color: Vec3
    location: Vec3
    rotation_euler: Vec3
    requires_pie_restart: bool


class PIEStartResult(Struct):
    """How `sim.start()` ended.

    Attributes:
        state: `READY`, `COMPILE_FAILED` or `TIMEOUT`.
        compile_error: MuJoCo's message when the model was rejected.
        handshake_payload: The handshake of the new play world as plain data, without the model's bytes; the client
            has absorbed it already.
    """

    state: PIEState
    compile_error: str = ""
    handshake_payload: dict[str, Any] | None = None

    @property
    def is_ready(self) -> bool:
        """Whether the simulation is ready to be driven."""
        return self.state == PIEState.READY


class UploadProgress(Struct, frozen=True, kw_only=True):
    """How far `scene.upload_model` is.

    Attributes:
        file: File that a piece was sent of.
        sent_bytes: Bytes sent so far.
        total_bytes: Bytes to send altogether: what the server lacks of the model.
    """

    file: str
    sent_bytes: int
    total_bytes: int


class PIEStatus(Struct, frozen=True):
    """Where Play-In-Editor stands.

    Attributes:
        state: The state.
        compile_error: MuJoCo's message after a failed compile, else empty.
        sim_time: Simulation time in seconds, when the simulation has data.
    """

    state: PIEState
    compile_error: str = ""
    sim_time: float | None = None


class SimOptions(Struct, omit_defaults=True):
    """The `mjOption` fields the server exposes. None means "not mentioned".

    Attributes:
        timestep: Seconds.
        gravity: m/s^2, world frame.
        wind: m/s, world frame.
        magnetic: Magnetic flux, gauss, world frame.
        density: Density of the medium, kg/m^3.
        viscosity: Viscosity of the medium, kg/(m s).
        impratio: Ratio of frictional to normal constraint impedance.
        tolerance: Solver tolerance.
        iterations: Solver iterations at most.
        ls_iterations: Line-search iterations at most.
        integrator: `euler`, `rk4`, `implicit` or `implicitfast`.
        cone: `pyramidal` or `elliptic`.
        solver: `pgs`, `cg` or `newton`.
        noslip_iterations: No-slip solver iterations at most.
        noslip_tolerance: No-slip solver tolerance.
        ccd_iterations: Convex collision iterations at most.
        ccd_tolerance: Convex collision tolerance, metres.
        enable_multiccd: Several contacts per convex pair.
        enable_sleep: Put resting trees to sleep.
        sleep_tolerance: Velocity below which a tree may sleep.
        disableflags: Raw mask `mjOption.disableflags`.
        enableflags: Raw mask `mjOption.enableflags`.
        num_worker_threads: Threads of the engine's pool; 0 is off.
        max_worker_threads: Logical cores of the server; only in replies.
    """

    timestep: float | None = None
    gravity: Vec3 | None = None
    wind: Vec3 | None = None
    magnetic: Vec3 | None = None
    density: float | None = None
    viscosity: float | None = None
    impratio: float | None = None
    tolerance: float | None = None
    iterations: int | None = None
    ls_iterations: int | None = None
    integrator: str | None = None
    cone: str | None = None
    solver: str | None = None
    noslip_iterations: int | None = None
    noslip_tolerance: float | None = None
    ccd_iterations: int | None = None
    ccd_tolerance: float | None = None
    enable_multiccd: bool | None = None
    enable_sleep: bool | None = None
    sleep_tolerance: float | None = None
    disableflags: int | None = None
    enableflags: int | None = None
    num_worker_threads: int | None = None
    max_worker_threads: int | None = None


class ActorInfo(Struct, frozen=True):
    """One actor of the world.

    Attributes:
        name: Engine actor name.
        actor_class: Short class name.
        actor_id: Stable id; empty if none.
        is_articulation: True for actors made from MJCF.
        has_quick_convert: True if it becomes a MuJoCo body through Quick Convert.
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame.
        is_static_mesh_actor: True for plain meshes.
        is_light: True for lights.
        static: Quick Convert: the body is fixed.
        complex_mesh: Quick Convert: convex decomposition.
        coacd_threshold: Quick Convert: concavity threshold.
        driven_by_unreal: Quick Convert: mocap body that follows the actor.
        friction: Quick Convert: sliding, torsional, rolling.
        label: Display name.
        tags: Actor tags, where the op reports them.
    """

    name: str
    actor_class: str
    actor_id: str
    is_articulation: bool
    has_quick_convert: bool
    location: Vec3
    rotation_quat: Quat
    is_static_mesh_actor: bool = False
    is_light: bool = False
    static: bool | None = None
    complex_mesh: bool | None = None
    coacd_threshold: float | None = None
    driven_by_unreal: bool | None = None
    friction: Vec3 | None = None
    label: str = ""
    tags: tuple[str, ...] = ()


class BlueprintInfo(
    Struct, frozen=True, rename={"class_path": "blueprint_class_path", "short_name": "blueprint_short_name"}
):
    """One articulation blueprint of the project.

    Attributes:
        class_path: Class path for `scene.spawn_actor`.
        short_name: Asset name.
        package_path: Package path.
        parent_class: Short name of the parent class.
    """

    class_path: str
    short_name: str
    package_path: str
    parent_class: str


class SceneActor(Struct, frozen=True):
    """One actor of a snapshot.

    Attributes:
        name: Engine actor name.
        label: Display name.
        actor_class: Short class name.
        actor_id: Stable id; empty if none.
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame.
        tags: Actor tags.
        is_articulation: True for actors made from MJCF.
        joints: Joint names; empty strings from a plugin outside play.
        actuators: Actuator names.
        sensors: Sensor names.
        cameras: Camera names.
    """

    name: str
    label: str
    actor_class: str
    actor_id: str
    location: Vec3
    rotation_quat: Quat
    tags: tuple[str, ...] = ()
    is_articulation: bool = False
    joints: tuple[str, ...] = ()
    actuators: tuple[str, ...] = ()
    sensors: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()


class SceneSnapshot(Struct, frozen=True):
    """Every visible actor with articulation metadata.

    Attributes:
        actors: The actors.
        in_pie: True when they come from the play world.
        level_path: Package path of the world shown.
    """

    actors: list[SceneActor]
    in_pie: bool
    level_path: str


class ActorHierarchyNode(Struct, frozen=True, rename={"actor_class": "class"}):
    """An actor and the actors attached to it.

    Attributes:
        name: Engine actor name.
        actor_class: Short class name.
        location: Position in the world frame, metres.
        children: Attached actors.
    """

    name: str
    actor_class: str
    location: Vec3
    children: list[ActorHierarchyNode]


class ActorBounds(Struct, frozen=True):
    """Axis-aligned box in the world frame, metres.

    Attributes:
        actor_name: Engine actor name.
        min: Lower corner.
        max: Upper corner.
        center: Midpoint.
        extents: Half sizes.
    """

    actor_name: str
    min: Vec3
    max: Vec3
    center: Vec3
    extents: Vec3


class CameraPose(Struct, frozen=True):
    """Pose of the editor's viewport camera; local +x looks forward, +z is up.

    Attributes:
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame.
        rotation_euler: (roll, pitch, yaw), degrees, Unreal frame.
        fov: Horizontal field of view, degrees.
    """

    location: Vec3
    rotation_quat: Quat
    rotation_euler: Vec3
    fov: float


class KeyframeInfo(Struct, frozen=True):
    """One compiled keyframe, vectors in compiled order.

    Attributes:
        name: Compiled name, prefix included; may be empty.
        time: Seconds.
        qpos: Length nq.
        qvel: Length nv.
        ctrl: Length nu.
        mocap_pos: Length 3 * nmocap, metres.
        mocap_quat: Length 4 * nmocap, (w, x, y, z) each.
    """

    name: str
    time: float
    qpos: list[float]
    qvel: list[float]
    ctrl: list[float]
    mocap_pos: list[float]
    mocap_quat: list[float]


class Contact(Struct, frozen=True):
    """One active contact.

    Attributes:
        geom1: Compiled name of the first geom; empty when unnamed.
        geom2: Compiled name of the second geom.
        body1: Compiled name of the first geom's body.
        body2: Compiled name of the second geom's body.
        pos: Contact point, metres, world frame.
        normal: Unit normal from geom 1 to geom 2, world frame.
        dist: Distance in metres; negative when penetrating.
        force: (fx, fy, fz, tx, ty, tz), N and N m, in the contact frame; fx is along the normal.
    """

    geom1: str
    geom2: str
    body1: str
    body2: str
    pos: Vec3
    normal: Vec3
    dist: float
    force: tuple[float, float, float, float, float, float]


class JobStatus(Struct, frozen=True):
    """How far an editor's job is.

    Attributes:
        job_id: Its id.
        state: `running`, `done` or `failed`; a newer server may say something else, which counts as running.
        progress: Text for people; None from servers that say nothing.
        elapsed_s: Seconds since it began, as this client counts.
    """

    job_id: str
    state: str
    progress: str | None
    elapsed_s: float


class ContactsResult(Struct, frozen=True):
    """Active contacts at one moment.

    Attributes:
        n_contacts: Length of `contacts`.
        truncated: True if more contacts matched than were asked for.
        contacts: In the order of `mjData.contact`.
    """

    n_contacts: int
    truncated: bool
    contacts: list[Contact]


class MocapPose(Struct, frozen=True):
    """Stored pose of a mocap body.

    Attributes:
        body: Compiled body name.
        pos: Position, metres, world frame.
        quat: Unit quaternion (w, x, y, z), world frame.
    """

    body: str
    pos: Vec3
    quat: Quat


class RecordingHandle(Struct, frozen=True):
    """A running recording.

    Attributes:
        name: Session name as the server calls it.
        max_duration_s: Length of the rolling window in seconds of simulation time; infinite when unlimited.
    """

    name: str
    max_duration_s: float


class RecordingSummary(Struct, frozen=True):
    """A finished recording.

    Attributes:
        frame_count: Frames; the plugin counts some twice.
        sim_duration_s: Last minus first timestamp, seconds of simulation time.
    """

    frame_count: int
    sim_duration_s: float


class ReplaySession(Struct, frozen=True):
    """A loaded replay session.

    Attributes:
        name: Session name.
    """

    name: str


class ReplayStatus(Struct, frozen=True):
    """A started replay.

    Attributes:
        active_session: Session name.
        total_frames: Frames in it.
    """

    active_session: str
    total_frames: int = 0
