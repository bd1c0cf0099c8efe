"""The async client on pytest-asyncio's event loops, of which it has one for each scope."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Any, Literal

import pytest_asyncio

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient


def _on_loop_of(scope: Literal["function", "class", "module", "package", "session"]) -> Any:
    @pytest_asyncio.fixture(name=f"_urlab_aio_client_{scope}", loop_scope=scope)
    async def client(_urlab_client_options: dict[str, Any]) -> AsyncIterator[URLabClient]:
        from urlab_client.aio import URLabClient  # noqa: PLC0415

        async with URLabClient(**_urlab_client_options) as client:
            await client.discover()
            yield client

    return client


function_client = _on_loop_of("function")
class_client = _on_loop_of("class")
module_client = _on_loop_of("module")
package_client = _on_loop_of("package")
session_client = _on_loop_of("session")
