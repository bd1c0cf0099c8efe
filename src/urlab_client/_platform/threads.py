"""Threads in the background, none of which ends unnoticed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVarTuple

Ts = TypeVarTuple("Ts")


def daemon(
    name: str, run: Callable[[*Ts], object], *arguments: *Ts, failed: Callable[[BaseException], object]
) -> threading.Thread:
    """Return a daemon thread, not started.

    Args:
        name: Its name.
        run: What it does.
        arguments: Arguments of `run`.
        failed: Called on the thread with the exception that ends it: reports it, and fails what waits for the thread.
    """

    def watched() -> None:
        try:
            run(*arguments)
        except BaseException as error:  # noqa: BLE001 - whatever it is, nobody else hears of it
            failed(error)

    return threading.Thread(target=watched, name=name, daemon=True)
