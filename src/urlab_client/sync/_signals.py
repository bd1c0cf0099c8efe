"""Deferred signals: Python runs a handler between any two instructions of the main thread, and it may raise."""

from __future__ import annotations

import importlib
import threading
from collections import deque
from collections.abc import Callable, Iterable
from itertools import repeat, starmap
from operator import itemgetter
from types import FrameType, TracebackType
from typing import Any, ClassVar, Self

from urlab_client._platform.signals import SIGNALS, raw

_get_handler: Callable[[int], Any] = raw.getsignal
_set_handler: Callable[[int, Any], Any] = raw.signal
_raise_soon: Callable[[int], None] = importlib.import_module("_thread").interrupt_main
# Where the handlers of event loops are defined. They only note the signal, so there is nothing to defer; and to put one
# back would make its signal interrupt system calls, which its loop has forbidden (`siginterrupt`).
_OF_LOOPS = frozenset({"asyncio.unix_events", "uvloop.loop"})
# Exhausts an iterator of C calls in one C call, so that no signal handler runs in between.
_consume: Callable[[Iterable[object]], None] = deque[object](maxlen=0).extend


def _is_deferred(handler: Any) -> bool:
    return callable(handler) and getattr(handler, "__module__", "") not in _OF_LOOPS


class DeferredSignals:
    """Defers signal handlers during a block of code of the main thread, except where the code runs them.

    Does nothing in other threads, where handlers never run. Signals that have arrived by the end of the block and were
    not handled take effect there, one by one, as if all of them arrived then.

    Attributes:
        arrived: Signals that have arrived and not been handled, each with the frame that it interrupted.
        on_arrival: Callback invoked when a signal arrives, between any two instructions of the block. Must not raise.
    """

    __slots__ = ("_handlers", "_holding", "arrived", "on_arrival")

    _known: ClassVar[tuple[list[Any], list[int]]] = [], []  # what was installed at the last call, and which to defer

    def __init__(self) -> None:
        self.on_arrival: Callable[[], object] | None = None
        self._holding = False
        self._handlers: dict[int, Any] = {}  # those that were replaced
        self.arrived: list[tuple[int, FrameType | None]] = []

    def __enter__(self) -> Self:
        if threading.get_ident() == threading.main_thread().ident:
            # All of some sixty signals are looked at in each call: a handler may have been installed since the last
            # one, and nothing tells. For the same reason none stays replaced between two calls.
            installed = [*map(_get_handler, SIGNALS)]
            known, numbers = DeferredSignals._known
            if installed != known:
                numbers = [number for number, handler in zip(SIGNALS, installed, strict=True) if _is_deferred(handler)]
                DeferredSignals._known = installed, numbers
            try:
                # One C call replaces all of them, and after an exception the map contains exactly those that were
                # replaced. In a Python loop, a handler still in place could raise between replacing one and noting it.
                self._handlers.update(zip(numbers, map(_set_handler, numbers, repeat(self._on_signal)), strict=False))
                self._holding = True
            except BaseException:  # raised by a handler that was not replaced yet
                self._holding = True
                self._put_back()
                raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._holding:
            self._put_back()

    def let_in(self) -> BaseException | None:
        """Run the handlers of arrived signals; return the exception of the first one that raises.

        The remaining signals stay deferred. The handlers stay replaced, so that none can interrupt this code.
        """
        try:
            while self.arrived:
                number, frame = self.arrived.pop(0)
                handler = _get_handler(number)
                if handler == self._on_signal:  # unless another one was installed in the meantime
                    handler = self._replaced(number)
                if callable(handler):
                    handler(number, frame)
        except BaseException as error:  # noqa: BLE001  # raised by the caller
            trace = error.__traceback__
            return error.with_traceback(None if trace is None else trace.tb_next)  # without this frame
        return None

    def _put_back(self) -> None:
        """Restore the handlers, and run those of arrived signals, one by one as Python does.

        Should several of them raise while they are restored, some stay replaced. They work all the same: see
        `_on_signal`.
        """
        mine = self._on_signal
        # Others were replaced in the meantime.
        restored = [pair for pair in self._handlers.items() if _get_handler(pair[0]) == mine]
        undelivered = map(_raise_soon, map(itemgetter(0), self.arrived))  # those that are still to come included
        try:
            _consume(starmap(_set_handler, restored))
        except BaseException:  # raised by a handler that was already restored; it ran once, so the second try succeeds
            _consume(starmap(_set_handler, restored))
            raise
        finally:
            self._holding = False
            # The restored handlers are run by Python, as after any signal: what they raise has the caller's line in its
            # traceback, and none runs inside another.
            _consume(undelivered)

    def _replaced(self, number: int) -> Any:
        """Return the handler that was replaced, by this block or an outer one."""
        handler = self._handlers.get(number)
        outer = getattr(handler, "__self__", None)
        return outer._replaced(number) if isinstance(outer, DeferredSignals) else handler  # noqa: SLF001  # our own

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self._holding:
            # At the edges of the block, and after it if several signals have arrived there: run the handler directly.
            self._replaced(number)(number, frame)
            return
        if all(number != other for other, _ in self.arrived):
            self.arrived.append((number, frame))
        if self.on_arrival is not None:
            self.on_arrival()
