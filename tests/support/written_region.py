"""The plugin's kind of writer: regions that are laid out and written in place."""

from __future__ import annotations

import mmap
from pathlib import Path

from urlab_client._platform.processors import processor_fence
from urlab_client.protocol import shm


class WrittenRegion:
    """A region's file and its writer, made in place as the plugin does."""

    def __init__(self, path: Path, stride: int) -> None:
        self.path = path
        with path.open("w+b") as file:
            file.truncate(shm.region_size(stride))
            self._map = mmap.mmap(file.fileno(), shm.region_size(stride))
        self.region = shm.Region.lay_out(memoryview(self._map), stride, fence=processor_fence())

    def publish(self, payload: bytes) -> None:
        """Publish; what is too large is dropped."""
        if len(payload) <= self.region.max_payload:
            self.region.publish(payload)

    def close(self) -> None:
        """Remove the file."""
        self.region.release()
        self._map.close()
        self.path.unlink(missing_ok=True)
