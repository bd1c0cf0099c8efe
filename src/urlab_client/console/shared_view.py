"""What all viewers see: the log, the newest state, the description of the world.

Nothing is queued. A viewer is notified of changes and takes what is newest when it is ready. Each state and each
description is encoded once, however many watch.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections import deque
from collections.abc import Generator, Iterable, Mapping
from itertools import islice
from typing import TYPE_CHECKING

from msgspec import Raw

from urlab_client.console.description import WorldDescription, describe
from urlab_client.console.messages import LogEntry, World, encode, state_message
from urlab_client.protocol.messages.streams import StateSnapshot

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient

log: logging.Logger = logging.getLogger("urlab_client.web")

_KEPT = 300
_KEPT_STATES = 600  # ten seconds, which are more than the page's curves span at first
_BURST_S = 5.0


class SharedView:
    """See the module.

    Attributes:
        entries: The log, newest last.
        world: The description of the world; its `version` grows with each change.
        world_json: The message `world`.
        snapshot: The state that is shown, or None.
        state_seq: Number of that state.
        state_json: The message `state`, or None.
        n_changes: How often viewers were notified.
    """

    def __init__(self, client: URLabClient) -> None:
        self.entries: deque[LogEntry] = deque(maxlen=_KEPT)
        self.world: WorldDescription = WorldDescription()
        self.world_json: str = encode(World(self.world)).decode()
        self.snapshot: StateSnapshot | None = None
        self.state_seq: int = 0
        self.state_json: str | None = None
        self._recent: deque[tuple[float, Raw]] = deque(maxlen=_KEPT_STATES)
        self.n_changes: int = 0
        self._client = client
        self._watchers: set[asyncio.Event] = set()
        self._n = 0
        self._bursts: dict[tuple[str, ...], float] = {}

    @contextlib.contextmanager
    def watch(self) -> Generator[asyncio.Event]:
        """Yield an event that is set on each change, and is set already."""
        changed = asyncio.Event()
        changed.set()
        self._watchers.add(changed)
        try:
            yield changed
        finally:
            self._watchers.discard(changed)

    def notify(self) -> None:
        """Notify all viewers of a change."""
        self.n_changes += 1
        for changed in self._watchers:
            changed.set()

    def note(self, kind: str, who: str, what: str, text: str, ms: float | None = None) -> None:
        """Add a line to the log."""
        text = text.removeprefix(f"{what}: ")  # as errors of the client begin
        if (kind, who) == ("error", "console"):
            log.warning("%s: %s", what, text)
        self._n += 1
        self.entries.append(LogEntry(self._n, time.time(), kind, who, what, text, ms))
        self.notify()

    def note_burst(self, who: str, what: str, robot: str, names: Iterable[str]) -> None:
        """Add a line on what moves parts of a robot: one for all that follow one another."""
        now, burst = time.monotonic(), (who, what, robot, *names)
        self._bursts = {known: at for known, at in self._bursts.items() if now - at < _BURST_S}
        if burst not in self._bursts:
            self.note("call", who, what, encode({robot: burst[3:]}).decode())
        self._bursts[burst] = now

    def entries_after(self, n: int) -> list[LogEntry]:
        """Return the entries after number `n`, of those that are kept."""
        missed = min(self._n - n, len(self.entries))  # they are numbered without gaps
        return [*islice(reversed(self.entries), max(0, missed))][::-1]

    def show(
        self, snapshot: StateSnapshot, targets: Mapping[str, list[float] | None], *, recorded: bool = False
    ) -> None:
        """Show a state, and what viewers have commanded by articulation."""
        self.snapshot = snapshot
        self.state_seq += 1
        encoded = encode(state_message(self.state_seq, snapshot, targets, recorded=recorded))
        self.state_json = encoded.decode()
        if not recorded:
            before = self._recent[-1][0] if self._recent else -math.inf
            if snapshot.time == before:
                self._recent.pop()
            elif snapshot.time < before:  # it was reset
                self._recent.clear()
            self._recent.append((snapshot.time, Raw(encoded)))
        self.notify()

    def states_after(self, time: float) -> list[Raw]:
        """Return the messages of the simulation's states after a time since it began, of those that are kept."""
        return [encoded for at, encoded in self._recent if at > time]

    def describe_world(self) -> None:
        """Describe the world again after a change."""
        self.world = describe(self._client, self.world.version + 1)
        self.world_json = encode(World(self.world)).decode()
        self.notify()
