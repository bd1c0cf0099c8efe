"""Handlers of the `recording` and `replay` ops."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from urlab_client._platform.files import write_whole
from urlab_client.enums import StepMode
from urlab_client.protocol.messages import recording
from urlab_client.server.core import ServerCore
from urlab_client.server.physics.play import Running
from urlab_client.server.physics.replay import Player, ReplaySessions, replay_folder
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need
from urlab_client.simulation.controllers import float32
from urlab_client.simulation.joint_recording import LIVE_SESSION, duration, encode_json

UNLIMITED_S: Final = 3.4028234663852886e38
"""The largest float32."""


def _sessions(server: ServerCore) -> tuple[Running, ReplaySessions]:
    running = server.play.running()
    running.sessions.scan()
    return running, running.sessions


def _locate(server: ServerCore, path: str, code: str) -> tuple[Path, Path]:
    """Return the resolved file that a request names relative to the folder of recordings, and that folder."""
    try:
        folder = replay_folder(server.world.content.root).resolve()
        file = Path(os.path.abspath(folder / path))
        real = file.resolve()
        is_folder = path.endswith(("/", os.sep)) or folder.is_relative_to(real) or real.is_dir()
    except (OSError, ValueError, RuntimeError) as error:  # too long, a null byte, a loop of links
        raise Refusal(code, f"{path!r} is not a usable path: {error}", **_where(code, path)) from None
    if is_folder:
        raise Refusal(code, f"{file} is a folder", **_where(code, file))
    return real, folder


def _where(code: str, path: object) -> dict[str, str]:
    return {"absolute_path": str(path)} if code == "path_not_writable" else {}


def _to_write(server: ServerCore, path: str) -> Path:
    """Return the file to save a recording to, in the folder of recordings."""
    file, folder = _locate(server, path, "path_not_writable")
    if file.parent != folder:
        raise Refusal(
            "path_not_writable",
            f"{file} does not lie in the folder of recordings, {folder}: give a file name",
            absolute_path=str(file),
        )
    if file.exists() and not _is_recording(file):
        raise Refusal("path_not_writable", f"{file} exists and is not a recording", absolute_path=str(file))
    return file


def _to_read(server: ServerCore, path: str) -> Path:
    """Return the file to load a recording from, in the folder of recordings or below a model root."""
    file, folder = _locate(server, path, "path_not_readable")
    folders = (folder, *server.world.content.model_roots)
    if not any(file.is_relative_to(allowed) for allowed in folders):
        text = ", ".join(map(str, folders))
        raise Refusal("path_not_readable", f"{file} lies outside the folders that recordings are loaded from ({text})")
    return file


@handles(recording.RecordingStart)
def recording_start(server: ServerCore, request: recording.RecordingStart) -> recording.RecordingStartOk:
    running, sessions = _sessions(server)
    engine, live = running.engine, sessions.live
    limit = request.max_duration_s
    limit = UNLIMITED_S if limit is None else float32(limit)
    with engine.lock:
        if live.capture in engine.on_substep:
            raise Refusal("recording_already_active", "a recording runs already: stop it first")
        engine.end_replay()
        live.start(limit)
        sessions.active = LIVE_SESSION
        engine.on_substep.append(live.capture)
    return recording.RecordingStartOk(name=LIVE_SESSION, max_duration_s=limit)


@handles(recording.RecordingStop)
def recording_stop(server: ServerCore, _: recording.RecordingStop) -> recording.RecordingStopOk:
    running, sessions = _sessions(server)
    live = sessions.live
    with running.engine.lock:
        if live.capture not in running.engine.on_substep:
            raise Refusal("recording_not_active", "no recording runs")
        running.engine.on_substep.remove(live.capture)
        return recording.RecordingStopOk(
            name=LIVE_SESSION, frame_count=len(live.frames), sim_duration_s=duration(live.frames)
        )


@handles(recording.RecordingSave)
def recording_save(server: ServerCore, request: recording.RecordingSave) -> recording.RecordingSaveOk:
    running, sessions = _sessions(server)
    file = _to_write(server, request.path or "recording.json")
    with running.engine.lock:
        frames = sessions.frames
    # The plugin sends no text with these two.
    if not frames:
        raise Refusal("path_not_writable", "", absolute_path=str(file))
    try:
        write_whole(file, encode_json(frames))
    except OSError:
        raise Refusal("path_not_writable", "", absolute_path=str(file)) from None
    return recording.RecordingSaveOk(absolute_path=str(file))


def _is_recording(file: Path) -> bool:
    """Whether a file may be replaced: a client must not overwrite models and levels."""
    try:
        with file.open("rb") as stream:
            start = stream.read(64)
    except OSError:
        return False
    text = start.replace(b"\0", b"").lstrip(b"\xff\xfe\xef\xbb\xbf \t\r\n")
    return text[:1] == b"{" and text[1:].lstrip()[:8].lower() == b'"frames"'


@handles(recording.RecordingClear)
def recording_clear(server: ServerCore, _: recording.RecordingClear) -> recording.RecordingClearOk:
    running, sessions = _sessions(server)
    with running.engine.lock:
        sessions.live.clear()
    return recording.RecordingClearOk()


@handles(recording.ReplayLoad)
def replay_load(server: ServerCore, request: recording.ReplayLoad) -> recording.ReplayLoadOk:
    sessions = _sessions(server)[1]
    path = need(request, request.path, "path")
    file = _to_read(server, path)
    try:
        return recording.ReplayLoadOk(name=sessions.load(file))
    except FileNotFoundError:
        raise Refusal("path_not_readable", f"{path}: {file} does not exist") from None
    except (OSError, ValueError) as error:
        raise Refusal("path_not_readable", f"{path}: {error}") from None


@handles(recording.ReplayListSessions)
def replay_list_sessions(server: ServerCore, _: recording.ReplayListSessions) -> recording.ReplayListSessionsOk:
    return recording.ReplayListSessionsOk(sessions=_sessions(server)[1].names)


@handles(recording.ReplaySetActive)
def replay_set_active(server: ServerCore, request: recording.ReplaySetActive) -> recording.ReplaySetActiveOk:
    sessions = _sessions(server)[1]
    name = need(request, request.name, "name")
    if not sessions.activate(name):
        raise Refusal("replay_session_not_found", name)
    return recording.ReplaySetActiveOk()


@handles(recording.ReplayStart)
def replay_start(server: ServerCore, _: recording.ReplayStart) -> recording.ReplayStartOk:
    running, sessions = _sessions(server)
    engine = running.engine
    with engine.lock:
        if engine.mode not in (StepMode.DIRECT, StepMode.PUPPET):
            raise Refusal("replay_requires_stepped", "a replay needs step mode direct or puppet: call set_mode first")
        if sessions.live.capture in engine.on_substep:
            engine.on_substep.remove(sessions.live.capture)
        frames = sessions.frames
        if frames:
            relative = sessions.active != LIVE_SESSION
            engine.begin_replay(lambda: Player(running.scene, frames, relative=relative))
        return recording.ReplayStartOk(active_session=sessions.active, total_frames=len(frames))


@handles(recording.ReplayStop)
def replay_stop(server: ServerCore, _: recording.ReplayStop) -> recording.ReplayStopOk:
    running = _sessions(server)[0]
    with running.engine.lock:
        running.engine.end_replay()
    return recording.ReplayStopOk()
