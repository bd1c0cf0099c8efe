"""The ZeroMQ context that all request sockets of a process share.

A context has two threads and a few descriptors. With one context for each of many clients in an event loop, these
threads wake up for every message and would use more processor time than the clients.
"""

from __future__ import annotations

import os
import threading
from typing import Final

import zmq

from urlab_client._platform.signals import uninterrupted

Context = zmq.Context[zmq.Socket[bytes]]

_MOST_SOCKETS: Final = 16_384
"""Maximum number of sockets. ZeroMQ's default of 1023 suffices for about 340 clients. Windows allows one less."""


class _SharedContext:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._context: Context | None = None
        self._users = 0

    def borrow(self) -> Context:
        with self._lock:
            if self._context is None:
                self._context = zmq.Context()
                self._context.max_sockets = min(_MOST_SOCKETS, self._context.get(zmq.SOCKET_LIMIT))
            self._users += 1
            return self._context

    def give_back(self, context: Context) -> None:
        with self._lock:
            if context is not self._context:  # this process is a fork of the borrower
                return
            self._users -= 1
            if self._users:
                return
            self._context = None
        with uninterrupted():
            context.term()


_shared = _SharedContext()


def _start_over() -> None:
    global _shared  # noqa: PLW0603  # a fork's copy of the context has no threads behind it
    _shared = _SharedContext()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_over)


def borrow() -> Context:
    """Return the shared context, created if needed. The caller must call `give_back`."""
    return _shared.borrow()


def give_back(context: Context) -> None:
    """Return a borrowed context after closing its sockets. The last call terminates the context."""
    _shared.give_back(context)
