"""What the client's streams hand out: snapshots, rows, pictures and events, each with how it was delivered. No I/O."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

import msgspec
from msgspec import Struct

from urlab_client.protocol.base import doc
from urlab_client.protocol.codec import encode_message, from_wire_array
from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.errors import ProtocolError
from urlab_client.protocol.layouts import BytesLike
from urlab_client.protocol.messages.session import ArticulationState, Clock, EntityState, StateReply, StepOk
from urlab_client.protocol.picture_files import JPEG_QUALITY, jpeg, png
from urlab_client.protocol.pixels import Pixels
from urlab_client.protocol.rows import Row
from urlab_client.protocol.serializable import Serializable
from urlab_client.protocol.topics import TopicKind

__all__ = [
    "CameraSample",
    "ClientEvent",
    "PlayEnded",
    "PlayStarted",
    "RowSample",
    "ServerAnswers",
    "ServerConnected",
    "ServerLost",
    "ServerReconnected",
    "ServerSilent",
    "SessionLost",
    "SessionOpened",
    "StateSnapshot",
    "StreamItem",
    "StreamPolicy",
    "StreamStats",
]


class StreamPolicy(StrEnum):
    """What a stream keeps for a reader that is busy."""

    LATEST = "latest"
    """Only the newest message."""
    LATEST_PER_KEY = "latest_per_key"
    """The newest message of each topic."""
    ALL = "all"
    """Every message, up to a limit."""


class StreamItem(Serializable, Struct, kw_only=True, omit_defaults=True):
    """How an item of a stream was delivered."""

    seq: Annotated[int, doc("Number of the message among all that this stream received, from 1.")] = 0
    dropped: Annotated[
        int,
        doc(
            "Messages received and not handed out since the previous item: superseded, overflowed or malformed. "
            "With `latest_per_key`, what was superseded counts on the item of the same topic."
        ),
    ] = 0
    gap: Annotated[
        str | None, doc("Why an unknown number of messages is missing before this one, for example a reconnect.")
    ] = None
    recv_wall_time_ns: Annotated[int, doc("This machine's UTC clock when the message arrived, nanoseconds.")] = 0


class StreamStats(Serializable, Struct, kw_only=True, frozen=True):
    """Counters of one stream. What was received is delivered, dropped, malformed or still waiting."""

    received: Annotated[int, doc("Messages received.")]
    delivered: Annotated[int, doc("Items handed to the reader.")]
    dropped: Annotated[int, doc("Messages dropped for newer ones, by policy or for want of space.")]
    malformed: Annotated[int, doc("Messages skipped because they could not be decoded.")]
    waiting: Annotated[int, doc("Messages waiting for the reader.")]
    gaps: Annotated[int, doc("Times that messages went missing before they got here, for example by a reconnect.")]
    received_bytes: Annotated[int, doc("Bytes received, topics not included.")]
    last_age_s: Annotated[float | None, doc("Seconds since the last message arrived; None before the first.")]


class StateSnapshot(StreamItem, tag_field="op", tag="state_full", kw_only=True, omit_defaults=True, eq=False):
    """State of everything at the end of one tick, observation level `standard` whatever the session asked for."""

    time: Annotated[float, doc("`mjData.time`, seconds. Order live snapshots by this, not by `step`.")]
    step: Annotated[int, doc("Step counter of the session; constant in live mode.")]
    sim_time: Annotated[Clock, doc("`time` as two integers.")]
    wall_time: Annotated[Clock, doc("UTC of the server when the snapshot was built.")]
    per_articulation: Annotated[dict[str, ArticulationState], doc("State by articulation key.")] = {}
    entities: Annotated[dict[str, EntityState], doc("Plain entities by name; the plugin sends none.")] = {}
    user: Annotated[dict[str, Any], doc("User channels that the scene declares, by name; from the beta on.")] = {}
    arts: Annotated[
        dict[str, ArticulationState] | None, doc("What the beta sends as `per_articulation`, which then is the same.")
    ] = None
    scene: Annotated[
        dict[str, EntityState] | None, doc("What the beta sends as `entities`, which then is the same.")
    ] = None

    def __post_init__(self) -> None:
        """Bring a snapshot of either generation into one shape."""
        if self.arts is not None:
            self.per_articulation = self.arts
        if self.scene is not None:
            self.entities = self.scene

    @classmethod
    def of(cls, reply: StateReply) -> StateSnapshot:
        """Return the state in a reply as a snapshot."""
        now = Clock(sec=int(reply.time), nsec=int(reply.time % 1.0 * 1e9))
        return cls(
            time=reply.time,
            step=reply.step,
            sim_time=reply.sim_time or now,
            wall_time=reply.wall_time or Clock(sec=0, nsec=0),
            per_articulation=reply.per_articulation,
            entities=(reply.entities or {}) if isinstance(reply, StepOk) else {},
        )

    def encode(self) -> bytes:
        """Return the msgpack map of a `state/full` message."""
        return encode_message(self)

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> StateSnapshot:
        """Read the msgpack map of a `state/full` message or of a state region; `where` names its source in errors.

        Raises:
            ProtocolError: If it is not such a map.
        """
        try:
            return _SNAPSHOT.decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            at = f" on {str(where)!r}" if where else ""
            raise ProtocolError(f"state snapshot{at}: {error}.", raw=bytes(payload[:256])) from error


# Not strict: the plugin sends integers as floats.
_SNAPSHOT = msgspec.msgpack.Decoder(StateSnapshot, strict=False, dec_hook=from_wire_array)


class RowSample(StreamItem, kw_only=True, eq=False):
    """One row of the state stream."""

    kind: Annotated[TopicKind, doc("What the row is about.")]
    owner: Annotated[str, doc("Articulation key; for the scene kinds the entity's name.")]
    component: Annotated[
        str, doc("Component name of a joint, free joint or sensor, else empty. Not always the compiled name.")
    ]
    row: Annotated[Row, doc("The values; its class follows from `kind`.")]


class CameraSample(StreamItem, kw_only=True, eq=False):
    """One picture of a camera."""

    camera: Annotated[str, doc("Name of the camera.")]
    mode: Annotated[CameraMode | str, doc("What the pixels mean.")]
    pixels: Annotated[
        Pixels, doc("Real: uint8 (H, W, 4) RGBA. Depth: float32 (H, W), metres. Else uint8 (H, W, 4) BGRA. Yours.")
    ]
    frame_id: Annotated[int | None, doc("The server's number of the picture; None from the plugin.")] = None
    sim_time: Annotated[float | None, doc("Simulation time of the picture, seconds; None from the plugin.")] = None
    capture_time: Annotated[float | None, doc("Unix time of the picture, seconds; None from the plugin.")] = None

    def png(self) -> bytes:
        """Return it as PNG, without loss: colours as RGB, depth as 16-bit grey in millimetres, 0 beyond 65.535 m.

        Encoding takes milliseconds, so async code calls it with `asyncio.to_thread`.

        Raises:
            MissingExtra: Pillow is not installed; the message has the command.
        """
        return png(self.pixels, self.mode)

    def jpeg(self, quality: int = JPEG_QUALITY, *, max_size: int | None = None) -> bytes:
        """Return it as JPEG, to be looked at: colours, or depth as grey, near is bright.

        Args:
            quality: 1 to 100.
            max_size: Pixels that the longer side may have, for a smaller picture; None leaves it as large as it is.

        Raises:
            MissingExtra: Pillow is not installed; the message has the command.
            ValueError: There is no such quality or size.
        """
        return jpeg(self.pixels, self.mode, quality, max_size=max_size)


class ClientEvent(StreamItem, tag_field="event", kw_only=True, omit_defaults=True):
    """Something that happened to a client's connection, session or play world; `recv_wall_time_ns` says when."""


