"""Streams from scripted publishers on real sockets: what they hand out, what they drop, how they end."""

from __future__ import annotations

import asyncio
import gc
import logging
import socket
import sys
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from publisher import Publisher
from relay import Relay
from waiting import DEADLINE_S, pass_time, until

from urlab_client.aio.streams.events import EventBus
from urlab_client.aio.streams.live_state import LiveState
from urlab_client.aio.streams.sources import Camera, CameraSource, RowFilter, RowSource, StateSource
from urlab_client.aio.streams.stream import Stream
from urlab_client.aio.transport.subscriber import Subscriptions
from urlab_client.errors import (
    ClientClosed,
    ConcurrentReadError,
    ProtocolError,
    StreamOverflow,
    URLabError,
    URLabTimeoutError,
)
from urlab_client.events import PlayStarted, ServerConnected, ServerLost, ServerReconnected
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.messages.streams import RowSample, StateSnapshot
from urlab_client.protocol.rows import BaseStateRow, JointRow, SensorRow
from urlab_client.protocol.topics import TopicKind

sys.path.append(str(Path(__file__).parents[1] / "protocol"))
import vectors

STATE = b"state/full"
GOLDEN = vectors.load("msg_state_full").frames


def snapshot(time: float, **changes: Any) -> bytes:
    """A `state/full` payload: the golden one at another time."""
    plain = msgspec.msgpack.decode(GOLDEN[1])
    return msgspec.msgpack.encode(plain | {"time": time} | changes)


@pytest.fixture
async def publisher() -> AsyncIterator[Publisher]:
    made = Publisher()
    yield made
    made.close()


@pytest.fixture
async def subscriptions() -> AsyncIterator[Subscriptions]:
    made = Subscriptions()
    yield made
    made.close()


@pytest.fixture
def state(subscriptions: Subscriptions, publisher: Publisher) -> StateSource:
    return StateSource(subscriptions, lambda: publisher.endpoint)


def latest(source: Any, **options: Any) -> Stream[Any]:
    return Stream(source, policy="latest", **{"default_timeout": DEADLINE_S, **options})


def everything(source: Any, **options: Any) -> Stream[Any]:
    return Stream(source, policy="all", **{"default_timeout": DEADLINE_S, **options})


async def turns() -> None:
    """Let the loop do what is due, and what that leads to."""
    for _ in range(5):
        await asyncio.sleep(0)


class Marker:
    """Tells when everything sent before has arrived: one socket keeps the order."""

    def __init__(self, source: StateSource, publisher: Publisher) -> None:
        self._publisher = publisher
        self._stream = everything(source, buffer=100_000)

    async def __aenter__(self) -> Self:
        await self._stream.__aenter__()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._stream.aclose()

    async def passed(self) -> None:
        self._publisher.send(STATE, snapshot(-1.0))
        while (await self._stream.receive()).time != -1.0:
            pass


def camera_at(endpoint: str, mode: str = "real", topic: str = "arm0/camera/wrist") -> Camera:
    info = CameraInfo(mode=mode, resolution=(2, 2), fovy=45.0, zmq_endpoint=endpoint, zmq_topic=topic)
    return Camera("wrist", info)


