"""Bodies in the HTTP API: listing, picking and pushing them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import msgspec
from starlette.requests import Request
from starlette.responses import Response

from urlab_client.console.body_pushing import BodyPushing, Pick, Push
from urlab_client.console.lease import Viewer
from urlab_client.console.ops import encode
from urlab_client.web.route_group import Handler


class BodyRoutes:
    """Handlers of `/api/bodies`, `/api/pick` and `/api/push`.

    Args:
        body_pushing: The bodies of the console.
        viewer: Says who asks.
        body: Reads what a request carries.
    """

    def __init__(
        self,
        body_pushing: BodyPushing,
        viewer: Callable[[Request], Viewer],
        body: Callable[[Request], Awaitable[bytes]],
    ) -> None:
        self._body_pushing = body_pushing
        self._viewer = viewer
        self._body = body

    def routes(self) -> list[tuple[str, Handler, list[str]]]:
        """Return path, handler and methods of each route."""
        return [
            ("/api/bodies", self._bodies, ["GET"]),
            ("/api/bodies/{id:int}", self._one, ["GET"]),
            ("/api/pick", self._pick, ["POST"]),
            ("/api/push", self._push, ["POST", "DELETE"]),
        ]

    async def _bodies(self, request: Request) -> Response:
        return _json(await self._body_pushing.bodies())

    async def _one(self, request: Request) -> Response:
        return _json(await self._body_pushing.body(request.path_params["id"]))

    async def _pick(self, request: Request) -> Response:
        return _json(await self._body_pushing.pick(msgspec.json.decode(await self._body(request), type=Pick)))

    async def _push(self, request: Request) -> Response:
        if request.method == "DELETE":
            self._body_pushing.release(self._viewer(request))
        else:
            push = msgspec.json.decode(await self._body(request), type=Push)
            await self._body_pushing.push(self._viewer(request), push)
        return _json({})


def _json(value: object) -> Response:
    return Response(encode(value), media_type="application/json")
