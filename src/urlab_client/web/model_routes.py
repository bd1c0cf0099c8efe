"""Model uploads in the HTTP API."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import Response

from urlab_client.console.model_import import WouldReplace, import_model, received_model
from urlab_client.console.ops import encode
from urlab_client.web.route_group import JOB, Handler, RouteGroup


class ModelRoutes(RouteGroup):
    """Handler of `/api/models`."""

    def routes(self) -> list[tuple[str, Handler, list[str]]]:
        """Return path, handler and methods of each route."""
        return [("/api/models/{name}", self._take, ["PUT"])]

    async def _take(self, request: Request) -> Response:
        viewer, name = self._viewer(request), request.path_params["name"]
        request.scope[JOB] = f"the import of {name}"
        async with self._console.lease.hold(viewer):  # large models take longer than the controls are kept
            await self._console.opened()
            model = await received_model(name, request.stream())
            try:
                made = await import_model(self._console.client, name, model, request.query_params.get("replace", ""))
            except WouldReplace as error:
                hint = f"Send it again with ?replace={error.name} to replace it."
                said = {"code": "would_replace", "message": str(error), "hint": hint, "name": error.name}
                return Response(encode({"error": said}), 409, media_type="application/json")
        self._console.note("call", viewer.name, "import model", name)
        return Response(encode({"blueprint": made.class_path, "name": made.short_name}), media_type="application/json")
