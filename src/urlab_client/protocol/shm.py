"""Layout of the shared-memory regions: header, slots, publication order, torn reads, file names. No files, no mapping.

For the shared-memory transports of client and server, which map files and hand the mapped bytes to `Region`.

A region is a header of 64 bytes and two or more slots of `stride` bytes, each a payload after its size:

    offset  type     field
    0       uint32   magic, `URLB`
    4       uint32   protocol version, 1
    8       uint32   stride
    12      uint32   number of slots
    16      uint64   sequence: number of publications
    24      uint32   slot of the newest publication
    28      36 bytes reserved

All little-endian, which is also the byte order of every platform MuJoCo runs on: sequence and slot number are read
and written as single native words.

Beside them may be a doorbell, a Unix stream socket over which our client and server wake each other; the plugin has
none. The regions are authoritative; a ring is only a hint to check them. So a ring may be lost, doubled or late without
harm. The server listens on `DOORBELL_FILE` in the directory of `req.shm`, and each byte is one message (`Ring`). Both
sides send without blocking and drop a ring if the peer's buffer is full, because the peer then has rings waiting.
Unknown bytes are ignored.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import PurePath
from struct import Struct as Layout
from typing import Any, Generic, TypeVar, overload

from msgspec import Struct

from urlab_client.errors import ProtocolError

MAGIC = 0x424C5255
VERSION = 1
HEADER_SIZE = 64
SIZE_PREFIX = 4
RPC_STRIDE = 1_048_576
MAX_BUFFERS = 64

REQUEST_FILE = "req.shm"
REPLY_FILE = "rep.shm"
STATE_FILE = "state.shm"
LIVE_DIRECTORY = "live"
DOORBELL_FILE = "doorbell.sock"
MAX_DOORBELL_PATH_BYTES = 103
"""Longest path that every system's `sockaddr_un` holds; with a longer one there is no doorbell."""

HEADER = Layout("<IIIIQI36x")
_LAYOUT_SIZE = 16  # bytes of the header, from its start, that stay as they are for as long as the region does
_SIZE = Layout("<I")
_SEQUENCE_MASK = (1 << 64) - 1
_MIN_STATE_STRIDE = 16_384
_READ_ATTEMPTS = 8

T = TypeVar("T")

Fence = Callable[[], None]
"""A full memory barrier between the loads and stores before the call and those after it."""


class Ring:
    """The doorbell's messages."""

    REQUEST = b"q"
    """From a client: it published a request."""
    WANT_STATE = b"S"
    """From a client, once: it wants `STATE`."""
    WANT_CAMERAS = b"C"
    """From a client, once: it wants `CAMERA`."""
    REPLY = b"r"
    """From the server: it published a reply, or accepted the connection."""
    STATE = b"s"
    """From the server: it published a snapshot."""
    CAMERA = b"c"
    """From the server: it published a picture."""


class RegionNotReady(ProtocolError):
    """The region is still being created: look again a little later."""


class Header(Struct, frozen=True):
    """The header of a region, copied at one moment.

    Attributes:
        stride: Bytes per slot, the size prefix included.
        n_buffers: Number of slots.
        sequence: Number of publications so far.
        latest_idx: Slot of the newest publication.
    """

    stride: int
    n_buffers: int
    sequence: int
    latest_idx: int


class Publication(Struct, Generic[T], frozen=True):
    """One payload that was read whole.

    Attributes:
        sequence: The region's sequence when it was read. The same publication can turn up again under the next
            number, when the writer was between storing the slot number and counting.
        payload: The payload, or what `take` made of it.
    """

    sequence: int
    payload: T


def region_size(stride: int, n_buffers: int = 2) -> int:
    """Return the size of a region in bytes."""
    return HEADER_SIZE + stride * n_buffers


def camera_stride(width: int, height: int) -> int:
    """Return the stride of a camera region: 4 bytes per pixel and the size prefix."""
    return width * height * 4 + SIZE_PREFIX


def state_stride(snapshot_size: int) -> int:
    """Return a stride for state snapshots, given the size of the first in bytes.

    The next power of two from twice that size on, and never below the plugin's 16384: a snapshot that does not fit its
    slot is lost.
    """
    return max(_MIN_STATE_STRIDE, 1 << (2 * snapshot_size - 1).bit_length())


