"""Requests over shared memory, with ZeroMQ beside it for what cannot go that way.

The plugin loses a reply that does not fit its slot, after it has executed the request, and a reply carries no number.
So what goes which way is decided before sending, a request is sent once, and after a request that got no reply nothing
is sent over shared memory until an exchange without side effects has shown that no old reply is still to come.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

from urlab_client._windows import NamedEvent
from urlab_client.aio.transport.base import LateReply, RequestTransport
from urlab_client.aio.transport.busy_poll import BusyPoll
from urlab_client.aio.transport.mapped_region import MappedRegion, RegionInUse
from urlab_client.aio.transport.poller import Doorbell, Poller, ReplyPoll
from urlab_client.protocol import doorbell
from urlab_client.protocol.base import Effect, Needs, Op
from urlab_client.protocol.codec import encode_request
from urlab_client.protocol.errors import (
    ClientClosed,
    ConnectionLost,
    OutcomeUnknown,
    ProtocolError,
    URLabConnectionError,
    URLabError,
    URLabTimeoutError,
)
from urlab_client.protocol.messages.runtime import ReadMocapPose
from urlab_client.protocol.messages.session import HelloOk, StateReply
from urlab_client.protocol.messages.streams import ClientEvent, ServerLost
from urlab_client.protocol.shm import REPLY_FILE, REQUEST_FILE, RegionNotReady, region_directories

__all__ = ["SharedMemoryRegions", "ShmTransport"]

log = logging.getLogger("urlab_client.transport")

# Replies that grow with what happens in the scene, whatever size they had before.
_UNBOUNDED = frozenset({"hello", "meta", "get_contacts", "list_keyframes", "replay_list_sessions"})
# A reply may be so many times larger than the largest one of its kind seen before.
_GROWTH = 8

_NOT_READY_S = 0.5
_RETRY_S = 1.0
_SETTLE_S = 0.5
_IDLE_S = 0.5
# Whatever is to tell of a reply, look for it so often, too: a ring that is lost must not cost more.
_GLANCE_S = 0.05

# Looking from the loop before the thread is asked to; longer than the last waits took is of no use.
_SPIN_S = 400e-6
_LONGEST_SPIN_S = 2e-3

_SYNC: Final = "sync-"


class SharedMemoryRegions:
    """Where one client's server has its regions, and how the client learns of news in them.

    Args:
        directory: Where the regions are, when it is not where the server says.

    Attributes:
        directory: Directory of `state.shm`; None while no server said so.
        rung: Called for each ring of the doorbell, by kind.
    """

    def __init__(self, directory: str | os.PathLike[str] | None) -> None:
        self.directory: Path | None = None
        self.rung: dict[bytes, list[Callable[[], None]]] = {doorbell.STATE: [], doorbell.CAMERA: [], doorbell.REPLY: []}
        self._given = None if directory is None else Path(directory).absolute()
        self._waiter: Poller | None = None
        self._bell: Doorbell | None = None
        self._wanted: set[bytes] = set()

    @property
    def waiter(self) -> Poller:
        """The thread that looks, where there is no doorbell."""
        if self._waiter is None:
            self._waiter = Poller(asyncio.get_running_loop())
        return self._waiter

    @property
    def bell(self) -> Doorbell | None:
        """The doorbell, while there is one."""
        return self._bell

    def follow(self, hello: HelloOk) -> bool:
        """Take over what a handshake says; return whether the regions are elsewhere than before.

        Raises:
            URLabConnectionError: The server says that play runs, and not where its regions are.
        """
        before = self.directory
        if self._given is not None:
            self.directory = self._given
        elif hello.shm_session_dir is not None:
            self.directory = Path(hello.shm_session_dir)
        elif hello.manager_present:
            raise URLabConnectionError(
                "discover: transport='shm', but the server names no directory of shared memory.",
                hint="Start it with shared memory, or use transport='zmq'.",
            )
        return self.directory != before

    def candidates(self, file: str) -> list[Path]:
        """Return where a region's file may be, best place first.

        Raises:
            ProtocolError: The server's directory is not absolute.
        """
        if self.directory is None:
            return []
        if self._given is not None:
            return [self._given / file]
        return [Path(directory) / file for directory in region_directories(self.directory, file)]

    def find(self, file: str) -> Path | None:
        """Return where a region's file is; None when it is nowhere."""
        return next((path for path in self.candidates(file) if path.exists()), None)

    def connect_bell(self) -> Doorbell | None:
        """Return the doorbell, connecting it if the server has one."""
        if self._bell is None:
            on_ring = {kind: self._act(kind) for kind in self.rung}
            try:
                requests = self.find(REQUEST_FILE)
                path = None if requests is None else requests.with_name(doorbell.FILE)
                if path is None or not path.exists():
                    return None
                bell = self._bell = Doorbell(asyncio.get_running_loop(), path, on_ring, self._lose_bell)
            except (OSError, ProtocolError) as error:
                log.debug("no doorbell: %s", error)
                return None
            for message in self._wanted:
                bell.ring(message)  # which may find that it is lost already
        return self._bell

    def want(self, message: bytes) -> None:
        """Ask to be told of publications, too: `WANT_STATE` or `WANT_CAMERAS`."""
        if message not in self._wanted:
            self._wanted.add(message)
            if self._bell is not None:
                self._bell.ring(message)

    def disconnect(self) -> None:
        """Let go of the server, which is gone or elsewhere."""
        if self._bell is not None:
            self._bell.close()
            self._bell = None

    def close(self) -> None:
        """Release everything. Idempotent."""
        self.disconnect()
        if self._waiter is not None:
            self._waiter.close()

    def _act(self, kind: bytes) -> Callable[[], None]:
        def act() -> None:
            for listener in tuple(self.rung[kind]):
                listener()

        return act

    def _lose_bell(self) -> None:
        self._bell = None
        # Whoever waited for a ring looks once more and goes on without.
        for kind in self.rung:
            self._act(kind)()


