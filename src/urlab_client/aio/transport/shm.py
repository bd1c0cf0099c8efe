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
from pathlib import Path

from urlab_client.aio.transport.base import LateReply, RequestTransport, TransportStats
from urlab_client.aio.transport.busy_poll import BusyPoll
from urlab_client.aio.transport.delivery import deliver
from urlab_client.aio.transport.mapped_region import RegionInUse
from urlab_client.aio.transport.poller import ReplyPoll
from urlab_client.aio.transport.region_channel import SYNC_PREFIX, RegionChannel, envelope_of, opening_of
from urlab_client.aio.transport.server_regions import SharedMemoryRegions
from urlab_client.aio.transport.shm_way import way_of
from urlab_client.errors import (
    ClientClosed,
    ConnectionLost,
    OutcomeUnknown,
    ProtocolError,
    URLabConnectionError,
    URLabError,
    URLabTimeoutError,
)
from urlab_client.events import ClientEvent, ServerLost
from urlab_client.protocol import doorbell
from urlab_client.protocol.base import Effect, Op
from urlab_client.protocol.messages.session import HelloOk
from urlab_client.protocol.shm import REPLY_FILE, REQUEST_FILE, RegionNotReady

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
# Poll at this interval in any case, so that a lost ring delays a reply no longer.
_GLANCE_S = 0.05

# Time to poll on the loop before the thread takes over.
_SPIN_S = 400e-6
_LONGEST_SPIN_S = 2e-3


class _Pending:
    """The request in progress."""

    __slots__ = ("at", "deadline", "future", "op", "watch")

    def __init__(self, op: Op, future: asyncio.Future[bytes], at: float, deadline: float | None) -> None:
        self.op = op
        self.future = future
        self.at = at
        self.deadline = deadline
        self.watch: ReplyPoll | None = None


