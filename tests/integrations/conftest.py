"""What tests of environments share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from urlab_client.server import SimulatedServer


@pytest.fixture
def made() -> Iterator[list[Any]]:
    """Environments that a test puts here are closed after it."""
    envs: list[Any] = []
    yield envs
    for env in envs:
        env.close()


@pytest.fixture(scope="module")
def serving() -> Iterator[Callable[..., str]]:
    """Return the address of a server of these models in this process; one is started for all tests of a module.

    Its physics moves only when it is stepped, unless `step_mode` says otherwise: in live mode it would go on in real
    time after its clients have closed.
    """
    addresses: dict[str, str] = {}
    with ExitStack() as stack:

        def address(*models: str, **options: Any) -> str:
            wishes = repr((models, sorted(options.items())))
            if wishes not in addresses:
                server = SimulatedServer(*models, **{"play": True, "step_mode": "direct", **options})
                stack.enter_context(server)
                addresses[wishes] = f"{server.address}:{server.step_port}"
            return addresses[wishes]

        yield address
