"""What the generators share: the pinned ruff, writing what changed, and `--check`."""

from __future__ import annotations

import argparse
import ast
import functools
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import textwrap
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent


class Refused(Exception):
    """What the tool was given cannot be generated from; the message says where and why."""


class Source:
    """A Python file: its tree, its classes, what it assigns, and the text of each node."""

    def __init__(self, path: Path) -> None:
        text = path.read_bytes()
        self._lines = text.splitlines(keepends=True)
        self.tree = ast.parse(text, str(path))
        self.classes = {node.name: node for node in self.tree.body if isinstance(node, ast.ClassDef)}
        self.assignments: dict[str, ast.expr] = {}
        for node in self.tree.body:
            match node:
                case (
                    ast.Assign(targets=[ast.Name(id=name)], value=value)
                    | ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value)
                ):
                    self.assignments[name] = value
                case _:
                    pass

    def segment(self, node: ast.expr | ast.stmt) -> str:
        """Return the text of a node; `ast.get_source_segment` splits the whole file for each."""
        assert node.end_lineno is not None  # noqa: S101
        lines = self._lines[node.lineno - 1 : node.end_lineno]
        lines[-1] = lines[-1][: node.end_col_offset]
        lines[0] = lines[0][node.col_offset :]
        return b"".join(lines).decode()

    def line(self, number: int) -> str:
        """Return a line, counted from 1."""
        return self._lines[number - 1].decode()


def main(
    tool: str,
    argv: Sequence[str] | None,
    render: Callable[[], Mapping[Path, str]],
    *,
    present: Iterable[Path] = (),
    shown: Path = REPOSITORY,
) -> int:
    """Run a generator's command line; return its exit code.

    Args:
        tool: File name of the generator.
        argv: Arguments; None takes those of the process.
        render: Returns the text of each generated file.
        present: Files that an earlier run generated: those that are not rendered any more are removed.
        shown: Folder that the paths in messages are relative to.
    """
    parser = argparse.ArgumentParser(description=(sys.modules[render.__module__].__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if something is stale")
    check: bool = parser.parse_args(argv).check
    try:
        files = render()
    except Refused as error:
        print(error, file=sys.stderr)
        return 1
    changed = False
    for path in sorted({*files, *present}):
        new = files[path].encode() if path in files else None
        old = path.read_bytes() if path.exists() else None
        if new == old:
            continue
        changed = True
        name = path.relative_to(shown).as_posix() if path.is_relative_to(shown) else str(path)
        if check:
            state = "orphan: no source produces it" if new is None else "missing" if old is None else "stale"
            print(f"{name}: {state}", file=sys.stderr)
        elif new is None:
            path.unlink()
            print(f"removed {name}")
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(new)
            print(f"wrote {name}")
    if check and changed:
        print(f"run: python tools/{tool}", file=sys.stderr)
    return 1 if check and changed else 0


def tidied(files: Mapping[Path, str], root: Path, package: str) -> dict[Path, str]:
    """Return modules without unused imports, sorted and formatted; refuse what the project's rules refuse.

    Args:
        files: Text of each module, all of them below `root`.
        root: Folder that the paths in messages are relative to.
        package: Name of the package whose imports are its own.
    """
    command = _ruff()
    with tempfile.TemporaryDirectory() as folder:
        copies = {path: Path(folder, path.relative_to(root)) for path in files}
        for path, copy in copies.items():
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text(files[path], encoding="utf-8", newline="\n")
        settings = ["--no-cache", "--config", str(REPOSITORY / "pyproject.toml")]
        settings += ["--config", f"lint.isort.known-first-party = ['{package}']", *map(str, copies.values())]
        for arguments in (
            ["check", "--fix-only", "--select", "F401,I,TC005", "--quiet"],
            ["format", "--quiet"],
            # Only the generated modules of a package are here: INP001 would miss its other files.
            ["check", "--quiet", "--output-format", "concise", "--ignore", "INP001"],
        ):
            done = subprocess.run(  # noqa: S603 - the command is ours
                [*command, *arguments, *settings], capture_output=True, text=True, check=False, cwd=folder
            )
            if done.returncode != 0:
                problems = textwrap.indent((done.stdout + done.stderr).strip(), "  ")
                raise Refused(f"what was generated does not pass ruff {arguments[0]}; correct its source:\n{problems}")
        return {path: copy.read_text(encoding="utf-8") for path, copy in copies.items()}


@functools.cache
def _ruff() -> list[str]:
    """Return the command of the ruff that the project pins: another one formats otherwise."""
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pins = [line for lines in extras["optional-dependencies"].values() for line in lines if line.startswith("ruff==")]
    pin = pins[0].partition("==")[2]
    for command in ([str(Path(sysconfig.get_path("scripts"), "ruff"))], [shutil.which("ruff") or "ruff"]):
        try:
            answer = subprocess.run([*command, "--version"], capture_output=True, text=True, check=False)  # noqa: S603
        except OSError:
            continue
        if answer.stdout.split() == ["ruff", pin]:
            return command
    raise Refused(f"ruff {pin} is needed here: pip install ruff=={pin}")
