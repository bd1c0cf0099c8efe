"""The endpoints of the HTTP API: what viewers read, and what they do with the controls."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING, Annotated, cast

import anyio
import anyio.to_thread
from msgspec import Meta, Struct
from starlette.responses import Response

from urlab_client.aio.client_types import Diagnosis
from urlab_client.console.body_pushing import BodyList, BodyView, Pick, Picked, Push
from urlab_client.console.controls import SERVED, SteppedTo, parse
from urlab_client.console.description import WorldDescription
from urlab_client.console.lease import Viewer
from urlab_client.console.messages import LogEntry, State, StateList, Status, encode
from urlab_client.console.session import ConsoleSession
from urlab_client.enums import StepMode
from urlab_client.integrations.forwarding import EventStream
from urlab_client.web import documents
from urlab_client.web.access import HEALTH
from urlab_client.web.endpoints import BYTES, JSON, Call, endpoint, json_response, read_body, refusal

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

_FLOWING_S = 5.0


class RunRequest(Struct, forbid_unknown_fields=True):
    """Whether physics is to run."""

    running: bool


class StepRequest(Struct, forbid_unknown_fields=True):
    """A number of physics steps."""

    n_steps: Annotated[int, Meta(ge=1, le=1_000_000)] = 1


_ONE_STEP = StepRequest()


class LoginRequest(Struct, forbid_unknown_fields=True):
    """A token, which is good for one use."""

    token: str


class Key(Struct):
    """A key, for the header `Authorization: Bearer KEY`."""

    key: str


class Invitation(Struct):
    """A token, and the path of the page with it."""

    token: str
    path: str


# What there is


@endpoint("GET", "/api/world")
async def world(call: Call) -> WorldDescription:
    """Articulations, joints with ranges, actuators, sensors, cameras."""
    return call.console.view.world


@endpoint("GET", "/api/status")
async def status(call: Call) -> Status:
    """Connection, play, modes and driver."""
    return call.console.status(call.viewer)


@endpoint("GET", "/api/handshake", media=BYTES)
async def handshake(call: Call) -> Response:
    """The bytes that a client with `read_only=True` passes to `discover()`."""
    return Response(await anyio.to_thread.run_sync(call.console.client.handshake), media_type=BYTES)


@endpoint("GET", "/api/state", reply=State)
async def state(call: Call) -> Response:
    """The newest state."""
    shown = call.console.view.state_json
    if shown is None:
        return refusal(503, "no_state", "No state has arrived yet.", "Is play running?")
    return Response(shown, media_type=JSON)


@endpoint("GET", "/api/states", reply=StateList)
async def past(call: Call, after: float = -1.0) -> Response:
    """The simulation's states of the last ten seconds, those after `?after` seconds since it began."""
    return json_response({"states": call.console.view.states_after(after)})


@endpoint("GET", "/api/log")
async def log(call: Call) -> list[LogEntry]:
    """The latest calls, errors and events."""
    return [*call.console.view.entries]


@endpoint("GET", "/api/explain")
async def explain(call: Call) -> Diagnosis:
    """Why does a robot not move? The client's diagnosis, in sentences."""
    return await call.console.client.explain()


@endpoint("GET", "/api/events", media="text/event-stream")
async def events(call: Call) -> Response:
    """Server-sent events `log`, `world` and `status`; `Last-Event-ID` resumes the log."""
    last = call.request.headers.get("last-event-id", "")
    return EventStream(_events(call.console, call.viewer, int(last) if last.isdecimal() else -1))


async def _events(console: ConsoleSession, viewer: Viewer, line: int) -> AsyncGenerator[bytes, None]:
    view = console.view
    version, sent = -1, ""
    with view.watch() as changed:
        while True:
            changed.clear()
            news: list[bytes] = []
            if version != view.world.version:
                version = view.world.version
                news.append(_event("world", encode(view.world)))
            now = console.status_json(viewer)
            if now != sent:
                sent = now
                news.append(_event("status", now.encode()))
            for entry in view.entries_after(line):
                line = entry.n
                news.append(_event("log", encode(entry), line))
            if news:
                yield b"".join(news)
            await changed.wait()


def _event(kind: str, data: bytes, number: int | None = None) -> bytes:
    head = b"" if number is None else f"id: {number}\n".encode()
    return head + f"event: {kind}\ndata: ".encode() + data + b"\n\n"


@endpoint("GET", "/api/cameras/{articulation}/{camera:path}.jpg", media="image/jpeg")
async def picture(call: Call, articulation: str, camera: str) -> Response:
    """The newest picture of a camera."""
    # It is that of the stream that viewers share, or one captured now if nothing is streaming.
    console, path = call.console, f"{articulation}/{camera}"
    feed = console.cameras.feed(path)
    if feed is None:
        return _no_camera(path)
    if console.moving and console.client.step_mode is StepMode.LIVE and console.cameras.replay_of(path) is None:
        async with feed.watch():
            with anyio.move_on_after(_FLOWING_S):
                return Response((await feed.after(0)).jpeg, media_type="image/jpeg")
    sample = await feed.camera.capture()
    return Response(await anyio.to_thread.run_sync(sample.jpeg), media_type="image/jpeg")


@endpoint("GET", "/api/cameras/{articulation}/{camera:path}.png", media="image/png")
async def png(call: Call, articulation: str, camera: str) -> Response:
    """A lossless picture, captured now, in any mode."""
    path = f"{articulation}/{camera}"
    view = call.console.cameras.camera(path)
    if view is None:
        return _no_camera(path)
    sample = await view.capture()
    return Response(await anyio.to_thread.run_sync(sample.png), media_type="image/png")


