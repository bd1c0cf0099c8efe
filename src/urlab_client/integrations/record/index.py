"""Where the messages of an MCAP file are: from the index at its end or, in an unfinished file, from its records' heads.

Opening reads no messages, and looking one up reads one block.
"""

from __future__ import annotations

import io
import os
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeAlias

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, MetadataIndex, Schema
from mcap.stream_reader import get_chunk_data_stream
from numpy.typing import NDArray
from zstandard import ZstdError

from urlab_client.integrations._feed.scene_messages import SceneLayout, from_metadata
from urlab_client.integrations.record.writer import RecordingError

__all__ = ["IndexedChannel", "Progress", "RecordedMessage", "RecordingIndex"]

Progress: TypeAlias = Callable[[int], None]

UNKNOWN = "neither an MCAP file nor a recording of the server."
CUT_OFF = "the end of the file is missing"

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")  # with the head of its record
_CHUNK = struct.Struct("<Q")  # its earliest time
_CHUNK_INDEX = struct.Struct("<QQQQI")
_LISTED = struct.Struct("<HQ")
_INDEX = struct.Struct("<HI")
_FOOTER = struct.Struct("<BQQQI")
_NO_CHANNELS: frozenset[int] = frozenset()
_KEPT = 8  # blocks in memory: the one that is played, and those with the newest pictures of some cameras
_TOLD_EVERY = 16
_BROKEN = (McapError, ZstdError, struct.error, ValueError, OverflowError, MemoryError)

Positions: TypeAlias = dict[int, NDArray[np.uint64]]
"""By channel: time, nanoseconds, and offset in the block of each message, shape (n, 2)."""


class IndexedChannel(NamedTuple):
    """One channel: its topic, the name of its messages' schema, its metadata, and the layout in that."""

    id: int
    topic: str
    schema: str
    metadata: Mapping[str, str]
    layout: SceneLayout


class RecordedMessage(NamedTuple):
    """One message; times in nanoseconds, of the recording's clock and of the server's UTC clock."""

    channel: IndexedChannel
    log_time: int
    publish_time: int
    data: bytes


@dataclass(slots=True)
class _Block:
    """Messages that are read together: a chunk, or consecutive messages outside of any. All in bytes of the file."""

    start: int
    size: int
    chunked: bool
    first_ns: int
    index_size: int = 0
    channels: frozenset[int] = _NO_CHANNELS


@dataclass(frozen=True, slots=True)
class _Contents:
    data: bytes
    positions: Positions


