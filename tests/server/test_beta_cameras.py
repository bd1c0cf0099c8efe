"""The simulated server's beta over a raw socket: pictures, statement by statement."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from beta_bench import Bench
from raw_shm import RawRegion
from waiting import eventually
from wire import Wire

from urlab_client.server import SimulatedServer
from urlab_client.server.render import camera_renderer
from urlab_client.server.render.camera_renderer import GIVEN_UP, CameraRenderer
from urlab_client.simulation.drawing import Stage


@pytest.mark.opengl
def test_pictures_in_steps(playing: Bench) -> None:
    """Beta statements 48, 49, 50 and 52. Generation 2 statements 25, 26 and 28."""
    assert "cameras" not in playing.step(include_cameras={"cam": "sync"})
    for mode in ("direct", "live"):
        playing.wire.ask("set_mode", mode=mode)
        reply = playing.step(include_cameras={"arm_a/cam": "sync"}, render="sync")
        (frame,) = reply["cameras"].values()
        assert list(frame) == ["width", "height", "frame_id", "sim_time", "dtype", "data"]
        assert frame["frame_id"] >= reply["frame_id"]
    assert "cameras" not in playing.step(include_cameras={"arm_a/cam": {"frame_id": 1e15}})
    assert playing.step(include_cameras={"arm_a/cam": {"frame_id": 1}})["cameras"]
    assert playing.step(include_cameras={"arm_a/cam": 1e15})["cameras"]
    assert set(playing.step(include_cameras=True)["cameras"]) == {"arm_a/cam", f"{playing.b}/cam"}


@pytest.mark.opengl
def test_the_camera_switch(playing: Bench) -> None:
    """Beta statements 53 and 56. Generation 2 statements 35, 36, 38, 39 and 40."""
    on = {"cameras": {"arm_a/cam": {"zmq": True, "shm": False}, "nobody/cam": True}}
    first, second = (playing.wire.ask("set_camera_streaming", **on)["cameras"] for _ in range(2))
    assert first == second
    assert list(first) == ["arm_a/cam"]
    told = first["arm_a/cam"]
    assert (told["streaming"], told["zmq"], told["shm"], told["zmq_topic"]) == (True, True, False, "arm_a/cam")
    both = playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": True, f"{playing.b}/cam": {}})["cameras"]
    assert both["arm_a/cam"]["zmq_endpoint"] != both[f"{playing.b}/cam"]["zmq_endpoint"]
    assert both[f"{playing.b}/cam"]["shm"] is True
    only = playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": {"shm": True}})["cameras"]["arm_a/cam"]
    assert only == {"streaming": True, "zmq": False, "shm": True}
    assert playing.wire.ask("set_camera_streaming", cameras={"nobody/cam": True})["cameras"] == {}
    assert playing.refused("set_camera_streaming", cameras={})[0] == "bad_request"
    assert playing.refused("set_camera_streaming")[0] == "missing_field"
    playing.wire.ask("set_camera_streaming", **on)
    number = playing.step()["frame_id"]
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger = 0
        socket.rcvtimeo = 20_000
        socket.subscribe(b"arm_a/cam ")
        socket.connect(told["zmq_endpoint"])
        topic, payload = socket.recv_multipart()
    assert topic == b"arm_a/cam "
    assert (payload[:4], len(payload)) == (b"UCM1", 64 * 48 * 4 + 40)
    assert int.from_bytes(payload[8:16], "little") == number


@contextmanager
def pictures(endpoint: str, topic: bytes) -> Iterator[zmq.Socket[bytes]]:
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger = 0
        socket.rcvtimeo = 20_000
        socket.subscribe(topic)
        socket.connect(endpoint)
        yield socket


def number_of(message: list[bytes]) -> int:
    return int.from_bytes(message[1][8:16], "little")


def regions(bench: Bench) -> set[str]:
    assert bench.server.shm_dir is not None
    return {path.name for path in bench.server.shm_dir.glob("cam_*.shm")}


@pytest.mark.opengl
def test_a_picture_of_a_later_snapshot(playing: Bench) -> None:
    """Generation 2 statement 27."""
    last = playing.step()["frame_id"]
    for _ in range(3):
        reply = playing.step(include_cameras={"arm_a/cam": {"frame_id": last}})
        assert reply["cameras"]["arm_a/cam"]["frame_id"] >= last
        last = reply["frame_id"]


@pytest.mark.opengl
def test_cameras_are_off_until_they_are_switched_on(playing: Bench) -> None:
    """Generation 2 statements 34 and 44."""
    (told, _) = playing.wire.hello()["articulations"]
    assert regions(playing) == set()
    with pictures(told["camera_topics"]["arm_a/cam"]["zmq_endpoint"].replace("0.0.0.0", "127.0.0.1"), b"") as socket:
        for _ in range(3):
            playing.step(include_cameras=True, render="sync")
        before = playing.step()["frame_id"]
        playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": True})
        playing.step()
        assert number_of(socket.recv_multipart()) >= before, "nothing came before it was switched on"
    eventually(lambda: regions(playing) == {"cam_arm_a_cam.shm"})
    playing.play()
    assert regions(playing) == set()


@pytest.mark.opengl
def test_a_region_has_room_for_the_header(playing: Bench) -> None:
    """Generation 2 statements 37, 41 and 42."""
    both: dict[str, Any] = {"cameras": {"arm_a/cam": {"zmq": True, "shm": True}}}
    told = playing.wire.ask("set_camera_streaming", **both)["cameras"]["arm_a/cam"]
    assert playing.server.shm_dir is not None
    region = RawRegion(playing.server.shm_dir / "cam_arm_a_cam.shm")
    try:
        assert region.header[2] == 64 * 48 * 4 + 44
        playing.step()
        eventually(lambda: region.sequence > 0)
        assert len(region.read()[1]) == 64 * 48 * 4 + 40
        before = region.sequence
        assert playing.wire.ask("set_camera_streaming", **both)["cameras"]["arm_a/cam"] == told
        assert region.sequence >= before
    finally:
        region.close()
    with pictures(told["zmq_endpoint"], b"arm_a/cam ") as socket:
        playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": {"zmq": True}})
        assert regions(playing) == set()
        reply = playing.step()
        message = next(m for m in iter(socket.recv_multipart, None) if number_of(m) >= reply["frame_id"])
        assert np.frombuffer(message[1], "<f8", count=1, offset=16)[0] == reply["time"]


@pytest.mark.opengl
def test_a_stream_is_silent_while_the_state_stands_still(playing: Bench) -> None:
    """Beta statement 55."""
    other = f"{playing.b}/cam"
    cameras = {"arm_a/cam": True, other: True}
    told = playing.wire.ask("set_camera_streaming", cameras=cameras)["cameras"]
    playing.wire.ask("set_camera_delay", cameras={other: {"on_state_change": False}})
    with (
        pictures(told["arm_a/cam"]["zmq_endpoint"], b"arm_a/cam ") as socket,
        pictures(told[other]["zmq_endpoint"], f"{other} ".encode()) as repeating,
    ):
        first = playing.step()["frame_id"]
        assert number_of(socket.recv_multipart()) == first
        playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": False})
        playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": True})
        for _ in range(4):
            repeating.recv_multipart()
        second = playing.step()["frame_id"]
        assert number_of(socket.recv_multipart()) == second, "nothing came between, not even when it was switched on"
        playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": False})
        playing.step(include_cameras={"arm_a/cam": "sync"}, render="sync")
        playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": True})
        for _ in range(4):
            repeating.recv_multipart()
        third = playing.step()["frame_id"]
        assert number_of(socket.recv_multipart()) == third, "what it has drawn for a step is not news, either"


@pytest.mark.opengl
@pytest.mark.parametrize("mode", ["direct", "live"])
def test_a_camera_that_is_switched_on_at_standstill_shows_what_it_has_missed(playing: Bench, mode: str) -> None:
    """Beta statement 55, the other way round."""
    playing.wire.ask("set_mode", mode=mode)
    if mode == "live":
        playing.wire.ask("set_paused", paused=False)
    eventually(lambda: playing.step()["frame_id"])
    playing.wire.ask("set_mode", mode="direct")
    camera = f"{playing.b}/cam"  # on a port of this session alone: nobody who has left seems to listen still
    told = playing.wire.ask("set_camera_streaming", cameras={camera: True})["cameras"][camera]
    assert playing.server.shm_dir is not None
    region = RawRegion(playing.server.shm_dir / f"cam_{playing.b}_cam.shm")
    try:
        eventually(lambda: region.sequence == 1)
        with pictures(told["zmq_endpoint"], f"{camera} ".encode()) as socket:
            message = socket.recv_multipart()
        shared = region.read()[1]
        assert (shared[:32], shared[40:]) == (message[1][:32], message[1][40:]), "the same but for when it was drawn"
        now = playing.step()["frame_id"]
        assert number_of(message) == now - 1
    finally:
        region.close()


@pytest.mark.opengl
def test_a_picture_that_a_reply_takes_along_is_streamed_all_the_same(
    playing: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = f"{playing.b}/cam"
    told = playing.wire.ask("set_camera_streaming", cameras={camera: {"zmq": True}})["cameras"][camera]
    drawn: queue.SimpleQueue[int] = queue.SimpleQueue()
    go_on, seen = threading.Semaphore(0), {0}
    draw: Any = CameraRenderer.frames

    def waits(renderer: CameraRenderer, *args: Any) -> Any:
        """Have the stream wait between drawing a state and sending it."""
        frames = draw(renderer, *args)
        number = frames[camera].frame_id
        if threading.current_thread().name == "urlab-cameras" and number not in seen:
            seen.add(number)
            drawn.put(number)
            go_on.acquire()
        return frames

    monkeypatch.setattr(camera_renderer, "LATEST_S", np.inf)
    monkeypatch.setattr(CameraRenderer, "frames", waits)
    with pictures(told["zmq_endpoint"], f"{camera} ".encode()) as socket:
        try:
            for _ in range(3):
                playing.step()
                number = drawn.get()
                reply = playing.step(include_cameras={camera: "latest"})
                assert reply["cameras"][camera]["frame_id"] == number
                go_on.release()
                assert number_of(socket.recv_multipart()) == number
        finally:
            go_on.release(100)


@pytest.fixture
def drawing(playing: Bench, monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Whether pictures get drawn: they wait while it is cleared."""
    playing.step(include_cameras=True, render="sync")
    may = threading.Event()
    may.set()
    draw = Stage.draw

    def waits(stage: Stage, *args: Any) -> Any:
        may.wait()
        return draw(stage, *args)

    monkeypatch.setattr(Stage, "draw", waits)
    yield may
    may.set()


