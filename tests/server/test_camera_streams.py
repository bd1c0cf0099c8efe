"""Camera images of live mode, received with a bare SUB socket."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from waiting import eventually
from wire import Wire

from urlab_client.server import SimulatedServer
from urlab_client.server.render.camera_renderer import CameraRenderer
from urlab_client.server.streams import camera_streams
from urlab_client.values.pictures import camera_header

ROBOT = """
<mujoco model="robot">
  <worldbody>
    <camera name="wrist" pos="0 0 3" resolution="16 12"/>
    <camera name="wrist2" pos="0 0 3" resolution="8 6"/>
    <camera name="far" pos="0 0 9" resolution="8 6"/>
    <body name="base"><freejoint name="root"/><geom name="box" type="box" size="4 4 .5" mass="1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT)
    return path


@pytest.fixture
def server(robot: Path) -> Iterator[SimulatedServer]:
    with SimulatedServer(robot, play=True, camera_modes={"robot/wrist": "depth"}) as server:
        yield server


@pytest.fixture
def subscribe() -> Iterator[Callable[[str, str], zmq.Socket[bytes]]]:
    sockets: list[zmq.Socket[bytes]] = []
    with zmq.Context() as context:

        def make(endpoint: str, topic: str) -> zmq.Socket[bytes]:
            socket = context.socket(zmq.SUB)
            sockets.append(socket)
            socket.linger = 0
            socket.rcvtimeo = 30_000
            socket.connect(endpoint)
            socket.subscribe(topic)
            return socket

        yield make
        for socket in sockets:
            socket.close()


def topics(wire: Wire) -> dict[str, Any]:
    return wire.hello()["articulations"][0]["camera_topics"]


def test_each_camera_has_its_port_from_the_first_on(
    server: SimulatedServer, connect: Callable[[SimulatedServer], Wire]
) -> None:
    found = topics(connect(server))
    ports = [int(found[name]["zmq_endpoint"].rpartition(":")[2]) for name in ("wrist", "wrist2", "far")]
    assert ports[0] == server.camera_port
    assert ports == sorted(set(ports))
    assert all(camera["zmq_endpoint"].startswith("tcp://127.0.0.1:") for camera in found.values())


@pytest.mark.opengl
def test_messages_are_topic_and_pixels(
    server: SimulatedServer, connect: Callable[[SimulatedServer], Wire], subscribe: Any
) -> None:
    found = topics(connect(server))
    wrist, far = found["wrist"], found["far"]
    for_wrist = subscribe(wrist["zmq_endpoint"], wrist["zmq_topic"] + " ")
    for_far = subscribe(far["zmq_endpoint"], "")
    for _ in range(2):
        topic, data = for_wrist.recv_multipart()
        assert topic == b"robot/camera/wrist "
        assert np.frombuffer(data, "<f4").reshape(12, 16) == pytest.approx(np.full((12, 16), 250.0), rel=1e-4)
    topic, data = for_far.recv_multipart()
    assert topic == b"robot/camera/far "
    assert len(data) == 8 * 6 * 4


@pytest.mark.opengl
def test_the_stream_shows_live_physics(
    server: SimulatedServer, connect: Callable[[SimulatedServer], Wire], subscribe: Any
) -> None:
    wire = connect(server)
    wrist = topics(wire)["wrist"]
    socket = subscribe(wrist["zmq_endpoint"], wrist["zmq_topic"] + " ")
    socket.recv_multipart()
    wire.ask("set_paused", paused=False)
    eventually(lambda: np.frombuffer(socket.recv_multipart()[1], "<f4").min() >= 300.0)


@pytest.mark.opengl
def test_stepped_modes_publish_nothing(
    server: SimulatedServer, connect: Callable[[SimulatedServer], Wire], subscribe: Any
) -> None:
    wire = connect(server)
    wrist = topics(wire)["wrist"]
    wire.ask("set_mode", mode="direct")
    socket = subscribe(wrist["zmq_endpoint"], wrist["zmq_topic"] + " ")
    wire.ask("set_paused", paused=False)
    for _ in range(3):
        reply = wire.ask("step", n_steps=50, include_cameras={"wrist": "sync"})
    last = np.frombuffer(reply["cameras"]["wrist"]["data"], "<f4").min()
    wire.ask("set_mode", mode="live")
    topic, data = socket.recv_multipart()
    assert topic == b"robot/camera/wrist "
    assert np.frombuffer(data, "<f4").min() >= last


@pytest.mark.opengl
def test_images_go_on_after_one_that_failed(
    server: SimulatedServer,
    connect: Callable[[SimulatedServer], Wire],
    subscribe: Any,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    wrist = topics(connect(server))["wrist"]
    with monkeypatch.context() as patch:
        failed = threading.Event()

        def fail(*_: object) -> None:
            failed.set()
            raise MemoryError("no room for pixels")

        patch.setattr(CameraRenderer, "frames", fail)
        socket = subscribe(wrist["zmq_endpoint"], wrist["zmq_topic"] + " ")
        assert failed.wait(30.0)
    assert socket.recv_multipart()[0] == b"robot/camera/wrist "
    assert "no room for pixels" in caplog.text
    assert server.failure is None


@pytest.mark.opengl
def test_an_image_that_fails_costs_the_other_cameras_nothing(
    robot: Path,
    connect: Callable[[SimulatedServer], Wire],
    subscribe: Any,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def header(number: int, sim_time: float, width: int, height: int, captured: float) -> bytes:
        if width == 16:
            raise struct.error("no header for this one")
        return camera_header(number, sim_time, width, height, captured)

    monkeypatch.setattr(camera_streams, "camera_header", header)
    with SimulatedServer(robot, play=True, dialect="beta") as server:
        wire = connect(server)
        wire.hello()
        wire.ask("set_mode", mode="direct")
        on = {name: {"zmq": True} for name in ("robot/wrist", "robot/far")}
        told = wire.ask("set_camera_streaming", cameras=on)["cameras"]
        wrist, far = (subscribe(told[name]["zmq_endpoint"], f"{name} ") for name in on)
        while "no header for this one" not in caplog.text:  # from here on, both cameras have a subscriber
            wire.ask("step")
            assert far.recv_multipart()[0] == b"robot/far "
        wire.ask("step")
        assert far.recv_multipart()[0] == b"robot/far "
        assert not wrist.poll(0)
    assert "an image of 'robot/wrist' is not published" in caplog.text


@pytest.mark.opengl
def test_streams_survive_a_new_play_session(
    server: SimulatedServer, connect: Callable[[SimulatedServer], Wire], subscribe: Any
) -> None:
    wire = connect(server)
    before = topics(wire)
    wire.ask("stop_pie")
    wire.ask("begin_pie")
    found = topics(wire)
    assert found.keys() == before.keys()
    for camera in found.values():
        socket = subscribe(camera["zmq_endpoint"], camera["zmq_topic"] + " ")
        assert socket.recv_multipart()[0] == camera["zmq_topic"].encode() + b" "
