"""Pictures of steps from servers that cannot draw for a step: taken from the cameras' streams."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import pytest
from publisher import Publisher
from scripted_beta import ScriptedBeta
from waiting import DEADLINE_S, pass_time, until

from urlab_client.aio import URLabClient
from urlab_client.errors import URLabTimeoutError
from urlab_client.protocol.messages.session import StepOk
from urlab_client.server import Drop, Faults, SimulatedServer
from urlab_client.values.pictures import camera_header

TOPIC = b"arm_a/wrist "
SYNC = {"arm a/wrist": "sync"}


@pytest.fixture
def beta() -> Iterator[ScriptedBeta]:
    """A server that numbers its pictures, and cannot wait for one."""
    server = ScriptedBeta()
    server.capabilities.remove("render_sync")
    yield server
    server.close()


@asynccontextmanager
async def client_of(beta: ScriptedBeta) -> AsyncIterator[URLabClient]:
    client = URLabClient("tcp://127.0.0.1", step_port=beta.port, live_pictures=False, step_mode="direct")
    async with client:
        await client.discover()
        yield client


@pytest.fixture
async def client(beta: ScriptedBeta) -> AsyncIterator[URLabClient]:
    async with client_of(beta) as made:
        yield made


@pytest.fixture
def camera(beta: ScriptedBeta) -> Iterator[Publisher]:
    publisher = Publisher(beta.port + 2)
    yield publisher
    publisher.close()


def picture(frame_id: int, sim_time: float, shade: int) -> bytes:
    return camera_header(frame_id, sim_time, 4, 2, 1.75e9) + bytes([shade]) * 32


def brings(beta: ScriptedBeta, frame_id: int | None) -> None:
    """Let the replies to steps carry a picture of that snapshot, or none."""
    answer = beta._step
    frame = {"width": 4.0, "height": 2.0, "frame_id": frame_id, "sim_time": 0.0, "dtype": "bgra8", "data": bytes(32)}
    cameras = {} if frame_id is None else {"cameras": {"arm_a/wrist": frame}}
    beta.on("step", lambda request: {**answer(request), **cameras})


@pytest.mark.parametrize("brought", [0, None])
async def test_the_picture_of_a_step_is_taken_from_the_stream(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher, brought: int | None
) -> None:
    """Generation 2 statement 54: the first one that is not older than the step."""
    brings(beta, brought)
    wrist = client.articulations["arm_a"].cameras["wrist"]
    for step in (1, 2):  # the second one finds the stream open
        task = asyncio.create_task(client.step(include_cameras=SYNC))
        if step == 1:
            await camera.subscribed(TOPIC)
        await until(lambda step=step: beta.frame >= step)
        camera.send(TOPIC, picture(step - 1, 0.0, 9))
        camera.send(TOPIC, picture(step, 0.002 * step, 10 * step))
        if step == 2:  # it would answer the second step, were it sent during the first
            camera.send(TOPIC, picture(3, 1.0, 9))
        reply = await task
        assert reply.cameras is not None
        assert list(reply.cameras) == ["arm a/wrist"]
        assert (wrist.delivered, wrist.frame_id, wrist.sim_time) == (True, step, 0.002 * step)
        assert wrist.latest_frame is not None
        assert wrist.latest_frame[0, 0, 0] == 10 * step
    assert [request["cameras"] for request in beta.of("set_camera_streaming")] == [
        {"arm_a/wrist": {"zmq": True, "shm": True}}
    ]


async def test_a_stream_that_brings_no_new_picture_leaves_the_camera_undelivered(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher
) -> None:
    brings(beta, 0)
    wrist = client.articulations["arm_a"].cameras["wrist"]
    task = asyncio.create_task(client.step(include_cameras=SYNC))
    await camera.subscribed(TOPIC)
    await until(lambda: client._state.step_streams.needed)
    camera.send(TOPIC, picture(0, 0.0, 9))
    pass_time(10.0)
    reply = await task
    assert reply.cameras == {}
    assert (wrist.delivered, wrist.latest_frame) == (False, None)
    assert client.step_count == 1


async def test_pictures_without_numbers_are_not_waited_for(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher
) -> None:
    brings(beta, 0)
    task = asyncio.create_task(client.step(include_cameras=SYNC, timeout=None))
    await camera.subscribed(TOPIC)
    camera.send(TOPIC, bytes(32))
    assert (await task).cameras == {}


async def test_a_step_whose_picture_is_not_waited_for_any_longer_was_taken(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher
) -> None:
    brings(beta, 0)
    task = asyncio.create_task(client.step(include_cameras=SYNC))
    await camera.subscribed(TOPIC)
    await until(lambda: client._state.step_streams.needed)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert client.step_count == 1
    assert (await client.step()).step == 2


async def test_streams_are_closed_when_no_step_asks_for_their_pictures(
    client: URLabClient, beta: ScriptedBeta, camera: Publisher
) -> None:
    brings(beta, 7)
    task = asyncio.create_task(client.step(include_cameras=SYNC))
    await camera.subscribed(TOPIC)
    assert (await task).cameras
    assert beta.streaming == {"arm_a/wrist": (True, True)}
    pass_time(10.0)
    await camera.subscribed()
    await until(lambda: beta.streaming == {"arm_a/wrist": (False, False)})


async def test_steps_that_want_no_such_picture_open_no_stream(client: URLabClient, beta: ScriptedBeta) -> None:
    brings(beta, 0)
    await client.step()
    await client.step(include_cameras={"arm a/wrist": "latest"})
    assert not beta.of("set_camera_streaming")


async def test_a_camera_that_nobody_serves_costs_no_more_than_the_deadline(
    client: URLabClient, beta: ScriptedBeta
) -> None:
    brings(beta, None)
    task = asyncio.create_task(client.step(include_cameras=SYNC))
    await until(lambda: beta.streaming)
    pass_time(2.5)
    await until(lambda: client._state.step_streams.needed)
    pass_time(10.0)
    assert not (await task).cameras
    assert client.step_count == 1


async def test_cameras_that_always_stream_are_received_from_the_first_older_picture_on() -> None:
    beta = ScriptedBeta(without=("set_camera_streaming", "set_camera_delay"))
    beta.capabilities.remove("render_sync")
    camera = Publisher(beta.port + 2)
    try:
        brings(beta, 0)
        async with client_of(beta) as client:
            for step in (1, 2):
                task = asyncio.create_task(client.step(include_cameras=SYNC))
                await until(lambda step=step: beta.frame >= step)
                if step == 1:
                    await camera.subscribed(TOPIC)
                camera.send(TOPIC, picture(step, 0.002 * step, 5))
                reply = await task
                assert reply.cameras is not None
                assert reply.cameras["arm a/wrist"].frame_id == step
    finally:
        camera.close()
        beta.close()


@pytest.mark.opengl
@pytest.mark.parametrize("renders", [True, False], ids=["renders for a step", "draws as it likes"])
async def test_the_first_picture_of_a_step_may_wait_for_opengl(renders: bool) -> None:
    faults, dialect = Faults(), "beta" if renders else "alpha"
    with SimulatedServer("arm", play=True, camera_size=(64, 48), dialect=dialect, faults=faults) as server:
        async with URLabClient(**server.client_options(), step_mode="direct") as client:
            await client.discover(timeout=DEADLINE_S)

            async def lost() -> asyncio.Task[StepOk]:
                fault = faults.add(Drop("step", times=1))
                step = asyncio.create_task(client.step(include_cameras={"arm/wrist": "sync"}))
                await until(lambda: fault.applied)
                pass_time(12.0)
                return step

            step = await lost()
            assert not (await asyncio.wait((step,), timeout=0.05))[0]
            pass_time(48.0)
            with pytest.raises(URLabTimeoutError, match="step: no reply"):
                await step
            await client.resync(timeout=DEADLINE_S)  # the server looks for OpenGL meanwhile
            await client.step(include_cameras={"arm/wrist": "sync"}, timeout=DEADLINE_S)
            assert client.camera("wrist").latest_frame is not None
            with pytest.raises(URLabTimeoutError, match="step: no reply"):
                await (await lost())
