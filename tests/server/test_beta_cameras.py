"""The simulated server's beta over a raw socket: pictures, statement by statement."""

from __future__ import annotations

import zmq
from beta_bench import Bench


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
