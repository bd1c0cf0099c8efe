"""Recordings and replays in the HTTP API."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import Struct
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from urlab_client.console.messages import state_message
from urlab_client.console.ops import encode
from urlab_client.integrations._feed.messages import EpisodeOutcome
from urlab_client.web.route_group import JOB, Handler, RouteGroup

_T = TypeVar("_T")


class _RecordRequest(Struct):
    cameras: bool = True


class _OutcomeRequest(Struct):
    outcome: EpisodeOutcome


class _ReplayRequest(Struct):
    name: str = ""
    placing: bool = False
    time: float | None = None
    playing: bool | None = None
    rate: float | None = None


class RecordingRoutes(RouteGroup):
    """Handlers of `/api/recording`, `/api/recordings` and `/api/replay`."""

    def routes(self) -> list[tuple[str, Handler, list[str]]]:
        """Return path, handler and methods of each route."""
        return [
            ("/api/recording", self._record, ["POST", "DELETE"]),
            ("/api/recording/outcome", self._mark, ["POST"]),
            ("/api/recordings", self._list, ["GET"]),
            ("/api/recordings/{name}", self._recording, ["GET", "PUT", "DELETE"]),
            ("/api/replay", self._replay, ["POST", "DELETE"]),
            ("/api/replay/states", self._past, ["GET"]),
        ]

    async def _record(self, request: Request) -> Response:
        viewer = self._viewer(request)
        console = self._console
        console.lease.use(viewer)
        if request.method == "DELETE":
            found = await console.recordings.stop()
            console.note("call", viewer.name, "stop recording", found["name"])
            return _json(found)
        asked = msgspec.json.decode(await request.body() or b"{}", type=_RecordRequest)
        name = await console.recordings.start(cameras=asked.cameras)
        console.note("call", viewer.name, "record", name)
        return _json({"name": name})

    async def _mark(self, request: Request) -> Response:
        viewer, console = self._viewer(request), self._console
        console.lease.use(viewer)
        outcome = msgspec.json.decode(await request.body(), type=_OutcomeRequest).outcome
        await console.recordings.mark(outcome)
        console.note("call", viewer.name, "episode", outcome)
        return _json({})

    async def _list(self, request: Request) -> Response:
        return _json({"recordings": self._console.recordings.list(), "folder": str(self._console.recordings.folder)})

    async def _recording(self, request: Request) -> Response:
        name, recordings = request.path_params["name"], self._console.recordings
        if request.method != "GET":
            viewer = self._viewer(request)
            self._console.lease.use(viewer)
            if request.method == "DELETE":
                replayed = self._console.replay.view
                if replayed is not None and replayed.name == name:
                    raise ValueError(f"{name} is being replayed: go back to live first")
                recordings.remove(name)
                self._console.note("call", viewer.name, "delete recording", name)
                return _json({})
            request.scope[JOB] = f"the upload of {name}"
            found = await recordings.take_in(name, request.stream())
            self._console.note("call", viewer.name, "upload recording", name)
            return _json(found)
        wanted = request.query_params.get("as", "")
        if wanted == "about":
            return _json(await recordings.describe(name))
        if not wanted:
            request.scope[JOB] = f"the download of {name}"
            return FileResponse(recordings.path(name), filename=name, media_type="application/octet-stream")
        request.scope[JOB] = f"the conversion of {name} to {wanted}"
        async with contextlib.AsyncExitStack() as stack:
            making = recordings.converted(name, wanted, request.query_params.get("camera", ""))
            path = await _while_present(request, stack.enter_async_context(making))
            return _Converted(path, stack.pop_all())

    async def _replay(self, request: Request) -> Response:
        viewer, console = self._viewer(request), self._console
        console.lease.use(viewer)
        if request.method == "DELETE":
            await console.replay.end()
            return _json({})
        asked = msgspec.json.decode(await request.body(), type=_ReplayRequest)
        if asked.name:
            await console.replay.begin(console.recordings.path(asked.name), placing=asked.placing)
            console.note("call", viewer.name, "replay", asked.name)
        return _json(await console.replay.change(at=asked.time, playing=asked.playing, rate=asked.rate))

    async def _past(self, request: Request) -> Response:
        states = await self._console.replay.past(float(request.query_params.get("seconds", 8.0)))
        return _json({"states": [state_message(n, state, {}) for n, state in enumerate(states)]})


class _Converted(FileResponse):
    """A converted recording, which is deleted after the response, sent or not."""

    def __init__(self, path: Path, made: contextlib.AsyncExitStack) -> None:
        super().__init__(path, filename=path.name)
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


def _json(value: object) -> Response:
    return Response(encode(value), media_type="application/json")
