"""Actions, delays and what a task keeps of each environment: the same in single environments, servers and batches."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeLimit

from urlab_client.errors import ModeLocked, UnknownKeyframe
from urlab_client.integrations.gym import (
    Actions,
    EpisodeEnd,
    Start,
    States,
    Task,
    URLabBatchEnv,
    URLabEnv,
    URLabVectorEnv,
    Walk,
)
from urlab_client.randomise.declaration import Delay, Push, Randomisation, Vary
from urlab_client.server import ControllerConfig, SimulatedServer

LEVER = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 1"/>
    <body name="lever" pos="0 0 0.5">
      <joint name="hinge" axis="0 1 0" damping="0.1" range="-60 60" limited="true"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.1"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="4" dampratio="1" ctrlrange="-1 1"/></actuator>
  <keyframe><key name="raised" qpos="0.5" ctrl="0.4375"/></keyframe>
</mujoco>
"""


@pytest.fixture(scope="module", params=["alpha", "beta"])
def levers(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[str]]:
    """Addresses of two servers with a lever whose keyframe has a set-point of its own."""
    model = tmp_path_factory.mktemp("lever") / "lever.xml"
    model.write_text(LEVER)
    options: Any = {"play": True, "step_mode": "direct", "dialect": request.param}
    with SimulatedServer(model, **options) as one, SimulatedServer(model, **options) as two:
        yield [f"{server.address}:{server.step_port}" for server in (one, two)]


class Hold(Task):
    """The lever follows its action, which is a change from the keyframe, and counts its actions above zero."""

    actions: ClassVar[Any] = Actions(scale=0.25, offset="raised")
    memory: ClassVar[Mapping[str, tuple[int, ...]]] = {"up": (), "recent": (2, 1)}
    keyframe: ClassVar[str | None] = "raised"
    n_observed: ClassVar[int] = 5
    n_substeps: ClassVar[int] = 5
    max_episode_steps: ClassVar[int | None] = 4

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        start.joint("lever/hinge", 0.5 + rng.uniform(-0.1, 0.1))
        start.memory["up"][...] = 10.0 * start.index

    def update(self, states: States) -> None:
        states.memory["up"][:] += states.last_action[:, 0] > 0
        states.memory["recent"][:, 1] = states.memory["recent"][:, 0]
        states.memory["recent"][:, 0] = states.last_action

    def observe(self, states: States) -> Any:
        kept = states.memory
        return np.column_stack(
            [states.index, kept["up"], kept["recent"][..., 0], states.previous_action[:, 0] - states.last_action[:, 0]]
        )

    def reward(self, states: States, actions: Any) -> Any:
        return states.memory["up"] - 0.1 * np.sum((states.last_action - states.previous_action) ** 2, axis=1)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("delay", [None, Delay(action=1, action_substeps=(2, 9))])
def test_what_a_task_keeps_is_the_same_on_servers_and_in_a_batch_and_reset_with_its_environment(
    levers: list[str], made: list[Any], mode: AutoresetMode, delay: Delay | None
) -> None:
    options: Any = {"autoreset_mode": mode}
    if delay is not None:
        options["randomise"] = Randomisation(delay=delay)
    batch, wire = URLabBatchEnv(levers[0], 2, task=Hold(), **options), URLabVectorEnv(levers, task=Hold(), **options)
    made += [wire, batch]
    assert (batch.action_space.low.min(), batch.action_space.high.max()) == (-1.0, 1.0)
    rng = np.random.default_rng(3)
    ours, theirs = (env.reset(seed=5)[0] for env in (wire, batch))
    assert np.array_equal(ours, theirs)
    assert theirs[:, -5:].tolist() == [[0, 0, 0, 0, 0], [1, 10, 0, 0, 0]]
    up, earlier = np.array([0.0, 10.0]), np.zeros(2)
    for step in range(1, 10):
        actions = rng.uniform(-1, 1, (2, 1)).astype(np.float32)
        ours, theirs = wire.step(actions), batch.step(actions)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            assert np.array_equal(a, b)
        over = step % (5 if mode is AutoresetMode.NEXT_STEP else 4) == 0
        if over and mode is AutoresetMode.NEXT_STEP:
            assert not theirs[1].any(), "a reset earns nothing"
        up = np.array([0.0, 10.0]) if over else up + (actions[:, 0] > 0)
        assert theirs[0][:, -4].tolist() == up.tolist()
        chosen = np.zeros(2) if over else actions[:, 0].astype(np.float64)
        assert theirs[0][:, -3].tolist() == chosen.tolist()
        assert theirs[0][:, -1].tolist() == (0.0 * chosen if over else earlier - chosen).tolist()
        earlier = chosen
    wire.close()
    single = URLabEnv.connect(levers[0], task=Hold(), **{k: v for k, v in options.items() if k == "randomise"})
    made.append(single)
    alone, _ = single.reset(seed=5)
    again, _ = batch.reset(seed=5)
    assert np.array_equal(alone, again[0])
    for _ in range(4):
        action = rng.uniform(-1, 1, 1).astype(np.float32)
        alone, reward, *_ = single.step(action)
        theirs = batch.step(np.stack([action, action]))
    assert reward == theirs[1][0]
    if mode is AutoresetMode.NEXT_STEP:
        assert np.array_equal(alone, theirs[0][0])


