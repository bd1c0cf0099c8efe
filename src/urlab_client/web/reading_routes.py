"""The read-only part of the HTTP API: pictures, a diagnosis, and server-sent events."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
import anyio.to_thread
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from urlab_client.console.lease import Viewer
from urlab_client.console.ops import encode
from urlab_client.enums import StepMode
from urlab_client.web.asyncapi import asyncapi
from urlab_client.web.route_group import Handler, RouteGroup

_FLOWING_S = 5.0
_ALIVE_S = 15.0
"""How long an event stream may be silent, seconds: proxies close connections that are silent for longer."""


class ReadingRoutes(RouteGroup):
    """Handlers of `/api/asyncapi.json`, `/api/explain`, `/api/events` and pictures."""

    def routes(self) -> list[tuple[str, Handler, list[str]]]:
        """Return path, handler and methods of each route."""
        return [
            ("/api/asyncapi.json", self._asyncapi, ["GET"]),
            ("/api/explain", self._explain, ["GET"]),
            ("/api/events", self._events, ["GET"]),
            ("/api/cameras/{path:path}.jpg", self._jpeg, ["GET"]),
            ("/api/cameras/{path:path}.png", self._png, ["GET"]),
        ]

    async def _asyncapi(self, request: Request) -> Response:
        url, root = request.url, request.scope.get("root_path", "")
        document = asyncapi(url.netloc, root, "wss" if url.scheme == "https" else "ws")
        return Response(document, media_type="application/json")

    async def _explain(self, request: Request) -> Response:
        found = await self._console.client.explain()
        return Response(encode(found), media_type="application/json")

    async def _jpeg(self, request: Request) -> Response:
        """Return the newest picture of the stream that viewers share, or capture one if nothing is streaming."""
        feed = self._console.feed(request.path_params["path"])
        if feed is None:
            return _no_camera(request)
        console = self._console
        replayed = console.replay.has_pictures(request.path_params["path"])
        if console.moving and console.client.step_mode is StepMode.LIVE and not replayed:
            async with feed.watch():
                with anyio.move_on_after(_FLOWING_S):
                    return Response((await feed.after(0)).jpeg, media_type="image/jpeg")
        sample = await feed.view.capture()
        return Response(await anyio.to_thread.run_sync(sample.jpeg), media_type="image/jpeg")

    async def _png(self, request: Request) -> Response:
        view = self._console.camera(request.path_params["path"])
        if view is None:
            return _no_camera(request)
        sample = await view.capture()
        return Response(await anyio.to_thread.run_sync(sample.png), media_type="image/png")

    async def _events(self, request: Request) -> Response:
        """Stream the log, the world and the status; a browser that reconnects gets the log entries it missed."""
        last = request.headers.get("last-event-id", "")
        known = int(last) if last.isdecimal() else -1
        stream = self._told(self._viewer(request), known)
        return StreamingResponse(stream, media_type="text/event-stream", headers={"x-accel-buffering": "no"})

    async def _told(self, viewer: Viewer, line: int) -> AsyncGenerator[bytes]:
        console = self._console
        world, status = -1, b""
        with console.bell() as changed:
            while True:
                changed.clear()
                news: list[bytes] = []
                if world != console.world.version:
                    world = console.world.version
                    news.append(_event("world", encode(console.world)))
                now = encode(console.status(viewer))
                if now != status:
                    status = now
                    news.append(_event("status", status))
                for entry in [entry for entry in console.entries if entry.n > line]:
                    line = entry.n
                    news.append(_event("log", encode(entry), line))
                if news:
                    yield b"".join(news)
                with anyio.move_on_after(_ALIVE_S) as waiting:
                    await changed.wait()
                if waiting.cancelled_caught:
                    yield b": nothing new\n\n"


def _no_camera(request: Request) -> Response:
    text = f"No camera is called {request.path_params['path']!r}."
    return Response(encode({"error": {"code": "unknown_camera", "message": text}}), 404, media_type="application/json")


def _event(kind: str, data: bytes, number: int | None = None) -> bytes:
    head = b"" if number is None else f"id: {number}\n".encode()
    return head + f"event: {kind}\ndata: ".encode() + data + b"\n\n"
