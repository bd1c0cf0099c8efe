"""The plugin's kind of writer: regions that are laid out and written in place."""

from __future__ import annotations

import mmap
from pathlib import Path

from urlab_client._platform.processors import processor_fence
from urlab_client.protocol import shm


def create(
    buffer: bytearray | memoryview | mmap.mmap, stride: int, n_buffers: int = 2, *, fence: shm.Fence
) -> shm.Region:
    """Lay out an empty region in a buffer, erasing what it held. Until its end readers find the region not ready."""
    view = memoryview(buffer)
    view[:4] = bytes(4)
    fence()
    view[4 : shm.HEADER_SIZE] = shm.HEADER.pack(0, shm.VERSION, stride, n_buffers, 0, 0)[4:]
    view[shm.HEADER_SIZE : shm.region_size(stride, n_buffers)] = bytes(stride * n_buffers)
    fence()
    view[:4] = shm.HEADER.pack(shm.MAGIC, 0, 0, 0, 0, 0)[:4]
    return shm.attach(view, fence=fence)


class WrittenRegion:
    """A region's file and its writer, made in place as the plugin does."""

    def __init__(self, path: Path, stride: int) -> None:
        self.path = path
        with path.open("w+b") as file:
            file.truncate(shm.region_size(stride))
            self._map = mmap.mmap(file.fileno(), shm.region_size(stride))
        self.region = create(self._map, stride, fence=processor_fence())

    def publish(self, payload: bytes) -> None:
        """Publish; what is too large is dropped."""
        if len(payload) <= self.region.max_payload:
            self.region.publish(payload)

    def close(self) -> None:
        """Remove the file."""
        self.region.release()
        self._map.close()
        self.path.unlink(missing_ok=True)