@pytest.mark.parametrize("late", [Delay(action=2), Delay(action=1, action_substeps=3), Delay(action_substeps=7)])
def test_before_a_delayed_action_takes_effect_the_keyframe_is_held(
    levers: list[str], made: list[Any], late: Delay
) -> None:
    options: Any = {"observations": ["qpos"], "keyframe": "raised", "n_substeps": 5}
    batch = URLabBatchEnv(levers[0], 1, randomise=Randomisation(delay=late), **options)
    env = URLabEnv.connect(levers[0], randomise=Randomisation(delay=late), **options)
    made += [env, batch]
    model, wait = batch.model, int(late.action) * 5 + int(late.action_substeps)  # type: ignore[arg-type]
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    env.reset()
    batch.reset()
    for _ in range(4):
        expected, _ = env.step(np.array([-0.5], dtype=np.float32))[:2]
        copies = batch.step(np.array([[-0.5]], dtype=np.float32))[0]
        for _ in range(5):
            data.ctrl[:] = model.key_ctrl[0] if wait > 0 else -0.5
            wait -= 1
            mujoco.mj_step(model, data)
        assert np.array_equal(expected, data.qpos)
        assert np.array_equal(copies[0], data.qpos)
    assert data.qpos[0] < 0.4, "the action has taken effect"


def test_a_keyframe_is_held_by_its_set_points_or_its_joint_positions(
    levers: list[str], tmp_path: Path, made: list[Any]
) -> None:
    model = tmp_path / "lever.xml"
    model.write_text(LEVER)
    pd = {"lever": ControllerConfig(kp=4.0, kv=0.1)}
    with SimulatedServer(model, play=True, step_mode="direct", controllers=pd) as server:
        made += [URLabBatchEnv(each, 1) for each in (levers[0], f"{server.address}:{server.step_port}")]
    assert [env.mapping.held("raised")["lever"].tolist() for env in made] == [[0.4375], [0.5]]
    assert [env.mapping.held(None)["lever"].tolist() for env in made] == [[0.0], [0.0]]


def test_set_points_for_a_controller_are_bounded_by_the_joints_and_walk_takes_actions_of_one(
    serving: Callable[..., str], made: list[Any]
) -> None:
    address = serving("quadruped", controllers={"quadruped": ControllerConfig(kp=60.0, kv=2.0)})
    plain, motors, walk = (
        URLabBatchEnv(address, 1),
        URLabBatchEnv(serving("quadruped"), 1),
        URLabBatchEnv(address, 1, task=Walk()),
    )
    made += [plain, motors, walk]
    radians = plain.single_action_space
    assert np.allclose(radians.low[:3], np.radians([-45, -100, -60]))  # type: ignore[attr-defined]
    assert np.allclose(radians.high[:3], np.radians([45, 80, 65]))  # type: ignore[attr-defined]
    assert motors.single_action_space.high[:3].tolist() == [25, 25, 35]  # type: ignore[attr-defined]
    assert abs(walk.single_action_space.low).max() == 1.0  # type: ignore[attr-defined]
    found = walk.mapping.set_points(np.array([2.0, -0.5, 1.0] * 4))["quadruped"]
    assert np.allclose(found, [0.3, -0.3, 0.8] * 4), "clipped, then scaled"
    assert walk.mapping.actions("quadruped").scale == [0.3, 0.6, 0.8] * 4


