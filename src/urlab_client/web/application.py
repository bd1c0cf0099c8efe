"""The Starlette application: the page, the HTTP API and the WebSockets."""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import anyio
import anyio.to_thread
import msgspec
from msgspec import Struct
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from urlab_client.console import mujoco_viewer
from urlab_client.console.lease import DrivingLease, NotDriving, Viewer
from urlab_client.console.messages import Ack, Ctrl, FromViewer, Hand, Log, Name, Ping, Pong, Refused, You
from urlab_client.console.ops import SERVED, encode, parse
from urlab_client.console.session import Audience, ConsoleSession
from urlab_client.errors import URLabError
from urlab_client.web.access import Access, Guarded
from urlab_client.web.body_routes import BodyRoutes
from urlab_client.web.explained_errors import explain_error
from urlab_client.web.model_routes import ModelRoutes
from urlab_client.web.openapi import openapi
from urlab_client.web.reading_routes import ReadingRoutes
from urlab_client.web.recording_routes import RecordingRoutes
from urlab_client.web.route_group import Handler

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

    from urlab_client.aio import URLabClient

_STATIC = Path(__file__).parent / "static"
_LARGEST_BODY = 1024 * 1024
_AHEAD = 2  # states or pictures sent to a browser that it has not acknowledged
_VIEWER = "x-urlab-viewer"
_GONE = 499  # what servers log if a client closes its request


def app(
    client: URLabClient,
    *,
    access: Access | None = None,
    handshake: Callable[[], bytes] | None = None,
    lease_seconds: float = 20.0,
    metrics: CollectorRegistry | None = None,
    recordings: str | os.PathLike[str] = "recordings",
) -> Starlette:
    """Make the application. It keeps the client's session open during its lifespan, and leaves closing it to you.

    To mount it in another application, enter `site.router.lifespan_context(site)` in that application's lifespan.

    Args:
        client: An async client that belongs to the serving event loop. The application reads set-points and state from
            it, as any other part of a program may.
        access: Access rules. By default, requests reach the application on this machine, with a token of
            `site.state.access.invite()`.
        handshake: For a client with `read_only=True`: callback that returns the result of the driving client's
            `handshake()`, for example `Path("…").read_bytes`. Called in a thread, and again whenever play restarts.
        lease_seconds: How long a viewer keeps the controls without using them.
        metrics: Registry that `/metrics` serves to Prometheus, behind the same access rules; None leaves the path out.
            It includes the client's requests if the client was made with `observe=PrometheusObserver(metrics)`.
        recordings: Folder of the recordings that viewers make, download and replay; created with the first one.

    Raises:
        ValueError: The client is read-only and `handshake` is missing, or the client is not read-only and `handshake`
            is given.
    """
    if client.config.read_only != (handshake is not None):
        raise ValueError("app: pass `handshake` for a client with read_only=True, and for no other client")
    access = access or Access()
    session = ConsoleSession(client, DrivingLease(lease_seconds), Path(recordings), handshake)
    site = _Site(session, access, metrics)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        async with site.console.open():
            yield

    application = Starlette(routes=site.routes(), middleware=[Middleware(Guarded, access=access)], lifespan=lifespan)
    application.state.access = access
    application.state.console = site.console
    return application


def entrance(access: Access) -> Handler:
    """Return the handler of `POST /api/session`, which exchanges a token for a key."""

    async def enter(request: Request) -> Response:
        key = access.admit(msgspec.json.decode(await _body(request), type=_LoginRequest).token)
        if key is None:
            return _error(401, "bad_token", "This token is unknown or has been used.")
        return _json(encode({"key": key}))

    return _answering(enter)


class _RunRequest(Struct):
    running: bool


class _StepRequest(Struct):
    n_steps: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 1


class _LoginRequest(Struct):
    token: str


