from __future__ import annotations

import contextlib
import math
import pickle
import struct

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from vectors import encode_camera

from urlab_client.enums import CameraMode
from urlab_client.errors import ProtocolError
from urlab_client.protocol.rows import ActionsRow, BaseStateRow, JointRow, SceneRow, SensorRow, TwistRow, decode_row
from urlab_client.protocol.topics import (
    StreamTopic,
    TopicKind,
    articulation_filter,
    camera_filter,
    resolve_endpoint,
    scene_filter,
)
from urlab_client.server.streams.commands import StreamedSetPoints, decode_gains
from urlab_client.values.pictures import decode_camera

OF_COMPONENT = [TopicKind.JOINT, TopicKind.BASE_STATE, TopicKind.SENSOR, TopicKind.CAMERA]
OF_ARTICULATION = [TopicKind.TWIST, TopicKind.ACTIONS, TopicKind.CONTROL, TopicKind.SET_GAINS]
OF_SCENE = {TopicKind.XPOS: 3, TopicKind.XQUAT: 4, TopicKind.QPOS: 7, TopicKind.QVEL: 6}

names = st.text(st.characters(codec="utf-8"), min_size=1).filter(lambda name: not name.endswith(" "))
keys = names.filter(lambda key: "/" not in key)
float32 = st.floats(width=32)
int32 = st.integers(-(2**31), 2**31 - 1)


def vectors32(size: int | st.SearchStrategy[int]) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float32, size, elements=float32)


