"""`python -m benchmarks.bytecodes`: count the bytecodes and Python calls of a step, by module and by function.

On a busy machine times are noise, and these counts are not: they differ only with the number of times that the event
loop looks for the reply. They say how much code runs, not how long it takes.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import threading
from collections import Counter
from pathlib import PurePath
from types import FrameType
from typing import Any

from urlab_client import URLabClient, aio
from urlab_client.server import SimulatedServer

_WARM = 300
_STEPS = 20


class _Count:
    """Counts what the threads do that are traced with it while it is `on`."""

    def __init__(self) -> None:
        self.on = False
        self._bytecodes = Counter[tuple[str, str]]()
        self._calls = Counter[tuple[str, str]]()

    def trace(self, frame: FrameType, event: str, _: Any) -> Any:
        """Trace a frame, as `sys.settrace` asks."""
        frame.f_trace_opcodes, frame.f_trace_lines = self.on, False
        if self.on and event in ("call", "opcode"):
            (self._calls if event == "call" else self._bytecodes)[_place(frame)] += 1
        return self.trace

    def show(self, what: str, most: int) -> None:
        """Print the counts of one step."""
        print(f"\n{what}: {self._bytecodes.total() / _STEPS:.0f} bytecodes in {self._calls.total() / _STEPS:.0f} calls")
        modules, calls = Counter[str](), Counter[str]()
        for (module, function), count in self._bytecodes.items():
            modules[module] += count
            calls[module] += self._calls[module, function]
        for module, count in modules.most_common():
            print(f"{count / _STEPS:8.0f} {calls[module] / _STEPS:6.1f}  {module}")
        print()
        for (module, function), count in self._bytecodes.most_common(most):
            print(f"{count / _STEPS:8.0f} {self._calls[module, function] / _STEPS:6.1f}  {module} {function}")


def _place(frame: FrameType) -> tuple[str, str]:
    parts = PurePath(frame.f_code.co_filename).parts
    own = "urlab_client" in parts
    return "/".join(parts[parts.index("urlab_client") + 1 :] if own else parts[-2:]), frame.f_code.co_qualname


def _blocking(options: dict[str, Any], count: _Count) -> None:
    with URLabClient(**options, step_mode="direct") as client:
        client.discover()
        for _ in range(_WARM):
            client.step()
        count.on = True
        sys.settrace(count.trace)
        for _ in range(_STEPS):
            client.step()
        sys.settrace(None)


async def _async(options: dict[str, Any], count: _Count) -> None:
    async with aio.URLabClient(**options, step_mode="direct") as client:
        await client.discover()
        for _ in range(_WARM):
            await client.step()
        count.on = True
        sys.settrace(count.trace)
        for _ in range(_STEPS):
            await client.step()
        sys.settrace(None)


def _served(model: str, count: _Count) -> None:
    def answering(frame: FrameType, event: str, argument: Any) -> Any:
        return count.trace(frame, event, argument) if threading.current_thread().name == "urlab-rpc" else None

    threading.settrace(answering)
    server = SimulatedServer(model, play=True).start()
    threading.settrace(None)  # type: ignore[arg-type]  # None, too, as for sys.settrace
    with server, URLabClient(**server.client_options(), step_mode="direct") as client:
        client.discover()
        for _ in range(_WARM):
            client.step()
        count.on = True
        for _ in range(_STEPS):
            client.step()
        count.on = False


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="arm", help="robot of the simulated server (default: arm)")
    parser.add_argument("--functions", type=int, default=25, help="number of functions to list (default: 25)")
    options = parser.parse_args()
    blocking, awaited, served = _Count(), _Count(), _Count()
    with SimulatedServer(options.model, play=True) as server:
        _blocking(server.client_options(), blocking)
        asyncio.run(_async(server.client_options(), awaited))
    _served(options.model, served)
    blocking.show("client.step()", options.functions)
    awaited.show("await client.step()", options.functions)
    served.show("the server's answer to a step", options.functions)


if __name__ == "__main__":
    main()
