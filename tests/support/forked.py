"""Programs that are forks of an interpreter which has imported the package already: importing it costs half a second.

Streams, signals, exit and tracebacks of each are its own. What imports do is not to be tested this way, nor what an
environment variable has decided when they are done. Where Linux's `fork` is missing, each is started like any other.
"""

from __future__ import annotations

import atexit
import contextlib
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
from typing import IO, Any, Self

IMPORTED = ("urlab_client.aio.client", "urlab_client.cli", "urlab_client.server", "urlab_client.sync.client")

COMMAND = "import sys; from urlab_client.cli import main; sys.exit(main())"
"""The program `urlab`."""


def program(
    source: str,
    *arguments: str | Path,
    flags: tuple[str, ...] = ("-W", "error"),
    cwd: Path | None = None,
    environment: Mapping[str, str] | None = None,
) -> Program | subprocess.Popen[str]:
    """Start a program with pipes.

    Args:
        source: What `python -c` would be given.
        arguments: Of the program.
        flags: Of the interpreter. Each set of them costs one interpreter more.
        cwd: Where it runs; default is here.
        environment: Default is that of this process.
    """
    if sys.platform == "linux":
        order = {
            "source": source,
            "arguments": [*map(str, arguments)],
            "cwd": str(cwd or Path.cwd()),
            "environment": dict(environment or os.environ),
        }
        return Program(_interpreter(flags), order)
    command = [sys.executable, *flags, "-c", source, *map(str, arguments)]
    return subprocess.Popen(command, text=True, cwd=cwd, env=environment, **_pipes())


def _pipes() -> dict[str, Any]:
    return dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)


class Program:
    """A running program, with what tests need of `subprocess.Popen`."""

    def __init__(self, interpreter: Interpreter, order: Mapping[str, Any]) -> None:
        ins, outs, errs = os.pipe(), os.pipe(), os.pipe()
        self.stdin: IO[str] | None = os.fdopen(ins[1], "w")
        self.stdout, self.stderr = os.fdopen(outs[0]), os.fdopen(errs[0])
        self.returncode: int | None = None
        self._interpreter = interpreter
        its = [ins[0], outs[1], errs[1]]
        self.pid = interpreter.start(order, its)
        for end in its:
            os.close(end)

    def send_signal(self, number: int) -> None:
        if self.returncode is None:
            os.kill(self.pid, number)

    def communicate(self, timeout: float) -> tuple[str, str]:
        """Close its input, wait for the end, and return what was not read yet; what outlives the timeout is killed."""
        if self.stdin is not None:
            self.stdin.close()
        watchdog = threading.Timer(timeout, self.send_signal, [signal.SIGKILL])
        watchdog.start()
        with self.stdout, self.stderr, ThreadPoolExecutor() as readers:
            out, err = readers.map(_rest, (self.stdout, self.stderr))
        self.returncode = self._interpreter.ended()
        watchdog.cancel()
        return out, err

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.returncode is None:
            self.send_signal(signal.SIGKILL)
            self.communicate(60)


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
            start_new_session=True,
            **_pipes(),  # whose kind its streams keep in forks
        )
        there.close()
        self._socket, self._answers = here, here.makefile("rb")
        self.running = 0
        atexit.register(self.end)

    def start(self, order: Mapping[str, Any], streams: list[int]) -> int:
        """Fork for a program and return its number."""
        socket.send_fds(self._socket, [b"\n"], streams)
        self._socket.sendall(json.dumps(order).encode() + b"\n")
        answer = self._answers.readline()
        assert answer, self.process.communicate()
        self.running = int(answer)
        return self.running

    def ended(self) -> int:
        """Wait for the end of the program and return its exit code."""
        self.running = 0
        return int(self._answers.readline())

    def end(self) -> None:
        """End it, and a program that a failed test has left."""
        if self.running:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.running, signal.SIGKILL)
            self.ended()
        self._answers.close()
        self._socket.close()
        self.process.communicate()


_INTERPRETERS: dict[tuple[str, ...], list[Interpreter]] = {}


def _interpreter(flags: tuple[str, ...]) -> Interpreter:
    """Return an interpreter that has nothing to wait for."""
    known = _INTERPRETERS.setdefault(flags, [])
    free = [one for one in known if not one.running]
    if not free:
        known.append(Interpreter(flags))
    return free[0] if free else known[-1]


def forks(control: socket.socket) -> dict[str, Any] | None:
    """Fork for each order until there are no more; return the order in a fork."""
    while True:
        received, streams, _, _ = socket.recv_fds(control, 1, 3)
        if not received:
            return None
        with control.makefile("rb") as lines:
            order = json.loads(lines.readline())
        pid = os.fork()
        for number, stream in enumerate(streams):
            if pid == 0:
                os.dup2(stream, number)
            os.close(stream)
        if pid == 0:
            os.chdir(order["cwd"])
            os.environ.clear()
            os.environ.update(order["environment"])
            return order
        control.sendall(f"{pid}\n".encode())
        control.sendall(f"{os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])}\n".encode())


def as_main(arguments: list[str]) -> dict[str, Any]:
    """Return the names of an empty program; its tracebacks begin with itself."""
    sys.argv, sys.path[0] = ["-c", *arguments], ""
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
        order = forks(orders)
    if order is not None:
        exec(compile(order["source"], "<string>", "exec"), as_main(order["arguments"]))
