"""Live mode and the client's streams, in both flavours, against a scripted plugin that publishes on real sockets."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest
from hello import hello_ok
from publisher import Publisher
from waiting import DEADLINE_S, eventually, until

import urlab_client
from urlab_client.aio import URLabClient
from urlab_client.errors import ClientClosed, URLabError, URLabTimeoutError
from urlab_client.events import (
    PlayEnded,
    PlayStarted,
    ServerConnected,
    ServerLost,
    ServerReconnected,
    SessionLost,
    SessionOpened,
)

sys.path.append(str(Path(__file__).parents[1] / "protocol"))
import vectors

STATE = b"state/full"
TOPIC, PIXELS = vectors.load("msg_camera_real_2x2").frames
XML = """<mujoco><worldbody>
  <body name="arm0_base"><joint name="arm0_hip"/><geom name="arm0_g" size=".1" mass="1"/></body>
  <body name="crate" pos="0 3 1"><freejoint name="crateJoint"/><geom size=".1" mass="1"/></body>
</worldbody><actuator><motor name="arm0_hip" joint="arm0_hip"/></actuator></mujoco>"""


class Plugin:
    """A plugin in live mode: physics runs there, whatever the client does."""

    def __init__(self, scripted: Any, publisher: Publisher) -> None:
        self.publisher = publisher
        model = mujoco.MjModel.from_xml_string(XML)
        mjb = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, mjb)
        self.camera = {
            "mode": "real",
            "resolution": [2.0, 2.0],
            "fovy": 45.0,
            "zmq_endpoint": f"tcp://0.0.0.0:{publisher.port}",
            "zmq_topic": "arm0/camera/wrist",
        }
        arm = {
            "prefix": "arm0",
            "actor_id": "left",
            "default_control_mode": "raw",
            "actuator_types": {"hip": "motor"},
            "original_names": {"actuators": {}, "joints": {}, "sensors": {}, "bodies": {}},
            "camera_topics": {"wrist": self.camera},
        }
        self.hello = hello_ok(mjb=mjb.tobytes(), articulations=[arm], entities={})
        scripted.on("hello", lambda _: self.hello)
        scripted.on("set_mode", self.set_mode)
        scripted.on("stop_pie", {"op": "stop_pie_ok"})
        scripted.on("pie_status", {"op": "pie_status_ok", "state": "off", "compile_error": ""})
        scripted.on("step", lambda _: self.state("step_ok", 0.5, 0.5, wall=100.0) | {"entities": {}})

    def set_mode(self, request: dict[str, Any]) -> dict[str, Any]:
        return {"op": "set_mode_ok", "previous_mode": "live", "current_mode": request["mode"]}

    def state(self, op: str, time: float, angle: float, wall: float) -> dict[str, Any]:
        block = {"qpos": [angle], "qvel": [0.0], "ctrl": [0.25], "act": [0.0], "sensors": {}, "actions": 0.0}
        return {
            "op": op,
            "time": time,
            "step": 0.0,
            "sim_time": {"sec": 0.0, "nsec": 5e8},
            "wall_time": {"sec": float(int(wall)), "nsec": float(round(wall % 1 * 1e9))},
            "per_articulation": {"arm0": block},
        }

    def tick(self, time: float, angle: float = 0.0, *, wall: float = 200.0, **more: Any) -> None:
        message = self.state("state_full", time, angle, wall) | {"entities": {}} | more
        self.publisher.send(STATE, msgspec.msgpack.encode(message))


@pytest.fixture
async def publisher() -> AsyncIterator[Publisher]:
    made = Publisher()
    yield made
    made.close()


@pytest.fixture
def plugin(scripted: Any, publisher: Publisher) -> Plugin:
    return Plugin(scripted, publisher)


@pytest.fixture
def options(scripted: Any, publisher: Publisher) -> dict[str, Any]:
    return {"step_port": scripted.port, "state_port": publisher.port, "rcv_timeout_ms": round(1e3 * DEADLINE_S)}


@pytest.fixture
async def client(plugin: Plugin, options: dict[str, Any]) -> AsyncIterator[URLabClient]:
    async with URLabClient("tcp://127.0.0.1", **options) as made:
        yield made


class TestInTheBackground:
    async def test_nothing_is_received_before_discover_nor_outside_live_mode(
        self, client: URLabClient, publisher: Publisher
    ) -> None:
        await client.discover()
        await publisher.subscribed(STATE, TOPIC)
        await client.runtime.set_mode("direct")
        await publisher.subscribed()
        await client.runtime.set_mode("live")
        await publisher.subscribed(STATE, TOPIC)

    async def test_state_and_clocks_follow(self, client: URLabClient, plugin: Plugin, publisher: Publisher) -> None:
        await client.discover()
        art = client.articulations["arm0"]
        await publisher.subscribed(STATE, TOPIC)
        crate = {"xpos": [1.0, 2.0, 3.0], "xquat": [1.0, 0.0, 0.0, 0.0]}
        crate |= {"qpos": [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0], "qvel": [0.0] * 6}
        plugin.tick(2.5, 0.75, entities={"crate": crate})
        await until(lambda: client.sim_time == 2.5)
        assert art.qpos_array.tolist() == [0.75]
        assert art.last_applied_ctrl.tolist() == [0.25]
        assert client.data is not None
        assert (client.data.time, client.data.qpos[art.joints["hip"].qpos_offset]) == (2.5, 0.75)
        assert client.entities["crate"].root_pos_w.tolist() == [1.0, 2.0, 3.0]
        assert (client.sim_time_nsec, client.wall_time_sec) == (500_000_000, 200)

    async def test_a_snapshot_that_a_reply_overtook_is_not_taken_over(
        self, client: URLabClient, plugin: Plugin, publisher: Publisher
    ) -> None:
        await client.discover()
        await publisher.subscribed(STATE, TOPIC)
        art = client.articulations["arm0"]
        await client.step()
        async with client.state_stream("all") as arrivals:
            plugin.tick(0.4, 0.4, wall=99.9)
            assert (await arrivals.receive()).time == 0.4  # it has been offered to the client's own state, too
            assert (client.sim_time, art.qpos_array.tolist()) == (0.5, [0.5])
            plugin.tick(0.6, 0.6, wall=100.1)
            await until(lambda: client.sim_time == 0.6)
            plugin.tick(0.7, wall=90.0)  # somebody set the server's clock
            await until(lambda: client.sim_time == 0.7)

    async def test_a_snapshot_that_waited_for_the_data_lock_is_not_taken_over_outside_live_mode(
        self, client: URLabClient, plugin: Plugin, publisher: Publisher
    ) -> None:
        await client.discover()
        await publisher.subscribed(STATE, TOPIC)
        live = client._state._live
        with ThreadPoolExecutor(1) as reader:  # in a thread of its own, as the lock is reentrant
            await asyncio.wrap_future(reader.submit(client._data_lock.acquire))
            try:
                plugin.tick(0.4, 0.4)
                await until(lambda: live._retry is not None)
                await client.runtime.set_mode("direct")
            finally:
                await asyncio.wrap_future(reader.submit(client._data_lock.release))
        await until(lambda: live._retry is None)
        assert (client.sim_time, live.stats.absorbed) == (0.0, 0)

    async def test_a_state_that_does_not_fit_is_refused_whole(
        self, client: URLabClient, plugin: Plugin, publisher: Publisher, caplog: pytest.LogCaptureFixture
    ) -> None:
        await client.discover()
        await publisher.subscribed(STATE, TOPIC)
        plugin.tick(5.0, per_articulation={"arm0": {"qpos": [1.0, 2.0], "qvel": [0.0]}})
        await until(lambda: "discover()" in caplog.text)
        assert client.sim_time == 0.0
        plugin.tick(6.0)
        await until(lambda: client.sim_time == 6.0)

    async def test_cameras_follow(self, client: URLabClient, publisher: Publisher) -> None:
        await client.discover()
        camera = client.articulations["arm0"].cameras["wrist"]
        await publisher.subscribed(STATE, TOPIC)
        assert camera.latest_frame is None
        publisher.send(TOPIC, PIXELS)
        await until(lambda: camera.latest_frame is not None)
        frame = camera.latest_frame
        assert frame is not None
        assert frame[0, 0].tolist() == [255, 0, 0, 255]
        await client.runtime.set_mode("direct")
        assert camera.latest_frame is frame

    async def test_pictures_that_nobody_looks_at_need_not_come(
        self, plugin: Plugin, options: dict[str, Any], publisher: Publisher
    ) -> None:
        async with URLabClient("tcp://127.0.0.1", **options, live_pictures=False) as client:
            await client.discover()
            camera = client.articulations["arm0"].cameras["wrist"]
            async with camera.frames("latest") as frames:
                await publisher.subscribed(STATE, TOPIC)
                publisher.send(TOPIC, PIXELS)
                assert (await frames.receive(timeout=DEADLINE_S)).pixels.shape == (2, 2, 4)
            assert camera.latest_frame is None

    async def test_a_malformed_picture_is_skipped(
        self, client: URLabClient, publisher: Publisher, caplog: pytest.LogCaptureFixture
    ) -> None:
        await client.discover()
        camera = client.articulations["arm0"].cameras["wrist"]
        await publisher.subscribed(STATE, TOPIC)
        publisher.send(TOPIC, PIXELS)
        await until(lambda: camera.latest_frame is not None)
        frame = camera.latest_frame
        publisher.send(TOPIC, PIXELS[:-1])
        await until(lambda: camera.latest_frame is not frame or "skipped a malformed picture" in caplog.text)
        assert camera.latest_frame is frame

    async def test_a_camera_that_moved_with_the_next_play_session_is_followed(
        self, client: URLabClient, plugin: Plugin
    ) -> None:
        await client.discover()
        camera = client.articulations["arm0"].cameras["wrist"]
        elsewhere = Publisher()
        try:
            plugin.camera["zmq_endpoint"] = f"tcp://*:{elsewhere.port}"
            async with camera.frames() as frames:
                await client.discover()
                await elsewhere.subscribed(TOPIC)
                elsewhere.send(TOPIC, PIXELS)
                assert "moved" in str((await frames.receive()).gap)
            await until(lambda: camera.latest_frame is not None)
        finally:
            elsewhere.close()

    def test_reception_never_waits_for_the_data_lock(
        self, plugin: Plugin, options: dict[str, Any], publisher: Publisher
    ) -> None:
        """Its holder may be waiting for a call on the client's loop."""
        with urlab_client.URLabClient("tcp://127.0.0.1", **options) as client:
            client.discover()
            with client.state_stream("all") as states:
                asyncio.run(publisher.subscribed(STATE, TOPIC))
                with client._data_lock:
                    for time in range(1, 5):
                        plugin.tick(float(time))
                        assert states.receive().time == time
                    assert client.sim_time == 0.0
                eventually(lambda: client.meta() and client.sim_time == 4.0)


