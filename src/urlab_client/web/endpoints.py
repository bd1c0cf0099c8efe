"""Declaring the HTTP API: a function's signature is both the route and its entry in the OpenAPI document.

After the `Call`, a parameter that the path names comes from the path, `body` is the decoded JSON, and any other is a
query parameter. The result becomes JSON, unless it is a response already.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, get_type_hints

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from urlab_client.console.lease import NotDriving, Viewer
from urlab_client.console.messages import encode
from urlab_client.console.session import ConsoleSession
from urlab_client.errors import (
    OutcomeUnknown,
    ProtocolError,
    URLabConnectionError,
    URLabError,
    URLabRPCError,
    URLabTimeoutError,
)
from urlab_client.web.access import Access

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

JOB = "urlab_job"
"""Key in the scope of a long request: its description, for the warning if the server ends meanwhile."""

JSON = "application/json"
BYTES = "application/octet-stream"

_VIEWER = "x-urlab-viewer"
_LARGEST_BODY = 1024 * 1024
_GONE = 499  # what servers log if a client closes its request

_Function = Callable[..., Awaitable[Any]]
_Handler = Callable[[Request], Awaitable[Response]]


class Site(NamedTuple):
    """What the endpoints of one application share; `metrics` is None where they are not served."""

    console: ConsoleSession
    access: Access
    metrics: CollectorRegistry | None


class Call(NamedTuple):
    """One request."""

    site: Site
    request: Request

    @property
    def console(self) -> ConsoleSession:
        """The session that all viewers share."""
        return self.site.console

    @property
    def viewer(self) -> Viewer:
        """The viewer that sent it: a page that watches, or a program with a key."""
        found = self.console.viewers.get(self.request.headers.get(_VIEWER, ""))
        return found or Viewer(f"key:{self.request.scope.get('urlab_key')}", "a program")

    def note(self, what: str, text: str) -> None:
        """Add to the log what the viewer did."""
        self.console.view.note("call", self.viewer.name, what, text)

    @property
    def root(self) -> str:
        """The path under which the application is mounted, or a proxy shows it."""
        return str(self.request.scope.get("root_path", ""))


@dataclass(frozen=True, eq=False)
class Endpoint:
    """One operation of the HTTP API.

    Attributes:
        method: Its HTTP method.
        path: Its path, in the form of Starlette's routes.
        function: What it does; its name is the operation's id, its docstring the description.
        drives: Whether it takes the controls before anything else.
        public: Whether it needs no key.
        reply: Type of the JSON in its response, where the function makes the response.
        media: Media type of a response that is not JSON.
        upload: Whether the body is a file's bytes, which the function reads itself.
    """

    method: str
    path: str
    function: _Function
    drives: bool = False
    public: bool = False
    reply: Any = None
    media: str = JSON
    upload: bool = False

    @cached_property
    def _types(self) -> dict[str, Any]:
        return get_type_hints(self.function, include_extras=True)

    @cached_property
    def parameters(self) -> dict[str, tuple[Any, Any]]:
        """Type and default of each parameter after the call, by name; `Parameter.empty` without default."""
        found = list(inspect.signature(self.function).parameters.values())[1:]
        return {one.name: (self._types[one.name], one.default) for one in found}

    @cached_property
    def in_path(self) -> frozenset[str]:
        """Names of the parameters in the path."""
        return frozenset(re.findall(r"\{(\w+)", self.path))

    @property
    def result(self) -> Any:
        """Type of the JSON in its response; None if that is empty, or is not JSON."""
        made = self._types["return"]
        return self.reply if made is Response or made is type(None) else made

    def handler(self, site: Site) -> _Handler:
        """Return the handler for a site, which turns exceptions into responses."""

        async def answer(request: Request) -> Response:
            try:
                return await self._answer(Call(site, request))
            except ClientDisconnect:
                return Response(status_code=_GONE)  # the client is gone
            except (NotDriving, URLabError, OSError, ValueError, TypeError, KeyError, RecursionError) as error:
                status, described = explain_error(error)
                return json_response({"error": described}, status)

        return answer

    async def _answer(self, call: Call) -> Response:
        if self.drives:
            call.console.lease.use(call.viewer)
        given: dict[str, Any] = {}
        for name, (kind, default) in self.parameters.items():
            wire_name = name.rstrip("_")
            if name == "body":
                raw = await read_body(call.request)
                given[name] = (
                    msgspec.json.decode(raw, type=kind) if raw or default is inspect.Parameter.empty else default
                )
            elif name in self.in_path:
                given[name] = call.request.path_params[name]
            elif wire_name in call.request.query_params:
                given[name] = msgspec.convert(call.request.query_params[wire_name], kind, strict=False)
        result = await self.function(call, **given)
        return result if isinstance(result, Response) else json_response({} if result is None else result)


def endpoint(method: str, path: str, **options: Any) -> Callable[[_Function], Endpoint]:
    """Declare a function as an endpoint; see `Endpoint`."""
    return lambda function: Endpoint(method, path, function, **options)


def routes(endpoints: Iterable[Endpoint], site: Site) -> list[Route]:
    """Return a route for each path, whatever its methods."""
    by_path: dict[str, dict[str, _Handler]] = {}
    for one in endpoints:
        by_path.setdefault(one.path, {})[one.method] = one.handler(site)
    return [Route(path, _by_method(handlers), methods=list(handlers)) for path, handlers in by_path.items()]


def _by_method(handlers: dict[str, _Handler]) -> _Handler:
    async def answer(request: Request) -> Response:
        return await handlers["GET" if request.method == "HEAD" else request.method](request)

    return answer


async def read_body(request: Request) -> bytes:
    """Return a request's body.

    Raises:
        ValueError: It is too large.
    """
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > _LARGEST_BODY:
            raise ValueError(f"a body is at most {_LARGEST_BODY} bytes")
    return bytes(body)


def json_response(value: object, status: int = 200) -> Response:
    """Return a response of JSON."""
    return Response(encode(value), status, media_type=JSON)


def refusal(status: int, code: str, message: str, hint: str = "", **more: str) -> Response:
    """Return the response of a request that failed."""
    return json_response({"error": {"code": code, "message": message, "hint": hint, **more}}, status)


def explain_error(error: Exception) -> tuple[int, dict[str, Any]]:
    """Return the HTTP status and the description of an error."""
    hint = (getattr(error, "hint", None) or "") if isinstance(error, URLabError) else ""
    text = error.args[0] if isinstance(error, URLabError) and error.args else str(error)
    match error:
        case NotDriving():
            status, code = 423, "not_driving"
        case URLabRPCError():
            status, code = 409, error.code
            text = error.message
        case URLabTimeoutError():
            status, code = 504, "timeout"
        case OutcomeUnknown():
            status, code = 502, "outcome_unknown"
        case URLabConnectionError():
            status, code = 503, "unreachable"
        case ProtocolError():
            status, code = 502, "failed"
        case URLabError():
            status, code = 409, "refused"
        case OSError():
            status, code = 500, "io_failed"
        case _:
            status, code = 400, "bad_request"
    return status, {"code": code, "message": str(text), "hint": hint}
