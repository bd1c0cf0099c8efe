"""Programs that are forks of an interpreter which has imported the package already: importing it costs half a second.

Streams, signals, exit and tracebacks of each are its own. What imports do is not to be tested this way, nor what an
environment variable has decided when they are done. Where Linux's `fork` is missing, each is started like any other.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import types
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import IO, Any

IMPORTED = ("urlab_client.aio.client", "urlab_client.cli", "urlab_client.server", "urlab_client.sync.client")


def program(
    source: str,
    *,
    flags: tuple[str, ...] = ("-W", "error"),
    cwd: Path | None = None,
    environment: Mapping[str, str] | None = None,
) -> Program | subprocess.Popen[str]:
    """Start a program, with pipes for its output and without input.

    Args:
        source: What `python -c` would be given.
        flags: Of the interpreter. Each set of them costs one interpreter more.
        cwd: Where it runs; default is here.
        environment: Default is that of this process.
    """
    if sys.platform == "linux":
        return Program(_interpreter(flags), source, cwd or Path.cwd(), environment or os.environ)
    streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [sys.executable, *flags, "-c", source]
    return subprocess.Popen(command, text=True, cwd=cwd, env=environment, **streams)


class Program:
    """A running program, with what tests need of `subprocess.Popen`."""

    def __init__(self, interpreter: Interpreter, source: str, cwd: Path, environment: Mapping[str, str]) -> None:
        reading, writing = zip(os.pipe(), os.pipe(), strict=True)
        self.stdout, self.stderr = map(os.fdopen, reading)
        self.returncode: int | None = None
        self._interpreter = interpreter
        order = {"source": source, "cwd": str(cwd), "environment": dict(environment)}
        self.pid = interpreter.start(order, list(writing))
        for end in writing:
            os.close(end)

    def send_signal(self, number: int) -> None:
        if self.returncode is None:
            os.kill(self.pid, number)

    def communicate(self, timeout: float) -> tuple[str, str]:
        """Wait for the end, and return what was not read yet; what outlives the timeout is killed."""
        watchdog = threading.Timer(timeout, self.send_signal, [signal.SIGKILL])
        watchdog.start()
        with self.stdout, self.stderr, ThreadPoolExecutor() as readers:
            out, err = readers.map(_rest, (self.stdout, self.stderr))
        self.returncode = self._interpreter.ended()
        watchdog.cancel()
        return out, err


def _rest(stream: IO[str]) -> str:
    return stream.read()


class Interpreter:
    """An interpreter that has imported the package and forks for each program, one at a time."""

    def __init__(self, flags: tuple[str, ...]) -> None:
        here, there = socket.socketpair()
        # Forks would lack the threads of linear algebra. The first test's mark would end it when that test fails.
        environment = {name: value for name, value in os.environ.items() if name != "URLAB_TEST_PROCESS"}
        self.process = subprocess.Popen(
            [sys.executable, *flags, __file__, str(there.fileno())],
            pass_fds=[there.fileno()],
            env=environment | {"OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        there.close()
        self._socket, self._answers = here, here.makefile("rb")
        self._running = 0
        atexit.register(self.end)

    def start(self, order: Mapping[str, Any], streams: list[int]) -> int:
        """Fork for a program and return its number; what a failed test has left there is ended."""
        self._end_program()
        socket.send_fds(self._socket, [b"\n"], streams)
        self._socket.sendall(json.dumps(order).encode() + b"\n")
        self._running = int(self._answers.readline())
        return self._running

    def ended(self) -> int:
        """Wait for the end of the program and return its exit code."""
        self._running = 0
        return int(self._answers.readline())

    def _end_program(self) -> None:
        if self._running:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._running, signal.SIGKILL)
            self.ended()

    def end(self) -> None:
        """End it, and a program that is left."""
        self._end_program()
        self._answers.close()
        self._socket.close()
        self.process.wait()


@functools.cache
def _interpreter(flags: tuple[str, ...]) -> Interpreter:
    return Interpreter(flags)


def forks(control: socket.socket) -> str | None:
    """Fork for each order until there are no more; return the program's source in a fork."""
    while True:
        received, streams, _, _ = socket.recv_fds(control, 1, 2)
        if not received:
            return None
        with control.makefile("rb") as lines:
            order = json.loads(lines.readline())
        pid = os.fork()
        for number, stream in enumerate(streams, 1):
            if pid == 0:
                os.dup2(stream, number)
            os.close(stream)
        if pid == 0:
            os.chdir(order["cwd"])
            os.environ.clear()
            os.environ.update(order["environment"])
            return order["source"]
        control.sendall(f"{pid}\n".encode())
        control.sendall(f"{os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])}\n".encode())


def as_main() -> dict[str, Any]:
    """Return the names of an empty program; its tracebacks begin with itself."""
    sys.argv, sys.path[0] = ["-c"], ""
    sys.modules["__main__"] = main = types.ModuleType("__main__")
    sys.excepthook = _show
    if "coverage" in sys.modules and (measuring := import_module("coverage").Coverage.current()) is not None:
        measuring.switch_context(os.environ.get("PYTEST_CURRENT_TEST", ""))
    return vars(main)


def _show(kind: type[BaseException], error: BaseException, trace: types.TracebackType | None) -> None:
    own = trace and trace.tb_next
    sys.__excepthook__(kind, error.with_traceback(own), own)


if __name__ == "__main__":
    for name in IMPORTED:
        import_module(name)
    gc.freeze()
    with socket.socket(fileno=int(sys.argv[1])) as orders:
        text = forks(orders)
    if text is not None:
        exec(compile(text, "<string>", "exec"), as_main())
