"""The `urlab` command in child processes, each with a deadline."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
from children import DEADLINE_S, child
from forked import COMMAND, Program, program

FREE_PORTS = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
GYMNASIUM_MODELS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


def urlab(
    *arguments: str | Path, cwd: Path, environment: Mapping[str, str] | None = None, **outputs: Any
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, with pipes where no other outputs are given."""
    if environment is None and not outputs:
        with program(COMMAND, *arguments, cwd=cwd) as process:
            out, err = process.communicate(timeout=DEADLINE_S)
        return subprocess.CompletedProcess(arguments, process.returncode or 0, out, err)
    return subprocess.run(
        [sys.executable, "-m", "urlab_client", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **(environment or {})},
        stdin=subprocess.DEVNULL,
        text=True,
        timeout=DEADLINE_S,
        check=False,
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **outputs},
    )


def refusal(done: subprocess.CompletedProcess[str]) -> str:
    """Return the one line on standard error of a command that ended with code 2 and said nothing else."""
    assert (done.returncode, done.stdout) == (2, ""), done
    (line,) = done.stderr.splitlines()
    return line


class Server:
    """A running `urlab serve`."""

    def __init__(self, process: Program | subprocess.Popen[str], first_line: str) -> None:
        self.process = process
        self.first_line = first_line

    @property
    def ready(self) -> dict[str, Any]:
        """The line of JSON."""
        return json.loads(self.first_line)

    @property
    def client_options(self) -> dict[str, Any]:
        """What a client needs."""
        ports = {f"{name}_port": self.ready[f"{name}_port"] for name in ("step", "state", "ctrl", "info")}
        return {"address": self.ready["address"], **ports}

    @property
    def rpc(self) -> str:
        """Address with the RPC port."""
        return f"{self.ready['address']}:{self.ready['step_port']}"

    def end(self, number: signal.Signals | None) -> tuple[int, str, str]:
        """Send a signal, or close standard input; return exit code and what came after the first line.

        On Windows, where no signal can be sent to another process, input is closed in any case.
        """
        if number is None or sys.platform == "win32":
            assert self.process.stdin is not None
            self.process.stdin.close()
            self.process.stdin = None
        else:
            self.process.send_signal(number)
        out, err = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, out, err


@contextlib.contextmanager
def served(*arguments: str | Path, cwd: Path, json: bool = True, inherits: bool = False) -> Generator[Server]:
    """Run `urlab serve` on free ports until the block ends; a fork does not inherit which signals are ignored."""
    options = [*FREE_PORTS, *(["--json"] if json else []), *(["--until-eof"] if sys.platform == "win32" else [])]
    command = ["serve", *options, *arguments]
    with child("-m", "urlab_client", *command, cwd=cwd) if inherits else program(COMMAND, *command, cwd=cwd) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        line = process.stdout.readline()
        assert line, process.stderr.read()
        server = Server(process, line)
        yield server
        if process.returncode is None:
            server.end(signal.SIGTERM)
