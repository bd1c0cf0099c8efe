"""A robot behind FastAPI: one client serves all requests, state streams and events, and survives a server restart.

Run: uvicorn fastapi_backend:app --app-dir examples
"""

import os
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI, Request, Response, WebSocket
from fastapi.responses import JSONResponse
from pydantic import BaseModel

from urlab_client import URLabConnectionError, URLabError
from urlab_client.aio import URLabClient
from urlab_client.integrations.forwarding import EventStream, forward
from urlab_client.values.descriptions import ArticulationDescription, SceneDescription

address = os.environ.get("URLAB_ADDRESS", "sim://arm?play&unpaused")
watched = os.environ.get("URLAB_WATCH")  # file with the response of /handshake from the controlling worker
hello = Path(watched).read_bytes() if watched else None
client = URLabClient(address, keep_session=hello is None, read_only=hello is not None)


@asynccontextmanager
async def lifespan(_: FastAPI) -> AsyncGenerator[None]:
    async with client:
        await client.discover(handshake=hello)
        yield


app = FastAPI(title="Robots", lifespan=lifespan)


class Moved(BaseModel):
    seconds: float
    robot: ArticulationDescription


@app.get("/scene")
async def scene() -> SceneDescription:
    return client.describe()


@app.get("/handshake")
async def handshake() -> Response:
    return Response(client.handshake(), media_type="application/octet-stream")


@app.post("/robots/{robot}/move")
async def move(robot: str, joints: dict[str, float]) -> Moved:
    found = client.articulations[robot]
    return Moved(seconds=await found.move_to(joints), robot=found.describe())


@app.websocket("/states")
async def states(browser: WebSocket) -> None:
    await browser.accept()
    # A slow browser gets fewer states; nothing queues up.
    await forward(client.state_stream("latest", max_rate=60, timeout=None), browser)


@app.get("/events")
async def events() -> EventStream:
    return EventStream(client.events())


@app.exception_handler(URLabError)
@app.exception_handler(ValueError)
@app.exception_handler(KeyError)
async def explain(_: Request, error: Exception) -> JSONResponse:
    status = 503 if isinstance(error, URLabConnectionError) else 409 if isinstance(error, URLabError) else 422
    return JSONResponse({"error": str(error)}, 404 if isinstance(error, KeyError) else status)