def test_a_declaration_of_actions_that_does_not_fit_is_refused(levers: list[str]) -> None:
    for wrong, problem in (
        (Actions(scale=[1.0, 2.0]), r"actions of lever: scale and offset take one number, or one for each of the 1"),
        ({"arm": Actions()}, "actions of arm; the articulations are: lever"),
    ):
        with pytest.raises(ValueError, match=problem):
            URLabBatchEnv(levers[0], 1, actions=wrong)  # type: ignore[arg-type]
    with pytest.raises(UnknownKeyframe, match="no keyframe 'lowered'"):
        URLabBatchEnv(levers[0], 1, actions=Actions(offset="lowered"))
    with pytest.raises(ValueError, match="clip must be"):
        Actions(clip=(1.0, 1.0))
    with pytest.raises(ValueError, match="clip takes 2 numbers, got 3"):
        Actions(clip=(-1.0, 0.0, 1.0))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="scale takes finite numbers, got nan"):
        Actions(scale=float("nan"))
    with pytest.raises(TypeError, match="scale takes numbers, got"):
        Actions(scale=None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"actions takes Actions, or a dictionary .*, got 0\.5"):
        URLabBatchEnv(levers[0], 1, actions=0.5)  # type: ignore[arg-type]


def _misspelt(**names: Any) -> Task:
    made: Task = type("Mine", (Hold,), names)()
    return made


def _starting(change: Callable[[Start], object]) -> Task:
    return _misspelt(reset=lambda self, rng, start: change(start))


@pytest.mark.parametrize(
    ("task", "problem"),
    [
        (_misspelt(rewards=lambda self, states, actions: 0), r"Mine\.rewards is not used .* mean 'reward'\?"),
        (_misspelt(terminate=lambda self, states: 0), r"Mine\.terminate .* 'terminated'"),
        (_misspelt(max_episodes_steps=5), r"Mine\.max_episodes_steps .* 'max_episode_steps'"),
        (_misspelt(ended=lambda self, success, steps: None), r"Mine\.ended\(\) must take \(episode\)"),
        (_misspelt(reward=lambda self, states: 0), r"Mine\.reward\(\) must take \(states, actions\)"),
        (_misspelt(n_observed=-1), r"Mine\.n_observed must be at least 0, not -1"),
        (_misspelt(n_observed="5"), r"Mine\.n_observed takes an integer, got '5'"),
        (_misspelt(memory=["up"]), r"Mine\.memory takes a dictionary of names to shapes, got \['up'\]"),
        (_misspelt(memory={"up": 3}), r"Mine\.memory\['up'\] takes a collection, such as a tuple, got 3"),
        (_misspelt(memory={"up": (-3,)}), r"Mine\.memory\['up'\] must be at least 0"),
        (_misspelt(articulations="lever"), r"articulations takes a collection, such as \('lever',\)"),
    ],
)
def test_wrong_declarations_of_a_task_are_refused_at_construction(levers: list[str], task: Task, problem: str) -> None:
    with pytest.raises((ValueError, TypeError), match=problem):
        URLabBatchEnv(levers[0], 1, task=task)


def test_an_environment_that_cannot_be_made_leaves_its_task_free(levers: list[str], made: list[Any]) -> None:
    task, pushed = Hold(), Randomisation(push=(Push(body="lid", force=(1.0, 2.0), every=(1, 2)),))
    with pytest.raises(KeyError, match="lid"):  # the traceback keeps what has been made so far
        URLabBatchEnv(levers[0], 1, task=task, randomise=pushed)
    made.append(URLabBatchEnv(levers[0], 1, task=task))


