"""Reply blocks, read from real models."""

from __future__ import annotations

import time
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from scenes import ASSETS, BALL, BOT, make_scene

from urlab_client.enums import ObservationLevel, StepMode
from urlab_client.protocol.messages.session import ArticulationCommand, ArticulationState, Step
from urlab_client.server.assets.actors import Actor, ActorKind, ConversionSettings, Mesh
from urlab_client.server.physics.engine import Engine
from urlab_client.server.physics.observe import Observer, sim_clock, wall_clock

pytestmark = pytest.mark.mujoco("3.11")  # one of its actuators has several inputs

RICH = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1">
      <joint name="ball" type="ball"/>
      <geom size="0.1"/>
      <site name="imu"/>
      <body name="arm" pos="0 0 0.3">
        <joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="torque" joint="hinge"/>
    <intvelocity name="servo" joint="hinge" kp="5" actrange="-1 1"/>
    <orientation name="attitude" joint="ball" kp="1" input="quat"/>
    <general name="filter" joint="hinge" dyntype="filter" dynprm="0.1"/>
  </actuator>
  <sensor>
    <accelerometer name="acc" site="imu"/>
    <jointpos name="angle" joint="hinge"/>
    <framequat name="pose" objtype="body" objname="arm"/>
  </sensor>
