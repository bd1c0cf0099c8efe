"""What holds for every test."""

import gc
import importlib.metadata
import importlib.util
import os
import sys
from collections.abc import Generator

import pytest
from hypothesis import HealthCheck, settings
from not_on_windows import listed, names

# The tests start hundreds of processes; without bytecode files each would compile the package anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A test that is slow because the machine is busy has not failed; pytest's own limit ends those that hang.
settings.register_profile("urlab", deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=30)
settings.register_profile("thorough", settings.get_profile("urlab"), max_examples=150)
settings.load_profile("urlab")

# Marker -> modules without which its tests are left out, and the extras to install.
OPTIONAL = {"ray": (("ray",), "ray"), "view": (("foxglove", "rerun"), "foxglove,rerun")}

MISSING = {
    marker: extras
    for marker, (modules, extras) in OPTIONAL.items()
    if any(importlib.util.find_spec(module) is None for module in modules)
}


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


def too_new(item: pytest.Item) -> bool:
    """Whether a test needs a newer MuJoCo than is installed."""
    marker = item.get_closest_marker("mujoco")
    return marker is not None and release(MUJOCO) < release(marker.args[0])


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what cannot run here: for want of an extra, of a newer MuJoCo, or of something that Windows lacks."""
    left_out = [
        item
        for item in items
        if any(item.get_closest_marker(marker) for marker in MISSING) or too_new(item) or names(IMPOSSIBLE, item.nodeid)
    ]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Say what is left out: with workers, the summary does not count it."""
    return [
        *([f"tests are left out by -m {config.option.markexpr!r}"] if config.option.markexpr else []),
        *(f"tests marked `{marker}` need: pip install -e '.[{extras}]'" for marker, extras in MISSING.items()),
        f"tests marked `mujoco` need the release that they name, or a later one; this is {MUJOCO}",
        *([f"{len(IMPOSSIBLE)} entries of tests/not_on_windows.toml are left out"] if IMPOSSIBLE else []),
    ]


def pytest_collection_finish() -> None:
    """Keep the collected tests out of the garbage collector's rounds: some tests run it again and again."""
    gc.freeze()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Collect no garbage meanwhile: Python 3.11 fails when a finaliser formats a traceback within another's."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
