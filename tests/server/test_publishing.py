"""The state, info and control sockets, seen by plain ZeroMQ sockets that know nothing of the package's client."""

from __future__ import annotations

import itertools
import json
import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq
from waiting import attempts, eventually
from wire import Wire, check_numbers, float32, server_threads, set_points, write_level

from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.rows import ActionsRow, BaseStateRow, JointRow, SceneRow, SensorRow, TwistRow, decode_row
from urlab_client.protocol.topics import StreamTopic
from urlab_client.server import SimulatedServer
from urlab_client.server.physics.engine import Engine
from urlab_client.server.streams import broadcast, publishing
from urlab_client.server.transport.endpoint import bound_peers
from urlab_client.simulation.controller_config import ControllerConfig

Tick = list[tuple[bytes, bytes]]

ROWS = [b"bot/base_state/root", b"bot/joint/j", b"bot/sensor/s", b"bot/twist"]


MULTI = """
<mujoco model="multi">
  <worldbody>
    <body><joint name="turn" type="ball"/><geom size="0.1"/>
      <body pos="1 0 0"><joint name="h"/><geom size="0.1"/></body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m" joint="h"/>
    <orientation name="o" joint="turn" kp="3"/>
    <motor name="last" joint="h"/>
  </actuator>
</mujoco>
"""


class Bench:
    """A playing server, an RPC client of it and raw sockets at its other ports."""

    def __init__(self, stack: ExitStack, server: SimulatedServer, wire: Wire) -> None:
        self.server = server
        self.wire = wire
        self._stack = stack
        self._context = stack.enter_context(zmq.Context())

    def open(self, kind: int, port: int, **options: int) -> zmq.Socket[bytes]:
        socket = self._stack.enter_context(self._context.socket(kind))
        socket.linger = 0
        socket.rcvtimeo = 30_000
        socket.rcvhwm = 0  # a test that is held up misses nothing
        for name, value in options.items():
            setattr(socket, name, value)
        socket.connect(f"{self.server.address}:{port}")
        return socket

    def subscribe(self, *topics: bytes, **options: int) -> zmq.Socket[bytes]:
        """Subscribe to the state socket."""
        socket = self.open(zmq.SUB, self.server.state_port, **options)
        for topic in topics:
            socket.subscribe(topic)
        return socket

    def control(self) -> zmq.Socket[bytes]:
        """Return a publisher that the server has subscribed to."""
        publisher = self.open(zmq.XPUB, self.server.ctrl_port)
        assert {publisher.recv(), publisher.recv()} == {b"\x01bot/control ", b"\x01bot/set_gains "}
        return publisher

    def hurry(self) -> None:
        """Have physics tick every 0.1 ms."""
        with self.engine.lock:
            self.engine.scene.model.opt.timestep = 1e-4

    @property
    def engine(self) -> Engine:
        running = self.server._running.core.play.current
        assert running is not None
        return running.engine


Play = Callable[..., Bench]


@pytest.fixture
def play(models: Path, connect: Callable[[SimulatedServer], Wire]) -> Iterator[Play]:
    with ExitStack() as stack:

        def start(*names: str | Path, **options: Any) -> Bench:
            paths = [models / f"{name}.xml" if isinstance(name, str) else name for name in names or ("bot",)]
            server = stack.enter_context(SimulatedServer(*paths, play=True, **options))
            wire = connect(server)
            wire.hello()
            return Bench(stack, server, wire)

        yield start


def ticks(socket: zmq.Socket[bytes]) -> Iterator[Tick]:
    """Yield what comes up to and with each snapshot, beginning after the first one."""
    tick: Tick = []
    whole = False
    for _ in attempts("not all of the ticks that the test waits for came"):
        topic, payload = socket.recv_multipart()
        tick.append((topic, payload))
        if topic == b"state/full":
            if whole:
                yield tick
            whole, tick = True, []


def snapshot(tick: Tick) -> StateSnapshot:
    assert tick[-1][0] == b"state/full"
    return StateSnapshot.decode(tick[-1][1])


def rows(tick: Tick) -> list[Any]:
    return [decode_row(StreamTopic.parse(topic), payload) for topic, payload in tick[:-1]]


