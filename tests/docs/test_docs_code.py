"""The code on the documentation's pages runs, and prints what the pages say."""

from __future__ import annotations

import doctest
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from pages import ROOT, Block, blocks, commands, pages, shown

DEADLINE_S = 100
LANGUAGES = {"python", "console", "sh", "text", "xml", "json"}

# Runs the blocks of a page as one program; a separator tells their outputs apart. Tracebacks name the page's lines.
DRIVER = r"""
import json, sys
page, blocks = json.load(sys.stdin)
namespace = {"__name__": "__main__"}
for line, code in blocks:
    exec(compile("\n" * (line - 1) + code, page, "exec"), namespace)
    print("\x1e", end="", flush=True)
"""


def python_blocks(page: Path) -> list[Block]:
    return [block for block in blocks(page) if block.language == "python" and not block.directive]


def assert_output(block: Block, got: str) -> None:
    """Compare what a block printed with what the page shows; `...` there stands for anything."""
    if block.output is None:
        return
    checker, flags = doctest.OutputChecker(), doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    if not checker.check_output(block.output, got, flags):
        difference = checker.output_difference(doctest.Example(block.code, block.output), got, flags)
        pytest.fail(f"{block}: {difference}", pytrace=False)


@pytest.mark.parametrize("page", [page for page in pages() if python_blocks(page)], ids=shown)
def test_python_blocks_run(page: Path, tmp_path: Path) -> None:
    chosen = python_blocks(page)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", DRIVER],
        input=json.dumps([str(page), [(block.line, block.code) for block in chosen]]),
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, ""), f"{shown(page)}\n{done.stdout}\n{done.stderr}"
    for block, got in zip(chosen, done.stdout.split("\x1e"), strict=False):
        assert_output(block, got)


def marked(directive: str) -> list[Block]:
    return [block for page in pages() for block in blocks(page) if block.directive == directive]


@pytest.mark.parametrize("block", marked("run"), ids=str)
def test_marked_console_blocks_run(block: Block, tmp_path: Path) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    script = "\n".join(["set -e", *commands(block)])
    done = subprocess.run(
        ["bash", "-c", script],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
    )
    assert (done.returncode, done.stderr) == (0, ""), f"{block}\n{done.stdout}\n{done.stderr}"
    expected = "".join(f"{line}\n" for line in block.code.splitlines() if not line.startswith("$ "))
    assert_output(Block(block.page, block.line, "console", block.code, output=expected), done.stdout)


@pytest.mark.parametrize("page", sorted({block.page for block in marked("test")}), ids=shown)
def test_marked_tests_pass(page: Path, tmp_path: Path) -> None:
    for block in marked("test"):
        if block.page == page:
            # So that a failure names the page's line.
            (tmp_path / f"test_line_{block.line}.py").write_text("\n" * (block.line - 1) + block.code, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nasyncio_default_fixture_loop_scope = function\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "pytest_urlab", "--strict-markers", "-W", "error", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 0, f"{shown(page)}\n{done.stdout}\n{done.stderr}"


def test_something_runs() -> None:
    assert {shown(page) for page in pages() if python_blocks(page)} >= {"README.md", "docs/quickstart.md"}
    assert marked("run")


@pytest.mark.parametrize("page", pages(), ids=shown)
def test_blocks_are_of_a_known_language(page: Path) -> None:
    assert {block.language for block in blocks(page)} <= LANGUAGES


@pytest.mark.parametrize("page", pages(), ids=shown)
def test_commands_are_understood(page: Path) -> None:
    from urlab_client.cli import _parser

    for block in blocks(page):
        if block.language not in {"console", "sh"}:
            continue
        for command in commands(block):
            words = shlex.split(command.removesuffix("&"))
            if words[:1] == ["urlab"]:
                try:
                    _parser().parse_args(words[1:])
                except SystemExit as end:
                    pytest.fail(f"{block}: {command}: exit code {end.code}", pytrace=False)


def test_the_set_up_lines_stand_in_the_readme_word_for_word() -> None:
    # Other documents and `.ci/run` quote these lines.
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    for line in (
        "python3 -m venv .venv && .venv/bin/pip install -e '.[demo]' && .venv/bin/urlab demo",
        "uv run --extra demo urlab demo",
        "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/python -m pytest",
    ):
        assert lines.count(line) == 1