class _Envelope(Struct):
    """What a reply says about itself."""

    op: str = ""
    code: str = ""
    message: str = ""


_MSGPACK = msgspec.msgpack.Decoder(_Envelope)
_JSON = msgspec.json.Decoder(_Envelope)


def _envelope(reply: bytes) -> _Envelope:
    """Read what a reply says about itself; empty for what is not a reply."""
    try:
        return (_JSON if reply[:1] == b"{" else _MSGPACK).decode(reply)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return _Envelope()


@cache
def _opening(op: Op) -> bytes:
    """Return how a successful msgpack reply to `op` begins, after the byte or bytes that say how long its map is."""
    return msgspec.msgpack.encode({"op": op.reply_name})[1:]


class _RegionChannel:
    """The pair of request and reply region, for the one client that holds the lock."""

    def __init__(self, requests: Path, replies: Path) -> None:
        self.requests = MappedRegion(requests, writable=True, exclusive=True)
        try:
            self.replies = MappedRegion(replies)
        except BaseException:
            self.requests.close()
            raise
        session = requests.parent.name
        self._request_event = NamedEvent(f"Local\\URLab_{session}_req_ready")
        self.reply_event = NamedEvent(f"Local\\URLab_{session}_rep_ready")
        # A client that died here may have left a request behind whose reply is still to come.
        self.dirty = True
        self.seen = 0
        self._token = ""
        self._asked_at = 0.0

    @property
    def limit(self) -> int:
        """Largest payload that fits in both directions."""
        return min(self.requests.region.max_payload, self.replies.region.max_payload)

    def intact(self) -> bool:
        return self.requests.intact() and self.replies.intact()

    def replaced(self) -> bool:
        return self.requests.replaced() or self.replies.replaced()

    def publish(self, frame: bytes) -> None:
        self.seen = self.replies.region.sequence
        self.requests.region.publish(frame)
        self._request_event.set()

    def ask_for_sync(self, now: float) -> bool:
        """Ask, unless that was done a moment ago, for a refusal that only this question gets; return whether it was."""
        if self._token and now - self._asked_at < _RETRY_S:
            return False
        self._token = _SYNC + secrets.token_hex(8)
        self._asked_at = now
        # Refused for its session before anything else about it is looked at.
        self.publish(encode_request(ReadMocapPose(body=""), self._token))
        return True

    def synchronised(self) -> bool:
        """Take up the answer to `ask_for_sync` if it is there; from then on the channel is clean."""
        found = self.replies.region.read_latest(self.seen) if self._token and self.intact() else None
        if found is not None:
            self.seen = found.sequence
            answer = _envelope(found.payload)
            if answer.code == "session_expired" and self._token in answer.message:
                self.dirty = False
                self._token = ""
        return not self.dirty

    def close(self) -> None:
        self.requests.close()
        self.replies.close()
        self._request_event.close()
        self.reply_event.close()


class _Pending:
    """The request under way."""

    def __init__(self, op: Op, future: asyncio.Future[bytes]) -> None:
        self.op = op
        self.future = future
        self.watch: ReplyPoll | None = None
        self.glance: asyncio.TimerHandle | None = None


