"""A TCP proxy that carries out a script: per direction, what becomes of the bytes that come next."""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass

from relay import Relay


@dataclass(frozen=True)
class Delay:
    """Let the bytes through after so many seconds, and those behind them."""

    seconds: float


@dataclass(frozen=True)
class Truncate:
    """Let so many of the bytes through and close both ends: a frame ends in its middle."""

    keep: int


@dataclass(frozen=True)
class Garbage:
    """Put these bytes in front."""

    junk: bytes


@dataclass(frozen=True)
class Throttle:
    """Let the bytes through in pieces of this size, with a pause after each."""

    piece: int
    pause: float = 0.001


Fault = Delay | Truncate | Garbage | Throttle


class FaultProxy(Relay):
    """Forwards to `127.0.0.1:target`; half-open and pulled cables, cuts and refusals are the relay's.

    Attributes:
        up: Faults of the next chunks of bytes to the server, one each.
        down: Faults of the next chunks to the client.
    """

    def __init__(self, target: int) -> None:
        super().__init__(target)
        self.up: deque[Fault] = deque()
        self.down: deque[Fault] = deque()

    def hold_requests(self) -> None:
        """From now on nothing reaches the server; the client gets everything."""
        self._to_server.clear()

    def heal(self) -> None:
        """Forget what is left of the script and let everything through."""
        self.up.clear()
        self.down.clear()
        self.refusing = False
        self.thaw()

    async def pass_on(self, data: bytes, writer: asyncio.StreamWriter, *, up: bool) -> bool:
        """See the base class."""
        script = self.up if up else self.down
        match script.popleft() if script else None:
            case Delay(seconds):
                await asyncio.sleep(seconds)
            case Truncate(keep):
                writer.write(data[:keep])
                await writer.drain()
                self.cut()
                return False
            case Garbage(junk):
                data = junk + data
            case Throttle(piece, pause):
                for start in range(0, len(data), piece):
                    writer.write(data[start : start + piece])
                    await writer.drain()
                    await asyncio.sleep(pause)
                return True
            case None:
                pass
        return await super().pass_on(data, writer, up=up)
