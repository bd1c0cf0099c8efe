"""The same tests for both flavours of the client and both dialects of the simulated server, over real transports.

A test is written once, with `await`. For the façade its objects are wrapped so that blocking calls run in a thread.
Each test runs over ZeroMQ: blocking on the alpha, and async, as the façade is inside, on the beta; over shared memory,
too, in `test_shared_memory`. With `-m long`, three combinations more make every pair of flavour, transport and dialect
complete; with `-m matrix`, the rest of them runs.
"""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import anyio.to_thread
import gymnasium
import numpy as np
import pytest
from resting import rest

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


class Servers:
    """Servers that are kept for the next test with the same wishes: bringing one back is quicker than starting it."""

    MOST = 4

    def __init__(self) -> None:
        self._idle: dict[str, SimulatedServer] = {}

    @contextmanager
    def lend(self, *models: Any, **options: Any) -> Iterator[SimulatedServer]:
        """Hand out a server as it is after its start."""
        wishes = repr((models, sorted(options.items())))
        server = self._idle.pop(wishes, None)
        if server is None:
            server = SimulatedServer(*models, **options).start()
        else:
            server.restore()
        try:
            yield server
        except BaseException:
            server.close()
            raise
        rest(server)
        self._idle[wishes] = server
        if len(self._idle) > self.MOST:
            self._idle.pop(next(iter(self._idle))).close()

    def close(self) -> None:
        for server in self._idle.values():
            server.close()


Connect = Callable[..., Any]
Serve = Callable[..., AbstractContextManager[SimulatedServer]]


MARKED = {
    ("aio", "zmq", "alpha"): "long",
    ("aio", "shm", "alpha"): "long",
    ("sync", "shm", "beta"): "long",
    ("aio", "shm", "beta"): "matrix",
    ("sync", "shm", "alpha"): "matrix",
    ("sync", "zmq", "beta"): "matrix",
}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what adds little: the façade knows nothing of dialects, and most of the client nothing of transports.

    With `--address`, leave only what can run against any server.
    """
    anywhere = [
        item for item in items if item.path.name == "test_statements.py" and item.name.startswith("test_check[")
    ]
    if config.getoption("--address"):
        items[:] = anywhere
        return
    items[:] = [item for item in items if item not in anywhere]
    here = Path(__file__).parent
    for item in items:
        if here not in item.path.parents:  # pytest hands over those of all folders
            continue
        chosen = item.callspec.params if isinstance(item, pytest.Function) and hasattr(item, "callspec") else {}
        if combination := MARKED.get(tuple(chosen.get(name) for name in ("connect", "transport", "dialect"))):
            item.add_marker(combination)
        elif chosen.get("transport") == "shm" or (chosen.get("connect"), chosen.get("dialect")) == ("sync", "beta"):
            item.add_marker("long")


@pytest.fixture(scope="module")
def servers() -> Iterator[Servers]:
    made = Servers()
    yield made
    made.close()


@pytest.fixture(scope="session")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory of all servers' shared memory; its name is short, as those of sockets must be."""
    return tmp_path_factory.getbasetemp()


@pytest.fixture(params=["alpha", "beta"])
def dialect(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(params=["zmq", "shm"])
def transport(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def applied(dialect: str) -> Callable[[float], float]:
    """What the server makes of a set-point."""
    return {"alpha": lambda value: float(np.float32(value)), "beta": float}[dialect]


@pytest.fixture
def serve(servers: Servers, dialect: str, transport: str, memory: Path) -> Serve:
    """Lend servers of one dialect, with the regions that the clients of the test need."""
    return partial(servers.lend, dialect=dialect, shm_dir=memory if transport == "shm" else None)


@pytest.fixture(params=["aio", "sync"])
async def connect(request: pytest.FixtureRequest, transport: str) -> AsyncIterator[Connect]:
    """Make clients of one flavour; closed after the test."""
    made: list[Any] = []

    def connect(server: SimulatedServer | None = None, **options: Any) -> Any:
        if server is not None:
            options = {**server.client_options(), "transport": transport, **options}
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


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for a module's models, which outlive their tests as the servers do."""
    return tmp_path_factory.mktemp("models")