def parse_header(buffer: bytes | bytearray | memoryview) -> Header:
    """Read and check the header of a whole region.

    Args:
        buffer: The region, header and slots; bytes beyond the last slot are ignored.

    Raises:
        RegionNotReady: If the buffer is too short for what its header says, or the header is not yet written.
        ProtocolError: If a field cannot be right.
    """
    head = bytes(buffer[:HEADER_SIZE])
    if len(head) < HEADER_SIZE:
        raise RegionNotReady(f"shared-memory region: {len(head)} bytes, expected a header of {HEADER_SIZE}.", raw=head)
    magic, version, stride, n_buffers, sequence, latest = HEADER.unpack(head)
    if 0 in (magic, version, stride, n_buffers):
        raise RegionNotReady("shared-memory region: the header is not written yet.", raw=head)
    for field, value, expected, right in (
        ("magic", f"{magic:#010x}", f"{MAGIC:#010x}", magic == MAGIC),
        ("protocol_version", version, VERSION, version == VERSION),
        ("buffer_stride", stride, f"{SIZE_PREFIX} or more", stride >= SIZE_PREFIX),
        # A lone slot could change at any moment: no read of it can be known to be whole.
        ("n_buffers", n_buffers, f"2 to {MAX_BUFFERS}", 2 <= n_buffers <= MAX_BUFFERS),
        ("latest_idx", latest, f"below n_buffers ({n_buffers})", latest < n_buffers),
    ):
        if not right:
            raise ProtocolError(f"shared-memory region: {field} is {value}, expected {expected}.", raw=head)
    size = region_size(stride, n_buffers)
    if len(buffer) < size:
        problem = f"{len(buffer)} bytes, expected {size} (64 + {stride} * {n_buffers})"
        raise RegionNotReady(f"shared-memory region: {problem}.", raw=head)
    return Header(stride, n_buffers, sequence, latest)


