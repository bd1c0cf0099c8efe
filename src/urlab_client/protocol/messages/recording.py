"""Ops of `client.recording` and `client.replay`."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Final

from urlab_client.protocol.base import Effect, Needs, Op, Reply, Request, doc
from urlab_client.values.types import RecordingSummary, ReplayStatus


class RecordingStartOk(Reply, tag="recording_start_ok", kw_only=True):
    """The running recording."""

    name: Annotated[str, doc("Session name, always `Live Recording`.")]
    max_duration_s: Annotated[float, doc("Length of the rolling window, seconds of simulation time.")]


class RecordingStart(Request[RecordingStartOk], tag="recording_start", kw_only=True):
    """Start recording joint states."""

    name: Annotated[str | None, doc("Accepted but not used; the server names the session.")] = None
    max_duration_s: Annotated[float | None, doc("Seconds of simulation time to keep; None for no limit.")] = None


class RecordingStopOk(Reply, tag="recording_stop_ok", kw_only=True):
    """The stopped recording."""

    name: Annotated[str, doc("Session name.")]
    frame_count: Annotated[int, doc("Number of frames; the plugin counts some twice.")]
    sim_duration_s: Annotated[float, doc("Last minus first timestamp, seconds.")]


class RecordingStop(Request[RecordingStopOk], tag="recording_stop", kw_only=True):
    """Stop the running recording."""


class RecordingSaveOk(Reply, tag="recording_save_ok", kw_only=True):
    """The saved file."""

    absolute_path: Annotated[str, doc("Path on the server's machine.")]


class RecordingSave(Request[RecordingSaveOk], tag="recording_save", kw_only=True):
    """Write the active session to a JSON file."""

    path: Annotated[str | None, doc("File name; default `recording.json`.")] = None


class RecordingClearOk(Reply, tag="recording_clear_ok", kw_only=True):
    """The live buffer is empty."""


class RecordingClear(Request[RecordingClearOk], tag="recording_clear", kw_only=True):
    """Empty the live buffer."""


class ReplayLoadOk(Reply, tag="replay_load_ok", kw_only=True):
    """The loaded session."""

    name: Annotated[str, doc("Session name: the file's stem.")]


class ReplayLoad(Request[ReplayLoadOk], tag="replay_load", kw_only=True):
    """Load a recording and make it the active session."""

    path: Annotated[str, doc("File name in the server's replay directory.")]


class ReplayListSessionsOk(Reply, tag="replay_list_sessions_ok", kw_only=True):
    """Loaded sessions."""

    sessions: Annotated[list[str], doc("`Live Recording` first.")]


class ReplayListSessions(Request[ReplayListSessionsOk], tag="replay_list_sessions", kw_only=True):
    """List the loaded sessions."""


class ReplaySetActiveOk(Reply, tag="replay_set_active_ok", kw_only=True):
    """The session is active."""


class ReplaySetActive(Request[ReplaySetActiveOk], tag="replay_set_active", kw_only=True):
    """Make a loaded session the active one."""

    name: Annotated[str, doc("Session name.")]


class ReplayStartOk(Reply, tag="replay_start_ok", kw_only=True):
    """The running replay."""

    active_session: Annotated[str, doc("Session name.")]
    total_frames: Annotated[int, doc("Number of frames.")]


class ReplayStart(Request[ReplayStartOk], tag="replay_start", kw_only=True):
    """Play the active session. Requires step mode `direct` or `puppet`."""


class ReplayStopOk(Reply, tag="replay_stop_ok", kw_only=True):
    """The replay has stopped."""


class ReplayStop(Request[ReplayStopOk], tag="replay_stop", kw_only=True):
    """Stop playing."""


# The plugin declares no reply fields for these ops.
_recording_op = partial(Op, ns="recording", needs=Needs.MANAGER, declares=())
_replay_op = partial(Op, ns="replay", needs=Needs.MANAGER, declares=())

OPS: Final = (
    _recording_op(request=RecordingStart, infinite=("max_duration_s",), errors=("recording_already_active",)),
    _recording_op(request=RecordingStop, errors=("recording_not_active",), returns=RecordingSummary),
    _recording_op(request=RecordingSave, timeout=60.0, errors=("path_not_writable",)),
    _recording_op(request=RecordingClear),
    _replay_op(request=ReplayLoad, timeout=60.0, errors=("path_not_readable",), undeclared=("path",)),
    _replay_op(request=ReplayListSessions, effect=Effect.READ, generated=True, returns="sessions"),
    _replay_op(request=ReplaySetActive, errors=("replay_session_not_found",), undeclared=("name",)),
    _replay_op(request=ReplayStart, errors=("replay_requires_stepped",), returns=ReplayStatus),
    _replay_op(request=ReplayStop),
)