class ServerConnected(ClientEvent, tag="connected", kw_only=True, omit_defaults=True):
    """The first connection to the server stands."""

    endpoint: Annotated[str, doc("Where the server is.")]


class ServerLost(ClientEvent, tag="lost", kw_only=True, omit_defaults=True):
    """The connection broke; it is being restored."""

    endpoint: Annotated[str, doc("Where the server was.")]
    reason: Annotated[str, doc("What is known about why.")] = ""


class ServerReconnected(ClientEvent, tag="reconnected", kw_only=True, omit_defaults=True):
    """The connection stands again. The server may be another one: the next call tells whether the session lives."""

    endpoint: Annotated[str, doc("Where the server is.")]
    down_s: Annotated[float, doc("Seconds without a connection.")]
    refused: Annotated[
        bool, doc("Whether connections were refused meanwhile: no server was there, as while one restarts.")
    ] = False


class ServerSilent(ClientEvent, tag="silent", kw_only=True, omit_defaults=True):
    """A reply is overdue while the connection stands: the server is busy, blocked by a dialog, or stuck."""

    endpoint: Annotated[str, doc("Where the server is.")]
    op: Annotated[str, doc("Op whose reply did not come in time.")]
    waited_s: Annotated[float, doc("Seconds that were waited for it.")]


class ServerAnswers(ClientEvent, tag="answers", kw_only=True, omit_defaults=True):
    """A server that was silent answers again."""

    endpoint: Annotated[str, doc("Where the server is.")]
    silent_s: Annotated[float, doc("Seconds since the request that it left unanswered.")]


class SessionOpened(ClientEvent, tag="session_opened", kw_only=True, omit_defaults=True):
    """A handshake was answered."""

    session_id: Annotated[str, doc("Id of the new session.")]
    urlab_version: Annotated[str, doc("Version of the server.")]
    mujoco_version: Annotated[str, doc("MuJoCo version of the server.")]


class SessionLost(ClientEvent, tag="session_lost", kw_only=True, omit_defaults=True):
    """The server no longer knows the session: call `discover()`."""

    session_id: Annotated[str, doc("Id of the session that was.")]
    reason: Annotated[str, doc("The server's words.")] = ""


class PlayStarted(ClientEvent, tag="play_started", kw_only=True, omit_defaults=True):
    """A play world is there to be driven."""

    articulations: Annotated[
        list[str], doc("Keys of its articulations; empty when somebody else started it: `discover()` tells them.")
    ] = []


class PlayEnded(ClientEvent, tag="play_ended", kw_only=True, omit_defaults=True):
    """The play world is gone."""

    reason: Annotated[str, doc("Who ended it, as far as this client knows.")] = ""
