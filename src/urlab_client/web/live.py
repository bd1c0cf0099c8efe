"""The WebSockets: the state and what viewers say, pictures of a camera, and the 3-D view."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Awaitable, Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, get_args

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from urlab_client.console import mujoco_viewer
from urlab_client.console.lease import NotDriving, Viewer
from urlab_client.console.messages import (
    Ack,
    Ctrl,
    FromViewer,
    Hand,
    Log,
    Name,
    Ping,
    Pong,
    Refused,
    ToViewer,
    You,
    encode,
    tag_of,
)
from urlab_client.console.session import ConsoleSession
from urlab_client.integrations.forwarding import Flow, converse, forward, receive_text
from urlab_client.web.endpoints import explain_error

_AHEAD = 2  # states or pictures sent to a browser that it has not acknowledged
_NAME_CHARACTERS = 24


async def _send(socket: WebSocket, message: ToViewer) -> None:
    await socket.send_text(encode(message).decode())


async def live(console: ConsoleSession, socket: WebSocket) -> None:
    """Send the world, states, the status and the log to a viewer, and do what it says."""
    await socket.accept()
    view, flow = console.view, Flow(_AHEAD)
    with console.new_viewer() as viewer, view.watch() as changed:
        await _send(socket, You(viewer.key, viewer.name))

        async def send() -> None:
            version = state = line = -1
            status = ""
            while True:
                changed.clear()
                if version != view.world.version:
                    version = view.world.version
                    await socket.send_text(view.world_json)
                if (now := console.status_json(viewer)) is not status:
                    status = now
                    await socket.send_text(status)
                if news := view.entries_after(line):
                    line = news[-1].n
                    await _send(socket, Log(news))
                if view.state_json is not None and state != view.state_seq and flow.free:
                    state = view.state_seq
                    flow.sent()
                    await socket.send_text(view.state_json)
                await changed.wait()

        async def listen() -> None:
            while True:
                text = await receive_text(socket)
                try:
                    message: FromViewer = msgspec.json.decode(text, type=FromViewer)
                    if isinstance(message, Ack):
                        flow.acknowledge()
                        changed.set()
                    elif isinstance(message, Ping):
                        await _send(socket, Pong(message.at, time.time() * 1e3))
                    else:
                        _obey(console, viewer, message)
                except (NotDriving, ValueError, KeyError, RecursionError, msgspec.MsgspecError) as error:
                    await _send(socket, Refused(explain_error(error)[1]))

        await converse(socket, send, listen)


def _obey(console: ConsoleSession, viewer: Viewer, message: Name | Ctrl | Hand) -> None:
    match message:
        case Name(name=name):
            viewer.name = " ".join(name.split())[:_NAME_CHARACTERS] or viewer.name
            console.view.notify()
        case Ctrl(values=values):
            console.controls.set_points(viewer, values)
        case Hand():
            console.hands.command(viewer, message)


async def pictures(console: ConsoleSession, socket: WebSocket) -> None:
    """Send the pictures of a camera, the newest whenever the browser is ready."""
    feed = console.cameras.feed("{articulation}/{camera}".format_map(socket.path_params))
    await socket.accept()
    if feed is None:
        await socket.close(4404, "no such camera")
        return
    async with feed.watch():
        await forward(feed.frames(), socket, ahead=_AHEAD)


async def poses(console: ConsoleSession, socket: WebSocket) -> None:
    """Send states to the page of the 3-D view, and where values lie in them."""
    await socket.accept()
    await socket.send_text(mujoco_viewer.SPECTATOR)
    view, viewer, flow = console.view, console.mujoco_viewer, Flow(_AHEAD)

    with view.watch() as changed:

        async def send() -> None:
            model = sent = None
            while True:
                changed.clear()
                snapshot = view.snapshot
                shown = await viewer.shown()
                if shown and shown is not model:
                    model = shown
                    await socket.send_text(mujoco_viewer.LAYOUT + shown.layout)
                if shown and snapshot and snapshot is not sent and flow.free:
                    sent = snapshot
                    flow.sent()
                    await socket.send_bytes(viewer.write(shown, snapshot))
                await changed.wait()

        async def listen() -> None:
            while (message := await socket.receive())["type"] == "websocket.receive":
                # The page also asks for control of MuJoCo's own panels, which the console does not have.
                if message.get("text") == mujoco_viewer.SHOWN:
                    flow.acknowledge()
                    changed.set()

        await converse(socket, send, listen)


async def refuse_panels(_: ConsoleSession, socket: WebSocket) -> None:
    """Tell a page of the 3-D view that somebody else has MuJoCo's own panels."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # gone already
        await socket.accept()
        await socket.close(mujoco_viewer.TAKEN, "this page watches")


class Socket(NamedTuple):
    """One WebSocket of the API, from which its route and its channel in the AsyncAPI document are made.

    Attributes:
        name: Name of the channel.
        path: Its path, in the form of Starlette's routes.
        serve: What it does.
        description: What it is for.
        sends: Name of the operation by which the console sends, and the types of messages.
        receives: The same of what viewers send.
        parameters: Descriptions of the parameters in the path.
    """

    name: str
    path: str
    serve: Callable[[ConsoleSession, WebSocket], Awaitable[None]]
    description: str
    sends: tuple[str, tuple[str, ...]]
    receives: tuple[str, tuple[str, ...]]
    parameters: Mapping[str, str] = MappingProxyType({})


def _tags(kinds: Any) -> tuple[str, ...]:
    return tuple(tag_of(kind) for kind in get_args(kinds) or (kinds,))


SOCKETS = (
    Socket(
        "live",
        "/api/live",
        live,
        "State, status, world and log; what viewers say.",
        ("tell", _tags(ToViewer)),
        ("hear", _tags(FromViewer)),
    ),
    Socket(
        "pictures",
        "/api/cameras/{articulation}/{camera:path}/live",
        pictures,
        "Pictures of one camera.",
        ("show", ("picture",)),
        ("hearShown", _tags(Ack)),
        {"articulation": "Its articulation; `-` for cameras of the scene.", "camera": "Its name."},
    ),
)