@pytest.mark.parametrize(
    ("task", "problem"),
    [
        (_misspelt(reward=lambda *_: 0.0), r"Mine\.reward\(\) returned shape \(\) for 2 environments"),
        (_misspelt(reward=lambda *_: np.array([0, np.nan])), r"Mine\.reward\(\) returned nan for environment 1"),
        (_misspelt(terminated=lambda *_: False), r"Mine\.terminated\(\) returned shape \(\)"),
        (_misspelt(success=lambda *_: np.zeros((2, 1))), r"Mine\.success\(\) returned shape \(2, 1\)"),
        (_misspelt(reward=lambda _, states, actions: states.memory["up"].fill(0)), "read-only"),
        (_misspelt(reward=lambda *_: np.array(["a", "b"])), r"Mine\.reward\(\) returned <U1; it must return numbers"),
        (_misspelt(terminated=lambda *_: np.array([0.0, 0.5])), r"Mine\.terminated\(\) .* true or false"),
        (
            _misspelt(terminated=lambda *_: np.array([0, np.nan])),
            r"Mine\.terminated\(\) returned nan for environment 1",
        ),
        (_misspelt(observe=lambda *_: np.zeros(5)), r"Mine\.observe\(\) returned shape \(5,\) .* shape \(2, 5\)"),
        (_misspelt(observe=lambda *_: np.zeros((1, 5))), r"Mine\.observe\(\) returned shape \(1, 5\)"),
        (_misspelt(observe=lambda *_: np.full((2, 5), np.nan)), r"Mine\.observe\(\) returned .* for environment 0"),
        (_starting(lambda start: start.memory.update(upp=1.0)), r"Mine\.reset\(\) keeps upp, .* declares up, recent"),
        (_starting(lambda start: start.memory.update(up=np.ones(2))), r"Mine\.reset\(\) set the memory 'up' to shape"),
        (_misspelt(update=lambda _, states: states.memory.update(recent=np.ones(2))), r"Mine\.update\(\) set the mem"),
        (_starting(lambda start: start.joint("lever/hinge", np.nan)), r"start\.qpos of environment 0"),
        (
            _starting(lambda start: start.goal.update(to=np.array(np.nan))),
            r"Mine\.reset\(\) set the goal 'to' to array\(nan\)",
        ),
        (
            _starting(lambda start: start.goal.update(to=np.array("up"))),
            r"Mine\.reset\(\) set the goal 'to' to array\('up'",
        ),
        (_starting(lambda start: start.goal.update(to=np.zeros(start.index))), r"goals of shapes .* environment 1"),
    ],
)
def test_wrong_answers_of_a_task_are_refused_by_name(
    levers: list[str], made: list[Any], task: Task, problem: str
) -> None:
    env = URLabBatchEnv(levers[0], 2, task=task)
    made.append(env)

    def an_action() -> None:
        env.reset()
        env.step(env.action_space.sample())

    with pytest.raises(ValueError, match=problem):
        an_action()


class Rebinding(Hold):
    """Sets other arrays, where it could write in place, and needs no memory to be told of actions."""

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        start.qpos = start.qpos + 0.1
        start.memory["up"] = 3
        start.goal = {"to": np.array(start.index + 0.5 if start.index else 0)}

    def update(self, states: States) -> None:
        states.memory = {**states.memory, "up": states.memory["up"] + 1}


def test_a_task_may_set_other_arrays_instead_of_writing_in_place(levers: list[str], made: list[Any]) -> None:
    env = URLabBatchEnv(levers[0], 2, task=Rebinding())
    made.append(env)
    observations, _ = env.reset()
    assert observations[:, 0].tolist() == [0.6, 0.6]
    assert observations[:, -4].tolist() == [3.0, 3.0]
    assert env.step(env.action_space.sample())[0][:, -4].tolist() == [4.0, 4.0]


def test_actions_are_told_to_a_task_that_keeps_nothing(levers: list[str], made: list[Any]) -> None:
    told: list[int] = []

    class Counts(Hold):
        n_observed: ClassVar[int] = 0
        memory: ClassVar[Mapping[str, tuple[int, ...]]] = {}
        observe, reset = Task.observe, Task.reset

        def update(self, states: States) -> None:
            told.append(len(states))

        def reward(self, states: States, actions: Any) -> Any:
            return np.zeros(len(states))

    env = URLabBatchEnv(levers[0], 2, task=Counts())
    made.append(env)
    env.reset()
    env.step(env.action_space.sample())
    assert told == [2]


def test_a_task_whose_set_up_failed_may_serve_again(levers: list[str], made: list[Any]) -> None:
    class Looks(Hold):
        name = "lever/rodd"

        def setup(self, scene: Any) -> None:
            super().setup(scene)
            scene.id("geom", self.name)

    task = Looks()
    with pytest.raises(KeyError, match="rodd") as failure:
        URLabBatchEnv(levers[0], 1, task=task)
    task.name = "lever/rod"
    made.append(URLabBatchEnv(levers[0], 1, task=task))
    assert failure.value  # as an interpreter keeps its last error, and with it what failed


