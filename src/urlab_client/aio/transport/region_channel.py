"""The pair of request and reply region, and the exchange that shows that no old reply is still to come."""

from __future__ import annotations

import secrets
from functools import cache
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

from urlab_client._windows import NamedEvent
from urlab_client.aio.transport.mapped_region import MappedRegion
from urlab_client.protocol.base import Op
from urlab_client.protocol.codec import encode_request
from urlab_client.protocol.messages.runtime import ReadMocapPose

__all__ = ["SYNC_PREFIX", "Envelope", "RegionChannel", "envelope_of", "opening_of"]

SYNC_PREFIX: Final = "sync-"
"""How the session ids begin that no server knows, and whose refusal answers the exchange."""

_ASK_AGAIN_S = 1.0


class Envelope(Struct):
    """What a reply says about itself."""

    op: str = ""
    code: str = ""
    message: str = ""


_MSGPACK = msgspec.msgpack.Decoder(Envelope)
_JSON = msgspec.json.Decoder(Envelope)


def envelope_of(reply: bytes) -> Envelope:
    """Read what a reply says about itself; empty for what is not a reply."""
    try:
        return (_JSON if reply[:1] == b"{" else _MSGPACK).decode(reply)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return Envelope()


@cache
def opening_of(op: Op) -> bytes:
    """Return how a successful msgpack reply to `op` begins, after the byte or bytes that say how long its map is."""
    return msgspec.msgpack.encode({"op": op.reply_name})[1:]


class RegionChannel:
    """The pair of request and reply region, for the one client that holds the lock.

    Args:
        requests: File of the requests.
        replies: File of the replies.
        events: What their events are called on Windows.

    Attributes:
        limit: Largest payload that fits in both directions.
    """

    def __init__(self, requests: Path, replies: Path, events: tuple[str, str]) -> None:
        self.requests: MappedRegion = MappedRegion(requests, writable=True, exclusive=True)
        try:
            self.replies: MappedRegion = MappedRegion(replies)
        except BaseException:
            self.requests.close()
            raise
        self.limit: int = min(self.requests.region.max_payload, self.replies.region.max_payload)
        request_event, reply_event = events
        self._request_event = NamedEvent(request_event)
        self.reply_event: NamedEvent = NamedEvent(reply_event)
        # A client that died here may have left a request behind whose reply is still to come.
        self.dirty: bool = True
        self.seen: int = 0
        self._token = ""
        self._asked_at = 0.0

    def intact(self) -> bool:
        """Whether both regions are mapped in full still."""
        return self.requests.intact() and self.replies.intact()

    def replaced(self) -> bool:
        """Whether other files have taken the place of the two."""
        return self.requests.replaced() or self.replies.replaced()

    def publish(self, frame: bytes) -> None:
        """Put a request into its region, and say so."""
        self.seen = self.replies.region.sequence
        self.requests.region.publish(frame)
        self._request_event.set()

    def ask_for_sync(self, now: float) -> bool:
        """Ask, unless that was done a moment ago, for a refusal that only this question gets; return whether it was."""
        if self._token and now - self._asked_at < _ASK_AGAIN_S:
            return False
        self._token = SYNC_PREFIX + secrets.token_hex(8)
        self._asked_at = now
        # Refused for its session before anything else about it is looked at.
        self.publish(encode_request(ReadMocapPose(body=""), self._token))
        return True

    def synchronised(self) -> bool:
        """Take up the answer to `ask_for_sync` if it is there; from then on the channel is clean."""
        found = self.replies.region.read_latest(self.seen) if self._token and self.intact() else None
        if found is not None:
            self.seen = found.sequence
            answer = envelope_of(found.payload)
            if answer.code == "session_expired" and self._token in answer.message:
                self.dirty = False
                self._token = ""
        return not self.dirty

    def close(self) -> None:
        """Let go of both regions."""
        self.requests.close()
        self.replies.close()
        self._request_event.close()
        self.reply_event.close()
