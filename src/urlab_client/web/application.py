"""The Starlette application: the page, the HTTP API and the WebSockets, for one server or for several."""

from __future__ import annotations

import contextlib
import html
import os
import re
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from urlab_client.console import mujoco_viewer
from urlab_client.console.session import ConsoleSession
from urlab_client.web import file_routes, live
from urlab_client.web import routes as api
from urlab_client.web.access import Access, Guarded
from urlab_client.web.documents import openapi
from urlab_client.web.endpoints import BYTES, JSON, Call, Endpoint, Site, json_response, refusal, routes

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

    from urlab_client.aio import URLabClient

_STATIC = Path(__file__).parent / "static"
_ENDPOINTS = tuple(one for module in (api, file_routes) for one in vars(module).values() if isinstance(one, Endpoint))
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_TAKEN = frozenset({"api", "healthz", "metrics"})
_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>URLab consoles</title><body><h1>Servers</h1><ul>{items}</ul></body></html>"""


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
    session = ConsoleSession(client, recordings=Path(recordings), lease_seconds=lease_seconds, handshake=handshake)
    return application_of(session, access or Access(), metrics)


def application_of(session: ConsoleSession, access: Access, metrics: CollectorRegistry | None = None) -> Starlette:
    """Make the application of a session, which is open during its lifespan."""

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        async with session.open():
            yield

    site = Site(session, access, metrics)
    application = Starlette(routes=_routes(site), middleware=[Middleware(Guarded, access=access)], lifespan=lifespan)
    application.state.access = access
    application.state.console = session
    return application


def apps(
    clients: Mapping[str, URLabClient],
    *,
    access: Access | None = None,
    lease_seconds: float = 20.0,
    metrics: CollectorRegistry | None = None,
    recordings: str | os.PathLike[str] = "recordings",
) -> Starlette:
    """Make one application with a console for each of several servers.

    Each console is at `/NAME/`, with its own controls, and `/` links to them; `GET /api/servers` lists them with the
    state of their connections. A token or key of `access` is valid for all. As with `app`, enter the lifespan of the
    application when you mount it, and close the clients yourself.

    Args:
        clients: An async client of the serving event loop for each server, by the name in its path: letters, digits,
            `_` and `-`.
        access: Access rules. By default, requests reach the application on this machine, with a token of
            `site.state.access.invite()`.
        lease_seconds: How long a viewer keeps the controls of a server without using them.
        metrics: Registry that `/metrics` serves to Prometheus, behind the same access rules; None leaves the path out.
        recordings: Folder of the recordings, with a folder in it for each server.

    Raises:
        ValueError: There is no client, or a name cannot be part of a path.
    """
    for name in clients:
        if not _NAME.fullmatch(name) or name in _TAKEN:
            raise ValueError(
                f"{name!r} cannot be the name of a server: use letters, digits, _ and -, but not {sorted(_TAKEN)}"
            )
    if not clients:
        raise ValueError("apps: pass at least one client")
    access = access or Access()
    consoles = {
        name: app(client, access=access, lease_seconds=lease_seconds, recordings=Path(recordings) / name)
        for name, client in clients.items()
    }
    sessions: dict[str, ConsoleSession] = {name: console.state.console for name, console in consoles.items()}

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        async with contextlib.AsyncExitStack() as stack:
            for session in sessions.values():
                await stack.enter_async_context(session.open())
            yield

    # Access is checked once for each path: here, and by each console for its own paths.
    index = Starlette(routes=_index(sessions, access, metrics), middleware=[Middleware(Guarded, access=access)])
    application = Starlette(
        routes=[*(Mount(f"/{name}", console) for name, console in consoles.items()), Mount("/", index)],
        lifespan=lifespan,
    )
    application.state.access = access
    application.state.consoles = sessions
    return application


def _index(sessions: Mapping[str, ConsoleSession], access: Access, metrics: CollectorRegistry | None) -> list[Route]:
    """Return the routes above those of the consoles."""

    async def page(_: Request) -> Response:
        items = "".join(
            f'<li><a href="{name}/">{name}</a> {html.escape(session.client.address)}</li>'
            for name, session in sessions.items()
        )
        return HTMLResponse(_PAGE.format(items=items))

    async def servers(request: Request) -> Response:
        root = request.scope.get("root_path", "")
        found = [
            {
                "name": name,
                "path": f"{root}/{name}/",
                "address": session.client.address,
                "link": session.link,
                "playing": session.client.manager_present,
            }
            for name, session in sessions.items()
        ]
        return json_response(found)

    site = Site(next(iter(sessions.values())), access, metrics)
    shared = [api.enter, api.health, *([] if metrics is None else [api.metrics])]
    return [Route("/", page), Route("/api/servers", servers), *routes(shared, site)]


def _routes(site: Site) -> list[Route | WebSocketRoute | Mount]:
    documented = tuple(one for one in _ENDPOINTS if one is not api.metrics or site.metrics is not None)

    async def page(_: Request) -> Response:
        return FileResponse(_STATIC / "index.html")

    async def openapi_document(call: Call) -> Response:
        return Response(openapi(documented, call.root), media_type=JSON)

    undocumented = [
        Endpoint("GET", "/api/openapi.json", openapi_document),
        Endpoint("POST", "/api/ops/{op}", api.perform_op),
    ]
    return [
        Route("/", page),
        *routes([*documented, *undocumented], site),
        *(_socket(one.path, one.serve, site) for one in live.SOCKETS),
        Mount("/static", _compressed(_STATIC)),
        *_viewer_routes(site),
    ]


def _socket(path: str, serve: Callable[[ConsoleSession, WebSocket], Awaitable[None]], site: Site) -> WebSocketRoute:
    async def serve_one(socket: WebSocket) -> None:
        await serve(site.console, socket)

    return WebSocketRoute(path, serve_one)


# The 3-D view


def _viewer_routes(site: Site) -> list[Route | WebSocketRoute | Mount]:
    shipped = mujoco_viewer.files()
    if shipped is None:
        return []

    async def page(_: Request) -> Response:
        return Response(shipped.page, media_type="text/html", headers={"content-security-policy": shipped.policy})

    return [
        Route("/viewer/", page),
        *routes([Endpoint("GET", "/viewer/model", _model)], site),
        _socket("/viewer/state", live.poses, site),
        _socket("/viewer/ui", live.refuse_panels, site),
        Mount("/viewer/assets", _compressed(shipped.assets)),
        Mount("/viewer", _compressed(shipped.dist)),
    ]


async def _model(call: Call) -> Response:
    """Return the model, its size, or a part of it, as the viewer's page requests."""
    shown = await call.console.mujoco_viewer.shown()
    query = call.request.query_params
    if shown is None or query.get("crc32", str(shown.crc)) != str(shown.crc):
        missing = mujoco_viewer.no_view(call.console.client)
        return refusal(404, "no_model", missing or "The model has changed.")
    if "total_bytes" in query:
        return json_response({"total_bytes": len(shown.bundle)})
    start = int(query.get("offset_bytes", 0))
    length = int(query.get("size_bytes", len(shown.bundle)))
    if start < 0 or length < 0:
        return refusal(400, "bad_request", "The offset and the size of a part must not be negative.")
    return Response(shown.bundle[start : start + length], media_type=BYTES)


def _compressed(folder: Path) -> ASGIApp:
    return GZipMiddleware(_RevalidatedFiles(directory=folder), compresslevel=4)  # 16 MB become 6, in 0.2 s


class _RevalidatedFiles(StaticFiles):
    """Large files that a browser caches and revalidates on each use."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["cache-control"] = "no-cache"
        return response
