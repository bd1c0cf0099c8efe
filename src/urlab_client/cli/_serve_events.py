"""Events of a server that a command runs: its start, signals, and the end of standard input."""

from __future__ import annotations

import contextlib
import queue
import signal
import sys
import threading
from enum import Enum
from types import FrameType
from typing import TYPE_CHECKING, TypeAlias

from urlab_client._windows import read_aside

if TYPE_CHECKING:
    from urlab_client.server.simulated import SimulatedServer

__all__ = ["Event", "Events", "Starter", "next_event", "stop_on_signals", "watch_input"]

# Ctrl-C does not interrupt a lock wait on Windows, so the wait is sliced there.
_WAIT_S = 0.1 if sys.platform == "win32" else None


class Event(Enum):
    """What the main thread waits for."""

    STARTED = "started"
    STOP = "stop"
    FAILED = "failed"


Events: TypeAlias = "queue.SimpleQueue[Event]"  # unlike a threading.Event, it may be used in signal handlers


class Starter(threading.Thread):
    """Starts the server off the main thread, which can thus handle a signal while a model compiles.

    Attributes:
        error: What went wrong, or None.
    """

    def __init__(self, server: SimulatedServer, events: Events) -> None:
        super().__init__(name="urlab-start", daemon=True)
        self.error: Exception | None = None
        self._server = server
        self._events = events

    def run(self) -> None:
        """Start the server, and queue `Event.STARTED`."""
        try:
            self._server.start()
        except Exception as error:  # noqa: BLE001 - raised again by the main thread
            self.error = error
        self._events.put(Event.STARTED)


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
    signal.signal(signal.SIGINT, signal.SIG_IGN if ignore_interrupt else stop)
    signal.signal(signal.SIGTERM, stop)
    hangup = getattr(signal, "SIGHUP", None)
    if hangup is not None and signal.getsignal(hangup) != signal.SIG_IGN:  # nohup ignores it
        signal.signal(hangup, stop)


def watch_input(events: Events) -> None:
    """Wait for the end of standard input and queue `Event.STOP`; runs in its own thread."""
    # Not through sys.stdin, whose lock this thread would still hold when the interpreter ends.
    with contextlib.suppress(OSError):  # there is no standard input
        while read_aside(0, 4096):
            pass
    events.put(Event.STOP)
