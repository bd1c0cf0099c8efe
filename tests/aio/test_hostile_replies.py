"""Replies, handshakes, snapshots, rows and pictures that mean a client no good.

Whatever comes, only the package's own exceptions come out, a message is taken over whole or not at all, and a step
whose reply cannot be used is in doubt. Everything is read afterwards: an index that leads out of the model shows there.
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest
from hello import hello_ok
from hypothesis import given, settings
from hypothesis import strategies as st
from mangling import FACTOR

from urlab_client import SessionTakenOver, URLabError
from urlab_client.aio import URLabClient, URLabPDController
from urlab_client.errors import ProtocolError
from urlab_client.protocol.rows import decode_row
from urlab_client.protocol.topics import StreamTopic
from urlab_client.server.streams.commands import StreamedSetPoints, decode_gains
from urlab_client.values.pictures import decode_camera

pytestmark = pytest.mark.mujoco("3.12")  # one of its actuators is a `pid`

XML = """
<mujoco>
  <worldbody>
    <body name="bot_base" pos="0 0 1"><freejoint name="bot_root"/><geom size=".1" mass="1"/>
      <body name="bot_arm"><joint name="bot_elbow"/><geom size=".05" pos="0 0 .3" mass=".1"/></body></body>
    <body name="crate" pos="0 3 1"><freejoint name="crate_free"/><geom size=".1" mass="1"/></body>
    <body name="door" mocap="true"><geom size=".1"/></body>
  </worldbody>
  <actuator>
    <pid name="bot_elbow" joint="bot_elbow" kp="1" kv="1"/>
    <motor name="bot_motor" joint="bot_elbow"/>
  </actuator>
  <sensor><framepos name="bot_tip" objtype="body" objname="bot_arm"/></sensor>