def stepped(topic: bytes, payload: bytes) -> bool:
    """Whether a message is the snapshot of a direct step."""
    return topic == b"state/full" and StateSnapshot.decode(payload).step > 0


# The state socket


def test_a_live_tick_brings_the_rows_of_each_articulation_and_then_the_snapshot(play: Play) -> None:
    bench = play("bot", unpaused=True)
    bench.wire.ask("set_twist", articulation="bot", linear=[0.5, 0.25, 0], angular=[0, 0, -1])
    stream = ticks(bench.subscribe(b""))
    tick = next(tick for tick in stream if snapshot(tick).per_articulation["bot"].twist.linear[0])
    assert [topic for topic, _ in tick] == [*ROWS, b"state/full"]
    base, joint, sensor, twist = rows(tick)
    state = snapshot(tick).per_articulation["bot"]
    assert isinstance(base, BaseStateRow)
    np.testing.assert_array_equal(base.position, state.qpos[:3].astype(np.float32))
    np.testing.assert_array_equal(base.quat_xyzw, state.qpos[[4, 5, 6, 3]].astype(np.float32))
    np.testing.assert_array_equal(base.linear_velocity, state.qvel[:3].astype(np.float32))
    np.testing.assert_array_equal(base.angular_velocity, state.qvel[3:6].astype(np.float32))
    assert isinstance(joint, JointRow)
    assert joint.id == 1
    assert (joint.position, joint.velocity) == (float32(state.qpos[7]), float32(state.qvel[6]))
    assert isinstance(sensor, SensorRow)
    assert sensor.id == 0
    assert sensor.values.tolist() == [float32(state.sensors["s"][0])]
    assert twist == TwistRow(0.5, 0.25, -1.0)


def test_rows_have_the_sizes_and_ids_of_the_wire(play: Play) -> None:
    tick = next(ticks(play().subscribe(b"")))
    assert {topic: len(payload) for topic, payload in tick[:-1]} == dict(zip(ROWS, (52, 16, 12, 12), strict=True))
    assert tick[0][1] == np.array([0, 0, 1, 0, 0, 0, 1, *[0] * 6], "<f4").tobytes()


def test_action_keys_travel_only_while_one_is_down(play: Play) -> None:
    bench = play()
    stream = ticks(bench.subscribe(b""))
    assert b"bot/actions" not in dict(next(stream))
    twist = bench.engine.articulations.control("bot").twist
    twist.actions = 0b101
    tick = next(tick for tick in stream if b"bot/actions" in dict(tick))
    assert [topic for topic, _ in tick] == [*ROWS, b"bot/actions", b"state/full"]
    assert rows(tick)[-1] == ActionsRow(0b101)
    assert snapshot(tick).per_articulation["bot"].actions == 0b101


def test_scene_rows_come_after_all_articulations_and_in_double_precision(play: Play, tmp_path: Path) -> None:
    bench = play("bot", "ball", write_level(tmp_path / "level.json", size=0.5, quick_convert=True))
    tick = next(ticks(bench.subscribe(b"")))
    topics = [topic for topic, _ in tick]
    assert topics[: len(ROWS)] == ROWS
    assert topics[len(ROWS)].startswith(b"ball/base_state/")
    ((name, crate),) = snapshot(tick).entities.items()
    scene = topics[topics.index(b"ball/twist") + 1 : -1]
    assert [topic.decode() for topic in scene] == [f"scene/{name}/{part}" for part in ("xpos", "xquat", "qpos", "qvel")]
    xpos, xquat, qpos, qvel = (row for row in rows(tick) if isinstance(row, SceneRow))
    assert tuple(xpos.values) == crate.xpos
    assert tuple(xquat.values) == crate.xquat
    np.testing.assert_array_equal(qpos.values, crate.qpos)
    np.testing.assert_array_equal(qvel.values, crate.qvel)