@dataclass
class RecordingIndex:
    """What a file holds, and where. May be used by several threads.

    Attributes:
        path: The file.
        complete: Whether it was finished.
        damage: Why what is known of it ends early; empty for a finished file.
        channels: By id.
        metadata: By name.
    """

    path: Path
    complete: bool = False
    damage: str = ""
    channels: dict[int, IndexedChannel] = field(default_factory=dict[int, IndexedChannel])
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    _blocks: list[_Block] = field(default_factory=list[_Block])
    _schemas: dict[int, str] = field(default_factory=dict[int, str])
    _kept: OrderedDict[int, _Contents] = field(default_factory=OrderedDict[int, _Contents])
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def of(cls, path: Path, progress: Progress | None = None) -> RecordingIndex:
        """Read the index of a file.

        Args:
            path: The file.
            progress: Told now and then how far a file without an index has been read, bytes.

        Raises:
            RecordingError: The file is not an MCAP file.
        """
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(f"{path}: {UNKNOWN}")
            index = cls(path, complete=True)
            try:
                found = index._read_summary(file, size)
            except (OSError, *_BROKEN):
                found = False
            if not found:
                index = cls(path)
                index._scan(file, size, progress)
        first = np.array([block.first_ns for block in index._blocks], dtype=np.uint64)
        index._earliest = np.minimum.accumulate(first[::-1])[::-1]  # of a block and all after it
        return index

    def __post_init__(self) -> None:
        self._earliest: NDArray[np.uint64] = np.zeros(0, np.uint64)

    def having(self, *schemas: str) -> list[IndexedChannel]:
        """Return the channels whose messages have one of these schemas, by topic."""
        return sorted((one for one in self.channels.values() if one.schema in schemas), key=lambda one: one.topic)

    def times(self, channels: Collection[int] | None = None) -> dict[int, NDArray[np.int64]]:
        """Return the times of all messages by channel, nanoseconds, without reading the messages."""
        found: dict[int, list[NDArray[np.int64]]] = {}
        with self.path.open("rb") as file:
            for block in self._blocks:
                if channels is None or not block.channels.isdisjoint(channels):
                    positions = self._positions(file, block)
                    for channel, rows in positions.items():
                        if channels is None or channel in channels:
                            found.setdefault(channel, []).append(rows[:, 0].astype(np.int64))
        return {channel: np.concatenate(parts) for channel, parts in found.items()}

    def messages(self, channels: Collection[int], progress: Progress | None = None) -> Iterator[RecordedMessage]:
        """Iterate over the messages of some channels in the file's order. It ends before damage, which `damage` names.

        Args:
            channels: Their ids.
            progress: Told now and then how many bytes have been read.
        """
        wanted = frozenset(channels)
        with self.path.open("rb") as file:
            for block in self._blocks:
                if wanted.isdisjoint(block.channels):
                    continue
                try:
                    contents = self._read(file, block)
                    found = [rows[:, 1] for channel, rows in contents.positions.items() if channel in wanted]
                    for offset in np.sort(np.concatenate(found)).tolist() if found else ():
                        yield self._message(contents, offset)
                except _BROKEN as error:
                    self.damage = _explained(error)
                    return
                if progress is not None:
                    progress(block.start)

    def first(self, channel: int) -> RecordedMessage | None:
        """Return the first message of a channel in the file, None without any.

        Raises:
            RecordingError: The file is damaged there.
        """
        for number, block in enumerate(self._blocks):
            if channel in block.channels and (rows := self._contents(number).positions.get(channel)) is not None:
                return self._checked(number, int(rows[0, 1]))
        return None

    def newest(self, channel: int, at: int | None = None) -> RecordedMessage | None:
        """Return the last message of a channel that is not after a time in nanoseconds, None without any.

        Args:
            channel: Its id.
            at: The time; None for the end of the file.

        Raises:
            RecordingError: The file is damaged there.
        """
        last = len(self._blocks) if at is None else int(np.searchsorted(self._earliest, np.uint64(at), side="right"))
        for number in range(last - 1, -1, -1):
            if channel not in self._blocks[number].channels:
                continue
            rows = self._contents(number).positions.get(channel)
            if rows is None:
                continue
            row = len(rows) if at is None else int(np.searchsorted(rows[:, 0], np.uint64(at), side="right"))
            if row:
                return self._checked(number, int(rows[row - 1, 1]))
        return None

    def wall_span(self) -> tuple[int, int]:
        """Return the server's UTC clock at the first and at the last message of the file, nanoseconds.

        Raises:
            RecordingError: The file is damaged there.
        """
        if not self._blocks:
            return 0, 0
        found: list[int] = []
        for number, end in ((0, np.min), (len(self._blocks) - 1, np.max)):
            offsets = [end(rows[:, 1]) for rows in self._contents(number).positions.values()]
            found.append(self._checked(number, int(end(offsets))).publish_time)
        return found[0], found[1]

    # Blocks

    def _contents(self, number: int) -> _Contents:
        with self._lock:
            kept = self._kept.get(number)
            if kept is not None:
                self._kept.move_to_end(number)
                return kept
        block = self._blocks[number]
        try:
            with self.path.open("rb") as file:
                contents = self._read(file, block)
        except _BROKEN as error:
            raise self._damaged(block, error) from error
        with self._lock:
            self._kept[number] = contents
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return contents

    def _checked(self, number: int, offset: int) -> RecordedMessage:
        try:
            return self._message(self._contents(number), offset)
        except _BROKEN as error:
            raise self._damaged(self._blocks[number], error) from error

    def _damaged(self, block: _Block, error: Exception) -> RecordingError:
        return RecordingError(f"{self.path} is damaged at byte {block.start}: {_explained(error)}.")

    def _message(self, contents: _Contents, offset: int) -> RecordedMessage:
        kind, length, channel, _, log_time, publish_time = _MESSAGE.unpack_from(contents.data, offset)
        start, end = offset + _MESSAGE.size, offset + _RECORD.size + length
        if kind != Opcode.MESSAGE or not start <= end <= len(contents.data) or channel not in self.channels:
            raise ValueError("the index of a chunk does not fit it")
        return RecordedMessage(self.channels[channel], log_time, publish_time, contents.data[start:end])

    def _read(self, file: BinaryIO, block: _Block) -> _Contents:
        data = self._data(file, block)
        return _Contents(data, self._positions(file, block) if block.index_size else _walked(data))

    def _data(self, file: BinaryIO, block: _Block) -> bytes:
        file.seek(block.start)
        raw = file.read(block.size)
        if len(raw) < block.size:
            raise ValueError(CUT_OFF)
        if not block.chunked:
            return raw
        chunk = Chunk.read(_stream(raw[_RECORD.size :]))
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(length)

    def _positions(self, file: BinaryIO, block: _Block) -> Positions:
        if not block.index_size:
            return _walked(self._data(file, block))
        file.seek(block.start + block.size)
        raw = file.read(block.index_size)
        found: Positions = {}
        at = 0
        while at < len(raw):
            _, length = _RECORD.unpack_from(raw, at)
            channel, size = _INDEX.unpack_from(raw, at + _RECORD.size)
            rows = np.frombuffer(raw, "<u8", size // 8, at + _RECORD.size + _INDEX.size).reshape(-1, 2)
            if len(rows):
                found[channel] = rows
            at += _RECORD.size + length
        return found

    # Opening

    def _read_summary(self, file: BinaryIO, size: int) -> bool:
        """Take over the index at the end; return whether there is one that says where every message is."""
        end = size - len(_MAGIC) - _FOOTER.size
        file.seek(max(0, end))
        raw = file.read()
        if end < len(_MAGIC) or raw[_FOOTER.size :] != _MAGIC:
            return False
        kind, length, start, _, crc = _FOOTER.unpack(raw[: _FOOTER.size])
        if (kind, length) != (Opcode.FOOTER, _FOOTER.size - _RECORD.size) or not len(_MAGIC) <= start < end:
            return False
        file.seek(start)
        summary = file.read(end - start)
        if crc and zlib.crc32(summary + raw[: _FOOTER.size - 4]) != crc:
            return False
        messages, offsets = 0, list[int]()
        same: dict[frozenset[int], frozenset[int]] = {}
        at = 0
        while at < len(summary):
            kind, length = _RECORD.unpack_from(summary, at)
            body = summary[at + _RECORD.size : at + _RECORD.size + length]
            at += _RECORD.size + length
            match kind:
                case Opcode.CHUNK_INDEX:
                    block = _block_of(body)
                    block.channels = same.setdefault(block.channels, block.channels)
                    self._blocks.append(block)
                case Opcode.STATISTICS:
                    messages = int.from_bytes(body[:8], "little")
                case Opcode.METADATA_INDEX:
                    offsets.append(MetadataIndex.read(_stream(body)).offset)
                case _:
                    self._take(kind, body)
        for offset in offsets:
            file.seek(offset)
            kind, length = _RECORD.unpack(file.read(_RECORD.size))
            self._take(kind, file.read(length))
        self._blocks.sort(key=lambda block: block.start)
        indexed = all(block.index_size and block.channels <= self.channels.keys() for block in self._blocks)
        return indexed and bool(self._blocks or not messages)

    def _scan(self, file: BinaryIO, size: int, progress: Progress | None) -> None:
        """Find the messages by the heads of the records, up to where the file breaks off."""
        self.damage = CUT_OFF
        try:
            for number, (at, head) in enumerate(_heads(file, size)):
                kind, length = _RECORD.unpack_from(head)
                if kind == Opcode.DATA_END:
                    break
                if kind in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA}:
                    file.seek(at + _RECORD.size)
                    self._take(kind, file.read(length))
                else:
                    self._note(kind, at, _RECORD.size + length, head)
                if progress is not None and number % _TOLD_EVERY == 0:
                    progress(at)
        except _BROKEN as error:
            self.damage = _explained(error)
        self._learn_channels(file)

    def _note(self, kind: int, at: int, size: int, head: bytes) -> None:
        """Note where a record with messages, or with their positions, is."""
        last = self._blocks[-1] if self._blocks else None
        match kind:
            case Opcode.CHUNK:
                (first_ns,) = _CHUNK.unpack_from(head, _RECORD.size)
                self._blocks.append(_Block(at, size, chunked=True, first_ns=first_ns))
            case Opcode.MESSAGE_INDEX if last is not None:
                channel, entries = _INDEX.unpack_from(head, _RECORD.size)
                last.index_size += size
                last.channels |= {channel} if entries else _NO_CHANNELS
            case Opcode.MESSAGE:
                first_ns = _MESSAGE.unpack_from(head)[4]
                if last is None or last.chunked or last.start + last.size != at:
                    last = _Block(at, 0, chunked=False, first_ns=first_ns)
                    self._blocks.append(last)
                last.size += size
                last.first_ns = min(last.first_ns, first_ns)
            case _:
                pass

    def _learn_channels(self, file: BinaryIO) -> None:
        """Read the blocks that declare channels; the index of the last one may not be whole, so it is read, too."""
        for number, block in enumerate(self._blocks):
            last = number == len(self._blocks) - 1 or not block.index_size
            if not last and block.channels <= self.channels.keys():
                continue
            try:
                data = self._data(file, block)
                if last:
                    block.index_size, block.channels = 0, frozenset(_walked(data))
                for kind, start, end in _records(data):
                    self._take(kind, data[start:end])
                if not block.channels <= self.channels.keys():
                    raise ValueError("a message belongs to no channel")
            except _BROKEN as error:
                self.damage = _explained(error)
                del self._blocks[number:]
                return

    def _take(self, kind: int, body: bytes) -> None:
        match kind:
            case Opcode.SCHEMA:
                schema = Schema.read(_stream(body))
                self._schemas[schema.id] = schema.name
            case Opcode.CHANNEL:
                one = Channel.read(_stream(body))
                layout = from_metadata(one.metadata)
                schema_name = self._schemas.get(one.schema_id, "")
                self.channels[one.id] = IndexedChannel(one.id, one.topic, schema_name, one.metadata, layout)
            case Opcode.METADATA:
                metadata = Metadata.read(_stream(body))
                self.metadata[metadata.name] = metadata.metadata
            case _:
                pass


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def _block_of(body: bytes) -> _Block:
    """Return what a chunk index says. A long recording has one for each second, too many for the library's reader."""
    first_ns, _, start, size, listed = _CHUNK_INDEX.unpack_from(body)
    end = _CHUNK_INDEX.size + listed
    channels = frozenset(channel for channel, _ in _LISTED.iter_unpack(body[_CHUNK_INDEX.size : end]))
    index_size = int.from_bytes(body[end : end + 8], "little")
    return _Block(start, size, chunked=True, first_ns=first_ns, index_size=index_size, channels=channels)


