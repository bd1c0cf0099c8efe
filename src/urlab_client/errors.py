"""All exceptions of this package, and the table from wire codes to exception classes.

    URLabError                       what failed, on what, and what to do next; `op`, `code`, `hint`
        URLabConnectionError         also a `ConnectionError`
            ServerUnreachable
                AuthenticationFailed
            ConnectionLost
            OutcomeUnknown
            ClientClosed
            ForkedError
            SessionTakenOver         also a `URLabRPCError`
                NoSession
                ServerRestarted
        URLabTimeoutError            also a `TimeoutError`
            NotSettled
            PictureTimeout
        ProtocolError
        ReadOnlyClient
        URLabVersionMismatch
        StreamOverflow
        ConcurrentReadError
        URLabRPCError                the server refused a request; `details`
            URLabPIEError
            NoActiveManager, …       one class for each wire code: `RPC_ERRORS`
    UnknownName                      a `KeyError`: no such articulation, joint, camera, …

`str()` of each states what failed, on what, and what to do next. All of them can be pickled, so they cross process
pools. Invalid arguments raise plain `ValueError` or `TypeError` before anything is sent.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, ClassVar, Final

from urlab_client.enums import PIEState, StepMode
from urlab_client.values.names import UnknownName

__all__ = [
    "RPC_ERRORS",
    "UNCLAIMED",
    "ActorHierarchyFailed",
    "AddQuickConvertFailed",
    "AuthenticationFailed",
    "BadMode",
    "BadRequest",
    "BadValue",
    "ClientClosed",
    "ConcurrentReadError",
    "ConnectionLost",
    "ControlClaimed",
    "ControllerSchemaViolation",
    "CreateLevelFailed",
    "DestroyAssetFailed",
    "DestroyFailed",
    "DimMismatch",
    "DuplicateFailed",
    "FindActorsFailed",
    "ForkedError",
    "GameThreadTimeout",
    "GetActorBoundsFailed",
    "HashMismatch",
    "ImportFailed",
    "InternalError",
    "InvalidCount",
    "InvalidMode",
    "LeaseBusy",
    "ListActorsFailed",
    "ListBlueprintsFailed",
    "LoadLevelFailed",
    "MissingField",
    "MissingOp",
    "ModeLocked",
    "NoActiveManager",
    "NoBounds",
    "NoController",
    "NoEngine",
    "NoJoints",
    "NoSession",
    "NoTwistController",
    "NoViewport",
    "NoWorld",
    "NotControlOwner",
    "NotInEditor",
    "NotMocapBody",
    "NotReady",
    "NotSettled",
    "OutcomeUnknown",
    "PathNotReadable",
    "PathNotWritable",
    "PayloadTooLarge",
    "PictureTimeout",
    "ProtocolError",
    "ReadOnlyClient",
    "RecordingAlreadyActive",
    "RecordingNotActive",
    "RemoveQuickConvertFailed",
    "ReplayRequiresStepped",
    "ReplaySessionNotFound",
    "ReplyTooLarge",
    "SaveLevelFailed",
    "SelectFailed",
    "ServerRestarted",
    "ServerUnreachable",
    "SessionTakenOver",
    "SetActorTransformFailed",
    "ShuttingDown",
    "SnapshotFailed",
    "SpawnFailed",
    "StepTimeout",
    "StreamOverflow",
    "TooManyCells",
    "URLabConnectionError",
    "URLabError",
    "URLabPIEError",
    "URLabRPCError",
    "URLabTimeoutError",
    "URLabVersionMismatch",
    "UnknownActor",
    "UnknownArticulation",
    "UnknownBody",
    "UnknownJob",
    "UnknownKeyframe",
    "UnknownName",
    "UnknownOp",
    "UnknownUpload",
    "Unsupported",
    "WrongTransport",
    "rpc_error",
]


UNCLAIMED: Final = "(unclaimed)"
"""Owner that a server reports for a robot without one."""

RPC_ERRORS: dict[str, type[URLabRPCError]] = {}
"""Wire code to exception class; codes not listed here raise `URLabRPCError` itself."""


def _rebuild(cls: type[URLabError], args: tuple[Any, ...], state: dict[str, Any]) -> URLabError:
    error = cls.__new__(cls)
    error.args = args
    error.__dict__.update(state)
    return error


def _sentence(text: str) -> str:
    """Return a text that ends with a full stop, which a server's message may lack."""
    return text if not text or text.endswith((".", "!", "?", "…")) else f"{text}."