</mujoco>"""


def picture(mode: str) -> dict[str, Any]:
    return {
        "mode": mode,
        "resolution": [2.0, 1.0],
        "fovy": 45.0,
        "zmq_endpoint": "tcp://0.0.0.0:5558",
        "zmq_topic": "bot/camera/eye",
    }


GAINS = {"kp": {"elbow": 1.0}, "kv": {"elbow": 1.0}, "torque_limit": {"elbow": 1.0}}
SCHEMA = {name: {"type": "per_joint", "dtype": "float32", "min": 0.0} for name in GAINS}


def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def greeting() -> dict[str, Any]:
    compiled = model()
    buffer = np.zeros(mujoco.mj_sizeModel(compiled), np.uint8)
    mujoco.mj_saveModel(compiled, None, buffer)
    bot = {
        "prefix": "bot",
        "actor_id": "b1",
        "default_control_mode": "ue_controller",
        "controller": {"kind": "pd", "params": GAINS, "schema": SCHEMA},
        "actuator_types": {"elbow": "motor", "motor": "motor"},
        "original_names": {"actuators": {}, "joints": {"elbow": "knee"}, "sensors": {}, "bodies": {}},
        "camera_topics": {"eye": picture("real"), "far": picture("depth")},
    }
    crate, door = (compiled.body(name).id for name in ("crate", "door"))
    free = {"free_joint": "crate_free", "free_joint_id": 2.0, "qpos_offset": 8.0, "qvel_offset": 7.0}
    return hello_ok(
        mjb=buffer.tobytes(),
        articulations=[bot],
        entities={
            "crate": {"id": float(crate), "has_free_base": True, **free},
            "door": {"id": float(door), "has_free_base": False},
        },
        global_cameras={"sky": picture("real")},
    )


def state(op: str, **entries: Any) -> dict[str, Any]:
    pose = {"xpos": [0.0, 0.0, 1.0], "xquat": [1.0, 0.0, 0.0, 0.0]}
    return {
        "op": op,
        "time": 0.5,
        "step": 3.0,
        "sim_time": {"sec": 0.0, "nsec": 5e8},
        "wall_time": {"sec": 1.0, "nsec": 100.0},
        "per_articulation": {
            "bot": {
                "qpos": [0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.25],
                "qvel": [0.0] * 7,
                "ctrl": [0.1, 0.2, 0.3],
                "act": [0.0, 0.0, 0.0],
                "sensors": {"tip": [1.0, 2.0, 3.0]},
                "bodies": {"base": pose, "arm": pose},
                "actuator_force": [7.0, 8.0],
                "twist": {"linear": [0.0] * 3, "angular": [0.0] * 3},
                "actions": 1.0,
            }
        },
        "entities": {"crate": {**pose, "qpos": [0.0, 3.0, 2.0, 1.0, 0.0, 0.0, 0.0], "qvel": [0.0] * 6}, "door": pose},
        **entries,
    }


def frame(dtype: str, width: float = 2.0, height: float = 1.0) -> dict[str, Any]:
    return {"width": width, "height": height, "dtype": dtype, "data": bytes(8)}


STEP = state(
    "step_ok",
    cameras={"bot/eye": frame("bgra8"), "bot/far": frame("float32"), "sky": frame("bgra8")},
    perturbation={"body_id": 1.0, "version": 1.0, "xfrc": [0.0] * 6},
)
SNAPSHOT = {**state("state_full")}
NUMBERS = [None, -1.0, 0.0, 1.0, 2.0, 3.0, 1e9, 1e300, float("nan"), float("inf"), 2**31, -(2**31), 2**62, -(2**62)]
TEXTS = ["", "bot", "crate", "..", "\0", "/", "real", "depth", "float32"]
LISTS = [[0.0] * n for n in (0, 1, 2, 6, 7, 8, 9)] + [[None], ["x"], [[]], [-1.0, -1.0], [1e9, 1e9], [0.0, 1.0]]
ODD = [*NUMBERS, *TEXTS, *LISTS, True, b"", b"xxxx", {}, {"": {}}]


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of everything inside a document, but not of its op."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        if at or key not in {"op", "session_id", "mjb"}:
            yield (*at, key)
            yield from places(item, (*at, key))


Changes = list[tuple[tuple[Any, ...], str, Any]]


def changes(document: dict[str, Any]) -> st.SearchStrategy[Changes]:
    """Return changes after which up to three values are missing, renamed or not what they should be."""
    return st.lists(st.sampled_from(list(places(document))).flatmap(partial(change, document)), min_size=1, max_size=3)


def change(document: dict[str, Any], path: tuple[Any, ...]) -> st.SearchStrategy[tuple[tuple[Any, ...], str, Any]]:
    """Return what may become of one place: most of it of the type that is there."""
    value: Any = document
    for key in path:
        value = value[key]
    alike = {float: NUMBERS, str: TEXTS, list: LISTS}.get(type(value), ODD)
    dropped = st.tuples(st.sampled_from(["drop", "rename"]), st.sampled_from(TEXTS))
    replaced = st.tuples(st.just("set"), st.sampled_from(alike))
    strange = st.tuples(st.just("set"), st.sampled_from(ODD))
    return st.one_of(dropped, replaced, replaced, strange).map(lambda made: (path, *made))


def changed(document: dict[str, Any], changes: Changes) -> dict[str, Any]:
    """Return a copy of a document with these changes."""
    made = copy.deepcopy(document)
    for path, what, value in changes:
        place: Any = made
        try:
            for key in path[:-1]:
                place = place[key]
            if what == "set":
                place[path[-1]] = copy.deepcopy(value)
            elif what == "drop":
                del place[path[-1]]
            else:
                place[str(value)] = place.pop(path[-1])
        except (KeyError, IndexError, TypeError, AttributeError):
            continue  # an earlier change took the place away
    return made


class Session:
    """A client in play with a scripted server, one for all examples of a test."""

    def __init__(self, scripted: Any, mode: str) -> None:
        self.scripted = scripted
        self.runner = asyncio.Runner()
        scripted.on("hello", greeting())
        scripted.on(
            "set_mode", lambda asked: {"op": "set_mode_ok", "previous_mode": "live", "current_mode": asked["mode"]}
        )
        self.client = URLabClient("tcp://127.0.0.1", step_port=scripted.port, step_mode=mode)
        self.run(self.client.discover())

    def run(self, call: Any) -> Any:
        return self.runner.run(call)

    def ask(self, op: str, reply: dict[str, Any], call: Any) -> URLabError | None:
        """Answer a call with this; return the client's own exception that comes out. Any other fails the test."""
        self.scripted.on(op, msgspec.msgpack.encode(reply))
        try:
            self.run(call())
        except URLabError as error:
            return error
        return None

    def close(self) -> None:
        self.run(self.client.close())
        self.runner.close()


@pytest.fixture
def direct(scripted: Any) -> Iterator[Session]:
    session = Session(scripted, "direct")
    yield session
    session.close()


@pytest.fixture
def puppet(scripted: Any) -> Iterator[Session]:
    session = Session(scripted, "puppet")
    yield session
    session.close()


