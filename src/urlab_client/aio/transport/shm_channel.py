"""The pair of request and reply regions, and the exchange that rules out outstanding old replies."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

from urlab_client._platform.windows import NamedEvent
from urlab_client.aio.background import Tell
from urlab_client.aio.transport.shm_regions import MappedRegion
from urlab_client.aio.transport.waiting import Watch
from urlab_client.protocol.base import Op
from urlab_client.protocol.codec import encode_request
from urlab_client.protocol.messages.runtime import ReadMocapPose

_SYNC_PREFIX: Final = "sync-"
"""Prefix of session ids that no server knows; their rejection completes the exchange."""

_ASK_AGAIN_S = 1.0
_FASTEST_POLL_S = 50e-6


class Envelope(Struct):
    """The fields of a reply that identify it."""

    op: str = ""
    code: str = ""
    message: str = ""


_MSGPACK = msgspec.msgpack.Decoder(Envelope)
_JSON = msgspec.json.Decoder(Envelope)


def envelope_of(reply: bytes) -> Envelope:
    """Return the identifying fields of a reply; empty if the bytes are not a reply."""
    try:
        return (_JSON if reply[:1] == b"{" else _MSGPACK).decode(reply)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return Envelope()


@cache
def _opening_of(op: Op) -> bytes:
    """Return the start of a successful msgpack reply to `op`, after the bytes that encode the length of its map."""
    return msgspec.msgpack.encode({"op": op.reply_name})[1:]


def succeeded(reply: bytes, op: Op) -> bool:
    """Return whether a reply is that of a successful `op`."""
    return reply.startswith(_opening_of(op), 1) or envelope_of(reply).op == op.reply_name


def answers(reply: bytes, op: Op) -> bool:
    """Return whether a reply may be the one to `op`."""
    if reply.startswith(_opening_of(op), 1):
        return True
    found = envelope_of(reply)
    if found.op == "error":
        return not (found.code == "session_expired" and _SYNC_PREFIX in found.message)
    return found.op in ("", op.reply_name)  # without an op, decoding it raises, instead of waiting in vain


class RegionChannel:
    """The pair of request and reply regions, for the client that holds the lock.

    Attributes:
        limit: Size of the largest payload that fits in both directions, bytes.
        dirty: Whether an old reply may still be to come.
        abandoned_at: Loop time at which the caller of this client's last request gave up, until the channel is clean.
        seen: Sequence of the reply region when the last request was published, or of the last reply.
    """

    def __init__(self, requests: Path, replies: Path, events: tuple[str, str]) -> None:
        self.requests: MappedRegion = MappedRegion(requests, writable=True)
        try:
            self.replies: MappedRegion = MappedRegion(replies)
        except BaseException:
            self.requests.close()
            raise
        self.limit: int = min(self.requests.region.max_payload, self.replies.region.max_payload)
        request_event, reply_event = events
        self._request_event = NamedEvent(request_event)
        self._reply_event = NamedEvent(reply_event)
        # A client that crashed may have left a request whose reply is still outstanding.
        self.dirty: bool = True
        self.abandoned_at: float | None = None
        self.seen: int = 0
        self._token = ""
        self._asked_at = 0.0
        self._watch: Watch | None = None

    def intact(self) -> bool:
        """Return whether both regions are still mapped completely."""
        return self.requests.intact() and self.replies.intact()

    def replaced(self) -> bool:
        """Return whether other files have replaced the regions."""
        return self.requests.replaced() or self.replies.replaced()

    def publish(self, frame: bytes) -> None:
        """Write a request to its region and signal it."""
        self.seen = self.replies.region.sequence
        self.requests.region.publish(frame)
        self._request_event.set()

    def expect(self, on_news: Callable[[], None], tell: Tell | None) -> None:
        """Have a thread look for the reply, and call `on_news` once when there may be one."""
        if self._watch is None:
            block = self._reply_event.wait if self._reply_event.exists else None
            loop = asyncio.get_running_loop()
            self._watch = Watch(
                loop, on_news, has_news=self._has_news, block=block, fastest_s=_FASTEST_POLL_S, tell=tell
            )
        self._watch.expect()

    def ignore(self) -> None:
        """End `expect`."""
        if self._watch is not None:
            self._watch.ignore()

    def _has_news(self) -> bool:
        return not self.replies.intact() or self.replies.region.sequence != self.seen

    def ask_for_sync(self, now: float) -> bool:
        """Send a request with a unique rejection unless one was sent recently. Return whether it was sent."""
        if self._token and now - self._asked_at < _ASK_AGAIN_S:
            return False
        self._token = _SYNC_PREFIX + secrets.token_hex(8)
        self._asked_at = now
        # The server checks the session first and rejects the request for it.
        self.publish(encode_request(ReadMocapPose(body=""), self._token))
        return True

    def synchronised(self) -> bool:
        """Consume the reply to `ask_for_sync` if it has arrived. Return whether the channel is clean."""
        found = self.replies.region.read_latest(self.seen) if self._token and self.intact() else None
        if found is not None:
            self.seen = found.sequence
            answer = envelope_of(found.payload)
            if answer.code == "session_expired" and self._token in answer.message:
                self.dirty = False
                self.abandoned_at = None
                self._token = ""
        return not self.dirty

    def close(self) -> None:
        """Release both regions."""
        if self._watch is not None:
            self._watch.close()
            self._watch = None  # it refers to this channel
        self.requests.close()
        self.replies.close()
        self._request_event.close()
        self._reply_event.close()
