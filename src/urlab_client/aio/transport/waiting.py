"""How the event loop learns that a reply or a publication has arrived.

A loop with `add_reader` watches sockets itself. A thread, one per loop, watches what the loop cannot: sockets of other
loops, above all Windows' default Proactor loop, and regions of shared memory whose server has no doorbell. And because
waking up an idle processor takes as long as a fast reply, the loop may poll for a reply before it sleeps (`BusyPoll`).
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Collection
from typing import Any, ClassVar, Final, TypeAlias, cast
from weakref import WeakSet, ref

import zmq
from msgspec import Struct

from urlab_client._platform.processors import crowded
from urlab_client.aio.background import Tell, background_thread
from urlab_client.events import ClientEvent

Socket: TypeAlias = zmq.Socket[bytes]

# Interval of the thread's checks whether the loop was closed while clients were open.
_CHECK_S: Final = 1.0
_JOIN_S: Final = 1.0
_AGAIN_S: Final = 1.0

_FAST_S: Final = 1e-3  # how long the pauses between two looks at a region stay the shortest
_SLOWEST_S: Final = 5e-3  # the longest of them
_POLL_STEP_S: Final = 1e-3  # the resolution of ZeroMQ's poll
_LINGER_S: Final = 2e-3  # how long after news the thread does without its wake-up, which takes as long as a reply

_DRAIN_BYTES: Final = 4096
_POLLIN: Final = int(zmq.POLLIN)


class Watch:
    """The watch on one socket or one region of shared memory; calls `on_news` on the event loop.

    A socket that is readable is news, though there may be nothing to read. Where the loop cannot watch it, and for a
    region, the thread does, which reports news once and then waits for `expect`. The thread looks at a region
    with pauses that grow with the time that it has waited, to five milliseconds; the loop's timers are too coarse.

    Args:
        fd: The socket; None for a region.
        has_news: Whether a region has news. Called on the thread until `close`; must not block or raise.
        block: Sleeps until a region's server signals, for at most the given seconds; None without signals.
        fastest_s: Pause between two looks at a region in the first millisecond, seconds.
        expected: Whether the thread is to watch a socket at first, and again after news. Waking the thread delays a
            reply that the loop polls for itself, so other news are expected only from `expect` on, and those of a
            region always.
        tell: Publishes the event that a watching thread died. Another one follows after a pause.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        on_news: Callable[[], object],
        *,
        fd: int | None = None,
        has_news: Callable[[], bool] | None = None,
        block: Callable[[float], object] | None = None,
        fastest_s: float = 0.0,
        expected: Callable[[], bool] = lambda: True,
        tell: Tell | None = None,
    ) -> None:
        self.fd = fd
        self.has_news = has_news
        self.block = block
        self.tell = tell
        self._loop = loop
        self._on_news = on_news
        self.fastest_s = fastest_s
        self._expected: Callable[[], bool] = (lambda: False) if fd is None else expected
        self._since = 0.0
        self._armed = False
        self._closed = False
        self._watcher: _Watcher | None = None  # None if the loop watches
        if fd is not None:
            with contextlib.suppress(NotImplementedError):
                loop.add_reader(fd, on_news)
                return
        self._watcher = _Watcher.of(loop, self)
        if self._expected():
            self.expect()

    def expect(self) -> None:
        """Watch until the next news, if that was left to this call."""
        if self._watcher is None:
            return
        self._since = time.monotonic()
        if not self._armed and not self._closed:
            self._armed = True
            self._watcher.arm(self)

    def ignore(self) -> None:
        """Stop watching until the next `expect`, so that the thread does not keep what a forgotten client leaves."""
        if self._armed and self._watcher is not None:
            self._armed = False
            self._watcher.disarm(self)

    def close(self) -> None:
        """Stop watching. Call before the socket or region is closed. Idempotent."""
        if self._closed:
            return
        self._closed = True
        if self._watcher is not None:
            self._watcher.release(self)
        elif self.fd is not None and not self._loop.is_closed():  # an abandoned client may outlive its loop
            self._loop.remove_reader(self.fd)

    def pause(self, now: float) -> float:
        """Return the seconds to sleep before the next look at the region."""
        return min(self.fastest_s * max((now - self._since) / _FAST_S, 1.0), _SLOWEST_S)

    def notify(self) -> None:
        """Handle news. Called on the event loop."""
        self._armed = False
        try:
            if not self._closed:
                self._on_news()
        finally:
            if self._expected():
                self.expect()


