"""The async client on pytest-asyncio's event loops, one for each scope."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING, Any, Literal

import pytest
import pytest_asyncio

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient


def runs(item: pytest.Item) -> bool:
    """Return whether pytest-asyncio runs a test."""
    return pytest_asyncio.is_async_test(item)


def loop_scope(request: pytest.FixtureRequest) -> str:
    """Return the scope of the loop that a test runs on: `function`, `class`, …"""
    mark = request.node.get_closest_marker("asyncio")
    chosen = None if mark is None else mark.kwargs.get("loop_scope")
    return chosen or request.config.getini("asyncio_default_test_loop_scope") or "function"


def _on_loop_of(scope: Literal["function", "class", "module", "package", "session"]) -> Any:
    @pytest_asyncio.fixture(name=f"_urlab_aio_client_{scope}", loop_scope=scope)
    async def client(_urlab_client_options: dict[str, Any]) -> AsyncIterator[URLabClient]:
        from urlab_client.aio import URLabClient

        async with URLabClient(**_urlab_client_options) as client:
            await client.discover()
            yield client

    return client


function_client = _on_loop_of("function")
class_client = _on_loop_of("class")
module_client = _on_loop_of("module")
package_client = _on_loop_of("package")
session_client = _on_loop_of("session")


@pytest.fixture
def _urlab_aio_client_beside_anyio(
    request: pytest.FixtureRequest, _urlab_client_options: dict[str, Any]
) -> Iterator[URLabClient]:
    """The client on the loop of the test. An async fixture would be run by anyio's plugin, on another loop."""
    from urlab_client.aio import URLabClient

    runner: asyncio.Runner = request.getfixturevalue(f"_{loop_scope(request)}_scoped_runner")
    client = URLabClient(**_urlab_client_options)
    try:
        runner.run(client.discover())
        yield client
    finally:
        runner.run(client.close())
