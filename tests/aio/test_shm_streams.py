"""State and pictures out of shared memory, written by the plugin's kind of writer: the same streams as over sockets."""

from __future__ import annotations

import asyncio
import os
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hello import hello_ok
from publisher import Publisher
from waiting import DEADLINE_S
from written_region import WrittenRegion

from urlab_client._platform.processors import processor_fence
from urlab_client.aio.launch import transport_to
from urlab_client.aio.session.session import Session
from urlab_client.aio.streams.publishers import Publishers
from urlab_client.aio.streams.sources import Camera
from urlab_client.aio.streams.stream import Stream
from urlab_client.aio.transport.shm_regions import ServerRegions
from urlab_client.enums import CameraMode
from urlab_client.protocol import shm
from urlab_client.protocol.messages.session import CameraInfo, HelloOk

STATE = b"state/full"
WIDTH, HEIGHT = 32, 24


def snapshot(time: float) -> bytes:
    clock = {"sec": int(time), "nsec": 0}
    fields = {"op": "state_full", "time": time, "step": 1.0, "sim_time": clock, "wall_time": clock}
    return msgspec.msgpack.encode(fields | {"per_articulation": {}, "entities": {}})


INFO = CameraInfo(
    mode="real",
    resolution=(WIDTH, HEIGHT),
    fovy=45.0,
    zmq_endpoint="tcp://127.0.0.1:9",
    zmq_topic="arm/camera/eye",
)


def picture(value: int) -> bytes:
    """BGRA pixels of one value each in blue, green and red."""
    return bytes([value, value + 1, value + 2, 0]) * (WIDTH * HEIGHT)


@pytest.fixture
async def publisher() -> AsyncIterator[Publisher]:
    made = Publisher()
    yield made
    made.close()


@pytest.fixture
async def memory(tmp_path: Path) -> AsyncIterator[ServerRegions]:
    made = ServerRegions(tmp_path)
    made.follow(msgspec.convert(hello_ok(), HelloOk, strict=False))
    yield made
    made.close()


@pytest.fixture
async def publishers(publisher: Publisher, memory: ServerRegions) -> AsyncIterator[Publishers]:
    session = Session(transport_to("tcp://127.0.0.1", 1, None), default_timeout=DEADLINE_S)
    made = Publishers(session, lambda: publisher.port, live=lambda: True, memory=memory)
    yield made
    made.close()


@pytest.fixture
def state_region(tmp_path: Path) -> Iterator[WrittenRegion]:
    region = WrittenRegion(tmp_path / shm.STATE_FILE, 16_384)
    yield region
    region.close()


@pytest.fixture
def camera_region(tmp_path: Path) -> Iterator[WrittenRegion]:
    region = WrittenRegion(tmp_path / "cam_arm_eye.shm", shm.camera_stride(WIDTH, HEIGHT))
    yield region
    region.close()


def states(publishers: Publishers, policy: str = "latest") -> Stream[Any]:
    return Stream(publishers.state(policy), policy=policy, default_timeout=DEADLINE_S)


def frames(publishers: Publishers, policy: str = "latest", *, camera: Camera | None = None) -> Stream[Any]:
    source = publishers.camera(camera or Camera("eye", INFO), policy)
    return Stream(source, policy=policy, default_timeout=DEADLINE_S)


async def test_state_comes_from_the_region(publishers: Publishers, state_region: WrittenRegion) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers) as stream:
        assert (await stream.receive()).time == 1.0
        for time in (2.0, 3.0, 4.0):
            state_region.publish(snapshot(time))
            assert (await stream.receive()).time == time


async def test_a_second_reader_gets_what_is_there_and_takes_nothing_away(
    publishers: Publishers, state_region: WrittenRegion
) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers) as first, states(publishers) as second:
        assert (await first.receive()).time == (await second.receive()).time == 1.0
        state_region.publish(snapshot(2.0))
        assert (await first.receive()).time == (await second.receive()).time == 2.0


async def test_without_a_region_it_comes_by_socket_until_there_is_one(
    publishers: Publishers, publisher: Publisher, tmp_path: Path
) -> None:
    async with states(publishers) as stream:
        await publisher.subscribed(STATE)
        publisher.send(STATE, snapshot(1.0))
        assert (await stream.receive()).time == 1.0
        region = WrittenRegion(tmp_path / shm.STATE_FILE, 16_384)
        region.publish(snapshot(2.0))
        assert (await stream.receive()).time == 2.0
        await publisher.subscribed()
        region.close()


