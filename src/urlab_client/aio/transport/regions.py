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

from urlab_client.aio.transport.mapped_region import MappedRegion
from urlab_client.aio.transport.poller import StreamPoll
from urlab_client.aio.transport.server_regions import SharedMemoryRegions
from urlab_client.aio.transport.subscriber import (
    MessageGone,
    MessageHandler,
    Subscription,
    Subscriptions,
    client_closed,
)
from urlab_client.errors import ProtocolError, URLabError
from urlab_client.protocol import doorbell
from urlab_client.protocol.shm import Publication
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.streams")

T = TypeVar("T")

# Interval of checks whether regions were created, removed or replaced.
_SUPERVISE_S = 0.25
_IDLE_S = 0.5
_SILENT_S = 1.0
_ATTEMPTS = 4

_WANTS = {doorbell.STATE: doorbell.WANT_STATE, doorbell.CAMERA: doorbell.WANT_CAMERAS}


class Place(Struct, frozen=True):
    """Location of a source's publications in shared memory.

    Attributes:
        file: Name of the region's file.
        topic: Topic passed to the handlers.
        ring: Kind of doorbell ring that announces the publications.
    """

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
        self.watch: StreamPoll | None = None
        self.silent = False
        self.seen: int = 0
        self.changed_at: float = 0.0
        # Pictures are read on the thread that accesses them.
        self._lock = threading.Lock()
        self._closed = False

    @property
    def region_sequence(self) -> int:
        return self.mapping.region.sequence

    def news(self) -> bool:
        """Return whether there is something to do. Called on the polling thread."""
        return not self.mapping.intact() or self.mapping.region.sequence != self.seen

    def begun_anew(self) -> bool:
        """Return whether a server reinitialised the region in place, as happens after a crash of its predecessor."""
        return self.region_sequence < self.seen or self.mapping.laid_out_anew()

    def message(self) -> BytesLike | None:
        """Return the current publication, or None if there is none. Raises `ProtocolError`."""
        region = self.mapping.region
        if self.place.ring == doorbell.CAMERA:
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
        with self._lock:
            if self._closed or not self.mapping.intact():
                return None
            found = self.mapping.region.view_latest()
            return None if found is None else (found, lambda: self._holds(found.sequence))

    def _holds(self, sequence: int) -> bool:
        with self._lock:
            return not self._closed and self.mapping.intact() and self.mapping.region.holds(sequence)

    def close(self) -> None:
        with self._lock:
            self._closed = True
            self.mapping.close()