class URLabError(Exception):
    """Base class of all exceptions of this package.

    Attributes:
        op: Name of the op that failed, or None.
        code: Short stable code; empty if no server was involved.
        hint: What to do next; included in `str()`.
    """

    op: str | None
    code: str
    hint: str | None

    def __init__(self, message: str, *, op: str | None = None, code: str = "", hint: str | None = None) -> None:
        super().__init__(message)
        self.op = op
        self.code = code
        self.hint = hint

    def __str__(self) -> str:
        text = str(self.args[0]) if self.args else ""
        return f"{_sentence(text)} {self.hint}" if self.hint else text

    def to_dict(self) -> dict[str, Any]:
        """Return the error as JSON-compatible data: `error` (the class), `message`, `op`, `code` and `hint`."""
        return {
            "error": type(self).__name__,
            "message": str(self),
            "op": self.op,
            "code": self.code,
            "hint": self.hint,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), self.args, dict(self.__dict__))


class URLabConnectionError(URLabError, ConnectionError):
    """The connection to the server cannot be used."""


class ServerUnreachable(URLabConnectionError):
    """No connection could be made within the deadline; nothing was sent."""


class AuthenticationFailed(ServerUnreachable):
    """Server and client do not accept each other's CURVE keys, or only one of them uses keys; nothing was sent."""


class ConnectionLost(URLabConnectionError):
    """The connection was lost. No request that changes the simulation was in progress."""


class OutcomeUnknown(URLabConnectionError):
    """The connection was lost after a request that changes state was sent; it may or may not have been executed.

    Attributes:
        job_id: The editor's job that executes it, if any.
    """

    job_id: str | None = None


class ClientClosed(URLabConnectionError):
    """The client was closed, before this call or during it."""


class ForkedError(URLabConnectionError):
    """The client was created in another process; a forked child must create its own."""


class URLabTimeoutError(URLabError, TimeoutError):
    """No reply arrived within the deadline. A request that was sent may still be executed by the server.

    Attributes:
        job_id: The editor's job that executes it, if any; it continues.
    """

    job_id: str | None = None


