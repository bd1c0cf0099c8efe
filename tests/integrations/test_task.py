"""Tasks: one object serves single environments, servers and batches, with the same numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from urlab_client.integrations.gym import (
    EpisodeEnd,
    FixedReach,
    Push,
    PushPictures,
    Reach,
    Run,
    SpaceMapping,
    Start,
    States,
    Task,
    URLabBatchEnv,
    URLabEnv,
    URLabVectorEnv,
    Walk,
)
from urlab_client.integrations.gym.spaces import FIELDS
from urlab_client.server import ControllerConfig, SimulatedServer
from urlab_client.values.names import NameMap

STEPPED: Any = {"play": True, "step_mode": "direct"}
"""Options of a server that does not go on in live mode after its clients have closed."""


PLUGIN: Any = {"dialect": "beta", "actor_names": "plugin"}
"""Options of a server whose compiled names begin otherwise than its robots are called."""


@pytest.fixture(scope="module")
def arms() -> Iterator[list[str]]:
    """Addresses of two servers."""
    with SimulatedServer("arm", **STEPPED) as one, SimulatedServer("arm", **STEPPED) as two:
        yield [f"{server.address}:{server.step_port}" for server in (one, two)]


@pytest.fixture(scope="module")
def walkers() -> Iterator[list[str]]:
    """Addresses of two servers whose quadruped has the controller that `Walk` asks for."""
    pd = {"quadruped": ControllerConfig(kp=60.0, kv=2.0)}
    with (
        SimulatedServer("quadruped", **STEPPED, controllers=pd) as one,
        SimulatedServer("quadruped", **STEPPED, controllers=pd) as two,
    ):
        yield [f"{server.address}:{server.step_port}" for server in (one, two)]


@pytest.fixture(scope="module")
def pushers() -> Iterator[list[str]]:
    """Addresses of two servers with what `Push` needs."""
    models = ("arm", "block", "floor")
    with (
        SimulatedServer(*models, play=True, camera_size=(96, 72)) as one,
        SimulatedServer(*models, play=True, camera_size=(96, 72)) as two,
    ):
        yield [f"{server.address}:{server.step_port}" for server in (one, two)]


@pytest.fixture(scope="module")
def plugin_pushers() -> Iterator[list[str]]:
    """Addresses of two servers with what `Push` needs, named as the plugin names it."""
    models = ("arm", "block", "floor")
    with (
        SimulatedServer(*models, play=True, camera_size=(96, 72), **PLUGIN) as one,
        SimulatedServer(*models, play=True, camera_size=(96, 72), **PLUGIN) as two,
    ):
        yield [f"{server.address}:{server.step_port}" for server in (one, two)]


@pytest.mark.parametrize(
    ("kind", "servers"), [(Reach, "arms"), (Push, "pushers"), (Push, "plugin_pushers"), (Walk, "walkers")]
)
def test_all_three_environments_agree_bit_for_bit(
    kind: type[Task], servers: str, made: list[Any], request: pytest.FixtureRequest
) -> None:
    addresses = request.getfixturevalue(servers)
    batch = URLabBatchEnv(addresses[0], 2, task=kind(), max_episode_steps=4)
    wire = URLabVectorEnv(addresses, task=kind(), max_episode_steps=4)
    made += [wire, batch]
    rng = np.random.default_rng(2)
    actions = [rng.uniform(-0.4, 0.4, wire.action_space.shape).astype(np.float32) for _ in range(7)]

    def rollout(env: Any) -> list[Any]:
        observation, told = env.reset(seed=6)
        seen: list[Any] = [observation]
        for action in actions:
            *ours, infos = env.step(action)
            assert infos.keys() == told.keys(), "collectors such as Minari's need the same keys at each reset and step"
            assert infos["_success"].all()
            seen += [*ours, infos["success"], infos["sim_time"]]
        return seen

    expected, found = rollout(wire), rollout(batch)
    for a, b in zip(expected, found, strict=True):
        assert np.array_equal(a, b)
    wire.close()
    single = URLabEnv.connect(addresses[0], task=kind(), max_episode_steps=4)
    made.append(single)
    observation, told = single.reset(seed=6)
    assert single.observation_space.contains(observation)
    assert np.array_equal(observation, expected[0][0])
    for i, action in enumerate(actions[:4]):
        observation, reward, terminated, truncated, info = single.step(action[0])
        assert info.keys() == told.keys()
        ours = [row[0] for row in expected[1 + 6 * i : 7 + 6 * i]]
        assert np.array_equal(observation, ours[0])
        assert (reward, terminated, truncated, info["success"], info["sim_time"]) == tuple(ours[1:])
    assert truncated


@pytest.mark.parametrize("kind", [FixedReach, Run])
def test_fixed_goals_start_within_a_twentieth_of_a_radian(kind: type[Task], made: list[Any]) -> None:
    env = URLabBatchEnv(kind.scene_address, 8, task=kind())
    made.append(env)
    observations, _ = env.reset(seed=0)
    (key,) = env.mapping.keys
    free = 7 if kind is Run else 0
    away = abs(env.mapping.field(observations, key, "qpos") - env.model.qpos0)[:, free:]
    assert 0.04 < away.max() <= 0.05


def test_goals_starts_and_commands_vary_with_the_seed_alone(walkers: list[str], made: list[Any]) -> None:
    class Faced(Walk):
        """Notes where the robots look."""

        faced: ClassVar[list[Any]] = []

        def success(self, states: States) -> Any:
            self.faced.append(states.positions("quadruped")[:, 3:7])
            return super().success(states)

    env = URLabBatchEnv(walkers[0], 3, task=Faced())
    made.append(env)
    first, _ = env.reset(seed=1)
    again, _ = env.reset(seed=1)
    other, _ = env.reset(seed=2)
    assert np.array_equal(first, again)
    assert np.array_equal(first[1:], other[:2]), "environment i has the seed s + i"
    commands = first[:, -3:] / 3.0
    assert ((commands >= Walk.LOW) & (commands <= Walk.HIGH)).all()
    assert len(np.unique(commands)) == 9
    quaternions = Faced.faced[0]
    assert len(np.unique(quaternions[:, 0])) == 3, "it looks another way each time"
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0)


def test_a_hand_at_its_target_is_a_success_and_ends_a_curriculums_episode(arms: list[str], made: list[Any]) -> None:
    class Near(Reach):
        """Targets where the hand rests."""

        def __init__(self) -> None:
            self.ends: list[EpisodeEnd] = []

        def reset(self, rng: np.random.Generator, start: Start) -> None:
            data = self.scene.data
            data.qpos[:] = start.qpos
            mujoco.mj_kinematics(self.scene.model, data)
            start.goal["target"] = data.site_xpos[self.scene.id("site", "arm/grip")] + rng.choice([0.0, 0.5])

        def ended(self, episode: EpisodeEnd) -> None:
            self.ends.append(episode)

    task = Near()
    env = URLabBatchEnv(arms[0], 4, task=task, max_episode_steps=2)
    made.append(env)
    observations, told = env.reset(seed=[0, 1, 2, 3])
    near = np.linalg.norm(observations[:, -3:], axis=1) < 0.03
    assert 0 < near.sum() < 4
    assert told["success"].tolist() == near.tolist()
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    totals = np.zeros(4)
    for _ in range(2):
        _, rewards, _, truncated, infos = env.step(still)
        totals += rewards
        assert infos["success"].tolist() == near.tolist()
        assert (rewards > 0).tolist() == near.tolist()
    assert truncated.all()
    for i, end in enumerate(task.ends):
        assert (end.index, end.success, end.terminated, end.steps, end.total) == (i, near[i], False, 2, totals[i])
        assert np.array_equal(end.goal["target"], observations[i, -6:-3])
    assert len(task.ends) == 4


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_ended_is_told_once_the_length_of_its_own_episode(
    arms: list[str], made: list[Any], mode: AutoresetMode
) -> None:
    class Falls(Reach):
        """An episode of environment i ends after i + 2 actions, and what has fallen stays so until a reset."""

        def __init__(self) -> None:
            self.acted, self.ends = np.zeros(3, dtype=int), []

        def terminated(self, states: Any) -> Any:
            self.acted += 1
            return self.acted >= np.arange(3) + 2 if mode is AutoresetMode.DISABLED else self.acted == np.arange(3) + 2

        def ended(self, episode: EpisodeEnd) -> None:
            self.ends.append(episode.steps)

    task = Falls()
    env = URLabBatchEnv(arms[0], 3, task=task, autoreset_mode=mode)
    made.append(env)
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    assert task.ends == [2, 3, 4]


def test_where_some_episodes_begin_anew_infos_tell_of_all(arms: list[str], made: list[Any]) -> None:
    disabled, same_step = AutoresetMode.DISABLED, AutoresetMode.SAME_STEP
    env = URLabBatchEnv(arms[0], 2, task=Reach(), max_episode_steps=2, autoreset_mode=disabled)
    made.append(env)
    one = {"reset_mask": np.array([True, False])}
    assert env.reset(seed=1, options=one)[1]["_success"].tolist() == [True, False], "the other had no episode yet"
    assert env.step(env.action_space.sample())[4]["_success"].all()
    assert env.reset(options=one)[1]["_success"].all()
    env = URLabBatchEnv(arms[0], 2, task=Reach(), max_episode_steps=2, autoreset_mode=same_step)
    made.append(env)
    _, told = env.reset(seed=1)
    env.step(env.action_space.sample())
    infos = env.step(env.action_space.sample())[4]
    assert infos.keys() - {"final_obs", "_final_obs", "final_info", "_final_info"} == told.keys()
    assert infos["final_info"].keys() == told.keys()


@pytest.mark.parametrize("naming", [{}, PLUGIN], ids=["model", "plugin"])
def test_poses_and_contacts_are_those_of_the_state(naming: Any, made: list[Any]) -> None:
    class Stand(Walk):
        seen: ClassVar[list[States]] = []

        def reward(self, states: States, actions: Any) -> Any:
            self.seen.append(states)
            return np.zeros(len(states))

    pd = {"quadruped": ControllerConfig(kp=60.0, kv=2.0)}
    with SimulatedServer("quadruped", **STEPPED, controllers=pd, **naming) as server:
        env = URLabBatchEnv(f"{server.address}:{server.step_port}", 2, task=Stand())
    made.append(env)
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    states, model, calf = Stand.seen[-1], env.model, f"{env.mapping.prefixes['quadruped']}_FL_calf"
    assert calf == ("quadruped_C_0_FL_calf" if naming else "quadruped_FL_calf")
    for written in ("quadruped_FL_calf", "quadruped/FL_calf", calf):
        assert states.scene.id("body", written) == model.body(calf).id
    data = mujoco.MjData(model)
    for i in range(2):
        data.qpos[:] = states.qpos[i]
        mujoco.mj_forward(model, data)
        assert np.array_equal(states.body_position("quadruped/FL_calf")[i], data.body(calf).xpos)
    for foot in ("quadruped/FL_calf", "quadruped/FL_foot"):
        assert states.touching(foot).all()
        assert states.touching(foot, "quadruped/floor").all()
    assert not states.touching("geom:quadruped/FL_calf").any(), "the shin, not the foot of the body with its name"
    assert not states.touching("quadruped/trunk").any()
    assert not states.touching("quadruped/FL_calf", "quadruped/FR_calf").any()
    with pytest.raises(KeyError, match=r"^no body 'quadruped/tail'\. .*quadruped_"):
        states.body_position("quadruped/tail")
    with pytest.raises(ValueError, match="has no free joint"):
        Start(states.scene, states.qpos[0], states.qvel[0]).place("quadruped/FL_calf", [0, 0, 0])


def test_an_argument_wins_over_the_task_and_what_is_judged_needs_not_be_observed(
    arms: list[str], made: list[Any]
) -> None:
    """Any fields, on a server and in a batch: rewards are those of the whole observation."""
    whole = URLabBatchEnv(arms[0], 1, task=FixedReach(), n_substeps=3, reset_noise=0.0, max_episode_steps=1)
    made.append(whole)
    expected = whole.reset()[0], *whole.step(np.full((1, 7), 0.2, dtype=np.float32))
    assert whole.mapping.fields == FIELDS
    assert expected[4].all(), "one action, as the argument says"
    for count in (1, len(FIELDS) - 1):
        for fields in itertools.combinations(FIELDS, count):
            options: Any = {"n_substeps": 3, "reset_noise": 0.0, "max_episode_steps": 1, "observations": fields}
            batch = URLabBatchEnv(arms[0], 1, task=FixedReach(), **options)
            single = URLabEnv.connect(arms[0], task=FixedReach(), **options)
            made += [batch, single]
            for at, ours, theirs in (
                (0, batch.reset()[0], single.reset()[0]),
                (1, batch.step(np.full((1, 7), 0.2, dtype=np.float32)), single.step(np.full(7, 0.2))),
            ):
                seen, alone = (ours, theirs) if at == 0 else (ours[0], theirs[0])
                parts = [whole.mapping.field(expected[at], "arm", field) for field in fields]
                assert np.array_equal(seen, np.concatenate(parts, axis=-1))
                assert np.array_equal(seen[0], alone)
            assert ours[1][0] == theirs[1] == expected[2][0] < 0
            single.close()
    with pytest.raises(ValueError, match=r"'sensors' is not observed: .*observations=\['qpos'\]"):
        SpaceMapping(whole.model, NameMap({"arm": "arm_"}), ["qpos"]).field(np.zeros(8), "arm", "sensors")


@pytest.mark.usefixtures("opengl")
def test_a_block_is_pushed_to_its_target_and_seen_in_pictures_alone(pushers: list[str], made: list[Any]) -> None:
    class Ahead(Push):
        def reset(self, rng: np.random.Generator, start: Start) -> None:
            super().reset(rng, start)
            start.place("block/block", [0.44, 0.0, 0.03])
            start.goal["target"] = np.array([0.56, 0.0])

    class AheadByEye(Ahead, PushPictures):
        pass

    batch = URLabBatchEnv(pushers[0], 1, task=Ahead())
    made.append(batch)
    behind = np.array([Ahead.BEHIND[joint] for joint in ("shoulder_lift", "elbow", "wrist_pitch")])
    ahead = np.array([0.62, 0.3, -0.92])
    batch.reset(seed=0)
    rewards: list[float] = []
    infos: dict[str, Any] = {}
    for share in np.linspace(0.0, 1.0, 60):
        lift, elbow, pitch = (1 - share) * behind + share * ahead
        _, reward, _, _, infos = batch.step(np.array([[0, lift, elbow, 0, pitch, 0, 0]], dtype=np.float32))
        rewards.append(float(reward[0]))
    assert infos["success"].all()
    assert rewards[-1] > 0.9 > 0.0 > rewards[0]

    env = URLabEnv.connect(pushers[1], task=AheadByEye())
    made.append(env)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"arm", "cameras", "task"}, "not where the block is"
    assert set(env.action_space.spaces) == {"arm"}, "the block has no actuators"  # type: ignore[attr-defined]
    picture = observation["cameras"]["arm/overview"].astype(int)
    assert picture.shape == (72, 96, 3)
    orange = (picture[..., 0] > 150) & (picture[..., 2] < 80)
    assert 3 < orange.sum() < 300
    in_batch = URLabBatchEnv(pushers[1], 1, task=AheadByEye())
    made.append(in_batch)
    assert np.array_equal(in_batch.reset(seed=0)[0]["cameras"]["arm/overview"][0], picture)
    with pytest.raises(ValueError, match="'block' is not observed"):
        env.mapping.field(observation, "block", "qpos")


def test_what_a_task_settles_is_refused_beside_it(arms: list[str], made: list[Any]) -> None:
    with pytest.raises(ValueError, match="reward_fn cannot be given together with a task"):
        URLabVectorEnv(arms, task=Reach(), reward_fn=lambda *_: 0)

    class Wrong(Reach):
        n_observed: ClassVar[int] = 5

    env = URLabBatchEnv(arms[0], 1, task=Wrong())
    made.append(env)
    with pytest.raises(
        ValueError, match=r"Wrong.observe\(\) returned shape \(1, 6\) .* shape \(1, 5\): \(n, n_observed\)"
    ):
        env.reset()
