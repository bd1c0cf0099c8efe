"""The FastAPI example as its users meet it: over HTTP and WebSockets, while its server is restarted, too."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import re
from collections.abc import AsyncGenerator
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx2
import pytest
from http_served import served
from served import Served
from waiting import DEADLINE_S, until
from websockets.asyncio.client import connect

from urlab_client.aio import URLabClient
from urlab_client.server import SimulatedServer

EXAMPLE = Path(__file__).parents[2] / "examples" / "fastapi_backend.py"


def backend(monkeypatch: pytest.MonkeyPatch, **options: Any) -> ModuleType:
    """Load the example as a process of its own would, with its client at another server."""
    monkeypatch.setenv("URLAB_ADDRESS", "tcp://localhost")
    spec = importlib.util.spec_from_file_location("fastapi_backend", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.client = URLabClient(**{**module.client.config.options(), **options})  # type: ignore[attr-defined]
    return module


@contextlib.asynccontextmanager
async def states(http: httpx2.AsyncClient) -> AsyncGenerator[Any]:
    url = str(http.base_url).replace("http", "ws", 1).rstrip("/")
    async with connect(f"{url}/states", max_size=None, close_timeout=0.1) as socket:
        yield socket


async def test_one_client_serves_many_and_another_worker_watches(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with SimulatedServer("arm", play=True, unpaused=True) as server:
        options = server.client_options()
        driver = backend(monkeypatch, **options)
        async with served(driver.app) as http:
            (tmp_path / "robot.hello").write_bytes((await http.get("/handshake")).content)
            monkeypatch.setenv("URLAB_WATCH", str(tmp_path / "robot.hello"))
            watcher = backend(monkeypatch, **options)
            async with served(watcher.app) as beside, states(beside) as watching:
                assert (await beside.get("/scene")).json()["articulations"][0]["name"] == "arm"
                refused = await beside.post("/robots/arm/move", json={"elbow": 0.5})
                assert (refused.status_code, "read-only" in refused.json()["error"]) == (409, True)
                scenes = await asyncio.gather(*(http.get("/scene") for _ in range(20)))
                assert {scene.json()["articulations"][0]["name"] for scene in scenes} == {"arm"}
                session = driver.client.session_id
                moved = (await http.post("/robots/arm/move", json={"elbow": 0.5})).json()
                assert moved["seconds"] > 0
                for path, joints, status in (
                    ("/robots/arn/move", {"elbow": 0.5}, 404),
                    ("/robots/arm/move", {"elbow": 9.0}, 422),
                    ("/robots/arm/move", {"elbow": "far"}, 422),
                ):
                    assert (await http.post(path, json=joints)).status_code == status
                schemas = (await http.get("/openapi.json")).json()["components"]["schemas"]
                assert {"SceneDescription", "ArticulationDescription", "Moved"} <= set(schemas)

                # Whoever does not read holds nobody up.
                async with states(http), states(http) as one, states(http) as two:
                    seen: dict[Any, list[float]] = {one: [], two: [], watching: []}
                    for _ in range(30):
                        for browser, times in seen.items():
                            times.append(json.loads(await browser.recv())["time"])
                for times in seen.values():
                    assert times == sorted(set(times))
                await http.post("/robots/arm/move", json={"elbow": 0.0})
                assert driver.client.session_id == session, "nobody has taken it over"


@pytest.mark.long
async def test_a_restart_of_the_server_is_told_and_survived(monkeypatch: pytest.MonkeyPatch) -> None:
    async with Served() as server:
        program = backend(monkeypatch, **server.options(), rcv_timeout_ms=2000)
        async with served(program.app) as http:
            await program.client.runtime.set_paused(False)
            told: list[str] = []
            answered = asyncio.Event()

            async def listen() -> None:
                async with http.stream("GET", "/events") as stream:
                    answered.set()
                    async for line in stream.aiter_lines():
                        told.extend(re.findall("event: (.*)", line))

            async with states(http) as browser:
                before = json.loads(await browser.recv())["time"]
                listening = asyncio.create_task(listen())
                await answered.wait()
                await server.kill()
                await until(lambda: "lost" in told)
                assert (await http.post("/robots/arm/move", json={"elbow": 0.4})).status_code in {409, 503}
                await server.start()
                await until(lambda: "session_opened" in told)
                listening.cancel()
                await asyncio.wait((listening,))
                await program.client.runtime.set_paused(False)
                moved = await http.post("/robots/arm/move", json={"elbow": 0.3})
                assert moved.status_code == 200, moved.text
                async with asyncio.timeout(DEADLINE_S):
                    while json.loads(await browser.recv())["time"] >= before:
                        pass  # of the server before
