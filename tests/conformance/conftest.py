"""The same tests for both flavours of the client, against a simulated server over real sockets.

A test is written once, with `await`. For the façade its objects are wrapped so that blocking calls run in a thread.
"""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import anyio.to_thread
import gymnasium
import pytest

import urlab_client
import urlab_client.aio
from urlab_client.server import SimulatedServer
from urlab_client.sync._facade import Facade, aio_of

GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


class Awaited:
    """A façade object whose blocking methods can be awaited; everything else passes through."""

    def __init__(self, twin: Facade) -> None:
        object.__setattr__(self, "twin", twin)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.twin, name)
        if inspect.iscoroutinefunction(getattr(type(aio_of(self.twin)), name, None)):

            async def call(*args: Any, **kwargs: Any) -> Any:
                return await anyio.to_thread.run_sync(lambda: value(*args, **kwargs))

            return call
        if inspect.ismethod(value):
            return lambda *args, **kwargs: awaited(value(*args, **kwargs))
        return awaited(value)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.twin, name, value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Awaited) and self.twin is other.twin

    def __hash__(self) -> int:
        return id(self.twin)


def awaited(value: Any) -> Any:
    """Wrap façade objects, also inside dictionaries."""
    if isinstance(value, Facade):
        return Awaited(value)
    if isinstance(value, dict) and any(isinstance(item, Facade) for item in value.values()):
        return AwaitedMap(value)
    return value


class AwaitedMap:
    """A dictionary of façade objects."""

    def __init__(self, entries: dict[str, Any]) -> None:
        self.entries = entries

    def __getitem__(self, key: str) -> Any:
        return awaited(self.entries[key])

    def __contains__(self, key: str) -> bool:
        return key in self.entries

    def __iter__(self) -> Any:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def get(self, key: str) -> Any:
        return awaited(self.entries.get(key))

    def values(self) -> list[Any]:
        return [awaited(value) for value in self.entries.values()]


Connect = Callable[..., Any]


@pytest.fixture(params=["aio", "sync"])
async def connect(request: pytest.FixtureRequest) -> AsyncIterator[Connect]:
    """Make clients of one flavour; closed after the test."""
    made: list[Any] = []

    def connect(server: SimulatedServer | None = None, **options: Any) -> Any:
        options = {**(server.client_options() if server else {}), **options}
        if request.param == "aio":
            client: Any = urlab_client.aio.URLabClient(**options)
        else:
            client = Awaited(urlab_client.URLabClient(**options))
        made.append(client)
        return client

    yield connect
    for client in made:
        await client.close()


@pytest.fixture
def asset() -> Callable[[str], str]:
    """Path of one of gymnasium's MuJoCo models."""
    return lambda name: str(GYMNASIUM / name)