@pytest.mark.opengl
@pytest.mark.parametrize("wait", [{"render": "sync"}, {"wait_cameras": True}])
def test_a_step_waits_for_pictures_only_as_long_as_it_says(
    playing: Bench, drawing: threading.Event, wait: dict[str, Any]
) -> None:
    """Beta statement 51."""
    other = f"{playing.b}/cam"
    first = playing.step(include_cameras=True, **wait)
    drawing.clear()
    cameras = {"arm_a/cam": "sync", other: {"frame_id": first["frame_id"] + 1}}
    for _ in range(2 * GIVEN_UP):
        reply = playing.step(include_cameras=cameras, camera_timeout_ms=1, **wait)
        assert {key: frame["frame_id"] for key, frame in reply["cameras"].items()} == {"arm_a/cam": first["frame_id"]}
        assert reply["frame_id"] > first["frame_id"]
    drawing.set()
    eventually(lambda: not playing.core.play.current.cameras._made_painter()._pending)
    reply = playing.step(include_cameras=cameras, **wait)
    assert {frame["frame_id"] for frame in reply["cameras"].values()} == {reply["frame_id"]}


@pytest.mark.parametrize("limit", [0, -5, float("nan")])
def test_a_limit_that_is_no_time_is_not_waited_for(playing: Bench, drawing: threading.Event, limit: float) -> None:
    drawing.clear()
    reply = playing.step(include_cameras={"arm_a/cam": {"frame_id": 1e9}}, render="sync", camera_timeout_ms=limit)
    assert "cameras" not in reply


