"""A view in Foxglove: a WebSocket server that its application connects to."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from urlab_client._installation import need
from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.errors import URLabError
from urlab_client.integrations._feed.geometry import Shape, scene_update, shapes_of
from urlab_client.integrations._feed.messages import (
    ArrowPrimitive,
    Color,
    ContactMessage,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SolidPrimitive,
    Time,
    Vector3,
    encode,
    schema_name,
    schema_of,
)
from urlab_client.integrations._feed.samples import (
    CameraPicture,
    TopicMessage,
    computed_messages,
    picture_messages,
    state_messages,
)
from urlab_client.integrations._feed.scene import FollowedScene, Simulation
from urlab_client.integrations._flavours import flavoured, in_flavour
from urlab_client.integrations.view.view import AsyncView, Moment, View, ViewBackend
from urlab_client.protocol.base import Floats
from urlab_client.sync.client import URLabClient

if TYPE_CHECKING:
    import foxglove
    from foxglove.websocket import ChannelView, Client, WebSocketServer

_JPEG_QUALITY = 80
_RED = Color(1.0, 0.2, 0.1, 1.0)
_NEWTON_M = 0.002  # length of a contact's arrow for each newton
_BACKLOG = 64  # queue length per browser; older messages are dropped
_JOINING_S = 1.0  # how long after a subscription the newest state is sent again


class FoxgloveBackend(ViewBackend):
    """Shows states to all connected clients."""

    def __init__(self, *, host: str, port: int, sensors: bool) -> None:
        need("foxglove", "PIL", extra="foxglove")
        self._host, self._port = host, port
        self._sensors = sensors
        self._server: WebSocketServer | None = None
        self._context: foxglove.Context | None = None
        self._channels: dict[tuple[str, str], foxglove.Channel] = {}
        self._shapes: list[Shape] = []
        self._last: Moment | None = None
        self._joined = self._shown = -math.inf

    @property
    def address(self) -> str:
        if self._server is None:
            return ""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"ws://{host}:{self._server.port}"

    def open(self) -> None:
        import foxglove
        from foxglove.websocket import ServerListener

        backend = self

        class Listener(ServerListener):
            def on_subscribe(self, client: Client, channel: ChannelView) -> None:
                del client, channel
                backend._joined = time.monotonic()

        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="urlab",
                host=self._host,
                port=self._port,
                context=self._context,
                server_listener=Listener(),
                message_backlog_size=_BACKLOG,
            )
        except RuntimeError as error:
            raise URLabError(
                f"foxglove_view: port {self._port} of {self._host} cannot be used: {error}",
                hint="Another program may hold it; port=0 (--port 0) takes any free one.",
            ) from None

    def use(self, simulation: Simulation, scene: FollowedScene) -> None:
        self._shapes = shapes_of(simulation.model, simulation.bodies)
        if self._server is not None and self._last is not None:
            self._server.clear_session()
        for key in [key for key in self._channels if key[1]]:
            self._channels.pop(key).close()  # the layout in its metadata has changed
        self._joined = time.monotonic()

    def show(self, moment: Moment) -> None:
        self._last = moment
        simulation, ns = moment.simulation, moment.ns
        self._send(computed_messages(simulation, ns, contacts=moment.contacts), ns)
        if moment.contacts:
            self._send([TopicMessage("/contact_markers", lambda: _markers(simulation.contacts(), Time.of(ns)))], ns)
        if moment.state is not None:
            step, episode = moment.step, moment.episode
            states = state_messages(moment.state, ns, sample=step, episode=episode, sensors=self._sensors)
            self._send(states, ns)

    def show_picture(self, picture: CameraPicture, ns: int) -> None:
        self._send(picture_messages(picture, ns, _JPEG_QUALITY), ns)

    def idle(self) -> bool:
        # So that clients that join while time stands still see something. Repeated, because a subscription may be
        # reported before it takes effect.
        now = time.monotonic()
        if self._last is not None and now < self._joined + _JOINING_S and now >= self._shown + _JOINING_S / 4:
            self._shown = now
            ns = self._last.ns
            self._send([TopicMessage("/scene", lambda: scene_update(self._shapes, Time.of(ns)))], ns)
            self.show(self._last)
        return True

    def close(self) -> None:
        for channel in self._channels.values():
            channel.close()
        if self._server is not None:
            self._server.stop()

    def _send(self, messages: Iterable[TopicMessage], ns: int) -> None:
        """Send messages, which are made only if there is a subscriber, and once for the topic's schema."""
        import foxglove

        for topic, make, metadata in messages:
            key = topic, metadata.get("layout", "")
            channel = self._channels.get(key)
            if channel is None:
                kind = type(make())
                schema = foxglove.Schema(name=schema_name(kind), encoding="jsonschema", data=schema_of(kind))
                self._channels[key] = foxglove.Channel(
                    topic, schema=schema, message_encoding="json", context=self._context, metadata=dict(metadata)
                )
            elif channel.has_sinks():
                channel.log(encode(make()), log_time=ns)


