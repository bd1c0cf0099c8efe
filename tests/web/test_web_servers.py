"""Several servers behind one application, and what happens as server-sent events, over HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncGenerator
from typing import Any

import httpx2
import pytest
from http_served import served
from starlette.applications import Starlette
from starlette.routing import Mount
from starlette.testclient import TestClient
from waiting import DEADLINE_S, attempts

from urlab_client.aio import URLabClient
from urlab_client.server import SimulatedServer
from urlab_client.web import Access, app, apps


async def events(response: httpx2.Response, kind: str) -> AsyncGenerator[tuple[int, Any]]:
    """Yield number and data of the server-sent events of a kind."""
    number, what = 0, ""
    async for line in response.aiter_lines():
        field, _, value = line.partition(": ")
        if field == "id":
            number = int(value)
        elif field == "event":
            what = value
        elif field == "data" and what == kind:
            yield number, json.loads(value)


async def test_events_are_told_once_and_go_on_where_they_broke_off() -> None:
    with SimulatedServer("arm", play=True) as server:
        async with URLabClient(**server.client_options()) as client:
            site = app(client, access=Access(tokens=False))
            async with served(site) as http:
                async with (
                    http.stream("GET", "/api/events") as stream,
                    contextlib.aclosing(events(stream, "world")) as worlds,
                ):
                    assert stream.headers["content-type"].startswith("text/event-stream")
                    async with asyncio.timeout(DEADLINE_S):
                        while not (await anext(worlds))[1]["articulations"]:
                            pass
                await http.post("/api/ops/set_sim_speed", json={"percent": 50})
                async with (
                    http.stream("GET", "/api/events") as stream,
                    contextlib.aclosing(events(stream, "log")) as log,
                ):
                    first, entry = await anext(log)
                    async with asyncio.timeout(DEADLINE_S):
                        while entry["what"] != "set_sim_speed":
                            _, entry = await anext(log)
                await http.post("/api/ops/set_sim_speed", json={"percent": 60})
                async with (
                    http.stream("GET", "/api/events", headers={"last-event-id": str(entry["n"])}) as stream,
                    contextlib.aclosing(events(stream, "log")) as log,
                ):
                    later = [await anext(log)]
                    async with asyncio.timeout(DEADLINE_S):
                        while later[-1][1]["what"] != "set_sim_speed":  # the console may have something to say, too
                            later.append(await anext(log))
                numbers = list(range(entry["n"] + 1, entry["n"] + 1 + len(later)))
                assert [number for number, _ in later] == [after["n"] for _, after in later] == numbers
                assert entry["n"] >= first
                assert "60" in later[-1][1]["text"]
                async with (
                    http.stream("GET", "/api/events") as stream,
                    contextlib.aclosing(events(stream, "status")) as statuses,
                ):
                    assert (await anext(statuses))[1]["speed"] == 60


def test_each_server_has_a_console_and_one_key_opens_all() -> None:
    with SimulatedServer("arm", play=True) as one, SimulatedServer("quadruped", play=True) as two:
        clients = {"left": URLabClient(**one.client_options()), "right": URLabClient(**two.client_options())}
        site = apps(clients)

        @contextlib.asynccontextmanager
        async def lifespan(_: Starlette) -> AsyncGenerator[None]:
            async with clients["left"], clients["right"], site.router.lifespan_context(site):
                yield

        backend = Starlette(routes=[Mount("/", site)], lifespan=lifespan)
        with TestClient(backend, base_url="http://localhost") as http:
            for path in ("/", "/api/servers", "/left/api/world", "/right/"):
                assert http.get(path).status_code == 401
            key = http.post("/api/session", json={"token": site.state.access.invite()}).json()["key"]
            http.headers["authorization"] = f"Bearer {key}"
            assert 'href="left/"' in http.get("/").text
            listed = http.get("/api/servers").json()
            assert [(each["name"], each["path"]) for each in listed] == [("left", "/left/"), ("right", "/right/")]
            assert http.get("/right/api/openapi.json").json()["servers"] == [{"url": "/right"}]
            for name, robot in (("left", "arm"), ("right", "quadruped")):
                with http.websocket_connect(f"ws://localhost/{name}/api/live") as live:
                    messages = (live.receive_json() for _ in attempts("it does not play"))
                    worlds = (message["world"] for message in messages if message["type"] == "world")
                    world = next(world for world in worlds if world["playing"])
                assert [art["key"] for art in world["articulations"]] == [robot]
            # Each has its own controls.
            http.post("/left/api/lease")
            assert http.get("/left/api/status").json()["mine"]
            assert not http.get("/right/api/status").json()["mine"]


@pytest.mark.parametrize("name", ["a/b", "", "api", "metrics", "..", "a b"])
def test_a_server_has_a_name_that_can_stand_in_a_path(name: str) -> None:
    with pytest.raises(ValueError, match="cannot be the name of a server"):
        apps({name: URLabClient("tcp://localhost")})
    with pytest.raises(ValueError, match="at least one client"):
        apps({})
