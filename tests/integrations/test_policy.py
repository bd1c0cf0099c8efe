"""Policies: what declarations are refused, what a network sees and does, and what a policy refuses to drive."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from waiting import until

from urlab_client import URLabClient, URLabError, aio
from urlab_client._installation import install_command
from urlab_client.enums import StepMode
from urlab_client.integrations import policy as policies
from urlab_client.integrations.policy import (
    Policy,
    PolicyFileError,
    PolicyMismatch,
    RobotState,
    parse_spec,
    require,
    run,
    run_blocking,
)
from urlab_client.server import ControllerConfig, Drop, Faults, SimulatedServer

PD = {"quadruped": ControllerConfig()}

WALK = """
robot = "quadruped"
step_modes = ["direct", "live"]
timestep = 0.002
decimation = 10

[[observation]]
term = "clock"
hz = 2.0

[[observation]]
term = "joint_position"
joints = ["RR_calf", "FL_hip"]

[action]
via = "controller"
joints = ["FL_thigh", "FR_thigh"]
scale = [0.5, 0.25]
offset = 0.1

[gains]
kp = 60
kv = [1.5, 2.5]
torque_limit = 30.0
"""

REACH = """
robot = "arm"
step_modes = ["direct"]
timestep = 0.002
decimation = 20

[[observation]]
term = "sensor"
sensor = "grip_position"

