"""Streams from shared memory: state and pictures, with sockets as a fallback while a region is missing.

One reader per region serves all handlers. A region keeps only the newest publication, so streams that need all of them
always receive from the sockets.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar, cast

from msgspec import Struct

from urlab_client.aio.transport.shm_regions import MappedRegion, ServerRegions
from urlab_client.aio.transport.subscriber import (
    MessageGone,
    MessageHandler,
    Subscription,
    Subscriptions,
    client_closed,
)
from urlab_client.aio.transport.waiting import Watch
from urlab_client.errors import ProtocolError, URLabError
from urlab_client.protocol.shm import Publication, Ring
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.streams")

T = TypeVar("T")

# Interval of checks whether regions were created, removed or replaced.
_SUPERVISE_S = 0.25
_IDLE_S = 0.5
_SILENT_S = 1.0
_ATTEMPTS = 4
_FASTEST_POLL_S = 250e-6

_WANTS = {Ring.STATE: Ring.WANT_STATE, Ring.CAMERA: Ring.WANT_CAMERAS}


class Place(Struct, frozen=True):
    """Location of a source's publications in shared memory, and the topic that its handlers get."""

    file: str
    topic: bytes
    ring: bytes


class _Wanted(Struct, frozen=True):
    """What a handler receives; see `Regions.attach`."""

    subscription: Callable[[], Subscription]
    place: Callable[[], Place]


class SharedPicture:
    """A publication that stays in its region until first access.

    It takes the place of a payload: it has the same length, and its source reads it.
    """

    def __init__(self, reader: _RegionReader, sequence: int, size: int) -> None:
        self.reader = reader
        self.sequence = sequence
        self._size = size

    def __len__(self) -> int:
        return self._size

    def read(self, take: Callable[[memoryview], T]) -> Publication[T]:
        """Convert this picture, or a newer one that replaced it. Call from any thread.

        Raises:
            MessageGone: The region of the picture is gone.
            ProtocolError: No picture could be read completely.
        """
        return self.reader.read(take)


class _RegionReader:
    """One mapped region and its handlers."""

    def __init__(self, path: Path, place: Place) -> None:
        self.mapping: MappedRegion = MappedRegion(path)
        self.place = place
        self.handlers: dict[MessageHandler, None] = {}
        self.watch: Watch | None = None
        self.seen: int = 0
        self.changed_at: float = 0.0
        # Pictures are read on the thread that accesses them.
        self._lock = threading.Lock()
        self._closed = False

    @property
    def region_sequence(self) -> int:
        return self.mapping.region.sequence

    def has_news(self) -> bool:
        """Return whether there is something to do. Called on the watching thread, too."""
        return not self.mapping.intact() or self.region_sequence != self.seen

    def begun_anew(self) -> bool:
        """Return whether a server reinitialised the region in place, as happens after a crash of its predecessor."""
        return self.region_sequence < self.seen or self.mapping.laid_out_anew()

    def message(self) -> BytesLike | None:
        """Return the current publication, or None if there is none. Raises `ProtocolError`."""
        region = self.mapping.region
        if self.place.ring == Ring.CAMERA:
            self.seen = region.sequence
            # The handlers use its length and pass it back to their source, which handles this type.
            return cast("BytesLike", SharedPicture(self, self.seen, region.max_payload)) if self.seen else None
        found = region.read_latest()
        if found is None:
            return None
        self.seen = found.sequence
        return found.payload

    def read(self, take: Callable[[memoryview], T]) -> Publication[T]:
        with self._lock:
            if not self._closed and self.mapping.intact():
                for _ in range(_ATTEMPTS):
                    found = self.mapping.region.read_latest(take=take)
                    if found is not None:
                        return found
                raise ProtocolError(f"{self.mapping.path}: pictures arrive faster than they can be read.")
        raise MessageGone(f"{self.mapping.path}: the picture is gone.")

    def view(self) -> tuple[Publication[memoryview], Callable[[], bool]] | None:
        """Return a live view of the current publication and a check whether it is still valid."""

        def holds(sequence: int) -> bool:
            with self._lock:
                return not self._closed and self.mapping.intact() and self.mapping.region.holds(sequence)

        with self._lock:
            if self._closed or not self.mapping.intact():
                return None
            found = self.mapping.region.read_latest(take=lambda view: view)
            return None if found is None else (found, lambda: holds(found.sequence))

    def close(self) -> None:
        if self.watch is not None:
            self.watch.close()
            self.watch = None  # it refers to this reader, whose mapping must not wait for the garbage collector
        with self._lock:
            self._closed = True
            self.mapping.close()