def look(client: URLabClient) -> list[Any]:
    """Read everything that a user can read, comparably."""
    assert math.isfinite(client.sim_time)
    seen: list[Any] = [client.step_count, client.sim_time, client.sim_time_nsec, client.wall_time_sec]
    for entity in client.entities.values():
        seen += [entity.root_pos_w, entity.root_quat_w, entity.root_lin_vel_w, entity.root_lin_vel_b]
        seen += [entity.projected_gravity_b, entity.qpos_offset, entity.body_id]
    for art in client.articulations.values():
        seen += [art.qpos_array, art.qvel_array, art.dof_qpos, art.dof_qvel, art.act_array, art.last_applied_ctrl]
        seen += [art.twist_linear, art.root_ang_vel_w, art.root_ang_vel_b, art.get_qpos(), art.get_ctrl()]
        seen += [actuator.force for actuator in art.actuators.values()]
        seen += [body.xpos for body in art.bodies.values()]
        for sensor in art.sensors.values():
            assert sensor.latest is None or sensor.latest.shape == (sensor.dim,)
            seen.append(sensor.latest)
        seen += [camera.latest_frame for camera in art.cameras.values()]
        if art.controller is not None:
            seen += [art.controller.params, art.controller.schema]
        if isinstance(art.controller, URLabPDController):
            seen += [dict(art.controller.kp), dict(art.controller.kv), dict(art.controller.torque_limit)]
    seen += [camera.latest_frame for camera in client.global_cameras.values()]
    if client.data is not None:
        seen += [client.data.qpos.copy(), client.data.qvel.copy(), client.data.ctrl.copy(), client.data.time]
    return [np.asarray(value).tolist() if isinstance(value, np.ndarray) else value for value in seen]


def same(first: list[Any], second: list[Any]) -> bool:
    return repr(first) == repr(second)  # NaN is NaN here


FUZZ = settings(max_examples=40 * FACTOR)
FEW = settings(max_examples=20 * FACTOR)


def test_a_good_handshake_and_reply_are_taken_over(direct: Session) -> None:
    client = direct.client
    assert direct.ask("step", STEP, client.step) is None
    art = client.articulations["bot"]
    assert client.step_count == 3
    assert [actuator.force for actuator in art.actuators.values()] == [7.0, 8.0]
    assert [actuator.value for actuator in art.actuators.values()] == [0.0, 0.0]
    assert art.last_applied_ctrl.tolist() == [0.1, 0.2, 0.3]
    assert client.entities["crate"].root_pos_w.tolist() == [0.0, 3.0, 2.0]
    assert art.cameras["far"].latest_frame.shape == (1, 2)


def test_any_step_reply_is_taken_over_whole_or_not_at_all(direct: Session) -> None:
    @FUZZ
    @given(changes(STEP))
    def check(spoilt: Changes) -> None:
        reply = changed(STEP, spoilt)
        assert direct.ask("step", STEP, direct.client.step) is None
        before = look(direct.client)
        error = direct.ask("step", reply, direct.client.step)
        in_doubt = bool(direct.client._state.pending)
        after = look(direct.client)
        assert in_doubt == (error is not None)
        assert error is None or (isinstance(error, ProtocolError) and same(before, after))

    check()


def test_any_push_reply_is_taken_over_whole_or_not_at_all(puppet: Session) -> None:
    @FUZZ
    @given(changes(STEP))
    def check(spoilt: Changes) -> None:
        reply = changed(STEP, spoilt)
        mine = puppet.client.data
        before = look(puppet.client)[:4], mine.qpos.copy(), mine.time
        error = puppet.ask("step", reply, lambda: puppet.client.step(0))
        look(puppet.client)
        assert (mine.qpos == before[1]).all(), "in puppet mode the local state is the user's"
        assert mine.time == before[2]
        assert error is None or isinstance(error, ProtocolError)
        assert bool(puppet.client._state.pending) == (error is not None)

    check()


def test_any_reset_reply_is_taken_over_whole_or_not_at_all(direct: Session) -> None:
    document = state("reset_ok")

    @FEW
    @given(changes(document))
    def check(spoilt: Changes) -> None:
        reply = changed(document, spoilt)
        assert direct.ask("step", STEP, direct.client.step) is None
        before = look(direct.client)
        error = direct.ask("reset", reply, direct.client.reset)
        after = look(direct.client)
        assert error is None or (isinstance(error, ProtocolError) and same(before, after))
        assert bool(direct.client._state.pending) == (error is not None)

    check()


