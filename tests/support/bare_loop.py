"""An event loop that watches no sockets for others: on Windows its own, the Proactor loop, elsewhere one like it."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable, Coroutine
from typing import Any, NoReturn, TypeVar

__all__ = ["BareLoop", "run_bare"]

T = TypeVar("T")

if sys.platform == "win32":
    BareLoop = asyncio.ProactorEventLoop
else:

    class BareLoop(asyncio.SelectorEventLoop):
        """Without `add_reader`."""

        def add_reader(self, fd: Any, callback: Callable[..., Any], *args: Any) -> NoReturn:
            """Refuse, as asyncio's base class does."""
            raise NotImplementedError

        def remove_reader(self, fd: Any) -> NoReturn:
            """Refuse, as asyncio's base class does."""
            raise NotImplementedError


def run_bare(main: Coroutine[Any, Any, T]) -> T:
    """`asyncio.run` on such a loop."""
    with asyncio.Runner(loop_factory=BareLoop, debug=True) as runner:
        return runner.run(main)