class _Site:
    def __init__(self, console: ConsoleSession, access: Access, metrics: CollectorRegistry | None) -> None:
        self.console = console
        self._access = access
        self._metrics = metrics
        self._viewers: dict[str, Viewer] = {}
        self._reading = ReadingRoutes(console, self._viewer)
        self._recordings = RecordingRoutes(console, self._viewer)
        self._models = ModelRoutes(console, self._viewer)
        self._body_pushing = BodyRoutes(console.body_pushing, self._viewer, _body)

    def routes(self) -> list[Route | WebSocketRoute | Mount]:
        def route(path: str, handler: Handler, *methods: str) -> Route:
            return Route(path, _answering(handler), methods=list(methods or ["GET"]))

        return [
            route("/", self._page),
            route("/api/openapi.json", self._openapi),
            route("/api/handshake", self._handshake),
            route("/api/world", self._world),
            route("/api/status", self._status),
            route("/api/state", self._state),
            route("/api/log", self._log),
            *(route(path, handler, *methods) for path, handler, methods in self._reading.routes()),
            route("/api/ops/{op}", self._op, "POST"),
            route("/api/ctrl", self._ctrl, "POST"),
            route("/api/run", self._run, "POST"),
            route("/api/step", self._step, "POST"),
            *(
                route(path, handler, *methods)
                for path, handler, methods in (
                    *self._recordings.routes(),
                    *self._models.routes(),
                    *self._body_pushing.routes(),
                )
            ),
            route("/api/lease", self._lease, "POST", "DELETE"),
            route("/api/connection", self._connection, "POST"),
            route("/api/invitations", self._invite, "POST"),
            Route("/api/session", entrance(self._access), methods=["POST"]),
            WebSocketRoute("/api/live", self._live),
            WebSocketRoute("/api/cameras/{path:path}/live", self._pictures),
            Mount("/static", StaticFiles(directory=_STATIC)),
            *([] if self._metrics is None else [Route("/metrics", showing(self._metrics))]),
            *self._studio_routes(),
        ]

    def _studio_routes(self) -> list[Route | WebSocketRoute | Mount]:
        shipped = mujoco_viewer.files()
        if shipped is None:
            return []

        async def page(request: Request) -> Response:
            return Response(shipped.page, media_type="text/html", headers={"content-security-policy": shipped.policy})

        return [
            Route("/viewer/", page),
            Route("/viewer/model", _answering(self._model)),
            WebSocketRoute("/viewer/state", self._poses),
            WebSocketRoute("/viewer/ui", self._taken),
            Mount("/viewer/assets", _Checked(directory=shipped.assets)),
            Mount("/viewer", _Checked(directory=shipped.dist)),
        ]

    async def _page(self, request: Request) -> Response:
        return FileResponse(_STATIC / "index.html")

    async def _openapi(self, request: Request) -> Response:
        return _json(openapi(request.scope.get("root_path", ""), metrics=self._metrics is not None))

    async def _handshake(self, request: Request) -> Response:
        shared = await anyio.to_thread.run_sync(self.console.client.handshake)
        return Response(shared, media_type="application/octet-stream")

    async def _world(self, request: Request) -> Response:
        return _json(encode(self.console.world))

    async def _status(self, request: Request) -> Response:
        return _json(encode(self.console.status(self._viewer(request))))

    async def _state(self, request: Request) -> Response:
        if self.console.state_json is None:
            return _error(503, "no_state", "No state has arrived yet.", "Is play running?")
        return _json(self.console.state_json)

    async def _log(self, request: Request) -> Response:
        return _json(encode(list(self.console.entries)))

    async def _op(self, request: Request) -> Response:
        op = SERVED.get(request.path_params["op"])
        if op is None:
            return _error(404, "unknown_op", f"No op is called {request.path_params['op']!r}.", "See openapi.json.")
        body = await _body(request)
        return _json(encode(await self.console.controls.do(self._viewer(request), parse(op, body))))

    async def _ctrl(self, request: Request) -> Response:
        values = msgspec.json.decode(await _body(request), type=dict[str, dict[str, float]])
        self.console.controls.set_points(self._viewer(request), values)
        return _json(b"{}")

    async def _run(self, request: Request) -> Response:
        await self.console.controls.run(
            self._viewer(request), msgspec.json.decode(await _body(request), type=_RunRequest).running
        )
        return _json(b"{}")

    async def _step(self, request: Request) -> Response:
        steps = msgspec.json.decode(await _body(request) or b"{}", type=_StepRequest)
        return _json(encode(await self.console.controls.step(self._viewer(request), steps.n_steps)))

    async def _lease(self, request: Request) -> Response:
        viewer = self._viewer(request)
        if request.method == "POST":
            self.console.lease.use(viewer)
        else:
            self.console.lease.release(viewer)
        self.console.tell()
        return _json(encode(self.console.status(viewer)))

    async def _connection(self, request: Request) -> Response:
        self.console.lease.use(self._viewer(request))
        self.console.take_back()
        return _json(b"{}")

    async def _invite(self, request: Request) -> Response:
        token = self._access.invite()
        return _json(encode({"token": token, "path": f"{request.scope.get('root_path', '')}/?token={token}"}))

    # WebSockets

    async def _live(self, socket: WebSocket) -> None:
        await socket.accept()
        viewer = Viewer(secrets.token_urlsafe(16), self._new_name())
        self._viewers[viewer.key] = viewer
        one = Audience(viewer)
        flow = _Flow()
        self.console.audience.add(one)
        self.console.tell()
        try:
            await socket.send_text(encode(You(viewer.key, viewer.name)).decode())
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._send, socket, one, flow)
                with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # gone, perhaps during a reply
                    await self._listen(socket, one, flow)
                tasks.cancel_scope.cancel()
        finally:
            self.console.audience.discard(one)
            self.console.lease.release(viewer)
            del self._viewers[viewer.key]
            self.console.tell()

    async def _send(self, socket: WebSocket, one: Audience, flow: _Flow) -> None:
        console = self.console
        world = state = line = -1
        status = b""
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # gone; the listener ends the rest
            while True:
                one.changed.clear()
                if world != console.world.version:
                    world = console.world.version
                    await socket.send_text(console.world_json.decode())
                now = encode(console.status(one.viewer))
                if now != status:
                    status = now
                    await socket.send_text(now.decode())
                if console.entries and console.entries[-1].n > line:
                    news = [entry for entry in console.entries if entry.n > line]
                    line = news[-1].n
                    await socket.send_text(encode(Log(news)).decode())
                if (
                    console.state_json is not None
                    and state != console.state_seq
                    and flow.sent - flow.acknowledged < _AHEAD
                ):
                    state = console.state_seq
                    flow.sent += 1
                    await socket.send_text(console.state_json.decode())
                await one.changed.wait()

    async def _listen(self, socket: WebSocket, one: Audience, flow: _Flow) -> None:
        while True:
            text = await _said(socket)
            try:
                message: FromViewer = msgspec.json.decode(text, type=FromViewer)
                match message:
                    case Ack():
                        flow.acknowledged += 1
                        one.changed.set()
                    case Ping(at=at):
                        await socket.send_text(encode(Pong(at, _now_ms())).decode())
                    case Name(name=name):
                        one.viewer.name = " ".join(name.split())[:24] or one.viewer.name
                        self.console.tell()
                    case Ctrl() | Hand():
                        self.console.drive(one.viewer, message)
            except (NotDriving, ValueError, KeyError, RecursionError, msgspec.MsgspecError) as error:
                await socket.send_text(encode(Refused(explain_error(error)[1])).decode())

    async def _pictures(self, socket: WebSocket) -> None:
        feed = self.console.feed(socket.path_params["path"])
        await socket.accept()
        if feed is None:
            await socket.close(4404, "no such camera")
            return
        flow = _Flow()
        async with feed.watch(), anyio.create_task_group() as tasks:

            async def send() -> None:
                seq = 0
                with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                    while True:
                        while flow.sent - flow.acknowledged >= _AHEAD:
                            flow.changed = anyio.Event()
                            await flow.changed.wait()
                        picture = await feed.after(seq)
                        seq = picture.seq
                        flow.sent += 1
                        await socket.send_bytes(picture.frame())

            tasks.start_soon(send)
            with contextlib.suppress(WebSocketDisconnect):
                while True:
                    await _said(socket)
                    flow.acknowledged += 1
                    flow.changed.set()
            tasks.cancel_scope.cancel()

    # The 3-D view

    async def _model(self, request: Request) -> Response:
        """Return the model, its size, or a part of it, as the viewer's page requests."""
        shown = await self.console.mujoco_viewer.shown()
        query = request.query_params
        if shown is None or query.get("crc32", str(shown.crc)) != str(shown.crc):
            return _error(404, "no_model", self.console.mujoco_viewer.missing or "The model has changed.")
        if "total_bytes" in query:
            return _json(encode({"total_bytes": len(shown.bundle)}))
        start = int(query.get("offset_bytes", 0))
        length = int(query.get("size_bytes", len(shown.bundle)))
        if start < 0 or length < 0:
            return _error(400, "bad_request", "The offset and the size of a part must not be negative.")
        return Response(shown.bundle[start : start + length], media_type="application/octet-stream")

    async def _poses(self, socket: WebSocket) -> None:
        await socket.accept()
        await socket.send_text(mujoco_viewer.SPECTATOR)
        flow = _Flow()
        with self.console.bell() as changed:

            async def send() -> None:
                sent = told = None
                with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                    while True:
                        changed.clear()
                        snapshot = self.console.snapshot
                        shown = await self.console.mujoco_viewer.shown()
                        if shown and shown is not told:
                            told = shown
                            await socket.send_text(mujoco_viewer.LAYOUT + shown.layout)
                        if shown and snapshot and snapshot is not sent and flow.sent - flow.acknowledged < _AHEAD:
                            sent = snapshot
                            flow.sent += 1
                            await socket.send_bytes(self.console.mujoco_viewer.write(shown, snapshot))
                        await changed.wait()

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(send)
                while (said := await socket.receive())["type"] == "websocket.receive":
                    # The page also asks for control of MuJoCo's own panels, which the console does not have.
                    if said.get("text") == mujoco_viewer.SHOWN:
                        flow.acknowledged += 1
                        changed.set()
                tasks.cancel_scope.cancel()

    async def _taken(self, socket: WebSocket) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # gone already
            await socket.accept()
            await socket.close(mujoco_viewer.TAKEN, "this page watches")

    # Viewers

    def _viewer(self, request: HTTPConnection) -> Viewer:
        """Return the viewer that sent a request: a page that watches, or a program with a key."""
        found = self._viewers.get(request.headers.get(_VIEWER, ""))
        return found or Viewer(f"key:{request.scope.get('urlab_key')}", "a program")

    def _new_name(self) -> str:
        taken = {viewer.name for viewer in self._viewers.values()}
        return next(name for n in range(1, len(taken) + 2) if (name := f"Viewer {n}") not in taken)


