"""One side of a region that is hammered: `python hammer.py ROLE FILE SECONDS`.

Says that it is ready, waits for a line, and in the end prints counts.

`write` publishes, `read` reads. Every payload is one 64-bit number over and over, so that a mixture of two shows. The
number tells which publication it is, so that one taken under the wrong count shows, too.
"""

from __future__ import annotations

import mmap
import random
import sys
import time
from collections.abc import Callable
from pathlib import Path

from urlab_client._platform.processors import processor_fence
from urlab_client.protocol.shm import Region

WORDS = (8, 40, 100)
STRIDE = 1024
START_S = 60.0
BURST = 2999
# Between two publications, so that both sides meet at every point: none, or as long as a read takes, more or less.
LONGEST_PAUSE_S = 20e-6


def opened(path: Path) -> tuple[Region, mmap.mmap]:
    with path.open("r+b") as file:
        mapping = mmap.mmap(file.fileno(), 0)
    return Region(memoryview(mapping), fence=processor_fence()), mapping


def publish(put: Callable[[bytes], None], seconds: float) -> str:
    """Print how many were published: in bursts without a pause, and in bursts with pauses of all lengths."""
    end = time.monotonic() + seconds
    chance = random.Random(3)
    payloads = [number.to_bytes(8, "little") * WORDS[number % len(WORDS)] for number in range(BURST)]
    count = 0
    while not count or time.monotonic() < end:
        hurried = chance.random() < 0.5
        for payload in payloads:
            put(payload)
            resume = 0.0 if hurried else time.perf_counter() + chance.uniform(0, LONGEST_PAUSE_S)
            while time.perf_counter() < resume:
                pass
        count += len(payloads)
    return str(count)


def take(news: Callable[[int], tuple[int, bytes | None]], seconds: float) -> str:
    """Print how many reads were made, how many payloads accepted, and how many of those were torn or others'."""
    end = time.monotonic() + seconds
    seen = tries = accepted = wrong = 0
    # Whoever writes may come late.
    while time.monotonic() < end or (not accepted and time.monotonic() < end + START_S):
        for _ in range(1000):
            sequence, payload = news(seen)
            tries += sequence != seen
            if payload is None:
                continue
            seen = sequence
            accepted += 1
            number = int.from_bytes(payload[:8], "little")
            torn = payload != payload[:8] * WORDS[number % len(WORDS)]
            # A writer stores the slot and then counts: between the two, the next publication is already the newest.
            wrong += torn or number not in ((sequence - 1) % BURST, sequence % BURST)
    return f"{tries} {accepted} {wrong}"


def wait_for_start() -> None:
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.readline()


def run(role: str, path: Path, seconds: float) -> str:
    region, _mapping = opened(path)
    wait_for_start()
    if role == "write":
        return publish(region.publish, seconds)

    def newest(seen: int) -> tuple[int, bytes | None]:
        found = region.read_latest(seen)
        return (region.sequence, None) if found is None else (found.sequence, found.payload)

    return take(newest, seconds)


if __name__ == "__main__":
    sys.stdout.write(run(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3])))
