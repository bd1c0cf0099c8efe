"""Items of the client's streams: snapshots, rows, pictures and events, with information on their delivery. No I/O."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Struct

from urlab_client.enums import CameraMode, Word
from urlab_client.errors import ProtocolError
from urlab_client.protocol.base import doc
from urlab_client.protocol.codec import encode_message, from_wire_array
from urlab_client.protocol.messages.session import ArticulationState, Clock, EntityState, StateReply, StepOk
from urlab_client.protocol.rows import Row
from urlab_client.protocol.topics import TopicKind
from urlab_client.values.layouts import BytesLike
from urlab_client.values.pictures import JPEG_QUALITY, Pixels, jpeg, png, shown_png
from urlab_client.values.plain import Serializable


class StreamPolicy(Word):
    """Which messages a stream keeps for a busy reader."""

    LATEST = "latest"
    """Only the newest message."""
    LATEST_PER_KEY = "latest_per_key"
    """The newest message of each topic."""
    ALL = "all"
    """Every message, up to a limit."""


StreamPolicyName: TypeAlias = Literal["latest", "latest_per_key", "all"]
"""A policy of streams, by name."""


class StreamItem(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Delivery information of a stream's item."""

    seq: Annotated[int, doc("Sequence number among all messages that this stream received, from 1.")] = 0
    dropped: Annotated[
        int,
        doc(
            "Messages received but not delivered since the previous item: superseded, overflowed or malformed. "
            "With `latest_per_key`, superseded messages count on the item of the same topic."
        ),
    ] = 0
    gap: Annotated[
        str | None, doc("Reason why an unknown number of messages is missing before this one, such as a reconnect.")
    ] = None
    recv_wall_time_ns: Annotated[int, doc("This machine's UTC clock when the message arrived, nanoseconds.")] = 0


class StreamStats(Serializable, Struct, kw_only=True, frozen=True):
    """Counters of one stream. Every received message is delivered, dropped, malformed or still waiting."""

    received: Annotated[int, doc("Messages received.")]
    delivered: Annotated[int, doc("Items delivered to the reader.")]
    dropped: Annotated[int, doc("Messages dropped in favour of newer ones, by policy or for lack of space.")]
    malformed: Annotated[int, doc("Messages skipped because they could not be decoded.")]
    waiting: Annotated[int, doc("Messages waiting for the reader.")]
    gaps: Annotated[int, doc("Number of times that messages were lost before they arrived here, as on a reconnect.")]
    received_bytes: Annotated[int, doc("Bytes received, excluding topics.")]
    last_age_s: Annotated[float | None, doc("Seconds since the last message arrived; None before the first.")]


class StateSnapshot(StreamItem, tag_field="op", tag="state_full", kw_only=True, eq=False):
    """State of everything at the end of one tick, always at observation level `standard`."""

    time: Annotated[float, doc("`mjData.time`, seconds. Order live snapshots by this, not by `step`.")]
    step: Annotated[int, doc("Step counter of the session; constant in live mode.")]
    sim_time: Annotated[Clock, doc("`time` as two integers.")]
    wall_time: Annotated[Clock, doc("UTC of the server when the snapshot was built.")]
    per_articulation: Annotated[dict[str, ArticulationState], doc("State by articulation key.")] = {}
    entities: Annotated[dict[str, EntityState], doc("Plain entities by name; the plugin sends none.")] = {}
    user: Annotated[dict[str, Any], doc("User channels that the scene declares, by name; from the beta on.")] = {}
    arts: Annotated[
        dict[str, ArticulationState] | None, doc("The beta's field for `per_articulation`, which then is the same.")
    ] = None
    scene: Annotated[dict[str, EntityState] | None, doc("The beta's field for `entities`, which then is the same.")] = (
        None
    )

    def __post_init__(self) -> None:
        """Give snapshots of both generations the same shape."""
        if self.arts is not None:
            self.per_articulation = self.arts
        if self.scene is not None:
            self.entities = self.scene

    def __repr__(self) -> str:  # one line, without arrays
        robots = ", ".join(self.per_articulation) or "no robots"
        return f"<StateSnapshot step {self.step} at {self.time:.3f} s: {robots}>"

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
        """Decode the msgpack map of a `state/full` message or a state region; `where` names its source in errors.

        Raises:
            ProtocolError: The payload is not such a map.
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

    kind: Annotated[TopicKind, doc("Kind of the row.")]
    owner: Annotated[str, doc("Articulation key; for the scene kinds the entity's name.")]
    component: Annotated[
        str, doc("Component name of a joint, free joint or sensor, otherwise empty. Not always the compiled name.")
    ]
    row: Annotated[Row, doc("The values; its class follows from `kind`.")]


class CameraSample(StreamItem, kw_only=True, eq=False):
    """One picture of a camera."""

    camera: Annotated[str, doc("Name of the camera.")]
    mode: Annotated[CameraMode | str, doc("Meaning of the pixels.")]
    pixels: Annotated[
        Pixels,
        doc("Real: uint8 (H, W, 4) RGBA. Depth: float32 (H, W), metres. Otherwise uint8 (H, W, 4) BGRA. Never reused."),
    ]
    frame_id: Annotated[int | None, doc("The server's number of the picture; None from the plugin.")] = None
    sim_time: Annotated[float | None, doc("Simulation time of the picture, seconds; None from the plugin.")] = None
    capture_time: Annotated[float | None, doc("Unix time of the picture, seconds; None from the plugin.")] = None

    def png(self) -> bytes:
        """Encode the picture as PNG: colours as RGB, depth as 16-bit grey in millimetres, 0 beyond 65.535 m.

        Encoding takes milliseconds, so async code should call it with `asyncio.to_thread`.

        Raises:
            MissingExtra: Pillow is not installed; the message contains the command to install it.
        """
        return png(self.pixels, self.mode)

    def jpeg(self, quality: int = JPEG_QUALITY, *, max_size: int | None = None) -> bytes:
        """Encode the picture as JPEG, for viewing: colours, or depth as grey with near points bright.

        Args:
            quality: JPEG quality, 1 to 100.
            max_size: Maximum length of the longer side, pixels; larger pictures are scaled down. None keeps the size.

        Raises:
            MissingExtra: Pillow is not installed; the message contains the command to install it.
            ValueError: The quality or size is out of range.
        """
        return jpeg(self.pixels, self.mode, quality, max_size=max_size)

    def __repr__(self) -> str:
        height, width = self.pixels.shape[:2]
        at = "" if self.sim_time is None else f" at {self.sim_time:.3f} s"
        return f"<CameraSample {self.camera!r} {self.mode} {width}x{height}{at}>"

    def _repr_html_(self) -> None:  # the picture itself says more than a table
        return None

    def _repr_png_(self) -> bytes | None:
        return shown_png(self.pixels, self.mode)
