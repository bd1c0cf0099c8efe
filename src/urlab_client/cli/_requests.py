"""Requests that are still running when their server ends: each is cancelled cleanly, without a traceback."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from urlab_client.web.endpoints import JOB

log: logging.Logger = logging.getLogger("urlab_client.web")


@dataclass(eq=False)
class _Request:
    task: asyncio.Task[Any]
    scope: Scope
    begun: bool = False
    """Whether its response has begun."""
    answered: bool = False
    """Whether its response has been sent completely."""


class RunningRequests:
    """ASGI middleware that tracks running requests.

    Args:
        application: The wrapped application.
    """

    def __init__(self, application: ASGIApp) -> None:
        self._application = application
        self._running: set[_Request] = set()
        self._connections: Iterable[Any] | None = None

    def cancel(self, connections: Iterable[Any]) -> None:
        """Cancel the running requests, and log a warning for each.

        Args:
            connections: uvicorn's connections, of which those that wait for the rest of a response are aborted.
        """
        self._connections = list(connections)
        for request in self._running:
            request.task.cancel()
            job = request.scope.get(JOB)
            if job is None and request.scope["type"] == "http" and request.scope["method"] != "GET":
                job = f"{request.scope['method']} {request.scope['path']}"
            if job is not None and not request.answered:
                log.warning("%s was broken off", job)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or serve a WebSocket."""
        task = asyncio.current_task()
        if scope["type"] == "lifespan" or task is None:
            await self._application(scope, receive, send)
            return
        request = _Request(task, scope)

        async def sending(message: Message) -> None:
            request.begun = True
            await send(message)
            request.answered = message["type"] == "http.response.body" and not message.get("more_body", False)

        self._running.add(request)
        try:
            await self._application(scope, receive, sending)
        except asyncio.CancelledError:
            if self._connections is None:
                raise
            # Nothing else is left to do in this task, and uvicorn would log an escaping error as a failure.
            task.uncancel()
            await self._end(request, receive, send)
        finally:
            self._running.discard(request)

    async def _end(self, request: _Request, receive: Receive, send: Send) -> None:
        http = request.scope["type"] == "http"
        if request.answered:
            return
        if http and not request.begun:
            error = {"code": "ended", "message": "The console ended before the request was complete.", "hint": ""}
            await JSONResponse({"error": error}, 503)(request.scope, receive, send)
            return
        for connection in self._connections or ():
            if connection.client == request.scope["client"]:
                connection.transport.abort()
        # uvicorn logs a response that has begun as incomplete, unless its connection has closed by then.
        while http and (await receive())["type"] != "http.disconnect":
            pass