def test_the_snapshot_is_standard_msgpack_of_float64_whatever_the_session_asked_for(play: Play) -> None:
    bench = play()
    bench.wire.raw({"op": "hello", "observations": "full"})
    _, payload = next(ticks(bench.subscribe(b"state/full")))[-1]
    check_numbers(payload)
    plain = msgspec.msgpack.decode(payload)
    assert list(plain) == ["op", "time", "step", "sim_time", "wall_time", "per_articulation", "entities"]
    assert plain["op"] == "state_full"
    assert plain["entities"] == {}
    block = plain["per_articulation"]["bot"]
    assert set(block) == {"qpos", "qvel", "ctrl", "act", "sensors", "twist", "actions"}
    assert plain["wall_time"]["nsec"] % 100 == 0


def test_live_time_moves_with_every_tick_and_the_counter_does_not(play: Play, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "WAITING_TICKS", 1_000_000)  # no tick is lost where the streams' thread is held up
    bench = play("bot", unpaused=True)
    seen = [snapshot(tick) for tick in itertools.islice(ticks(bench.subscribe(b"state/full")), 20)]
    counts = [round(s.time / 0.002) for s in seen]
    assert counts == list(range(counts[0], counts[0] + 20))
    assert {s.step for s in seen} == {0}


def test_paused_live_repeats_the_state(play: Play) -> None:
    stream = ticks(play().subscribe(b""))
    seen = list(itertools.islice(stream, 5))
    assert {snapshot(tick).time for tick in seen} == {0.0}
    assert all([topic for topic, _ in tick] == [*ROWS, b"state/full"] for tick in seen)


def test_direct_mode_sends_one_snapshot_per_step_and_no_rows(play: Play) -> None:
    bench = play()
    bench.wire.ask("set_mode", mode="direct")
    stream = ticks(bench.subscribe(b""))
    next(stream)
    replies = [bench.wire.ask("step", n_steps=3) for _ in range(5)]
    seen: dict[float, Tick] = {}
    while replies[-1]["time"] not in seen:
        tick = next(stream)
        seen[snapshot(tick).time] = tick
    assert {reply["time"] for reply in replies} <= set(seen)
    assert {topic for tick in seen.values() for topic, _ in tick} == {b"state/full"}
    last = snapshot(seen[replies[-1]["time"]])
    assert last.step == 15
    assert last.per_articulation["bot"].qpos.tolist() == replies[-1]["per_articulation"]["bot"]["qpos"]


def test_puppet_mode_shows_the_last_push_and_no_rows(play: Play) -> None:
    bench = play()
    bench.wire.ask("set_mode", mode="puppet")
    stream = ticks(bench.subscribe(b""))
    next(stream)
    pushed = [0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0, 0.5]
    bench.wire.ask("step", qpos=pushed, time=7.0)
    tick = next(tick for tick in stream if snapshot(tick).step)
    assert len(tick) == 1
    assert snapshot(tick).time == 7.0
    assert snapshot(tick).per_articulation["bot"].qpos.tolist() == pushed


def test_rows_return_with_live_mode(play: Play) -> None:
    bench = play()
    bench.wire.ask("set_mode", mode="direct")
    stream = ticks(bench.subscribe(b""))
    assert len(next(stream)) == 1
    bench.wire.ask("set_mode", mode="live")
    assert next(len(tick) for tick in stream if len(tick) > 1) == len(ROWS) + 1


def test_a_subscriber_stays_through_play_sessions(play: Play) -> None:
    bench = play()
    stream = ticks(bench.subscribe(b"state/full"))
    bench.wire.ask("set_mode", mode="direct")
    bench.wire.ask("step")
    assert next(snapshot(tick).step for tick in stream if snapshot(tick).step) == 1
    bench.wire.ask("stop_pie")
    bench.wire.ask("begin_pie")
    assert next(snapshot(tick).step for tick in stream if not snapshot(tick).step) == 0


def test_a_state_beyond_float32_does_not_stop_the_stream(play: Play) -> None:
    bench = play()
    bench.wire.ask("set_mode", mode="puppet")
    bench.wire.ask("step", qpos=[0, 0, 1, 1, 0, 0, 0, 1e300])
    bench.wire.ask("set_mode", mode="live")
    bench.wire.ask("set_paused", paused=True)
    row = decode_row(StreamTopic.parse(b"bot/joint/j"), bench.subscribe(b"bot/joint/j").recv_multipart()[1])
    assert isinstance(row, JointRow)


