"""Nothing that runs in the background ends unseen: every task and thread is made by a helper that reports its end.

The files in `KILLED` end each of them with an error, and see who is told.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

HELPERS = {"daemon", "thread", "background_thread", "background_task", "ServingThread", "kept_running"}
"""What makes tasks and threads whose end is reported; `thread` is that of the server's `Health`."""

PLAIN = {
    "Process",
    "ProcessPoolExecutor",
    "Task",
    "Thread",
    "ThreadPoolExecutor",
    "Timer",
    "create_task",
    "ensure_future",
    "run_coroutine_threadsafe",
    "run_in_executor",
    "start_new_thread",
    "start_soon",
}
"""What makes tasks and threads whose end only those see who wait for it."""

AWAITED = {
    "_platform/threads.py:daemon": "makes the threads of the helpers",
    "aio/background.py:background_task": "makes the tasks of the helpers",
    "aio/session/session.py:probe": "waits for the task and returns its result",
    "sync/_loop.py:_start_job": "the caller of the job waits for it; the job holds every error of its coroutine",
    "sync/_loop.py:_run_between_calls": "runs the loop until the task has ended and raises its error",
    "sync/_loop.py:_cancel_all": "likewise",
    "sync/_loop.py:_main": "waits for them in bounded time, and logs their errors",
    "sync/_loop.py:_end": "likewise",
    "console/file_jobs.py:run_job": "waits for the task and raises its error",
    "web/file_routes.py:_while_present": "waits for both tasks, and raises the error of the job",
    "conformance/bench.py:to_the_end": "waits for the task and raises its error",
    "console/session.py:open": "starts `_run`, in which errors cannot leave `kept_running`",
    "integrations/forwarding.py:until_first": "the task group of one connection, which ends with the error",
    "integrations/gym/vector.py:_move_all": "waits for all tasks; the caller gets each result or error",
    "integrations/gym/engines.py:__init__": "a pool, whose results the caller reads",
    "cli/mcp.py:_serve_stdio_and_console": "waits for the task and raises its error",
    "cli/mcp.py:_serve_unless_start_fails": "waits for both tasks, and raises or returns the error of the first",
}
"""Functions that make tasks or threads without the helpers, and who sees their end."""

KILLED = {
    "tests/server/test_health.py": {
        "urlab-auth",
        "urlab-cameras",
        "urlab-compile",
        "urlab-editor",
        "urlab-physics",
        "urlab-registry",
        "urlab-render",
        "urlab-rpc",
        "urlab-sandbox",
        "urlab-shm",
        "urlab-streams",
        "urlab-watchdog",
    },
    "tests/aio/test_background_tasks.py": {
        "urlab-cameras",
        "urlab-claims",
        "urlab-keeper",
        "urlab-server",
        "urlab-waiter",
        "urlab-watch",
    },
    "tests/sync/test_portal.py": {"urlab-io"},
    "tests/web/test_console_failures.py": {"urlab-web-camera", "urlab-web-"},
    "tests/web/test_console_in_production.py": {"urlab-console-links"},
    "tests/integrations/test_failing_threads.py": {
        "urlab-environment",
        "urlab-feed",
        "urlab-pictures",
        "urlab-record",
        "urlab-view",
    },
    "tests/mcp/test_mcp_failures.py": {"urlab-mcp-progress", "urlab-mcp-stdin"},
    "tests/conformance/test_tap.py": {"urlab-relay", "urlab-replay"},
    "tests/cli/test_cli_failures.py": {"urlab-start", "urlab-stdin"},
}


def called(call: ast.Call) -> str:
    function = call.func
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def makers(tree: ast.AST, function: str = "") -> Iterator[tuple[str, ast.Call]]:
    """Yield each call that makes a task or thread, with the name of the outermost function around it."""
    for node in ast.iter_child_nodes(tree):
        name = function
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            name = function or node.name
        if isinstance(node, ast.Call) and called(node) in HELPERS | PLAIN:
            yield name, node
        yield from makers(node, name)


@pytest.fixture(scope="module")
def sources() -> list[tuple[str, ast.Module]]:
    """The modules of the package that have any of these words; parsing takes long."""
    words = re.compile("|".join(sorted(HELPERS | PLAIN)))
    texts = [(file, file.read_text(encoding="utf-8")) for file in sorted((ROOT / "src").rglob("*.py"))]
    return [
        (file.relative_to(ROOT / "src").as_posix().removeprefix("urlab_client/"), ast.parse(text))
        for file, text in texts
        if words.search(text)
    ]


def text(node: ast.expr) -> str:
    """Return a constant text, or the constant start of a formatted one; empty for anything else."""
    if isinstance(node, ast.JoinedStr):
        node = node.values[0]
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def test_what_runs_in_the_background_is_made_by_the_helpers(sources: list[tuple[str, ast.Module]]) -> None:
    plain = {f"{file}:{function}" for file, tree in sources for function, call in makers(tree) if called(call) in PLAIN}
    assert plain - set(AWAITED) == set(), "use Health.thread or aio/background.py, or say here who awaits it"
    assert set(AWAITED) - plain == set(), "no longer there"
    for file, tree in sources:
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                assert "Thread" not in map(ast.unparse, node.bases), f"{file}: {node.name} is a thread of its own"


def test_each_name_is_killed_by_a_test(sources: list[tuple[str, ast.Module]]) -> None:
    names: set[tuple[bool, str]] = set()
    for file, tree in sources:
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and called(node) in HELPERS and node.args and (name := text(node.args[0])):
                names.add((file.startswith(("server/", "_sandbox/")), name))
    assert {name for _, name in names if not name.startswith("urlab-")} == set()
    killed = {(file.startswith("tests/server/"), name) for file, all_ in KILLED.items() for name in all_}
    assert killed == names
    for file, wanted in KILLED.items():
        constants = {
            node.value
            for node in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8")))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        assert {name for name in wanted if not any(name in constant for constant in constants)} == set(), file
