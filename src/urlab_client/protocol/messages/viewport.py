"""Ops of `client.viewport`: the editor's perspective viewport."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Final

from urlab_client.protocol.base import (
    EDITOR_TIMEOUT_S,
    ActorTarget,
    Effect,
    EulerDeg,
    Location,
    Op,
    QuatXYZW,
    Reply,
    Request,
    TargetBy,
    doc,
)
from urlab_client.values.rotation import Quat, Vec3
from urlab_client.values.types import CameraPose


class CameraReply(Reply, kw_only=True):
    """Pose of the viewport's camera: local +x points forward, +z up."""

    location: Location
    rotation_quat: QuatXYZW
    rotation_euler: EulerDeg
    fov: Annotated[float, doc("Horizontal field of view, degrees.")]


class SetCameraOk(CameraReply, tag="set_camera_ok", kw_only=True):
    """The pose in force."""


class SetCamera(Request[SetCameraOk], tag="set_camera", kw_only=True):
    """Place the perspective viewport's camera."""

    location: Location
    rotation_quat: Annotated[
        Quat | None, doc("Rotation (x, y, z, w) in Unreal's frame; send (-x, y, -z, w) for a MuJoCo quaternion.")
    ] = None
    rotation_euler: EulerDeg | None = None
    fov: Annotated[float | None, doc("Horizontal field of view, degrees; None keeps it.")] = None


class GetCameraOk(CameraReply, tag="get_camera_ok", kw_only=True):
    """The pose in force."""


class GetCamera(Request[GetCameraOk], tag="get_camera", kw_only=True):
    """Read the viewport camera's pose."""


class FrameActorOk(CameraReply, tag="frame_actor_ok", kw_only=True):
    """The pose in force."""


class FrameActor(Request[FrameActorOk], tag="frame_actor", kw_only=True):
    """Move the camera so that an actor fills the view. The view direction does not change."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"


class SetViewportModeOk(Reply, tag="set_mode_ok", kw_only=True):
    """The mode in force. Its `op` is that of the runtime op `set_mode`."""

    mode: Annotated[str, doc("As requested.")]


class SetViewportMode(Request[SetViewportModeOk], tag="set_viewport_mode", kw_only=True):
    """Switch the viewport's view mode, and return the mode in force."""

    mode: Annotated[str, doc("`lit`, `unlit`, `wireframe`, `collision` or `reflections`.")]


class TrackActorOk(Reply, tag="track_actor_ok", kw_only=True):
    """The tracked actor."""

    tracked_actor_path: Annotated[str, doc("Full object path.")]


class TrackActor(Request[TrackActorOk], tag="track_actor", kw_only=True):
    """Make the camera follow an actor, and return its object path. A new call replaces the target."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"
    offset: Annotated[Vec3 | None, doc("Camera position in the actor's frame, metres.")] = None
    smoothing: Annotated[float, doc("Fraction of the old pose kept per tick, in [0, 1).")] = 0.0


class UntrackOk(Reply, tag="untrack_ok", kw_only=True):
    """Tracking ended."""

    was_tracking: Annotated[bool, doc("Whether tracking was active.")]


class Untrack(Request[UntrackOk], tag="untrack", kw_only=True):
    """Stop tracking, and return whether it was active."""


_editor_op = partial(Op, ns="viewport", timeout=EDITOR_TIMEOUT_S, generated=True)

OPS: Final = (
    _editor_op(request=SetCamera, errors=("no_viewport",), returns=CameraPose, positional=1),
    _editor_op(request=GetCamera, effect=Effect.READ, errors=("no_viewport",), returns=CameraPose),
    _editor_op(
        request=FrameActor, errors=("unknown_actor", "no_bounds", "no_viewport"), returns=CameraPose, positional=1
    ),
    _editor_op(
        request=SetViewportMode,
        method="set_mode",
        errors=("invalid_mode", "no_viewport", "unsupported"),
        returns="mode",
        positional=1,
    ),
    _editor_op(request=TrackActor, errors=("unknown_actor", "no_viewport"), returns="tracked_actor_path", positional=1),
    _editor_op(request=Untrack, returns="was_tracking"),
)
