"""A Wine for each worker, and a screen in memory for them: all of it starts and ends within deadlines.

Wine's server cannot always be stopped, or waited for, and its services keep the output of who started them open. So
nothing here is waited for without a limit, and what stays is killed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import select
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

STAYING = "import ctypes, time; ctypes.windll.user32.GetDesktopWindow(); print('ready', flush=True); time.sleep(1e6)"
SERVER_S = 10
START_S = 60
SCREEN_S = 20


class NotStarted(Exception):
    """Wine, or the screen, did not start."""


@dataclasses.dataclass(frozen=True)
class Prefix:
    """A Wine: its folder, and the interpreter that runs in it."""

    path: Path
    interpreter: Path

    @property
    def environment(self) -> dict[str, str]:
        """The environment of programs in this Wine."""
        return {**os.environ, "WINEPREFIX": str(self.path)}

    def start(self) -> None:
        """Start it, with a server that gives way to what it serves.

        Raises:
            NotStarted: The interpreter does not start in time.
        """
        self.server("nice", "-n", "5", "wineserver", "-p")
        # Wine's services, and the desktop with the first window, start with the first program that asks for them and
        # keep its output open; a test's would not end. So this one comes first, and stays.
        staying = subprocess.Popen(  # noqa: S603
            [self.interpreter, "-c", STAYING],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        assert staying.stdout is not None  # noqa: S101
        with staying.stdout as output:
            if first_line(output.fileno(), START_S) != "ready":
                raise NotStarted(f"Wine did not start the interpreter in {self.path} within {START_S} s")

    def stop(self) -> None:
        """End everything that runs in it."""
        self.server("wineserver", "-k")
        self.server("wineserver", "-w")
        self.kill()

    def server(self, *command: str) -> None:
        """Run a command for its server, within a deadline."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(  # noqa: S603
                command,
                env=self.environment,
                check=False,
                timeout=SERVER_S,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )

    def kill(self) -> None:
        """Kill everything that runs in it."""
        mark = os.fsencode(f"WINEPREFIX={self.path}")
        for process in Path("/proc").glob("[0-9]*"):
            # They may end, or belong to somebody else.
            with contextlib.suppress(OSError):
                if mark in (process / "environ").read_bytes().split(b"\0") and int(process.name) != os.getpid():
                    os.kill(int(process.name), signal.SIGKILL)


@contextlib.contextmanager
def prefixes(interpreter: Path, number: int) -> Iterator[list[Prefix]]:
    """Run a number of Wines: that of the interpreter, and copies of it.

    Raises:
        NotStarted: One of them does not start in time.
    """
    folder = interpreter.parent
    paths = [folder / "prefix", *(folder / f"prefix-{i}" for i in range(1, number))]
    running = [Prefix(path, interpreter) for path in paths]
    try:
        # Wine keeps the registry in memory until its server ends: a copy made before then crashes.
        for prefix in running:
            prefix.stop()
        for path in paths[1:]:
            if not path.exists():
                shutil.copytree(paths[0], path, symlinks=True)
        for prefix in running:
            print(f"Windows: starting Wine in {prefix.path.name}, at most {SERVER_S + START_S} s", flush=True)
            prefix.start()
        yield running
    finally:
        for prefix in running:
            prefix.stop()


@contextlib.contextmanager
def screen() -> Iterator[str]:
    """Run a screen in memory, without which Wine draws nothing, and yield its name for `DISPLAY`.

    Raises:
        NotStarted: It does not start in time.
    """
    print(f"Windows: starting a screen in memory, at most {SCREEN_S} s", flush=True)
    reading, writing = os.pipe()
    server = subprocess.Popen(  # noqa: S603
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1024x768x24"],  # noqa: S607
        pass_fds=[writing],
        start_new_session=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    try:
        number = first_line(reading, SCREEN_S)
        if not number:
            raise NotStarted(f"Xvfb did not start within {SCREEN_S} s")
        yield f":{number}"
    finally:
        os.close(reading)
        server.terminate()
        try:
            server.wait(SERVER_S)
        except subprocess.TimeoutExpired:
            server.kill()


def first_line(file: int, seconds: float) -> str:
    """Return the first line of a pipe, or what came of it until it ended or the time was up."""
    until, text = time.monotonic() + seconds, b""
    while b"\n" not in text and select.select([file], [], [], max(0, until - time.monotonic()))[0]:
        part = os.read(file, 4096)
        if not part:
            break
        text += part
    return text.decode(errors="replace").partition("\n")[0].strip()
