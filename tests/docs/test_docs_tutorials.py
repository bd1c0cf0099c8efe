"""Each tutorial runs as written: command by command, where only the extras that it names are installed."""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
import urllib.error
import urllib.request
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pages import ROOT, Block, blocks, shown
from ports import free_port
from shell import DEADLINE_S, same, steps

TUTORIALS = [page for page in sorted((ROOT / "docs" / "tutorials").glob("*.md")) if page.stem != "index"]

PICTURES = {"cameras"}

# Runs one block after the other in one namespace, as a reader's session would.
SESSION = """
import json, sys
names = {"__name__": "__main__"}
for line in sys.stdin:
    first, code, page = json.loads(line)
    exec(compile("\\n" * (first - 1) + code, page, "exec"), names)
    print("\\x1e", flush=True)
"""


class Reader:
    """Somebody who follows a page in an empty folder, with an empty virtual environment."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "work"
        self.folder.mkdir()
        self.programs = folder / "environment" / ("Scripts" if os.name == "nt" else "bin")
        venv.create(self.programs.parent, with_pip=True, symlinks=os.name != "nt")
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL"))}
        path = os.pathsep.join([str(self.programs), os.environ.get("PATH", os.defpath)])
        self.environment = {**kept, "PATH": path, "PIP_NO_COMPILE": "1"}
        self.port = free_port()
        self.running: list[subprocess.Popen[str]] = []
        self.session: subprocess.Popen[str] | None = None

    def python(self, block: Block) -> str:
        """Run a block in the session and return what it printed."""
        if self.session is None:
            self.session = self.start([str(self.programs / "python"), "-c", SESSION])
        assert self.session.stdin is not None and self.session.stdout is not None  # noqa: PT018 - for the type checker
        self.session.stdin.write(json.dumps([block.line, block.code, shown(block.page)]) + "\n")
        self.session.stdin.flush()
        said: list[str] = []
        for line in self.session.stdout:
            if line.startswith("\x1e"):
                return "".join(said)
            said.append(line)
        pytest.fail(f"{block} failed:\n{''.join(said)}", pytrace=False)

    def shell(self, command: str) -> str:
        """Run a command and return what it printed; one that serves goes on in the background."""
        command = re.sub(r"-e '\.(\[.*\])'", rf"'{ROOT}\1'", command).replace("install -e .", f"install '{ROOT}'")
        command = command.replace("localhost:8000", f"localhost:{self.port}")
        if command.startswith("uvicorn "):
            self.start(["bash", "-c", f"exec {command} --port {self.port}"])
            self.wait_for_server()
            return ""
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=2 * DEADLINE_S,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def start(self, command: list[str]) -> subprocess.Popen[str]:
        self.running.append(
            subprocess.Popen(
                command,
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
        )
        return self.running[-1]

    def wait_for_server(self) -> None:
        until = time.monotonic() + DEADLINE_S
        while True:
            try:
                with urllib.request.urlopen(f"http://localhost:{self.port}/", timeout=DEADLINE_S):
                    return
            except urllib.error.URLError:
                assert self.running[-1].poll() is None, self.running[-1].communicate()[0]
                assert time.monotonic() < until, "the server does not answer"


@contextmanager
def reading(folder: Path) -> Iterator[Reader]:
    reader = Reader(folder)
    try:
        yield reader
    finally:
        for process in reader.running:
            process.terminate()
            process.communicate(timeout=DEADLINE_S)


@pytest.mark.long
@pytest.mark.timeout(6 * DEADLINE_S)
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, id=page.stem, marks=[pytest.mark.opengl] * (page.stem in PICTURES)) for page in TUTORIALS],
)
def test_the_tutorial_runs_as_written(page: Path, tmp_path: Path) -> None:
    with reading(tmp_path) as reader:
        for block in blocks(page):
            if block.directive.startswith("file: "):
                (reader.folder / block.directive.removeprefix("file: ")).write_text(block.code, encoding="utf-8")
                continue
            done = [(block.output, reader.python(block))] if block.language == "python" else []
            if block.language in {"sh", "console"}:
                done = [(output, reader.shell(command)) for command, output in steps(block)]
            for wanted, got in done:
                if wanted and (difference := same(wanted, got)):
                    pytest.fail(f"{block}: {difference}", pytrace=False)


def test_every_tutorial_says_what_to_install() -> None:
    for page in TUTORIALS:
        first = blocks(page)[0]
        assert first.code.startswith("pip install -e "), f"{first}: the tutorial begins with what it needs"
