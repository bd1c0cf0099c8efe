"""A server whose every answer a test dictates, and a client of it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator

import pytest
from scripted import ScriptedServer

from urlab_client.aio import URLabClient


@pytest.fixture
def scripted() -> Iterator[ScriptedServer]:
    server = ScriptedServer()
    yield server
    server.close()


@pytest.fixture
async def client(scripted: ScriptedServer) -> AsyncIterator[URLabClient]:
    """A client of the scripted server."""
    async with URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False) as made:
        yield made