[action]
via = "actuators"
joints = ["elbow"]
"""


def walk(*changes: tuple[str, str]) -> str:
    """Return the declaration with some text replaced."""
    text = WALK
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def policy_of(text: str, outputs: Callable[[Any], Any] | None = None) -> Policy:
    """Return a policy whose outputs are zeros, or what a function says."""
    spec = parse_spec(text, "it.toml")
    return Policy(spec, outputs or (lambda _: np.zeros(len(spec.action.joints))), source="it.toml")


@pytest.fixture(scope="module")
def quadruped(serving: Callable[..., str]) -> Iterator[URLabClient]:
    with URLabClient(serving("quadruped", controllers=PD), step_mode="direct") as client:
        client.discover()
        yield client


@pytest.fixture(scope="module")
def arm(serving: Callable[..., str]) -> Iterator[URLabClient]:
    with URLabClient(serving("arm"), step_mode="direct") as client:
        client.discover()
        yield client


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "hz = 2.0",
            "hz = 2.0\nherz = 1",
            r"observation\[0\]: .*`herz`. Its keys are term, scale, offset, clip, input, hz",
        ),
        ("hz = 2.0", 'hz = "2"', r"observation\[0\].hz: Expected `float`, got `str`"),
        ("hz = 2.0", "", r"observation\[0\]: .*missing required field `hz`"),
        ('"clock"', '"clok"', r"observation\[0\].term: .*'clok'. Terms are .*gravity, .*clock"),
        ("[gains]", "[gain]", "unknown field `gain`. Its keys are robot, .*gains"),
        ("kp = 60\n", "", r"gains: .*missing required field `kp`. Its keys are kp, kv, torque_limit"),
        ("kp = 60", "kp = -1", "gains: kp must be 0 or more"),
        ("[1.5, 2.5]", "[1.0, 2.0, 3.0]", "gains.kv has 3 numbers; it takes one, or one for each of the action's 2"),
        ("[0.5, 0.25]", "[0.5]", "action: scale has 1 numbers"),
        ("[0.5, 0.25]", "nan", "action: scale contains NaN"),
        ("[0.5, 0.25]", "[]", "action: scale is empty"),
        ("decimation = 10", "decimation = 10.5", "decimation: Expected `int`, got `float`"),
        ("decimation = 10", "decimation = 0", "decimation: Expected `int` >= 1"),
        ('"direct", "live"', '"puppet"', "step_modes can contain 'direct' and 'live', not 'puppet'"),
        ('"direct", "live"', '"fast"', r"step_modes\[0\]: Invalid enum value 'fast'"),
        ('via = "controller"', 'via = "client"', "step_modes cannot contain 'live' with action.via = 'client'"),
        ('via = "controller"', 'via = "actuators"', "'actuators' does not use the table .gains."),
        ('via = "controller"', 'via = "controller"\nkind = "torque"', "kind = 'torque' requires via = 'actuators'"),
        ('"FL_thigh", "FR_thigh"', '"FL_thigh", "FL_thigh"', "joints contains a joint twice"),
        ("offset = 0.1", "clip = [1.0, -1.0]", r"clip must be \[low, high\]"),
        ("[gains]", '[[observation]]\nterm = "command"\n[gains]', r"need the table \[command\]"),
        (
            "[gains]",
            "[command]\ndefault=[1,0,0]\nlow=[0,0,0]\nhigh=[0.5,0,0]\n[gains]",
            "default .* between low and hi",
        ),
        ("[gains]", "[gains", "not TOML: .*line"),
        ("[gains]", "a = " + "[" * 100_000 + "\n[gains]", "not TOML: .*recursion"),
        ("[gains]", "a = " + "1" * 5000 + "\n[gains]", "not TOML: .*4300 digits"),
    ],
)
def test_a_declaration_that_cannot_work_is_refused_by_file_and_key(old: str, new: str, said: str) -> None:
    with pytest.raises(PolicyFileError, match=said) as caught:
        parse_spec(walk((old, new)), "walk.toml")
    assert str(caught.value).startswith("walk.toml: ")


@pytest.mark.parametrize("term", ["1", "[1]", "'gravity'", "{term = 1}", "{term = ['gravity']}", "{}"])
def test_terms_of_a_wrong_type_are_refused(term: str) -> None:
    text = f"observation = [{term}]\n" + WALK.replace("[[observation]]", "[[ignored]]")
    with pytest.raises(PolicyFileError, match=r"walk\.toml: "):
        parse_spec(text, "walk.toml")


def test_a_table_for_a_normaliser_gets_advice() -> None:
    with pytest.raises(PolicyFileError, match=r"unknown field `normalizer`.*`offset` and `scale` of each term"):
        parse_spec(WALK + "\n[normalizer]\nmean = [0.0]\n", "walk.toml")


def test_files_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(PolicyFileError, match=r"away.toml: cannot be read: No such file"):
        policies.load(tmp_path / "away.onnx")
    (tmp_path / "away.toml").write_text(WALK)
    with pytest.raises(PolicyFileError, match=r"away.onnx: no such file"):
        policies.load(tmp_path / "away.onnx")
    (tmp_path / "away.onnx").write_bytes(b"no network")
    with pytest.raises(PolicyFileError, match=r"away.onnx: not a network that ONNX Runtime can run"):
        policies.load(tmp_path / "away.onnx")


def test_the_extra_is_named_when_it_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "it.toml").write_text(WALK)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=re.escape(install_command("onnx"))):
        policies.load(tmp_path / "it.onnx")


def test_a_base_is_seen_as_mujoco_measures_it(quadruped: URLabClient) -> None:
    text = WALK.replace("hz = 2.0", "hz = 2.0\n" + "".join(f'[[observation]]\nterm = "{term}"\n' for term in (
        "base_height", "gravity", "linear_velocity", "angular_velocity", "joint_velocity")))  # fmt: skip
    robot = quadruped.articulations["quadruped"]
    mapping = policy_of(text).bind(robot)
    model, data = quadruped.model, mujoco.MjData(quadruped.model)
    rng = np.random.default_rng(3)
    data.qpos[:] = rng.normal(size=model.nq)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    state = RobotState(np.stack([data.qpos, data.qpos]), np.stack([data.qvel, data.qvel]))

    seen = mapping.observe(state, np.zeros((2, 3)), np.zeros((2, 2)), time=0.125)

    trunk = model.body("quadruped_trunk").id
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, trunk, velocity, 1)
    down = data.xmat[trunk].reshape(3, 3).T @ [0, 0, -1]
    thighs = [data.joint(f"quadruped_{leg}_thigh").qvel[0] for leg in ("FL", "FR")]
    joints = [data.joint(f"quadruped_{name}").qpos[0] for name in ("RR_calf", "FL_hip")]
    expected = [1.0, 0.0, data.qpos[2], *down, *velocity[3:], *velocity[:3], *thighs, *joints]
    assert seen.shape == (2, mapping.observation_size)
    for row in seen:
        np.testing.assert_allclose(row, expected, atol=1e-12)


def test_torques_are_those_of_the_pd_law_within_their_limit(quadruped: URLabClient) -> None:
    mapping = policy_of(WALK).bind(quadruped.articulations["quadruped"])
    model = quadruped.model
    assert model is not None
    state = RobotState(np.zeros((3, model.nq)), np.full((3, model.nv), 0.1))
    torques = mapping.torques(np.array([[0.2, -0.2], [9.0, 9.0], [-9.0, -9.0]]), state)
    at_rest = [60 * 0.2 - 1.5 * 0.1, 60 * -0.2 - 2.5 * 0.1]
    assert torques == pytest.approx(np.array([at_rest, [30.0, 30.0], [-30.0, -30.0]]))


def test_scales_clips_history_command_and_last_action_make_the_input(quadruped: URLabClient) -> None:
    text = WALK[: WALK.index("[[observation]]")] + (
        'history = 2\n[[observation]]\nterm = "command"\nscale = [2.0, 1.0, 1.0]\noffset = 0.1\nclip = [-0.5, 0.5]\n'
        '[[observation]]\nterm = "last_action"\n' + WALK[WALK.index("[action]") :]
    )
    text += "[command]\ndefault = [0.2, 0.0, 0.0]\nlow = [0.0, 0.0, -1.0]\nhigh = [1.0, 0.0, 1.0]\n"
    inputs: list[list[float]] = []

    def outputs(observation: Any) -> Any:
        inputs.append(np.round(observation, 9).tolist())
        return np.array([5.0, -0.5])

    policy, robot = policy_of(text, outputs), quadruped.articulations["quadruped"]
    quadruped.reset()
    policy.act(robot)
    policy.command = [0.25, 0.0, -1.0]
    policy.act(robot)
    first, second = [0.2, -0.1, -0.1, 0.0, 0.0], [0.3, -0.1, -0.5, 1.0, -0.5]
    assert inputs == [first + first, first + second]
    assert policy.action.tolist() == [1.0, -0.5]  # clipped
    thighs = {name: robot.actuators[name].value for name in ("FL_thigh", "FR_thigh")}
    assert thighs == {"FL_thigh": 0.1 + 0.5 * 1.0, "FR_thigh": 0.1 - 0.25 * 0.5}
    policy.reset()
    assert policy.action.tolist() == [0.0, 0.0]
    policy.command = [0.2, 0.0, 0.0]
    policy.act(robot)
    assert inputs[-1] == first + first, "nothing of the episode before"
    for wrong in ([2.0, 0.0, 0.0], [0.1], [np.nan, 0.0, 0.0]):
        with pytest.raises(ValueError, match=r"from \[0.0, 0.0, -1.0\] to \[1.0, 0.0, 1.0\]"):
            policy.command = wrong
    with pytest.raises(ValueError, match="takes no command"):
        policy_of(WALK).command = [0.0, 0.0, 0.0]


def test_gains_last_as_long_as_the_run(quadruped: URLabClient) -> None:
    controller = quadruped.articulations["quadruped"].controller
    before = {name: dict(values) for name, values in controller.params.items() if isinstance(values, dict)}
    during: list[tuple[float, float]] = []

    found = run_blocking(
        quadruped,
        policy_of(WALK),
        seconds=0.1,
        on_action=lambda _: during.append((controller.kp["FL_thigh"], controller.kv["FR_thigh"])),
    )
    assert during == [(60.0, 2.5)] * 5
    assert (found.actions, found.steps, found.step_mode) == (5, 50, "direct")
    assert found.sim_time == pytest.approx(0.1)
    assert {name: dict(controller.params[name]) for name in before} == before


def test_stepping_by_hand_is_the_same(quadruped: URLabClient) -> None:
    robot = quadruped.articulations["quadruped"]
    ends: list[list[float]] = []
    policy = policy_of(WALK, lambda seen: seen[:2])
    run_blocking(quadruped, policy, seconds=0.4)
    ends.append(robot.qpos_array.tolist())

    before = {name: dict(values) for name, values in robot.controller.params.items() if isinstance(values, dict)}
    robot.controller.set_gains(**policy.bind(robot).gains())
    robot.ctrl_array[:] = 0.0
    quadruped.reset()
    policy.reset()
    for _ in range(20):
        policy.act(robot)
        quadruped.step(policy.spec.decimation)
    ends.append(robot.qpos_array.tolist())
    robot.controller.set_gains(**before)
    assert ends[0] == ends[1]
    assert ends[0][0] != 0.0


def test_a_clients_own_pd_law_moves_a_robot_as_the_servers_does(
    quadruped: URLabClient, serving: Callable[..., str]
) -> None:
    wave = [np.array([np.sin(n), np.cos(2 * n)]) for n in range(20)]
    ends = []
    with URLabClient(serving("quadruped"), step_mode="direct") as bare:
        bare.discover()
        for client, text in (
            (quadruped, WALK),
            (bare, walk(('via = "controller"', 'via = "client"'), ('"direct", "live"', '"direct"'))),
        ):
            waves = iter(wave)
            policy = policy_of(text, lambda _, waves=waves: next(waves))
            # Only the thighs' gains are declared; without any on the other joints the robots fold alike.
            if client is quadruped:
                client.articulations["quadruped"].controller.set_defaults(kp=0, kv=0)
            run_blocking(client, policy, seconds=0.1)
            ends.append(client.articulations["quadruped"].qpos_array.copy())
    quadruped.articulations["quadruped"].controller.set_defaults(kp=100, kv=5)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-5)  # the server computes in single precision
    assert abs(ends[0][8]) > 0.05


def test_a_robot_is_bound_once_and_held_only_after_an_action(
    quadruped: URLabClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, robot = policy_of(walk()), quadruped.articulations["quadruped"]
    with pytest.raises(PolicyMismatch, match=r"'quadruped' has had no action yet.*Call act"):
        policy.hold(robot)
    bound: list[Any] = []
    bind = policy.bind
    monkeypatch.setattr(policy, "bind", lambda robot: bound.append(robot) or bind(robot))
    for _ in range(3):
        policy.act(robot)
    assert bound == [robot]
    assert repr(policy).endswith("for 'quadruped'>")


def test_position_servos_take_targets_as_they_are(arm: URLabClient) -> None:
    heights: list[float] = []

    def lower(observation: Any) -> Any:
        heights.append(float(observation[2]))
        return np.array([0.5])

    found = run_blocking(arm, policy_of(REACH, lower), seconds=1.0)
    assert found.actions == 25
    assert arm.articulations["arm"].get_qpos()["elbow"] == pytest.approx(0.5, abs=0.02)
    assert heights[-1] < heights[0] - 0.1
    assert (found.distance, found.falls, found.reward) == (0.0, 0, 0.0)


GOAL = """
[[observation]]
term = "goal"

