"""Positions of the messages of an MCAP file: from the index at its end or, in an unfinished file, from record headers.

Opening a file reads no messages, and looking one up reads one block. Files come from anywhere, so what a file declares
is checked before memory is allocated for it.

The readers of the library `mcap` do not suffice, so only its records are used: they unpack a chunk of any size, read an
unfinished file whole for each query, sort all chunks and unpack one for each lookup, and do not say where a file is
damaged. A lookup in a recording of three hours takes them 400 times as long.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import struct
import threading
import zlib
from array import array
from collections import OrderedDict
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, TypeAlias

import msgspec
import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Metadata, MetadataIndex, Schema
from numpy.typing import NDArray
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from urlab_client.integrations._feed.scene import SceneLayout, from_metadata
from urlab_client.integrations.record.joint_states import as_mcap, is_joint_states
from urlab_client.integrations.record.writer import RecordingError

Progress: TypeAlias = Callable[[int], None]

UNKNOWN = "neither an MCAP file nor a recording of the server."
CUT_OFF = "the end of the file is missing"

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")  # with the head of its record
_CHUNK_INDEX = struct.Struct("<QQQQI")
_LISTED = struct.Struct("<HQ")
_INDEX = struct.Struct("<HI")
_FOOTER_SIZE = _RECORD.size + 20
_NO_CHANNELS: frozenset[int] = frozenset()
_KEPT = 8  # blocks in memory: the current one, and those with the newest pictures of some cameras
_KEPT_BYTES = 64 << 20
_TOLD_EVERY = 16
_BROKEN = (McapError, ZstdError, struct.error, ValueError, OverflowError, MemoryError, RuntimeError)  # the last by LZ4

LATEST_NS: Final = 2**63 - 1
"""The latest time, nanoseconds, that fits the tables of a recording."""

# Limits on what a file can make a reader allocate. A chunk of the recorder has 1 MiB or one picture, and a picture of
# the sky hardly takes any space.
_CHUNK_BYTES = 64 << 20
_CHUNK_RATIO = 100
_LARGEST_CHUNK = 512 << 20
_SUMMARY_BYTES = 256 << 20
_DECLARED_BYTES = 16 << 20
_MOST_BLOCKS = 4_000_000
_MOST_WALKED = 10_000_000
_NAME_CHARS = 4096

Positions: TypeAlias = dict[int, NDArray[np.uint64]]
"""Time, nanoseconds, and offset in its block of each message, shape (n, 2), by channel."""


class IndexedChannel(NamedTuple):
    """One channel: its topic, the name of its messages' schema, its metadata, and the layout in the metadata."""

    id: int
    topic: str
    schema: str
    metadata: Mapping[str, str]
    layout: SceneLayout


class RecordedMessage(NamedTuple):
    """One message: its position, and its times on the recording's clock and the server's UTC clock, nanoseconds."""

    channel: IndexedChannel
    log_time: int
    publish_time: int
    data: bytes
    block: int
    offset: int


@dataclass(slots=True)
class _Block:
    """A chunk, whose messages are read together. In bytes of the file."""

    start: int
    size: int
    first_ns: int
    index_size: int = 0
    channels: frozenset[int] = _NO_CHANNELS


@dataclass(frozen=True, slots=True)
class _Contents:
    """The unpacked records of a block, and the positions of its messages in order of time."""

    data: bytes
    positions: Positions