</mujoco>
"""


@pytest.fixture
def engine() -> Iterator[Engine]:
    with Engine(make_scene(ball=BALL, rich=RICH, bot=BOT)) as engine:
        engine.set_mode(StepMode.DIRECT)
        commands = {
            "rich": ArticulationCommand(ctrl=[0.1, 0.2, 0.5, 0.5, 0.5, 0.5, 0.4]),
            "bot": ArticulationCommand(ctrl=[0.75]),
        }
        engine.step(Step(n_steps=20, per_articulation=commands), lambda mode: None)
        yield engine


@pytest.fixture
def observer(engine: Engine) -> Observer:
    return Observer(engine.scene, engine.articulations.controls)


MINIMAL = {"qpos", "qvel", "twist", "actions"}
STANDARD = MINIMAL | {"ctrl", "act", "sensors"}
FULL = STANDARD | {"bodies", "actuator_force"}


def keys(state: ArticulationState) -> set[str]:
    return set(msgspec.to_builtins(state, enc_hook=np.ndarray.tolist))


@pytest.mark.parametrize(
    ("level", "expected"),
    [(ObservationLevel.MINIMAL, MINIMAL), (ObservationLevel.STANDARD, STANDARD), (ObservationLevel.FULL, FULL)],
)
def test_each_level_has_exactly_its_keys_even_where_a_robot_lacks_the_parts(
    observer: Observer, level: ObservationLevel, expected: set[str]
) -> None:
    states = observer.articulations(level)
    assert list(states) == ["ball", "rich", "bot"]
    for state in states.values():
        assert keys(state) == expected


def test_each_articulation_gets_its_own_share_of_the_state(engine: Engine, observer: Observer) -> None:
    data = engine.scene.data
    states = observer.articulations(ObservationLevel.FULL)
    assert np.concatenate([state.qpos for state in states.values()]).tolist() == data.qpos.tolist()
    assert np.concatenate([state.qvel for state in states.values()]).tolist() == data.qvel.tolist()
    assert np.concatenate([state.ctrl for state in states.values()]).tolist() == data.ctrl.tolist()
    assert np.concatenate([state.actuator_force for state in states.values()]).tolist() == data.actuator_force.tolist()
    assert [len(state.qpos) for state in states.values()] == [7, 5, 8]
    assert states["bot"].ctrl.tolist() == [0.75]


def test_act_is_as_long_as_ctrl_with_the_first_activation_or_zero(engine: Engine, observer: Observer) -> None:
    data = engine.scene.data
    states = observer.articulations(ObservationLevel.STANDARD)
    assert states["bot"].act.tolist() == [0.0]
    assert states["ball"].act.tolist() == []
    assert states["rich"].act.tolist() == [0, data.act[0], 0, 0, 0, 0, data.act[1]]
    assert 0.0 not in data.act


def test_sensors_are_raw_slices_under_short_names(engine: Engine, observer: Observer) -> None:
    data = engine.scene.data
    states = observer.articulations(ObservationLevel.STANDARD)
    assert states["ball"].sensors == {}
    assert states["bot"].sensors == {"s": [data.sensor("bot_s").data[0]]}
    assert states["rich"].sensors == {
        name: data.sensor(f"rich_{name}").data.tolist() for name in ("acc", "angle", "pose")
    }


def test_bodies_are_world_poses_under_short_names(engine: Engine, observer: Observer) -> None:
    bodies = observer.articulations(ObservationLevel.FULL)["bot"].bodies
    assert bodies is not None
    assert list(bodies) == ["base", "arm"]
    for name, pose in bodies.items():
        assert pose.xpos == tuple(engine.scene.data.body(f"bot_{name}").xpos)
        assert pose.xquat == tuple(engine.scene.data.body(f"bot_{name}").xquat)


def test_what_was_observed_does_not_change_with_later_steps(engine: Engine, observer: Observer) -> None:
    state = observer.articulations(ObservationLevel.FULL)["bot"]
    before = msgspec.to_builtins(state, enc_hook=np.ndarray.tolist)
    engine.step(Step(n_steps=5), lambda mode: None)
    engine.reset()
    assert msgspec.to_builtins(state, enc_hook=np.ndarray.tolist) == before


def test_the_twist_is_reported_at_every_level_and_survives_reset(engine: Engine, observer: Observer) -> None:
    engine.articulations.set_twist("bot", [0.5, 0.25, 9], [9, 9, 1.5])
    engine.reset()
    for level in ObservationLevel:
        states = observer.articulations(level)
        assert states["bot"].twist.linear == (0.5, 0.25, 0.0)
        assert states["bot"].twist.angular == (0.0, 0.0, 1.5)
        assert states["ball"].twist.linear == (0.0, 0.0, 0.0)
        assert states["bot"].actions == 0


@pytest.mark.parametrize("asset", ["humanoid.xml", "ant.xml", "walker2d_v5.xml", "pusher_v5.xml"])
def test_a_single_robot_is_the_whole_model(asset: str) -> None:
    scene = make_scene(robot=ASSETS / asset)
    engine = Engine(scene)
    state = Observer(scene, engine.articulations.controls).articulations(ObservationLevel.FULL)["robot"]
    assert state.qpos.tolist() == scene.data.qpos.tolist()
    assert state.qvel.tolist() == scene.data.qvel.tolist()
    assert len(state.ctrl) == len(state.act) == len(state.actuator_force) == scene.model.nu
    assert len(state.bodies) == scene.model.nbody - 1
    assert len(state.sensors) == scene.model.nsensor


@given(st.floats(-1e9, 1e9))
def test_sim_clock_truncates_to_nanoseconds(seconds: float) -> None:
    clock = sim_clock(seconds)
    assert clock.sec == int(seconds)
    assert abs(clock.nsec) < 1_000_000_000
    assert clock.sec + 1e-9 * clock.nsec == pytest.approx(seconds, abs=2e-9, rel=1e-15)
    assert abs(clock.sec + 1e-9 * clock.nsec) <= abs(seconds) * (1 + 1e-15)


@pytest.mark.parametrize("seconds", [0.9999999999, 1.9999999999, 3599.9999999998])
def test_sim_clock_never_rounds_up(seconds: float) -> None:
    assert (sim_clock(seconds).sec, sim_clock(seconds).nsec) == (int(seconds), 999_999_999)


@given(st.floats())
def test_sim_clock_always_fits_the_wire(seconds: float) -> None:
    clock = sim_clock(seconds)
    assert abs(clock.sec) < 2**31
    assert abs(clock.nsec) < 1_000_000_000


def test_wall_clock_is_utc_now_in_steps_of_100_ns() -> None:
    before = time.time_ns()
    clock = wall_clock()
    now = clock.sec * 1_000_000_000 + clock.nsec
    assert before - 100 < now <= time.time_ns()
    assert clock.nsec % 100 == 0


def test_entities_have_coordinates_only_with_a_free_joint() -> None:
    sphere = Mesh(shape="sphere", size=(0.1,))
    free = Actor(name="Prop", label="Prop", kind=ActorKind.STATIC_MESH, location=(1.0, 2.0, 3.0), mesh=sphere)
    fixed = structs.replace(free, name="Wall", location=(4.0, 5.0, 6.0), quick_convert=ConversionSettings(static=True))
    scene = make_scene(structs.replace(free, quick_convert=ConversionSettings()), fixed, bot=BOT)
    with Engine(scene) as engine:
        engine.set_mode(StepMode.DIRECT)
        entities = engine.step(Step(n_steps=10), lambda mode: Observer(scene, engine.articulations.controls).entities())
    prop, wall = entities.values()
    assert wall.xpos == (4.0, 5.0, 6.0)
    assert (wall.qpos, wall.qvel) == (None, None)
    assert prop.xpos[:2] == (1.0, 2.0)
    assert prop.xquat == (1.0, 0.0, 0.0, 0.0)
    assert prop.qpos is not None
    assert prop.qpos.tolist() == scene.data.qpos[-7:].tolist()
    assert prop.qvel is not None
    assert prop.qvel.tolist() == scene.data.qvel[-6:].tolist()
    assert prop.qvel[2] < 0.0


def test_where_there_is_nothing_to_observe_the_collections_are_empty() -> None:
    scene = make_scene(floor='<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
    state = Observer(scene, Engine(scene).articulations.controls).articulations(ObservationLevel.FULL)["floor"]
    assert keys(state) == FULL
    assert (state.sensors, state.bodies) == ({}, {})
    empty = make_scene()
    observer = Observer(empty, Engine(empty).articulations.controls)
    assert (observer.articulations(ObservationLevel.FULL), observer.entities()) == ({}, {})
