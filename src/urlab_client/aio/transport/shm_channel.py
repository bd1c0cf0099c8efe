"""The pair of request and reply regions, and the exchange that rules out outstanding old replies."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from functools import cache
from typing import Final

import msgspec
from msgspec import Struct

from urlab_client._platform.mapped_files import MappedFile
from urlab_client._platform.windows import NamedEvent
from urlab_client.aio.transport.shm_regions import RegionReader, ServerRegions, attached
from urlab_client.errors import ProtocolError
from urlab_client.protocol.base import Op
from urlab_client.protocol.codec import encode_request
from urlab_client.protocol.messages.runtime import ReadMocapPose
from urlab_client.protocol.shm import REPLY_FILE, REQUEST_FILE, Ring

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


def envelope_of(reply: bytes, op: Op | None = None) -> Envelope:
    """Return the identifying fields of a reply, which is probably one to `op`; empty if the bytes are not a reply."""
    if op is not None and reply.startswith((success := _success_of(op))[0], 1):
        return success[1]  # without looking at the rest, which takes as long as it is
    try:
        return (_JSON if reply[:1] == b"{" else _MSGPACK).decode(reply)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return Envelope()


@cache
def _success_of(op: Op) -> tuple[bytes, Envelope]:
    """Return what identifies a successful reply to `op`, and its start after the length of its msgpack map."""
    return msgspec.msgpack.encode({"op": op.reply_name})[1:], Envelope(op.reply_name)


def answers(reply: bytes, op: Op) -> bool:
    """Return whether a reply may be the one to `op`."""
    found = envelope_of(reply, op)
    if found.op == "error":
        return not (found.code == "session_expired" and _SYNC_PREFIX in found.message)
    return found.op in ("", op.reply_name)  # without an op, decoding it raises, instead of waiting in vain


class RegionInUse(ProtocolError):
    """Another client on this machine uses the regions."""


class RegionChannel:
    """The pair of request and reply regions, for the client that holds the lock.

    Args:
        location: Where the regions are.
        on_news: Called when a reply may have arrived.
        on_lost: Called when the regions were replaced or damaged.

    Attributes:
        replies: The region of replies; its `seen` is that of the last request, or of the last reply.
        limit: Size of the largest payload that fits in both directions, bytes.
        dirty: Whether an old reply may still be to come.
        abandoned_at: Loop time at which the caller of this client's last request gave up, until the channel is clean.

    Raises:
        RegionInUse: Another client holds the lock.
        ProtocolError: A file is not a region, or not yet.
        OSError: A file cannot be opened.
    """

    def __init__(self, location: ServerRegions, *, on_news: Callable[[], None], on_lost: Callable[[], None]) -> None:
        path = location.find(REQUEST_FILE)
        self._file = MappedFile(path, writable=True)
        self._requests = attached(self._file)
        try:
            if not self._file.lock():
                raise RegionInUse(f"{path}: another client on this machine uses it.")  # noqa: TRY301
            self.replies: RegionReader = RegionReader(
                location, REPLY_FILE, Ring.REPLY, on_news=on_news, on_lost=on_lost, fastest_s=_FASTEST_POLL_S
            )
        except BaseException:
            self._close_requests()
            raise
        self.replies.waits = False
        self.limit: int = min(self._requests.max_payload, self.replies.region.max_payload)
        self._request_event, self._reply_event = map(NamedEvent, location.events(path))
        if self._reply_event.exists:
            self.replies.block = self._reply_event.wait
        # A client that crashed may have left a request whose reply is still outstanding.
        self.dirty: bool = True
        self.abandoned_at: float | None = None
        self._token = ""
        self._asked_at = 0.0

    def intact(self) -> bool:
        """Return whether both regions are still mapped completely."""
        return self._file.intact() and self.replies.file.intact()

    def publish(self, frame: bytes) -> None:
        """Write a request to its region and signal it. Call only while `intact`."""
        self.replies.seen = self.replies.region.sequence
        self._requests.publish(frame)
        self._request_event.set()

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
        found = self.replies.region.read_latest(self.replies.seen) if self._token else None
        if found is not None:
            self.replies.seen = found.sequence
            answer = envelope_of(found.payload)
            if answer.code == "session_expired" and self._token in answer.message:
                self.dirty = False
                self.abandoned_at = None
                self._token = ""
        return not self.dirty

    def close(self) -> None:
        """Release both regions."""
        self.replies.close()
        self._close_requests()
        self._request_event.close()
        self._reply_event.close()

    def _close_requests(self) -> None:
        self._requests.release()
        self._file.close()
