"""Every golden vector of a binary layout: decoded, re-encoded byte for byte, or refused for the recorded reason."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest
import vectors

from urlab_client._platform.processors import no_fence
from urlab_client.enums import CameraMode
from urlab_client.errors import ProtocolError
from urlab_client.protocol import rows, shm
from urlab_client.protocol.topics import StreamTopic, TopicKind
from urlab_client.server.streams.commands import Actuators, CameraEndpoint, StreamedSetPoints, decode_gains
from urlab_client.values.pictures import decode_camera

# What the codec, not these layouts, is responsible for.
CODEC_FAMILIES = ("rpc_", "msgpack_", "msg_state_full")


@dataclass
class Golden:
    decode: Callable[[bytes], Any]
    encode: Callable[[Any], bytes]
    decoded: Callable[[Any], dict[str, Any]]
    kind: TopicKind | None = None


def scene(kind: TopicKind, fields: Callable[[list[float]], dict[str, Any]]) -> Golden:
    return Golden(
        lambda data: rows.SceneRow.decode(kind, data),
        rows.SceneRow.encode,
        lambda row: fields(row.values.tolist()),
        kind,
    )


JOINT = Golden(
    rows.JointRow.decode,
    rows.JointRow.encode,
    lambda row: {"id": row.id, "pos": row.position, "vel": row.velocity, "acc": row.acceleration},
    TopicKind.JOINT,
)
BASE_STATE = Golden(
    rows.BaseStateRow.decode,
    rows.BaseStateRow.encode,
    lambda row: {
        "pos": row.position.tolist(),
        "quat_xyzw": row.quat_xyzw.tolist(),
        "linvel": row.linear_velocity.tolist(),
        "angvel": row.angular_velocity.tolist(),
    },
    TopicKind.BASE_STATE,
)
SENSOR = Golden(
    rows.SensorRow.decode,
    rows.SensorRow.encode,
    lambda row: {"id": row.id, "dim": row.values.size, "values": row.values.tolist()},
    TopicKind.SENSOR,
)
CONTROL = Golden(
    StreamedSetPoints.decode,
    lambda payload: (
        struct.pack("<i", len(payload.values))
        + b"".join(map(struct.Struct("<if").pack, payload.actuator_ids, payload.values))
    ),
    lambda payload: {
        "n": payload.values.size,
        "entries": [
            {"actuator_id": actuator, "value": value}
            for actuator, value in zip(payload.actuator_ids.tolist(), payload.values.tolist(), strict=True)
        ],
    },
    TopicKind.CONTROL,
)
REAL = Golden(
    lambda data: decode_camera(data, CameraMode.REAL, 2, 2).pixels,
    lambda pixels: vectors.encode_camera(pixels, CameraMode.REAL),
    lambda pixels: {"width": 2, "height": 2, "dtype": "bgra8", "rows_top_down_rgba": pixels.tolist()},
)
DEPTH = Golden(
    lambda data: decode_camera(data, CameraMode.DEPTH, 2, 2).pixels,
    lambda pixels: vectors.encode_camera(pixels, CameraMode.DEPTH),
    lambda pixels: {
        "width": 2,
        "height": 2,
        "dtype": "float32",
        "rows_top_down_cm": np.frombuffer(vectors.encode_camera(pixels, "depth"), "<f4").reshape(2, 2).tolist(),
        "rows_top_down_m": pixels.tolist(),
    },
)

ROWS = {
    "row_joint": JOINT,
    "row_joint_unbound": JOINT,
    "row_base_state": BASE_STATE,
    "row_sensor_dim1": SENSOR,
    "row_sensor_dim3": SENSOR,
    "row_sensor_unbound": SENSOR,
    "row_twist": Golden(
        rows.TwistRow.decode,
        rows.TwistRow.encode,
        lambda row: {"vx": row.vx, "vy": row.vy, "yaw_rate": row.yaw_rate},
        TopicKind.TWIST,
    ),
    "row_actions": Golden(
        rows.ActionsRow.decode,
        rows.ActionsRow.encode,
        lambda row: {"mask": row.mask, "bits": list(row.bits)},
        TopicKind.ACTIONS,
    ),
    "row_scene_xpos": scene(TopicKind.XPOS, lambda v: {"xpos": v}),
    "row_scene_xquat": scene(TopicKind.XQUAT, lambda v: {"quat_wxyz": v}),
    "row_scene_qpos": scene(TopicKind.QPOS, lambda v: {"pos": v[:3], "quat_wxyz": v[3:]}),
    "row_scene_qvel": scene(TopicKind.QVEL, lambda v: {"linvel": v[:3], "angvel": v[3:]}),
    "control_payload": CONTROL,
}
MESSAGES = {
    "msg_joint": JOINT,
    "msg_base_state": BASE_STATE,
    "msg_sensor": SENSOR,
    "msg_control": CONTROL,
    "msg_camera_real_2x2": REAL,
    "msg_camera_depth_2x2": DEPTH,
}
REJECTED_ROWS = {"row_sensor_reject_short": SENSOR, "control_payload_reject_short": CONTROL}


def close(value: Any) -> Any:
    """Compare numbers to float32 precision, wherever they stand; Python's own `==` for the rest."""
    match value:
        case dict():
            return {key: close(item) for key, item in value.items()}
        case [float(), *_]:
            return pytest.approx(value, rel=1e-7)
        case list():
            return [close(item) for item in value]
        case _:
            return value