class TestWhatIsHandedOut:
    async def test_snapshots_are_typed(self, publisher: Publisher, state: StateSource) -> None:
        async with latest(state) as states:
            await publisher.subscribed(STATE)
            publisher.send(*GOLDEN)
            found = await states.receive()
        robot = found.per_articulation["g1"]
        assert robot.qpos.dtype == np.float64
        assert robot.qvel.tolist() == [0.0, 1.5]
        assert (found.time, found.step, type(found.step)) == (12.345678901, 42, int)
        assert (found.sim_time.nsec, found.wall_time.sec) == (345678900, 1750000000)
        assert robot.sensors == {"imu_acc": [0.0, 0.0, 9.81]}
        assert (robot.twist.linear, robot.actions) == ((0.5, -0.25, 0.0), 5)
        assert found.entities == {}
        assert (found.seq, found.dropped, found.gap) == (1, 0, None)

    async def test_rows_are_typed(self, publisher: Publisher, subscriptions: Subscriptions) -> None:
        source = RowSource(subscriptions, lambda: publisher.endpoint, RowFilter(["g1"]))
        async with everything(source) as rows:
            await publisher.subscribed(b"g1/")
            messages = [vectors.load(name) for name in ("msg_joint", "msg_base_state", "msg_sensor")]
            for message in messages:
                publisher.send(*message.frames)
            found: list[RowSample] = [await rows.receive() for _ in messages]
        assert [(row.kind, f"{row.owner}/{row.kind}/{row.component}") for row in found] == [
            (kind, message.decoded["topic"])
            for kind, message in zip((TopicKind.JOINT, TopicKind.BASE_STATE, TopicKind.SENSOR), messages, strict=True)
        ]
        joint, base, sensor = (sample.row for sample in found)
        assert joint == JointRow(id=7, position=0.5, velocity=-1.25, acceleration=2.0)
        assert isinstance(base, BaseStateRow)
        assert isinstance(sensor, SensorRow)
        assert base.position.tolist() == messages[1].decoded["pos"]

    @pytest.mark.parametrize(
        ("vector", "mode", "key"),
        [("msg_camera_real_2x2", "real", "rows_top_down_rgba"), ("msg_camera_depth_2x2", "depth", "rows_top_down_m")],
    )
    async def test_pictures_are_arrays(
        self, publisher: Publisher, subscriptions: Subscriptions, vector: str, mode: str, key: str
    ) -> None:
        message = vectors.load(vector)
        topic = message.decoded["topic"].removesuffix(" ")
        camera = camera_at(f"tcp://0.0.0.0:{publisher.port}", mode, topic)  # in bind form, as the plugin reports it
        async with latest(CameraSource(subscriptions, camera, lambda: "127.0.0.1")) as frames:
            await publisher.subscribed(f"{topic} ".encode())
            publisher.send(*message.frames)
            frame = await frames.receive()
        np.testing.assert_allclose(frame.pixels, message.decoded[key])
        assert (frame.camera, frame.mode, frame.frame_id, frame.sim_time) == ("wrist", mode, None, None)
        frame.pixels[:] = 0  # the reader's own

    async def test_pictures_of_newer_servers_say_more(self, publisher: Publisher, subscriptions: Subscriptions) -> None:
        source = CameraSource(subscriptions, camera_at(publisher.endpoint), lambda: "127.0.0.1")
        async with latest(source) as frames:
            await publisher.subscribed(b"arm0/camera/wrist ")
            publisher.send(b"arm0/camera/wrist ", vectors.load("camera_peer_header_v2").data)
            frame = await frames.receive()
        assert (frame.frame_id, frame.sim_time, frame.capture_time) == (4242, 1.5, 1750000000.25)

    async def test_iteration_and_direct_reads_go_together(self, publisher: Publisher, state: StateSource) -> None:
        async with everything(state) as states:
            await publisher.subscribed(STATE)
            for time in range(5):
                publisher.send(STATE, snapshot(time))
            assert (await states.receive()).time == 0
            times = []
            async for item in states:
                times.append(item.time)
                if len(times) == 4:
                    break
        assert times == [1, 2, 3, 4]
        assert states.stats.delivered == 5

    async def test_opens_with_its_first_use(self, publisher: Publisher, state: StateSource) -> None:
        states = latest(state)
        assert states.receive_nowait() is None
        assert publisher.filters == set()
        reader = asyncio.create_task(anext(states))
        await publisher.subscribed(STATE)
        publisher.send(STATE, snapshot(1.0))
        assert (await reader).time == 1.0
        await states.aclose()

    @given(st.binary(max_size=64) | st.binary(max_size=16).map(lambda end: GOLDEN[1][: -len(end) or None] + end))
    def test_nonsense_is_a_protocol_error(self, payload: bytes) -> None:
        try:
            StateSnapshot.decode(payload, "state/full")
        except ProtocolError as error:
            assert "state/full" in str(error)  # noqa: PT017  # some of it is not nonsense


