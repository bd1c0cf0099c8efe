"""Serving pages: a socket that is bound before anybody is told of it, and uvicorn until a signal ends it."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Generator

import uvicorn
from starlette.types import ASGIApp

from urlab_client.cli._ending import sigterm_interrupts
from urlab_client.cli._requests import RunningRequests

__all__ = ["bound", "ending_well", "serve"]

_FINISHING_S = 0.2  # for what is nearly done, after which it is broken off
_GRACE_S = 10.0  # for what was broken off to clear up


@contextlib.contextmanager
def ending_well() -> Generator[None]:
    """Let SIGTERM end the body as SIGINT does, and take that for its end."""
    # KeyboardInterrupt comes in the moment before uvicorn listens for it.
    with contextlib.suppress(KeyboardInterrupt), sigterm_interrupts():
        yield


def bound(host: str, number: int) -> socket.socket:
    """Return a socket that listens.

    Raises:
        OSError: The port is in use, or there is no such interface.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sends small messages at once only on sockets that say they are TCP; others wait for the peer, up to 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, number))
        listener.listen()  # before the link is printed: whoever is quick waits, and is not refused
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
) -> None:
    """Serve until SIGINT or SIGTERM. What takes longer is broken off then, and a warning says what it was.

    Args:
        application: What to serve.
        listener: Where.
        started: Called when Ctrl-C ends it in good order.
        ended: Ends it, too.
        lifespan: Whether the application's lifespan is that of the server; else it is the caller's.
    """
    requests = RunningRequests(application)
    config = uvicorn.Config(
        requests,
        log_config=None,
        access_log=False,
        ws="websockets-sansio",
        ws_max_size=1024 * 1024,
        timeout_graceful_shutdown=round(_FINISHING_S + _GRACE_S),
        proxy_headers=False,
        server_header=False,
        lifespan="on" if lifespan else "off",
    )

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            if self.started:
                started()

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            breaking_off = asyncio.get_running_loop().call_later(
                _FINISHING_S, requests.break_off, self.server_state.connections
            )
            try:
                await super().shutdown(sockets)
            finally:
                breaking_off.cancel()

    server = Server(config)

    async def end(event: asyncio.Event) -> None:
        await event.wait()
        server.should_exit = True

    ending = None if ended is None else asyncio.create_task(end(ended))
    try:
        await server.serve(sockets=[listener])
        await asyncio.sleep(0)
    except asyncio.CancelledError:
        # uvicorn repeats the signal that ended it, and what asyncio makes of it must not break off the closing.
        task = asyncio.current_task()
        if task is None or task.uncancel():
            raise
    finally:
        if ending is not None:
            ending.cancel()
