"""Ops of `client.runtime`: live changes to the running simulation."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, Final

from msgspec import Struct

from urlab_client.protocol.base import (
    ActorId,
    ControlRequest,
    Effect,
    Floats,
    Needs,
    Op,
    QuatWXYZ,
    Reply,
    Request,
    TargetBy,
    doc,
)
from urlab_client.values.plain import Serializable
from urlab_client.values.rotation import Vec3
from urlab_client.values.types import Contact, KeyframeInfo, MocapPose, SimOptions


class ClaimControlOk(Reply, tag="claim_control_ok", kw_only=True):
    """The client owns the robot."""

    articulation: Annotated[str, doc("Engine's object name, regardless of the requested name.")]
    owner: Annotated[str, doc("Owner: `control_owner`, or the session id if the server does not read that field.")]
    ttl_s: Annotated[float, doc("Seconds without a write after which the claim expires; 0 for never.")]


class ClaimControl(ControlRequest[ClaimControlOk], tag="claim_control", kw_only=True):
    """Become the only owner of a robot, or renew the ownership."""

    articulation: Annotated[str, doc("Articulation key, actor id or engine's object name.")]
    ttl_s: Annotated[float, doc("Seconds without a write after which the claim expires; 0 or less for never.")] = 0.0
    force: Annotated[bool, doc("Take the robot from its owner.")] = False


class ReleaseControlOk(Reply, tag="release_control_ok", kw_only=True):
    """The robot has no owner."""

    articulation: Annotated[str, doc("Engine's object name, regardless of the requested name.")]


class ReleaseControl(ControlRequest[ReleaseControlOk], tag="release_control", kw_only=True):
    """Release a robot."""

    articulation: Annotated[str, doc("Articulation key, actor id or engine's object name.")]


class SetModeOk(Reply, tag="set_mode_ok", kw_only=True):
    """The mode before and after."""

    previous_mode: Annotated[str, doc("Step mode before the call.")]
    current_mode: Annotated[str, doc("Step mode now.")]


class SetMode(Request[SetModeOk], tag="set_mode", kw_only=True):
    """Switch the step mode. Every mode except live resumes paused physics."""

    mode: Annotated[str, doc("`live`, `direct`, `puppet` or `auto`.")]


class SetPausedOk(Reply, tag="set_paused_ok", kw_only=True):
    """The resulting state."""

    paused: Annotated[bool, doc("Whether physics is paused now.")]


class SetPaused(Request[SetPausedOk], tag="set_paused", kw_only=True):
    """Pause or resume physics, and return the state in force."""

    paused: Annotated[bool, doc("True to pause.")]


class SetSimSpeedOk(Reply, tag="set_sim_speed_ok", kw_only=True):
    """The resulting pacing."""

    percent: Annotated[float, doc("Percent of real time, clamped to 5..100.")]


class SetSimSpeed(Request[SetSimSpeedOk], tag="set_sim_speed", kw_only=True):
    """Set the pacing of live mode, and return the value in force."""

    percent: Annotated[float, doc("Percent of real time; the engine clamps to 5..100.")]


class SetControlSourceOk(Reply, tag="set_control_source_ok", kw_only=True, omit_defaults=True):
    """The control source in force."""

    source: Annotated[str, doc("`zmq` or `ui`.")]
    scope: Annotated[str, doc("`global` or `articulation`.")]
    articulation: Annotated[str | None, doc("Articulation key, with that scope.")] = None


class SetControlSource(ControlRequest[SetControlSourceOk], tag="set_control_source", kw_only=True):
    """Choose the source of the set-points for the actuators: this protocol or the editor's panel."""

    source: Annotated[str, doc("`zmq` or `ui`.")]
    articulation: Annotated[str | None, doc("Articulation key, actor id or engine's object name; None for all.")] = None


class SetTwistOk(Reply, tag="set_twist_ok", kw_only=True):
    """The twist in force."""

    articulation: Annotated[str, doc("Articulation key.")]
    linear: Annotated[Vec3, doc("(vx, vy, 0), m/s.")]
    angular: Annotated[Vec3, doc("(0, 0, yaw rate), rad/s.")]


