"""What holds for every test."""

import importlib.util

import pytest
from hypothesis import settings

# A test that is slow because the machine is busy has not failed; pytest's own limit ends those that hang.
settings.register_profile("urlab", deadline=None)
settings.load_profile("urlab")

HAS_RAY = importlib.util.find_spec("ray") is not None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what needs Ray where it is not installed: counted as deselected. CI has a step that installs it."""
    if HAS_RAY:
        return
    left_out = [item for item in items if item.get_closest_marker("ray")]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def pytest_report_header() -> str | None:
    """Say what is left out."""
    return None if HAS_RAY else "tests marked `ray` are deselected: pip install -e '.[ray]' to run them"
