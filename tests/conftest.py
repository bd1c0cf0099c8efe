"""What holds for every test."""

import importlib.util

import pytest
from hypothesis import HealthCheck, settings

# A test that is slow because the machine is busy has not failed; pytest's own limit ends those that hang.
settings.register_profile("urlab", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("urlab")

# Marker of the tests that need an extra which the test command does not install -> its modules, and what to install.
OPTIONAL = {"ray": (("ray",), "ray"), "view": (("foxglove", "rerun"), "foxglove,rerun")}

MISSING = {
    marker: extras
    for marker, (modules, extras) in OPTIONAL.items()
    if any(importlib.util.find_spec(module) is None for module in modules)
}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what needs such an extra where it is not installed, and what takes minutes unless that is asked for.

    Counted as deselected. CI has steps for them.
    """
    unwanted = [*MISSING] if "long" in config.option.markexpr else [*MISSING, "long"]
    left_out = [item for item in items if any(item.get_closest_marker(marker) for marker in unwanted)]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def pytest_report_header() -> list[str]:
    """Say what is left out."""
    return [
        f"tests marked `{marker}` are deselected: pip install -e '.[{extras}]' to run them"
        for marker, extras in MISSING.items()
    ]
