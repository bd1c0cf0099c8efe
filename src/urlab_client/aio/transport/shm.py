"""Requests over shared memory, with ZeroMQ for those that cannot use it.

The plugin executes a request and then drops its reply if that does not fit its slot, and replies carry no number. So
the transport is chosen before sending and a request is sent only once. After a request without a reply, shared memory
stays unused until an exchange without side effects has shown that no old reply is outstanding.

The server serves shared memory and ZeroMQ in two threads, so a request could overtake an earlier one whose caller gave
up. Behind one on ZeroMQ the next request also takes ZeroMQ; behind one in shared memory it waits until that exchange
has shown that the server is done with it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from functools import cache
from typing import Final

from urlab_client.aio.transport.base import Deadlines, LateReply, SentRequest, lost, no_reply
from urlab_client.aio.transport.shm_channel import RegionChannel, RegionInUse, answers, envelope_of
from urlab_client.aio.transport.shm_regions import ServerRegions
from urlab_client.aio.transport.waiting import BusyPoll
from urlab_client.aio.transport.zmq import ZmqTransport
from urlab_client.errors import ClientClosed, ProtocolError, URLabConnectionError, URLabError, URLabTimeoutError
from urlab_client.protocol.base import Effect, Needs, Op
from urlab_client.protocol.messages.session import HelloOk, StateReply
from urlab_client.protocol.shm import RegionNotReady, Ring

log: logging.Logger = logging.getLogger("urlab_client.transport")

# A reply may be this many times larger than the largest one of its kind seen before.
_GROWTH = 8

_NOT_READY_S = 0.5
_RETRY_S = 1.0
_SETTLE_S = 0.5
_SETTLE_LOOK_S = 1e-3
# No request over shared memory takes this long, so nothing reads these regions any more.
_DEAD_S = 30.0
_IDLE_S = 0.5

# Time to poll on the loop before it sleeps.
_SPIN_S = 400e-6
_LONGEST_SPIN_S = 2e-3

# Ops whose replies grow with the scene, regardless of their earlier size.
_UNBOUNDED: Final = frozenset({"hello", "meta", "get_contacts", "list_keyframes", "replay_list_sessions"})
# Chunks are larger than slots, and a chunk that was executed without a reply must not be sent again.
_UPLOADS: Final = frozenset({"upload_model_manifest", "upload_model_chunk", "upload_model_commit"})


@cache
def _always_over_zmq(op: Op) -> str:
    """Return why requests of an op always use ZeroMQ; empty if they may use shared memory."""
    if op.needs is Needs.EDITOR:
        return "editor op"
    if op.ns == "scene" or op.name in _UPLOADS:
        return "upload"  # its chunks and its reply exceed a slot
    if op.name in _UNBOUNDED:
        return "handshake" if op.needs is Needs.NOTHING else "reply may be too large"
    return ""


class ShmRequests:
    """Requests over shared memory if they fit, and over ZeroMQ if not.

    Args:
        over_zmq: The transport that they belong to, which also detects whether the server is alive.
        regions: Location of the server's regions.
    """

    def __init__(self, over_zmq: ZmqTransport, regions: ServerRegions) -> None:
        self._over_zmq = over_zmq
        self._stats = over_zmq.stats
        self._regions = regions
        regions.on_look.append(self._on_look)
        self._channel: RegionChannel | None = None
        self._obstacle = "no handshake yet"
        self._retry_at = 0.0
        self._used_at = 0.0
        self._pending: SentRequest | None = None
        self._closed = False
        self._refused: dict[str, str] = {}
        self._largest_state = 0
        self._busy_poll = BusyPoll(_SPIN_S, _LONGEST_SPIN_S)

    async def follow(self, hello: HelloOk) -> None:
        """Open the regions that a handshake names.

        If another client uses them, all requests go over ZMQ until it has gone.

        Raises:
            URLabConnectionError: The regions do not exist or are not valid.
        """
        moved = self._regions.follow(hello)
        self._largest_state = 0
        self._refused.clear()
        if self._channel is not None and (moved or not self._channel.intact() or self._channel.replies.moved()):
            self._drop("the server moved")
        if self._regions.directory is None:
            self._obstacle = "play has not begun"
            return
        loop = asyncio.get_running_loop()
        give_up = loop.time() + _NOT_READY_S
        while self._channel is None and not self._closed:
            error = self._try_to_open(loop.time())
            if isinstance(error, RegionInUse):
                return
            if error is not None:
                if loop.time() < give_up and isinstance(error, (FileNotFoundError, RegionNotReady)):
                    await asyncio.sleep(0.01)
                    continue
                raise URLabConnectionError(
                    f"discover: transport='shm', but the server's shared memory cannot be used: {_reason(error)}",
                    hint="Check that the server is on this machine and uses this directory, or use transport='zmq'.",
                ) from error
        channel = self._channel
        if channel is None:
            return
        give_up = loop.time() + _SETTLE_S
        while loop.time() < give_up and self._channel is channel and self._pending is None:
            if self._is_clean(channel):
                return
            await asyncio.sleep(_SETTLE_LOOK_S)  # a region has no event

    async def request(self, frame: bytes, op: Op, deadlines: Deadlines, *, late: LateReply | None = None) -> bytes:
        """See `ZmqTransport.request`."""
        if self._channel is not None and self._channel.abandoned_at is not None:
            await self._let_it_end(op, deadlines.reply)
        pictures = op.name == "step" and b"include_cameras" in frame
        has_state = issubclass(op.reply, StateReply)  # whose size is nearly constant
        why_zmq = _always_over_zmq(op) or ("pictures" if pictures else self._refused.get(op.name, ""))
        if not why_zmq and self._over_zmq.owed:
            why_zmq = "behind an abandoned request"
        if not why_zmq:
            loop = asyncio.get_running_loop()
            now = loop.time()
            channel = self._usable_channel(now)
            if channel is None:
                why_zmq = self._obstacle
            elif len(frame) > channel.limit:
                why_zmq = "request too large"
            elif has_state and not 0 < self._largest_state * _GROWTH <= channel.limit:
                why_zmq = "reply may be too large" if self._largest_state else "size of the reply not known yet"
            else:
                sent = SentRequest(op, loop.create_future(), now, deadlines.reply)
                answer = await self._over_shm(channel, frame, sent, loop)
                why_zmq = self._refusal(answer, op)
                if not why_zmq:
                    if has_state and len(answer) > self._largest_state:
                        self._largest_state = len(answer)
                    return answer
        self._stats.over_zmq[why_zmq] = self._stats.over_zmq.get(why_zmq, 0) + 1
        answer = await self._over_zmq.request(frame, op, deadlines, late=late)
        if (
            has_state and not pictures and envelope_of(answer, op).op == op.reply_name
        ):  # a refusal does not show the size of the state
            self._largest_state = max(self._largest_state, len(answer))
        return answer

    def on_server_lost(self) -> None:
        """Fail the pending request, unless its reply has arrived."""
        if self._channel is not None:
            self._channel.replies.check()
        self._drop("the server was lost")

    def close(self, error: ClientClosed) -> None:
        """Fail the pending request and release the regions. Idempotent."""
        self._closed = True
        self._fail(lambda _: error)
        self._drop("closed")

    # Routing

    def _usable_channel(self, now: float) -> RegionChannel | None:
        """Return the channel if it can be used now."""
        if self._closed or self._pending is not None:
            self._obstacle = "busy"
            return None
        channel = self._channel
        if channel is not None:
            doubtful = channel.dirty or now - self._used_at > _IDLE_S
            if not channel.intact() or (doubtful and channel.replies.moved()):
                self._drop("the regions were replaced")
        if self._channel is None:
            if self._regions.directory is None or now < self._retry_at or not self._over_zmq.connected:
                return None
            self._try_to_open(now)
        self._used_at = now
        channel = self._channel
        if channel is None or not channel.dirty or self._is_clean(channel):
            return channel
        if self._channel is not None:
            self._obstacle = "waiting for an old reply"
        return None

    async def _let_it_end(self, op: Op, deadline: float | None) -> None:
        """Wait until the server is done with the request whose caller gave up.

        Raises:
            URLabTimeoutError: It was not done by the deadline.
        """
        loop = asyncio.get_running_loop()
        while (channel := self._channel) is not None and (since := channel.abandoned_at) is not None:
            now = loop.time()
            if self._usable_channel(now) is not None:
                return
            if now > since + _DEAD_S:
                self._drop("no answer in shared memory")
            elif deadline is not None and now >= deadline:
                raise URLabTimeoutError(
                    f"{op.name}: the server has not answered an abandoned request in shared memory yet, which this one "
                    "must not overtake. Nothing was sent.",
                    op=op.name,
                    hint="The server is busy or blocked; allow more time with timeout=…",
                )
            else:
                await asyncio.sleep(_SETTLE_LOOK_S)

    def _is_clean(self, channel: RegionChannel) -> bool:
        now = asyncio.get_running_loop().time()
        try:
            if channel.dirty and channel.intact() and not channel.synchronised() and channel.ask_for_sync(now):
                self._ring()
        except ProtocolError as error:
            self._drop("")
            self._put_off(error, now)
        return not channel.dirty

    def _try_to_open(self, now: float) -> Exception | None:
        """Open the regions. Return why they cannot be used."""
        try:
            channel = self._channel = RegionChannel(self._regions, on_news=self._on_news, on_lost=self._on_lost)
        except (OSError, ProtocolError) as error:
            self._put_off(error, now)
            return error
        doorbell = "no" if self._regions.doorbell is None else "yes"
        log.info("shared memory in %s; doorbell: %s", channel.replies.file.path.parent, doorbell)
        return None

    def _put_off(self, error: Exception, now: float) -> None:
        before = self._obstacle
        self._obstacle = "regions in use by another client" if isinstance(error, RegionInUse) else "no usable regions"
        self._retry_at = now + _RETRY_S
        if self._obstacle != before:
            log.info("shared memory: %s: %s", self._obstacle, _reason(error))

    def _refusal(self, answer: bytes, op: Op) -> str:
        """Return why a reply requires sending the request over ZMQ; empty if the reply is final."""
        code = envelope_of(answer, op).code
        if code == "wrong_transport":  # the server did not execute the request
            self._refused[op.name] = "refused by the server"
        elif code == "reply_too_large":
            self._refused[op.name] = "reply too large"
            if op.effect is not Effect.READ:
                return ""
        else:
            return ""
        return self._refused[op.name]

    # Over shared memory

    async def _over_shm(
        self, channel: RegionChannel, frame: bytes, pending: SentRequest, loop: asyncio.AbstractEventLoop
    ) -> bytes:
        op, reply = pending.op, pending.reply
        self._pending = pending
        # If the wait ends without the reply, that reply is still outstanding.
        channel.dirty = channel.replies.waits = True
        try:
            channel.publish(frame)
            sent = time.perf_counter()
            self._stats.sent += 1
            self._stats.over_shm += 1
            self._ring()
            self._regions.look_by(pending.deadline)
            awake = self._busy_poll.pays(op.name)
            if awake:
                await self._busy_poll.look(op.name, reply, channel.replies.check)
            if not reply.done() and self._regions.doorbell is None:
                channel.replies.look()
            answer = await reply
        except BaseException:
            channel.abandoned_at = loop.time()
            raise
        finally:
            channel.replies.ignore()
            self._pending = None
        channel.dirty = False
        self._stats.received += 1
        self._busy_poll.note(op.name, time.perf_counter() - sent, awake=awake)
        return answer

    def _ring(self) -> None:
        if self._regions.doorbell is not None:
            self._regions.doorbell.ring(Ring.REQUEST)

    def _on_news(self) -> None:
        """Deliver the reply if it has arrived."""
        pending, channel = self._pending, self._channel
        if pending is None or pending.reply.done() or channel is None:
            return
        replies = channel.replies
        try:
            found = replies.region.read_latest(replies.seen)
        except ProtocolError as error:
            pending.reply.set_exception(
                ProtocolError(f"{pending.op.name}: {replies.file.path}: {error.args[0]}", op=pending.op.name)
            )
            self._drop("the reply region is damaged")
            return
        if found is None:  # it kept changing while it was read
            asyncio.get_running_loop().call_soon(replies.look)
            return
        replies.seen = found.sequence
        if answers(found.payload, pending.op):
            pending.reply.set_result(found.payload)
        else:
            self._stats.late += 1
            log.debug("%s: dropped a reply to another request", replies.file.path)

    def _on_look(self, due: float) -> None:
        """Keep looking until the deadline, and give up then."""
        pending, channel = self._pending, self._channel
        if pending is None:
            return
        expired = pending.deadline is not None and pending.deadline <= due
        if not expired:
            self._regions.look_by(pending.deadline)
        elif channel is not None:
            channel.replies.check()
            if not pending.reply.done():
                pending.reply.set_exception(no_reply(pending.op, "in shared memory", due - pending.at))

    # When the server goes

    def _on_lost(self) -> None:
        self._drop("the regions were replaced")

    def _drop(self, obstacle: str) -> None:
        self._obstacle = obstacle
        self._fail(lambda op: lost(op, f"the server at {self._over_zmq.endpoint}"))
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        self._regions.close()

    def _fail(self, error: Callable[[Op], URLabError]) -> None:
        pending = self._pending
        if pending is not None and not pending.reply.done():
            pending.reply.set_exception(error(pending.op))


def _reason(error: Exception) -> str:
    return str(error.args[0]) if isinstance(error, URLabError) else str(error)