@pytest.mark.parametrize("name", ROWS)
def test_row(name: str) -> None:
    vector, golden = vectors.load(name), ROWS[name]
    expected = dict(vector.decoded)
    topic = expected.pop("topic", None)
    row = golden.decode(vector.data)
    assert golden.decoded(row) == expected
    assert golden.encode(row) == vector.data
    if topic is not None and golden.kind is not TopicKind.CONTROL:
        parsed = StreamTopic.parse(topic.encode())
        assert parsed.kind is golden.kind
        assert golden.decoded(rows.decode_row(parsed, vector.data)) == expected


@pytest.mark.parametrize("name", MESSAGES)
def test_message(name: str) -> None:
    vector, golden = vectors.load(name), MESSAGES[name]
    expected = dict(vector.decoded)
    topic, payload = vector.frames
    parsed = StreamTopic.parse(topic)
    assert str(parsed) == expected.pop("topic")
    assert parsed.encode() == topic
    assert parsed.kind is (golden.kind or TopicKind.CAMERA)
    content = golden.decode(payload)
    assert golden.decoded(content) == close(expected)
    if golden is DEPTH:  # centimetres to metres and back rounds in the last bit of a float32
        np.testing.assert_array_max_ulp(
            np.frombuffer(golden.encode(content), "<f4"), np.frombuffer(payload, "<f4"), maxulp=1
        )
    else:
        assert golden.encode(content) == payload


@pytest.mark.parametrize("name", REJECTED_ROWS)
def test_rejected_row(name: str) -> None:
    vector = vectors.load(name)
    with pytest.raises(ProtocolError) as caught:
        REJECTED_ROWS[name].decode(vector.data)
    formula = {"length != 8 + 4*dim": "8 + 4*dim", "length < 4 + 8*n": "4 + 8*n"}[vector.decoded["reason"]]
    assert formula in str(caught.value)
    assert f"{len(vector.data)} bytes" in str(caught.value)
    assert caught.value.raw == vector.data


def test_set_gains() -> None:
    vector = vectors.load("msg_set_gains")
    topic, payload = vector.frames
    assert StreamTopic.parse(topic) == StreamTopic(TopicKind.SET_GAINS, "g1")
    assert StreamTopic.parse(topic).encode() == topic
    assert decode_gains(payload) == vector.decoded["reshaped"]


def test_info() -> None:
    vector = vectors.load("msg_info")
    ranges = {3: ' ctrlrange="-1.5 1.5"'}
    motors = "".join(f'<motor joint="j"{ranges.get(number, "")}/>' for number in range(12))
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    index = SimpleNamespace(
        key="g1", prefix="g1_", actuators=np.array([3, 11], np.int32), actuator_names=("left_knee", "waist")
    )
    robot: Any = SimpleNamespace(index=index)
    info = Actuators(model, [robot]).info(robot, [CameraEndpoint("head", "tcp://0.0.0.0:5558")])
    assert json.loads(info) == vector.decoded


@pytest.mark.parametrize("name", ["camera_peer_header_v1", "camera_peer_header_v2"])
def test_camera_with_header(name: str) -> None:
    vector = vectors.load(name)
    frame = decode_camera(vector.data, CameraMode.REAL, vector.decoded["width"], vector.decoded["height"])
    assert frame.frame_id == vector.decoded["frame_id"]
    assert frame.sim_time == vector.decoded["sim_time"]
    assert frame.capture_time == vector.decoded.get("capture_unix_time")
    assert vectors.encode_camera(frame.pixels, CameraMode.REAL).hex() == vector.decoded["pixels_hex"]


def assert_header(header: shm.Header, decoded: dict[str, Any]) -> None:
    assert header.stride == decoded["buffer_stride"]
    assert header.n_buffers == decoded["n_buffers"]
    assert header.sequence == decoded["sequence"]
    assert header.latest_idx == decoded["latest_idx"]
    assert shm.region_size(header.stride, header.n_buffers) == decoded["file_size"]


