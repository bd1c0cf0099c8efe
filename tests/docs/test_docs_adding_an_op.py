"""The walkthrough `docs/adding-an-op.md`, done as written in a copy of the repository."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

import pytest
from pages import ROOT, Block, blocks
from test_docs_code import assert_output

PAGE = ROOT / "docs" / "adding-an-op.md"
TOOLS = ("gen_ops.py", "gen_sync.py", "gen_docs.py")


def of(kind: str) -> list[Block]:
    return [block for block in blocks(PAGE) if block.directive.partition(":")[0] == kind]


def run(tree: Path, arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree / "src")},
    )


def apply(tree: Path, block: Block) -> None:
    kind, _, rest = block.directive.partition(": ")
    name, before, anchor = rest.partition(" before: ")
    if not before:
        name, _, anchor = rest.partition(" after: ")
    path = tree / name
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    where, gap = len(lines), "\n\n" if path.suffix == ".py" else ""
    if kind == "insert":
        (where,), gap = [number for number, line in enumerate(lines, 0 if before else 1) if line.strip() == anchor], ""
    end = "\n\n" if before and block.code.startswith("class ") else ""
    path.write_text("".join([*lines[:where], gap, block.code, end, *lines[where:]]), encoding="utf-8")


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the repository after all edits, with everything generated."""
    copy = tmp_path_factory.mktemp("walkthrough")
    for folder in ("src", "tools", "docs", "tests/data", "tests/protocol", "tests/server", "tests/support"):
        shutil.copytree(ROOT / folder, copy / folder)  # with bytecode, so that only what changes is compiled
    shutil.copy(ROOT / "pyproject.toml", copy)
    for block in blocks(PAGE):
        if block.directive.startswith(("append:", "insert:")):
            apply(copy, block)
    for tool in TOOLS:
        stale = run(copy, [f"tools/{tool}", "--check"])
        assert stale.returncode == 1, f"{tool} --check does not notice the new op: {stale.stderr}"
        written = run(copy, [f"tools/{tool}"])
        assert written.returncode == 0, written.stderr
    return copy


def test_the_page_has_all_kinds_of_steps() -> None:
    assert {kind: len(of(kind)) for kind in ("append", "insert", "shows", "use")} == {
        "append": 2,
        "insert": 2,
        "shows": 2,
        "use": 1,
    }
    commands = "".join(block.code for block in blocks(PAGE) if block.language == "console" and not block.directive)
    assert [line.rpartition("/")[2] for line in commands.splitlines()] == list(TOOLS)


@pytest.mark.parametrize("block", of("shows"), ids=str)
def test_generated_code_is_as_shown(tree: Path, block: Block) -> None:
    file = tree / block.directive.partition(": ")[2]
    assert block.code in file.read_text(encoding="utf-8")


def test_the_op_works_in_both_flavours(tree: Path) -> None:
    (block,) = of("use")
    asynchronous = """
        print("and")

        import asyncio
        from urlab_client.aio import URLabClient

        async def main():
            async with URLabClient("sim://ball") as client:
                await client.discover()
                print(await client.runtime.get_mass("ball"))

        asyncio.run(main())
    """
    done = run(tree, ["-W", "error", "-c", block.code + textwrap.dedent(asynchronous)])
    assert (done.returncode, done.stderr) == (0, "")
    printed, _, awaited = done.stdout.partition("and\n")
    assert_output(block, printed)
    assert awaited == "1.0\n"


def test_meta_and_the_reference_have_their_row(tree: Path) -> None:
    reference = (tree / "docs" / "reference" / "ops-runtime.md").read_text(encoding="utf-8")
    row = next(line for line in reference.splitlines() if line.startswith("| [`get_mass`]("))
    assert "`get_mass()`" in row
    assert "| play | read |" in row


def test_the_tests_that_the_page_names_pass(tree: Path) -> None:
    (block,) = of("tests")
    files = block.code.split("-m pytest ")[1].split()
    done = run(tree, ["-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *files])
    assert done.returncode == 0, done.stdout


def test_what_is_written_passes_the_linter(tree: Path) -> None:
    done = run(tree, ["-m", "ruff", "check", "--no-cache", "src"])
    assert done.returncode == 0, done.stdout
    done = run(tree, ["-m", "ruff", "format", "--no-cache", "--check", "src"])
    assert done.returncode == 0, done.stdout
