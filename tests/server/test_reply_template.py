"""Replies to `step` that are filled in are those that are encoded, byte for byte."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scenes import BALL, BOT, make_scene
from test_observations import RICH

from urlab_client.enums import ObservationLevel, StepMode
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.messages.session import Clock, Step, StepOk
from urlab_client.server.assets.actors import Actor, ActorKind, ConversionSettings, Mesh
from urlab_client.server.physics.engine import Engine
from urlab_client.server.physics.observe import Observer, sim_clock
from urlab_client.server.physics.reply_template import StepReplies

pytestmark = pytest.mark.mujoco("3.11")  # its robot has an actuator of several inputs

CRATE = Actor(
    name="Crate",
    label="Crate",
    kind=ActorKind.STATIC_MESH,
    location=(1.0, 2.0, 3.0),
    mesh=Mesh(shape="sphere", size=(0.1,)),
    quick_convert=ConversionSettings(),
)


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    with Engine(make_scene(CRATE, ball=BALL, rich=RICH, bot=BOT)) as engine:
        engine.set_mode(StepMode.DIRECT)
        engine.step(Step(n_steps=3), lambda _: None)
        yield engine


@pytest.fixture(scope="module")
def frames(engine: Engine) -> StepReplies:
    return StepReplies(engine.scene, engine.articulations.controls)


def encoded(engine: Engine, level: ObservationLevel, wall_time: Clock) -> bytes:
    observer = Observer(engine.scene, engine.articulations.controls)
    return encode_reply(
        StepOk(
            time=engine.time,
            step=engine.step_count,
            sim_time=sim_clock(engine.time),
            wall_time=wall_time,
            per_articulation=observer.articulations(level),
            entities=observer.entities(),
        )
    )


def filled(engine: Engine, frames: StepReplies, level: ObservationLevel) -> tuple[bytes, Clock]:
    frame = frames.encode(level, engine.time, engine.step_count)
    wall: dict[str, Any] = msgspec.msgpack.decode(frame)["wall_time"]
    return frame, Clock(sec=int(wall["sec"]), nsec=int(wall["nsec"]))


@pytest.mark.parametrize("level", ObservationLevel)
def test_every_level_is_the_reply_as_it_is_encoded(
    engine: Engine, frames: StepReplies, level: ObservationLevel
) -> None:
    for _ in range(3):
        engine.step(Step(n_steps=5), lambda _: None)
        frame, wall_time = filled(engine, frames, level)
        assert frame == encoded(engine, level, wall_time)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(
    level=st.sampled_from(ObservationLevel),
    state=arrays(np.float64, 8, elements=st.floats(allow_subnormal=True)),
    time=st.floats(allow_infinity=False, allow_nan=False),
    step=st.integers(0, 2**40),
    twist=st.tuples(st.floats(width=32), st.floats(width=32), st.floats(width=32), st.integers(0, 1023)),
)
def test_whatever_the_numbers_are(
    engine: Engine,
    frames: StepReplies,
    level: ObservationLevel,
    state: np.ndarray[Any, np.dtype[np.float64]],
    time: float,
    step: int,
    twist: tuple[float, float, float, int],
) -> None:
    with engine.lock:
        data = engine.scene.data
        shown = (data.qpos, data.qvel, data.ctrl, data.act, data.sensordata, data.actuator_force, data.xpos, data.xquat)
        for array in shown:
            array.flat = state
        data.time = time
        engine.step_count = step
        mine = engine.articulations.control("bot").twist
        mine.vx, mine.vy, mine.yaw_rate, mine.actions = twist
        frame, wall_time = filled(engine, frames, level)
        assert frame == encoded(engine, level, wall_time)


def test_a_number_that_looks_like_a_mark_stays_a_number(engine: Engine, frames: StepReplies) -> None:
    with engine.lock:
        engine.scene.data.qpos[:] = 2.0**52 + np.arange(engine.scene.model.nq)
        for level in ObservationLevel:
            fresh = StepReplies(engine.scene, engine.articulations.controls)
            for taken in (frames, fresh):
                frame, wall_time = filled(engine, taken, level)
                assert frame == encoded(engine, level, wall_time)