def test_a_seed_for_each_environment_comes_in_any_sequence(levers: list[str], made: list[Any]) -> None:
    env = URLabBatchEnv(levers[0], 2, task=Hold())
    made.append(env)
    expected = env.reset(seed=[3, 8])[0].tolist()
    assert env.reset(seed=(3, 8))[0].tolist() == expected
    assert env.reset(seed=np.array([3, 8]))[0].tolist() == expected
    with pytest.raises(TypeError, match="seed takes an integer"):
        env.reset(seed=1.5)  # type: ignore[arg-type]


def test_an_end_that_gymnasium_decides_is_told_at_the_next_reset(levers: list[str], made: list[Any]) -> None:
    ends: list[EpisodeEnd] = []

    class Told(Hold):
        def ended(self, episode: EpisodeEnd) -> None:
            ends.append(episode)

    inner = URLabEnv.connect(levers[0], task=Told(), max_episode_steps=sys.maxsize)  # as a registered task is made
    env = TimeLimit(inner, 3)
    made.append(env)
    env.reset(seed=1)
    rewards = [float(env.step(np.ones(1, dtype=np.float32))[1]) for _ in range(3)]
    assert not ends
    env.reset()
    env.reset()
    env.step(np.ones(1, dtype=np.float32))
    env.reset(seed=1)
    assert [(end.steps, end.terminated, end.total) for end in ends] == [(3, False, sum(rewards))]


def test_a_task_serves_one_environment_until_it_is_closed(levers: list[str], made: list[Any]) -> None:
    task = Hold()
    first = URLabVectorEnv(levers, task=task)
    made.append(first)
    with pytest.raises(ValueError, match="this Hold already serves another environment: make one for each"):
        URLabBatchEnv(levers[0], 1, task=task)
    first.close()
    batch = URLabBatchEnv(levers[0], 1, task=task)
    made.append(batch)
    assert task.scene.model is batch.model, "it was set up again"
    batch.close()
    made.append(URLabEnv.connect(levers[0], task=task))


def test_feet_are_asked_for_at_once(serving: Callable[..., str], made: list[Any]) -> None:
    class Feet(Walk):
        seen: ClassVar[list[States]] = []

        def success(self, states: States) -> Any:
            self.seen.append(states)
            return np.zeros(len(states), dtype=bool)

    env = URLabBatchEnv(
        serving("quadruped", controllers={"quadruped": ControllerConfig(kp=60.0, kv=2.0)}), 2, task=Feet()
    )
    made.append(env)
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    states, feet = Feet.seen[-1], [f"geom:quadruped/{leg}_foot" for leg in ("FL", "FR", "RL", "RR")]
    assert states.touching(feet).tolist() == [[True] * 4] * 2
    assert (
        states.touching([*feet, "quadruped/trunk"], ["quadruped/trunk", "quadruped/floor"]).tolist()
        == [[True, True, True, True, False]] * 2
    )


def test_a_curriculum_advances_while_a_policy_is_trained(levers: list[str], made: list[Any]) -> None:
    class Follow(Task):
        """The lever goes to an angle, within a span that grows as it succeeds."""

        observations: ClassVar[Any] = ["qpos"]
        actions: ClassVar[Any] = Actions(scale=0.9)
        n_observed: ClassVar[int] = 1
        n_substeps: ClassVar[int] = 50
        max_episode_steps: ClassVar[int | None] = 4

        def __init__(self) -> None:
            self.span = 0.1
            self.spans = [self.span]

        def reset(self, rng: np.random.Generator, start: Start) -> None:
            start.goal["angle"] = np.array([rng.uniform(-self.span, self.span)])

        def observe(self, states: States) -> Any:
            return states.goal["angle"]

        def reward(self, states: States, actions: Any) -> Any:
            return -np.abs(states.qpos[:, 0] - states.goal["angle"][:, 0])

        def success(self, states: States) -> Any:
            return self.reward(states, None) > -0.08

        def ended(self, episode: EpisodeEnd) -> None:
            hard = abs(episode.goal["angle"][0]) > 0.5 * self.span
            if hard:
                self.span = min(0.8, 1.03 * self.span) if episode.success else max(0.1, 0.97 * self.span)
                self.spans.append(self.span)

    def trained(step: float) -> Follow:
        """Train `action = weight * goal` by a random search."""
        task = Follow()
        env = URLabBatchEnv(levers[0], 16, task=task, autoreset_mode=AutoresetMode.DISABLED)
        made.append(env)
        rng, weight = np.random.default_rng(0), 0.0

        def score(weight: float, seed: int) -> float:
            observation, _ = env.reset(seed=seed)
            total = 0.0
            for _ in range(4):
                observation, reward, *_ = env.step((weight * observation[:, 1:]).astype(np.float32))
                total += float(np.mean(reward))
            return total

        for _ in range(30):
            tried, seed = weight + step * rng.normal(), int(rng.integers(1000))
            weight = max((weight, tried), key=lambda each: score(each, seed))
        return task

    assert trained(0.0).span < 0.2, "without training it stays easy"
    learned = trained(0.4)
    assert learned.span > 0.5
    assert learned.spans[:10] != learned.spans[-10:]


