"""What holds for every test."""

import functools
import gc
import importlib.metadata
import importlib.util
import itertools
import os
import signal
import sys
import traceback
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from children import ended_with_a_failure
from hypothesis import HealthCheck, settings
from not_on_windows import listed, names

# The tests start hundreds of processes; without bytecode files each would compile the package anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Started in the background (`nohup`, a script's `&`) they ignore SIGINT, which some send to themselves and to programs.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A test that is slow because the machine is busy has not failed; pytest's own limit ends those that hang.
settings.register_profile("urlab", deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=30)
settings.register_profile("thorough", settings.get_profile("urlab"), max_examples=150)
settings.load_profile("urlab")

# Marker -> modules without which its tests are left out, and the extras to install.
OPTIONAL = {
    "mutants": (("coverage", "mutmut"), "mutants"),
    "ray": (("ray",), "ray"),
    "view": (("foxglove", "rerun"), "foxglove,rerun"),
}

LEFT_OUT: dict[str, str] = {}
"""Tests that cannot run here, and what they need."""

OPENGL = "URLAB_TESTS_WITHOUT_OPENGL"

_raises: Any = pytest.raises


def _tells(error: BaseException) -> bool:
    """Whether what the package raised has a message; cancelling and the end of an iterator need none."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = frames and "urlab_client" in Path(frames[-1].filename).parts
    silent = not isinstance(error, Exception) or isinstance(error, StopIteration | StopAsyncIteration)
    return silent or not ours or not {None, "", "None"} & {getattr(error, "message", str(error)), *error.args[:1]}


@functools.wraps(_raises)
def raises_with_a_message(*arguments: Any, **options: Any) -> Any:
    """Expect an exception, which must have a message if the package raises it, whatever else a test asks of it."""
    plain = len(arguments) == 1 and not {"match", "check"} & options.keys()
    return _raises(*arguments, **options, **({"check": _tells} if plain else {}))


pytest.raises = raises_with_a_message

MISSING = {
    marker: extras
    for marker, (modules, extras) in OPTIONAL.items()
    if any(importlib.util.find_spec(module) is None for module in modules)
}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add what the checks of `tests/conformance` take to run against another server."""
    group = parser.getgroup("conformance")
    group.addoption("--address", help="run the checks of tests/conformance against this server, and nothing else")
    group.addoption("--play", action="store_true", help="with --address: also drive its robots")
    group.addoption("--author", action="store_true", help="with --address: also edit, in a level of their own")


@pytest.hookimpl(wrapper=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> Generator[None, int, int]:
    """Take one worker more than xdist would, as tests also wait; none for single files, or with `-s`."""
    workers = yield
    return 0 if config.option.capture == "no" or not any(map(os.path.isdir, config.args)) else workers + 1


MUJOCO = importlib.metadata.version("mujoco")


def release(version: str) -> tuple[int, ...]:
    """Return a version's first two numbers."""
    return tuple(int(part) for part in version.split(".")[:2])


def on_wine() -> bool:
    """Whether this Windows is Wine."""
    if sys.platform != "win32":
        return False
    import ctypes

    return hasattr(ctypes.WinDLL("ntdll"), "wine_get_version")


IMPOSSIBLE = listed(wine=on_wine()) if sys.platform == "win32" else {}
collect_ignore = [test.removeprefix("tests/") for test in IMPOSSIBLE if "::" not in test]  # some cannot be imported


@functools.cache
def without_opengl() -> str:
    """Return why no pictures can be drawn here; empty where they can. The workers ask the process that starts them."""
    if OPENGL not in os.environ:
        from urlab_client.simulation.opengl import Backend, search_backend

        found = search_backend()
        os.environ[OPENGL] = "" if isinstance(found, Backend) else found
    return os.environ[OPENGL]


def lacking(item: pytest.Item) -> str:
    """Return what a test needs that is not here; empty when it can run."""
    for marker, extras in MISSING.items():
        if item.get_closest_marker(marker):
            return f"pip install -e '.[{extras}]'"
    newer = item.get_closest_marker("mujoco")
    if newer is not None and release(MUJOCO) < release(newer.args[0]):
        return f"MuJoCo {newer.args[0]} or later; this is {MUJOCO}"
    if names(IMPOSSIBLE, item.nodeid):
        return "another system (tests/not_on_windows.toml says why)"
    if item.get_closest_marker("opengl") and without_opengl():
        return f"OpenGL: {without_opengl()}"
    return ""


@pytest.fixture(scope="session")
def opengl() -> None:
    """Look for OpenGL, which the first picture would wait for. Tests whose fixtures request this get the mark."""
    from urlab_client.simulation.opengl import search_backend

    search_backend()


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark the tests whose fixtures have pictures drawn."""
    if "opengl" in getattr(item, "fixturenames", ()):
        item.add_marker("opengl")


def pytest_configure(config: pytest.Config) -> None:
    """Look for OpenGL once for all workers, which collect the tests."""
    if getattr(config.option, "numprocesses", None):
        without_opengl()
    elif os.environ.pop("PYTHONDEVMODE", None):
        # Programs have the rest of the development mode: asyncio would tell of whatever takes long on a busy machine.
        os.environ.update(PYTHONWARNINGS="default", PYTHONFAULTHANDLER="1", PYTHONMALLOC="debug")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what cannot run here."""
    needs = {item: lacking(item) for item in items}
    left_out = [item for item in items if needs[item]]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not needs[item]]
    # A worker tells the process that started it, which collects nothing and counts nothing.
    told = getattr(config, "workeroutput", None)
    (LEFT_OUT if told is None else told.setdefault("left_out", {})).update(
        {item.nodeid: needs[item] for item in left_out}
    )


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take over what a worker has left out."""
    LEFT_OUT.update(getattr(node, "workeroutput", {}).get("left_out", {}))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name the tests that were left out, with what they need."""
    for need in sorted(set(LEFT_OUT.values())):
        tests = [test for test, needed in LEFT_OUT.items() if needed == need]
        terminalreporter.section("left out", "-")
        terminalreporter.write_line(f"{len(tests)} left out, which need {need}")
        functions = sorted({test.partition("[")[0] for test in tests})
        for file, group in itertools.groupby(functions, lambda name: name.partition("::")[0]):
            terminalreporter.write_line(f"{file}: {', '.join(name.rpartition('::')[2] for name in group)}")


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Say which tests are left out by their marks."""
    return [f"tests are left out by -m {config.option.markexpr!r}"] if config.option.markexpr else []


def pytest_collection_finish() -> None:
    """Keep the collected tests out of the garbage collector's rounds: some tests run it again and again."""
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None]:
    """End the processes that a failed test leaves hanging."""
    with ended_with_a_failure():
        yield


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Collect no garbage meanwhile: Python 3.11 fails when a finaliser formats a traceback within another's."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


@pytest.fixture(autouse=True)
def _interruptible() -> Generator[None]:
    """A test that leaves another handler behind fails itself, and not those that interrupt themselves later."""
    before = signal.getsignal(signal.SIGINT)
    yield
    assert signal.getsignal(signal.SIGINT) == before