class Regions:
    """Everything that one client receives from shared memory. Except for `view`, use from one event loop."""

    def __init__(self, location: ServerRegions, subscriptions: Subscriptions) -> None:
        self._location = location
        self._subscriptions = subscriptions
        self._wanted: dict[MessageHandler, _Wanted] = {}
        self._readers: dict[str, _RegionReader] = {}
        self._silent: dict[str, int] = {}  # sequence at which a region fell silent, by file
        self._timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._away = False
        self._closed = False
        for ring in _WANTS:
            location.on_ring[ring].append(self._look_at_all)

    def attach(
        self, handler: MessageHandler, subscription: Callable[[], Subscription], place: Callable[[], Place]
    ) -> None:
        """Deliver publications to `handler`, from the region if it exists, otherwise from the socket.

        `place` raises `ProtocolError` if there can be no region.
        """
        if self._closed:
            raise client_closed()
        self._loop = asyncio.get_running_loop()
        reader = self._reader(place)
        if reader is None:
            self._subscriptions.attach(handler, subscription)
        else:
            self._feed(reader, handler)
        self._wanted[handler] = _Wanted(subscription, place)
        if self._timer is None:
            self._timer = self._loop.call_later(_SUPERVISE_S, self._supervise)

    def detach(self, handler: MessageHandler) -> None:
        """Stop receiving for `handler`. Does nothing if it does not receive."""
        if self._wanted.pop(handler, None) is None:
            return
        self._subscriptions.detach(handler)
        for reader in tuple(self._readers.values()):
            reader.handlers.pop(handler, None)
            if not reader.handlers:
                self._close_reader(reader)

    def path(self, handler: MessageHandler) -> Path | None:
        """Return the file that `handler` receives from, or None if it does not receive from a region."""
        return next((r.mapping.path for r in self._readers.values() if handler in r.handlers), None)

    def refresh(self) -> None:
        """Reattach after a handshake: play may have started and the regions may have changed."""
        self._away = False
        self._silent.clear()
        for reader in tuple(self._readers.values()):
            if not reader.mapping.intact() or self._moved(reader):
                self._lose(reader)
        self._return_to_regions()

    def release(self) -> None:
        """Release every region until `refresh`, because play ends or the server and its files are gone."""
        self._away = True
        for reader in tuple(self._readers.values()):
            self._lose(reader)

    def view(self, place: Place) -> tuple[Publication[memoryview], Callable[[], bool]] | None:
        """Return a live view of the newest publication and a validity check, or None without a region."""
        reader = self._readers.get(place.file)
        return None if reader is None else reader.view()

    def close(self) -> None:
        """End every stream with `ClientClosed`. Idempotent."""
        if self._closed:
            return
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        ended = [handler for reader in self._readers.values() for handler in reader.handlers]
        for reader in tuple(self._readers.values()):
            self._close_reader(reader)
        self._wanted.clear()
        for handler in ended:
            handler.on_end(client_closed)

    # Readers

    def _reader(self, wanted: Callable[[], Place]) -> _RegionReader | None:
        """Return the reader of a region. Open it if the region exists and has news."""
        if self._away:
            return None
        try:
            place = wanted()
            known = self._readers.get(place.file)
            if known is not None:
                return known
            path = self._location.find(place.file)
            if path is None:
                return None
            reader = _RegionReader(path, place)
        except (OSError, ProtocolError) as error:
            log.debug("not from shared memory: %s", error)
            return None
        if reader.region_sequence in (0, self._silent.get(place.file)):
            reader.close()
            return None
        reader.changed_at = self._now()
        self._readers[place.file] = reader
        self._location.connect_doorbell()
        self._location.want(_WANTS[place.ring])
        self._watch(reader)
        log.debug("receiving from %s", path)
        return reader

    def _feed(self, reader: _RegionReader, handler: MessageHandler) -> None:
        def welcome() -> None:
            if self._readers.get(reader.place.file) is reader and reader.has_news():
                self._look_at(reader)
            else:
                self._deliver(reader, (handler,))

        reader.handlers[handler] = None
        if self._loop is not None:
            # Deliver an existing publication, too, but later: a handler that is attaching is not ready for it yet.
            self._loop.call_soon(welcome)

    def _watch(self, reader: _RegionReader) -> None:
        """Have a thread look at a region while there is no doorbell."""
        there = self._readers.get(reader.place.file) is reader
        if there and self._location.doorbell is None and self._loop is not None:
            if reader.watch is None:
                tell = self._location.tell
                reader.watch = Watch(
                    self._loop,
                    lambda: self._look_at(reader),
                    has_news=reader.has_news,
                    fastest_s=_FASTEST_POLL_S,
                    tell=tell,
                )
            reader.watch.expect()

    def _look_at_all(self) -> None:
        for reader in tuple(self._readers.values()):
            self._look_at(reader)

    def _look_at(self, reader: _RegionReader) -> None:
        """Deliver a new publication of a region."""
        if self._readers.get(reader.place.file) is not reader:
            return
        if not reader.mapping.intact():
            self._lose(reader)
            return
        if reader.begun_anew():
            self._lose(reader)
            self._return_to_regions()
            return
        if reader.region_sequence != reader.seen:
            reader.changed_at = self._now()
            self._deliver(reader, tuple(reader.handlers))
        self._watch(reader)

    def _deliver(self, reader: _RegionReader, handlers: Iterable[MessageHandler]) -> None:
        if self._readers.get(reader.place.file) is not reader or not reader.mapping.intact():
            return
        try:
            payload = reader.message()
        except ProtocolError as error:
            reader.seen = reader.region_sequence
            for handler in handlers:
                handler.on_malformed(str(error.args[0]))
            return
        if payload is None:
            return
        for handler in handlers:
            if handler in reader.handlers:
                handler.take(reader.place.topic, payload)
                handler.drain()

    def _lose(self, reader: _RegionReader) -> None:
        """Continue without a region."""
        handlers = tuple(reader.handlers)
        self._close_reader(reader)
        for handler in handlers:
            wanted = self._wanted.get(handler)
            if wanted is not None:
                with contextlib.suppress(URLabError, ValueError):  # treat an invalid address like a closed port
                    self._subscriptions.attach(handler, wanted.subscription)

    def _close_reader(self, reader: _RegionReader) -> None:
        self._readers.pop(reader.place.file, None)
        reader.handlers.clear()
        reader.close()

    # Supervision

    def _supervise(self) -> None:
        self._timer = None
        if self._wanted and self._loop is not None:  # first, whatever happens below
            self._timer = self._loop.call_later(_SUPERVISE_S, self._supervise)
        now = self._now()
        for reader in tuple(self._readers.values()):
            self._look_at(reader)
            idle = now - reader.changed_at
            if idle > _IDLE_S and self._readers.get(reader.place.file) is reader:
                # While play runs, snapshots keep coming. One that exceeds its slot arrives only by socket.
                silent = idle > _SILENT_S and reader.place.ring == Ring.STATE
                if silent:
                    self._silent[reader.place.file] = reader.region_sequence
                if silent or self._moved(reader):
                    self._lose(reader)
        self._return_to_regions()

    def _return_to_regions(self) -> None:
        """Move handlers from sockets to their regions if these have news by now."""
        for handler, wanted in tuple(self._wanted.items()):
            if self.path(handler) is None:
                reader = self._reader(wanted.place)
                if reader is not None:
                    self._subscriptions.detach(handler)
                    self._feed(reader, handler)

    def _moved(self, reader: _RegionReader) -> bool:
        try:
            return reader.mapping.replaced() or self._location.find(reader.place.file) != reader.mapping.path
        except (OSError, ProtocolError):  # the directory's name comes from the server
            return True

    def _now(self) -> float:
        return 0.0 if self._loop is None else self._loop.time()
