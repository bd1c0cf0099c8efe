"""`OPS`: the only list of ops. Namespaces, façade, server dispatch, documentation tables and tests derive from it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec

from urlab_client.protocol import errors
from urlab_client.protocol.base import DialectName, Effect, Needs, Op
from urlab_client.protocol.messages import (
    cameras,
    control,
    debug,
    farm,
    jobs,
    outliner,
    recording,
    runtime,
    scene,
    session,
    sim,
    uploads,
    viewport,
)
from urlab_client.protocol.types import ActorBounds, CameraPose, MocapPose, RecordingSummary, ReplayStatus

__all__ = ["ENVELOPE_ERRORS", "OPS", "dialect_ops", "registry"]

ENVELOPE_ERRORS = (
    "not_ready",
    "wrong_transport",
    "bad_request",
    "missing_op",
    "session_expired",
    "unknown_op",
    "missing_field",
    "no_active_manager",
    "shutting_down",
)
"""Codes that any op can get, in the order in which a server checks."""


def registry(*ops: Op) -> Mapping[str, Op]:
    """Index `ops` by name, refusing at import whatever a reader or a tool would later trip over."""
    index: dict[str, Op] = {}
    methods: set[tuple[str, str]] = set()
    for op in ops:
        _check(op)
        if op.name in index or (op.ns, op.method) in methods:
            raise TypeError(f"op {op.name!r} is declared twice")
        methods.add((op.ns, op.method))
        index[op.name] = op
    return MappingProxyType(index)


def _check(op: Op) -> None:
    if not op.reply_name.endswith("_ok"):
        raise TypeError(f"{op.name}: the reply's tag {op.reply_name!r} does not end in _ok")
    for struct in (op.request, op.reply):
        if "__doc__" not in struct.__dict__ or not struct.__doc__:
            raise TypeError(f"{struct.__name__}: no docstring")
        for field in msgspec.structs.fields(struct):
            if not _described(field.type):
                raise TypeError(f"{struct.__name__}.{field.name}: no description")
    unknown = [code for code in op.errors if code not in errors.RPC_ERRORS]
    if unknown:
        raise TypeError(f"{op.name}: undeclared error codes {unknown}")
    wrong = [name for name in op.undeclared if name not in op.required]
    if wrong:
        raise TypeError(f"{op.name}: {wrong} are not required fields")


def _described(annotation: Any) -> bool:
    # Not by msgspec.inspect, which takes a third of the package's import time for this alone.
    if get_origin(annotation) is Annotated:
        return any(isinstance(extra, msgspec.Meta) for extra in get_args(annotation)[1:])
    return get_origin(annotation) in {Union, UnionType} and any(map(_described, get_args(annotation)))


_EDITOR = 30.0  # editor ops wait for the game thread, and level or mesh work can hold it for long
_READ = Effect.READ
_MANAGER = Needs.MANAGER

OPS: Mapping[str, Op] = registry(
    Op(request=session.Hello, method="discover", needs=Needs.NOTHING, effect=_READ, timeout=30.0),
    Op(request=session.Meta, needs=Needs.NOTHING, effect=_READ),
    Op(
        request=session.Step,
        needs=_MANAGER,
        # Above the server's own limit of 5 s, or its step_timeout would arrive too late.
        timeout=6.5,
        hot=True,
        errors=("not_ready", "not_control_owner", "step_timeout", "shutting_down"),
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
        request=session.Reset,
        needs=_MANAGER,
        errors=("not_ready", "unknown_keyframe"),
        declares=("op:string", "time:float", "step:int"),
    ),
    # --- runtime ---
    Op(
        request=session.Forward,
        ns="runtime",
        needs=_MANAGER,
        # Computes what follows from the state, which it leaves as it is: the same the second time.
        effect=_READ,
        errors=("not_ready",),
        declares=("op:string", "time:float", "step:int", "per_articulation:object"),
    ),
    Op(
        request=runtime.SetMode,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready", "mode_locked_by_server", "missing_field", "bad_mode"),
        undeclared=("mode",),
    ),
    Op(
        request=runtime.SetPaused,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready", "missing_field"),
        generated=True,
        returns="paused",
        positional=1,
    ),
    Op(
        request=runtime.ConfigureController,
        ns="runtime",
        needs=_MANAGER,
        errors=(
            "not_ready",
            "missing_field",
            "unknown_articulation",
            "no_controller",
            "controller_schema_violation",
        ),
    ),
    Op(
        request=runtime.SetSimOptions,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready", "missing_field", "bad_value"),
        undeclared=("options",),
        declares=("op:string",),
    ),
    Op(
        request=runtime.SetSimSpeed,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready", "missing_field"),
        generated=True,
        returns="percent",
        positional=1,
    ),
    Op(
        request=runtime.SetControlSource,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready", "missing_field", "bad_value", "unknown_articulation", "not_control_owner"),
        generated=True,
        positional=1,
        undeclared=("source",),
        declares=("op:string",),
    ),
    Op(
        request=runtime.SetTwist,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready", "missing_field", "unknown_articulation", "not_control_owner", "no_twist_controller"),
        generated=True,
        positional=1,
        undeclared=("articulation",),
        declares=("op:string",),
    ),
    Op(
        request=runtime.SetQpos,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready", "missing_field", "unknown_articulation", "not_control_owner", "no_joints", "dim_mismatch"),
        declares=(
            "op:string",
            "target:string",
            "actor_id:string?",
            "actor_name:string?",
            "qpos:array",
            "free_base_shortcut:bool",
        ),
    ),
    Op(
        request=runtime.SetMocapPose,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready", "missing_field", "unknown_body", "not_mocap_body"),
        generated=True,
        returns=MocapPose,
        positional=1,
    ),
    Op(
        request=runtime.ReadMocapPose,
        ns="runtime",
        needs=_MANAGER,
        effect=_READ,
        errors=("not_ready", "missing_field", "unknown_body", "not_mocap_body"),
        generated=True,
        returns=MocapPose,
        positional=1,
    ),
    Op(request=runtime.GetContacts, ns="runtime", needs=_MANAGER, effect=_READ, errors=("not_ready",)),
    Op(
        request=runtime.ListKeyframes,
        ns="runtime",
        needs=_MANAGER,
        effect=_READ,
        errors=("not_ready",),
        generated=True,
        returns="keyframes",
    ),
    Op(
        request=runtime.SetUserChannels,
        ns="runtime",
        needs=_MANAGER,
        errors=("not_ready",),
        dialects=("beta",),
    ),
    *control.OPS,
    *cameras.OPS,
    # --- recording, replay: the plugin declares no reply fields for these ---
    Op(
        request=recording.RecordingStart,
        ns="recording",
        method="start",
        needs=_MANAGER,
        errors=("not_ready", "recording_already_active"),
        declares=(),
    ),
    Op(
        request=recording.RecordingStop,
        ns="recording",
        method="stop",
        needs=_MANAGER,
        errors=("not_ready", "recording_not_active"),
        returns=RecordingSummary,
        declares=(),
    ),
    Op(
        request=recording.RecordingSave,
        ns="recording",
        method="save",
        needs=_MANAGER,
        timeout=60.0,
        errors=("not_ready", "path_not_writable"),
        declares=(),
    ),
    Op(
        request=recording.RecordingClear,
        ns="recording",
        method="clear",
        needs=_MANAGER,
        errors=("not_ready",),
        declares=(),
    ),
    Op(
        request=recording.ReplayLoad,
        ns="replay",
        method="load",
        needs=_MANAGER,
        timeout=60.0,
        errors=("not_ready", "missing_field", "path_not_readable"),
        undeclared=("path",),
        declares=(),
    ),
    Op(
        request=recording.ReplayListSessions,
        ns="replay",
        method="list_sessions",
        needs=_MANAGER,
        effect=_READ,
        errors=("not_ready",),
        generated=True,
        returns="sessions",
        declares=(),
    ),
    Op(
        request=recording.ReplaySetActive,
        ns="replay",
        method="set_active",
        needs=_MANAGER,
        errors=("not_ready", "missing_field", "replay_session_not_found"),
        undeclared=("name",),
        declares=(),
    ),
    Op(
        request=recording.ReplayStart,
        ns="replay",
        method="start",
        needs=_MANAGER,
        errors=("not_ready", "replay_requires_stepped"),
        returns=ReplayStatus,
        declares=(),
    ),
    Op(
        request=recording.ReplayStop,
        ns="replay",
        method="stop",
        needs=_MANAGER,
        errors=("not_ready",),
        declares=(),
    ),
    # --- scene ---
    Op(
        request=scene.ImportXml,
        job=True,
        ns="scene",
        timeout=120.0,
        errors=("missing_field", "import_failed"),
    ),
    Op(
        request=scene.CreateLevel,
        job=True,
        ns="scene",
        timeout=_EDITOR,
        errors=("missing_field", "create_level_failed"),
        generated=True,
        positional=1,
    ),
    Op(
        request=scene.LoadLevel,
        job=True,
        ns="scene",
        timeout=_EDITOR,
        errors=("missing_field", "load_level_failed"),
        generated=True,
        positional=1,
    ),
    Op(request=scene.SaveLevel, job=True, ns="scene", timeout=_EDITOR, errors=("save_level_failed",), generated=True),
    Op(
        request=scene.CurrentLevel,
        ns="scene",
        effect=_READ,
        timeout=_EDITOR,
        errors=("not_in_editor", "no_world"),
        generated=True,
        returns="level_path",
    ),
    Op(
        request=scene.EnsureManager,
        ns="scene",
        timeout=_EDITOR,
        errors=("not_in_editor", "no_world", "spawn_failed"),
        generated=True,
        returns="was_existing",
    ),
    Op(request=scene.SpawnActor, job=True, ns="scene", timeout=_EDITOR, errors=("missing_field", "spawn_failed")),
    Op(
        request=scene.SpawnGrid,
        job=True,
        ns="scene",
        timeout=60.0,
        errors=("missing_field", "invalid_count", "too_many_cells", "spawn_failed"),
    ),
    Op(
        request=scene.SpawnLight,
        job=True,
        ns="scene",
        timeout=_EDITOR,
        errors=("spawn_failed",),
        declares=(
            "op:string",
            "actor_id:string",
            "actor_name:string",
            "actor_path:string",
            "kind:string",
            "intensity:float",
            "color:array",
            "location:array",
            "requires_pie_restart:bool",
        ),
    ),
    Op(
        request=scene.DestroyActor,
        ns="scene",
        timeout=_EDITOR,
        errors=("missing_field", "destroy_failed"),
        dialects=("alpha",),
    ),
    Op(
        request=scene.RemoveActor,
        ns="scene",
        timeout=_EDITOR,
        errors=("missing_field", "destroy_failed"),
        dialects=("beta",),
        job=True,
    ),
    Op(
        request=scene.DestroyAsset,
        ns="scene",
        timeout=_EDITOR,
        errors=("missing_field", "destroy_asset_failed"),
        generated=True,
        returns="was_found",
        positional=1,
    ),
    Op(
        request=scene.SetActorTransform,
        ns="scene",
        timeout=_EDITOR,
        errors=("missing_field", "set_actor_transform_failed"),
        generated=True,
        positional=1,
        declares=("op:string", "target:string", "actor_name:string", "requires_pie_restart:bool"),
    ),
    Op(
        request=scene.DuplicateActor,
        job=True,
        ns="scene",
        timeout=_EDITOR,
        errors=("missing_field", "duplicate_failed"),
    ),
    Op(
        request=scene.ActorHierarchy,
        ns="scene",
        effect=_READ,
        timeout=_EDITOR,
        errors=("missing_field", "actor_hierarchy_failed"),
        generated=True,
        returns="root",
        positional=1,
    ),
    Op(request=scene.Snapshot, ns="scene", effect=_READ, timeout=_EDITOR, errors=("snapshot_failed",)),
    *jobs.OPS,
    *uploads.OPS,
    *farm.OPS,
    # --- sim ---
    # The server may take 10 s to reach its game thread, on top of the request's own timeout_s.
    Op(
        request=sim.BeginPie,
        ns="sim",
        method="start",
        timeout=45.0,
        errors=("shutting_down", "load_level_failed"),
        declares=("op:string", "state:string", "compile_error:string", "handshake_payload:object?"),
    ),
    Op(request=sim.StopPie, ns="sim", method="stop", timeout=_EDITOR, errors=("timeout",)),
    Op(request=sim.PieStatus, ns="sim", method="status", effect=_READ, timeout=_EDITOR),
    # --- outliner ---
    Op(request=outliner.ListActors, ns="outliner", effect=_READ, timeout=_EDITOR, errors=("list_actors_failed",)),
    Op(
        request=outliner.ListBlueprints,
        ns="outliner",
        effect=_READ,
        timeout=_EDITOR,
        errors=("list_blueprints_failed",),
        generated=True,
        returns="blueprints",
    ),
    Op(request=outliner.FindActors, ns="outliner", effect=_READ, timeout=_EDITOR, errors=("find_actors_failed",)),
    Op(
        request=outliner.GetActorBounds,
        ns="outliner",
        effect=_READ,
        timeout=_EDITOR,
        errors=("missing_field", "get_actor_bounds_failed"),
        generated=True,
        returns=ActorBounds,
        positional=1,
    ),
    Op(
        request=outliner.SelectActor,
        ns="outliner",
        timeout=_EDITOR,
        errors=("missing_field", "select_failed"),
        generated=True,
        positional=1,
        declares=("op:string", "target:string"),
    ),
    Op(
        request=outliner.AddQuickConvert,
        ns="outliner",
        timeout=_EDITOR,
        errors=("missing_field", "add_quick_convert_failed"),
        generated=True,
        positional=1,
        declares=("op:string", "target:string"),
    ),
    Op(
        request=outliner.RemoveQuickConvert,
        ns="outliner",
        timeout=_EDITOR,
        errors=("missing_field", "remove_quick_convert_failed"),
        generated=True,
        positional=1,
        declares=("op:string", "target:string"),
    ),
    # --- debug ---
    Op(
        request=debug.DrawMarker,
        ns="debug",
        timeout=_EDITOR,
        errors=("missing_field", "no_world"),
        generated=True,
        positional=2,
    ),
    Op(
        request=debug.DrawLine,
        ns="debug",
        timeout=_EDITOR,
        errors=("missing_field", "no_world"),
        generated=True,
        positional=3,
    ),
    Op(
        request=debug.DrawBox,
        ns="debug",
        timeout=_EDITOR,
        errors=("missing_field", "no_world"),
        generated=True,
        positional=3,
    ),
    Op(
        request=debug.DrawArrow,
        ns="debug",
        timeout=_EDITOR,
        errors=("missing_field", "no_world"),
        generated=True,
        positional=3,
    ),
    Op(
        request=debug.DrawAxes,
        ns="debug",
        timeout=_EDITOR,
        errors=("missing_field", "no_world"),
        generated=True,
        positional=1,
    ),
    Op(request=debug.ClearMarkers, ns="debug", timeout=_EDITOR, errors=("no_world",), generated=True),
    Op(
        request=debug.SetOverlayText,
        ns="debug",
        timeout=_EDITOR,
        errors=("missing_field", "no_engine"),
        generated=True,
        positional=1,
    ),
    # --- viewport ---
    Op(
        request=viewport.SetCamera,
        ns="viewport",
        timeout=_EDITOR,
        errors=("missing_field", "no_viewport"),
        generated=True,
        returns=CameraPose,
        positional=1,
    ),
    Op(
        request=viewport.GetCamera,
        ns="viewport",
        effect=_READ,
        timeout=_EDITOR,
        errors=("no_viewport",),
        generated=True,
        returns=CameraPose,
    ),
    Op(
        request=viewport.FrameActor,
        ns="viewport",
        timeout=_EDITOR,
        errors=("missing_field", "unknown_actor", "no_bounds", "no_viewport"),
        generated=True,
        returns=CameraPose,
        positional=1,
    ),
    Op(
        request=viewport.SetViewportMode,
        ns="viewport",
        method="set_mode",
        timeout=_EDITOR,
        errors=("missing_field", "invalid_mode", "no_viewport", "unsupported"),
        generated=True,
        returns="mode",
        positional=1,
    ),
    Op(
        request=viewport.TrackActor,
        ns="viewport",
        timeout=_EDITOR,
        errors=("missing_field", "unknown_actor", "no_viewport"),
        generated=True,
        returns="tracked_actor_path",
        positional=1,
    ),
    Op(request=viewport.Untrack, ns="viewport", timeout=_EDITOR, generated=True, returns="was_tracking"),
)


@cache
def dialect_ops(dialect: DialectName) -> Mapping[str, Op]:
    """Return the ops that a generation of the plugin offers, by name."""
    return MappingProxyType({name: op for name, op in OPS.items() if dialect in op.dialects})
