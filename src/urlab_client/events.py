"""What `client.events()` yields: what happened to a client's connection, session and play world."""

from __future__ import annotations

from typing import Annotated

import msgspec

from urlab_client.protocol.base import doc
from urlab_client.protocol.messages.streams import StreamItem

__all__ = [
    "ClientEvent",
    "PlayEnded",
    "PlayStarted",
    "ServerAnswers",
    "ServerConnected",
    "ServerLost",
    "ServerReconnected",
    "ServerSilent",
    "SessionLost",
    "SessionOpened",
    "TaskFailed",
]


class ClientEvent(StreamItem, tag_field="event", kw_only=True):
    """Something that happened to a client's connection, session or play world; `recv_wall_time_ns` says when."""


class ServerConnected(ClientEvent, tag="connected", kw_only=True):
    """The first connection to the server was established."""

    endpoint: Annotated[str, doc("Endpoint of the server.")]


class ServerLost(ClientEvent, tag="lost", kw_only=True):
    """The connection broke; it is being restored."""

    endpoint: Annotated[str, doc("Endpoint of the server.")]
    reason: Annotated[str, doc("Reason, as far as it is known.")] = ""


class ServerReconnected(ClientEvent, tag="reconnected", kw_only=True):
    """The connection was restored, maybe to another server: the next call shows whether the session still exists."""

    endpoint: Annotated[str, doc("Endpoint of the server.")]
    down_s: Annotated[float, doc("Seconds without a connection.")]
    refused: Annotated[
        bool, doc("Whether connections were refused in the meantime: no server was listening, as during a restart.")
    ] = False


class ServerSilent(ClientEvent, tag="silent", kw_only=True):
    """A reply is overdue although the connection is up: the server is busy, blocked by a dialog, or stuck."""

    endpoint: Annotated[str, doc("Endpoint of the server.")]
    op: Annotated[str, doc("Op whose reply did not arrive in time.")]
    waited_s: Annotated[float, doc("Seconds spent waiting for the reply.")]


class ServerAnswers(ClientEvent, tag="answers", kw_only=True):
    """A server that was silent answers again."""

    endpoint: Annotated[str, doc("Endpoint of the server.")]
    silent_s: Annotated[float, doc("Seconds since the unanswered request.")]


class SessionOpened(ClientEvent, tag="session_opened", kw_only=True):
    """A handshake was answered."""

    session_id: Annotated[str, doc("Id of the new session.")]
    urlab_version: Annotated[str, doc("Version of the server.")]
    mujoco_version: Annotated[str, doc("MuJoCo version of the server.")]


class SessionLost(ClientEvent, tag="session_lost", kw_only=True):
    """The server no longer knows the session; call `discover()`."""

    session_id: Annotated[str, doc("Id of the lost session.")]
    reason: Annotated[str, doc("The server's message.")] = ""


class PlayStarted(ClientEvent, tag="play_started", kw_only=True):
    """A play world is ready."""

    articulations: Annotated[
        list[str], doc("Keys of its articulations; empty if another client started it; `discover()` finds them.")
    ] = msgspec.field(default_factory=list[str])


class PlayEnded(ClientEvent, tag="play_ended", kw_only=True):
    """The play world has ended."""

    reason: Annotated[str, doc("What ended it, as far as this client knows.")] = ""


class TaskFailed(ClientEvent, tag="task_failed", kw_only=True):
    """A background task or thread of this client ended unexpectedly; the log has the details."""

    task: Annotated[str, doc("Its name, such as `urlab-keeper`, which keeps the session.")]
    error: Annotated[str, doc("The error that ended it.")]
