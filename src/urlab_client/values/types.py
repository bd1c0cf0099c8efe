"""Typed values of play that the API hands to users or takes from them: msgspec Structs; positions are metres."""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from urlab_client.enums import PIEState
from urlab_client.values.plain import Serializable
from urlab_client.values.rotation import Quat, Vec3


class PIEStartResult(Serializable, Struct):
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


class UploadProgress(Serializable, Struct, frozen=True, kw_only=True):
    """How far `scene.upload_model` is.

    Attributes:
        file: File that a piece was sent of.
        sent_bytes: Bytes sent so far.
        total_bytes: Bytes to send altogether: what the server lacks of the model.
    """

    file: str
    sent_bytes: int
    total_bytes: int


class PIEStatus(Serializable, Struct, frozen=True):
    """Where Play-In-Editor stands.

    Attributes:
        state: The state.
        compile_error: MuJoCo's message after a failed compile, else empty.
        sim_time: Simulation time in seconds, when the simulation has data.
    """

    state: PIEState
    compile_error: str = ""
    sim_time: float | None = None


class SimOptions(Serializable, Struct, omit_defaults=True):
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


class CameraPose(Serializable, Struct, frozen=True):
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


class KeyframeInfo(Serializable, Struct, frozen=True):
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


class Contact(Serializable, Struct, frozen=True):
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


class JobStatus(Serializable, Struct, frozen=True):
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


class ContactsResult(Serializable, Struct, frozen=True):
    """Active contacts at one moment.

    Attributes:
        n_contacts: Length of `contacts`.
        truncated: True if more contacts matched than were asked for.
        contacts: In the order of `mjData.contact`.
    """

    n_contacts: int
    truncated: bool
    contacts: list[Contact]


class MocapPose(Serializable, Struct, frozen=True):
    """Stored pose of a mocap body.

    Attributes:
        body: Name of the body, as it was asked for.
        pos: Position, metres, world frame.
        quat: Unit quaternion (w, x, y, z), world frame.
    """

    body: str
    pos: Vec3
    quat: Quat


class RecordingHandle(Serializable, Struct, frozen=True):
    """A running recording.

    Attributes:
        name: Session name as the server calls it.
        max_duration_s: Length of the rolling window in seconds of simulation time; infinite when unlimited.
    """

    name: str
    max_duration_s: float


class RecordingSummary(Serializable, Struct, frozen=True):
    """A finished recording.

    Attributes:
        frame_count: Frames; the plugin counts some twice.
        sim_duration_s: Last minus first timestamp, seconds of simulation time.
    """

    frame_count: int
    sim_duration_s: float


class ReplaySession(Serializable, Struct, frozen=True):
    """A loaded replay session.

    Attributes:
        name: Session name.
    """

    name: str


class ReplayStatus(Serializable, Struct, frozen=True):
    """A started replay.

    Attributes:
        active_session: Session name.
        total_frames: Frames in it.
    """

    active_session: str
    total_frames: int = 0
