"""Events of a server that a command runs: its start, signals, and the end of standard input."""

from __future__ import annotations

import contextlib
import logging
import queue
import signal
import sys
import threading
from enum import Enum
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING, TypeAlias

from urlab_client._platform.threads import daemon
from urlab_client._platform.windows import read_aside
from urlab_client.cli._common import in_background

if TYPE_CHECKING:
    from urlab_client.server.simulated import SimulatedServer

logger: logging.Logger = logging.getLogger("urlab_client.cli")

# Ctrl-C does not interrupt a lock wait on Windows, so the wait is sliced there.
_WAIT_S = 0.1 if sys.platform == "win32" else None


class Event(Enum):
    """What the main thread waits for."""

    STARTED = "started"
    STOP = "stop"
    FAILED = "failed"


Events: TypeAlias = "queue.SimpleQueue[Event]"  # unlike a threading.Event, it may be used in signal handlers


class Starter:
    """Starts the server off the main thread, which can thus handle a signal while a model compiles.

    Attributes:
        error: What went wrong, or None.
        thread: The thread, which queues `Event.STARTED` at its end.
    """

    def __init__(self, server: SimulatedServer, events: Events) -> None:
        self.error: BaseException | None = None
        fail = partial(self._fail, events)
        self.thread: threading.Thread = daemon("urlab-start", self._start, server, events, failed=fail)
        self.thread.start()

    def _start(self, server: SimulatedServer, events: Events) -> None:
        server.start()
        events.put(Event.STARTED)

    def _fail(self, events: Events, error: BaseException) -> None:
        self.error = error  # raised again by the main thread
        events.put(Event.STARTED)


def next_event(events: Events) -> Event:
    """Wait for the next event; a signal interrupts the wait."""
    while True:
        with contextlib.suppress(queue.Empty):
            return events.get(timeout=_WAIT_S)


def stop_on_signals(events: Events, *, ignore_interrupt: bool) -> None:
    """Queue `Event.STOP` on SIGTERM, Ctrl-C and a closed terminal.

    Args:
        events: The queue.
        ignore_interrupt: Whether to ignore Ctrl-C, because it is meant for another process.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        events.put(Event.STOP)

    # Ctrl-C reaches all processes of a terminal, but is meant for the one that started this server.
    signal.signal(signal.SIGINT, signal.SIG_IGN if ignore_interrupt or in_background() else stop)
    signal.signal(signal.SIGTERM, stop)
    hangup = getattr(signal, "SIGHUP", None)
    if hangup is not None and signal.getsignal(hangup) != signal.SIG_IGN:  # nohup ignores it
        signal.signal(hangup, stop)


def watch_input(events: Events) -> None:
    """Queue `Event.STOP` at the end of standard input, which a thread waits for."""

    def watch() -> None:
        # Not through sys.stdin, whose lock this thread would still hold when the interpreter ends.
        with contextlib.suppress(OSError):  # there is no standard input
            while read_aside(0, 4096):
                pass
        events.put(Event.STOP)

    def fail(error: BaseException) -> None:
        logger.error("standard input can no longer be read", exc_info=error)
        events.put(Event.STOP)

    daemon("urlab-stdin", watch, failed=fail).start()