class ShmTransport:
    """Transport over shared memory for requests that fit, and over another transport for the rest.

    Args:
        inner: The other transport, which also detects whether the server is alive.
        memory: Location of the server's regions.
    """

    def __init__(self, inner: RequestTransport, memory: SharedMemoryRegions) -> None:
        self.on_event: Callable[[ClientEvent], None] | None = None
        self.stats: TransportStats = inner.stats
        self._inner = inner
        self._memory = memory
        inner.on_event = self._on_event
        memory.rung[doorbell.REPLY].append(self._on_ring)
        self._channel: RegionChannel | None = None
        self._obstacle = "no handshake yet"
        self._retry_at = 0.0
        self._used_at = 0.0
        self._pending: _Pending | None = None
        # One of each for all requests: most replies arrive long before, and creating and cancelling a timer takes a
        # tenth of the time of a step.
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0
        self._glances: asyncio.TimerHandle | None = None
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
        """Whether a server is connected."""
        return self._inner.connected

    @property
    def owed(self) -> bool:
        """See `RequestTransport.owed`."""
        return self._inner.owed or (self._channel is not None and self._channel.abandoned_at is not None)

    async def follow(self, hello: HelloOk) -> None:
        """Open the regions that a handshake names.

        If another client uses them, all requests go over ZMQ until it has gone.

        Raises:
            URLabConnectionError: The regions do not exist or are not valid.
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
                    hint="Check that the server is on this machine and uses this directory, or use transport='zmq'.",
                ) from error
        channel = self._channel
        if channel is None:
            return
        self._memory.connect_bell()
        give_up = loop.time() + _SETTLE_S
        while self._settling(channel) and loop.time() < give_up:  # noqa: ASYNC110 - a region has no event
            await asyncio.sleep(_SETTLE_LOOK_S)

    async def request(
        self, frame: bytes, op: Op, *, deadline: float | None, connect_by: float | None, late: LateReply | None = None
    ) -> bytes:
        """See `RequestTransport.request`. `late` is invoked only for requests over ZMQ, such as handshakes."""
        if self._channel is not None and self._channel.abandoned_at is not None:
            await self._let_it_end(op, deadline)
        way = way_of(op)
        pictures = way.pictures and b"include_cameras" in frame
        detour = way.detour or ("pictures" if pictures else self._refused.get(op.name, ""))
        if not detour and self._inner.owed:
            detour = "behind an abandoned request"
        channel = None
        if not detour:
            loop = asyncio.get_running_loop()
            now = loop.time()
            channel = self._usable_channel(now)
            if channel is None:
                detour = self._obstacle
            elif len(frame) > channel.limit:
                detour = "request too large"
            elif way.state and not 0 < self._largest_state * _GROWTH <= channel.limit:
                detour = "reply may be too large" if self._largest_state else "size of the reply not known yet"
            else:
                pending = _Pending(op, loop.create_future(), now, deadline)
                answer = await self._over_shm(channel, frame, pending, loop)
                detour = self._refusal(answer, op)
                if not detour:
                    if way.state and len(answer) > self._largest_state:
                        self._largest_state = len(answer)
                    return answer
        self.stats.over_zmq[detour] = self.stats.over_zmq.get(detour, 0) + 1
        answer = await self._inner.request(frame, op, deadline=deadline, connect_by=connect_by, late=late)
        if way.state and not pictures and _succeeded(answer, op):  # a refusal does not show the size of the state
            self._largest_state = max(self._largest_state, len(answer))
        return answer

    async def aclose(self) -> None:
        """See `RequestTransport.aclose`."""
        self._closed = True
        closed = ClientClosed(f"The client of {self.endpoint} was closed.", hint="Create a new client.")
        self._fail(lambda _: closed)
        self._drop("closed")
        for timer in (self._timer, self._glances):
            if timer is not None:
                timer.cancel()
        self._memory.close()
        await self._inner.aclose()

    # Which way

    def _usable_channel(self, now: float) -> RegionChannel | None:
        """Return the channel if it can be used now."""
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
        if channel.dirty and not self._is_clean(channel):
            if self._channel is not None:
                self._obstacle = "waiting for an old reply"
            return None
        return channel

    def _settling(self, channel: RegionChannel) -> bool:
        """Return whether `channel` is still in use, free of other tasks' requests, and not yet clean."""
        return self._channel is channel and self._pending is None and not self._is_clean(channel)

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
        try:
            waits = channel.dirty and channel.intact() and not channel.synchronised()
            if waits and channel.ask_for_sync(asyncio.get_running_loop().time()):
                self._ring()
        except ProtocolError as error:
            self._drop("no usable regions")
            self._put_off(error)
        return not channel.dirty

    def _open(self) -> RegionChannel:
        """Open the regions. Raises the same errors as `MappedRegion`."""
        paths: list[Path] = []
        for file in (REQUEST_FILE, REPLY_FILE):
            path = self._memory.find(file)
            if path is None:
                paths_tried = ", ".join(map(str, self._memory.candidates(file)))
                raise FileNotFoundError(f"there is no {paths_tried}")
            paths.append(path)
        self._channel = RegionChannel(paths[0], paths[1], self._memory.events(paths[0]))
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
        """Return why a reply requires sending the request over ZMQ; empty if the reply is final."""
        if answer.startswith(opening_of(op), 1):
            return ""
        code = envelope_of(answer).code
        if code == "wrong_transport":  # the server did not execute the request
            self._refused[op.name] = "refused by the server"
        elif code == "reply_too_large":
            self._refused[op.name] = "reply too large"
            if op.effect is not Effect.READ:
                return ""
        return self._refused.get(op.name, "")

    # Over shared memory

    async def _over_shm(
        self, channel: RegionChannel, frame: bytes, pending: _Pending, loop: asyncio.AbstractEventLoop
    ) -> bytes:
        op, deadline = pending.op, pending.deadline
        self._pending = pending
        # If the wait ends without the reply, that reply is still outstanding.
        channel.dirty = True
        try:
            channel.publish(frame)
            sent = time.perf_counter()
            self.stats.sent += 1
            self.stats.over_shm += 1
            self._ring()
            if deadline is not None and (self._timer is None or deadline < self._due):
                self._expire_at(loop, deadline)
            awake = self._busy_poll.pays(op.name)
            if awake:
                await self._busy_poll.look(op.name, pending.future, lambda: self._look_at(channel))
            if not pending.future.done():
                if self._memory.bell is None:
                    self._watch()
                if self._glances is None:
                    self._glances = loop.call_later(_GLANCE_S, self._glance, loop)
            answer = await pending.future
        except BaseException:
            channel.abandoned_at = loop.time()
            raise
        finally:
            if pending.watch is not None:
                self._unwatch()
            self._pending = None
            self._used_at = loop.time()
        channel.dirty = False
        self.stats.received += 1
        self._busy_poll.note(op.name, time.perf_counter() - sent, awake=awake)
        return answer

    def _ring(self) -> None:
        bell = self._memory.bell
        if bell is not None:
            bell.ring(doorbell.REQUEST)

    def _look_at(self, channel: RegionChannel) -> None:
        # Between two polls another task may have blocked the loop for as long as a server takes to restart.
        if not channel.replies.intact() or channel.replies.region.sequence != channel.seen:
            self._look()

    def _glance(self, loop: asyncio.AbstractEventLoop) -> None:
        self._glances = None
        pending = self._pending
        if pending is None:
            return
        self._glances = loop.call_later(_GLANCE_S, self._glance, loop)  # first, whatever happens below
        self._look()
        if not pending.future.done() and self._channel is not None and self._channel.replaced():
            self._drop("the regions were replaced")

    def _watch(self) -> None:
        """Let the thread poll for the reply."""
        pending, channel = self._pending, self._channel
        if pending is None or pending.future.done() or pending.watch is not None or channel is None:
            return
        replies, event = channel.replies, channel.reply_event

        def news() -> bool:
            return not replies.intact() or replies.region.sequence != channel.seen

        pending.watch = ReplyPoll(news, self._take, event.wait if event.exists else None)
        self._memory.waiter.add(pending.watch)

    def _unwatch(self) -> None:
        if self._pending is not None and self._pending.watch is not None:
            self._memory.waiter.remove(self._pending.watch)
            self._pending.watch = None

    def _on_ring(self) -> None:
        if self._memory.bell is None:
            self._look()
            self._watch()
        else:
            self._take()

    def _take(self) -> None:
        """Deliver the reply if it has arrived and resume its task immediately. A callback of the loop."""
        pending = self._pending
        answer = self._found()
        if answer is not None and pending is not None:
            deliver(pending.future, answer)

    def _look(self) -> None:
        """Deliver the reply if it has arrived; its task resumes in the loop's next iteration."""
        pending = self._pending
        answer = self._found()
        if answer is not None and pending is not None:
            pending.future.set_result(answer)

    def _found(self) -> bytes | None:
        """Return the reply to the request in progress if it has arrived and the request still waits."""
        pending, channel = self._pending, self._channel
        if pending is None or pending.future.done() or channel is None:
            return None
        if not channel.replies.intact():
            self._drop("the reply region was cut off")
            return None
        try:
            found = channel.replies.region.read_latest(channel.seen)
        except ProtocolError as error:
            pending.future.set_exception(
                ProtocolError(f"{pending.op.name}: {channel.replies.path}: {error.args[0]}", op=pending.op.name)
            )
            self._drop("the reply region is damaged")
            return None
        if found is None:
            sequence = channel.replies.region.sequence
            if sequence == 0:  # reinitialised: it counts from one again
                channel.seen = 0
            if sequence != channel.seen:  # it kept changing while it was read
                asyncio.get_running_loop().call_soon(self._look)
            elif pending.watch is not None:
                pending.watch.resume()
            return None
        channel.seen = found.sequence
        if self._answers(found.payload, pending.op):
            return found.payload
        self.stats.late += 1
        if pending.watch is not None:
            pending.watch.resume()
        log.debug("%s: dropped a reply to another request", channel.replies.path)
        return None

    @staticmethod
    def _answers(reply: bytes, op: Op) -> bool:
        if reply.startswith(opening_of(op), 1):
            return True
        found = envelope_of(reply)
        if not found.op:  # not a reply to any request: decoding it raises, instead of waiting in vain
            return True
        if found.op == "error":
            return not (found.code == "session_expired" and SYNC_PREFIX in found.message)
        return found.op == op.reply_name

    def _expire_at(self, loop: asyncio.AbstractEventLoop, deadline: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._due = deadline
        self._timer = loop.call_at(deadline, self._expire, loop)

    def _expire(self, loop: asyncio.AbstractEventLoop) -> None:
        self._timer = None
        pending = self._pending
        if pending is None or pending.deadline is None:
            return
        if pending.deadline > self._due:  # not the current time: the loop may be early by its resolution
            self._expire_at(loop, pending.deadline)
            return
        self._look()
        if pending.future.done():
            return
        waited_ms = 1000 * (pending.deadline - pending.at)
        executed = "" if pending.op.effect is Effect.READ else " The request was sent and may still be executed."
        pending.future.set_exception(
            URLabTimeoutError(
                f"{pending.op.name}: no reply in shared memory within {waited_ms:.0f} ms.{executed}",
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
            return ConnectionLost(text, op=op.name, hint="The op changes nothing, so it can be sent again.")
        return OutcomeUnknown(text, op=op.name, hint="It may have been executed: call discover() and check the state.")


def _succeeded(answer: bytes, op: Op) -> bool:
    return answer.startswith(opening_of(op), 1) or envelope_of(answer).op == op.reply_name


def _reason(error: Exception) -> str:
    return str(error.args[0]) if isinstance(error, URLabError) else str(error)
