"""Streams from shared memory: state and pictures, with sockets as a fallback while a region is missing.

One reader per region serves all handlers. A region keeps only the newest publication, so streams that need all of them
always receive from the sockets.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar, cast

from msgspec import Struct

from urlab_client.aio.transport.shm_regions import RegionReader, ServerRegions
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions, client_closed
from urlab_client.errors import ProtocolError, URLabError
from urlab_client.protocol.shm import Publication, Ring
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.streams")

T = TypeVar("T")

_SILENT = 20  # looks without news, about a second
_FASTEST_POLL_S = 250e-6


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

    def __init__(self, reader: RegionReader, sequence: int, size: int) -> None:
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


class _StreamReader(RegionReader):
    """A region of published messages and its handlers."""

    def __init__(self, regions: Regions, location: ServerRegions, place: Place) -> None:
        self.place: Place = place
        self.handlers: dict[MessageHandler, None] = {}
        super().__init__(
            location,
            place.file,
            place.ring,
            on_news=lambda: regions.deliver(self, tuple(self.handlers)),
            on_lost=lambda: regions.lose(self),
            fastest_s=_FASTEST_POLL_S,
        )

    def message(self) -> BytesLike | None:
        """Return the current publication, or None if there is none. Raises `ProtocolError`."""
        if self.ring == Ring.CAMERA:
            self.seen: int = self.region.sequence
            # The handlers use its length and pass it back to their source, which handles this type.
            picture = SharedPicture(self, self.seen, self.region.max_payload)
            return cast("BytesLike", picture) if self.seen else None
        found = self.region.read_latest()
        if found is None:
            return None
        self.seen = found.sequence
        return found.payload


class Regions:
    """Everything that one client receives from shared memory. Except for `view`, use from one event loop."""

    def __init__(self, location: ServerRegions, subscriptions: Subscriptions) -> None:
        self._location = location
        self._subscriptions = subscriptions
        self._wanted: dict[MessageHandler, _Wanted] = {}
        self._readers: dict[str, _StreamReader] = {}
        self._silent: dict[str, int] = {}  # sequence at which a region fell silent, by file
        self._away = False
        self._closed = False
        location.on_look.append(self._supervise)

    def attach(
        self, handler: MessageHandler, subscription: Callable[[], Subscription], place: Callable[[], Place]
    ) -> None:
        """Deliver publications to `handler`, from the region if it exists, otherwise from the socket.

        `place` raises `ProtocolError` if there can be no region.
        """
        if self._closed:
            raise client_closed()
        wanted = _Wanted(subscription, place)
        if not self._feed(handler, wanted):
            self._subscriptions.attach(handler, subscription)
        self._wanted[handler] = wanted
        self._location.look_by()

    def detach(self, handler: MessageHandler) -> None:
        """Stop receiving for `handler`. Does nothing if it does not receive."""
        if self._wanted.pop(handler, None) is None:
            return
        self._subscriptions.detach(handler)
        for reader in tuple(self._readers.values()):
            reader.handlers.pop(handler, None)
            if not reader.handlers:
                self._close(reader)

    def path(self, handler: MessageHandler) -> Path | None:
        """Return the file that `handler` receives from, or None if it does not receive from a region."""
        return next((reader.file.path for reader in self._readers.values() if handler in reader.handlers), None)

    def refresh(self) -> None:
        """Reattach after a handshake: play may have started and the regions may have changed."""
        self._away = False
        self._silent.clear()
        for reader in tuple(self._readers.values()):
            if not reader.file.intact() or reader.moved():
                self.lose(reader)
        self._return_to_regions()

    def release(self) -> None:
        """Release every region until `refresh`, because play ends or the server and its files are gone."""
        self._away = True
        for reader in tuple(self._readers.values()):
            self.lose(reader)

    def view(self, place: Place) -> tuple[Publication[memoryview], Callable[[], bool]] | None:
        """Return a live view of the newest publication and a validity check, or None without a region."""
        reader = self._readers.get(place.file)
        return None if reader is None else reader.view()

    def close(self) -> None:
        """End every stream with `ClientClosed`. Idempotent."""
        self._closed = True
        self._wanted.clear()
        for reader in tuple(self._readers.values()):
            handlers = tuple(reader.handlers)
            self._close(reader)
            for handler in handlers:
                handler.on_end(client_closed)

    # Called by the readers

    def deliver(self, reader: _StreamReader, handlers: Iterable[MessageHandler]) -> None:
        """Deliver the current publication."""
        try:
            payload = reader.message()
        except ProtocolError as error:
            reader.seen = reader.region.sequence
            for handler in handlers:
                handler.on_malformed(str(error.args[0]))
            return
        if payload is None:
            return
        for handler in handlers:
            if handler in reader.handlers:
                handler.take(reader.place.topic, payload)
                handler.drain()

    def lose(self, reader: _StreamReader) -> None:
        """Continue without a region."""
        handlers = tuple(reader.handlers)
        self._close(reader)
        for handler in handlers:
            wanted = self._wanted.get(handler)
            if wanted is not None:
                with contextlib.suppress(URLabError, ValueError):  # treat an invalid address like a closed port
                    self._subscriptions.attach(handler, wanted.subscription)

    # Which handler receives from which region

    def _feed(self, handler: MessageHandler, wanted: _Wanted) -> bool:
        """Deliver from a region, if it exists and has news."""
        reader = self._reader(wanted)
        if reader is None:
            return False

        def welcome() -> None:
            if reader.closed or reader.has_news():
                reader.look()
            else:
                self.deliver(reader, (handler,))

        reader.handlers[handler] = None
        # Deliver an existing publication, too, but later: a handler that is attaching is not ready for it yet.
        self._location.loop.call_soon(welcome)
        return True

    def _reader(self, wanted: _Wanted) -> _StreamReader | None:
        if self._away:
            return None
        try:
            place = wanted.place()
            reader = self._readers.get(place.file)
            if reader is not None:
                return reader
            reader = _StreamReader(self, self._location, place)
        except (OSError, ProtocolError) as error:
            log.debug("not from shared memory: %s", error)
            return None
        if reader.region.sequence in (0, self._silent.get(place.file)):
            reader.close()
            return None
        self._readers[place.file] = reader
        log.debug("receiving from %s", reader.file.path)
        return reader

    def _close(self, reader: _StreamReader) -> None:
        self._readers.pop(reader.place.file, None)
        reader.handlers.clear()
        reader.close()

    def _supervise(self, _: float) -> None:
        if not self._wanted:
            return
        self._location.look_by()
        for reader in tuple(self._readers.values()):
            # While play runs, snapshots keep coming. One that exceeds its slot arrives only by socket.
            if reader.ring == Ring.STATE and reader.quiet > _SILENT and not reader.has_news():
                self._silent[reader.place.file] = reader.region.sequence
                self.lose(reader)
        self._return_to_regions()

    def _return_to_regions(self) -> None:
        """Move handlers from sockets to their regions if these have news by now."""
        for handler, wanted in tuple(self._wanted.items()):
            if self.path(handler) is None and self._feed(handler, wanted):
                self._subscriptions.detach(handler)