class TestNarrowness:
    async def test_topics_that_only_begin_alike_are_not_taken(
        self, publisher: Publisher, subscriptions: Subscriptions, state: StateSource
    ) -> None:
        knee = RowSource(subscriptions, lambda: publisher.endpoint, RowFilter(["g1"], ["joint"], ["knee"]))
        camera = CameraSource(subscriptions, camera_at(publisher.endpoint), lambda: "127.0.0.1")
        row = vectors.load("row_joint").data
        pixels = vectors.load("msg_camera_real_2x2").frames[1]
        async with everything(state) as states, everything(knee) as rows, everything(camera) as frames:
            await publisher.until(lambda: {STATE, b"g1/joint/knee", b"arm0/camera/wrist "} <= publisher.filters)
            for topic in b"state/fuller", b"g1/joint/knee2", b"g1/joint/knee/x", b"arm0/camera/wrist 2":
                publisher.send(topic, snapshot(0.0))
            publisher.send(b"g1/joint/knee", row)
            publisher.send(STATE, snapshot(1.0))
            publisher.send(b"arm0/camera/wrist ", pixels)
            found = await states.receive(), await rows.receive(), await frames.receive()
            assert [item.seq for item in found] == [1, 1, 1]
            assert [stream.stats.malformed for stream in (states, rows, frames)] == [0, 0, 0]

    @pytest.mark.parametrize(
        ("articulations", "kinds", "components", "entities", "filters"),
        [
            (["g1"], [], [], False, {b"g1/"}),
            (["g1", "g10"], [], [], True, {b"g1/", b"g10/", b"scene/"}),
            (["g1"], ["sensor", "twist"], [], False, {b"g1/sensor/", b"g1/twist"}),
            (["g1"], ["joint"], ["hip", "knee"], False, {b"g1/joint/hip", b"g1/joint/knee"}),
            ([], ["xpos"], [], False, {b"scene/"}),
        ],
    )
    async def test_rows_are_subscribed_narrowly(
        self,
        publisher: Publisher,
        subscriptions: Subscriptions,
        articulations: list[str],
        kinds: list[str],
        components: list[str],
        entities: bool,
        filters: set[bytes],
    ) -> None:
        endpoint = publisher.endpoint
        source = RowSource(
            subscriptions, lambda: endpoint, RowFilter(articulations, kinds, components, entities=entities)
        )
        async with latest(source):
            await publisher.subscribed(*filters)

    @pytest.mark.parametrize(
        ("articulations", "kinds", "problem"),
        [([], [], "no articulation to receive rows from"), (["g1"], ["camera"], "no rows of kind camera")],
    )
    async def test_impossible_rows_are_refused(
        self, subscriptions: Subscriptions, articulations: list[str], kinds: list[str], problem: str
    ) -> None:
        with pytest.raises(ValueError, match=problem):
            RowSource(subscriptions, lambda: "tcp://127.0.0.1:1", RowFilter(articulations, kinds))

    async def test_rows_of_components_that_are_not_compiled_are_left_out(
        self, publisher: Publisher, subscriptions: Subscriptions
    ) -> None:
        async with everything(RowSource(subscriptions, lambda: publisher.endpoint, RowFilter(["g1"]))) as rows:
            await publisher.subscribed(b"g1/")
            publisher.send(b"g1/joint/ghost", vectors.load("row_joint_unbound").data)
            publisher.send(b"g1/sensor/ghost", vectors.load("row_sensor_unbound").data)
            publisher.send(b"g1/joint/knee", vectors.load("row_joint").data)
            assert (await rows.receive()).component == "knee"
            assert rows.stats.received == 1

    async def test_two_streams_share_one_subscription(self, publisher: Publisher, state: StateSource) -> None:
        async with latest(state) as second:
            async with latest(state) as first:
                await publisher.subscribed(STATE)
                publisher.send(STATE, snapshot(1.0))
                assert (await first.receive()).time == (await second.receive()).time == 1.0
            publisher.send(STATE, snapshot(2.0))
            assert (await second.receive()).time == 2.0
            assert publisher.filters == {STATE}
        await publisher.subscribed()


