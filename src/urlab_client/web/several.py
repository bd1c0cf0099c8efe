"""Several servers behind one application: a console for each, with shared access rules."""

from __future__ import annotations

import contextlib
import html
import os
import re
from collections.abc import AsyncGenerator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Mount, Route

from urlab_client.console.ops import encode
from urlab_client.web.access import Access, Guarded
from urlab_client.web.application import app, entrance, showing

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

    from urlab_client.aio import URLabClient

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_TAKEN = frozenset({"api", "metrics"})
_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>URLab consoles</title><body><h1>Servers</h1><ul>{items}</ul></body></html>"""


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
                f"{name!r} cannot be the name of a server: use letters, digits, _ and -, but not 'api' or 'metrics'"
            )
    if not clients:
        raise ValueError("apps: pass at least one client")
    door = access or Access()
    consoles = {
        name: app(client, access=door, lease_seconds=lease_seconds, recordings=Path(recordings) / name)
        for name, client in clients.items()
    }

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        async with contextlib.AsyncExitStack() as stack:
            for console in consoles.values():
                await stack.enter_async_context(console.router.lifespan_context(console))
            yield

    async def page(request: Request) -> Response:
        items = "".join(
            f'<li><a href="{name}/">{name}</a> {html.escape(client.address)}</li>' for name, client in clients.items()
        )
        return HTMLResponse(_PAGE.format(items=items))

    async def listed(request: Request) -> Response:
        root = request.scope.get("root_path", "")
        found = [
            {
                "name": name,
                "path": f"{root}/{name}/",
                "address": clients[name].address,
                "link": console.state.console.link,
                "playing": clients[name].manager_present,
            }
            for name, console in consoles.items()
        ]
        return Response(encode(found), media_type="application/json")

    # Access is checked once for each path: here, and by each console for its own paths.
    index = Starlette(
        routes=[
            Route("/", page),
            Route("/api/servers", listed),
            Route("/api/session", entrance(door), methods=["POST"]),
            *([] if metrics is None else [Route("/metrics", showing(metrics))]),
        ],
        middleware=[Middleware(Guarded, access=door)],
    )
    application = Starlette(
        routes=[*(Mount(f"/{name}", console) for name, console in consoles.items()), Mount("/", index)],
        lifespan=lifespan,
    )
    application.state.access = door
    application.state.consoles = {name: console.state.console for name, console in consoles.items()}
    return application