def _heads(file: BinaryIO, size: int) -> Iterator[tuple[int, bytes]]:
    """Yield where each whole record is, and its first bytes."""
    at = len(_MAGIC)
    while True:
        file.seek(at)
        head = file.read(_MESSAGE.size)
        if len(head) < _RECORD.size:
            return
        kind, length = _RECORD.unpack_from(head)
        if not kind or at + _RECORD.size + length > size:
            return
        yield at, head
        at += _RECORD.size + length


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield kind, start and end of the body of each record."""
    at = 0
    while at < len(data):
        kind, length = _RECORD.unpack_from(data, at)
        start, at = at + _RECORD.size, at + _RECORD.size + length
        if at > len(data):
            raise ValueError("a record ends after its chunk")
        yield kind, start, at


def _walked(data: bytes) -> Positions:
    """Return where the messages are in a block that has no index."""
    found: dict[int, list[tuple[int, int]]] = {}
    for kind, start, _ in _records(data):
        if kind == Opcode.MESSAGE:
            offset = start - _RECORD.size
            _, _, channel, _, log_time, _ = _MESSAGE.unpack_from(data, offset)
            found.setdefault(channel, []).append((log_time, offset))
    return {channel: np.array(rows, dtype=np.uint64) for channel, rows in found.items()}


def _explained(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else CUT_OFF
