"""Signals kept waiting: Python runs a handler between any two instructions of the main thread, and it may raise."""

from __future__ import annotations

import importlib
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable
from itertools import repeat, starmap
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
# Runs an iterator of calls into C to its end in one call into C: no signal handler runs in between.
_consume: Callable[[Iterable[object]], None] = deque[object](maxlen=0).extend


class DeferredSignals:
    """Keeps signal handlers out of a block of code of the main thread, except where the code lets them in.

    In other threads this does nothing: handlers never run there. What has arrived by the end of the block and was not
    let in takes effect there, each signal by itself, as if all of them came then.

    Attributes:
        on_arrival: Called when a signal arrives, amid any code of the block. Must not raise.
    """

    __slots__ = ("_arrived", "_handlers", "_holding", "_numbers", "_undelivered", "on_arrival")

    def __init__(self) -> None:
        self.on_arrival: Callable[[], object] | None = None
        self._holding = False
        self._numbers: list[int] = []
        self._handlers: list[Any] = []
        self._arrived: list[tuple[int, FrameType | None]] = []
        self._undelivered: map[None] | None = None

    def __enter__(self) -> Self:
        if threading.get_ident() == threading.main_thread().ident:
            self._numbers = numbers = [number for number in _SIGNALS if callable(_get_handler(number))]
            try:
                # A list keeps what came before an exception: exactly the handlers that were replaced.
                self._handlers.extend(map(_set_handler, numbers, repeat(self._on_signal)))
                self._holding = True
            except BaseException:  # a handler that was not set aside yet has raised
                self._holding = True
                try:
                    self._put_back()
                except BaseException:  # and another one
                    self._put_back()
                    raise
                raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._holding:
            self._put_back()

    @property
    def arrived(self) -> bool:
        """Whether a signal waits to be let in."""
        return bool(self._arrived)

    def let_in(self) -> BaseException | None:
        """Run the handlers of what has arrived; return what the first one that raises has raised.

        The others wait on. Meanwhile handlers stay aside: there is no moment at which one could strike this very code.
        """
        try:
            while self._arrived:
                number, frame = self._arrived.pop(0)
                handler = _get_handler(number)
                if handler == self._on_signal:  # and nobody has installed another one meanwhile
                    handler = self._aside(number)
                if callable(handler):
                    handler(number, frame)
        except BaseException as error:  # noqa: BLE001  # what it is, is the caller's business
            trace = error.__traceback__
            return error.with_traceback(None if trace is None else trace.tb_next)  # without this frame
        return None

    def _put_back(self) -> None:
        """Put the handlers back, and let those of signals that have arrived run, one by one as Python does."""
        mine = self._on_signal
        # Not those that somebody has replaced meanwhile.
        aside = [
            (number, _last_in_place(number, handler))
            for number, handler in zip(self._numbers, self._handlers)  # noqa: B905
            if _get_handler(number) == mine
        ]
        try:
            _consume(starmap(_set_handler, aside))
        except BaseException:  # a handler that was back already has raised
            _consume(starmap(_set_handler, aside))
            raise
        finally:
            self._holding = False
            if self._undelivered is not None:
                _consume(self._undelivered)

    def _aside(self, number: int) -> Any:
        """Return the handler that is aside, here or in a block around this one."""
        handler = dict(zip(self._numbers, self._handlers, strict=False)).get(number)
        outer = getattr(handler, "__self__", None)
        return outer._aside(number) if isinstance(outer, DeferredSignals) else handler  # noqa: SLF001  # our own

    def left_in_place(self, number: int) -> Any:
        """Return the handler that this stands for though its block is over; None if the block is not."""
        return None if self._holding else dict(zip(self._numbers, self._handlers, strict=False)).get(number)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self._holding:
            # At the edges of the block, and after it if several signals have struck there: as if it were not aside.
            self._aside(number)(number, frame)
            return
        if all(number != other for other, _ in self._arrived):
            self._arrived.append((number, frame))
        if self._undelivered is None:
            self._undelivered = map(_raise_soon, map(itemgetter(0), self._arrived))
        if self.on_arrival is not None:
            self.on_arrival()


def _last_in_place(number: int, handler: Any) -> Any:
    """Return what a handler stands for that several signals at once have left in place after its block."""
    owner = getattr(handler, "__self__", None)
    while isinstance(owner, DeferredSignals) and (before := owner.left_in_place(number)) is not None:
        handler, owner = before, getattr(before, "__self__", None)
    return handler
