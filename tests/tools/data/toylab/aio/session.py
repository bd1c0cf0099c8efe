"""Not mirrored: what the classes of the package stand on."""

from __future__ import annotations

import asyncio
import enum
import threading
from typing import Final


class Default(enum.Enum):
    DEFAULT = "default"


DEFAULT: Final = Default.DEFAULT

Timeout = float | Default | None


class Session:
    def __init__(self) -> None:
        self.log: list[object] = []
        self.threads: set[str] = set()

    async def call(self, *what: object) -> None:
        await asyncio.sleep(0)
        self.threads.add(threading.current_thread().name)
        self.log.append(what)


class Namespace:
    def __init__(self, session: Session) -> None:
        self._session = session
