"""The lock around model and data, which tells a busy physics thread from one that MuJoCo does not give back."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Final

from urlab_client.server.refusal import Refusal

__all__ = ["DataLock", "MujocoCall", "Overdue", "busy"]


LEAST_PATIENCE_S: Final = 1.0
"""A call of MuJoCo does not count as overdue before; a slice of a long request may take a while on a busy machine."""


@dataclass(frozen=True)
class Overdue:
    """A call of MuJoCo that takes longer than a step may.

    Attributes:
        thread: The thread that is in it.
        began_at: When it began, seconds of `time.perf_counter`.
        seconds: How long ago that is.
    """

    thread: threading.Thread
    began_at: float
    seconds: float


class MujocoCall:
    """Which thread is inside MuJoCo, and since when. Entered under the engine's lock, looked at by everybody."""

    __slots__ = ("_patience_s", "_under_way")

    def __init__(self, patience_s: float) -> None:
        self._patience_s = max(patience_s, LEAST_PATIENCE_S)
        self._under_way: tuple[threading.Thread, float] | None = None

    def __enter__(self) -> None:
        self._under_way = threading.current_thread(), time.perf_counter()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._under_way = None

    @property
    def overdue(self) -> Overdue | None:
        """The call, when it takes longer than a step may; None when none is under way, or it is not late."""
        under_way = self._under_way
        if under_way is None:
            return None
        thread, began_at = under_way
        seconds = time.perf_counter() - began_at
        return Overdue(thread, began_at, seconds) if seconds > self._patience_s else None


class DataLock:
    """A re-entrant lock around model and data whose `with` gives up after a time.

    Attributes:
        inner: The lock itself, for the physics thread and for waits with deadlines of their own.
    """

    __slots__ = ("_call", "_timeout", "inner")

    def __init__(self, timeout: float, call: MujocoCall) -> None:
        """Make a lock that nobody holds.

        Args:
            timeout: Seconds after which entering raises `Refusal` with `not_ready`: a step request may legally keep
                physics busy for hours, and no other request may hang for that.
            call: Tells when there is nothing to wait for.
        """
        self.inner: threading.RLock = threading.RLock()
        self._timeout = timeout
        self._call = call

    def acquire(self) -> bool:
        """Take the lock, if it becomes free in time.

        Raises:
            Refusal: `not_ready`, at once, while MuJoCo does not come back.
        """
        if self.inner.acquire(blocking=False):
            return True
        overdue = self._call.overdue
        if overdue is not None:
            raise Refusal(
                "not_ready",
                f"MuJoCo has not returned for {overdue.seconds:.0f} s: play continues when it does, and "
                "stop_pie ends it",
            )
        return self.inner.acquire(timeout=self._timeout)

    @contextmanager
    def look(self) -> Generator[None]:
        """Hold the lock, or go without it while MuJoCo does not come back: for what no step changes.

        Raises:
            Refusal: `not_ready` when physics is busy, but comes back.
        """
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
    """Return the refusal of whoever does not get the lock in time."""
    return Refusal("not_ready", "physics is busy with a step request that is still running; try again later")