class SetTwist(ControlRequest[SetTwistOk], tag="set_twist", kw_only=True):
    """Store a commanded base velocity for policies to read; it does not drive the simulation."""

    articulation: Annotated[str, doc("Articulation key, actor id or engine's object name.")]
    linear: Annotated[Vec3, doc("(vx, vy, ignored), m/s, base frame.")] = (0.0, 0.0, 0.0)
    angular: Annotated[Vec3, doc("(ignored, ignored, yaw rate), rad/s, base frame.")] = (0.0, 0.0, 0.0)


class SetQposOk(Reply, tag="set_qpos_ok", kw_only=True, omit_defaults=True, eq=False):
    """The written positions."""

    target: Annotated[str, doc("As requested.")]
    actor_name: Annotated[str, doc("Articulation key.")]
    actor_id: ActorId = ""
    qpos: Annotated[Floats, doc("Values read back, shape (7,) for the shortcut, otherwise all of the articulation.")]
    free_base_shortcut: Annotated[bool, doc("True if only the free base was written.")]


class SetQpos(ControlRequest[SetQposOk], tag="set_qpos", kw_only=True, eq=False):
    """Write joint positions of an articulation and run `mj_forward`. Velocities and time do not change."""

    target: Annotated[str, doc("Actor id, or the articulation key with `by_name`.")]
    qpos: Annotated[Floats, doc("All joint positions in joint order, or 7 values for the free base alone.")]
    target_by: TargetBy = "actor_id"


class MocapReply(Reply, kw_only=True):
    """Pose of a mocap body."""

    body: Annotated[str, doc("Compiled body name.")]
    pos: Annotated[Vec3, doc("Position, metres, world frame.")]
    quat: QuatWXYZ


class SetMocapPoseOk(MocapReply, tag="set_mocap_pose_ok", kw_only=True):
    """The pose in force."""


class SetMocapPose(ControlRequest[SetMocapPoseOk], tag="set_mocap_pose", kw_only=True):
    """Place a mocap body. Body poses change at the next step or `forward()`."""

    body: Annotated[str, doc("Compiled name, or short name with or without the articulation's key or actor id.")]
    pos: Annotated[Vec3 | None, doc("Position, metres, world frame; None keeps it.")] = None
    quat: Annotated[QuatWXYZ | None, doc("Unit quaternion (w, x, y, z), world frame; None keeps it.")] = None


class ReadMocapPoseOk(MocapReply, tag="read_mocap_pose_ok", kw_only=True):
    """The stored pose."""


class ReadMocapPose(Request[ReadMocapPoseOk], tag="read_mocap_pose", kw_only=True):
    """Read the pose of a mocap body."""

    body: Annotated[str, doc("Compiled name, or short name with or without the articulation's key or actor id.")]


class GetContactsOk(Reply, tag="get_contacts_ok", kw_only=True):
    """Active contacts."""

    n_contacts: Annotated[int, doc("Length of `contacts`, not the total.")]
    truncated: Annotated[bool, doc("True if more contacts matched.")]
    contacts: Annotated[list[Contact], doc("In the order of `mjData.contact`.")]


