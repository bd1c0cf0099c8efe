"""Run the commands of a page as its reader would: in one folder, servers in the background until the page ends."""

from __future__ import annotations

import doctest
import os
import re
import select
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from pages import ROOT, Block
from ports import free_port

DEADLINE_S = 240

NOT_RUN = {
    r"(python3 -m venv|uv run|\S*pip install|trial/bin/)": "sets an environment up from an index: .ci/run begins "
    "with the README's line, and tests/packaging installs the wheel",
    r"git clone ": "fetches the repository, in which this runs",
    r"python3 -m pip wheel": "fetches the build backend: tests/packaging builds the wheel with the one installed",
    r"\.venv/bin/python -m pytest$": "is this run",
    r"\.venv/bin/python -m pytest tests/protocol/test_registry.py ": "test_docs_adding_an_op.py runs it in a copy",
    r"\.venv/bin/python tools/sample_mutants\.py": "takes hours: tests/tools/test_sample_mutants.py runs its parts",
    r"(\.venv/bin/python|python3) tools/gen_": "writes to the repository: test_docs_adding_an_op.py does it in a copy",
    r"(ssh|scp) ": "goes to a second machine",
    r"urlab console( tcp://10\..*)?$": "goes to an editor",
    r"urlab (conformance|tap)\b": "goes to an editor: tests/conformance and tests/cli run both",
    r"pytest tests/conformance --address": "goes to an editor",
    r"urlab mcp ": "tests/mcp run it",
    r"(uvicorn service:backend|curl -s localhost:8000/)": "test_docs_tutorials.py serves and asks it",
    r"uvicorn fastapi_backend:app": "tests/examples/test_fastapi_backend.py serves it",
    r"(python examples/clone_behaviour.py|urlab (evaluate|run-policy) clone/)": "takes long: "
    "tests/examples/test_clone_behaviour.py runs its short form",
    r"(python examples/push_by_sight.py|urlab evaluate \S*push.onnx)": "takes minutes, and PyTorch: "
    "tests/integrations/test_evaluate.py evaluates a network that sees pictures",
    r"(python examples/train_walk.py|urlab (evaluate|run-policy) walk/|python tools/walk_figures.py)": "takes minutes: "
    "tools/check_learning.py trains for a moment, and tests/integrations/test_walk.py walks",
    r"urlab teleop ": "takes keys from a terminal",
    r".* --python lerobot-env/": "needs LeRobot, which has an environment of its own",
    r"(KEY=\$\()?curl ": "test_docs_console.py makes these requests",
}
"""Commands that do not run here, as the beginning of a command: why not, or what runs it instead."""

SERVERS = r"urlab (serve|console)\b"
"""Commands that go on until they are interrupted."""

PORTS = {"--step-port": 5559, "--state-port": 5555, "--ctrl-port": 5556, "--info-port": 5557, "--camera-port": 5558}
HOSTS = "localhost|127.0.0.1|lab-server"
"""Where the pages' servers are. Here each has free ports of this machine, so that runs do not meet."""

MODEL = '<mujoco model="{0}"><worldbody><body><freejoint/><geom name="{0}" size="0.1"/></body></worldbody></mujoco>'

LEVEL = """
{"format": "urlab-level", "version": 1, "blueprints": {}, "actors": [
  {"name": "Manager", "kind": "manager"},
  {"name": "Box", "kind": "static_mesh", "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1]}, "quick_convert": {}}
]}
"""


def reason(command: str) -> str | None:
    """Return why a command does not run here."""
    return next((why for pattern, why in NOT_RUN.items() if re.match(pattern, command)), None)


def steps(block: Block) -> list[tuple[str, str]]:
    """Return the commands of a `console` or `sh` block, each with the output that the page shows below it."""
    lines = re.sub(r"\\\n *", "", block.code).splitlines()
    if block.language == "sh":
        return [(line, "") for line in lines if line and not line.startswith("#")]
    found: list[tuple[str, str]] = []
    for line in lines:
        if line.startswith("$ "):
            found.append((line.removeprefix("$ "), ""))
        else:
            command, output = found.pop()
            found.append((command, f"{output}{line}\n"))
    return found