def _markers(contacts: list[ContactMessage], time: Time) -> SceneUpdate:
    """Return contacts as spheres, and their forces as arrows."""
    entity = SceneEntity(
        time, "world", "contacts", frame_locked=False, cubes=[], spheres=[], cylinders=[], triangles=[], arrows=[]
    )
    for contact in contacts:
        at = Pose(contact.position, Quaternion(0.0, 0.0, 0.0, 1.0))
        entity.spheres.append(SolidPrimitive(at, Vector3(0.016, 0.016, 0.016), _RED))
        force = np.array([contact.force.x, contact.force.y, contact.force.z])
        newtons = float(np.linalg.norm(force))
        if newtons > 0:
            length, along = _NEWTON_M * newtons, Pose(contact.position, _along(force / newtons))
            entity.arrows.append(ArrowPrimitive(along, 0.8 * length, 0.008, 0.2 * length, 0.016, _RED))
    return SceneUpdate([], [entity])


def _along(direction: Floats) -> Quaternion:
    """Return the shortest rotation of the x axis, along which arrows point, to a unit vector."""
    x, y, z = direction.tolist()
    if x < -1 + 1e-9:
        return Quaternion(0.0, 0.0, 1.0, 0.0)
    scale = float(np.sqrt(2 * (1 + x)))
    return Quaternion(0.0, -z / scale, y / scale, scale / 2)


@flavoured(AsyncView, View)
def foxglove_view(
    client: AsyncClient | URLabClient,
    *,
    host: str = "127.0.0.1",
    port: int = 8765,
    cameras: Sequence[str] | Literal["all"] = (),
    camera_hz: float = 10.0,
    contacts: bool = True,
    sensors: bool = False,
    max_hz: float = 30.0,
) -> AsyncView | View:
    """Show a client's simulation in Foxglove; a context manager of the client's flavour.

    Foxglove connects to the view's `address`. Topics and frames are those of a recording (`record`): `/tf`,
    `/joint_states`, `/state/ARTICULATION`, `/contacts`, `/camera/NAME`; in addition, `/scene` has the geometry of the
    bodies and `/contact_markers` arrows of 2 mm per newton. Frames are in `world`: metres, right-handed, z up. The
    newest state is shown, at most `max_hz` times per second; skipped states are counted, and stepping never waits.
    After another handshake the new scene replaces the old one.

    Args:
        client: A client after `discover()`, during play, with its local model.
        host: Interface to listen on. The server has no authentication: on an interface other than loopback, everyone
            who can reach it sees the simulation.
        port: Port to listen on; 0 for any free one.
        cameras: Cameras to show, `ARTICULATION/CAMERA` or a scene-level name; `all` for all of them.
            In `direct` mode they are drawn with the step in which they are due, which then takes longer.
        camera_hz: Maximum number of pictures per second of simulation time.
        contacts: Show contacts, computed from the state with the client's local model.
        sensors: Send sensor readings in `/state/ARTICULATION`.
        max_hz: Maximum number of states shown per second of wall time.

    Raises:
        ImportError: The extra `foxglove` is not installed.
        ValueError: An option is out of range.

    Entering the block raises `URLabError` if the port cannot be used, before `discover()` or without a local model,
    and `KeyError` for an unknown camera.
    """
    backend = FoxgloveBackend(host=host, port=port, sensors=sensors)
    options: dict[str, Any] = {"cameras": cameras, "camera_hz": camera_hz, "max_hz": max_hz, "contacts": contacts}
    return in_flavour(client, AsyncView, View, backend, "foxglove_view", **options)
