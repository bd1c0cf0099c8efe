"""The code on the documentation's pages runs, and prints what the pages say."""

from __future__ import annotations

import json
import os
import re
import secrets
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from forked import program
from pages import ROOT, Block, blocks, pages, shown
from shell import DEADLINE_S, NOT_RUN, Shell, reason, same, steps

SHELL = {"console", "sh"}
READ = {"json": json.loads, "toml": tomllib.loads, "xml": ET.fromstring}
"""Languages of blocks that do nothing but must be well formed."""

SERVICES = {"dockerfile", "ini", "nginx"}
"""Languages of the blocks that `tests/web/test_console_in_production.py` runs or reads."""

LONG = {
    "README.md",
    "docs/console-api.md",
    "docs/console.md",
    "docs/environments-many.md",
    "docs/environments.md",
    "docs/howto/agents.md",
    "docs/howto/cameras.md",
    "docs/howto/data.md",
    "docs/howto/keys.md",
    "docs/howto/moving.md",
    "docs/howto/observing.md",
    "docs/howto/rl.md",
    "docs/howto/scenes.md",
    "docs/howto/sessions.md",
    "docs/install.md",
    "docs/policies.md",
    "docs/quickstart.md",
    "docs/randomisation.md",
    "docs/recording-convert.md",
    "docs/recording-episodes.md",
    "docs/recording.md",
    "docs/reference/blocking.md",
    "docs/shared-memory.md",
    "docs/simulated-server-pictures.md",
    "docs/simulated-server.md",
    "docs/start.md",
    "docs/tasks-details.md",
    "docs/tasks.md",
    "docs/teleoperation.md",
}
"""Pages whose code takes several seconds."""

ELSEWHERE = {f"docs/tutorials/{page}.md" for page in ("cameras", "learning", "policy")}
"""Pages whose code takes several seconds, and which `test_docs_tutorials.py` runs as written."""

PICTURES = re.compile(r'include_cameras|\bcameras(=|": \[)|\.capture\(|\.frames\(|server\.snapshot\(|urlab snapshot')
"""In the code of pages that have pictures drawn."""

CANNOT_DRAW = re.compile(r"^camera images are left out: .*\n", re.MULTILINE)
"""What a server says that was asked for pictures which no code of the page needs."""

# Runs the blocks of a page as one program; a separator tells their outputs apart. Tracebacks name the page's lines.
DRIVER = r"""
for line, code in {}:
    exec(compile("\n" * (line - 1) + code, {page!r}, "exec"))
    print("\x1e", end="", flush=True)
"""


def python_blocks(page: Path, directive: str = "") -> list[Block]:
    return [block for block in blocks(page) if block.language == "python" and block.directive == directive]


def shell_steps(page: Path) -> list[tuple[Block, str, str]]:
    """Return the commands of a page that run here: block, command, output."""
    return [
        (block, command, output)
        for block in blocks(page)
        if block.language in SHELL
        for command, output in steps(block)
        if reason(command) is None
    ]


def assert_output(block: Block, got: str) -> None:
    """Compare what a block printed with what the page shows; `...` there stands for anything."""
    if block.output is not None and (difference := same(block.output, got)):
        pytest.fail(f"{block}: {difference}", pytrace=False)


def run_python(page: Path, chosen: list[Block], folder: Path, **environment: str) -> str:
    """Run blocks as one program, compare what they print, and return what it says on standard error."""
    source = DRIVER.format([(block.line, block.code) for block in chosen], page=str(page))
    running = program(
        source,
        cwd=folder,
        environment={**os.environ, **environment},
    )
    out, err = running.communicate(timeout=DEADLINE_S)
    assert running.returncode == 0, f"{shown(page)}\n{out}\n{err}"
    for block, got in zip(chosen, out.split("\x1e"), strict=False):
        assert_output(block, got)
    return err


def page_param(page: Path) -> Any:
    """Return a page as a parameter; what takes several seconds runs with the long tests."""
    code = [block.code for block in python_blocks(page)] + [command for _, command, _ in shell_steps(page)]
    marks = [pytest.mark.long] if shown(page) in LONG else []
    if any(PICTURES.search(block) for block in code):
        marks.append(pytest.mark.opengl)
    return pytest.param(page, id=shown(page), marks=marks)


@pytest.mark.parametrize(
    "page", [page_param(p) for p in pages() if shown(p) not in ELSEWHERE and (python_blocks(p) or shell_steps(p))]
)
def test_code_runs(page: Path, tmp_path: Path) -> None:
    # The commands come second, in the same folder, so that they find what the page's program has written.
    if chosen := python_blocks(page):
        assert CANNOT_DRAW.sub("", run_python(page, chosen, tmp_path)) == ""
    shell = Shell(tmp_path)
    try:
        for block, command, output in shell_steps(page):
            got = shell.run(command)
            if output and (difference := same(output, got)):
                pytest.fail(f"{block}: {command}: {difference}", pytrace=False)
        shell.close()
    finally:
        shell.abandon()