def test_a_refused_step_is_not_in_doubt(direct: Session) -> None:
    gone = {"op": "error", "code": "session_expired", "message": "session 'x' is not the active one"}
    error = direct.ask("step", gone, direct.client.step)
    assert isinstance(error, SessionTakenOver)
    assert not direct.client._state.pending


def test_any_handshake_is_taken_over_whole_or_not_at_all(direct: Session) -> None:
    good = greeting()

    @FUZZ
    @given(changes(good))
    def check(spoilt: Changes) -> None:
        reply = changed(good, spoilt)
        client = direct.client
        assert direct.ask("hello", good, client.discover) is None
        model, names = client.model, (list(client.articulations), list(client.entities), list(client.global_cameras))
        before = look(client)
        error = direct.ask("hello", reply, client.discover)
        after = look(client)
        if error is not None:
            assert same(before, after)
            assert client.model is model
            assert names == (list(client.articulations), list(client.entities), list(client.global_cameras))
        # What was taken over serves: a reply that fits is taken over, any other is refused.
        assert isinstance(direct.ask("step", STEP, client.step), ProtocolError | None)
        look(client)

    check()


BOT = ("per_articulation", "bot")


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (("time",), float("nan"), "the simulation time is nan"),
        ((*BOT, "qpos"), [0.0] * 7, "qpos of articulation 'bot' has 7 values, but its model has 8"),
        ((*BOT, "actuator_force"), [0.0] * 3, "actuator_force of articulation 'bot' has 3 values, but its model has 2"),
        ((*BOT, "sensors"), {"tip": [0.0]}, "sensor 'tip' of articulation 'bot' has 1 values, but its model has 3"),
        (("entities", "crate", "qvel"), [0.0] * 7, "qvel of entity 'crate' has 7 values, not 6"),
        (("perturbation", "body_id"), 1e9, "invalid perturbation of body 1000000000"),
        (("perturbation", "xfrc"), [float("nan")] * 6, "invalid perturbation of body 1 by"),
        (("cameras", "sky", "width"), -2.0, "pictures of -2x1 pixels"),
        (("cameras", "sky", "data"), b"", "0 bytes, expected 8"),
        (("cameras", "sky", "dtype"), "float32", "a frame of real camera 'sky' has dtype 'float32'"),
        (("cameras", "moon"), frame("bgra8"), "a frame of camera 'moon', which the handshake does not list"),
    ],
)
def test_what_is_wrong_with_a_reply_is_said(direct: Session, place: tuple[Any, ...], value: Any, problem: str) -> None:
    before = look(direct.client)
    error = direct.ask("step", changed(STEP, [(place, "set", value)]), direct.client.step)
    assert isinstance(error, ProtocolError)
    assert problem in str(error)
    assert same(before, look(direct.client))
    assert direct.client._state.pending


CRATE = ("entities", "crate")
EYE = ("articulations", 0, "camera_topics", "eye")


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        ((*CRATE, "id"), 1000.0, "entity 'crate' is body 1000, but the bodies of its model are 1 to 4"),
        ((*CRATE, "id"), -1.0, "entity 'crate' is body -1"),
        ((*CRATE, "id"), 1.0, "entity 'crate' has joint and offsets"),
        ((*CRATE, "qpos_offset"), 15.0, "entity 'crate' has joint and offsets"),
        ((*CRATE, "qvel_offset"), -6.0, "entity 'crate' has joint and offsets"),
        ((*CRATE, "free_joint_id"), 77.0, "entity 'crate' has joint and offsets"),
        (("entities", "door", "has_free_base"), True, "entity 'door' has a free base, unlike its model"),
        ((*EYE, "resolution"), [-2.0, -1.0], "camera 'eye' of articulation 'bot': pictures of -2x-1 pixels"),
        ((*EYE, "resolution"), [1e9, 1e9], "each side has 1 to 16384"),
        (("global_cameras", "sky", "resolution"), [0.0, 1.0], "camera 'sky' of the scene: pictures of 0x1"),
        (("articulations", 0, "prefix"), "", "keys must be unique and not empty"),
        (("instance",), {"state_port": 70000.0}, "its state stream is on port 70000"),
        (("articulations", 0, "controller", "params", "kp"), [1.0], "kp of the controller of 'bot'"),
        (("articulations", 0, "controller", "schema", "kp", "min"), "low", "the minimum of kp"),
    ],
)
def test_what_is_wrong_with_a_handshake_is_said(
    direct: Session, place: tuple[Any, ...], value: Any, problem: str
) -> None:
    error = direct.ask("hello", changed(greeting(), [(place, "set", value)]), direct.client.discover)
    assert isinstance(error, ProtocolError)
    assert problem in str(error)