class _Checked(StaticFiles):
    """Large files that a browser caches and revalidates on each use."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["cache-control"] = "no-cache"
        return response


async def _said(socket: WebSocket) -> str:
    """Return the next text that a browser sends.

    Raises:
        WebSocketDisconnect: The browser is gone, or it sent a binary frame, for which the socket is closed.
    """
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message["code"], message.get("reason"))
    text: str | None = message.get("text")
    if text is None:
        await socket.close(1003, "this socket takes text")
        raise WebSocketDisconnect(1003)
    return text


class _Flow:
    """Counts messages that a browser has not acknowledged."""

    def __init__(self) -> None:
        self.sent = self.acknowledged = 0
        self.changed = anyio.Event()


def _now_ms() -> float:
    return time.time() * 1e3


def _answering(handler: Handler) -> Handler:
    """Turn a handler's exceptions into responses."""

    async def answer(request: Request) -> Response:
        try:
            return await handler(request)
        except ClientDisconnect:
            return Response(status_code=_GONE)  # the client is gone
        except (NotDriving, URLabError, OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            status, said = explain_error(error)
            return _json(encode({"error": said}), status)

    return answer


async def _body(request: Request) -> bytes:
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > _LARGEST_BODY:
            raise ValueError(f"a body is at most {_LARGEST_BODY} bytes")
    return bytes(body)


def _json(body: bytes, status: int = 200) -> Response:
    return Response(body, status, media_type="application/json")


def _error(status: int, code: str, message: str, hint: str = "") -> Response:
    return _json(encode({"error": {"code": code, "message": message, "hint": hint}}), status)


def showing(registry: CollectorRegistry) -> Callable[[Request], Response]:
    """Return a handler that serves the metrics of a registry in the requested format."""
    from prometheus_client.exposition import choose_encoder

    def show(request: Request) -> Response:
        encode_all, media_type = choose_encoder(request.headers.get("accept", ""))
        return Response(encode_all(registry), headers={"content-type": media_type})

    return show