def same(expected: str, got: str) -> str:
    """Return how an output differs from the page's, where `...` and `…` stand for anything; empty if it does not."""
    wanted, checker = expected.replace("…", "..."), doctest.OutputChecker()
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    if checker.check_output(wanted, got, flags):
        return ""
    return checker.output_difference(doctest.Example("", wanted), got, flags)


@dataclass
class Server:
    """A program in the background."""

    command: str
    process: subprocess.Popen[str]

    def first_output(self) -> str:
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], DEADLINE_S)
        assert ready, f"{self.command}: not a word within {DEADLINE_S} s"
        return self.process.stdout.readline()

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        _, errors = self.process.communicate(timeout=DEADLINE_S)
        assert self.process.returncode == 0, f"{self.command}: exit code {self.process.returncode}\n{errors}"
        assert "Traceback" not in errors, f"{self.command}\n{errors}"


class Shell:
    """A folder and what runs in it.

    Args:
        folder: Where the commands run; below it lies their home, which the pages call `/home/ada`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.root = folder / "machine"
        self.home = self.root / "home" / "ada"
        self.home.mkdir(parents=True)
        self.ports: dict[str, int] = {}
        self.server: Server | None = None
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
        self.environment = {**os.environ, "PATH": path, "HOME": str(self.home)}

    def provide(self, command: str) -> None:
        """Put there what a command reads and the reader has: MJCF files, a level, the examples of a clone."""
        if " examples/" in command:
            shutil.copytree(ROOT / "examples", self.folder / "examples", dirs_exist_ok=True)
        for name in re.findall(r"(?<![\w/.-])(\w+)\.xml\b", command):
            if not (self.folder / f"{name}.xml").exists():  # which the page's program may have written
                (self.folder / f"{name}.xml").write_text(MODEL.format(name), encoding="utf-8")
        for name in re.findall(r"(?<![\w/.-])\w+\.json\b", command):
            if not (self.folder / name).exists():
                (self.folder / name).write_text(LEVEL, encoding="utf-8")

    def run(self, command: str) -> str:
        """Run a command and return what it printed; of one that goes on, its first line.

        Raises:
            AssertionError: It failed, or said something on standard error.
        """
        self.provide(command)
        background = re.match(SERVERS, command) is not None
        command = self.with_own_ports(command.removesuffix("&").strip())
        if background:
            self.close()
            process = subprocess.Popen(
                ["bash", "-c", f"exec {command}"],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                cwd=self.folder,
                env=self.environment,
            )
            self.server = Server(command, process)
            return self.as_on_the_page(self.server.first_output())
        done = subprocess.run(
            ["bash", "-c", command],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
            cwd=self.folder,
            env=self.environment,
        )
        assert (done.returncode, done.stderr) == (0, ""), f"{command}\n{done.stdout}\n{done.stderr}"
        return self.as_on_the_page(done.stdout)

    def with_own_ports(self, command: str) -> str:
        if re.match(r"urlab serve\b", command):
            self.ports = {option: free_port() for option in PORTS if option not in command}
            command = " ".join([command, *(f"{option} {port}" for option, port in self.ports.items())])
        elif "--step-port" in self.ports:
            address = f"tcp://127.0.0.1:{self.ports['--step-port']}"
            command = re.sub(rf"tcp://({HOSTS})\b", address, command)
        if re.match(r"urlab console\b", command):
            self.ports["--port"] = free_port()
            command = f"{command} --port {self.ports['--port']}"
        return command

    def as_on_the_page(self, text: str) -> str:
        for option, port in self.ports.items():
            text = text.replace(str(port), str({**PORTS, "--port": 8355}[option]))
        return text.replace(str(self.root), "")

    def close(self) -> None:
        """End the server in the background; a reader whose next one wants the same ports does so, too."""
        server, self.server = self.server, None
        if server is not None:
            server.end()

    def abandon(self) -> None:
        """End what a failure left running, whatever it says."""
        if self.server is not None:
            self.server.process.kill()
            self.server.process.communicate()
