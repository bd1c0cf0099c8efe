"""Signals kept waiting: Python runs a handler between any two instructions of the main thread, and it may raise."""

from __future__ import annotations

import importlib
import signal
import threading
from collections.abc import Callable
from operator import itemgetter
from types import FrameType, TracebackType
from typing import Any, Self

__all__ = ["DeferredSignals"]

_SIGNALS = sorted(int(number) for number in signal.valid_signals())
# What `signal` wraps: its own functions make enumerations of everything, which takes ten times as long.
_signal: Any = importlib.import_module("_signal")
_get_handler: Callable[[int], Any] = _signal.getsignal
_set_handler: Callable[[int, Any], Any] = _signal.signal
_raise_soon: Callable[[int], None] = importlib.import_module("_thread").interrupt_main


class DeferredSignals:
    """Keeps signal handlers out of a block of code of the main thread, except where the code lets them in.

    In other threads this does nothing: handlers never run there. What has arrived by the end of the block and was not
    let in takes effect there, each signal by itself, as if all of them came then.

    Attributes:
        on_arrival: Called when a signal arrives, amid any code of the block. Must not raise.
    """

    __slots__ = ("_arrived", "_holding", "_set_aside", "_undelivered", "on_arrival")

    def __init__(self) -> None:
        self.on_arrival: Callable[[], object] | None = None
        self._holding = False
        self._set_aside: list[tuple[int, Any]] = []
        self._arrived: list[tuple[int, FrameType | None]] = []
        self._undelivered: map[None] | None = None

    def __enter__(self) -> Self:
        try:
            self._hold()
        except BaseException:
            self._restore()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._restore()
        finally:
            if self._undelivered is not None:
                # One call into C: all of them are due before the first handler can run, and raise.
                any(self._undelivered)

    @property
    def arrived(self) -> bool:
        """Whether a signal waits to be let in."""
        return bool(self._arrived)

    def let_in(self) -> BaseException | None:
        """Run the handlers of what has arrived; return what the first one that raises has raised.

        Those after it wait on. All handlers are set aside again.
        """
        try:
            self._restore()
            while self._arrived:
                number, frame = self._arrived.pop(0)
                handler = _get_handler(number)
                if callable(handler):
                    handler(number, frame)
        except BaseException as error:  # noqa: BLE001  # what it is, is the caller's business
            trace = error.__traceback__
            return error.with_traceback(None if trace is None else trace.tb_next)  # without this frame
        finally:
            self._hold()
        return None

    def _hold(self) -> None:
        if threading.get_ident() != threading.main_thread().ident:
            return
        try:
            for number in _SIGNALS:
                handler = _get_handler(number)
                if callable(handler) and handler != self._on_signal:
                    self._set_aside.append((number, handler))
                    _set_handler(number, self._on_signal)
            self._holding = True
        except BaseException:  # a handler that was not set aside yet has raised
            self._hold()
            raise

    def _restore(self) -> None:
        """Put the handlers back. One that runs, and raises, as soon as it is back does not keep the others out."""
        self._holding = False
        try:
            while self._set_aside:
                number, handler = self._set_aside[-1]
                if _get_handler(number) == self._on_signal:  # and not what somebody has installed meanwhile
                    _set_handler(number, handler)
                self._set_aside.pop()
        finally:
            if self._set_aside:
                self._restore()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self._holding:
            # It strikes while handlers are being set aside or put back: it must not be lost, wherever that stands.
            handler = dict(self._set_aside).get(number)
            if handler is not None:
                handler(number, frame)
            return
        if all(number != other for other, _ in self._arrived):
            self._arrived.append((number, frame))
        if self._undelivered is None:
            self._undelivered = map(_raise_soon, map(itemgetter(0), self._arrived))
        if self.on_arrival is not None:
            self.on_arrival()
