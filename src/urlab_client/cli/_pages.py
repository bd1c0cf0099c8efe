"""Serving pages: a socket that listens before its link is printed, and uvicorn until a signal.

uvicorn bounds neither the number of connections nor how long a peer may stay silent, and logs requests that its end
interrupts as failures; the two classes below mend that.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import socket
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from types import FrameType
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from urlab_client.cli._common import in_background, sigterm_interrupts
from urlab_client.web.endpoints import JOB

log: logging.Logger = logging.getLogger("urlab_client.web")

_FINISHING_S = 0.2  # for requests to finish before they are cancelled
_GRACE_S = 10.0  # for cancelled requests to clean up
_HEAD_S = 10.0
_BODY_S = 30.0
_CONNECTIONS = 500


@contextlib.contextmanager
def graceful_exit() -> Generator[None]:
    """Let SIGTERM end the block as SIGINT does, and suppress the KeyboardInterrupt."""
    # A signal before uvicorn has installed its handlers raises KeyboardInterrupt.
    with contextlib.suppress(KeyboardInterrupt), sigterm_interrupts():
        yield


def bound(host: str, number: int) -> socket.socket:
    """Return a socket that listens.

    Raises:
        OSError: The port is in use, or the interface does not exist.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sets TCP_NODELAY only on sockets that name IPPROTO_TCP; on others a small message waits up to 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, number))
        listener.listen()  # before the link is printed, so that an early connection waits instead of being refused
    except OSError as error:
        listener.close()
        raise OSError(
            error.errno, f"port {number} of {host} cannot be used: {error.strerror}; --port 0 takes any free one"
        ) from None
    return listener


async def serve(
    application: ASGIApp,
    listener: socket.socket,
    started: Callable[[], None],
    ended: asyncio.Event | None = None,
    *,
    public_url: str = "",
    lifespan: bool = True,
    head_s: float = _HEAD_S,
    body_s: float = _BODY_S,
    connections: int = _CONNECTIONS,
) -> None:
    """Serve until SIGINT or SIGTERM. Requests that do not finish then are cancelled, and a warning names each.

    Args:
        application: The application to serve.
        listener: A listening socket.
        started: Callback invoked once Ctrl-C ends the server cleanly.
        ended: Event that ends the server, too.
        public_url: URL by which browsers reach the application through a proxy, which removes its path.
        lifespan: Whether the server runs the application's lifespan; otherwise the caller does.
        head_s: See `bounded_connections`.
        body_s: Likewise.
        connections: Likewise, `most`.
    """
    requests = RunningRequests(application, encrypted=public_url.startswith("https:"))
    config = uvicorn.Config(
        requests,
        http=bounded_connections(head_s, body_s, connections),
        log_config=None,
        access_log=False,
        ws="websockets-sansio",
        ws_max_size=1024 * 1024,
        timeout_graceful_shutdown=round(_FINISHING_S + _GRACE_S),
        proxy_headers=False,
        server_header=False,
        root_path=urlsplit(public_url).path.rstrip("/"),
        lifespan="on" if lifespan else "off",
    )

    background = in_background()

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            if background:
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # which uvicorn has replaced, and puts back at its end
            if self.started:
                started()

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            cancelling = asyncio.get_running_loop().call_later(
                _FINISHING_S, requests.cancel, self.server_state.connections
            )
            try:
                await super().shutdown(sockets)
            finally:
                cancelling.cancel()

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            if not self.should_exit:  # a second one would break off the application's clean-up, which is bounded
                super().handle_exit(sig, frame)

        async def on_tick(self, counter: int) -> bool:
            return await super().on_tick(counter) or (ended is not None and ended.is_set())

    try:
        await Server(config).serve(sockets=[listener])
        await asyncio.sleep(0)
    except asyncio.CancelledError:
        # uvicorn raises the signal that ended it again, and asyncio's cancellation must not interrupt the clean-up.
        task = asyncio.current_task()
        if task is None or task.uncancel():
            raise


def bounded_connections(head_s: float, body_s: float, most: int) -> type[H11Protocol]:
    """Return the protocol of the connections of one server, which ends those whose peer stays silent.

    Args:
        head_s: Time for the whole head of a request, seconds.
        body_s: Time between two parts of a request's body, seconds.
        most: Number of connections. One more ends the oldest of those that have not sent a head yet.
    """
    without_head: dict[Connection, None] = {}

    class Connection(H11Protocol):
        """A connection with a clock that runs while the peer owes the rest of a head or of a body."""

        _clock: asyncio.TimerHandle | None = None

        def connection_made(  # pyright: ignore[reportIncompatibleMethodOverride]  # as in uvicorn
            self, transport: asyncio.Transport
        ) -> None:
            super().connection_made(transport)
            self._watch()
            if len(self.connections) > most:
                next(iter(without_head), self).end()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._watch()

        def on_response_complete(self) -> None:
            super().on_response_complete()
            self._stop()  # until the peer sends something, uvicorn's own clock for idle connections runs
            if not self._awaits_head:  # the next request had come already
                self._watch()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop()
            super().connection_lost(exc)

        @property
        def _awaits_head(self) -> bool:
            cycle: Any = self.cycle  # None before the first request
            return cycle is None or cycle.response_complete

        def _watch(self) -> None:
            ours = self in self.connections and not self.transport.is_closing()  # else it is a WebSocket, or ends
            if ours and self._awaits_head and self in without_head:
                return  # a head has the same time, however many bytes come
            self._stop()
            if ours and self._awaits_head:
                without_head[self] = None
                self._clock = self.loop.call_later(head_s, self.end)
            elif ours and self.cycle.more_body:
                self._clock = self.loop.call_later(body_s, self._end_unless_paused)

        def _stop(self) -> None:
            without_head.pop(self, None)
            if self._clock is not None:
                self._clock.cancel()
                self._clock = None

        def _end_unless_paused(self) -> None:
            if self.flow.read_paused:  # the application is slow, not the peer
                self._watch()
            else:
                self.end()

        def end(self) -> None:
            """Close the connection."""
            self._stop()
            self.transport.close()

    return Connection


@dataclass(eq=False)
class _Request:
    task: asyncio.Task[Any]
    scope: Scope
    begun: bool = False
    """Whether its response has begun."""
    answered: bool = False
    """Whether its response has been sent completely."""


class RunningRequests:
    """ASGI middleware that cancels the requests which still run when the server ends, without a traceback.

    If they are `encrypted`, up to a proxy, the application hears so.
    """

    def __init__(self, application: ASGIApp, *, encrypted: bool = False) -> None:
        self._application = application
        self._encrypted = encrypted
        self._running: set[_Request] = set()
        self._connections: Iterable[Any] | None = None

    def cancel(self, connections: Iterable[Any]) -> None:
        """Cancel the running requests, log a warning for each, and abort the connections of unfinished responses."""
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
        if self._encrypted:
            scope["scheme"] = "https" if scope["type"] == "http" else "wss"
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