class TestOnRequest:
    async def test_snapshots_rows_and_pictures(self, client: URLabClient, plugin: Plugin, publisher: Publisher) -> None:
        await client.discover()
        camera = client.articulations["arm0"].cameras["wrist"]
        async with client.state_stream() as states, client.row_stream("left") as rows, camera.frames() as frames:
            await publisher.subscribed(STATE, TOPIC, b"arm0/")
            plugin.tick(1.0)
            publisher.send(b"arm0/joint/hip", vectors.load("row_joint").data)
            publisher.send(TOPIC, PIXELS)
            ctrl = (await states.receive()).per_articulation["arm0"].ctrl
            assert ctrl is not None
            assert ctrl.tolist() == [0.25]
            assert (await rows.receive()).component == "hip"
            assert (await frames.receive()).camera == "wrist"
        await publisher.subscribed(STATE, TOPIC)

    async def test_unknown_names_are_refused(self, client: URLabClient) -> None:
        with pytest.raises(URLabError, match=r"discover\(\) first"):
            client.row_stream()
        await client.discover()
        with pytest.raises(KeyError, match="no articulation 'leg'"):
            client.row_stream("leg")

    async def test_events_tell_the_story(self, client: URLabClient, scripted: Any) -> None:
        events = client.events()
        await client.discover()
        await client.sim.stop()
        scripted.on("meta", {"op": "error", "code": "session_expired", "message": "unknown session"})
        with pytest.raises(ConnectionError):
            await client.meta()
        await asyncio.to_thread(scripted.close)
        reborn = type(scripted)(scripted.port)
        try:
            story = [
                ServerConnected, SessionOpened, PlayStarted, PlayEnded, SessionLost, ServerLost, ServerReconnected,
            ]  # fmt: skip
            assert [type(await events.receive()) for _ in story] == story
        finally:
            await asyncio.to_thread(reborn.close)

    async def test_closing_the_client_ends_everything(self, client: URLabClient, publisher: Publisher) -> None:
        await client.discover()
        streams: list[Any] = [client.state_stream(), client.row_stream(), client.events()]
        readers = [asyncio.create_task(anext(stream)) for stream in streams]
        await publisher.subscribed(STATE, TOPIC, b"arm0/", b"scene/")
        await client.close()
        for reader in readers:
            with pytest.raises(StopAsyncIteration):
                await reader
        camera = client.articulations["arm0"].cameras["wrist"]
        for begin in (client.state_stream, client.row_stream, client.events, camera.frames):
            with pytest.raises(ClientClosed):
                begin()