class RecordingIndex:
    """Contents of a file and their positions. Thread-safe.

    Args:
        path: The file.
        progress: Called occasionally with the number of bytes read so far of a file without an index.

    Attributes:
        path: The file.
        complete: Whether the file was finished.
        damage: Why the known part of the file ends early; empty for a finished file.
        channels: By id.
        metadata: By name.
    """

    def __init__(self, path: Path, progress: Progress | None = None) -> None:
        self.path = path
        self._kept: OrderedDict[int, _Contents] = OrderedDict()
        self._lock = threading.Lock()
        self._forget()
        # A server's own recording has no index and is read whole.
        self._converted = as_mcap(path) if is_joint_states(path) else None
        with self._opened() as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(f"{path}: {UNKNOWN}")
            try:
                self.complete: bool = self._read_summary(file, size)
            except (OSError, *_BROKEN):
                self.complete = False
            if not self.complete:
                self._forget()
                self._scan(file, size, progress)
        first = np.array([block.first_ns for block in self._blocks], dtype=np.uint64)
        self._earliest = np.minimum.accumulate(first[::-1])[::-1]  # of a block and all after it

    def _opened(self) -> BinaryIO:
        return self.path.open("rb") if self._converted is None else io.BytesIO(self._converted)

    def _forget(self) -> None:
        self.damage: str = ""
        self.channels: dict[int, IndexedChannel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self._blocks: list[_Block] = []
        self._schemas: dict[int, str] = {}
        self._declared = 0

    def channels_of(self, *schemas: str) -> list[IndexedChannel]:
        """Return the channels whose messages have one of these schemas, by topic."""
        return sorted((one for one in self.channels.values() if one.schema in schemas), key=lambda one: one.topic)

    def times(self, channels: Collection[int] | None = None) -> dict[int, NDArray[np.int64]]:
        """Return the times of all messages by channel, nanoseconds, without reading the messages."""
        found: dict[int, list[NDArray[np.int64]]] = {}
        walked = 0
        with self._opened() as file:
            for block in self._blocks:
                if channels is None or not block.channels.isdisjoint(channels):
                    positions = self._positions(file, block)
                    walked += 0 if block.index_size else sum(map(len, positions.values()))
                    if walked > _MOST_WALKED:
                        raise RecordingError(f"{self.path}: more than {_MOST_WALKED} messages are in no index.")
                    for channel, rows in positions.items():
                        if channel in self.channels and (channels is None or channel in channels):
                            found.setdefault(channel, []).append(rows[:, 0].astype(np.int64))
        times = {channel: np.concatenate(parts) for channel, parts in found.items()}
        for channel, stamps in times.items():
            if stamps.min() < 0:
                topic = self.channels[channel].topic
                raise RecordingError(f"{self.path}: a message of {topic} has a time of more than {LATEST_NS} ns.")
        return times

    def unreadable(self, message: RecordedMessage, reason: object) -> RecordingError:
        """Return the error for a message with wrong contents; it says which of its channel's messages that is."""
        topic, number = message.channel.topic, 1
        with self._opened() as file:
            for at, block in enumerate(self._blocks[: message.block + 1]):
                rows = self._positions(file, block).get(message.channel.id)
                if rows is not None:
                    number += int((rows[:, 1] < message.offset).sum()) if at == message.block else len(rows)
        return RecordingError(f"{self.path}: message {number} of {topic} cannot be read: {str(reason).rstrip('.')}.")

    def messages(self, channels: Collection[int], progress: Progress | None = None) -> Iterator[RecordedMessage]:
        """Iterate over the messages of some channels in the file's order, up to damage, which `damage` names."""
        wanted = frozenset(channels)
        with self._opened() as file:
            for number, block in enumerate(self._blocks):
                if wanted.isdisjoint(block.channels):
                    continue
                try:
                    data = self._data(file, block)
                    for kind, start, _ in _records(data):
                        if kind == Opcode.MESSAGE and int.from_bytes(data[start : start + 2], "little") in wanted:
                            yield self._message(number, data, start - _RECORD.size)
                except _BROKEN as error:
                    self.damage = _explained(error)
                    return
                if progress is not None:
                    progress(block.start)

    def first(self, channel: int) -> RecordedMessage | None:
        """Return the first message of a channel in the file, or None."""
        for number, block in enumerate(self._blocks):
            if channel in block.channels and (rows := self._contents(number).positions.get(channel)) is not None:
                return self._checked(number, int(rows[:, 1].min()))
        return None

    def newest(self, channel: int, at: int | None = None) -> RecordedMessage | None:
        """Return the last message of a channel at or before a time, or None.

        Args:
            channel: Id of the channel.
            at: The time, nanoseconds; None for the end of the file.
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

    # Blocks

    def _contents(self, number: int) -> _Contents:
        with self._lock:
            kept = self._kept.get(number)
            if kept is not None:
                self._kept.move_to_end(number)
                return kept
        block = self._blocks[number]
        with self._locating_damage(block), self._opened() as file:
            data = self._data(file, block)
            contents = _Contents(data, {channel: _by_time(rows) for channel, rows in _walked(data).items()})
        with self._lock:
            self._kept[number] = contents
            sizes = [len(one.data) for one in self._kept.values()]
            while len(sizes) > _KEPT or (len(sizes) > 1 and sum(sizes) > _KEPT_BYTES):
                self._kept.popitem(last=False)
                del sizes[0]
        return contents

    def _checked(self, number: int, offset: int) -> RecordedMessage:
        with self._locating_damage(self._blocks[number]):
            return self._message(number, self._contents(number).data, offset)

    @contextlib.contextmanager
    def _locating_damage(self, block: _Block) -> Generator[None]:
        """Turn errors of damaged data into one that says where they are."""
        try:
            yield
        except _BROKEN as error:
            raise RecordingError(f"{self.path} is damaged at byte {block.start}: {_explained(error)}.") from error

    def _message(self, number: int, data: bytes, offset: int) -> RecordedMessage:
        _, length, channel, _, log_time, publish_time = _MESSAGE.unpack_from(data, offset)
        if length < _MESSAGE.size - _RECORD.size:
            raise ValueError("a message is shorter than its header")
        if max(log_time, publish_time) > LATEST_NS:
            raise ValueError(f"a message has a time of {max(log_time, publish_time)} ns, more than {LATEST_NS}")
        content = data[offset + _MESSAGE.size : offset + _RECORD.size + length]
        return RecordedMessage(self.channels[channel], log_time, publish_time, content, number, offset)

    def _data(self, file: BinaryIO, block: _Block) -> bytes:
        file.seek(block.start)
        raw = file.read(block.size)
        if len(raw) < block.size:
            raise ValueError(CUT_OFF)
        return _unpacked(Chunk.read(_stream(raw[_RECORD.size :])))

    def _positions(self, file: BinaryIO, block: _Block) -> Positions:
        """Return the positions in a block: from the index that follows it, or else from its messages."""
        with self._locating_damage(block):
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
        """Read the index at the end; return whether there is one that covers all messages."""
        end = size - len(_MAGIC) - _FOOTER_SIZE
        file.seek(max(0, end))
        tail = file.read()
        if end < len(_MAGIC) or tail[_FOOTER_SIZE:] != _MAGIC or tail[0] != Opcode.FOOTER:
            return False
        footer = Footer.read(_stream(tail[_RECORD.size :]))
        start, crc = footer.summary_start, footer.summary_crc
        if not len(_MAGIC) <= start < end or end - start > _SUMMARY_BYTES:
            return False
        file.seek(start)
        summary = file.read(end - start)
        if crc and zlib.crc32(summary + tail[: _FOOTER_SIZE - 4]) != crc:
            return False
        messages, offsets = 0, list[int]()
        same: dict[frozenset[int], frozenset[int]] = {}
        for kind, begins, ends in _records(summary):
            body = summary[begins:ends]
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
            self._declare(kind, length, file)
        self._blocks.sort(key=lambda block: block.start)
        indexed = all(block.index_size and block.channels <= self.channels.keys() for block in self._blocks)
        limits = [*(block.start for block in self._blocks[1:]), start]
        apart = all(
            block.start + block.size + block.index_size <= limit
            for block, limit in zip(self._blocks, limits, strict=False)
        )
        return indexed and apart and bool(self._blocks or not messages)

    def _scan(self, file: BinaryIO, size: int, progress: Progress | None) -> None:
        """Find the messages by the headers of the records, up to the point where the file breaks off."""
        self.damage = CUT_OFF
        try:
            for number, (at, head) in enumerate(_heads(file, size)):
                kind, length = _RECORD.unpack_from(head)
                if kind == Opcode.DATA_END:
                    break
                if kind in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA}:
                    file.seek(at + _RECORD.size)
                    self._declare(kind, length, file)
                else:
                    self._note(kind, at, _RECORD.size + length, head)
                if progress is not None and number % _TOLD_EVERY == 0:
                    progress(at)
        except _BROKEN as error:
            self.damage = _explained(error)
        self._learn_channels(file)

    def _note(self, kind: int, at: int, size: int, head: bytes) -> None:
        """Add a record with messages, or with their positions, to the blocks."""
        if len(self._blocks) > _MOST_BLOCKS:
            raise ValueError(f"it has more than {_MOST_BLOCKS} chunks")
        match kind:
            case Opcode.CHUNK:
                self._blocks.append(_Block(at, size, int.from_bytes(head[_RECORD.size : _RECORD.size + 8], "little")))
            case Opcode.MESSAGE_INDEX if self._blocks:
                channel, entries = _INDEX.unpack_from(head, _RECORD.size)
                last = self._blocks[-1]
                last.index_size += size
                last.channels |= {channel} if entries else _NO_CHANNELS
            case Opcode.MESSAGE:
                raise ValueError("a message is outside of chunks, where none is looked up; write the file with chunks")
            case _:
                pass

    def _learn_channels(self, file: BinaryIO) -> None:
        """Read the blocks that declare channels, and the last one, whose index may be incomplete."""
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

    def _declare(self, kind: int, length: int, file: BinaryIO) -> None:
        if length > _DECLARED_BYTES:
            raise ValueError(f"a record of {length} bytes declares a schema, a channel or metadata")
        self._take(kind, file.read(length))

    def _take(self, kind: int, body: bytes) -> None:
        number = int.from_bytes(body[:2], "little")
        match kind:  # chunks may repeat schemas and channels
            case Opcode.SCHEMA if number not in self._schemas:
                self._schemas[number] = Schema.read(self._counted(body)).name
            case Opcode.CHANNEL if number not in self.channels:
                one = Channel.read(self._counted(body))
                name = self._schemas.get(one.schema_id, "")
                self.channels[number] = IndexedChannel(number, one.topic, name, one.metadata, self._layout(one))
            case Opcode.METADATA:
                metadata = Metadata.read(self._counted(body))
                self.metadata[metadata.name] = metadata.metadata
            case _:
                pass

    def _counted(self, body: bytes) -> ReadDataStream:
        self._declared += len(body)
        if self._declared > _DECLARED_BYTES:
            raise ValueError(f"schemas, channels and metadata take more than {_DECLARED_BYTES} bytes")
        return _stream(body)

    def _layout(self, channel: Channel) -> SceneLayout:
        if len(channel.topic) > _NAME_CHARS or "\0" in channel.topic:
            raise RecordingError(f"{self.path}: {channel.topic[:100]!r} is not a valid name of a channel.")
        try:
            return from_metadata(channel.metadata)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise RecordingError(f"{self.path}: the layout of {channel.topic} cannot be read: {error}.") from None


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def _block_of(body: bytes) -> _Block:
    """Read a chunk index. The library takes seven times as long, and a long recording has one for each second."""
    first_ns, _, start, size, listed = _CHUNK_INDEX.unpack_from(body)
    end = _CHUNK_INDEX.size + listed
    channels = frozenset(channel for channel, _ in _LISTED.iter_unpack(body[_CHUNK_INDEX.size : end]))
    index_size = int.from_bytes(body[end : end + 8], "little")
    return _Block(start, size, first_ns, index_size, channels)


def _heads(file: BinaryIO, size: int) -> Iterator[tuple[int, bytes]]:
    """Yield the offset and the first bytes of each complete record."""
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
    """Return the positions of the messages of a block from the messages themselves."""
    found: dict[int, array[int]] = {}
    for kind, start, _ in _records(data):
        if kind == Opcode.MESSAGE:
            offset = start - _RECORD.size
            _, _, channel, _, log_time, _ = _MESSAGE.unpack_from(data, offset)
            found.setdefault(channel, array("Q")).extend((log_time, offset))
    return {channel: np.array(rows, dtype=np.uint64).reshape(-1, 2) for channel, rows in found.items()}


def _by_time(rows: NDArray[np.uint64]) -> NDArray[np.uint64]:
    times = rows[:, 0]
    return rows if (times[1:] >= times[:-1]).all() else rows[np.argsort(times, kind="stable")]


def _unpacked(chunk: Chunk) -> bytes:
    packed, size = chunk.data, chunk.uncompressed_size
    if size > min(max(_CHUNK_BYTES, _CHUNK_RATIO * len(packed)), _LARGEST_CHUNK):
        raise ValueError(f"a chunk of {len(packed)} bytes declares that it unpacks to {size}")
    match chunk.compression:
        case "zstd":
            # The library allocates the size that the data declare themselves, whatever the limit.
            fits = frame_content_size(packed) in {-1, size}
            data = ZstdDecompressor().decompress(packed, max_output_size=size) if fits else b""
        case "lz4":
            lz4: Any = importlib.import_module("lz4.frame")  # it has no type stubs
            data = lz4.LZ4FrameDecompressor().decompress(packed, max_length=size)
        case "":
            data = packed
        case _:
            raise ValueError(f"a chunk is compressed as {chunk.compression!r}, which is unknown")
    if len(data) != size:
        raise ValueError(f"a chunk does not unpack to {size} bytes, as it declares")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def _explained(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else CUT_OFF
