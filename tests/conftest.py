"""What holds for every test."""

import importlib.util
import os
from collections.abc import Generator

import pytest
from hypothesis import HealthCheck, settings

# The tests start some hundred processes, each of which would compile the package anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A test that is slow because the machine is busy has not failed; pytest's own limit ends those that hang.
settings.register_profile("urlab", deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=30)
settings.register_profile("thorough", settings.get_profile("urlab"), max_examples=300)
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


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what needs an extra that is not installed. CI has steps for those tests."""
    left_out = [item for item in items if any(item.get_closest_marker(marker) for marker in MISSING)]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Say what is left out: with workers, the summary does not count it."""
    return [
        *([f"tests are left out by -m {config.option.markexpr!r}"] if config.option.markexpr else []),
        *(f"tests marked `{marker}` need: pip install -e '.[{extras}]'" for marker, extras in MISSING.items()),
    ]