WIDE = """
<mujoco model="wide"><worldbody><light pos="0 0 3"/>
  <body><joint/><geom size=".01"/><camera name="cam" pos="0 0 0" xyaxes="1 0 0 0 0 1" fovy="45"/></body>
  <body pos="0 10 {height}"><joint/><geom size=".05" rgba="1 1 1 1"/></body>
</worldbody></mujoco>"""


@pytest.mark.opengl
def test_the_field_of_view_is_the_vertical_one(tmp_path: Path) -> None:
    """Generation 2 statement 43."""
    seen = []
    for degrees in (22.0, 23.0):
        path = tmp_path / f"wide_{degrees:g}.xml"
        path.write_text(WIDE.format(height=10 * np.tan(np.radians(degrees))))
        with (
            SimulatedServer(path, play=True, dialect="beta", camera_size=(640, 480)) as server,
            Wire(server) as wire,
        ):
            wire.hello()
            (frame,) = wire.ask("step", include_cameras=True, render="sync", camera_timeout_ms=20_000)[
                "cameras"
            ].values()
            pixels = np.frombuffer(frame["data"], np.uint8).reshape(480, 640, 4)[:, :, :3]
            background = np.median(pixels.reshape(-1, 3), axis=0)
            seen.append(bool((np.abs(pixels - background).max(axis=2) > 20).any()))
    assert seen == [True, False]