[[observation]]
term = "goal"
relative_to = "grip_position"

[goal]
default = [0.3, 0.0, 0.5]
low = [0.0, -1.0, 0.0]
high = [1.0, 1.0, 1.0]

[action]"""


def test_a_goal_and_the_way_to_it_are_observed_and_what_is_left_is_told(arm: URLabClient) -> None:
    seen: list[Any] = []

    def network(observation: Any) -> Any:
        seen.append(observation)
        return np.zeros(1)

    policy = policy_of(REACH.replace("[action]", GOAL), network)
    assert policy.goal.tolist() == [0.3, 0.0, 0.5]
    policy.goal = [0.4, 0.2, 0.3]
    found = run_blocking(arm, policy, seconds=0.04)
    hand, goal, way = np.split(seen[0], 3)
    assert goal.tolist() == [0.4, 0.2, 0.3]
    assert way == pytest.approx(goal - hand)
    assert found.goal_error == pytest.approx(np.linalg.norm(way), abs=1e-3)
    assert run_blocking(arm, policy_of(REACH), seconds=0.04).goal_error is None
    for bad in ([0.4, 0.2], [0.4, 0.2, 3.0], [0.4, 0.2, float("nan")]):
        with pytest.raises(ValueError, match=r"a goal must be from \[0.0, -1.0, 0.0\] to \[1.0, 1.0, 1.0\]"):
            policy.goal = bad
    with pytest.raises(ValueError, match=r"it\.toml takes no goal"):
        policy_of(REACH).goal = [0.0]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("high = [1.0, 1.0, 1.0]", "high = [1.0, 1.0]", "default, low and high must have the same length"),
        ("high = [1.0, 1.0, 1.0]", "high = [0.2, 1.0, 1.0]", "default .* is not between low and high"),
        (GOAL.partition("[goal]")[2], "\n[action]", "missing required field `default`"),
        ('relative_to = "grip_position"', 'relative_to = "grip_orientation"', "has 4 numbers, the goal 3"),
        ('relative_to = "grip_position"', 'relative_to = "nose"', r"observation\[2\].relative_to: .*no sensor 'nose'"),
    ],
)
def test_a_goal_that_cannot_work_is_refused(old: str, new: str, said: str, arm: URLabClient) -> None:
    with pytest.raises((PolicyFileError, PolicyMismatch), match=said):
        policy_of(REACH.replace("[action]", GOAL).replace(old, new)).bind(arm.articulations["arm"])


def test_the_term_needs_a_goal() -> None:
    with pytest.raises(PolicyFileError, match=r"the term 'goal' needs the table \[goal\]"):
        policy_of(REACH.replace("[action]", '[[observation]]\nterm = "goal"\n[action]'))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (WALK.replace('"quadruped"', '"dog"'), r"no articulation is called 'dog'; the articulations are: quadruped"),
        (walk(('"direct", "live"', '"live"')), r"in 'direct' mode; step_modes requires 'live'.*step_mode='live'"),
        (walk(("0.002", "0.005")), r"timestep of 0.002 s; timestep requires 0.005 s.*set_sim_options\(timestep=0.005"),
        (walk(('"FR_thigh"', '"XX_thigh"')), r"action.joints\[1\]: .*no joint 'XX_thigh'; it has .*FR_thigh"),
        (walk(('"FR_thigh"', '"root"')), r"action.joints\[1\]: 'root' is neither a hinge nor a slide"),
        (walk(('"RR_calf"', '"calf"')), r"observation\[1\].joints\[0\]: .*no joint 'calf'"),
        (walk(("hz = 2.0", "hz = 2.0\nscale = [1.0, 2.0, 3.0]")), r"observation\[0\].scale: has 3 .*one, or 2"),
        (
            walk(("[action]", '[[observation]]\nterm = "sensor"\nsensor = "nose"\n[action]')),
            r"observation\[2\].sensor: .*no sensor 'nose'; it has imu_accelerometer",
        ),
        (
            walk(('via = "controller"', 'via = "client"'), ('"direct", "live"', '"direct"')),
            r"has an active controller; action.via = 'client' requires .*control_mode = 'raw'",
        ),
    ],
)
def test_a_policy_refuses_what_it_was_not_made_for(text: str, said: str, quadruped: URLabClient) -> None:
    with pytest.raises(PolicyMismatch, match=said):
        run_blocking(quadruped, policy_of(text))


def test_a_policy_refuses_a_robot_without_its_controller_or_actuators(arm: URLabClient, quadruped: URLabClient) -> None:
    with pytest.raises(PolicyMismatch, match=r"no controller; .* requires a PD controller.*--controller arm=pd"):
        run_blocking(arm, policy_of(REACH.replace("actuators", "controller") + "[gains]\nkp=1\nkv=1\ntorque_limit=1"))
    with pytest.raises(
        PolicyMismatch, match=r"'elbow' of 'arm' is a position; .*'torque' via 'actuators' requires a m"
    ):
        run_blocking(arm, policy_of(REACH.replace('via = "actuators"', 'via = "actuators"\nkind = "torque"')))
    with pytest.raises(PolicyMismatch, match=r"fall: needs a free base; 'arm' has none"):
        run_blocking(arm, policy_of(REACH + "[fall]\nheight = 0.1"))
    with pytest.raises(PolicyMismatch, match=r"observation\[0\]: needs a free base"):
        run_blocking(arm, policy_of(REACH.replace('term = "sensor"\nsensor = "grip_position"', 'term = "gravity"')))
    with pytest.raises(PolicyMismatch, match="0 actuators of 'arm' drive 'left_finger'"):
        run_blocking(arm, policy_of(REACH.replace('"elbow"', '"left_finger"')))
    robot = quadruped.articulations["quadruped"]
    robot.control_mode = "raw"
    try:
        with pytest.raises(PolicyMismatch, match=r"bypassed.*control_mode = 'ue_controller'"):
            run_blocking(quadruped, policy_of(WALK))
    finally:
        robot.control_mode = "ue_controller"


@pytest.mark.parametrize(
    ("outputs", "said"),
    [(np.zeros(3), "returned 3 numbers, but it.toml declares 2"), (np.array([np.nan, 0.0]), "returned NaN")],
)
def test_outputs_that_cannot_be_used_stop_the_run(outputs: Any, said: str, quadruped: URLabClient) -> None:
    before = quadruped.articulations["quadruped"].controller.kp["FL_thigh"]
    with pytest.raises(PolicyFileError, match=said):
        run_blocking(quadruped, policy_of(WALK, lambda _: outputs))
    assert quadruped.articulations["quadruped"].controller.kp["FL_thigh"] == before


def test_a_fall_is_counted_and_the_robot_starts_again(quadruped: URLabClient) -> None:
    text = (
        walk(("scale = [0.5, 0.25]", "scale = 1.0"), ("offset = 0.1", "")) + "[fall]\nupright = 0.99\nheight = 0.25\n"
    )
    attempts: list[int] = []
    policy = policy_of(text, lambda _: np.array([1.0, 1.0]))
    found = run_blocking(quadruped, policy, seconds=2.0, on_action=lambda so_far: attempts.append(so_far.falls))
    assert found.falls >= 2
    falls = np.flatnonzero(np.diff([*attempts, found.falls]))
    assert np.diff(falls).min() > 2, "one that lies has fallen with each action"
    assert found.upright_time == pytest.approx(0.02 * (attempts.count(0)))
    assert found.sim_time == pytest.approx(2.0)


@pytest.mark.long
async def test_in_live_mode_actions_keep_the_pace_of_the_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    times: list[float] = []
    async with aio.URLabClient("sim://quadruped?controller=quadruped=pd", step_mode="live") as client:
        await client.discover()
        assert require(client, policy_of(WALK)) is client.articulations["quadruped"]
        policy = policy_of(WALK, lambda _: np.array([0.8, 0.8]))
        found = await run(client, policy, seconds=0.5, on_action=lambda so_far: times.append(so_far.sim_time))
        assert found.step_mode == "live"
        assert found.sim_time >= 0.49
        assert all(time > 0.02 * n - 1e-9 for n, time in enumerate(times, 1)), "an action before its period"
        robot = client.articulations["quadruped"]
        await until(lambda: abs(robot.get_qpos()["FL_thigh"] - 0.5) < 0.15)  # physics goes on with the last action

        monkeypatch.setattr("urlab_client.integrations.policy.runner._STANDSTILL_S", 2.0)
        tasks: list[asyncio.Task[Any]] = []
        loop = asyncio.get_running_loop()

        def pause(_: Any) -> None:
            if not tasks:
                tasks.append(loop.create_task(client.runtime.set_paused(True)))

        with pytest.raises(URLabError, match="Physics stands still"):
            await run(client, policy, seconds=60.0, on_action=pause)
        await tasks[0]


async def test_a_live_policy_says_that_somebody_reset_the_simulation() -> None:
    with SimulatedServer("quadruped", play=True, controllers=PD) as server:
        async with aio.URLabClient(**server.client_options(), step_mode="live") as client:
            await client.discover()
            await client.runtime.set_paused(False)
            resets: list[asyncio.Task[Any]] = []

            def reset(so_far: Any) -> None:
                if so_far.sim_time > 0.5 and not resets:
                    resets.append(asyncio.create_task(client.reset()))

            with pytest.raises(URLabError, match=r"clock went back from 0\.\d+ s to 0\.\d+ s: somebody else reset"):
                await run(client, policy_of(WALK), seconds=60.0, on_action=reset)
            await resets[0]


async def test_a_policy_whose_gains_were_not_acknowledged_puts_back_those_of_before() -> None:
    faults = Faults()
    with SimulatedServer("quadruped", play=True, controllers=PD, faults=faults) as server:
        async with aio.URLabClient(**server.client_options(), step_mode="direct") as client:
            await client.discover()
            controller = client.articulations["quadruped"].controller
            before = dict(controller.params)
            lost = faults.add(Drop("configure_controller", times=1))
            running = asyncio.create_task(run(client, policy_of(WALK)))
            await until(lambda: lost.applied)
            running.cancel()
            with pytest.raises(asyncio.CancelledError):
                await running
            assert await controller.refresh() == before


class Overslept:
    """A client whose simulation is always a few physics steps further than its program waited for."""

    step_mode = StepMode.LIVE
    LATE = 3

    def __init__(self, client: aio.URLabClient) -> None:
        self._client = client
        self.runtime = SimpleNamespace(set_paused=self._unpause)
        self.waits = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    async def step(self, *, include_cameras: object = False) -> None:
        """What sends set-points takes no time; then the simulation runs until the program wakes up."""
        if self.waits:
            due = np.ceil((self.sleeps - 1e-9) / 0.002)
            await self._client.step(int(due) + self.LATE)
        self.waits = False

    async def sleep(self, seconds: float) -> None:
        self.waits, self.sleeps = True, seconds

    async def _unpause(self, paused: bool) -> None:
        assert not paused


async def test_a_live_policy_that_wakes_late_keeps_its_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    with SimulatedServer("quadruped", play=True, controllers={"quadruped": ControllerConfig()}) as server:
        async with aio.URLabClient(**server.client_options(), step_mode="direct") as client:
            await client.discover()
            late = Overslept(client)
            monkeypatch.setattr(
                "urlab_client.integrations.policy.runner.asyncio",
                SimpleNamespace(sleep=late.sleep, get_running_loop=asyncio.get_running_loop),
            )
            found = await run(late, policy_of(WALK, lambda _: np.zeros(2)), seconds=1.0)
    assert found.actions == 50, "one each 20 ms, as if each had come in time"
    assert found.late == 0


@pytest.mark.parametrize("dialect", ["alpha", "beta"])
def test_a_general_actuator_with_an_affine_bias_is_a_servo(dialect: str, tmp_path: Path) -> None:
    """What `MjSpec.to_xml()` makes of servos, and what the plugins call `motor` and `general`: Beta statement 6."""
    body = '<body><joint name="{0}"/><geom size="0.1"/></body>'
    joints = "".join(body.format(name) for name in ("hip", "knee", "wheel"))
    written = mujoco.MjSpec.from_string(
        f"<mujoco><worldbody>{joints}</worldbody><actuator>"
        '<position name="hip" joint="hip" kp="30" kv="2"/><position name="knee" joint="knee" kp="20" timeconst="0.1"/>'
        '<general name="wheel" joint="wheel" gainprm="3"/></actuator></mujoco>'
    )
    written.compile()
    model = tmp_path / "leg.xml"
    model.write_text(written.to_xml(), encoding="utf-8")
    torques = 'robot = "leg"\nstep_modes = ["direct"]\ntimestep = 0.002\ndecimation = 1\n'
    torques += (
        '[[observation]]\nterm = "clock"\nhz = 1.0\n[action]\nvia = "actuators"\nkind = "torque"\njoints = ["{}"]'
    )
    with (
        SimulatedServer(str(model), play=True, model_roots=[tmp_path], dialect=dialect) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        leg = client.articulations["leg"].actuators
        assert [str(leg[name].type) for name in ("hip", "knee", "wheel")] == ["position", "position", "motor"]
        assert (leg["hip"].kp, leg["hip"].kv) == (30.0, 2.0)
        require(client, policy_of(torques.format("wheel")))
        with pytest.raises(PolicyMismatch, match=r"'hip' of 'leg' is a position; .* requires a motor"):
            require(client, policy_of(torques.format("hip")))
