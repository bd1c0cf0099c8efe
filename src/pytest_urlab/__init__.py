"""Fixtures for tests of programs that drive URLab: a simulated server and both clients, reset between tests.

pytest loads this module in every run, so it imports nothing of the package before a test asks for a server.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from pytest_urlab.pool import ServerPool
    from urlab_client import URLabClient
    from urlab_client.aio import URLabClient as AsyncURLabClient
    from urlab_client.server import Faults, SimulatedServer

__all__ = [
    "pytest_configure",
    "urlab_aio_client",
    "urlab_client",
    "urlab_default",
    "urlab_faults",
    "urlab_server",
]


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker, and the fixture that needs pytest-asyncio if that is installed."""
    config.addinivalue_line(
        "markers",
        "urlab(*models, step_mode='auto', **options): run the test with a simulated server in play. Models and options "
        "are those of SimulatedServer; step_mode is that of the clients. Files may be relative to the test's folder.",
    )
    if config.pluginmanager.hasplugin("asyncio"):
        from pytest_urlab import asyncio_fixtures

        config.pluginmanager.register(asyncio_fixtures, "urlab_asyncio_fixtures")


@pytest.fixture(scope="session")
def urlab_default() -> pytest.MarkDecorator:
    """The default `urlab` mark, for tests without one; override this fixture to choose another."""
    return pytest.mark.urlab("arm")


@pytest.fixture(scope="session")
def _urlab_pool() -> Iterator[ServerPool]:
    from pytest_urlab.pool import ServerPool

    with ServerPool() as pool:
        yield pool


@pytest.fixture
def _urlab_mark(request: pytest.FixtureRequest, urlab_default: pytest.MarkDecorator) -> pytest.Mark:
    return request.node.get_closest_marker("urlab") or urlab_default.mark


@pytest.fixture
def urlab_server(
    request: pytest.FixtureRequest, _urlab_pool: ServerPool, _urlab_mark: pytest.Mark
) -> Iterator[SimulatedServer]:
    """A simulated server in play, in its initial state, as described by the test's `urlab` mark."""
    options = {name: value for name, value in _urlab_mark.kwargs.items() if name != "step_mode"}
    try:
        server = _urlab_pool.acquire(_urlab_mark.args, options, request.path.parent)
    except (TypeError, ValueError, OSError) as error:
        message = f"the server of @pytest.mark.urlab did not start: {error}"
        raise pytest.fail.Exception(message, pytrace=False) from None
    yield server
    _urlab_pool.release(server)


@pytest.fixture
def urlab_faults(urlab_server: SimulatedServer) -> Faults:
    """The faults injected into the server's replies; none until the test adds some."""
    faults = urlab_server.faults
    if faults is None:
        pytest.fail("the test's mark has faults=None", pytrace=False)
    return faults


@pytest.fixture
def _urlab_client_options(urlab_server: SimulatedServer, _urlab_mark: pytest.Mark) -> dict[str, Any]:
    return {
        "step_mode": _urlab_mark.kwargs.get("step_mode", "auto"),
        "mujoco_version_check": False,
        **urlab_server.client_options(),
    }


@pytest.fixture
def urlab_client(_urlab_client_options: dict[str, Any]) -> Iterator[URLabClient]:
    """A blocking client of the server, after `discover()`."""
    from urlab_client import URLabClient

    with URLabClient(**_urlab_client_options) as client:
        client.discover()
        yield client


@pytest.fixture
def urlab_aio_client(request: pytest.FixtureRequest) -> AsyncURLabClient:
    """An async client of the server, after `discover()`, on the test's event loop.

    For tests run by pytest-asyncio or by anyio's plugin.
    """
    config = request.config
    marked_anyio = "anyio_backend" in request.fixturenames
    asyncio_fixtures: Any = config.pluginmanager.get_plugin("urlab_asyncio_fixtures")
    if asyncio_fixtures is not None and (asyncio_fixtures.runs(request.node) or not marked_anyio):
        # In auto mode pytest-asyncio also runs tests marked with anyio, but not anyio's fixtures.
        runner = "beside_anyio" if marked_anyio else asyncio_fixtures.loop_scope(request)
    elif marked_anyio:
        runner = "anyio"
    else:
        pytest.fail(
            "urlab_aio_client needs a plugin for async tests: install pytest-asyncio, or mark the test with anyio",
            pytrace=False,
        )
    return request.getfixturevalue(f"_urlab_aio_client_{runner}")


@pytest.fixture
async def _urlab_aio_client_anyio(
    anyio_backend_name: str, _urlab_client_options: dict[str, Any]
) -> AsyncIterator[AsyncURLabClient]:
    from urlab_client.aio import URLabClient

    if anyio_backend_name != "asyncio":
        pytest.fail(f"the async client runs on asyncio, not on {anyio_backend_name}: set anyio_backend to asyncio")
    async with URLabClient(**_urlab_client_options) as client:
        await client.discover()
        yield client