def test_without_articulations_there_are_no_rows(play: Play, tmp_path: Path) -> None:
    bench = play(write_level(tmp_path / "level.json", size=0.5, quick_convert=True))
    tick = next(ticks(bench.subscribe(b"")))
    assert len(tick) == 1
    assert len(snapshot(tick).entities) == 1


def test_a_message_that_fails_costs_the_others_nothing(
    play: Play, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_: JointRow) -> bytes:
        raise ValueError("no such row")

    monkeypatch.setattr(JointRow, "encode", fail)
    bench = play("bot", unpaused=True)
    socket = bench.subscribe(b"")
    tick = next(ticks(socket))
    assert [topic for topic, _ in tick] == [*(row for row in ROWS if row != b"bot/joint/j"), b"state/full"]
    assert snapshot(tick).per_articulation.keys() == {"bot"}
    assert "no such row" in caplog.text
    assert bench.server.failure is None


# What it costs


def test_only_what_is_subscribed_to_is_encoded(play: Play, monkeypatch: pytest.MonkeyPatch) -> None:
    encoded: list[str] = []

    def count(kind: type[Any], name: str) -> None:
        encode = kind.encode
        monkeypatch.setattr(kind, "encode", lambda row: encoded.append(name) or encode(row))

    for kind in (JointRow, SensorRow, TwistRow):
        count(kind, kind.__name__)
    monkeypatch.setattr(broadcast, "encode_reply", lambda reply: encoded.append("snapshot"))
    socket = play().subscribe(b"bot/joint/")
    assert {socket.recv_multipart()[0] for _ in range(20)} == {b"bot/joint/j"}
    assert set(encoded) == {"JointRow"}


def test_physics_is_left_alone_while_nobody_subscribes(play: Play) -> None:
    bench = play("bot", unpaused=True)
    hooks = bench.engine.on_tick
    idle = hooks.copy()
    socket = bench.subscribe(b"bot/joint/", b"state/full")
    socket.recv_multipart()
    assert len(hooks) == len(idle) + 1
    socket.close()
    assert next(True for _ in bench.wire.until("pie_status") if hooks == idle)


def test_a_subscriber_that_never_reads_slows_nobody(play: Play, monkeypatch: pytest.MonkeyPatch) -> None:
    def narrow(socket: zmq.Socket[bytes]) -> None:
        bound_peers(socket)
        socket.sndbuf = 4096  # else the kernel takes megabytes

    monkeypatch.setattr(publishing, "bound_peers", narrow)
    bench = play("bot", unpaused=True)
    bench.hurry()
    lazy = bench.subscribe(b"", rcvhwm=1, rcvbuf=4096)
    lazy.recv_multipart()
    reader = bench.subscribe(b"state/full")
    first = StateSnapshot.decode(reader.recv_multipart()[1]).time
    for read, _ in enumerate(attempts("too few snapshots came"), start=1):
        time = StateSnapshot.decode(reader.recv_multipart()[1]).time
        # 1000 times 5 messages: as many wait for the lazy one, and what the kernel holds.
        if time >= first + 0.4 and read >= 1000:
            break
    sent = read * (len(ROWS) + 1)
    bench.wire.ask("set_mode", mode="direct")
    bench.wire.ask("step")  # from now on its snapshot comes ten times a second: also to the lazy one, when it has room
    late = itertools.takewhile(lambda message: not stepped(*message), iter(lazy.recv_multipart, None))
    assert sum(1 for _ in late) < sent


def test_closing_does_not_wait_for_subscribers(play: Play) -> None:
    before = server_threads()
    bench = play("bot", unpaused=True)
    bench.subscribe(b"", rcvhwm=1).recv_multipart()
    bench.control()
    bench.server.close()
    eventually(lambda: server_threads() <= before, "its threads did not end")


# The control socket


def test_streamed_set_points_reach_the_actuators_by_global_id(play: Play) -> None:
    bench = play()
    payload = set_points({99: 5.0, 0: 0.1, -1: 7.0})
    bench.control().send_multipart([b"bot/control ", payload + b"surplus"])
    for reply in bench.wire.until("forward"):
        (ctrl,) = reply["per_articulation"]["bot"]["ctrl"]
        if ctrl:
            assert ctrl == float32(0.1)
            break