def _no_camera(path: str) -> Response:
    return refusal(404, "unknown_camera", f"No camera is called {path!r}.")


@endpoint("GET", "/api/asyncapi.json")
async def asyncapi(call: Call) -> Response:
    """The WebSockets, described as AsyncAPI 3.0."""
    url = call.request.url
    document = documents.asyncapi(url.netloc, call.root, "wss" if url.scheme == "https" else "ws")
    return Response(document, media_type=JSON)


# Ops and set-points


async def perform_op(call: Call, op: str) -> Response:
    """Perform an op of the registry; the document describes each."""
    found = SERVED.get(op)
    if found is None:
        return refusal(404, "unknown_op", f"No op is called {op!r}.", "See openapi.json.")
    request = parse(found, await read_body(call.request))
    return json_response(await call.console.controls.do(call.viewer, request))


@endpoint("POST", "/api/ctrl")
async def ctrl(call: Call, body: dict[str, dict[str, float]]) -> None:
    """Set set-points: `{articulation: {actuator: value}}`. Requires the controls."""
    call.console.controls.set_points(call.viewer, body)


@endpoint("POST", "/api/run")
async def run(call: Call, body: RunRequest) -> None:
    """Run or stop physics: `{running: bool}`. Anyone may stop it."""
    await call.console.controls.run(call.viewer, body.running)


@endpoint("POST", "/api/step")
async def step_many(call: Call, body: StepRequest = _ONE_STEP) -> SteppedTo:
    """Step in direct mode: `{n_steps: int}`. Requires the controls."""
    return await call.console.controls.step(call.viewer, body.n_steps)


@endpoint("POST", "/api/hold", drives=True)
async def hold(call: Call, body: dict[str, bool]) -> None:
    """Hold the home pose with torque motors, in direct mode, until set-points come: `{articulation: holding}`.

    Physics that runs goes on.
    """
    controls, running = call.console.controls, call.console.running
    for key, holding in body.items():
        await controls.hold(call.viewer, key, holding)
        if holding:
            call.note("hold pose", key)
    if running and controls.holding and not controls.running:
        await controls.run(call.viewer, True)


@endpoint("POST", "/api/pose")
async def pose(call: Call, body: dict[str, dict[str, float]]) -> None:
    """Place joints in puppet mode: `{articulation: {joint: radians or metres}}`. Requires the controls."""
    await call.console.posing.place(call.viewer, body)


# Bodies


@endpoint("GET", "/api/bodies")
async def bodies(call: Call) -> BodyList:
    """The bodies of the model and where they are."""
    return await call.console.body_pushing.bodies()


@endpoint("GET", "/api/bodies/{id:int}")
async def body(call: Call, id: int) -> BodyView:  # noqa: A002 - the path's name for it
    """One body."""
    return await call.console.body_pushing.body(id)


@endpoint("POST", "/api/pick")
async def pick(call: Call, body: Pick) -> Picked:
    """The body that a ray hits first, and where."""
    return await call.console.body_pushing.pick(body)


@endpoint("POST", "/api/push")
async def push(call: Call, body: Push) -> None:
    """Push a body for a moment, or renew a push. Requires the controls."""
    await call.console.body_pushing.push(call.viewer, body)


@endpoint("DELETE", "/api/push")
async def end_push(call: Call) -> None:
    """End one's own push."""
    call.console.body_pushing.release(call.viewer)


# Viewers


@endpoint("POST", "/api/lease")
async def take_controls(call: Call) -> Status:
    """Take or keep the controls: status 423 while another viewer has them."""
    before = call.console.lease.holder
    call.console.lease.use(call.viewer)
    if before is None or before.key != call.viewer.key:
        call.note("take the controls", "")
    call.console.view.notify()
    return call.console.status(call.viewer)


@endpoint("DELETE", "/api/lease")
async def release_controls(call: Call) -> Status:
    """Release the controls."""
    holder = call.console.lease.holder
    call.console.lease.release(call.viewer)
    if holder is not None and holder.key == call.viewer.key:
        call.note("release the controls", "")
    call.console.view.notify()
    return call.console.status(call.viewer)


@endpoint("POST", "/api/connection", drives=True)
async def connect(call: Call) -> None:
    """Open a new session after another program has taken the server over."""
    call.console.reconnect()


@endpoint("POST", "/api/invitations")
async def invite(call: Call) -> Invitation:
    """Make a token for one more browser or program."""
    token = call.site.access.invite()
    return Invitation(token, f"{call.root}/?token={token}")


@endpoint("POST", "/api/session", public=True, reply=Key)
async def enter(call: Call, body: LoginRequest) -> Response:
    """Exchange a token for a key: `{token: str}`."""
    key = call.site.access.admit(body.token)
    if key is None:
        return refusal(401, "bad_token", "This token is unknown or has been used.")
    return json_response(Key(key))


@endpoint("GET", HEALTH, public=True)
async def health(call: Call) -> None:
    """Answers while the console runs, whatever the server does. Needs no key."""


@endpoint("GET", "/metrics", media="text/plain")
async def metrics(call: Call) -> Response:
    """Metrics of the client's requests, in Prometheus' text format."""
    from prometheus_client.exposition import choose_encoder

    registry = cast("CollectorRegistry", call.site.metrics)  # without one there is no route
    encode_all, media_type = choose_encoder(call.request.headers.get("accept", ""))
    text = await anyio.to_thread.run_sync(encode_all, registry)
    return Response(text, headers={"content-type": media_type})