@pytest.mark.parametrize("behind", [[2.0], [1.0, 2.0]])
async def test_what_the_socket_brought_does_not_come_again_from_the_region(
    publishers: Publishers, publisher: Publisher, tmp_path: Path, behind: list[float]
) -> None:
    async with states(publishers) as stream:
        await publisher.subscribed(STATE)
        for time in (1.0, 2.0):
            publisher.send(STATE, snapshot(time))
            assert (await stream.receive()).time == time
        region = WrittenRegion(tmp_path / shm.STATE_FILE, 16_384)
        region.publish(snapshot(behind[0]))  # a server sends first and writes then
        async with states(publishers) as beside:
            await publisher.subscribed()
            for time in behind:
                assert (await beside.receive()).time == time
                assert stream.receive_nowait() is None
                region.publish(snapshot(time + 1.0))
        assert (await stream.receive()).time == 3.0
        region.close()


async def test_snapshots_that_outgrow_their_slot_come_by_socket(
    publishers: Publishers, publisher: Publisher, state_region: WrittenRegion
) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers) as stream:
        await stream.receive()
        # From now on the server publishes over ZMQ alone.
        await publisher.subscribed(STATE)
        publisher.send(STATE, snapshot(2.0))
        assert (await stream.receive()).time == 2.0
        state_region.publish(snapshot(3.0))
        assert (await stream.receive()).time == 3.0


async def test_all_of_them_come_by_socket(
    publishers: Publishers, publisher: Publisher, state_region: WrittenRegion
) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers, "all") as stream:
        await publisher.subscribed(STATE)
        for time in (2.0, 3.0):
            publisher.send(STATE, snapshot(time))
        assert [(await stream.receive()).time for _ in range(2)] == [2.0, 3.0]


async def test_a_region_made_anew_is_followed(
    publishers: Publishers, state_region: WrittenRegion, tmp_path: Path
) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers) as stream:
        await stream.receive()
        state_region.path.unlink()
        again = WrittenRegion(tmp_path / shm.STATE_FILE, 16_384)
        again.publish(snapshot(2.0))
        assert (await stream.receive()).time == 2.0
        again.path.unlink()
        again.close()


async def test_a_region_cut_off_is_let_go(
    publishers: Publishers, publisher: Publisher, state_region: WrittenRegion
) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers) as stream:
        await stream.receive()
        os.truncate(state_region.path, 0)
        await publisher.subscribed(STATE)
        publisher.send(STATE, snapshot(2.0))
        assert (await stream.receive()).time == 2.0


async def test_regions_are_let_go_before_play_stops(
    publishers: Publishers, publisher: Publisher, state_region: WrittenRegion
) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers) as stream:
        await stream.receive()
        publishers.release_regions()
        await publisher.subscribed(STATE)
        async with states(publishers) as another:
            publisher.send(STATE, snapshot(1.5))
            assert (await another.receive()).time == 1.5, "by socket, as play may have ended"
        publishers.refresh()
        await publisher.subscribed()
        state_region.publish(snapshot(2.0))
        while (await stream.receive()).time != 2.0:
            pass


@pytest.mark.parametrize("mode", [CameraMode.REAL, CameraMode.DEPTH])
async def test_pictures_become_arrays_of_the_reader(
    publishers: Publishers, camera_region: WrittenRegion, monkeypatch: pytest.MonkeyPatch, mode: CameraMode
) -> None:
    monkeypatch.setattr(Camera, "mode", mode)
    depth = np.full(WIDTH * HEIGHT, 250.0, np.float32).tobytes()
    camera_region.publish(picture(10) if mode is CameraMode.REAL else depth)
    async with frames(publishers) as stream:
        first = (await stream.receive()).pixels
        before = first.copy()
        for value in range(4):
            camera_region.publish(picture(100 + value))
        assert np.array_equal(first, before), "it aliases the region"
        if mode is CameraMode.REAL:
            assert (first == [12, 11, 10, 255]).all()
        else:
            assert (first == 2.5).all()


async def test_a_picture_read_in_place_of_the_one_before_does_not_come_twice(
    publishers: Publishers, camera_region: WrittenRegion
) -> None:
    camera_region.publish(picture(1))
    async with frames(publishers) as stream:
        assert (await stream.receive()).pixels[0, 0, 2] == 1
        camera_region.publish(picture(2))
        assert (await stream.receive()).pixels[0, 0, 2] == 2
        assert stream.receive_nowait() is None
        with pytest.raises(TimeoutError, match=r"cam_arm_eye\.shm"):
            await stream.receive(timeout=0.05)


