"""Keeps the server answering while MuJoCo does not return.

For `SimulatedServer`. A short step runs on the thread that serves requests. If MuJoCo holds that thread for longer than
the step timeout, the client gets an error, and another thread serves. Meanwhile the engine's lock refuses requests that
need physics; others, such as `hello`, `meta` and `stop_pie`, do not wait for it.
"""

from __future__ import annotations

import logging
import threading
from typing import Final

from urlab_client.server.core import ServerCore
from urlab_client.server.rpc.dispatch import Dispatcher
from urlab_client.server.system.health import Health, ended

logger: logging.Logger = logging.getLogger("urlab_client.server")

INTERVAL_S: Final = 0.25


class Watchdog:
    """A thread that checks the physics of a server a few times a second."""

    def __init__(self, core: ServerCore, dispatcher: Dispatcher, health: Health) -> None:
        """Configure the thread; `start` starts it."""
        self._core = core
        self._dispatcher = dispatcher
        self._stopping = threading.Event()
        self._thread = health.thread("urlab-watchdog", self._run)

    @property
    def alive(self) -> bool:
        """Whether the thread is running."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Ask the thread to end."""
        self._stopping.set()

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end after `stop`; return False if it takes longer."""
        return self._thread.ident is None or ended(self._thread, timeout)

    def _run(self) -> None:
        told: object = None
        while not self._stopping.wait(INTERVAL_S):
            running = self._core.play.current
            overdue = None if running is None else running.engine.overdue
            if overdue is None:
                continue
            if overdue.began_at != told:
                told = overdue.began_at
                logger.warning("physics has not returned from MuJoCo for %.1f s; stop_pie ends it", overdue.seconds)
            self._dispatcher.relieve(overdue.thread)
