from __future__ import annotations

from collections.abc import Callable

import pytest
import vectors


@pytest.fixture(scope="session")
def vector() -> Callable[[str], vectors.Vector]:
    """Look a golden vector up by name: `vector("row_joint").data`."""
    return vectors.load