async def test_no_torn_picture_is_handed_out(publishers: Publishers, tmp_path: Path) -> None:
    # So large that the interpreter lets the writer on in the midst of a conversion.
    size = (800, 600)
    camera = Camera("eye", msgspec.structs.replace(INFO, resolution=size))
    region = WrittenRegion(tmp_path / "cam_arm_eye.shm", shm.camera_stride(*size))
    pictures = [bytes([value, value + 1, value + 2, 0]) * (size[0] * size[1]) for value in range(16)]
    stop, taken = threading.Event(), threading.Event()

    def hammer() -> None:
        while not stop.is_set():
            taken.clear()
            for number, payload in enumerate(pictures):
                region.publish(payload)
                stop.wait(1e-3 * (number % 4))
            taken.wait(DEADLINE_S)  # a reader that is too slow for all of them gets the last one

    region.publish(pictures[0])
    writer = threading.Thread(target=hammer)
    writer.start()
    try:
        async with frames(publishers, camera=camera) as stream:
            for _ in range(100):
                pixels = (await stream.receive()).pixels
                taken.set()
                assert (pixels == pixels[0, 0]).all()
    finally:
        stop.set()
        taken.set()
        writer.join()
        region.close()


async def test_a_shared_frame_says_when_it_was_overwritten(
    publishers: Publishers, camera_region: WrittenRegion
) -> None:
    camera = Camera("eye", INFO)
    assert publishers.shared_frame(camera) is None
    camera_region.publish(picture(5))
    async with frames(publishers) as stream:
        await stream.receive()
        frame = publishers.shared_frame(camera)
        assert frame is not None
        assert (frame.pixels[..., 0] == 5).all()
        assert not frame.pixels.flags.writeable
        assert frame.valid()
        camera_region.publish(picture(6))
        assert not frame.valid(), "the server may be writing into it by now"


@pytest.mark.skipif(sys.platform != "linux", reason="reads what this process has mapped")
async def test_the_last_stream_that_is_closed_lets_its_region_go(
    publishers: Publishers, state_region: WrittenRegion
) -> None:
    def mapped() -> int:
        return Path("/proc/self/maps").read_text().count(str(state_region.path))

    state_region.publish(snapshot(1.0))
    ours = mapped()
    async with states(publishers) as first:
        await first.receive()
        async with states(publishers) as second:
            await second.receive()
        assert mapped() > ours
        state_region.publish(snapshot(2.0))
        assert (await first.receive()).time == 2.0
    assert mapped() == ours


async def test_closing_ends_streams_and_threads(publishers: Publishers, state_region: WrittenRegion) -> None:
    state_region.publish(snapshot(1.0))
    stream = states(publishers)
    await stream.receive()
    waiting = asyncio.create_task(stream.receive())
    await asyncio.sleep(0)
    publishers.close()
    with pytest.raises(ConnectionError, match="closed"):
        await waiting


async def test_pictures_go_on_when_a_server_begins_to_count_anew(
    publishers: Publishers, camera_region: WrittenRegion
) -> None:
    for _ in range(5):
        camera_region.publish(picture(1))
    async with frames(publishers) as stream:
        await stream.receive()
        # After a crash the plugin lays out its files in place.
        again = shm.Region.lay_out(memoryview(camera_region._map), camera_region.region.stride, fence=processor_fence())
        again.publish(picture(2))
        assert (await stream.receive()).pixels[0, 0, 2] == 2
        again.publish(picture(3))
        assert (await stream.receive()).pixels[0, 0, 2] == 3


async def test_snapshots_go_on_when_a_server_lays_them_out_in_another_way(
    publishers: Publishers, state_region: WrittenRegion
) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers) as stream:
        await stream.receive()
        again = WrittenRegion(state_region.path, 65_536)
        for number in range(2, 6):  # the counter is beyond that of before already
            again.publish(snapshot(float(number)))
        assert (await stream.receive()).time == 5.0
        again.publish(snapshot(6.0))
        assert (await stream.receive()).time == 6.0
        assert stream.stats.malformed == 0
        again.close()


async def test_streams_survive_a_server_that_calls_its_directory_something_else(
    publishers: Publishers, publisher: Publisher, memory: ServerRegions, state_region: WrittenRegion
) -> None:
    state_region.publish(snapshot(1.0))
    async with states(publishers) as stream:
        await stream.receive()
        memory._given, memory.directory = None, Path("not absolute")
        await publisher.subscribed(STATE)
        publisher.send(STATE, snapshot(2.0))
        assert (await stream.receive()).time == 2.0
        memory.directory = state_region.path.parent
        state_region.publish(snapshot(3.0))
        assert (await stream.receive()).time == 3.0