def test_ids_are_global_whatever_the_topic_says(play: Play, models: Path) -> None:
    bench = play("bot", "limited")
    publisher = bench.open(zmq.XPUB, bench.server.ctrl_port)
    assert len({publisher.recv() for _ in range(4)}) == 4
    payload = set_points({1: 0.5})
    publisher.send_multipart([b"bot/control ", payload])
    for reply in bench.wire.until("forward"):
        if reply["per_articulation"]["copy1_bot"]["ctrl"] == [0.5]:
            assert reply["per_articulation"]["bot"]["ctrl"] == [0.0]
            break


@pytest.mark.mujoco("3.11")
def test_an_actuator_of_several_inputs_takes_its_first_by_id(play: Play, tmp_path: Path) -> None:
    path = tmp_path / "multi.xml"
    path.write_text(MULTI)
    bench = play(path, path)
    publisher = bench.open(zmq.XPUB, bench.server.ctrl_port)
    assert len({publisher.recv() for _ in range(4)}) == 4
    ids = np.arange(1, 6)
    publisher.send_multipart([b"multi/control ", set_points({int(number): float(number) for number in ids})])
    for reply in bench.wire.until("forward"):
        ctrl = {key: state["ctrl"] for key, state in reply["per_articulation"].items()}
        if ctrl["multi"][4]:
            assert ctrl["multi"][0] == 0.0
            assert ctrl["multi"][1] == 1.0
            assert ctrl["multi"][4] == 2.0
            assert [ctrl["copy1_multi"][place] for place in (0, 1, 4)] == [3.0, 4.0, 5.0]
            break


def test_set_points_streamed_outside_live_mode_are_lost(play: Play, caplog: pytest.LogCaptureFixture) -> None:
    bench = play()
    bench.wire.ask("set_mode", mode="direct")
    stream = ticks(bench.subscribe(b"state/full"))
    next(stream)
    publisher = bench.control()
    with caplog.at_level(logging.WARNING, "urlab_client.server"):
        publisher.send_multipart([b"bot/control ", set_points({0: 0.5})])
        publisher.send_multipart([b"bot/control ", b"\x05"])
        assert next(True for _ in bench.wire.until("pie_status") if "control message is ignored" in caplog.text)
    # A snapshot made after that was published after the commands were dealt with.
    bench.wire.ask("step")
    assert next(True for tick in stream if snapshot(tick).step)
    bench.wire.ask("set_mode", mode="live")
    moved = next(s for s in map(snapshot, stream) if s.time > 0.01)
    assert moved.per_articulation["bot"].ctrl.tolist() == [0.0]


@pytest.mark.parametrize(
    "frames",
    [
        [b"bot/control "],
        [b"bot/control ", b""],
        [b"bot/control ", b"\x02\0\0\0\0\0\0\0"],
        [b"bot/control ", b"\xff\xff\xff\xff"],
        [b"bot/set_gains ", b"{"],
        [b"bot/set_gains ", b'{"m": 3}'],
        [b"bot/set_gains ", b'{"nobody": {"kp": 3}}'],
    ],
)
def test_a_bad_message_disturbs_nothing(play: Play, frames: list[bytes]) -> None:
    bench = play()
    publisher = bench.control()
    publisher.send_multipart(frames)
    publisher.send_multipart([b"bot/control ", set_points({0: 0.5})])
    assert next(True for reply in bench.wire.until("forward") if reply["per_articulation"]["bot"]["ctrl"] == [0.5])


def test_of_too_many_commands_that_wait_for_physics_the_oldest_go(play: Play, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "WAITING_COMMANDS", 3)
    bench = play("bot", "limited")
    publisher = bench.open(zmq.XPUB, bench.server.ctrl_port)
    assert len({publisher.recv() for _ in range(4)}) == 4
    waiting = bench.server._running.streams._commands
    commands = [(1, 0.9), (0, 0.1), (0, 0.2), (0, 0.3)]
    with bench.engine.lock:
        for actuator, value in commands:
            payload = set_points({actuator: value})
            publisher.send_multipart([b"bot/control ", payload])
        eventually(lambda: len(waiting) == 3 and waiting[-1].values[0] == np.float32(0.3))
    for reply in bench.wire.until("forward"):
        ctrl = {key: state["ctrl"] for key, state in reply["per_articulation"].items()}
        if ctrl["bot"] != [0.0]:
            break
    assert ctrl == {"bot": [float32(0.3)], "copy1_bot": [0.0]}


