"""The lock around model and data, which distinguishes a busy physics thread from one stuck inside MuJoCo."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Final

from urlab_client.server.refusal import Refusal

MIN_TIMEOUT_S: Final = 1.0
"""Shortest duration of an overdue MuJoCo call; a slice of a long request may take a while on a busy machine."""


@dataclass(frozen=True)
class Overdue:
    """A MuJoCo call that has exceeded the step timeout.

    Attributes:
        thread: The calling thread.
        began_at: Start of the call, seconds of `time.perf_counter`.
        seconds: Time since then.
    """

    thread: threading.Thread
    began_at: float
    seconds: float


class MujocoCall:
    """The MuJoCo call in progress, if any. Entered under the engine's lock, read without it."""

    __slots__ = ("_timeout_s", "_under_way")

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = max(timeout_s, MIN_TIMEOUT_S)
        self._under_way: tuple[threading.Thread, float] | None = None

    def __enter__(self) -> None:
        self._under_way = threading.current_thread(), time.perf_counter()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._under_way = None

    @property
    def overdue(self) -> Overdue | None:
        """The call in progress if it has exceeded the step timeout, otherwise None."""
        under_way = self._under_way
        if under_way is None:
            return None
        thread, began_at = under_way
        seconds = time.perf_counter() - began_at
        return Overdue(thread, began_at, seconds) if seconds > self._timeout_s else None


class DataLock:
    """A re-entrant lock around model and data whose `with` gives up after a time.

    Attributes:
        inner: The lock itself, for the physics thread and for waits with deadlines of their own.
    """

    __slots__ = ("_call", "_timeout", "inner")

    def __init__(self, timeout: float, call: MujocoCall) -> None:
        """Create an unlocked lock.

        Args:
            timeout: Seconds after which entering raises `Refusal` with `not_ready`. A step request may legally keep
                physics busy for hours, and no other request may hang because of that.
            call: The MuJoCo call in progress; waiting is pointless while it is overdue.
        """
        self.inner: threading.RLock = threading.RLock()
        self._timeout = timeout
        self._call = call

    def acquire(self) -> bool:
        """Acquire the lock, or return False if it does not become free in time. Refuses while a call is overdue."""
        if self.inner.acquire(blocking=False):
            return True
        overdue = self._call.overdue
        if overdue is not None:
            raise Refusal(
                "not_ready",
                f"MuJoCo has not returned for {overdue.seconds:.0f} s: play continues when it returns, and "
                "stop_pie ends it",
            )
        return self.inner.acquire(timeout=self._timeout)

    @contextmanager
    def look(self) -> Generator[None]:
        """Hold the lock, or proceed without it while a MuJoCo call is overdue. For data that no step changes."""
        with ExitStack() as held:
            try:
                held.enter_context(self)
            except Refusal:
                if self._call.overdue is None:
                    raise
            yield

    def __enter__(self) -> None:
        if not self.acquire():
            raise busy()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.inner.release()


def busy() -> Refusal:
    """Return the refusal for a caller that does not get the lock in time."""
    return Refusal("not_ready", "physics is busy with a step request that is still running; try again later")
