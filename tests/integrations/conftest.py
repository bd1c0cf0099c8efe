"""What tests of environments share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def made() -> Iterator[list[Any]]:
    """Environments that a test puts here are closed after it."""
    envs: list[Any] = []
    yield envs
    for env in envs:
        env.close()
