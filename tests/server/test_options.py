"""`set_sim_options` as raw bytes; numbers are those of the checklist of observable behaviours."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mujoco
import pytest
from wire import Wire, float32

NAMES = [
    "timestep",
    "num_worker_threads",
    "max_worker_threads",
    "gravity",
    "wind",
    "magnetic",
    "density",
    "viscosity",
    "impratio",
    "tolerance",
    "iterations",
    "ls_iterations",
    "integrator",
    "cone",
    "solver",
    "noslip_iterations",
    "noslip_tolerance",
    "ccd_iterations",
    "ccd_tolerance",
    "enable_multiccd",
    "enable_sleep",
    "sleep_tolerance",
    "disableflags",
    "enableflags",
]


@pytest.fixture
def ball(serve: Callable[..., Wire]) -> Wire:
    wire = serve("ball", play=True)
    wire.ask("set_mode", mode="direct")
    return wire


def options(wire: Wire, **fields: Any) -> dict[str, Any]:
    return wire.ask("set_sim_options", options=fields)["options"]


def test_the_echo_has_all_fields(ball: Wire) -> None:
    assert sorted(options(ball)) == sorted(NAMES)


def test_092_timestep(ball: Wire) -> None:
    assert options(ball, timestep=0.005)["timestep"] == 0.004999999888241291
    assert ball.ask("step")["time"] == 0.004999999888241291


def test_093_gravity(ball: Wire) -> None:
    assert options(ball, gravity=[0, 0, -1.62])["gravity"] == pytest.approx((0, 0, -1.62), abs=1e-6)
    (state,) = ball.ask("step")["per_articulation"].values()
    assert state["qvel"][2] == pytest.approx(-1.62 * 0.002, rel=1e-3)


def test_094_refusals_remember_what_came_before(ball: Wire) -> None:
    assert ball.refused("set_sim_options") == "missing_field"
    assert ball.refused("set_sim_options", options={"timestep": 0.01, "integrator": "foo", "cone": "elliptic"})
    assert ball.ask("step")["time"] == pytest.approx(0.002)
    echo = options(ball)
    assert echo["timestep"] == float32(0.01)
    assert echo["cone"] == "pyramidal"


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("timestep", [0, -1, math.nan, math.inf, 1e-50]),  # the last is 0 as the float32 that it is kept as
        ("impratio", [0, math.nan]),
        ("density", [-1, math.inf, 1e39]),
        ("viscosity", [-1]),
        ("tolerance", [-1e-9, math.nan]),
        ("noslip_tolerance", [-1]),
        ("ccd_tolerance", [math.inf]),
        ("sleep_tolerance", [math.nan]),
        ("gravity", [[0, 0, math.nan], [math.inf, 0, 0]]),
        ("wind", [[0, -math.inf, 0]]),
        ("magnetic", [[0, 0, math.nan]]),
        *((name, [-1, 10_001, 2**31 - 1]) for name in ("iterations", "ls_iterations")),
        *((name, [-1, 10_001, 2**31 - 1]) for name in ("noslip_iterations", "ccd_iterations")),
    ],
)
def test_numbers_that_no_simulation_survives_are_refused_and_change_nothing(
    ball: Wire, name: str, values: list[Any]
) -> None:
    before = options(ball)
    for value in values:
        code, message = ball.refusal("set_sim_options", options={"viscosity": 0.5, name: value, "cone": "elliptic"})
        assert code == "bad_value"
        assert name in message
    assert options(ball) == before
    assert ball.ask("step")["time"] == pytest.approx(0.002)


def test_what_is_at_the_edge_is_taken(ball: Wire) -> None:
    assert options(ball, iterations=10_000, tolerance=0)["iterations"] == 10_000
    assert options(ball, ccd_iterations=0)["ccd_iterations"] == 0


def test_095_raw_masks_stay_raw(ball: Wire) -> None:
    gravity = int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    assert options(ball, disableflags=gravity)["disableflags"] == gravity
    (state,) = ball.ask("step", n_steps=5)["per_articulation"].values()
    assert state["qvel"][2] == 0.0


@pytest.mark.mujoco("3.10")
def test_096_worker_threads(ball: Wire) -> None:
    assert options(ball, num_worker_threads=-5)["num_worker_threads"] == 0
    echo = options(ball, num_worker_threads=100000)
    assert echo["num_worker_threads"] == echo["max_worker_threads"] > 0
    ball.ask("step", n_steps=5)
    assert options(ball, num_worker_threads=0)["num_worker_threads"] == 0


@pytest.mark.mujoco("3.10")
@pytest.mark.parametrize(("told", "most"), [(3, 3), (None, 1)])
def test_there_are_as_many_threads_as_processors(
    ball: Wire, told: int | None, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: told)
    assert options(ball)["max_worker_threads"] == most


def test_switches_move_the_flags_they_are_named_after(ball: Wire) -> None:
    echo = options(ball, enable_multiccd=False, enable_sleep=True)
    assert int(echo["disableflags"]) & mujoco.mjtDisableBit.mjDSBL_MULTICCD
    assert int(echo["enableflags"]) & mujoco.mjtEnableBit.mjENBL_SLEEP
    assert echo["sleep_tolerance"] == float32(1e-4)
    assert options(ball, disableflags=0, enableflags=0)["enable_sleep"] is True
    ball.ask("step", n_steps=5)


def test_wrong_shapes_are_ignored_and_choices_take_any_case(ball: Wire) -> None:
    before = options(ball)
    assert options(ball, gravity=[1], timestep="x", iterations=[3]) == before
    assert options(ball, integrator="RK4", solver="cG")["solver"] == "cg"