HILLS = """
<mujoco>
  <option timestep="0.002"/>
  <asset><hfield name="hills" nrow="3" ncol="3" size="2 2 1 0.1" elevation="0 0 0  0 0.5 0  0 0 1"/></asset>
  <worldbody>
    <geom name="hills" type="hfield" hfield="hills"/>
    <geom name="ramp" type="box" size="1 1 0.05" pos="6 0 0.5" euler="0 -30 0"/>
    <body name="ball" pos="0 0 5">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.1" mass="1"/>
    </body>
    <body name="arm" pos="0 0 6"><joint name="turn" axis="0 0 1"/><geom name="rod" size="0.5"/></body>
  </worldbody>
  <actuator><motor name="turn" joint="turn"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("dialect", ["alpha", "beta"])
def test_episodes_start_on_slopes_and_height_fields(tmp_path: Path, made: list[Any], dialect: Any) -> None:
    """The same place on a server and in a batch, whatever moves above it."""

    class Settle(Task):
        seen: ClassVar[list[float]] = []
        n_substeps: ClassVar[int] = 1

        def reset(self, rng: np.random.Generator, start: Start) -> None:
            x, y = rng.choice([-1.0, 0.0, 1.0, 6.0]), 0.0
            self.seen.append(start.ground(x, y))
            start.place("hills/ball", [x, y, start.ground(x, y) + 0.3])
            with pytest.raises(ValueError, match="no ground at x = 9, y = 0"):
                start.ground(9.0, 0.0)

        def reward(self, states: States, actions: Any) -> Any:
            return -states.body_position("hills/ball")[:, 2]

    model = tmp_path / "hills.xml"
    model.write_text(HILLS)
    with SimulatedServer(model, play=True, step_mode="direct", dialect=dialect) as server:
        address = f"{server.address}:{server.step_port}"
        batch = URLabBatchEnv(address, 1, task=Settle())
        env = URLabEnv.connect(address, task=Settle())
        made += [batch, env]
        for seed in range(6):
            assert np.array_equal(batch.reset(seed=seed)[0][0], env.reset(seed=seed)[0])
        env.close()
    assert Settle.seen[:12:2] == Settle.seen[1:12:2]
    found = {round(height, 3) for height in Settle.seen}
    assert found == {0.25, 0.5, 0.558}, "the slope, the summit and the ramp"


CRATE = LEVER.replace(
    "</worldbody>",
    """<body name="crate" pos="0 0.5 0.099"><freejoint/><geom name="crate" type="box" size=".1 .1 .1" mass="1"/></body>
    </worldbody><sensor><jointvel name="speed" joint="hinge"/><actuatorfrc name="push" actuator="servo"/></sensor>""",
).replace('qpos="0.5"', 'qpos="0.5 0 0.5 0.099 1 0 0 0"')


class Thrown(Task):
    """The lever and the crate are moving when an episode starts."""

    observations: ClassVar[Any] = "standard"
    keyframe: ClassVar[str | None] = "raised"
    measured: ClassVar[bool] = True
    n_observed: ClassVar[int] = 4
    n_substeps: ClassVar[int] = 5

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        start.joint("lever/hinge", 0.3, velocity=rng.uniform(1, 2))
        start.place("lever/crate", [0, 0.5, 0.3], velocity=[0.5, 0.0, -1.0], spin=rng.uniform(-1, 1, 3))

    def observe(self, states: States) -> Any:
        force = states.contact_force(["lever/crate", "lever/lever"], "lever/floor")
        return np.concatenate([force, states.sensor("lever/speed"), states.sensor("lever/push")], axis=1)

    def reward(self, states: States, actions: Any) -> Any:
        return states.qvel[:, 0]


@pytest.fixture(scope="module", params=["alpha", "beta"])
def crates(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a server whose step mode may change."""
    model = tmp_path_factory.mktemp("crate") / "lever.xml"
    model.write_text(CRATE)
    with SimulatedServer(model, play=True, dialect=request.param) as server:
        yield f"{server.address}:{server.step_port}"