class _Watcher:
    """The watching thread of one event loop.

    It uses ZeroMQ's poll, which is not limited to the 512 sockets of `select.select` on Windows.
    """

    _of_loops: ClassVar[dict[asyncio.AbstractEventLoop, _Watcher]] = {}

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        # Weak: an unclosed client is collected with its loop before this thread sees that the loop is closed.
        self._armed = WeakSet[Watch]()
        self._users = WeakSet[Watch]()
        self._ended = False
        self._woken = False
        self._lingers_until = 0.0
        self._linger_pause = 0.0
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._start()

    @classmethod
    def of(cls, loop: asyncio.AbstractEventLoop, user: Watch) -> _Watcher:
        """Return the watcher of `loop` for a new user."""
        watcher = cls._of_loops.get(loop)
        if watcher is None:
            watcher = cls._of_loops[loop] = cls(loop)
        watcher._users.add(user)
        return watcher

    def arm(self, watch: Watch) -> None:
        """Watch until there is news."""
        with self._lock:
            self._armed.add(watch)
            self._wake()

    def disarm(self, watch: Watch) -> None:
        """Stop watching for now."""
        with self._lock:
            self._armed.discard(watch)

    def release(self, watch: Watch) -> None:
        """Stop watching: `has_news` is not running and is not called again. The last user ends the thread."""
        with self._lock:
            self._armed.discard(watch)
            self._users.discard(watch)
            last = not self._users
            self._ended = self._ended or last
            if last or watch.fd is not None:  # its socket is about to be closed
                self._wake()
        if last:
            self._forget()
            self._thread.join(_JOIN_S)
            if not self._thread.is_alive():
                self._finish()  # as it has done itself, unless it died

    def _wake(self) -> None:
        if not self._woken:
            self._woken = True
            self._wake_writer.send(b"\0")

    def _forget(self) -> None:
        if self._of_loops.get(self._loop) is self:
            del self._of_loops[self._loop]

    def _start(self) -> None:
        self._thread = background_thread("urlab-waiter", self._run, tell=self._on_death)
        self._thread.start()

    def _on_death(self, event: ClientEvent) -> None:
        for watch in tuple(self._users):
            if watch.tell is not None:
                watch.tell(event)
        self._loop.call_later(_AGAIN_S, self._begin_again)

    def _begin_again(self) -> None:
        if not self._ended:
            self._woken = False  # the thread may have died between reading and noting it
            self._start()

    def _run(self) -> None:
        while self._look():
            pass
        self._finish()

    def _finish(self) -> None:
        with self._lock:
            self._woken = True  # suppresses any further wake-up
            self._armed.clear()
        self._forget()
        self._wake_reader.close()
        self._wake_writer.close()

    def _look(self) -> bool:
        """Wait for news and notify the loop. Return whether to continue."""
        try:
            with self._lock:
                if self._ended:
                    return False
                pause, block = self._look_at_regions()
                fds = [self._wake_reader.fileno(), *(watch.fd for watch in self._armed if watch.fd is not None)]
            if block is not None or pause < _POLL_STEP_S:
                (block or time.sleep)(pause)
                pause = 0.0
                if len(fds) == 1:  # the wake-up can wait: the regions are looked at again in any case
                    return not self._loop.is_closed()
            ready = _poll(fds, pause)
            with self._lock:
                if self._wake_reader.fileno() in ready:
                    self._wake_reader.recv(_DRAIN_BYTES)
                    self._woken = False
                self._notify([watch for watch in self._armed if watch.fd in ready])
        except zmq.ZMQError:  # on Windows, if a socket was closed meanwhile
            self._drop_closed()
        except _LoopClosed:
            return False
        return not self._loop.is_closed()

    def _look_at_regions(self) -> tuple[float, Callable[[float], object] | None]:
        """Report news in regions. Return how long to sleep, and how."""
        now = time.monotonic()
        watched = [watch for watch in self._armed if watch.has_news is not None]
        news = [watch for watch in watched if watch.has_news is not None and watch.has_news()]
        silent = [watch for watch in watched if watch not in news]
        if news:
            self._lingers_until = now + _LINGER_S
            self._linger_pause = min(watch.fastest_s for watch in news)
        idle = self._linger_pause if now < self._lingers_until else _CHECK_S
        pause = min((watch.pause(now) for watch in silent), default=idle)
        block = next((watch.block for watch in silent if watch.block is not None), None)
        watched.clear()
        silent.clear()
        self._notify(news)
        return pause, block

    def _notify(self, watches: list[Watch]) -> None:
        self._armed.difference_update(watches)
        references = [ref(watch) for watch in watches]
        watches.clear()  # notifying lets other threads run: by then, nothing here may hold a client that was forgotten
        for reference in references:
            try:
                self._loop.call_soon_threadsafe(_notify_if_there, reference)
            except RuntimeError as error:
                raise _LoopClosed from error

    def _drop_closed(self) -> None:
        with self._lock:
            for watch in tuple(self._armed):
                try:
                    if watch.fd is not None:
                        _poll([watch.fd], 0.0)
                except zmq.ZMQError:
                    self._armed.discard(watch)


