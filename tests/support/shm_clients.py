"""Clients that talk to the scripted server over shared memory."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncGenerator, Callable
from typing import Any

from urlab_client.aio import URLabClient


@contextlib.asynccontextmanager
async def shm_clients(port: int) -> AsyncGenerator[Callable[..., URLabClient]]:
    """Give what makes clients of the server at this port, with options of its own; they are closed in the end."""
    made: list[URLabClient] = []

    def connect(**options: Any) -> URLabClient:
        defaults: dict[str, Any] = {"step_port": port, "rcv_timeout_ms": 500, "local_model": False}
        made.append(URLabClient("tcp://127.0.0.1", transport="shm", **(defaults | options)))
        return made[-1]

    yield connect
    for client in made:
        await client.close()


async def shared(client: URLabClient) -> URLabClient:
    """Discover, and step once: the first reply's size is not known yet, so that goes over ZMQ."""
    await client.discover()
    await client.step()
    return client
