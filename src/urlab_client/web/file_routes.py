"""The endpoints of the HTTP API for files: recordings, their replay, and models."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, TypeVar

from msgspec import Struct
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from urlab_client.console.messages import ReplayView, StateList, state_message
from urlab_client.console.model_import import WouldReplace, make_blueprint, receive_model
from urlab_client.console.recordings import RecordingContents, RecordingView
from urlab_client.errors import URLabError
from urlab_client.integrations._feed.messages import EpisodeOutcome
from urlab_client.web.endpoints import BYTES, JOB, Call, endpoint, explain_error, json_response, refusal

_T = TypeVar("_T")


class RecordRequest(Struct, forbid_unknown_fields=True):
    """Whether to record pictures of the cameras, too."""

    cameras: bool = True


_WITH_CAMERAS = RecordRequest()


class OutcomeRequest(Struct, forbid_unknown_fields=True):
    """The outcome of the episode."""

    outcome: EpisodeOutcome


class ReplayRequest(Struct, forbid_unknown_fields=True):
    """A recording to replay, or where to seek and how fast to go on, seconds; null leaves a value as it is.

    `placing` also places the simulation's robots.
    """

    name: str = ""
    placing: bool = False
    time: float | None = None
    playing: bool | None = None
    rate: float | None = None


class RecordingName(Struct):
    """The name of the recording that has begun."""

    name: str


class RecordingList(Struct):
    """The recordings, newest first, and their folder."""

    recordings: list[RecordingView]
    folder: str


class ImportedModel(Struct):
    """The blueprint that a model has become: its class path and its name."""

    blueprint: str
    name: str


@endpoint("POST", "/api/recording", drives=True)
async def record(call: Call, body: RecordRequest = _WITH_CAMERAS) -> RecordingName:
    """Record to an MCAP file: `{cameras: bool}`."""
    name = await call.console.recordings.start(cameras=body.cameras)
    call.note("record", name)
    return RecordingName(name)


@endpoint("DELETE", "/api/recording", drives=True)
async def stop_recording(call: Call) -> RecordingContents:
    """Stop the recording and describe it."""
    found = await call.console.recordings.stop()
    call.note("stop recording", found.name)
    return found


@endpoint("POST", "/api/recording/outcome", drives=True)
async def mark_episode(call: Call, body: OutcomeRequest) -> None:
    """Mark the episode: `{outcome}` success, failure or discarded."""
    await call.console.recordings.mark(body.outcome)
    call.note("episode", body.outcome)


@endpoint("GET", "/api/recordings")
async def recordings(call: Call) -> RecordingList:
    """The recordings, newest first."""
    return RecordingList(call.console.recordings.list(), str(call.console.recordings.folder))


@endpoint("GET", "/api/recordings/{name}", media=BYTES)
async def download(call: Call, name: str, as_: str = "", camera: str = "") -> Response:
    """A recording; `?as=csv`, `npz` or `mp4&camera=…` converts it, `?as=about` describes it."""
    made, request = call.console.recordings, call.request
    if as_ == "about":
        return json_response(await made.describe(name))
    if not as_:
        request.scope[JOB] = f"the download of {name}"
        return FileResponse(made.path(name), filename=name, media_type=BYTES)
    request.scope[JOB] = f"the conversion of {name} to {as_}"
    async with contextlib.AsyncExitStack() as stack:
        path = await _while_present(request, stack.enter_async_context(made.converted(name, as_, camera)))
        of = f"-{camera.replace('/', '-')}" if as_ == "mp4" else ""
        return _Converted(path, f"{path.stem}{of}{path.suffix}", stack.pop_all())


@endpoint("PUT", "/api/recordings/{name}", drives=True, upload=True)
async def upload(call: Call, name: str) -> RecordingContents:
    """Add a recording that was made elsewhere: its bytes."""
    call.request.scope[JOB] = f"the upload of {name}"
    found = await call.console.recordings.take_in(name, call.request.stream())
    call.note("upload recording", name)
    return found


@endpoint("DELETE", "/api/recordings/{name}", drives=True)
async def remove_recording(call: Call, name: str) -> None:
    """Delete a recording."""
    replayed = call.console.replay.view
    if replayed is not None and replayed.name == name:
        raise ValueError(f"{name} is being replayed: go back to live first")
    call.console.recordings.remove(name)
    call.note("delete recording", name)


@endpoint("POST", "/api/replay", drives=True)
async def replay(call: Call, body: ReplayRequest) -> ReplayView:
    """Start a replay with `{name, placing}`, or change it with `{time, playing, rate}`, seconds."""
    replay = call.console.replay
    if body.name:
        await call.console.begin_replay(call.console.recordings.path(body.name), placing=body.placing)
        call.note("replay in the simulation" if body.placing else "replay", body.name)
    return await replay.change(at=body.time, playing=body.playing, rate=body.rate)


@endpoint("DELETE", "/api/replay", drives=True)
async def end_replay(call: Call) -> None:
    """End the replay and show the server's state again."""
    replay = call.console.replay
    if replay.view is not None:
        call.note("end replay", replay.view.name)
    await call.console.end_replay()


@endpoint("GET", "/api/replay/states")
async def replayed(call: Call, seconds: float = 8.0) -> StateList:
    """States of the last `?seconds` before the replay's position."""
    states = await call.console.replay.past(seconds)
    return StateList([state_message(n, state, {}, recorded=True) for n, state in enumerate(states)])


@endpoint("PUT", "/api/models/{name}", reply=ImportedModel, upload=True)
async def import_model(call: Call, name: str, replace: str = "") -> Response:
    """Import a model: the bytes of an .xml or .zip file. `?replace=NAME` allows it to replace that blueprint.

    Requires the controls.
    """
    console, request = call.console, call.request
    request.scope[JOB] = f"the import of {name}"
    async with console.lease.hold(call.viewer):  # large models take longer than the controls are kept
        await console.opened()
        try:
            model = await receive_model(name, request.stream())
            made = await make_blueprint(console.client, name, model, replace)
        except WouldReplace as error:
            hint = f"Send it again with ?replace={error.name} to replace it."
            return refusal(409, "would_replace", str(error), hint, name=error.name)
        except (URLabError, ValueError) as error:
            said = explain_error(error)[1]["message"]
            console.view.note("error", call.viewer.name, "import model", f"{name}: {said}")
            raise
    call.note("import model", name)
    return json_response(ImportedModel(made.class_path, made.short_name))


class _Converted(FileResponse):
    """A converted recording, which is deleted after the response, sent or not."""

    def __init__(self, path: Path, name: str, made: contextlib.AsyncExitStack) -> None:
        super().__init__(path, filename=name)
        self._made = made

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async with self._made:
            await super().__call__(scope, receive, send)


async def _while_present(request: Request, job: Coroutine[Any, Any, _T]) -> _T:
    """Return the result of a job, and cancel it if the client disconnects.

    Raises:
        ClientDisconnect: The client has disconnected.
    """

    async def leaving() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    tasks = asyncio.ensure_future(job), asyncio.ensure_future(leaving())
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if not tasks[0].done():
            raise ClientDisconnect
        return tasks[0].result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
