"""Set-points, controllers and twists, on real models but without an engine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import BOT, make_scene

from urlab_client.enums import ControllerKind
from urlab_client.server.physics.controllers import ArticulationControl, ControlSource, SetPoints, Twist
from urlab_client.simulation.controller_config import ControllerConfig
from urlab_client.simulation.controllers import PassthroughController, PDController

MIXED = """
<mujoco>
  <worldbody>
    <body name="base">
      <joint name="slide" type="slide" axis="1 0 0" range="-0.2 0.2" limited="true"/>
      <geom size="0.1"/>
      <site name="tip"/>
      <body name="wrist" pos="0 0 0.3">
        <joint name="ball" type="ball"/>
        <geom size="0.1"/>
        <body name="hand" pos="0 0 0.3">
          <joint name="hinge" axis="0 1 0"/>
          <geom size="0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="hinge" coef="1"/></fixed></tendon>
  <actuator>
    <motor name="by_tendon" tendon="t"/>
    <motor name="by_hinge" joint="hinge"/>
    <motor name="by_site" site="tip" gear="1 0 0 0 0 0"/>
    <motor name="by_ball" joint="ball" gear="0 0 1 0 0 0"/>
    <orientation name="attitude" joint="ball" kp="1" input="quat"/>
    <motor name="by_parent" jointinparent="slide"/>
  </actuator>