def test_streamed_gains_reach_the_controller(play: Play) -> None:
    bench = play(controllers={"*": ControllerConfig()})
    gains = {"m": {"kp": 7.0, "torque_limit": 0.1}}
    bench.control().send_multipart([b"bot/set_gains ", msgspec.json.encode(gains)])
    for reply in bench.wire.until("configure_controller", articulation="bot", params={}):
        if reply["params"]["kp"] == {"m": 7.0}:
            assert reply["params"]["torque_limit"] == {"m": float32(0.1)}
            assert reply["params"]["kv"] == {"m": 5.0}
            break


def test_the_server_listens_only_while_play_lasts(play: Play) -> None:
    bench = play()
    publisher = bench.control()
    bench.wire.ask("stop_pie")
    assert {publisher.recv(), publisher.recv()} == {b"\x00bot/control ", b"\x00bot/set_gains "}
    bench.wire.ask("begin_pie")
    assert {publisher.recv(), publisher.recv()} == {b"\x01bot/control ", b"\x01bot/set_gains "}


# The info socket


def test_info_describes_every_articulation_in_one_frame_each(play: Play) -> None:
    bench = play("bot", "limited")
    bench.hurry()
    socket = bench.open(zmq.SUB, bench.server.info_port)
    socket.subscribe(b"")
    frames = [socket.recv_multipart() for _ in range(2)]
    assert [len(message) for message in frames] == [1, 1]
    bot, limited = (json.loads(message[0]) for message in frames)
    announced = [
        {"name": name, "endpoint": camera["zmq_endpoint"]}
        for articulation in bench.wire.hello()["articulations"]
        for name, camera in articulation["camera_topics"].items()
    ]
    assert len(announced) == 2
    assert bot == {
        "type": "actuator_list",
        "robot": "bot",
        "names": ["bot_m"],
        "ids": [0],
        "mins": [-1.0],
        "maxs": [1.0],
        "camera_list": announced,
    }
    assert (limited["robot"], limited["ids"], limited["mins"], limited["maxs"]) == ("copy1_bot", [1], [-100.0], [100.0])


@pytest.mark.mujoco("3.11")
def test_info_tells_the_range_of_the_first_input_behind_an_actuator_of_several(play: Play, tmp_path: Path) -> None:
    path = tmp_path / "multi.xml"
    path.write_text(MULTI.replace('name="last"', 'name="last" ctrlrange="-2 3" ctrllimited="true"'))
    bench = play(path)
    bench.hurry()
    socket = bench.open(zmq.SUB, bench.server.info_port)
    socket.subscribe(b"")
    info = json.loads(socket.recv())
    assert (info["ids"], info["mins"], info["maxs"]) == ([0, 1, 2], [-100.0, -100.0, -2.0], [100.0, 100.0, 3.0])


def test_info_pauses_outside_live_mode(play: Play) -> None:
    bench = play()
    bench.wire.ask("set_mode", mode="direct")
    socket = bench.open(zmq.SUB, bench.server.info_port)
    socket.subscribe(b"")
    stream = ticks(bench.subscribe(b"state/full"))
    next(stream)
    for _ in range(60):
        bench.wire.ask("step")
    assert next(True for tick in stream if snapshot(tick).step == 60)
    assert not socket.poll(0)


def test_info_comes_often_at_first_and_rarely_later() -> None:
    due = list(itertools.takewhile(lambda tick: tick <= 4000, _info_ticks()))
    assert due[:3] == [50, 100, 150]
    assert due[49:] == [2500, 3000, 3500, 4000]


def _info_ticks() -> Iterator[int]:
    tick = 0
    while True:
        tick = broadcast.next_info(tick)
        yield tick