def test_a_model_with_names_that_are_not_text_is_refused(direct: Session) -> None:
    xml = '<mujoco><worldbody><body name="&#xD800;"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    odd = mujoco.MjModel.from_xml_string(xml)
    buffer = np.zeros(mujoco.mj_sizeModel(odd), np.uint8)
    mujoco.mj_saveModel(odd, None, buffer)
    before = look(direct.client)
    error = direct.ask("hello", hello_ok(mjb=buffer.tobytes()), direct.client.discover)
    assert isinstance(error, ProtocolError)
    assert "is not text" in str(error)
    assert same(before, look(direct.client))


def test_a_free_joint_without_a_name_is_not_the_articulations(direct: Session) -> None:
    """The wire counts the positions of an articulation by the names of its joints."""
    body = '<body name="bot_base"><freejoint/><geom size=".1"/><body name="bot_a"><joint name="bot_j"/>'
    xml = f'<mujoco><worldbody>{body}<geom size=".1"/></body></body></worldbody></mujoco>'
    odd = mujoco.MjModel.from_xml_string(xml)
    buffer = np.zeros(mujoco.mj_sizeModel(odd), np.uint8)
    mujoco.mj_saveModel(odd, None, buffer)
    bot = {**greeting()["articulations"][0], "camera_topics": {}}
    assert direct.ask("hello", hello_ok(mjb=buffer.tobytes(), articulations=[bot]), direct.client.discover) is None
    art = direct.client.articulations["bot"]
    assert not art.has_free_base
    assert art.qpos_array.shape == art.dof_qpos.shape == (1,)


def test_a_camera_of_the_scene_that_a_program_holds_follows_the_next_handshake(direct: Session) -> None:
    client, later = direct.client, greeting()
    assert direct.ask("hello", greeting(), client.discover) is None
    held = client.global_cameras["sky"]
    later["global_cameras"]["sky"]["resolution"] = [4.0, 3.0]
    assert direct.ask("hello", later, client.discover) is None
    assert client.global_cameras["sky"] is held
    assert tuple(held.info.resolution) == (4, 3)


def test_any_handshake_without_a_local_model(scripted: Any) -> None:
    good = greeting()
    session = Session(scripted, "direct")
    client = URLabClient("tcp://127.0.0.1", step_port=scripted.port, step_mode="direct", local_model=False)

    @FUZZ
    @given(changes(good), changes(STEP))
    def check(hello: Changes, step: Changes) -> None:
        session.ask("hello", changed(good, hello), client.discover)
        session.ask("step", changed(STEP, step), client.step)
        for entity in client.entities.values():
            for name in ("root_pos_w", "root_lin_vel_w", "projected_gravity_b"):
                with contextlib.suppress(URLabError):  # some of it follows from a model
                    getattr(entity, name)
        for art in client.articulations.values():
            assert all(isinstance(a.force, float | None) for a in art.actuators.values())
            assert art.get_sensors() is not None

    check()
    session.run(client.close())
    session.close()


def test_poses_of_entities_without_a_model_are_copies(scripted: Any, direct: Session) -> None:
    client = URLabClient("tcp://127.0.0.1", step_port=scripted.port, step_mode="direct", local_model=False)
    direct.run(client.discover())
    scripted.on("step", STEP)
    reply = direct.run(client.step())
    crate = client.entities["crate"]
    crate.root_pos_w[:] = crate.root_lin_vel_w[:] = 77.0
    reply.entities["crate"].qpos[:] = reply.entities["crate"].qvel[:] = 77.0
    assert crate.root_pos_w.tolist() == [0.0, 3.0, 2.0]
    assert crate.root_lin_vel_w.tolist() == [0.0] * 3
    direct.run(client.close())


def test_any_snapshot_is_taken_over_whole_or_not_at_all(direct: Session) -> None:
    client = direct.client
    direct.run(client.runtime.set_mode("live"))
    reception = client._state._live

    def hand_in(document: dict[str, Any]) -> None:
        reception.on_message(b"state/full", msgspec.msgpack.encode(document))
        reception.on_drained()

    @FUZZ
    @given(changes(SNAPSHOT))
    def check(spoilt: Changes) -> None:
        hand_in(SNAPSHOT)
        before, refused = look(client), reception.stats.refused
        hand_in(changed(SNAPSHOT, spoilt))
        after = look(client)
        assert reception.stats.refused == refused or same(before, after)

    direct.run(asyncio.to_thread(check))