SPEEDS = Randomisation(
    vary=(
        Vary(what="velocity", add=(-1.0, 1.0)),
        Vary(what="base_velocity", set=((-1.0, -1.0, 0.0), (1.0, 1.0, 0.0))),
        Vary(what="base_spin", add=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))),
    )
)


@pytest.mark.parametrize("randomise", [None, SPEEDS])
def test_episodes_start_with_velocities(crates: str, made: list[Any], randomise: Randomisation | None) -> None:
    """The same in a batch and over both dialects, whose protocols set velocities in puppet mode alone."""
    batch = URLabBatchEnv(crates, 1, task=Thrown(), randomise=randomise)
    env = URLabEnv.connect(crates, task=Thrown(), randomise=randomise)
    made += [batch, env]
    starts: list[Any] = []
    for seed in (0, 1, 0):
        theirs, (ours, info) = batch.reset(seed=seed)[0][0], env.reset(seed=seed)
        assert np.array_equal(ours, theirs)
        assert (info["step_count"], info["sim_time"]) == (0, 0.0)
        starts.append(ours)
        qvel = env.mapping.field(ours, "lever", "qvel")
        if randomise is None:
            assert 1.0 < qvel[0] < 2.0
            assert qvel[1:4].tolist() == [0.5, 0.0, -1.0]
        action = np.array([0.2], dtype=np.float32)
        for _ in range(3):
            theirs, (ours, reward, *_, info) = batch.step(action[None]), env.step(action)
            assert np.array_equal(ours, theirs[0][0])
            assert reward == theirs[1][0]
        assert info["step_count"] == 15
    assert np.array_equal(starts[0], starts[2])
    assert not np.array_equal(starts[0], starts[1])


def test_start_velocities_that_a_pinned_server_cannot_set_are_refused(tmp_path: Path, made: list[Any]) -> None:
    model = tmp_path / "lever.xml"
    model.write_text(CRATE)
    with SimulatedServer(model, play=True, step_mode="direct") as server:
        env = URLabEnv.connect(f"{server.address}:{server.step_port}", task=Thrown())
        with pytest.raises(ModeLocked, match="Start velocities are set in puppet mode"):
            env.reset()
        env.close()


def test_contact_forces_and_sensors_are_those_of_the_state(crates: str, made: list[Any]) -> None:
    class Rest(Thrown):
        seen: ClassVar[list[States]] = []

        def reset(self, rng: np.random.Generator, start: Start) -> None:
            start.goal["none"] = np.zeros(1)

        def success(self, states: States) -> Any:
            self.seen.append(states)
            return np.zeros(len(states), dtype=bool)

    env = URLabBatchEnv(crates, 2, task=Rest())
    made.append(env)
    env.reset()
    for _ in range(100):
        observation = env.step(np.full((2, 1), 0.4375, dtype=np.float32))[0]
    states = Rest.seen[-1]
    weight = 9.81
    assert np.allclose(states.contact_force("lever/crate"), weight, rtol=1e-3)
    assert np.allclose(states.contact_force("geom:lever/floor", "lever/crate"), weight, rtol=1e-3)
    assert states.contact_force(["lever/lever", "lever/crate"])[:, 0].tolist() == [0.0, 0.0]
    assert np.array_equal(states.sensor("lever/push"), observation[:, -1:])
    with pytest.raises(KeyError, match="puhs"):
        states.sensor("lever/puhs")
    assert states.sensor("lever/speed").shape == (2, 1)
    bare = URLabBatchEnv(crates, 1, task=type("Bare", (Rest,), {"measured": False})())
    made.append(bare)
    with pytest.raises(ValueError, match="only if the task sets measured = True"):
        bare.reset()
