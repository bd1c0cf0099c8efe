"""The servers of a test run: one for each set of models and options, started on first use."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import pytest

from urlab_client.server import Faults, SimulatedServer

__all__ = ["ServerPool"]

logger = logging.getLogger("urlab_client.testing")

MAX_OPEN: Final = 8
"""Maximum number of open servers; beyond it the one that has been idle longest is closed."""


@dataclass(frozen=True, eq=False)
class _Entry:
    models: tuple[str, ...]
    options: Mapping[str, Any]
    server: SimulatedServer


class ServerPool:
    """Lends servers to tests. Each test finds its server in the initial state."""

    def __init__(self) -> None:
        self._idle: list[_Entry] = []
        self._lent: list[_Entry] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for entry in (*self._idle, *self._lent):
            entry.server.close()

    def acquire(
        self, models: Sequence[str | os.PathLike[str]], options: Mapping[str, Any], folder: Path
    ) -> SimulatedServer:
        """Return an open server, all of whose threads are running.

        Args:
            models: Models of `SimulatedServer`; files are searched for in `folder` first.
            options: Options of `SimulatedServer`; `play` defaults to True.
            folder: Folder of the test.

        Raises:
            TypeError, ValueError: `SimulatedServer` rejects the models or options.
            OSError: A port or folder cannot be used.
        """
        paths = tuple(_located(os.fspath(model), folder) for model in models)
        entry = next((idle for idle in self._idle if (idle.models, idle.options) == (paths, options)), None)
        if entry is None:
            settings: dict[str, Any] = {"play": True, "faults": Faults(), **options}
            entry = _Entry(paths, dict(options), SimulatedServer(*paths, **settings))
        else:
            self._idle.remove(entry)
        entry.server.start()
        failure = entry.server.failure
        if failure is not None:
            entry.server.close()
            entry.server.start()
        self._lent.append(entry)
        if failure is not None:
            _report(f"the simulated server failed after the previous test and was restarted: {failure}")
        return entry.server

    def release(self, server: SimulatedServer) -> None:
        """Take a server back and restore its initial state; close it if that fails.

        Warns if the server has failed; it is restarted for the next test.
        """
        entry = next(lent for lent in self._lent if lent.server is server)
        self._lent.remove(entry)
        failure = server.failure
        try:
            server.restore()
        except Exception:
            logger.exception("%r could not be restored; the next test gets another server", server)
            server.close()
        self._idle.append(entry)
        if len(self._idle) > MAX_OPEN:
            self._idle.pop(0).server.close()
        if failure is not None:
            _report(f"the simulated server failed during this test and is restarted for the next one: {failure}")


def _report(problem: str) -> None:
    warnings.warn(pytest.PytestWarning(problem), stacklevel=3)


def _located(model: str, folder: Path) -> str:
    beside = folder / model
    return str(beside) if beside.is_file() else model