class Regions:
    """Everything that one client receives from shared memory. Except for `view`, use from one event loop.

    Args:
        memory: Location of the regions.
        subscriptions: Sockets used as a fallback.
    """

    def __init__(self, memory: SharedMemoryRegions, subscriptions: Subscriptions) -> None:
        self._memory = memory
        self._subscriptions = subscriptions
        self._wanted: dict[MessageHandler, _Wanted] = {}
        self._readers: dict[str, _RegionReader] = {}
        self._refused: dict[str, str] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._away = False
        self._closed = False
        for ring in _WANTS:
            memory.rung[ring].append(self._look_at_all)

    def attach(
        self, handler: MessageHandler, subscription: Callable[[], Subscription], place: Callable[[], Place]
    ) -> None:
        """Deliver publications to `handler`, from the region if it exists, otherwise from the socket.

        Args:
            handler: Receiver of the publications.
            subscription: Callback that returns the subscription for the socket.
            place: Callback that returns the region. Raises `ProtocolError` if there can be none.
        """
        if self._closed:
            raise client_closed()
        self._loop = asyncio.get_running_loop()
        reader = self._reader(place)
        if reader is None or reader.silent:
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
            if not reader.handlers and not reader.silent:
                self._close_reader(reader)

    def path(self, handler: MessageHandler) -> Path | None:
        """Return the file that `handler` receives from, or None if it does not receive from a region."""
        return next((r.mapping.path for r in self._readers.values() if handler in r.handlers), None)

    def refresh(self) -> None:
        """Reattach after a handshake: play may have started and the regions may have changed."""
        self._away = False
        self._refused.clear()
        for reader in tuple(self._readers.values()):
            if not reader.mapping.intact() or reader.mapping.replaced() or self._moved(reader):
                self._lose(reader)
        self._settle_all()

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
        """Return the reader of a region. Open it if the region exists and has a publication."""
        if self._away:
            return None
        try:
            place = wanted()
            known = self._readers.get(place.file)
            if known is not None:
                return known
            path = self._memory.find(place.file)
            if path is None:
                return None
            reader = _RegionReader(path, place)
        except (OSError, ProtocolError) as error:
            log.debug("not from shared memory: %s", error)
            return None
        if reader.region_sequence == 0:
            reader.close()
            return None
        reader.changed_at = self._now()
        self._readers[place.file] = reader
        self._memory.connect_bell()
        self._memory.want(_WANTS[place.ring])
        self._rouse(reader)
        log.debug("receiving from %s", path)
        return reader

    def _feed(self, reader: _RegionReader, handler: MessageHandler) -> None:
        reader.handlers[handler] = None
        if self._loop is not None:
            # Deliver an existing publication, too, but later: a handler that is attaching is not ready for it yet.
            self._loop.call_soon(self._welcome, reader, handler)

    def _welcome(self, reader: _RegionReader, handler: MessageHandler) -> None:
        if self._readers.get(reader.place.file) is reader and reader.news():
            self._look_at(reader)
        else:
            self._deliver(reader, (handler,))

    def _rouse(self, reader: _RegionReader) -> None:
        """Ensure that changes in a reader's region are detected."""
        if self._memory.bell is None and reader.watch is None:
            reader.watch = StreamPoll(reader.news, lambda: self._look_at(reader))
            self._memory.waiter.add(reader.watch)
        elif self._memory.bell is not None and reader.watch is not None:
            self._memory.waiter.remove(reader.watch)
            reader.watch = None

    def _look_at_all(self) -> None:
        for reader in tuple(self._readers.values()):
            self._rouse(reader)
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
            self._settle_all()
            return
        if reader.region_sequence != reader.seen:
            reader.changed_at = self._now()
            if reader.silent:
                self._resume(reader)
            self._deliver(reader, tuple(reader.handlers))
        if reader.watch is not None:
            reader.watch.resume()

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
            self._subscribe(handler)

    def _close_reader(self, reader: _RegionReader) -> None:
        self._readers.pop(reader.place.file, None)
        if reader.watch is not None:
            self._memory.waiter.remove(reader.watch)
            reader.watch = None
        reader.handlers.clear()
        reader.close()

    def _subscribe(self, handler: MessageHandler) -> None:
        wanted = self._wanted.get(handler)
        if wanted is not None:
            with contextlib.suppress(URLabError, ValueError):  # treat an invalid address like a closed port
                self._subscriptions.attach(handler, wanted.subscription)

    def _resume(self, reader: _RegionReader) -> None:
        """Move handlers back from their sockets to a region that publishes again."""
        reader.silent = False
        for handler, wanted in self._wanted.items():
            if _file_of(wanted.place) == reader.place.file:
                self._subscriptions.detach(handler)
                reader.handlers[handler] = None

    # Supervision

    def _supervise(self) -> None:
        self._timer = None
        if self._wanted and self._loop is not None:  # first, whatever happens below
            self._timer = self._loop.call_later(_SUPERVISE_S, self._supervise)
        now = self._now()
        for reader in tuple(self._readers.values()):
            self._rouse(reader)
            self._look_at(reader)
            idle = now - reader.changed_at
            if idle > _IDLE_S and self._readers.get(reader.place.file) is reader:
                if reader.mapping.replaced() or self._moved(reader):
                    self._lose(reader)
                elif idle > _SILENT_S and reader.place.ring == doorbell.STATE and not reader.silent:
                    # While play runs, snapshots keep coming. One that exceeds its slot arrives only by socket.
                    reader.silent = True
                    handlers = tuple(reader.handlers)
                    reader.handlers.clear()
                    for handler in handlers:
                        self._subscribe(handler)
        self._settle_all()
        for reader in tuple(self._readers.values()):
            if not self._wanted:
                self._close_reader(reader)

    def _settle_all(self) -> None:
        """Move handlers from sockets to their regions if these exist by now."""
        for handler, wanted in tuple(self._wanted.items()):
            if self.path(handler) is None:
                reader = self._reader(wanted.place)
                if reader is not None and not reader.silent:
                    self._subscriptions.detach(handler)
                    self._feed(reader, handler)

    def _moved(self, reader: _RegionReader) -> bool:
        try:
            return self._memory.find(reader.place.file) != reader.mapping.path
        except (OSError, ProtocolError):  # the directory's name comes from the server
            return True

    def _now(self) -> float:
        return 0.0 if self._loop is None else self._loop.time()


def _file_of(place: Callable[[], Place]) -> str | None:
    try:
        return place().file
    except ProtocolError:  # the cameras' names come from the server
        return None