class TestBlocking:
    def test_iterators_and_context_managers(
        self, plugin: Plugin, options: dict[str, Any], publisher: Publisher
    ) -> None:
        with urlab_client.URLabClient("tcp://127.0.0.1", **options) as client:
            client.discover()
            camera = client.articulations["arm0"].cameras["wrist"]
            assert camera.resolution == (2, 2)
            with client.state_stream("all") as states, camera.frames() as frames:
                asyncio.run(publisher.subscribed(STATE, TOPIC))
                for time in range(500):
                    plugin.tick(float(time))
                times = []
                for item in states:
                    times.append(item.time)
                    if len(times) == 500:
                        break
                publisher.send(TOPIC, PIXELS)
                assert next(frames).pixels.shape == (2, 2, 4)
                with pytest.raises(URLabTimeoutError, match="connected to tcp"):
                    states.receive(timeout=0.02)
            assert times == list(range(500))
            assert states.stats.delivered == 500
            assert list(states) == []

    def test_closing_the_client_ends_an_iteration_in_another_thread(
        self, plugin: Plugin, options: dict[str, Any], publisher: Publisher
    ) -> None:
        client = urlab_client.URLabClient("tcp://127.0.0.1", **options)
        stream = client.state_stream()
        with ThreadPoolExecutor(1) as pool:
            reader = pool.submit(list, stream)
            asyncio.run(publisher.subscribed(STATE))
            client.close()
            assert reader.result(DEADLINE_S) == []
        assert list(stream) == []
        with pytest.raises(ClientClosed):
            stream.receive()
        stream.close()

    def test_dropping_a_stream_stops_it(self, plugin: Plugin, options: dict[str, Any], publisher: Publisher) -> None:
        async def publish() -> None:
            await publisher.subscribed(STATE)
            plugin.tick(1.0)

        with urlab_client.URLabClient("tcp://127.0.0.1", **options) as client:
            publishing = threading.Thread(target=asyncio.run, args=(publish(),))
            publishing.start()
            for item in client.state_stream():
                assert item.time == 1.0
                break
            del item
            publishing.join(DEADLINE_S)
            asyncio.run(publisher.subscribed())