def _notify_if_there(reference: ref[Watch]) -> None:
    watch = reference()
    if watch is not None:
        watch.notify()


class _LoopClosed(Exception):
    """The loop was closed while clients were open."""


def _poll(fds: Collection[int], seconds: float) -> list[int]:
    """Return the descriptors that are readable or broken."""
    poll: Callable[[list[tuple[int, int]], int], list[tuple[int, int]]] = cast("Any", zmq.zmq_poll)
    return [fd for fd, _ in poll([(fd, _POLLIN) for fd in fds], int(seconds * 1000))]


_MISSES: Final = 4
_FIRST: Final = 8  # requests of an op before the first trial
_TRIAL: Final = 4  # requests of a trial: the first ones may find the processor in the state that the other way left
_UNTIL_POLLED: Final = 80  # requests that sleep between two trials of polling, which cost little
_UNTIL_SLEPT: Final = 1024  # requests that poll between two trials of sleeping: too few to show in a 99th percentile
_MARGIN: Final = 0.85  # polling occupies a processor, so it must be faster by this factor
_WEIGHT: Final = 0.2  # of a new time in the average
# One poller keeps the loop awake for all requests; several would only delay each other.
_polling = False


class _ReplyTimes(Struct):
    """Reply times of one op in seconds, in the way of waiting that is in use and in the other one."""

    polls: bool = True  # the way in use
    usual: float = 0.0
    other: float = 0.0  # as the last trial found it; 0 before the first
    tried: list[float] = []
    until_trial: int = _FIRST
    missed: int = 0

    @property
    def awake(self) -> bool:
        """Whether to poll for the next reply."""
        return self.missed < _MISSES and self.polls is (self.until_trial > 0)

    def note(self, seconds: float, *, awake: bool) -> None:
        """Record the time of a reply, and decide at the end of a trial."""
        if awake is self.polls:
            before = self.usual
            # An unusually long time reflects the machine's other load rather than the way of waiting.
            self.usual = before + _WEIGHT * (min(seconds, 2 * before) - before) if before else seconds
            self.until_trial -= 1
            if self.polls and self.other and not self._better(self.usual, self.other):
                self.until_trial = 0
        elif self.until_trial <= 0:  # otherwise there was no choice
            self.tried.append(seconds)
            if len(self.tried) == _TRIAL:
                self.other = sorted(self.tried)[_TRIAL // 2 - 1]
                self.tried.clear()
                if self._better(self.other, self.usual) if awake else not self._better(self.usual, self.other):
                    self.polls = awake
                    self.usual, self.other = self.other, self.usual
                self.until_trial = _UNTIL_SLEPT if self.polls else _UNTIL_POLLED

    @staticmethod
    def _better(awake: float, asleep: float) -> bool:
        return awake < _MARGIN * asleep


class BusyPoll:
    """Polls for replies while that has proved faster than sleeping; learns that for each op.

    An idle processor takes tens of microseconds to wake up, as long as a fast server takes for a whole reply. One that
    other work keeps busy responds immediately, and polling would only waste its time.

    Args:
        shortest: Minimum polling time, seconds.
        longest: Maximum polling time, seconds. Ops whose replies repeatedly take longer are not polled.
    """

    def __init__(self, shortest: float, longest: float) -> None:
        self._shortest = shortest
        self._longest = longest
        self._ops = defaultdict[str, _ReplyTimes](_ReplyTimes)

    def pays(self, op: str) -> bool:
        """Return whether to poll for the reply to this op."""
        return self._ops[op].awake and not _polling and not crowded()

    async def look(self, op: str, reply: asyncio.Future[Any], look: Callable[[], object]) -> None:
        """Call `look` until it completes `reply` or the time limit is reached. Other tasks run between two calls."""
        global _polling  # noqa: PLW0603  # shared by all loops of the process, which share one interpreter
        now = time.perf_counter  # the loop's clock may tick 64 times a second
        give_up = now() + self._limit(op)
        _polling = True
        try:
            while True:  # at least once: otherwise nothing would wake a task that is late for its first poll
                await asyncio.sleep(0)
                if reply.done():  # another task may have completed it and closed the socket
                    break
                look()
                if reply.done() or now() >= give_up:
                    break
        finally:
            _polling = False

    def _limit(self, op: str) -> float:
        """Return the seconds to poll; a trial is no longer than sleeping takes."""
        times = self._ops[op]
        return min(max(2 * times.usual, self._shortest) if times.polls else times.usual, self._longest)

    def note(self, op: str, seconds: float, *, awake: bool) -> None:
        """Record the time of a reply, with a polling or a sleeping loop."""
        times = self._ops[op]
        if seconds > self._longest:
            times.missed += 1
            return
        times.missed = 0
        times.note(seconds, awake=awake)
