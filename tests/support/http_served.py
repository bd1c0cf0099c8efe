"""Applications served as programs serve them, in the test's own loop."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator

import httpx2
from starlette.types import ASGIApp
from waiting import DEADLINE_S

from urlab_client.cli._pages import bound, serve


@contextlib.asynccontextmanager
async def served(
    application: ASGIApp, *, lifespan: bool = True, public_url: str = ""
) -> AsyncGenerator[httpx2.AsyncClient]:
    """Serve an application over a real socket, and yield an HTTP client of it."""
    ready, ended = asyncio.Event(), asyncio.Event()
    with bound("127.0.0.1", 0) as listener:
        serving = asyncio.create_task(
            serve(application, listener, ready.set, ended, public_url=public_url, lifespan=lifespan)
        )
        await ready.wait()
        try:
            url = f"http://127.0.0.1:{listener.getsockname()[1]}"
            async with httpx2.AsyncClient(base_url=url, timeout=DEADLINE_S) as http:
                yield http
        finally:
            ended.set()
            await serving