class ShmTransport:
    """Transport over shared memory for what fits, and over another one for the rest.

    Args:
        inner: The other one; it also tells whether the server lives.
        memory: Where the server's regions are.
    """

    def __init__(self, inner: RequestTransport, memory: SharedMemoryRegions) -> None:
        self.on_event: Callable[[ClientEvent], None] | None = None
        self.stats = inner.stats
        self._inner = inner
        self._memory = memory
        inner.on_event = self._on_event
        memory.rung[doorbell.REPLY].append(self._on_ring)
        self._channel: _RegionChannel | None = None
        self._obstacle = "no handshake yet"
        self._retry_at = 0.0
        self._used_at = 0.0
        self._pending: _Pending | None = None
        self._closed = False
        self._refused: dict[str, str] = {}
        self._largest_state = 0
        self._busy_poll = BusyPoll(_SPIN_S, _LONGEST_SPIN_S)

    @property
    def state_port(self) -> int | None:
        """See `RequestTransport.state_port`."""
        return self._inner.state_port

    @property
    def endpoint(self) -> str:
        """The server's RPC endpoint."""
        return self._inner.endpoint

    @property
    def connected(self) -> bool:
        """Whether a server is on the line."""
        return self._inner.connected

    async def follow(self, hello: HelloOk) -> None:
        """Open the regions that a handshake speaks of.

        Another client may have them already: then everything goes over ZMQ until it is gone.

        Raises:
            URLabConnectionError: They are not where they should be, or they are none.
        """
        moved = self._memory.follow(hello)
        self._largest_state = 0
        self._refused.clear()
        if self._channel is not None and (moved or not self._channel.intact() or self._channel.replaced()):
            self._drop("the server moved")
        if self._memory.directory is None:
            self._obstacle = "play has not begun"
            return
        loop = asyncio.get_running_loop()
        give_up = loop.time() + _NOT_READY_S
        while self._channel is None and not self._closed:
            try:
                self._open()
            except RegionInUse as error:
                self._put_off(error)
                return
            except (OSError, ProtocolError) as error:
                if loop.time() < give_up and isinstance(error, (FileNotFoundError, RegionNotReady)):
                    await asyncio.sleep(0.01)
                    continue
                self._put_off(error)
                raise URLabConnectionError(
                    f"discover: transport='shm', but the server's shared memory cannot be used: {_reason(error)}",
                    hint="Is the server on this machine, and this its directory? Else use transport='zmq'.",
                ) from error
        channel = self._channel
        if channel is None:
            return
        self._memory.connect_bell()
        give_up = loop.time() + _SETTLE_S
        while self._settling(channel) and loop.time() < give_up:  # noqa: ASYNC110 - a region has no event
            await asyncio.sleep(0.001)

    async def request(
        self, frame: bytes, op: Op, *, deadline: float | None, connect_by: float | None, late: LateReply | None = None
    ) -> bytes:
        """See `RequestTransport.request`. Where late replies come is told of what goes over ZMQ, as handshakes do."""
        detour = self._detour(frame, op)
        channel = None
        if not detour:
            channel = self._usable_channel()
            if channel is None:
                detour = self._obstacle
            elif len(frame) > channel.limit:
                detour = "request too large"
            elif issubclass(op.reply, StateReply) and not 0 < self._largest_state * _GROWTH <= channel.limit:
                detour = "reply may be too large" if self._largest_state else "size of the reply not known yet"
        if channel is not None and not detour:
            answer = await self._over_shm(channel, frame, op, deadline)
            detour = self._refusal(answer, op)
            if not detour:
                self._learn(frame, op, answer)
                return answer
        self.stats.over_zmq[detour] = self.stats.over_zmq.get(detour, 0) + 1
        answer = await self._inner.request(frame, op, deadline=deadline, connect_by=connect_by, late=late)
        self._learn(frame, op, answer)
        return answer

    async def aclose(self) -> None:
        """See `RequestTransport.aclose`."""
        self._closed = True
        closed = ClientClosed(f"The client of {self.endpoint} was closed.", hint="Make a new client.")
        self._fail(lambda _: closed)
        self._drop("closed")
        self._memory.close()
        await self._inner.aclose()

    # Which way

    def _detour(self, frame: bytes, op: Op) -> str:
        """Return why a request cannot go over shared memory, whatever its state; empty if it can."""
        if op.needs is Needs.EDITOR:
            return "editor op"
        if op.name in _UNBOUNDED:
            return "handshake" if op.needs is Needs.NOTHING else "reply may be too large"
        if op.name == "step" and b"include_cameras" in frame:
            return "pictures"
        return self._refused.get(op.name, "")

    def _usable_channel(self) -> _RegionChannel | None:
        """Return the channel if it may be used right now."""
        loop = asyncio.get_running_loop()
        now = loop.time()
        if self._closed or self._pending is not None:
            self._obstacle = "busy"
            return None
        channel = self._channel
        doubtful = channel is not None and (channel.dirty or now - self._used_at > _IDLE_S)
        if channel is not None and (not channel.intact() or (doubtful and channel.replaced())):
            self._drop("the regions were replaced")
            channel = None
        if channel is None:
            if self._memory.directory is None or now < self._retry_at or not self._inner.connected:
                return None
            try:
                channel = self._open()
            except (OSError, ProtocolError) as error:
                self._put_off(error)
                return None
        self._used_at = now
        if not self._is_clean(channel):
            if self._channel is not None:
                self._obstacle = "waiting for an old reply"
            return None
        return channel

    def _settling(self, channel: _RegionChannel) -> bool:
        """Whether `channel` has yet to become clean, unless it is gone or another task's request is in it by now."""
        return self._channel is channel and self._pending is None and not self._is_clean(channel)

    def _is_clean(self, channel: _RegionChannel) -> bool:
        try:
            waits = channel.dirty and channel.intact() and not channel.synchronised()
            if waits and channel.ask_for_sync(asyncio.get_running_loop().time()):
                self._ring()
        except ProtocolError as error:
            self._drop("no usable regions")
            self._put_off(error)
        return not channel.dirty

    def _open(self) -> _RegionChannel:
        """Open the regions. Raises as `MappedRegion` does."""
        paths: list[Path] = []
        for file in (REQUEST_FILE, REPLY_FILE):
            path = self._memory.find(file)
            if path is None:
                looked = ", ".join(map(str, self._memory.candidates(file)))
                raise FileNotFoundError(f"there is no {looked}")
            paths.append(path)
        self._channel = _RegionChannel(*paths)
        self._memory.connect_bell()
        self._used_at = asyncio.get_running_loop().time()
        log.info(
            "shared memory in %s, %s", paths[0].parent, "with a doorbell" if self._memory.bell else "without a doorbell"
        )
        return self._channel

    def _put_off(self, error: Exception) -> None:
        self._obstacle = "regions in use by another client" if isinstance(error, RegionInUse) else "no usable regions"
        self._retry_at = asyncio.get_running_loop().time() + _RETRY_S
        log.info("shared memory: %s: %s", self._obstacle, _reason(error))

    def _refusal(self, answer: bytes, op: Op) -> str:
        """Return why an answer means that the request has to go over ZMQ; empty if it is the answer."""
        if answer.startswith(_opening(op), 1):
            return ""
        code = _envelope(answer).code
        if code == "wrong_transport":  # says before anything else that it was not executed
            self._refused[op.name] = "refused by the server"
        elif code == "reply_too_large":
            self._refused[op.name] = "reply too large"
            if op.effect is not Effect.READ:
                return ""
        return self._refused.get(op.name, "")

    def _learn(self, frame: bytes, op: Op, answer: bytes) -> None:
        if issubclass(op.reply, StateReply) and b"include_cameras" not in frame:
            self._largest_state = max(self._largest_state, len(answer))

    # Over shared memory

    async def _over_shm(self, channel: _RegionChannel, frame: bytes, op: Op, deadline: float | None) -> bytes:
        loop = asyncio.get_running_loop()
        pending = self._pending = _Pending(op, loop.create_future())
        timer: asyncio.TimerHandle | None = None
        started = loop.time()
        # Until the reply is here, whatever ends the wait leaves one that is still to come.
        channel.dirty = True
        try:
            channel.publish(frame)
            sent = time.perf_counter()
            self.stats.sent += 1
            self.stats.over_shm += 1
            self._ring()
            if deadline is not None:
                timer = loop.call_at(deadline, self._expire, pending, deadline - started)
            if self._busy_poll.pays(op.name):
                await self._busy_poll.look(op.name, pending.future, lambda: self._look_at(channel))
            if not pending.future.done():
                if self._memory.bell is None:
                    self._watch()
                pending.glance = loop.call_later(_GLANCE_S, self._glance, pending)
            answer = await pending.future
        finally:
            self._unwatch()
            if pending.glance is not None:
                pending.glance.cancel()
            self._pending = None
            if timer is not None:
                timer.cancel()
            self._used_at = loop.time()
        channel.dirty = False
        self.stats.received += 1
        self._busy_poll.note(op.name, time.perf_counter() - sent)
        return answer

    def _ring(self) -> None:
        bell = self._memory.bell
        if bell is not None:
            bell.ring(doorbell.REQUEST)

    def _look_at(self, channel: _RegionChannel) -> None:
        # Between two looks another task may have had the loop for as long as a server takes to start again.
        if not channel.replies.intact() or channel.replies.region.sequence != channel.seen:
            self._look()

    def _glance(self, pending: _Pending) -> None:
        self._look()
        if not pending.future.done() and self._channel is not None and self._channel.replaced():
            self._drop("the regions were replaced")
        if not pending.future.done():
            pending.glance = asyncio.get_running_loop().call_later(_GLANCE_S, self._glance, pending)

    def _watch(self) -> None:
        """Let the thread look for the reply from now on."""
        pending, channel = self._pending, self._channel
        if pending is None or pending.future.done() or pending.watch is not None or channel is None:
            return
        replies, event = channel.replies, channel.reply_event

        def news() -> bool:
            return not replies.intact() or replies.region.sequence != channel.seen

        pending.watch = ReplyPoll(news, self._look, event.wait if event.exists else None)
        self._memory.waiter.add(pending.watch)

    def _unwatch(self) -> None:
        if self._pending is not None and self._pending.watch is not None:
            self._memory.waiter.remove(self._pending.watch)
            self._pending.watch = None

    def _on_ring(self) -> None:
        self._look()
        if self._memory.bell is None:
            self._watch()

    def _look(self) -> None:
        """Take up the reply if it is there."""
        pending, channel = self._pending, self._channel
        if pending is None or pending.future.done() or channel is None:
            return
        if not channel.replies.intact():
            self._drop("the reply region was cut off")
            return
        try:
            found = channel.replies.region.read_latest(channel.seen)
        except ProtocolError as error:
            pending.future.set_exception(
                ProtocolError(f"{pending.op.name}: {channel.replies.path}: {error.args[0]}", op=pending.op.name)
            )
            self._drop("the reply region is damaged")
            return
        if found is None:
            sequence = channel.replies.region.sequence
            if sequence == 0:  # begun anew: it counts from one again
                channel.seen = 0
            if sequence != channel.seen:  # it changed while it was read, again and again
                asyncio.get_running_loop().call_soon(self._look)
            elif pending.watch is not None:
                pending.watch.resume()
            return
        channel.seen = found.sequence
        if self._answers(found.payload, pending.op):
            pending.future.set_result(found.payload)
        else:
            self.stats.late += 1
            if pending.watch is not None:
                pending.watch.resume()
            log.debug("%s: dropped a reply to another request", channel.replies.path)

    @staticmethod
    def _answers(reply: bytes, op: Op) -> bool:
        if reply.startswith(_opening(op), 1):
            return True
        found = _envelope(reply)
        if found.op == "error":
            return not (found.code == "session_expired" and _SYNC in found.message)
        return found.op == op.reply_name

    def _expire(self, pending: _Pending, seconds: float) -> None:
        self._look()
        if pending.future.done():
            return
        executed = "" if pending.op.effect is Effect.READ else " The request was sent and may still be executed."
        pending.future.set_exception(
            URLabTimeoutError(
                f"{pending.op.name}: no reply in shared memory within {seconds * 1000:.0f} ms.{executed}",
                op=pending.op.name,
                hint="The server is busy or blocked; allow more time with timeout=…",
            )
        )

    # When the server goes

    def _on_event(self, event: ClientEvent) -> None:
        if isinstance(event, ServerLost):
            self._look()
            self._drop("the server was lost")
        if self.on_event is not None:
            self.on_event(event)

    def _drop(self, obstacle: str) -> None:
        self._obstacle = obstacle
        self._fail(self._lost)
        self._unwatch()
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        self._memory.disconnect()

    def _fail(self, error: Callable[[Op], URLabError]) -> None:
        pending = self._pending
        if pending is not None and not pending.future.done():
            pending.future.set_exception(error(pending.op))

    def _lost(self, op: Op) -> URLabError:
        text = f"{op.name}: the server at {self.endpoint} was lost after the request was sent."
        if op.effect is Effect.READ:
            return ConnectionLost(text, op=op.name, hint="The op changes nothing: it can be sent again.")
        return OutcomeUnknown(
            text, op=op.name, hint="Whether it was executed is unknown: call discover() and look at the state."
        )


def _reason(error: Exception) -> str:
    return str(error.args[0]) if isinstance(error, URLabError) else str(error)