def shown(bench: Bench, how: object = "latest", **fields: Any) -> dict[str, Any] | None:
    """Step once and return the reply's picture of the first robot's camera."""
    return bench.step(include_cameras={"arm_a/cam": how}, **fields).get("cameras", {}).get("arm_a/cam")


def sim_time_of(message: list[bytes]) -> float:
    return float(np.frombuffer(message[1], "<f8", count=1, offset=16)[0])


@pytest.mark.opengl
def test_a_delayed_camera(playing: Bench) -> None:
    """Beta statement 54."""
    other = f"{playing.b}/cam"
    streams = playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": True, other: True})["cameras"]
    told = playing.wire.ask("set_camera_delay", cameras={"ARM_A/cam": {"delay_s": 0.5, "seed": 7}, "nobody/cam": 1})
    in_force = {"delay_s": 0.5, "jitter_s": 0.0, "clock": "sim", "on_state_change": True, "max_fps": 0.0}
    assert told["cameras"] == {"arm_a/cam": in_force}
    assert shown(playing) is None, "nothing that it saw is old enough"
    seen: dict[float, dict[str, Any]] = {}
    for _ in range(100):
        reply = playing.step(include_cameras={"arm_a/cam": "sync"})
        seen[round(reply["time"], 6)] = reply["cameras"]["arm_a/cam"]
        assert reply["cameras"]["arm_a/cam"]["frame_id"] == reply["frame_id"]
    reply = playing.step(include_cameras={"arm_a/cam": "latest", other: "latest"}, render="sync")
    old = reply["cameras"]["arm_a/cam"]
    assert old == seen[round(reply["time"] - 0.5, 6)]
    assert reply["cameras"][other]["frame_id"] == reply["frame_id"], "the other camera is not delayed"
    assert playing.step(include_cameras=True)["cameras"]["arm_a/cam"]["frame_id"] == old["frame_id"] + 1
    reply = playing.step()
    with (
        pictures(streams["arm_a/cam"]["zmq_endpoint"], b"arm_a/cam ") as socket,
        pictures(streams[other]["zmq_endpoint"], f"{other} ".encode()) as others,
    ):
        first = socket.recv_multipart()
        assert number_of(others.recv_multipart()) == reply["frame_id"], "the other camera is not delayed"
        assert sim_time_of(first) == pytest.approx(reply["time"] - 0.5)
        later = playing.step(n_steps=20)
        second = socket.recv_multipart()
        assert number_of(second) > number_of(first), "what was sent is not sent again"
        assert sim_time_of(second) == pytest.approx(later["time"] - 0.5)


@pytest.mark.opengl
def test_two_cameras_jitter_apart(playing: Bench) -> None:
    cameras = ["arm_a/cam", f"{playing.b}/cam"]
    playing.wire.ask("set_camera_delay", cameras={key: {"delay_s": 0.05, "jitter_s": 0.04} for key in cameras})
    seen: dict[str, list[int]] = {name: [] for name in cameras}
    for _ in range(60):
        pictures = playing.step(include_cameras=True).get("cameras", {})
        for name in cameras:
            seen[name].append(pictures[name]["frame_id"] if name in pictures else 0)
    assert all(seen[name][-1] for name in cameras)
    assert seen[cameras[0]] != seen[cameras[1]]


