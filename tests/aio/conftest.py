"""A server whose every answer a test dictates, and a client of it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator

import pytest
from scripted import ScriptedServer, client_of
from scripted_beta import ScriptedBeta

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


@pytest.fixture
def beta() -> Iterator[ScriptedBeta]:
    """A server of the beta that is written from the description of its wire alone."""
    server = ScriptedBeta()
    yield server
    server.close()


@pytest.fixture
async def beta_client(beta: ScriptedBeta) -> AsyncIterator[URLabClient]:
    """A client of that server, in direct mode; what it said until then is forgotten."""
    async with client_of(beta, step_mode="direct") as made:
        await made.discover()
        beta.arrived()
        yield made
