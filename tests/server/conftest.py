"""Servers and bare clients for the tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from beta_bench import Bench
from wire import Wire, write_models

from urlab_client.server import SimulatedServer


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with `bot.xml`, `limited.xml`, `ball.xml`, `resting.xml`, `prop.xml`, `hand.xml`, `broken.xml`."""
    return write_models(tmp_path_factory.mktemp("models"))


@pytest.fixture
def connect() -> Iterator[Callable[[SimulatedServer], Wire]]:
    """Open bare clients, which close with the test."""
    with ExitStack() as stack:
        yield lambda server: stack.enter_context(Wire(server))


@pytest.fixture
def serve(models: Path, connect: Callable[[SimulatedServer], Wire]) -> Iterator[Callable[..., Wire]]:
    """Start servers with models of the folder and return a client with a session."""
    with ExitStack() as stack:

        def start(*names: str, **options: Any) -> Wire:
            paths = [models / f"{name}.xml" for name in names]
            wire = connect(stack.enter_context(SimulatedServer(*paths, **{"model_roots": [models], **options})))
            wire.hello()
            return wire

        yield start


@pytest.fixture
def editor(serve: Callable[..., Wire]) -> Wire:
    """A client of a server with an open level `fresh` and nothing in it."""
    wire = serve()
    wire.ask("create_level", name="fresh")
    return wire


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    models = write_models(tmp_path_factory.mktemp("models"))
    channels = {"arm_a/grip": 1.5, "arm_a/mode": "idle", "scene/door": False, "scene/goal": {"pos": [0], "quat": [1]}}
    with (
        SimulatedServer(
            dialect="beta",
            model_roots=[models],
            user_channels=channels,
            shm_dir=tmp_path_factory.getbasetemp(),
            camera_size=(64, 48),
        ) as server,
        Wire(server) as wire,
    ):
        yield Bench(server, wire, models)


@pytest.fixture
def playing(bench: Bench) -> Bench:
    bench.play()
    return bench