class TestPolicies:
    async def test_latest_skips_to_the_newest_and_decodes_nothing_else(
        self, publisher: Publisher, state: StateSource
    ) -> None:
        async with latest(state) as states, Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            publisher.send(STATE, snapshot(0.0))
            assert (await states.receive()).time == 0.0
            for _ in range(3):
                publisher.send(STATE, b"never looked at")
            await marker.passed()
            publisher.send(STATE, snapshot(5.0))
            await marker.passed()
            item = await states.receive()
        assert (item.time, item.seq, item.dropped) == (-1.0, 7, 5)
        assert (states.stats.dropped, states.stats.malformed) == (5, 0)

    async def test_latest_per_key_keeps_the_newest_row_of_each_topic(
        self, publisher: Publisher, subscriptions: Subscriptions, state: StateSource
    ) -> None:
        source = RowSource(subscriptions, lambda: publisher.endpoint, RowFilter(["g1"]))
        rows = Stream(source, policy="latest_per_key", default_timeout=DEADLINE_S)
        async with rows, Marker(state, publisher) as marker:
            await publisher.subscribed(b"g1/", STATE)
            for position in 1.0, 2.0, 3.0:
                publisher.send(b"g1/joint/hip", JointRow(1, position, 0.0, 0.0).encode())
                publisher.send(b"g1/joint/knee", JointRow(2, -position, 0.0, 0.0).encode())
            await marker.passed()
            found = [await rows.receive(), await rows.receive()]
            assert rows.receive_nowait() is None
        assert [(row.component, row.row.position, row.dropped) for row in found] == [("hip", 3.0, 2), ("knee", -3.0, 2)]

    async def test_all_loses_nothing_within_its_limits(self, publisher: Publisher, state: StateSource) -> None:
        async with everything(state) as states:
            await publisher.subscribed(STATE)
            for time in range(500):
                publisher.send(STATE, snapshot(time))
            items = [await states.receive() for _ in range(500)]
        assert [item.time for item in items] == list(range(500))
        assert {item.dropped for item in items} == {0}

    @pytest.mark.parametrize("limit", [{"buffer": 10}, {"buffer_bytes": 10 * len(GOLDEN[1])}])
    async def test_a_reader_that_falls_behind_is_told_and_goes_on(
        self, publisher: Publisher, state: StateSource, limit: dict[str, int]
    ) -> None:
        async with everything(state, **limit) as states, Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            for time in range(30):
                publisher.send(STATE, snapshot(time))
            await marker.passed()
            assert states.stats.waiting == 10
            with pytest.raises(StreamOverflow, match=r"21 messages were lost, 10 are buffered.*buffer=") as told:
                await states.receive()
            assert "state_stream" in str(told.value)
            items = [await states.receive() for _ in range(10)]
            assert [item.time for item in items] == [*range(21, 30), -1.0]
            assert [item.dropped for item in items] == [21] + [0] * 9
            publisher.send(STATE, snapshot(40.0))
            assert (await states.receive()).seq == 32

    async def test_a_reader_that_never_reads_costs_no_memory(self, publisher: Publisher, state: StateSource) -> None:
        async with everything(state, buffer=5) as states, Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            for _ in range(10):
                for _ in range(300):
                    publisher.send(STATE, snapshot(0.0))
                await marker.passed()
            stats = states.stats
            assert (stats.received, stats.waiting, stats.dropped) == (3010, 5, 3005)

    async def test_latest_may_be_looked_at_without_taking_it(self, publisher: Publisher, state: StateSource) -> None:
        async with latest(state) as states, Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            assert states.latest() is None
            await marker.passed()
            seen = await asyncio.to_thread(states.latest)
            assert seen is not None
            assert seen.time == -1.0
            assert await states.receive() is seen
            assert states.latest() is seen
            publisher.send(STATE, snapshot(1.0))
            publisher.send(STATE, b"nonsense")
            await until(lambda: states.stats.received == 3)
            assert states.latest() is seen, "the newest that can be understood"
            assert states.receive_nowait() is None
            stats = states.stats
            assert (stats.delivered, stats.dropped, stats.malformed, stats.waiting) == (1, 1, 1, 0)

    async def test_what_is_lost_after_an_item_was_looked_at_is_told_with_it(
        self, publisher: Publisher, state: StateSource
    ) -> None:
        async with everything(state, buffer=2) as states, Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            for time in (1.0, 2.0):
                publisher.send(STATE, snapshot(time))
            await until(lambda: states.stats.received == 2)
            seen = states.latest()
            assert seen is not None
            assert (seen.time, seen.dropped) == (2.0, 0)
            await marker.passed()
            with pytest.raises(StreamOverflow, match="1 messages were lost"):
                await states.receive()
            assert await states.receive() is seen
            assert seen.dropped == 1

    @pytest.mark.parametrize(
        ("options", "problem"),
        [
            ({"policy": "newest"}, "'newest' is not a valid StreamPolicy"),
            ({"policy": "all", "buffer": 0}, "at least one item"),
        ],
    )
    async def test_impossible_options_are_refused(
        self, state: StateSource, options: dict[str, Any], problem: str
    ) -> None:
        with pytest.raises(ValueError, match=problem):
            Stream(state, **options)