def marked(directive: str) -> list[Block]:
    return [block for page in pages() for block in blocks(page) if block.directive == directive]


@pytest.mark.ray
@pytest.mark.parametrize("page", sorted({block.page for block in marked("needs: ray")}), ids=shown)
def test_code_that_needs_ray_runs(page: Path, tmp_path: Path) -> None:
    token = secrets.token_hex(32)  # Ray would leave one in the home folder
    environment = {"RAY_AUTH_TOKEN": token, "RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
    run_python(page, python_blocks(page, "needs: ray"), tmp_path, **environment)


@pytest.mark.view
@pytest.mark.parametrize("page", sorted({block.page for block in marked("needs: view")}), ids=shown)
def test_code_that_needs_rerun_or_foxglove_runs(page: Path, tmp_path: Path) -> None:
    run_python(page, python_blocks(page, "needs: view"), tmp_path)


@pytest.mark.parametrize("page", sorted({block.page for block in marked("test")}), ids=shown)
def test_marked_tests_pass(page: Path, tmp_path: Path) -> None:
    for block in marked("test"):
        if block.page == page:
            # So that a failure names the page's line.
            (tmp_path / f"test_line_{block.line}.py").write_text("\n" * (block.line - 1) + block.code, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nasyncio_default_fixture_loop_scope = function\n", encoding="utf-8")
    imported = "ignore:Module already imported:pytest.PytestAssertRewriteWarning"
    arguments = ["-q", "-p", "pytest_urlab", "--strict-markers", "-W", "error", "-W", imported, str(tmp_path)]
    running = program(f"import sys, pytest\nsys.exit(pytest.main({arguments}))", cwd=tmp_path)
    out, err = running.communicate(timeout=DEADLINE_S)
    assert running.returncode == 0, f"{shown(page)}\n{out}\n{err}"


def every_block() -> Iterator[Block]:
    for page in pages():
        yield from blocks(page)


def test_something_runs() -> None:
    assert {shown(page) for page in pages() if python_blocks(page)} >= {"README.md", "docs/quickstart.md"}
    assert {shown(page) for page in pages() if shell_steps(page)} >= {"README.md", "docs/start.md"}


def test_no_block_is_left_out() -> None:
    # Walkthrough steps are the business of test_docs_adding_an_op.py; a text block below another is its output.
    for block in every_block():
        kind = block.directive.partition(":")[0]
        if block.language == "python":
            assert kind in {"", "test", "file", "needs", "use", "append", "insert", "shows"}, f"{block} does not run"
            assert kind != "needs" or block.directive in {"needs: ray", "needs: view"}, f"{block}: nothing runs it"
        elif block.language == "text":
            assert kind in {"as is", "append"}, f"{block} is nobody's output: say why, `<!-- as is: REASON -->`"
        else:
            elsewhere = SERVICES if block.page.name == "production.md" else set[str]()
            assert block.language in SHELL | set(READ) | elsewhere, f"{block}: {block.language or 'no language'}"


def test_what_does_not_run_is_still_there() -> None:
    commands = [command for block in every_block() if block.language in SHELL for command, _ in steps(block)]
    for pattern in NOT_RUN:
        assert any(re.match(pattern, command) for command in commands), f"no page has {pattern}: take it from NOT_RUN"


@pytest.mark.parametrize("block", [block for block in every_block() if block.language in READ], ids=str)
def test_files_are_well_formed(block: Block) -> None:
    READ[block.language](block.code)


@pytest.mark.parametrize("page", pages(), ids=shown)
def test_commands_are_understood(page: Path) -> None:
    from urlab_client.cli import _parser

    for block in blocks(page):
        for command, _ in steps(block) if block.language in SHELL else ():
            words = shlex.split(command.removesuffix("&"))
            if words[:1] == ["urlab"]:
                try:
                    _parser().parse_args(words[1:])
                except SystemExit as end:
                    pytest.fail(f"{block}: {command}: exit code {end.code}", pytrace=False)


def test_extras_that_pages_install_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for page in pages():
        for extras in re.findall(r"(?:urlab-client|-e '\.)\[([\w,-]+)\]", page.read_text(encoding="utf-8")):
            assert set(extras.split(",")) <= set(project["optional-dependencies"]), f"{shown(page)}: [{extras}]"


def test_the_set_up_lines_stand_in_the_readme_word_for_word() -> None:
    # Other documents and `.ci/run` quote these lines.
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    for line in (
        "python3 -m venv .venv && .venv/bin/pip install -e '.[demo]' && .venv/bin/urlab demo",
        "uv run --extra demo urlab demo",
        "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/python -m pytest",
    ):
        assert lines.count(line) == 1
