"""A part of the HTTP API: handlers that share the console's session."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeAlias

from starlette.requests import Request
from starlette.responses import Response

from urlab_client.console.lease import Viewer
from urlab_client.console.session import ConsoleSession

JOB = "urlab_job"
"""Key in the scope of a long request: its description, for the warning if the server ends meanwhile."""

Handler: TypeAlias = Callable[[Request], Awaitable[Response]]


class RouteGroup:
    """Handlers of some routes.

    Args:
        console: The session that all viewers share.
        viewer: Returns the viewer that sent a request.
    """

    def __init__(self, console: ConsoleSession, viewer: Callable[[Request], Viewer]) -> None:
        self._console = console
        self._viewer = viewer
