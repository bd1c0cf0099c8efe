"""Serving pages: a socket that listens before its link is printed, and uvicorn until a signal."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
from collections.abc import Callable, Generator

import uvicorn
from starlette.types import ASGIApp

from urlab_client.aio.background import background_task
from urlab_client.cli._common import in_background, sigterm_interrupts
from urlab_client.cli._connections import bounded_connections
from urlab_client.cli._requests import RunningRequests

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
        lifespan: Whether the server runs the application's lifespan; otherwise the caller does.
        head_s: See `bounded_connections`.
        body_s: Likewise.
        connections: Likewise, `most`.
    """
    requests = RunningRequests(application)
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

    server = Server(config)

    async def end(event: asyncio.Event) -> None:
        try:
            await event.wait()
        finally:
            server.should_exit = True

    ending = None if ended is None else background_task("urlab-end", end(ended))
    try:
        await server.serve(sockets=[listener])
        await asyncio.sleep(0)
    except asyncio.CancelledError:
        # uvicorn raises the signal that ended it again, and asyncio's cancellation must not interrupt the clean-up.
        task = asyncio.current_task()
        if task is None or task.uncancel():
            raise
    finally:
        if ending is not None:
            ending.cancel()