def same(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


class TestTopics:
    @given(
        st.one_of(
            st.builds(StreamTopic, st.sampled_from(OF_COMPONENT), keys, names),
            st.builds(StreamTopic, st.sampled_from(OF_ARTICULATION), keys),
            st.builds(StreamTopic, st.sampled_from(list(OF_SCENE)), names),
            st.just(StreamTopic(TopicKind.STATE_FULL)),
        ).filter(lambda topic: topic.owner != "scene" or topic.kind in OF_SCENE)
    )
    def test_round_trip(self, topic: StreamTopic) -> None:
        frame = topic.encode()
        assert StreamTopic.parse(frame) == topic
        assert StreamTopic.parse(memoryview(frame)) == topic
        assert frame.endswith(b" ") == (topic.kind in {TopicKind.CONTROL, TopicKind.SET_GAINS, TopicKind.CAMERA})

    @pytest.mark.parametrize(
        ("frame", "topic"),
        [
            (b"scene/joint/knee", StreamTopic(TopicKind.JOINT, "scene", "knee")),
            (b"scene/twist", StreamTopic(TopicKind.TWIST, "scene")),
            (b"scene/camera/head ", StreamTopic(TopicKind.CAMERA, "scene", "head")),
            (b"scene/joint/xpos", StreamTopic(TopicKind.XPOS, "joint")),
            (b"scene/scene/qvel", StreamTopic(TopicKind.QVEL, "scene")),
            (b"state/twist", StreamTopic(TopicKind.TWIST, "state")),
            (b"joint/joint/joint", StreamTopic(TopicKind.JOINT, "joint", "joint")),
            (b"g1/joint/left/knee", StreamTopic(TopicKind.JOINT, "g1", "left/knee")),
            (b"g1/joint//", StreamTopic(TopicKind.JOINT, "g1", "/")),
            (b"scene/kitchen/box/qpos", StreamTopic(TopicKind.QPOS, "kitchen/box")),
        ],
    )
    def test_articulations_named_like_a_part_of_the_grammar(self, frame: bytes, topic: StreamTopic) -> None:
        assert StreamTopic.parse(frame) == topic

    @pytest.mark.parametrize(
        ("frame", "problem"),
        [
            (b"", "expected <articulation>"),
            (b"g1", "expected <articulation>"),
            (b"g1/", "expected <articulation>"),
            (b"g1/joint", "expected <articulation>"),
            (b"g1/joint/", "expected <articulation>"),
            (b"/joint/knee", "expected <articulation>"),
            (b"g1/twist/x", "expected <articulation>"),
            (b"g1/velocity/knee", "expected <articulation>"),
            (b"scene//xpos", "expected <articulation>"),
            (b"scene/xpos", "expected <articulation>"),
            (b"g1/joint/knee ", "must not end in a space"),
            (b"g1/twist ", "must not end in a space"),
            (b"scene/box/xpos ", "must not end in a space"),
            (b"state/full ", "expected <articulation>"),
            (b"g1/camera/wrist", "must end in one space"),
            (b"g1/control", "must end in one space"),
            (b"g1/camera/wrist  ", "a name ends in a space"),
            (b"g1/joint/\xff", "not UTF-8"),
        ],
    )
    def test_refused(self, frame: bytes, problem: str) -> None:
        with pytest.raises(ProtocolError, match=problem) as caught:
            StreamTopic.parse(frame)
        assert caught.value.raw == frame

    @given(st.binary(max_size=40))
    def test_any_bytes_give_a_topic_that_encodes_alike_or_an_error(self, frame: bytes) -> None:
        try:
            topic = StreamTopic.parse(frame)
        except ProtocolError:
            return
        assert topic.encode() == frame

    @pytest.mark.parametrize(
        "topic",
        [
            StreamTopic(TopicKind.JOINT, "g1"),
            StreamTopic(TopicKind.JOINT, "", "knee"),
            StreamTopic(TopicKind.TWIST, "g1", "knee"),
            StreamTopic(TopicKind.XPOS),
            StreamTopic(TopicKind.STATE_FULL, "g1"),
            StreamTopic(TopicKind.JOINT, "a/b", "knee"),
            StreamTopic(TopicKind.TWIST, "g1 "),
            StreamTopic(TopicKind.CAMERA, "g1", "wrist "),
        ],
    )
    def test_encode_refuses_what_could_not_be_read_back(self, topic: StreamTopic) -> None:
        with pytest.raises(ValueError, match=r"topic"):
            topic.encode()


class TestFilters:
    @given(keys, keys, st.sampled_from([None, *OF_COMPONENT, *OF_ARTICULATION]))
    def test_an_articulation_never_brings_in_another(self, key: str, other: str, kind: TopicKind | None) -> None:
        chosen = articulation_filter(key, kind)
        for topic in (
            *(StreamTopic(of, other, "knee") for of in OF_COMPONENT),
            *(StreamTopic(of, other) for of in OF_ARTICULATION),
        ):
            wanted = other == key and kind in {None, topic.kind}
            assert topic.encode().startswith(chosen) == wanted

    def test_scene(self) -> None:
        assert StreamTopic(TopicKind.XPOS, "box").encode().startswith(scene_filter())
        assert StreamTopic(TopicKind.XPOS, "box").encode().startswith(scene_filter("box"))
        assert not StreamTopic(TopicKind.XPOS, "box2").encode().startswith(scene_filter("box"))

    def test_camera(self) -> None:
        # As the handshake gives it, without the trailing space, and as published, with it.
        for zmq_topic in ("arm0/camera/wrist", "arm0/camera/wrist "):
            chosen = camera_filter(zmq_topic)
            assert chosen == StreamTopic(TopicKind.CAMERA, "arm0", "wrist").encode()
            assert not StreamTopic(TopicKind.CAMERA, "arm0", "wrist2").encode().startswith(chosen)

    @pytest.mark.parametrize(
        ("key", "kind"),
        [("", None), ("a/b", None), ("g1", TopicKind.XPOS), ("g1", TopicKind.STATE_FULL)],
    )
    def test_refused(self, key: str, kind: TopicKind | None) -> None:
        with pytest.raises(ValueError, match=r"topic|empty"):
            articulation_filter(key, kind)


class TestEndpoints:
    @pytest.mark.parametrize("bound", ["0.0.0.0", "*", "::", "[::]", ""])
    def test_unspecified_hosts_become_the_servers(self, bound: str) -> None:
        assert resolve_endpoint(f"tcp://{bound}:5560", "sim.lab") == "tcp://sim.lab:5560"

    @pytest.mark.parametrize("host", ["fe80::1", "[fe80::1]"])
    def test_ipv6_host_is_bracketed(self, host: str) -> None:
        assert resolve_endpoint("tcp://0.0.0.0:5558", host) == "tcp://[fe80::1]:5558"

    @pytest.mark.parametrize(
        "endpoint", ["tcp://10.0.0.7:5558", "tcp://[fe80::2]:5558", "ipc:///tmp/cam", "inproc://cam"]
    )
    def test_others_stay(self, endpoint: str) -> None:
        assert resolve_endpoint(endpoint, "sim.lab") == endpoint

    @pytest.mark.parametrize(
        "endpoint",
        ["tcp://0.0.0.0", "tcp://0.0.0.0:", "tcp://0.0.0.0:*", "tcp://*:0", "tcp://*:65536", "tcp://*:²", "*:5558", ""],
    )
    def test_unusable(self, endpoint: str) -> None:
        with pytest.raises(ProtocolError, match="expected tcp://HOST:PORT"):
            resolve_endpoint(endpoint, "sim.lab")

    def test_the_host_itself_must_be_an_address(self) -> None:
        with pytest.raises(ValueError, match="not an address to connect to"):
            resolve_endpoint("tcp://0.0.0.0:5558", "0.0.0.0")


class TestStateRows:
    @given(int32, float32, float32, float32)
    def test_joint(self, joint: int, position: float, velocity: float, acceleration: float) -> None:
        frame = JointRow(joint, position, velocity, acceleration).encode()
        row = JointRow.decode(frame)
        assert row.id == joint
        assert struct.pack("<fff", row.position, row.velocity, row.acceleration) == frame[4:]
        assert [row.position, row.velocity, row.acceleration] == pytest.approx(
            [position, velocity, acceleration], nan_ok=True, rel=0, abs=0
        )

    @given(st.tuples(vectors32(3), vectors32(4), vectors32(3), vectors32(3)))
    def test_base_state(self, parts: tuple[np.ndarray, ...]) -> None:
        row = BaseStateRow.decode(BaseStateRow(*parts).encode())
        decoded = (row.position, row.quat_xyzw, row.linear_velocity, row.angular_velocity)
        assert all(map(same, decoded, parts))

    @given(int32, vectors32(st.integers(0, 20)))
    def test_sensor(self, sensor: int, values: np.ndarray) -> None:
        row = SensorRow.decode(SensorRow(sensor, values).encode())
        assert row.id == sensor
        assert same(row.values, values)

    @given(float32, float32, float32)
    def test_twist(self, vx: float, vy: float, yaw_rate: float) -> None:
        row = TwistRow.decode(TwistRow(vx, vy, yaw_rate).encode())
        assert [row.vx, row.vy, row.yaw_rate] == pytest.approx([vx, vy, yaw_rate], nan_ok=True, rel=0, abs=0)

    @given(st.sets(st.integers(0, 9)))
    def test_actions(self, keys: set[int]) -> None:
        row = ActionsRow.decode(ActionsRow(sum(1 << key for key in keys)).encode())
        assert row.bits == tuple(sorted(keys))

    @given(st.data(), st.sampled_from(list(OF_SCENE)))
    def test_scene(self, data: st.DataObject, quantity: TopicKind) -> None:
        values = data.draw(hnp.arrays(np.float64, OF_SCENE[quantity]))
        row = SceneRow.decode(quantity, SceneRow(quantity, values).encode())
        assert row.quantity is quantity
        assert same(row.values, values)

    def test_base_state_of_a_real_free_joint(self) -> None:
        model = mujoco.MjModel.from_xml_string(
            "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
        )
        data = mujoco.MjData(model)
        data.qpos[:] = [1.0, 2.0, 3.0, 0.5, -0.5, 0.25, 0.75]
        data.qvel[:] = [1, 2, 3, 4, 5, 6]
        row = BaseStateRow.decode(BaseStateRow.from_free_joint(data.qpos, data.qvel).encode())
        assert row.position.tolist() == [1, 2, 3]
        assert row.quat_xyzw.tolist() == [-0.5, 0.25, 0.75, 0.5]
        assert row.linear_velocity.tolist() == [1, 2, 3]
        assert row.angular_velocity.tolist() == [4, 5, 6]

    def test_a_row_made_from_live_data_does_not_follow_it(self) -> None:
        qpos, qvel = np.ones(7, np.float32), np.ones(6, np.float32)
        row = BaseStateRow.from_free_joint(qpos, qvel)
        qpos[:] = 0
        qvel[:] = 0
        assert row.position.tolist() == row.angular_velocity.tolist() == [1, 1, 1]

    def test_a_simulation_that_blew_up_still_streams(self) -> None:
        assert JointRow.decode(JointRow(3, 1e300, -1e300, math.nan).encode()).position == math.inf
        assert SensorRow.decode(SensorRow(3, np.array([-1e300])).encode()).values.tolist() == [-math.inf]
        assert TwistRow.decode(TwistRow(1e300, 0, 0).encode()).vx == math.inf

    def test_decoded_arrays_are_the_callers_own(self) -> None:
        for topic, row in (
            (StreamTopic(TopicKind.BASE_STATE, "g1", "root"), BaseStateRow(*map(np.ones, (3, 4, 3, 3)))),
            (StreamTopic(TopicKind.SENSOR, "g1", "imu"), SensorRow(1, np.ones(3))),
            (StreamTopic(TopicKind.QPOS, "box"), SceneRow(TopicKind.QPOS, np.ones(7))),
        ):
            buffer = bytearray(row.encode())
            decoded = decode_row(topic, buffer)
            buffer[:] = bytes(len(buffer))
            values = decoded.position if isinstance(decoded, BaseStateRow) else decoded.values
            assert values.any()
            values[:] = 2

    @pytest.mark.parametrize(
        ("topic", "size", "expected"),
        [
            (b"g1/joint/knee", 12, "12 bytes, expected 16"),
            (b"g1/joint/knee", 20, "20 bytes, expected 16"),
            (b"g1/base_state/root", 0, "0 bytes, expected 52"),
            (b"g1/base_state/root", 104, "104 bytes, expected 52"),
            (b"g1/twist", 16, "16 bytes, expected 12"),
            (b"g1/actions", 8, "8 bytes, expected 4"),
            (b"scene/box/xpos", 12, "12 bytes, expected 24"),
            (b"scene/box/xquat", 24, "24 bytes, expected 32"),
            (b"scene/box/qpos", 48, "48 bytes, expected 56"),
            (b"scene/box/qvel", 56, "56 bytes, expected 48"),
            (b"g1/sensor/imu", 4, r"4 bytes, expected 8 \+ 4\*dim"),
        ],
    )
    def test_wrong_size(self, topic: bytes, size: int, expected: str) -> None:
        with pytest.raises(ProtocolError, match=expected) as caught:
            decode_row(StreamTopic.parse(topic), bytes(size))
        assert repr(topic.decode()) in str(caught.value)

    @pytest.mark.parametrize(("dim", "problem"), [(-1, "dim is -1"), (2, "expected 16"), (2**31 - 1, "expected 85899")])
    def test_sensor_dim_must_be_that_of_the_row(self, dim: int, problem: str) -> None:
        with pytest.raises(ProtocolError, match=problem):
            SensorRow.decode(struct.pack("<iif", 1, dim, 0.5))

    def test_a_topic_without_row(self) -> None:
        with pytest.raises(ProtocolError, match="'g1/camera/head ': a camera topic carries none"):
            decode_row(StreamTopic.parse(b"g1/camera/head "), b"")

    def test_encode_refuses_wrong_shapes(self) -> None:
        with pytest.raises(ValueError, match=r"quat_xyzw has shape \(3,\), expected \(4,\)"):
            BaseStateRow(*map(np.zeros, (3, 3, 3, 3))).encode()
        with pytest.raises(ValueError, match=r"values has shape \(2, 2\)"):
            SensorRow(1, np.zeros((2, 2))).encode()
        with pytest.raises(ValueError, match=r"qpos has shape \(6,\), expected \(7,\)"):
            SceneRow(TopicKind.QPOS, np.zeros(6)).encode()

    def test_errors_travel_between_processes(self) -> None:
        with pytest.raises(ProtocolError) as caught:
            JointRow.decode(b"abc", "g1/joint/knee")
        copy = pickle.loads(pickle.dumps(caught.value))
        assert (str(copy), copy.raw) == (str(caught.value), b"abc")


class TestControl:
    @given(st.data(), st.integers(0, 30))
    def test_any_set_points(self, data: st.DataObject, n: int) -> None:
        ids, values = data.draw(hnp.arrays(np.int32, n)), data.draw(vectors32(n))
        entries = b"".join(struct.pack("<if", *entry) for entry in zip(ids.tolist(), values.tolist(), strict=True))
        payload = StreamedSetPoints.decode(struct.pack("<i", n) + entries + b"more")
        assert same(payload.actuator_ids, ids)
        assert same(payload.values, values)

    @pytest.mark.parametrize(
        ("payload", "problem"),
        [
            (b"", r"0 bytes, expected 4 \+ 8\*n"),
            (struct.pack("<i", -1), "n is -1"),
            (struct.pack("<iif", 2, 0, 1.0), "12 bytes, expected at least 20"),
            (struct.pack("<i", 2**31 - 1), "4 bytes, expected at least 17179869180"),
        ],
    )
    def test_refused(self, payload: bytes, problem: str) -> None:
        with pytest.raises(ProtocolError, match=f"on 'g1/control ': .*{problem}"):
            StreamedSetPoints.decode(payload, StreamTopic(TopicKind.CONTROL, "g1"))


class TestGains:
    def test_unknown_parameters_are_ignored(self) -> None:
        assert decode_gains(b'{"knee":{"kp":1,"ki":2}}') == {"kp": {"knee": 1.0}}

    @pytest.mark.parametrize(
        "payload", [b"", b"[]", b'{"knee":3}', b'{"knee":{"kp":"1"}}', b'{"\xff":{}}', b'{"a":{"x":' + b"[" * 100_000]
    )
    def test_refused(self, payload: bytes) -> None:
        with pytest.raises(ProtocolError, match="set_gains payload on 'g1'"):
            decode_gains(payload, "g1")


sizes = st.tuples(st.integers(1, 9), st.integers(1, 9))


def header(version: int, width: int, height: int, magic: int = 0x314D4355) -> bytes:
    if version == 1:
        return struct.pack("<IIQdII", magic, version, 7, 1.5, width, height)
    return struct.pack("<IIQdIId", magic, version, 7, 1.5, width, height, 99.25)


class TestCamera:
    @given(st.data(), sizes, st.sampled_from(["real", "semantic", "instance", "thermal"]))
    def test_colour_round_trip(self, data: st.DataObject, size: tuple[int, int], mode: str) -> None:
        width, height = size
        pixels = data.draw(hnp.arrays(np.uint8, (height, width, 4)))
        payload = encode_camera(pixels, mode)
        decoded = decode_camera(payload, mode, width, height).pixels
        expected = pixels.copy()
        if mode == "real":
            expected[..., 3] = 255
        assert same(decoded, expected)

    @given(st.data(), sizes)
    def test_depth_is_centimetres_on_the_wire_and_metres_here(self, data: st.DataObject, size: tuple[int, int]) -> None:
        width, height = size
        centimetres = data.draw(hnp.arrays(np.float32, (height, width), elements=float32))
        metres = decode_camera(centimetres.tobytes(), CameraMode.DEPTH, width, height).pixels
        assert metres.dtype == np.float32
        np.testing.assert_array_equal(metres, centimetres / np.float32(100))

    def test_depth_with_signalling_nan(self) -> None:
        frame = decode_camera(b"\x01\x00\xa0\x7f", "depth", 1, 1)
        assert np.isnan(frame.pixels).all()

    @pytest.mark.parametrize("mode", ["real", "semantic", "depth"])
    def test_pixels_are_the_callers_own(self, mode: str) -> None:
        buffer = bytearray(b"\x40" * 16)
        pixels = decode_camera(buffer, mode, 2, 2).pixels
        before = pixels.copy()
        buffer[:] = bytes(16)
        assert same(pixels, before)
        pixels[:] = 0

    def test_colours_of_a_picture_of_several_pieces(self) -> None:
        pixels = np.random.default_rng(0).integers(0, 256, (300, 700, 4), np.uint8)
        decoded = decode_camera(pixels.tobytes(), "real", 700, 300).pixels
        assert same(decoded[..., :3], pixels[..., 2::-1])
        assert (decoded[..., 3] == 255).all()

    @pytest.mark.parametrize("mode", ["real", "semantic", "depth"])
    def test_slot_at_an_odd_address(self, mode: str) -> None:
        payload = bytes(range(64, 80))
        decoded = decode_camera(memoryview(b"?" + payload)[1:], mode, 2, 2).pixels
        assert same(decoded, decode_camera(payload, mode, 2, 2).pixels)

    @pytest.mark.parametrize("size", [0, 15, 17, 24, 47, 49, 64])
    def test_wrong_size_is_never_reshaped(self, size: int) -> None:
        with pytest.raises(ProtocolError, match=rf"'arm/camera/wrist ': {size} bytes, expected 16 \(2x2 pixels"):
            decode_camera(bytes(size), "real", 2, 2, where=StreamTopic(TopicKind.CAMERA, "arm", "wrist"))

    def test_header_says_when(self) -> None:
        frame = decode_camera(header(2, 2, 2) + bytes(16), "semantic", 2, 2)
        assert (frame.frame_id, frame.sim_time, frame.capture_time) == (7, 1.5, 99.25)
        frame = decode_camera(header(1, 2, 2) + bytes(16), "semantic", 2, 2)
        assert (frame.frame_id, frame.sim_time, frame.capture_time) == (7, 1.5, None)

    def test_pixels_cannot_imitate_a_header(self) -> None:
        payload = header(1, 2, 2).ljust(2 * 8 * 4, b"\xee")
        frame = decode_camera(payload, "semantic", 8, 2)
        assert frame.frame_id is None
        assert frame.pixels.tobytes() == payload

    @pytest.mark.parametrize("payload", [header(1, 2, 2, magic=1), header(3, 2, 2)[:32], header(2, 2, 2)[:32]])
    def test_a_length_alone_makes_no_header(self, payload: bytes) -> None:
        with pytest.raises(ProtocolError, match="48 bytes, expected 16"):
            decode_camera(payload + bytes(16), "real", 2, 2)

    def test_header_of_another_resolution(self) -> None:
        with pytest.raises(ProtocolError, match="header says 4x1 pixels, the handshake 2x2"):
            decode_camera(header(1, 4, 1) + bytes(16), "real", 2, 2)


decoders = {
    "joint": JointRow.decode,
    "base": BaseStateRow.decode,
    "sensor": SensorRow.decode,
    "twist": TwistRow.decode,
    "actions": ActionsRow.decode,
    "control": StreamedSetPoints.decode,
    "gains": decode_gains,
    "camera": lambda payload: decode_camera(payload, "real", 2, 2),
}


@pytest.mark.parametrize("decode", decoders.values(), ids=decoders)
@given(payload=st.binary(max_size=80))
def test_any_bytes_are_read_or_refused(decode, payload: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        decode(payload)