</mujoco>
"""

NUMBERS = st.floats(width=64)
GAINS = st.floats(-1e3, 1e3, width=32)


class Rig:
    """One articulation and the arrays a controller works on."""

    def __init__(self, xml: str, config: ControllerConfig | None = None) -> None:
        scene = make_scene(bot=xml)
        self.model, self.data = scene.model, scene.data
        mujoco.mj_resetData(self.model, self.data)
        self.control = ArticulationControl(self.model, scene.articulations[0], self.data.ctrl.copy(), config)
        self.points = self.control.set_points

    def ctrl(self, *, raw: bool = False) -> list[float]:
        self.control.apply(self.data.qpos, self.data.qvel, self.data.ctrl, raw=raw)
        return self.data.ctrl.tolist()

    @property
    def controller(self) -> Any:
        return self.control.controller


@pytest.fixture
def pd() -> Rig:
    return Rig(BOT, ControllerConfig())


def f32(value: float) -> float:
    return float(np.float32(value))


def test_a_raw_set_point_reaches_ctrl_rounded_to_single_precision() -> None:
    rig = Rig(BOT)
    rig.points.stage([0.7])
    assert rig.ctrl() == [0.699999988079071]


def test_set_points_reach_controls_that_do_not_follow_each_other() -> None:
    motors = "".join(f'<motor name="m{i}" joint="j"/>' for i in range(3))
    body = '<body><joint name="j"/><geom size="0.1"/></body>'
    scene = make_scene(bot=f"<mujoco><worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>")
    whole, ctrl = scene.articulations[0], scene.data.ctrl
    outer = replace(
        whole, actuators=whole.actuators[::2], actuator_names=whole.actuator_names[::2], ctrl_adr=whole.ctrl_adr[::2]
    )
    control = ArticulationControl(scene.model, outer, ctrl.copy())
    control.set_points.stage([1.0, 2.0])
    control.apply(scene.data.qpos, scene.data.qvel, ctrl)
    assert ctrl.tolist() == [1.0, 0.0, 2.0]


def test_set_points_are_not_clamped_to_ctrlrange() -> None:
    rig = Rig(BOT)
    rig.points.stage([5.0])
    assert rig.ctrl() == [5.0]


@given(st.lists(NUMBERS, max_size=6), st.lists(NUMBERS, max_size=6))
def test_positions_beyond_the_controls_are_ignored_and_missing_ones_keep_their_value(
    first: list[float], then: list[float]
) -> None:
    points = SetPoints(np.zeros(3), {})
    with np.errstate(over="ignore"):
        points.stage(first)
        points.stage(then)
        expected = np.array((then + first[len(then) :] + [0.0] * 3)[:3], dtype=np.float32)
    np.testing.assert_array_equal(points.network, expected)


@pytest.mark.mujoco("3.11")
@pytest.mark.parametrize("name", ["by_hinge", "bot_by_hinge", "BY_Hinge", "BOT_by_HINGE"])
def test_a_named_set_point_takes_short_and_compiled_names_in_any_case(name: str) -> None:
    rig = Rig(MIXED)
    before = rig.points.network.copy()
    rig.points.stage_named({name: 0.25, "unknown": 9.0})
    before[1] = 0.25
    np.testing.assert_array_equal(rig.points.network, before)


def test_names_that_differ_in_case_only_stay_apart() -> None:
    points = SetPoints(np.zeros(2), {"Arm": 0, "arm": 1})
    points.stage_named({"Arm": 1.0, "arm": 2.0})
    assert points.network.tolist() == [1.0, 2.0]


@pytest.mark.mujoco("3.11")
def test_set_points_begin_neutral_so_an_orientation_servo_holds_still() -> None:
    rig = Rig(MIXED)
    assert rig.ctrl() == [0, 0, 0, 0, 1, 0, 0, 0, 0]


def test_the_ui_source_hides_network_values_without_losing_them() -> None:
    rig = Rig(BOT)
    rig.points.stage([0.5])
    rig.points.source = ControlSource.UI
    assert rig.ctrl() == [0.0]
    rig.points.stage([0.75])
    assert rig.ctrl() == [0.0]
    rig.points.ui[0] = 0.125
    assert rig.ctrl() == [0.125]
    rig.points.source = ControlSource.ZMQ
    assert rig.ctrl() == [0.75]


@pytest.mark.mujoco("3.11")
def test_only_single_control_actuators_on_hinges_and_slides_are_bound() -> None:
    rig = Rig(MIXED, ControllerConfig())
    assert rig.controller.bound == ("by_hinge", "by_parent")


@pytest.mark.mujoco("3.11")
def test_actuators_that_are_not_bound_are_not_written() -> None:
    rig = Rig(MIXED, ControllerConfig(kind=ControllerKind.PASSTHROUGH))
    rig.data.ctrl[:] = 7.0
    rig.points.stage([1, 2, 3, 4, 5, 6, 7, 8, 9])
    assert rig.ctrl() == [7, 2, 7, 7, 7, 7, 7, 7, 9]
    assert rig.ctrl(raw=True) == [1, 2, 3, 4, 5, 6, 7, 8, 9]


def test_a_controller_that_bound_nothing_behaves_as_absent() -> None:
    by_site = BOT.replace('<motor name="m" joint="j"', '<motor name="m" site="tip" gear="1 0 0 0 0 0"')
    rig = Rig(by_site, ControllerConfig())
    rig.points.stage([0.5])
    assert rig.controller.bound == ()
    assert not rig.control.controlled()
    assert rig.ctrl() == [0.5]


def test_the_passthrough_controller_calls_itself_base_and_has_no_parameters() -> None:
    rig = Rig(BOT, ControllerConfig(kind=ControllerKind.PASSTHROUGH))
    assert isinstance(rig.controller, PassthroughController)
    assert rig.controller.kind == "base"
    rig.controller.configure({"kp": {"m": 1.0}})
    assert rig.controller.params() == {}
    assert rig.controller.schema() == {}


@pytest.mark.parametrize(
    ("target", "ranged", "expected"),
    [(0.1, False, 10.0), (5.0, False, 200.0), (-5.0, False, -200.0), (5.0, True, 20.0)],
)
def test_pd_at_rest_gives_gain_times_error_within_limit_and_range(target: float, ranged: bool, expected: float) -> None:
    xml = BOT.replace('name="j"', 'name="j" limited="true" range="-0.2 0.2"') if ranged else BOT
    rig = Rig(xml, ControllerConfig())
    rig.points.stage([target])
    assert rig.ctrl() == [expected]


def test_a_torque_limit_of_zero_means_no_torque(pd: Rig) -> None:
    pd.controller.configure({"torque_limit": {"m": 0}})
    pd.points.stage([0.1])
    assert pd.ctrl() == [0.0]


@given(
    target=st.floats(-1e6, 1e6),
    q=st.floats(-1e6, 1e6),
    v=st.floats(-1e6, 1e6),
    kp=GAINS,
    kv=GAINS,
    limit=st.floats(0, 1e6, width=32),
)
def test_pd_computes_in_single_precision(target: float, q: float, v: float, kp: float, kv: float, limit: float) -> None:
    rig = _PD
    rig.controller.configure({"kp": {"m": kp}, "kv": {"m": kv}, "torque_limit": {"m": limit}})
    rig.points.stage([target])
    rig.data.qpos[-1], rig.data.qvel[-1] = q, v
    one = np.float32
    u = one(kp) * (one(target) - one(q)) - one(kv) * one(v)
    assert rig.ctrl() == [float(min(max(u, -one(limit)), one(limit)))]


_PD = Rig(BOT, ControllerConfig())


@given(st.lists(st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0]), min_size=3, max_size=3))
def test_numbers_beyond_single_precision_follow_ieee_without_a_warning(values: list[float]) -> None:
    rig = _PD
    rig.controller.configure({"kp": {"m": 1e30}})
    with np.errstate(over="ignore"):  # as `stage_positional` does for all robots
        rig.points.stage(values[:1])
    rig.data.qpos[-1], rig.data.qvel[-1] = values[1:]
    rig.ctrl()


@pytest.mark.mujoco("3.11")
def test_pd_parameters_start_from_the_configuration() -> None:
    rig = Rig(MIXED, ControllerConfig(kp=0.1, kv=2.0, torque_limit=3.0))
    assert rig.controller.params() == {
        "kp": {"by_hinge": f32(0.1), "by_parent": f32(0.1)},
        "kv": {"by_hinge": 2.0, "by_parent": 2.0},
        "torque_limit": {"by_hinge": 3.0, "by_parent": 3.0},
        "default_kp": f32(0.1),
        "default_kv": 2.0,
        "default_torque_limit": 3.0,
    }


def test_pd_defaults_are_those_of_the_plugin(pd: Rig) -> None:
    assert pd.controller.kind == "pd"
    assert list(pd.controller.params().items()) == [
        ("kp", {"m": 100.0}),
        ("kv", {"m": 5.0}),
        ("torque_limit", {"m": 200.0}),
        ("default_kp", 100.0),
        ("default_kv", 5.0),
        ("default_torque_limit", 200.0),
    ]


def test_the_schema_describes_the_six_parameters(pd: Rig) -> None:
    schema = pd.controller.schema()
    assert list(schema) == list(pd.controller.params())
    assert schema["kv"] == {"type": "per_joint", "dtype": "float32", "min": 0.0}
    assert schema["default_kv"] == {"type": "scalar", "dtype": "float32", "min": 0.0}


def test_changing_a_default_changes_no_actuator(pd: Rig) -> None:
    pd.controller.configure({"default_kp": 250})
    assert pd.controller.params()["default_kp"] == 250.0
    assert pd.controller.params()["kp"] == {"m": 100.0}


def test_configure_changes_what_it_names_and_ignores_what_it_cannot_use(pd: Rig) -> None:
    before = pd.controller.params()
    pd.controller.configure({"kp": {"m": 0.1, "nope": 1.0, 3: 1.0}, "kv": 4.0, "torque_limit": {"m": "9"}, "other": 1})
    assert pd.controller.params() == {**before, "kp": {"m": 0.10000000149011612}}


def test_configure_takes_negative_gains(pd: Rig) -> None:
    pd.controller.configure({"kp": {"m": -1.0}})
    assert pd.controller.params()["kp"] == {"m": -1.0}


def test_configure_switches_a_disabled_controller_on(pd: Rig) -> None:
    pd.controller.enabled = False
    pd.points.stage([0.25])
    assert pd.ctrl() == [0.25]
    pd.controller.configure({})
    assert pd.ctrl() == [25.0]


def test_raw_bypasses_the_controller_for_one_application(pd: Rig) -> None:
    pd.points.stage([0.25])
    assert pd.ctrl(raw=True) == [0.25]
    assert pd.ctrl() == [25.0]


def test_an_articulation_without_configuration_has_no_controller() -> None:
    assert Rig(BOT).controller is None
    assert isinstance(Rig(BOT, ControllerConfig()).controller, PDController)


@given(st.lists(st.floats(allow_nan=False), max_size=4), st.lists(st.floats(allow_nan=False), max_size=4))
def test_a_twist_keeps_planar_velocity_and_yaw_rate_rounded_and_unlimited(
    linear: list[float], angular: list[float]
) -> None:
    twist = Twist(vx=1.0, vy=2.0, yaw_rate=3.0, actions=5)
    twist.set(linear, angular)
    padded = [*linear, 0.0, 0.0][:2], [*angular, 0.0, 0.0, 0.0][2]
    with np.errstate(over="ignore"):
        assert twist.linear == (f32(padded[0][0]), f32(padded[0][1]), 0.0)
        assert twist.angular == (0.0, 0.0, f32(padded[1]))
    assert twist.actions == 5
