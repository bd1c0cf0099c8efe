"""Programs that are forked from a Python which has imported what most of them import.

Starting Python with NumPy, MuJoCo and the package takes longer than what the programs of the documentation do. Who tests
the start itself, or sends signals, starts a process.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

__all__ = ["run_python"]

MODULES = ("mujoco", "urlab_client.aio", "urlab_client.cli", "urlab_client.server", "urlab_client.sync")


def run_python(
    arguments: Sequence[str | Path],
    *,
    cwd: Path,
    timeout: float,
    environment: Mapping[str, str] | None = None,
    text: str = "",
) -> subprocess.CompletedProcess[str]:
    """Run `python -W error ARGUMENTS` to its end.

    Args:
        arguments: `-m` and a module, `-c` and code, or a file; then what the program is given.
        cwd: Folder to run in.
        timeout: Seconds after which it is killed.
        environment: Its environment; default this process's.
        text: Standard input.

    Raises:
        subprocess.TimeoutExpired: It ran for longer.
    """
    words = [*map(str, arguments)]
    environment = dict(os.environ if environment is None else environment)
    if sys.platform != "linux":  # where forking is not for everything that was imported
        return subprocess.run(
            [sys.executable, "-W", "error", *words],
            input=text,
            cwd=cwd,
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
    with tempfile.TemporaryDirectory() as folder:
        files = [os.path.join(folder, name) for name in ("in", "out", "err")]  # noqa: PTH118
        Path(files[0]).write_text(text, encoding="utf-8")
        job = {"arguments": words, "cwd": str(cwd), "environment": environment, "files": files}
        code = _parent().run(job, timeout)
        output, errors = (Path(name).read_text(encoding="utf-8") for name in files[1:])
    return subprocess.CompletedProcess(words, code, output, errors)


class _Parent:
    """The Python that the programs are forked from."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-W", "error", __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            # A process with threads had better not be forked.
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        atexit.register(self._process.communicate)

    def run(self, job: dict[str, Any], timeout: float) -> int:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        child = int(self._process.stdout.readline())
        late = not select.select([self._process.stdout], [], [], timeout)[0]
        if late:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        code = int(self._process.stdout.readline())
        if late:
            raise subprocess.TimeoutExpired(job["arguments"], timeout)
        return code


_parent = cache(_Parent)


def _serve() -> dict[str, Any] | None:
    """Fork for each job; return the job in its child, None in the end."""
    for name in MODULES:
        importlib.import_module(name)
    gc.freeze()
    while line := sys.stdin.readline():
        child = os.fork()
        if child == 0:
            return json.loads(line)
        print(child, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
    return None


def _become(job: dict[str, Any]) -> None:
    """Run a program as Python does."""
    os.chdir(job["cwd"])
    os.environ.clear()
    os.environ.update(job["environment"])
    for number, (name, flags) in enumerate(
        zip(job["files"], (os.O_RDONLY, *[os.O_WRONLY | os.O_CREAT] * 2), strict=True)
    ):
        file = os.open(name, flags, 0o600)
        os.dup2(file, number)
        os.close(file)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - the program's, to its end
    first, *sys.argv = job["arguments"]
    sys.path[0] = ""
    match first:
        case "-m":
            runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
        case "-c":
            code, sys.argv[0] = sys.argv[0], "-c"
            exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
        case _:
            sys.argv.insert(0, first)
            sys.path[0] = os.path.dirname(os.path.abspath(first))  # noqa: PTH100, PTH120
            runpy.run_path(first, run_name="__main__")


if __name__ == "__main__" and (chosen := _serve()) is not None:
    _become(chosen)