class Region:
    """A region in mapped memory, for its one writer or for any of its readers.

    Stride and number of slots are those found at first: a later change of the header by the other side cannot lead
    outside the buffer.

    Args:
        buffer: The whole region, aligned to 8 as a mapping is; read-only is enough for reading.
        fence: The memory barrier of this processor; a function that does nothing on x86.

    Attributes:
        stride: Bytes per slot, the size prefix included.
        n_buffers: Number of slots.
        max_payload: Largest payload that fits, bytes.

    Raises:
        RegionNotReady: It is still being created.
        ProtocolError: The header cannot be right.
    """

    def __init__(self, buffer: bytearray | memoryview, *, fence: Fence) -> None:
        header = parse_header(buffer)
        self.stride: int = header.stride
        self.n_buffers: int = header.n_buffers
        self.max_payload: int = header.stride - SIZE_PREFIX
        self._fence = fence
        self._bytes = memoryview(buffer)
        self._layout = bytes(self._bytes[:_LAYOUT_SIZE])
        # Single aligned moves; putting a number together from bytes could mix an old half with a new one.
        self._sequence = self._bytes[16:24].cast("Q")
        self._latest = self._bytes[24:28].cast("I")

    @classmethod
    def lay_out(cls, buffer: bytearray | memoryview, stride: int, n_buffers: int = 2, *, fence: Fence) -> Region:
        """Make an empty region of a buffer. Until its end, readers find the region not ready."""
        view = memoryview(buffer)
        view[:4] = bytes(4)
        fence()
        view[4:HEADER_SIZE] = HEADER.pack(0, VERSION, stride, n_buffers, 0, 0)[4:]
        view[HEADER_SIZE : region_size(stride, n_buffers)] = bytes(stride * n_buffers)
        fence()
        view[:4] = HEADER.pack(MAGIC, 0, 0, 0, 0, 0)[:4]
        return cls(view, fence=fence)

    @property
    def sequence(self) -> int:
        """Number of publications so far, as it stands now.

        Any change means news. A decrease means that the region was started anew: forget what was seen last.
        """
        return self._sequence[0]

    def publish(self, payload: bytes | bytearray | memoryview) -> None:
        """Make `payload` the newest publication. Only the region's one writer may.

        Raises:
            ValueError: If the payload is empty or larger than `max_payload`, or the region was attached read-only.
                Nothing was published.
        """
        size = len(payload)
        if not 0 < size <= self.max_payload:
            raise ValueError(f"payload of {size} bytes, the slots take 1 to {self.max_payload}")
        if self._bytes.readonly:
            raise ValueError("the region is mapped read-only")
        target = (self._latest[0] + 1) % self.n_buffers
        start = HEADER_SIZE + target * self.stride
        _SIZE.pack_into(self._bytes, start, size)
        start += SIZE_PREFIX
        self._bytes[start : start + size] = payload
        self._fence()
        # Slot number before count: a reader that sees the new count with the old slot would take the old payload.
        self._latest[0] = target
        self._fence()
        self._sequence[0] = (self._sequence[0] + 1) & _SEQUENCE_MASK
        # The next payload overwrites a slot that readers of this count rely on.
        self._fence()

    @overload
    def read_latest(self, last_seen: int = 0) -> Publication[bytes] | None: ...
    @overload
    def read_latest(self, last_seen: int = 0, *, take: Callable[[memoryview], T]) -> Publication[T] | None: ...
    def read_latest(self, last_seen: int = 0, *, take: Callable[[memoryview], Any] = bytes) -> Publication[Any] | None:
        """Return the newest publication if it is another one than that seen last.

        Args:
            last_seen: `sequence` of the publication seen last. To take what is there already, pass 0; to wait for
                what comes next, pass the region's present `sequence`.
            take: Makes the payload from a live view of the slot: a copy by default, or for example a conversion into
                an array of the caller's. The writer may be changing the slot meanwhile. What was taken is dropped and
                taken again when it did, so nothing returned may alias the view.

        Returns:
            The publication; None when there is no other one, or when the writer kept overwriting it while it was
            read. In the second case `sequence` differs from `last_seen`: yield, then try again.

        Raises:
            ProtocolError: If slot number or payload size are outside the region.
        """
        for _ in range(_READ_ATTEMPTS):
            sequence = self._sequence[0]
            if sequence in (0, last_seen):
                return None
            self._fence()
            try:
                payload = take(self._payload(self._latest[0]))
            except Exception:
                if self._is_torn(sequence):
                    continue
                raise
            if not self._is_torn(sequence):
                return Publication(sequence, payload)
        return None

    def is_counted(self, sequence: int) -> bool:
        """Return whether what was read as publication `sequence` is that one, and not the next one, uncounted yet."""
        return self._latest[0] == sequence % self.n_buffers and not self._is_torn(sequence)

    def holds(self, sequence: int) -> bool:
        """Return whether what was read since publication `sequence` came out is whole."""
        return not self._is_torn(sequence)

    def _payload(self, slot: int) -> memoryview:
        self._fence()
        if slot >= self.n_buffers:
            raise ProtocolError(f"shared-memory region: latest_idx is {slot}, expected below {self.n_buffers}.")
        start = HEADER_SIZE + slot * self.stride
        (size,) = _SIZE.unpack_from(self._bytes, start)
        if not 0 < size <= self.max_payload:
            problem = (
                f"slot {slot} has a payload of {size} bytes, expected 1 to {self.max_payload} (size + 4 <= stride)"
            )
            raise ProtocolError(f"shared-memory region: {problem}.")
        start += SIZE_PREFIX
        return self._bytes[start : start + size]

    def _is_torn(self, sequence: int) -> bool:
        # What was read belongs to publication `sequence` or a later one. The writer begins to overwrite the slot of
        # publication p once it has counted p + n_buffers - 1. A decrease is a region started anew.
        self._fence()
        return not 0 <= self._sequence[0] - sequence <= self.n_buffers - 2

    def begun_anew(self, seen: int) -> bool:
        """Return whether another writer laid the region out in place since publication `seen`."""
        return self.sequence < seen or bytes(self._bytes[:_LAYOUT_SIZE]) != self._layout

    def release(self) -> None:
        """Let go of the buffer, so that it can be unmapped. The region is unusable afterwards."""
        for view in (self._sequence, self._latest, self._bytes):
            view.release()


_SEPARATORS = re.compile(r"[/\\:\0]")


def camera_file(articulation: str, camera: str) -> str:
    """Return the file name of a camera's region: the names as the handshake gives them, joined as they are.

    Raises:
        ProtocolError: If a name could lead out of the directory.
    """
    for name in (articulation, camera):
        if name in {"", ".", ".."} or _SEPARATORS.search(name):
            raise ProtocolError(f"{name!r} cannot be part of a file name.")
    return f"cam_{articulation}_{camera}.shm"


def region_directories(shm_session_dir: str | os.PathLike[str], file: str) -> tuple[PurePath, ...]:
    """Return where to look for a region's file, best place first.

    Args:
        shm_session_dir: From the handshake: the directory of `state.shm`. The plugin keeps all other regions in its
            sibling `live`.
        file: Name of the file.

    Raises:
        ProtocolError: If the directory is not absolute.
    """
    directory = PurePath(shm_session_dir)
    if not directory.is_absolute():
        raise ProtocolError(f"shm_session_dir is {str(shm_session_dir)!r}, expected an absolute path.")
    if file == STATE_FILE:
        return (directory,)
    return tuple(dict.fromkeys((directory.parent / LIVE_DIRECTORY, directory)))