class TestFaults:
    @pytest.mark.parametrize(
        "frames",
        [
            [b""],
            [b"\xc1"],
            [GOLDEN[1][:-1]],
            [GOLDEN[1] + b"\x00"],
            [msgspec.msgpack.encode({"op": "state_full"})],
            [snapshot(0.0, step=1.5)],
            [snapshot(0.0, op="step_ok")],
            [snapshot(0.0, per_articulation={"g1": {"qpos": [[1.0]], "qvel": []}})],
            [],
            [GOLDEN[1], b"more"],
        ],
    )
    async def test_a_malformed_message_is_counted_and_skipped(
        self, publisher: Publisher, state: StateSource, frames: list[bytes], caplog: pytest.LogCaptureFixture
    ) -> None:
        async with everything(state) as states:
            await publisher.subscribed(STATE)
            for _ in range(3):
                publisher.send(STATE, *frames)
            publisher.send(STATE, snapshot(1.0))
            item = await states.receive()
            assert (item.time, item.seq, item.dropped) == (1.0, 4, 3)
            assert (states.stats.malformed, states.stats.delivered) == (3, 1)
        # asyncio's own, in debug mode, is about a machine that was busy.
        warnings = [
            record for record in caplog.records if record.levelno == logging.WARNING and record.name != "asyncio"
        ]
        assert len(warnings) == 1
        assert "state_stream: skipped a malformed message" in warnings[0].getMessage()

    async def test_a_picture_of_the_wrong_size_is_skipped(
        self, publisher: Publisher, subscriptions: Subscriptions
    ) -> None:
        topic, pixels = vectors.load("msg_camera_real_2x2").frames
        source = CameraSource(subscriptions, camera_at(publisher.endpoint), lambda: "127.0.0.1")
        async with everything(source) as frames:
            await publisher.subscribed(topic)
            for payload in pixels[:-4], pixels + b"more", pixels:
                publisher.send(topic, payload)
            assert (await frames.receive()).dropped == 2

    async def test_a_lost_publisher_is_found_again_and_the_next_item_says_so(
        self, subscriptions: Subscriptions
    ) -> None:
        first = Publisher()
        source = StateSource(subscriptions, lambda: first.endpoint)
        async with everything(source) as states:
            await first.subscribed(STATE)
            first.send(STATE, snapshot(1.0))
            assert (await states.receive()).gap is None
            first.close()
            second = Publisher(first.port)
            try:
                await second.subscribed(STATE)
                second.send(STATE, snapshot(2.0))
                second.send(STATE, snapshot(3.0))
                items = [await states.receive(), await states.receive()]
            finally:
                second.close()
            assert items[0].gap is not None
            assert items[0].gap.startswith("reconnected after ")
            assert (items[1].gap, states.stats.gaps) == (None, 1)

    async def test_a_publisher_that_zeromq_has_given_up_is_found_again(
        self, publisher: Publisher, subscriptions: Subscriptions, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("urlab_client.aio.transport.connection._RECONNECT_MS", -1)  # to ZeroMQ: never
        async with (
            Relay(publisher.port) as relay,
            everything(StateSource(subscriptions, lambda: f"tcp://127.0.0.1:{relay.port}")) as states,
        ):
            await publisher.subscribed(STATE)
            relay.cut()
            await publisher.subscribed()
            await publisher.subscribed(STATE)
            publisher.send(STATE, snapshot(1.0))
            assert "reconnected after" in str((await states.receive()).gap)

    async def test_a_camera_that_moved_is_followed(self, publisher: Publisher, subscriptions: Subscriptions) -> None:
        topic, pixels = vectors.load("msg_camera_real_2x2").frames
        elsewhere = Publisher()
        camera = camera_at(publisher.endpoint)
        try:
            async with latest(CameraSource(subscriptions, camera, lambda: "127.0.0.1")) as frames:
                await publisher.subscribed(topic)
                subscriptions.refresh()
                camera.info = camera_at(elsewhere.endpoint).info
                subscriptions.refresh()
                await elsewhere.subscribed(topic)
                await publisher.subscribed()
                elsewhere.send(topic, pixels)
                frame = await frames.receive()
                assert frame.gap == f"moved from {publisher.endpoint} to {elsewhere.endpoint}"
        finally:
            elsewhere.close()

    async def test_a_camera_that_moved_to_nowhere_ends_its_stream(
        self, publisher: Publisher, subscriptions: Subscriptions
    ) -> None:
        camera = camera_at(publisher.endpoint)
        async with latest(CameraSource(subscriptions, camera, lambda: "127.0.0.1")) as frames:
            camera.info = camera_at("tcp://0.0.0.0").info
            subscriptions.refresh()
            with pytest.raises(URLabError, match=r"unusable address.*no port"):
                await frames.receive()

    async def test_a_malformed_endpoint_is_refused(self, subscriptions: Subscriptions) -> None:
        with pytest.raises(ValueError, match="is not an address that ZeroMQ can connect to"):
            await latest(StateSource(subscriptions, lambda: "tcp://nowhere")).receive()


class TestWaiting:
    async def test_without_a_publisher_the_timeout_says_who_refused(self, subscriptions: Subscriptions) -> None:
        nobody = socket.socket()  # has the port, and does not listen
        nobody.bind(("127.0.0.1", 0))
        endpoint = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
        with nobody:
            async with latest(StateSource(subscriptions, lambda: endpoint)) as states:
                await until(lambda: "refused" in subscriptions.line(states._state).obstacle)  # type: ignore[union-attr]
                with pytest.raises(
                    URLabTimeoutError,
                    match=rf"state_stream: no connection to {endpoint} within 300 ms: connection refused",
                ) as raised:
                    await states.receive(timeout=0.3)
        assert isinstance(raised.value, TimeoutError)
        assert "client.sim.start()" in str(raised.value)

    @pytest.mark.parametrize("live", [True, False])
    async def test_a_server_that_prepares_its_first_picture_has_time(
        self, subscriptions: Subscriptions, publisher: Publisher, live: bool
    ) -> None:
        camera = camera_at(publisher.endpoint)
        source = CameraSource(subscriptions, camera, lambda: "127.0.0.1", live=lambda: live)
        async with latest(source, default_timeout=1.0) as frames:
            first = asyncio.ensure_future(frames.receive())
            await publisher.subscribed(b"arm0/camera/wrist ")
            await until(lambda: source.first_after(frames._state) == (30.0 if live else 0.0))
            pass_time(2.0)
            await turns()
            if live:
                publisher.send(b"arm0/camera/wrist ", bytes(16))
                assert (await first).pixels.shape == (2, 2, 4)
                first = asyncio.ensure_future(frames.receive())
                await turns()
                pass_time(2.0)
            with pytest.raises(URLabTimeoutError, match=r"nothing arrived within 1000 ms.*initialises OpenGL"):
                await first

    async def test_the_first_picture_has_its_deadline_too(
        self, subscriptions: Subscriptions, publisher: Publisher
    ) -> None:
        source = CameraSource(subscriptions, camera_at(publisher.endpoint), lambda: "127.0.0.1", live=lambda: True)
        async with latest(source, default_timeout=1.0) as frames:
            first = asyncio.ensure_future(anext(frames))
            await publisher.subscribed(b"arm0/camera/wrist ")
            await until(lambda: source.first_after(frames._state))
            pass_time(2.0)
            await turns()
            pass_time(40.0)
            with pytest.raises(URLabTimeoutError, match=r"nothing arrived within 30000 ms.*initialises OpenGL"):
                await first
            with pytest.raises(URLabTimeoutError, match="within 10 ms"):
                await frames.receive(timeout=0.01)

    async def test_a_silent_publisher_is_told_apart_and_the_stream_goes_on(
        self, publisher: Publisher, subscriptions: Subscriptions
    ) -> None:
        rows = everything(RowSource(subscriptions, lambda: publisher.endpoint, RowFilter(["g1"], ["joint"])))
        async with rows:
            await publisher.subscribed(b"g1/joint/")
            with pytest.raises(
                URLabTimeoutError, match=r"row_stream: connected to .* within 20 ms on topics 'g1/joint/'"
            ):
                await rows.receive(timeout=0.02)
            publisher.send(*vectors.load("msg_joint").frames)
            assert (await rows.receive()).component == "left_knee"

    async def test_a_lost_publisher_is_told_apart(self, subscriptions: Subscriptions) -> None:
        publisher = Publisher()
        async with latest(StateSource(subscriptions, lambda: publisher.endpoint)) as states:
            await publisher.subscribed(STATE)
            publisher.send(STATE, snapshot(1.0))
            await states.receive()
            publisher.close()
            await until(lambda: not subscriptions.line(states._state).connected)  # type: ignore[union-attr]
            with pytest.raises(URLabTimeoutError, match="the connection was lost and not restored"):
                await states.receive(timeout=0.3)

    async def test_iteration_does_not_wait_for_ever_for_a_first_item(
        self, publisher: Publisher, state: StateSource
    ) -> None:
        async with latest(state, default_timeout=0.05) as states:
            await publisher.subscribed(STATE)
            with pytest.raises(URLabTimeoutError, match="within 50 ms"):
                await anext(states)
            publisher.send(STATE, snapshot(1.0))
            assert (await states.receive(timeout=DEADLINE_S)).time == 1.0
            with pytest.raises(TimeoutError) as raised:
                async with asyncio.timeout(0.1):  # later ones may be long in coming: a server restarts, play is stopped
                    await anext(states)
            assert not isinstance(raised.value, URLabTimeoutError)

    async def test_a_limit_for_each_item_can_be_had(self, publisher: Publisher, state: StateSource) -> None:
        async with latest(state, timeout=0.05) as states:
            await publisher.subscribed(STATE)
            publisher.send(STATE, snapshot(1.0))
            assert (await states.receive(timeout=DEADLINE_S)).time == 1.0
            with pytest.raises(URLabTimeoutError):
                await anext(states)

    async def test_a_cancelled_reader_loses_nothing(self, publisher: Publisher, state: StateSource) -> None:
        async with everything(state) as states, Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            reader = asyncio.create_task(states.receive())
            await asyncio.sleep(0)
            reader.cancel()
            await marker.passed()
            with pytest.raises(asyncio.CancelledError):
                await reader
            assert (await states.receive()).seq == 1

    async def test_a_reader_cancelled_when_its_item_is_there_loses_nothing(
        self, publisher: Publisher, state: StateSource
    ) -> None:
        async with everything(state) as states:
            await publisher.subscribed(STATE)
            reader = asyncio.create_task(states.receive())
            publisher.send(STATE, snapshot(1.0))
            await until(lambda: states.stats.received)
            reader.cancel()
            try:
                item = await reader
            except asyncio.CancelledError:
                item = await states.receive()
            assert item.time == 1.0

    async def test_a_second_reader_is_refused(self, publisher: Publisher, state: StateSource) -> None:
        async with latest(state) as states:
            await publisher.subscribed(STATE)
            reader = asyncio.create_task(anext(states))
            await asyncio.sleep(0)
            with pytest.raises(ConcurrentReadError, match="already waiting"):
                await states.receive()
            with pytest.raises(ConcurrentReadError):
                states.receive_nowait()
            publisher.send(STATE, snapshot(1.0))
            assert (await reader).time == 1.0

    async def test_a_flood_leaves_other_tasks_their_turn(self, publisher: Publisher, state: StateSource) -> None:
        async with everything(state, buffer=10_000) as states:
            await publisher.subscribed(STATE)
            for _ in range(1000):
                publisher.send(STATE, GOLDEN[1])
            turns = 0
            async with asyncio.timeout(DEADLINE_S):
                while states.stats.received < 1000:
                    turns += 1
                    await asyncio.sleep(0)
            assert turns > 10

    async def test_reads_from_another_thread_account_for_everything(
        self, publisher: Publisher, state: StateSource
    ) -> None:
        """As the blocking façade does, which reads what waits without a way through the loop."""
        async with everything(state, buffer=50) as states, Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            done = threading.Event()

            def read() -> tuple[int, int]:
                items = dropped = 0
                while True:
                    finished = done.is_set()
                    try:
                        item = states.receive_nowait()
                    except StreamOverflow:
                        continue
                    if item is not None:
                        states.latest()
                        items, dropped = items + 1, dropped + item.dropped
                    elif finished:
                        return items, dropped

            reader = asyncio.create_task(asyncio.to_thread(read))
            for _ in range(20):
                for _ in range(100):
                    publisher.send(STATE, snapshot(0.0))
                await marker.passed()
            done.set()
            items, dropped = await reader
            stats = states.stats
            assert (stats.received, stats.delivered, stats.dropped) == (2020, items, dropped)
            assert items + dropped == 2020


class TestEnds:
    async def test_closing_ends_the_iteration_of_a_waiting_reader(
        self, publisher: Publisher, state: StateSource
    ) -> None:
        states = latest(state)

        async def read() -> list[Any]:
            return [item async for item in states]

        reader = asyncio.create_task(read())
        await publisher.subscribed(STATE)
        await states.aclose()
        await states.aclose()
        assert await reader == []
        assert states.closed
        await publisher.subscribed()
        assert [item async for item in states] == []
        for again in (states.receive, states.__aenter__):
            with pytest.raises(URLabError, match="The stream was closed"):
                await again()
        assert states.receive_nowait() is None

    async def test_a_closed_client_is_told_after_what_had_arrived(
        self, publisher: Publisher, subscriptions: Subscriptions, state: StateSource
    ) -> None:
        states, waiting = everything(state), latest(state)
        async with Marker(state, publisher) as marker, states, waiting:
            await publisher.subscribed(STATE)
            publisher.send(STATE, snapshot(1.0))
            await marker.passed()
            await waiting.receive()
            reader = asyncio.create_task(anext(waiting))
            await asyncio.sleep(0)
            subscriptions.close()
            subscriptions.close()
            with pytest.raises(StopAsyncIteration):
                await reader
            assert [state.time async for state in states] == [1.0, -1.0]
            for _ in range(2):
                assert [state async for state in states] == []
                with pytest.raises(ClientClosed):
                    await states.receive()
        with pytest.raises(ClientClosed):
            await latest(state).receive()

    async def test_a_dropped_stream_stops_receiving(self, publisher: Publisher, state: StateSource) -> None:
        publisher.send(STATE, snapshot(0.0))
        states = latest(state)
        await states.__aenter__()
        await publisher.subscribed(STATE)
        del states
        gc.collect()
        await publisher.subscribed()

    async def test_a_closed_stream_of_pictures_stops_receiving(
        self, publisher: Publisher, subscriptions: Subscriptions
    ) -> None:
        camera = camera_at(f"tcp://127.0.0.1:{publisher.port}")
        async with latest(CameraSource(subscriptions, camera, lambda: "127.0.0.1")):
            await publisher.subscribed(b"arm0/camera/wrist ")
        await publisher.subscribed()

    async def test_a_stream_stays_with_its_loop(self, publisher: Publisher, state: StateSource) -> None:
        async with latest(state) as states:
            await publisher.subscribed(STATE)
            with pytest.raises(URLabError, match="another event loop"):
                await asyncio.to_thread(asyncio.run, states.receive())


class TestEvents:
    async def test_listeners_hear_what_happens_from_then_on(self) -> None:
        bus = EventBus()
        bus.publish(ServerConnected(endpoint="tcp://early"))
        first, second = bus.stream((), 10), bus.stream((), 10)
        bus.publish(ServerConnected(endpoint="tcp://lab"))
        bus.publish(PlayStarted(articulations=["g1"]))
        heard = [await first.receive(), await first.receive()]
        assert [type(event) for event in heard] == [ServerConnected, PlayStarted]
        assert heard[0].endpoint == "tcp://lab"
        assert [event.seq for event in heard] == [1, 2]
        assert await second.receive() is not heard[0]

    async def test_a_waiting_listener_is_woken(self) -> None:
        bus = EventBus()
        listener = asyncio.create_task(anext(bus.stream((), 10)))
        await asyncio.sleep(0)
        bus.publish(ServerReconnected(endpoint="tcp://lab", down_s=1.5))
        assert await listener == ServerReconnected(
            endpoint="tcp://lab", down_s=1.5, seq=1, recv_wall_time_ns=listener.result().recv_wall_time_ns
        )

    async def test_the_oldest_give_way_visibly(self) -> None:
        bus = EventBus()
        events = bus.stream((), 3)
        for number in range(10):
            bus.publish(ServerLost(endpoint=f"tcp://{number}"))
        event = await events.receive()
        assert isinstance(event, ServerLost)
        assert (event.endpoint, event.dropped) == ("tcp://7", 7)

    async def test_closing_the_client_ends_them(self) -> None:
        bus = EventBus()
        events = bus.stream((), 3)
        bus.publish(ServerLost(endpoint="tcp://lab"))
        bus.close()
        assert [type(event) async for event in events] == [ServerLost]
        with pytest.raises(ClientClosed):
            bus.stream((), 3)

    async def test_only_the_kinds_asked_for_are_heard(self) -> None:
        bus = EventBus()
        events = bus.stream(("lost", PlayStarted), 10)
        for event in (ServerConnected(endpoint="tcp://lab"), ServerLost(endpoint="tcp://lab"), PlayStarted()):
            bus.publish(event)
        heard = [await events.receive(), await events.receive()]
        assert [(type(event), event.seq, event.dropped) for event in heard] == [(ServerLost, 1, 0), (PlayStarted, 2, 0)]
        with pytest.raises(ValueError, match=r"'play_start' is not a kind of event\. Did you mean 'play_started'"):
            bus.stream(["play_start"], 10)
        with pytest.raises(TypeError, match=r"\('lost',\)"):
            bus.stream("lost", 10)

    async def test_nobody_is_kept(self) -> None:
        bus = EventBus()
        events = bus.stream((), 3)
        with pytest.raises(URLabTimeoutError, match="no event within 0 ms"):
            await events.receive(timeout=0)
        await events.aclose()
        dropped = bus.stream((), 3)
        del dropped
        gc.collect()
        assert not bus.heard


class TestBackground:
    """Live mode: the newest snapshot is taken over where it arrives."""

    async def test_the_newest_snapshot_is_taken_over(self, publisher: Publisher, state: StateSource) -> None:
        taken: list[float] = []
        reception = LiveState(state, lambda found: taken.append(found.time), threading.RLock())
        reception.start()
        reception.start()
        async with Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            for time in range(200):
                publisher.send(STATE, snapshot(time))
            await marker.passed()
            assert taken[-1] == -1.0
            assert sorted(taken[:-1]) == taken[:-1]
            assert reception.stats.received == 201
            assert reception.stats.absorbed == len(taken)
            reception.stop()
            await marker.passed()
            assert reception.stats.received == 201
            assert not reception.running

    async def test_the_lock_is_never_waited_for(self, publisher: Publisher, state: StateSource) -> None:
        lock = threading.RLock()
        taken: list[float] = []
        held, release = threading.Event(), threading.Event()

        def hold() -> None:
            with lock:
                held.set()
                release.wait(DEADLINE_S)

        holder = asyncio.create_task(asyncio.to_thread(hold))
        assert await asyncio.to_thread(held.wait, DEADLINE_S)
        reception = LiveState(state, lambda found: taken.append(found.time), lock)
        reception.start()
        async with Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            publisher.send(STATE, snapshot(1.0))
            await marker.passed()
            assert taken == []
        release.set()
        await holder
        await until(lambda: taken)
        assert taken == [-1.0]
        reception.stop()

    async def test_a_snapshot_that_waited_for_the_lock_is_not_taken_over_after_the_end(
        self, publisher: Publisher, state: StateSource
    ) -> None:
        lock = threading.RLock()
        taken: list[float] = []
        reception = LiveState(state, lambda found: taken.append(found.time), lock)
        reception.start()
        with lock:  # of this very thread, which counts as another's
            async with Marker(state, publisher) as marker:
                await publisher.subscribed(STATE)
                await marker.passed()
            loop = asyncio.get_running_loop()
            waiting = [timer for timer in loop._scheduled if not timer.cancelled() and "_try_again" in repr(timer)]
            assert waiting, "it is tried again"
            reception.stop()
        assert all(timer.cancelled() for timer in waiting)
        reception.on_drained()
        assert taken == []

    async def test_what_does_not_fit_is_refused_and_reception_goes_on(
        self, publisher: Publisher, state: StateSource, caplog: pytest.LogCaptureFixture
    ) -> None:
        def absorb(found: StateSnapshot) -> None:
            if found.time > 0:
                raise ProtocolError("state/full: its model has 5.", hint="Call discover().")

        reception = LiveState(state, absorb, threading.RLock())
        reception.start()
        async with Marker(state, publisher) as marker:
            await publisher.subscribed(STATE)
            for number, frames in enumerate(([b"nonsense"], [snapshot(1.0)], [GOLDEN[1], b"more"])):
                publisher.send(STATE, *frames)
                await until(lambda number=number: reception.stats.refused == number + 1)
            await marker.passed()
        assert (reception.stats.absorbed, reception.stats.received) == (1, 4)
        (warning,) = [text for record in caplog.records if "live state" in (text := record.getMessage())]
        assert "was not applied: state snapshot: Expected `object`, got `int`." in warning
        reception.stop()
