"""One side of a region that is hammered: `python hammer.py write|read FILE SECONDS`. Prints a count.

Every payload is one 64-bit number over and over, so that a mixture of two shows.
"""

from __future__ import annotations

import mmap
import sys
import time
from pathlib import Path

from urlab_client.protocol.fence import processor_fence
from urlab_client.protocol.shm import Region, attach

WORDS = (8, 40, 100)


def opened(path: str) -> tuple[Region, mmap.mmap]:
    with Path(path).open("r+b") as file:
        mapping = mmap.mmap(file.fileno(), 0)
    return attach(memoryview(mapping), fence=processor_fence()), mapping


def write(region: Region, seconds: float) -> str:
    end = time.monotonic() + seconds
    payloads = [number.to_bytes(8, "little") * WORDS[number % len(WORDS)] for number in range(1, 3000)]
    count = 0
    while time.monotonic() < end:
        for payload in payloads:
            region.publish(payload)
        count += len(payloads)
    return str(count)


def read(region: Region, seconds: float) -> str:
    end = time.monotonic() + seconds
    seen = accepted = torn = 0
    while time.monotonic() < end:
        for _ in range(1000):
            found = region.read_latest(seen)
            if found is None:
                continue
            seen = found.sequence
            accepted += 1
            payload = found.payload
            number = int.from_bytes(payload[:8], "little")
            torn += payload != payload[:8] * WORDS[number % len(WORDS)]
    return f"{accepted} {torn}"


if __name__ == "__main__":
    region, mapping = opened(sys.argv[2])
    sys.stdout.write(write(region, float(sys.argv[3])) if sys.argv[1] == "write" else read(region, float(sys.argv[3])))
