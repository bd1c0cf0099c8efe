"""`urlab serve` in a child process, to be killed, stopped and started again on the same ports."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any, Self

from children import DEADLINE_S
from forked import COMMAND, Program, program
from ports import free_port

PORTS = ("step", "state", "ctrl", "info", "camera")


class Served:
    """A server, in play with the bundled arm.

    Attributes:
        address: Of its host.
        ports: By name.
    """

    def __init__(self, shm_dir: Path | None = None) -> None:
        self.address = ""
        self.ports = {name: free_port() for name in PORTS}
        self._memory = ["--no-shm"] if shm_dir is None else [f"--shm-dir={shm_dir}"]
        self._process: Program | subprocess.Popen[str] | None = None

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.kill()

    async def start(self) -> None:
        """Start it, on the ports it had, and wait until it serves."""
        options = ["--json", "--until-eof", "--play", *self._memory]
        options += [f"--{name}-port={number}" for name, number in self.ports.items()]
        self._process = process = await asyncio.to_thread(program, COMMAND, "serve", "arm", *options)
        assert process.stdout is not None
        ready = json.loads(await asyncio.to_thread(process.stdout.readline))
        self.address = ready["address"]

    def send(self, number: signal.Signals) -> None:
        """Signal it; return once a signal to stop has stopped it, which on a busy machine takes a moment."""
        assert self._process is not None
        with contextlib.suppress(OSError):
            os.kill(self._process.pid, number)
            while number is signal.SIGSTOP and _runs(self._process.pid):
                os.sched_yield()

    async def kill(self) -> None:
        """Kill it and wait until it is gone."""
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGKILL)
            await asyncio.to_thread(lambda: process.communicate(timeout=DEADLINE_S))

    def options(self) -> dict[str, Any]:
        """Options of a client of it."""
        return {"address": self.address, **{f"{name}_port": self.ports[name] for name in PORTS[:-1]}}


def _runs(process: int) -> bool:
    """Return whether a thread of the process is not stopped yet."""
    for stat in Path(f"/proc/{process}/task").glob("*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            if stat.read_text().rpartition(")")[2].split()[0] not in "TZX":
                return True
    return False
