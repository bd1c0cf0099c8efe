"""`scene.upload_model` to a server whose import takes long: it answers nobody meanwhile."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from scripted_beta import ScriptedBeta
from waiting import pass_time, until

from urlab_client import URLabTimeoutError
from urlab_client.aio import URLabClient


class SlowBeta(ScriptedBeta):
    """Its imports begin, and end when the test says so.

    Attributes:
        begun: Whether an import has.
        end: Lets all of them end.
    """

    def __init__(self) -> None:
        self.begun, self.end = threading.Event(), threading.Event()
        super().__init__()

    def _upload_model_commit(self, request: dict[str, Any]) -> dict[str, Any]:
        self.begun.set()
        self.end.wait()
        return super()._upload_model_commit(request)


@pytest.fixture
def beta() -> Iterator[SlowBeta]:
    server = SlowBeta()
    yield server
    server.end.set()
    server.close()


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "box.xml"
    path.write_text("<mujoco><worldbody><geom size='0.1'/></worldbody></mujoco>")
    return path


def client_of(beta: SlowBeta) -> URLabClient:
    return URLabClient("tcp://127.0.0.1", step_port=beta.port, live_pictures=False)


async def uploading(client: URLabClient, beta: SlowBeta, model: Path) -> asyncio.Task[Any]:
    """Begin to upload, and return when the server has begun to import."""
    task = asyncio.create_task(client.scene.upload_model(model))
    await until(lambda: beta.begun.is_set() or task.done())
    assert not task.done(), task
    return task


async def test_an_import_that_takes_a_minute_ends(beta: SlowBeta, model: Path) -> None:
    """Beta statements 82 and 85."""
    async with client_of(beta) as client:
        await client.discover()
        task = await uploading(client, beta, model)
        pass_time(60.0)
        done, _ = await asyncio.wait((task,), timeout=0.05)  # what is due is done long before
        assert not done
        beta.end.set()
        assert (await task).class_path == "/Game/MuJoCoImports/model.model_C"
        assert len(beta.of("upload_model_commit")) == 1


async def test_an_import_that_outlives_its_deadline_is_told_and_not_begun_again(beta: SlowBeta, model: Path) -> None:
    """Beta statement 85."""
    async with client_of(beta) as client:
        await client.discover()
        task = await uploading(client, beta, model)
        pass_time(601.0)
        with pytest.raises(URLabTimeoutError, match=r"upload_model_commit.*may still be executed"):
            await task
        beta.end.set()
        assert await client.scene.current_level() == "/Game/Levels/lab"
        assert len(beta.of("upload_model_commit")) == 1