class NotSettled(URLabTimeoutError):
    """Joints did not reach the targets of `move_to()`. Their set-points are kept.

    Attributes:
        remaining: Signed distance to the target by joint name, radians or metres.
    """

    remaining: dict[str, float]

    def __init__(self, message: str, *, remaining: dict[str, float], hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.remaining = remaining


class PictureTimeout(URLabTimeoutError):
    """Cameras delivered no picture in time.

    Attributes:
        cameras: Names of the cameras.
    """

    cameras: list[str]

    def __init__(self, message: str, *, cameras: list[str], hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.cameras = cameras


class ProtocolError(URLabError):
    """A frame from the server could not be decoded.

    Attributes:
        raw: The first bytes of the frame.
    """

    raw: bytes

    def __init__(self, message: str, *, op: str | None = None, raw: bytes = b"", hint: str | None = None) -> None:
        super().__init__(message, op=op, hint=hint)
        self.raw = raw[:256]


class ReadOnlyClient(URLabError):
    """The client was created with `read_only=True` and sends no requests. Nothing was sent."""


class URLabVersionMismatch(URLabError):
    """Client and server MuJoCo builds differ, so the compiled model cannot be loaded here.

    Attributes:
        server_version: MuJoCo version of the server.
        client_version: MuJoCo version installed here.
    """

    server_version: str
    client_version: str

    def __init__(self, server_version: str, client_version: str, *, hint: str | None = None) -> None:
        super().__init__(
            f"The server runs MuJoCo {server_version}, this process has MuJoCo {client_version}.",
            op="hello",
            hint=hint
            or (
                f"Install mujoco=={server_version}, or pass mujoco_version_check=False to go on with a warning, "
                "or local_model=False to work without a local model."
            ),
        )
        self.server_version = server_version
        self.client_version = client_version


class StreamOverflow(URLabError):
    """A stream with policy `all` overflowed its bounded buffer. Reading continues with the oldest remaining message.

    Attributes:
        lost: Number of lost messages.
    """

    lost: int

    def __init__(self, message: str, *, lost: int, hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.lost = lost


class ConcurrentReadError(URLabError):
    """A second task tried to read a stream that already has a reader."""


class URLabRPCError(URLabError):
    """The server refused a request.

    Attributes:
        code: Short stable code, for example `unknown_articulation`.
        message: The server's text, whose wording may change.
        details: Further fields of the error reply, by name.
    """

    advice: ClassVar[str | None] = None
    message: str
    details: dict[str, Any]

    def __init_subclass__(cls, *, code: str | None = None, advice: str | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if code is not None:
            if code in RPC_ERRORS:
                raise TypeError(f"error code {code!r} is declared twice")
            RPC_ERRORS[code] = cls
        if advice is not None:
            cls.advice = advice

    def __init__(
        self,
        code: str,
        message: str,
        *,
        op: str | None = None,
        hint: str | None = None,
        details: Mapping[str, Any] | None = None,
    ) -> None:
        what = f"{op}: {code}" if op else code
        super().__init__(
            f"{what}: {message}" if message else what, op=op, code=code, hint=hint if hint is not None else self.advice
        )
        self.message = message
        self.details = dict(details or {})

    def to_dict(self) -> dict[str, Any]:
        """Return the error as JSON-compatible data; in addition to the common fields, `details`."""
        from urlab_client.values.plain import plain  # errors alone need no NumPy

        return {**super().to_dict(), "details": plain(self.details, "list")}


def rpc_error(
    code: str, message: str, *, op: str | None = None, details: Mapping[str, Any] | None = None
) -> URLabRPCError:
    """Create the exception for an error reply: the class declared for `code`, otherwise `URLabRPCError`."""
    return RPC_ERRORS.get(code, URLabRPCError)(code, message, op=op, details=details)


class URLabPIEError(URLabRPCError):
    """`sim.start()` did not reach Playing.

    Attributes:
        state: State of Play-In-Editor.
        message: MuJoCo's compile log if the model was rejected, otherwise an explanation.
    """

    state: PIEState

    def __init__(self, *, code: str, message: str, state: PIEState) -> None:
        super().__init__(code, message, op="begin_pie")
        self.state = state


# One class per wire code. The docstring is the row of the error table in the documentation.


class SessionTakenOver(
    URLabRPCError,
    URLabConnectionError,
    code="session_expired",
    advice="Call discover() to open a new session; it takes the server over from whoever holds it now.",
):
    """The server no longer knows this session: another client said hello, or the server restarted."""


class NoSession(SessionTakenOver, advice="Call discover() first."):
    """No session is open, or the client does not know the play world: `discover()` was not called, or did not finish.

    The op was not executed.
    """

    def __init__(self, message: str, *, op: str | None = None, hint: str | None = None) -> None:
        super().__init__("session_expired", message, op=op, hint=hint)
        self.args: tuple[Any, ...] = (f"{op}: {message}" if op else message,)  # the code would mislead


class ServerRestarted(
    SessionTakenOver,
    advice="Call discover() to open a session with the server as it is now; keep_session=True does so by itself.",
):
    """The server was restarted, so the session, the play session and the simulation's state are lost.

    The op was not executed. Raised if the restart is visible: connections were refused for a while before the server
    refused the session. Otherwise a restart looks like another client's `hello`, and `SessionTakenOver` is raised.
    """

    def __init__(self, message: str, *, op: str | None = None, hint: str | None = None) -> None:
        super().__init__("session_expired", message, op=op, hint=hint)
        self.args: tuple[Any, ...] = (f"{op}: {message}" if op else message,)  # the code would mislead


class BadRequest(URLabRPCError, code="bad_request"):
    """The frame is neither a msgpack map nor a JSON object."""


class MissingOp(URLabRPCError, code="missing_op"):
    """The request has no usable `op`."""


class UnknownOp(URLabRPCError, code="unknown_op", advice="This server does not offer the op; see `meta` for its list."):
    """The server does not have this op; a packaged build answers every editor op with this."""


class NotInEditor(URLabRPCError, code="not_in_editor"):
    """The op needs the editor."""


class WrongTransport(URLabRPCError, code="wrong_transport"):
    """The op is not served over shared memory. It was not executed."""


class ReplyTooLarge(URLabRPCError, code="reply_too_large"):
    """The reply does not fit a shared-memory slot; the message says whether the op was executed."""


class InternalError(URLabRPCError, code="internal_error", advice="The server's log has the details."):
    """The simulated server failed unexpectedly; it continues to serve."""


class Unsupported(URLabRPCError, code="unsupported"):
    """The request is not supported without Unreal; only the simulated server answers this."""


class MissingField(URLabRPCError, code="missing_field"):
    """A required field is absent, empty or malformed."""


class NoActiveManager(
    URLabRPCError, code="no_active_manager", advice="Start a play session first: client.sim.start()."
):
    """No play session is running."""


class NotReady(URLabRPCError, code="not_ready"):
    """The play session has no compiled model (yet), or the part of it the op needs is missing."""


class StepTimeout(
    URLabRPCError,
    code="step_timeout",
    advice="Is physics paused (client.runtime.set_paused(False)), a replay running, or n_steps too long? "
    "The queued steps still run when the physics loop gets to them.",
):
    """A direct step did not finish within the server's own limit of 5 s; the queued work is not cancelled."""


class ShuttingDown(URLabRPCError, code="shutting_down"):
    """The server is stopping."""


class UnknownKeyframe(URLabRPCError, code="unknown_keyframe"):
    """The compiled model has no keyframe with this name; nothing was reset."""


class ModeLocked(URLabRPCError, code="mode_locked_by_server"):
    """The project locks the step mode."""

    @property
    def pinned(self) -> StepMode | None:
        """The locked mode; None if the server's text names none or several."""
        named = {mode for mode in _PINNABLE if re.search(rf"\b{mode}\b", self.message, re.IGNORECASE)}
        return named.pop() if len(named) == 1 else None


_PINNABLE = (StepMode.LIVE, StepMode.DIRECT, StepMode.PUPPET)


class BadMode(URLabRPCError, code="bad_mode"):
    """Unknown step mode."""


class BadValue(URLabRPCError, code="bad_value"):
    """A value outside the op's list of choices."""


class UnknownArticulation(URLabRPCError, code="unknown_articulation"):
    """No articulation has this key or actor id."""


class NotControlOwner(
    URLabRPCError,
    code="not_control_owner",
    advice="articulation.claim(force=True) takes the robot over; its present owner is then refused.",
):
    """Another client controls the robot, or no client does; nothing was written."""

    def __init__(
        self,
        code: str,
        message: str,
        *,
        op: str | None = None,
        hint: str | None = None,
        details: Mapping[str, Any] | None = None,
    ) -> None:
        # A server words its message as it likes, and need not name the owner there.
        owner = str((details or {}).get("owner") or "")
        if owner not in {"", UNCLAIMED} and not re.search(rf"(?<!\w){re.escape(owner)}(?!\w)", message):
            message = f"{message.rstrip('.')}. The owner is {owner!r}.".removeprefix(". ")
        super().__init__(code, message, op=op, hint=hint, details=details)

    @property
    def owner(self) -> str:
        """The client that controls the robot, or `(unclaimed)`; empty if the server does not send it."""
        return str(self.details.get("owner") or "")


class ControlClaimed(NotControlOwner, code="control_claimed"):
    """Another client controls the robot, so it could not be claimed."""


class LeaseBusy(
    URLabRPCError, code="busy", advice="Use another server, or wait until the lease is given back or runs out."
):
    """Another client holds the server's driver lease."""

    @property
    def lease_id(self) -> str:
        """Lease of the holder; empty if the server does not send it."""
        return str(self.details.get("lease_id", ""))


class UnknownJob(URLabRPCError, code="unknown_job"):
    """The editor does not know this job: it never existed, or its result was already fetched or has expired."""


class UnknownUpload(URLabRPCError, code="unknown_upload"):
    """The server does not know this upload: it was committed, or has expired."""


class HashMismatch(URLabRPCError, code="hash_mismatch"):
    """A file was corrupted in transit; send it again."""


class PayloadTooLarge(URLabRPCError, code="payload_too_large"):
    """A file or a model exceeds the server's limit."""


class NoController(URLabRPCError, code="no_controller"):
    """The articulation has no controller."""


class ControllerSchemaViolation(URLabRPCError, code="controller_schema_violation"):
    """Controller parameters do not fit the controller's schema; nothing was changed."""


class NoTwistController(URLabRPCError, code="no_twist_controller"):
    """The articulation has no twist controller."""


class NoJoints(URLabRPCError, code="no_joints"):
    """The articulation has no joints."""


class DimMismatch(URLabRPCError, code="dim_mismatch"):
    """The vector's length does not fit the articulation."""


class UnknownBody(URLabRPCError, code="unknown_body"):
    """The compiled model has no body with this name."""


class NotMocapBody(URLabRPCError, code="not_mocap_body"):
    """The body is not flagged `mocap="true"`."""


class RecordingAlreadyActive(URLabRPCError, code="recording_already_active"):
    """A recording is already running."""


class RecordingNotActive(URLabRPCError, code="recording_not_active"):
    """No recording is running."""


class PathNotWritable(URLabRPCError, code="path_not_writable"):
    """The recording could not be written, or there is nothing to save."""


class PathNotReadable(URLabRPCError, code="path_not_readable"):
    """The recording does not exist, or the file is not a recording."""


class ReplaySessionNotFound(URLabRPCError, code="replay_session_not_found"):
    """No replay session has this name."""


class ReplayRequiresStepped(
    URLabRPCError, code="replay_requires_stepped", advice="Switch first: client.runtime.set_mode('direct')."
):
    """Replay needs mode `direct` or `puppet`."""


class ImportFailed(URLabRPCError, code="import_failed"):
    """The MJCF file is missing or was rejected, or an old blueprint could not be removed."""


class CreateLevelFailed(URLabRPCError, code="create_level_failed"):
    """The level already exists, a play session is running, or it could not be saved."""


class LoadLevelFailed(URLabRPCError, code="load_level_failed"):
    """The level does not exist, cannot be read, or a play session is running."""


class SaveLevelFailed(URLabRPCError, code="save_level_failed"):
    """The level has no path yet, a play session is running, or it could not be written."""


class SpawnFailed(URLabRPCError, code="spawn_failed"):
    """The class cannot be spawned, or the actor id belongs to an actor of another class."""


class InvalidCount(URLabRPCError, code="invalid_count"):
    """A grid count is not above zero."""


class TooManyCells(URLabRPCError, code="too_many_cells"):
    """A grid of more than 1024 cells."""


class DestroyFailed(URLabRPCError, code="destroy_failed"):
    """No actor matches."""


class DestroyAssetFailed(URLabRPCError, code="destroy_asset_failed"):
    """The asset exists but cannot be deleted."""


class SetActorTransformFailed(URLabRPCError, code="set_actor_transform_failed"):
    """No actor matches, or the rotation is invalid."""


class DuplicateFailed(URLabRPCError, code="duplicate_failed"):
    """No actor matches, or the new id belongs to an actor of another class."""


class ActorHierarchyFailed(URLabRPCError, code="actor_hierarchy_failed"):
    """No actor matches."""


class SnapshotFailed(URLabRPCError, code="snapshot_failed"):
    """There is no world to describe."""


class ListActorsFailed(URLabRPCError, code="list_actors_failed"):
    """There is no world to list."""


class ListBlueprintsFailed(URLabRPCError, code="list_blueprints_failed"):
    """The content could not be searched."""


class FindActorsFailed(URLabRPCError, code="find_actors_failed"):
    """There is no world to search."""


class GetActorBoundsFailed(URLabRPCError, code="get_actor_bounds_failed"):
    """No actor matches."""


class SelectFailed(URLabRPCError, code="select_failed"):
    """No actor matches."""


class AddQuickConvertFailed(URLabRPCError, code="add_quick_convert_failed"):
    """No actor matches, or it has no mesh to convert."""


class RemoveQuickConvertFailed(URLabRPCError, code="remove_quick_convert_failed"):
    """No actor matches, or it is not converted."""


class GameThreadTimeout(URLabRPCError, code="timeout"):
    """The editor's game thread did not answer in time; often a modal dialog is open."""


class NoWorld(URLabRPCError, code="no_world"):
    """Neither a play world nor an editor world exists."""


class NoEngine(URLabRPCError, code="no_engine"):
    """There is no engine object to draw with."""


class NoViewport(URLabRPCError, code="no_viewport"):
    """The editor has no perspective viewport."""


class UnknownActor(URLabRPCError, code="unknown_actor"):
    """No actor matches; the message contains the key."""


class NoBounds(URLabRPCError, code="no_bounds"):
    """The actor has no valid bounds."""


class InvalidMode(URLabRPCError, code="invalid_mode"):
    """Unknown viewport mode."""


# These show that the session, play or the server is not well, or that another client holds what the request needs.
_PASSING = (
    SessionTakenOver,
    URLabPIEError,
    NoActiveManager,
    NotReady,
    StepTimeout,
    GameThreadTimeout,
    ShuttingDown,
    InternalError,
    NotControlOwner,
    LeaseBusy,
)


def refused_for_good(error: BaseException) -> bool:
    """Return whether a well server refused a request, so that neither another server nor a repetition would help."""
    return isinstance(error, URLabRPCError) and not isinstance(error, _PASSING)