class ContactFilter(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Exact compiled names, combined with AND and compared by position in the contact."""

    body1: Annotated[str | None, doc("Body of the first geom.")] = None
    body2: Annotated[str | None, doc("Body of the second geom.")] = None
    geom1: Annotated[str | None, doc("First geom.")] = None
    geom2: Annotated[str | None, doc("Second geom.")] = None


class GetContacts(Request[GetContactsOk], tag="get_contacts", kw_only=True):
    """Return a snapshot of the active contacts."""

    max_contacts: Annotated[int, doc("Maximum number of contacts to return.")] = 64
    filter: Annotated[ContactFilter | None, doc("Names to match.")] = None


class ListKeyframesOk(Reply, tag="list_keyframes_ok", kw_only=True):
    """Compiled keyframes."""

    keyframes: Annotated[list[KeyframeInfo], doc("In id order.")]


class ListKeyframes(Request[ListKeyframesOk], tag="list_keyframes", kw_only=True):
    """List the compiled keyframes."""


class ConfigureControllerOk(Reply, tag="configure_controller_ok", kw_only=True):
    """The parameters in force."""

    articulation: Annotated[str, doc("Articulation key.")]
    params: Annotated[dict[str, Any], doc("All current parameters.")]


class ConfigureController(Request[ConfigureControllerOk], tag="configure_controller", kw_only=True):
    """Change parameters of an articulation's controller. Omitted parameters do not change."""

    articulation: Annotated[str, doc("Articulation key.")]
    params: Annotated[dict[str, Any], doc("Parameters to change.")]


class SetUserChannelsOk(Reply, tag="set_user_channels_ok", kw_only=True):
    """Result for the values; a success even if all were rejected."""

    applied: Annotated[int, doc("Number of accepted values.")]
    rejected: Annotated[
        dict[str, str],
        doc(
            "Reason by `<articulation>/<channel>` or `scene/<channel>`: `undeclared_or_kind_mismatch`, "
            "`unsupported_value`, `unsupported_object` or `null_value`."
        ),
    ]


class SetUserChannels(Request[SetUserChannelsOk], tag="set_user_channels", kw_only=True):
    """Write user channels that the level declares for its robots or the scene; the state returns their values.

    Returns the reason for each rejected value, by `<articulation>/<channel>` or `scene/<channel>`.
    """

    arts: Annotated[
        dict[str, dict[str, Any]] | None,
        doc("Articulation to channel to a bool, number, string, list of numbers, or map of `pos` and `quat`."),
    ] = None
    scene: Annotated[dict[str, Any] | None, doc("Channel of the scene to value.")] = None


class SetSimOptionsOk(Reply, tag="set_sim_options_ok", kw_only=True):
    """The options in force."""

    options: Annotated[SimOptions, doc("Read back from the model.")]


class SetSimOptions(Request[SetSimOptionsOk], tag="set_sim_options", kw_only=True):
    """Change fields of `mjOption`, effective from the next step."""

    options: Annotated[SimOptions, doc("Fields to change; None keeps a field.")]


_play_op = partial(Op, ns="runtime", needs=Needs.MANAGER)

OPS: Final = (
    _play_op(request=SetMode, errors=("mode_locked_by_server", "bad_mode"), undeclared=("mode",)),
    _play_op(request=SetPaused),
    _play_op(
        request=ConfigureController,
        infinite=("params",),
        errors=("unknown_articulation", "no_controller", "controller_schema_violation"),
    ),
    _play_op(request=SetSimOptions, errors=("bad_value",), undeclared=("options",), declares=("op:string",)),
    _play_op(request=SetSimSpeed, returns="percent", positional=1),
    _play_op(
        request=SetControlSource,
        errors=("bad_value", "unknown_articulation", "not_control_owner"),
        generated=True,
        positional=1,
        undeclared=("source",),
        declares=("op:string",),
    ),
    _play_op(
        request=SetTwist,
        errors=("unknown_articulation", "not_control_owner", "no_twist_controller"),
        generated=True,
        positional=1,
        undeclared=("articulation",),
        declares=("op:string",),
    ),
    _play_op(
        request=SetQpos,
        errors=("unknown_articulation", "not_control_owner", "no_joints", "dim_mismatch"),
        declares=(
            "op:string",
            "target:string",
            "actor_id:string?",
            "actor_name:string?",
            "qpos:array",
            "free_base_shortcut:bool",
        ),
    ),
    _play_op(
        request=SetMocapPose, errors=("unknown_body", "not_mocap_body"), generated=True, returns=MocapPose, positional=1
    ),
    _play_op(
        request=ReadMocapPose,
        effect=Effect.READ,
        errors=("unknown_body", "not_mocap_body"),
        generated=True,
        returns=MocapPose,
        positional=1,
    ),
    _play_op(request=GetContacts, effect=Effect.READ),
    _play_op(request=ListKeyframes, effect=Effect.READ, generated=True, returns="keyframes"),
    _play_op(request=SetUserChannels, dialects=("beta",)),
    _play_op(request=ClaimControl, errors=("unknown_articulation", "control_claimed"), dialects=("beta",)),
    _play_op(request=ReleaseControl, errors=("unknown_articulation", "not_control_owner"), dialects=("beta",)),
)
