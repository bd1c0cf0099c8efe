"""Pictures without a step from servers that cannot draw for a request, and how the way there and back goes wrong."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from typing import Any

import anyio
import pytest
from publisher import Publisher
from scripted_beta import ScriptedBeta
from waiting import pass_time, until

from urlab_client.aio import URLabClient
from urlab_client.errors import PictureTimeout, URLabTimeoutError
from urlab_client.values.pictures import camera_header

TOPIC = b"arm_a/wrist "


@pytest.fixture
def beta() -> Iterator[ScriptedBeta]:
    """A server that numbers its pictures, and cannot wait for one."""
    server = ScriptedBeta()
    server.capabilities.remove("render_sync")
    yield server
    server.close()


@pytest.fixture
async def client(beta: ScriptedBeta) -> AsyncIterator[URLabClient]:
    options: dict[str, Any] = {"step_port": beta.port, "live_pictures": False, "step_mode": "direct"}
    async with URLabClient("tcp://127.0.0.1", **options) as client:
        await client.discover()
        yield client


@pytest.fixture
def camera(beta: ScriptedBeta) -> Iterator[Publisher]:
    publisher = Publisher(beta.port + 2)
    yield publisher
    publisher.close()


def picture(frame_id: int, shade: int) -> bytes:
    return camera_header(frame_id, 0.002 * frame_id, 4, 2, 1.75e9) + bytes([shade]) * 32


async def test_it_waits_for_a_picture_of_now_and_leaves_everything_as_it_was(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher
) -> None:
    """Generation 2 statement 54: the first one that is not older than the state."""
    await client.step()
    await client.step()
    beta.arrived()
    task = asyncio.create_task(client.camera("arm_a/wrist").capture())
    await camera.subscribed(TOPIC)
    await until(lambda: beta.streaming.get("arm_a/wrist", (False, False))[0])
    for frame_id in (1, 2, 3):
        camera.send(TOPIC, picture(frame_id, 10 * frame_id))
    sample = await task
    assert (sample.frame_id, sample.sim_time, sample.pixels[0, 0, 0]) == (2, 0.004, 20)
    await until(lambda: beta.streaming["arm_a/wrist"] == (False, False))
    asked = [(request["op"], request.get("mode", request.get("paused"))) for request in beta.arrived()]
    assert [one for one in asked if one[0] != "set_camera_streaming"] == [
        ("set_mode", "direct"),
        ("set_paused", True),
        ("set_mode", "live"),
        ("step", None),
        ("set_mode", "direct"),
        ("set_paused", False),
    ]
    assert (beta.mode, beta.paused, client.step_count) == ("direct", False, 2)


async def test_a_call_that_is_broken_off_goes_back_to_the_mode_it_came_from(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher
) -> None:
    with anyio.CancelScope() as scope:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(client.camera("arm_a/wrist").capture)
            await camera.subscribed(TOPIC)
            scope.cancel()
    assert (beta.mode, beta.paused) == ("direct", False)
    assert (await client.step()).step == 1


async def test_a_way_back_that_fails_is_taken_before_the_next_step(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher
) -> None:
    answer = beta.answers["set_mode"]
    task = asyncio.create_task(client.camera("arm_a/wrist").capture())
    await camera.subscribed(TOPIC)
    beta.on("set_mode", None)
    camera.send(TOPIC, picture(0, 1))
    await until(beta.held.qsize)
    pass_time(10)
    with pytest.raises(URLabTimeoutError, match="set_mode"):
        await task
    assert (beta.mode, beta.paused) == ("live", True)
    beta.on("set_mode", answer)
    assert (await client.step()).step == 1
    assert (beta.mode, beta.paused) == ("direct", False)


async def test_no_picture_is_an_error_that_names_the_camera(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher
) -> None:
    task = asyncio.create_task(client.capture(["arm_a/wrist"]))
    await camera.subscribed(TOPIC)
    await until(lambda: beta.streaming.get("arm_a/wrist", (False, False))[0])
    pass_time(40)
    with pytest.raises(PictureTimeout, match=r"no picture of 'wrist' arrived in time.*OpenGL") as caught:
        await task
    assert caught.value.cameras == ["wrist"]
    assert (await client.step()).step == 1
