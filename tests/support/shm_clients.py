"""Clients that talk to the scripted server over shared memory."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncGenerator, Callable
from typing import Any
from unittest import mock

from waiting import DEADLINE_S

from urlab_client.aio import URLabClient
from urlab_client.aio.transport import shm


@contextlib.asynccontextmanager
async def shm_clients(port: int) -> AsyncGenerator[Callable[..., URLabClient]]:
    """Give what makes clients of the server at this port, with options of its own; they are closed in the end.

    They wait for as long as it takes until a new session may use its regions, so that it shows what goes which way.
    """
    made: list[URLabClient] = []

    def connect(**options: Any) -> URLabClient:
        defaults: dict[str, Any] = {"step_port": port, "rcv_timeout_ms": round(1e3 * DEADLINE_S), "local_model": False}
        made.append(URLabClient("tcp://127.0.0.1", transport="shm", **(defaults | options)))
        return made[-1]

    with mock.patch.object(shm, "_SETTLE_S", DEADLINE_S):
        yield connect
    for client in made:
        await client.close()


async def shared(client: URLabClient) -> URLabClient:
    """Discover, and step once: the first reply's size is not known yet, so that goes over ZMQ."""
    await client.discover()
    await client.step()
    return client
