"""A robot behind FastAPI: one client for all requests, states to many browsers, events, a restart underneath.

Run: uvicorn fastapi_backend:app --app-dir examples
"""

import os
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress

from fastapi import FastAPI, Request, WebSocket, WebSocketDisconnect
from fastapi.responses import JSONResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel

from urlab_client import URLabConnectionError, URLabError
from urlab_client.aio import URLabClient
from urlab_client.protocol.descriptions import ArticulationDescription, SceneDescription

client = URLabClient(os.environ.get("URLAB_ADDRESS", "sim://arm?play&unpaused"), keep_session=True)


@asynccontextmanager
async def lifespan(_: FastAPI) -> AsyncGenerator[None]:
    async with client:
        if "URLAB_WATCH" not in os.environ:  # a worker beside the one that drives only reads states
            await client.discover()
        yield


app = FastAPI(title="Robots", lifespan=lifespan)


class Moved(BaseModel):
    seconds: float
    robot: ArticulationDescription


@app.get("/scene")
async def scene() -> SceneDescription:
    return client.describe()


@app.post("/robots/{robot}/move")
async def move(robot: str, joints: dict[str, float]) -> Moved:
    found = client.articulations[robot]
    return Moved(seconds=await found.move_to(joints), robot=found.describe())


@app.websocket("/states")
async def states(browser: WebSocket) -> None:
    await browser.accept()
    with suppress(WebSocketDisconnect):  # a slow browser gets fewer states, and none is queued for it
        async for snapshot in client.state_stream("latest", max_rate=60):
            await browser.send_text(snapshot.to_json())


@app.get("/events", response_class=EventSourceResponse)
async def events() -> AsyncGenerator[ServerSentEvent]:
    async for event in client.events():
        yield ServerSentEvent(data=event.to_dict(), event=event.__struct_config__.tag)


@app.exception_handler(URLabError)
@app.exception_handler(ValueError)
@app.exception_handler(KeyError)
async def explain(_: Request, error: Exception) -> JSONResponse:
    status = 503 if isinstance(error, URLabConnectionError) else 409 if isinstance(error, URLabError) else 422
    return JSONResponse({"error": str(error)}, 404 if isinstance(error, KeyError) else status)