HEADERS = [v.name for v in vectors.all() if v.name.startswith("shm_header_")]
REGIONS = [v.name for v in vectors.all() if v.name.startswith(("shm_region_", "shm_camera_region_"))]
REJECTED_REGIONS = [v.name for v in vectors.all() if v.name.startswith("shm_reject_")]


@pytest.mark.parametrize("name", HEADERS)
def test_shm_header(name: str) -> None:
    vector = vectors.load(name)
    whole = vector.data.ljust(vector.decoded["file_size"], b"\0")
    assert_header(shm.parse_header(whole), vector.decoded)
    with pytest.raises(shm.RegionNotReady, match=str(vector.decoded["file_size"])):
        shm.parse_header(whole[:-1])


def test_shm_fresh_region_is_created_byte_for_byte() -> None:
    for name in ("shm_header_state_fresh", "shm_header_rpc_fresh"):
        vector = vectors.load(name)
        buffer = bytearray(b"\xee" * vector.decoded["file_size"])
        shm.Region.lay_out(buffer, vector.decoded["buffer_stride"], fence=no_fence)
        assert buffer == vector.data.ljust(len(buffer), b"\0")


def test_shm_slot() -> None:
    vector = vectors.load("shm_slot_meta_request")
    stride = vector.decoded["stride"]
    buffer = bytearray(shm.region_size(stride))
    region = shm.Region.lay_out(buffer, stride, fence=no_fence)
    region.publish(msgspec.msgpack.encode(vector.decoded["payload"]))
    assert buffer[64 + stride :] == vector.data


@pytest.mark.parametrize("name", REGIONS)
def test_shm_region(name: str) -> None:
    vector = vectors.load(name)
    header = shm.parse_header(vector.data)
    assert_header(header, vector.decoded["header"])
    publication = shm.Region(memoryview(vector.data), fence=no_fence).read_latest()
    assert publication is not None
    assert publication.sequence == header.sequence
    if "latest" in vector.decoded:
        assert msgspec.msgpack.decode(publication.payload) == vector.decoded["latest"]
    else:
        assert len(publication.payload) == vector.decoded["size"]
        pixels = decode_camera(publication.payload, CameraMode.REAL, 2, 2).pixels
        assert pixels.tolist() == vector.decoded["rows_top_down_rgba"]
        assert header.stride == shm.camera_stride(2, 2)


@pytest.mark.parametrize(
    ("name", "publications"),
    [
        ("shm_region_after_1", ["shm_region_after_1"]),
        ("shm_region_after_2", ["shm_region_after_1", "shm_region_after_2"]),
        ("shm_region_state_full", ["shm_region_state_full"]),
        ("shm_camera_region_real_2x2", ["shm_camera_region_real_2x2"]),
    ],
)
def test_shm_region_is_produced_byte_for_byte(name: str, publications: list[str]) -> None:
    vector = vectors.load(name)
    buffer = bytearray(len(vector.data))
    region = shm.Region.lay_out(buffer, vector.decoded["header"]["buffer_stride"], fence=no_fence)
    for publication in publications:
        newest = shm.Region(memoryview(vectors.load(publication).data), fence=no_fence).read_latest()
        assert newest is not None
        region.publish(newest.payload)
    assert buffer == vector.data


@pytest.mark.parametrize("name", REJECTED_REGIONS)
def test_rejected_shm_region(name: str) -> None:
    vector = vectors.load(name)
    words = {
        "magic": "magic is 0x424c5256, expected 0x424c5255",
        "protocol_version": "protocol_version is 2, expected 1",
        "latest_idx >= n_buffers": "latest_idx is 2, expected below n_buffers (2)",
        "size == 0": "a payload of 0 bytes, expected 1 to 20",
        "size + 4 > stride": "a payload of 21 bytes, expected 1 to 20 (size + 4 <= stride)",
        "file shorter than 64 + stride * n_buffers": "88 bytes, expected 112 (64 + 24 * 2)",
    }[vector.decoded["reason"]]
    with pytest.raises(ProtocolError) as caught:
        shm.Region(memoryview(vector.data), fence=no_fence).read_latest()
    assert words in str(caught.value)
    assert isinstance(caught.value, shm.RegionNotReady) == (name == "shm_reject_short_file")


def test_every_layout_vector_is_covered() -> None:
    covered = {
        *ROWS,
        *MESSAGES,
        *REJECTED_ROWS,
        *HEADERS,
        *REGIONS,
        *REJECTED_REGIONS,
        "msg_set_gains",
        "msg_info",
        "camera_peer_header_v1",
        "camera_peer_header_v2",
        "shm_slot_meta_request",
    }
    assert covered == {v.name for v in vectors.all() if not v.name.startswith(CODEC_FAMILIES)}