@pytest.mark.opengl
def test_a_step_does_not_choose_from_what_a_camera_withholds(playing: Bench) -> None:
    """Beta statement 94."""
    playing.wire.ask("set_camera_delay", cameras={"arm_a/cam": 10})
    reply = playing.step(n_steps=10)
    assert shown(playing, {"frame_id": reply["frame_id"]}) is None
    assert shown(playing, {"frame_id": reply["frame_id"]}, wait_cameras=True) is None
    assert shown(playing, "sync", n_steps=1) is not None
    late = playing.step(n_steps=2000, include_cameras={"arm_a/cam": {"frame_id": 1e15}})
    assert late["cameras"]["arm_a/cam"]["sim_time"] <= late["time"] - 10


@pytest.mark.opengl
def test_a_reset_forgets_what_a_camera_saw(playing: Bench) -> None:
    playing.wire.ask("set_camera_delay", cameras={"arm_a/cam": 0.02})
    assert shown(playing) is None
    assert [shown(playing) for _ in range(4)][3] is not None
    playing.wire.ask("reset")
    assert [shown(playing) for _ in range(3)] == [None] * 3
    after = shown(playing)
    assert after is not None
    assert after["sim_time"] == 0
    later = playing.wire.ask("reset", keyframe_name=f"{playing.a}_home")
    assert later["time"] > 1
    assert shown(playing) is None, "not even when the clock goes on to a later time"


@pytest.mark.opengl
def test_a_delay_is_changed_and_taken_back(playing: Bench) -> None:
    playing.wire.ask("set_camera_delay", cameras={"arm_a/cam": 0.05})
    playing.step(n_steps=20)
    assert shown(playing, n_steps=20) is not None
    told = playing.wire.ask("set_camera_delay", cameras={"arm_a/cam": {"delay_s": 0.3, "max_fps": 10}})
    assert told["cameras"]["arm_a/cam"]["max_fps"] == 10
    told = playing.wire.ask("set_camera_delay", cameras={"arm_a/cam": -1})["cameras"]["arm_a/cam"]
    assert (told["delay_s"], told["max_fps"]) == (0, 10), "a limit stays until one is given"
    told = playing.wire.ask("set_camera_delay", cameras={"arm_a/cam": {"on_state_change": False}})["cameras"]
    assert (told["arm_a/cam"]["on_state_change"], told["arm_a/cam"]["max_fps"]) == (False, 0)
    reply = playing.step(include_cameras={"arm_a/cam": "latest"}, render="sync")
    assert reply["cameras"]["arm_a/cam"]["frame_id"] == reply["frame_id"]
    assert playing.core.play.current.engine.snapshots.hooks == [], "nothing is kept for cameras that are not late"


@pytest.mark.opengl
def test_a_camera_with_a_limit_of_pictures(playing: Bench) -> None:
    playing.wire.ask("set_camera_delay", cameras={"arm_a/cam": {"max_fps": 50}})
    numbers = [frame["frame_id"] for _ in range(9) if (frame := shown(playing))]
    assert [number - numbers[0] for number in numbers] == [0, 0, 0, 4, 4, 4, 4, 8, 8]


@pytest.mark.opengl
@pytest.mark.parametrize("bad", [{"delay_s": float("nan")}, {"max_fps": 1e300}, {"clock": "sun"}])
def test_a_delay_that_cannot_be_changes_nothing(playing: Bench, bad: dict[str, Any]) -> None:
    cameras = {f"{playing.b}/cam": 5, "arm_a/cam": bad}
    assert playing.refused("set_camera_delay", cameras=cameras)[0] == "bad_request"
    reply = playing.step(include_cameras=True, render="sync")
    assert {frame["frame_id"] for frame in reply["cameras"].values()} == {reply["frame_id"]}
    assert playing.refused("set_camera_delay", cameras={})[0] == "bad_request"
    assert playing.refused("set_camera_delay")[0] == "missing_field"
    assert playing.wire.ask("set_camera_delay", cameras={"nobody/cam": 1})["cameras"] == {}