@pytest.mark.parametrize(
    ("op", "good", "call"),
    [
        ("set_mode", {"op": "set_mode_ok", "previous_mode": "live", "current_mode": "direct"}, "set_mode"),
        (
            "set_qpos",
            {
                "op": "set_qpos_ok",
                "target": "bot",
                "actor_name": "bot",
                "qpos": [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0],
                "free_base_shortcut": True,
            },
            "set_qpos",
        ),
        (
            "set_sim_options",
            {
                "op": "set_sim_options_ok",
                "options": {
                    "timestep": 0.002,
                    "gravity": [0.0, 0.0, -9.81],
                    "iterations": 100.0,
                    "integrator": "4",
                    "cone": "elliptic",
                    "solver": "newton",
                    "enable_sleep": True,
                    "disableflags": 0.0,
                    "max_worker_threads": 4.0,
                },
            },
            "set_sim_options",
        ),
        ("forward", state("forward_ok"), "forward"),
        (
            "configure_controller",
            {"op": "configure_controller_ok", "articulation": "bot", "params": GAINS},
            "configure",
        ),
        ("pie_status", {"op": "pie_status_ok", "state": "ready", "compile_error": "", "sim_time": 0.5}, "status"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_any_other_reply_that_is_mirrored(direct: Session, op: str, good: dict[str, Any], call: str) -> None:
    client = direct.client
    calls = {
        "set_mode": lambda: client.runtime.set_mode("direct"),
        "set_qpos": lambda: client.runtime.set_qpos("bot", [0.0] * 8, by_name=True),
        "set_sim_options": client.runtime.set_sim_options,
        "forward": client.runtime.forward,
        "configure": client.articulations["bot"].controller.refresh,
        "status": client.sim.status,
    }

    def options() -> str:
        names = [name for name in dir(client.model.opt) if not name.startswith("_")]
        return repr([getattr(client.model.opt, name) for name in names])

    assert direct.ask(op, good, calls[call]) is None

    @FEW
    @given(changes(good))
    def check(spoilt: Changes) -> None:
        reply = changed(good, spoilt)
        before = look(client), options()
        error = direct.ask(op, reply, calls[call])
        after = look(client), options()
        assert error is None or (same(before[0], after[0]) and before[1] == after[1])

    check()


@pytest.mark.parametrize("count", [0, 6, 9])
def test_positions_that_nobody_can_have_written(direct: Session, count: int) -> None:
    written = {"op": "set_qpos_ok", "target": "bot", "actor_name": "bot", "free_base_shortcut": False}
    before = look(direct.client)
    ask = direct.client.runtime.set_qpos
    error = direct.ask("set_qpos", {**written, "qpos": [1.0] * count}, lambda: ask("bot", [1.0] * 8, by_name=True))
    assert isinstance(error, ProtocolError)
    assert f"qpos of articulation 'bot' has {count} values, but its model has 8" in str(error)
    assert same(before, look(direct.client))


@given(st.binary(max_size=64), st.binary(max_size=80))
def test_any_row(topic: bytes, payload: bytes) -> None:
    for parsed in (b"bot/joint/elbow", b"bot/sensor/s", b"bot/base_state/root", b"scene/crate/qpos", topic):
        try:
            decode_row(StreamTopic.parse(parsed), payload)
        except ProtocolError:
            continue


@given(st.binary(max_size=80))
def test_any_message_of_the_other_sockets(payload: bytes) -> None:
    for decode in (StreamedSetPoints.decode, decode_gains):
        try:
            decode(payload)
        except ProtocolError:
            continue


SIDES = st.sampled_from([-(2**62), -2, -1, 0, 1, 2, 3, 2**14, 2**15, 2**31, 2**62])


@given(st.sampled_from(["real", "depth", "semantic", "thermal", ""]), SIDES, SIDES, st.integers(0, 64) | st.none())
def test_any_picture(mode: str, width: int, height: int, size: int | None) -> None:
    fitting = min(abs(width * height * 4), 1000)
    try:
        frame = decode_camera(bytes(fitting if size is None else size), mode, width, height)
    except ProtocolError:
        return
    assert frame.pixels.shape[:2] == (height, width)
    assert frame.pixels.size > 0
