"""Vector environments: many servers in lockstep, batches without a wire, and that the two agree."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from waiting import attempts

import urlab_client
from urlab_client.aio.launch import LaunchedTransport
from urlab_client.enums import ControllerKind
from urlab_client.errors import BadValue
from urlab_client.integrations.gym import URLabBatchEnv, URLabVectorEnv
from urlab_client.server import ControllerConfig, Cut, Drop, Faults, Refuse, SimulatedServer

Make = Callable[..., Any]


@pytest.fixture(scope="module")
def servers() -> Iterator[list[str]]:
    """Addresses of two servers, which do not go on in live mode after their clients have closed."""
    with serving_two(step_mode="direct") as addresses:
        yield addresses


@contextmanager
def serving_two(**options: Any) -> Iterator[list[str]]:
    with SimulatedServer("arm", play=True, **options) as one, SimulatedServer("arm", play=True, **options) as two:
        yield [f"{server.address}:{server.step_port}" for server in (one, two)]


def actions_of(env: Any, n: int) -> list[Any]:
    rng = np.random.default_rng(3)
    return [rng.uniform(-0.5, 0.5, env.action_space.shape).astype(np.float32) for _ in range(n)]


def first_server(env: URLabVectorEnv) -> int:
    """Process id of environment 0's server."""
    client = env._sessions[0].episode.client
    return client._transport._process.pid


@pytest.mark.parametrize("mode", AutoresetMode)
def test_servers_and_batch_agree_bit_for_bit(
    serving: Make, servers: list[str], made: list[Any], mode: AutoresetMode
) -> None:
    def reward(before: Any, action: Any, after: Any, info: Any) -> Any:
        return after[..., 0] - before[..., 0]

    options: Any = {
        "n_substeps": 3,
        "reset_noise": 0.1,
        "max_episode_steps": 4,
        "autoreset_mode": mode,
        "reward_fn": reward,
        "termination_fn": lambda after, info: after[..., 1] > 0.08,
    }
    wire, batch = URLabVectorEnv(servers, **options), URLabBatchEnv(serving("arm"), 2, **options)
    made += [wire, batch]
    assert np.array_equal(wire.reset(seed=11)[0], batch.reset(seed=11)[0])
    ends = 0
    for action in actions_of(wire, 14):
        ours, theirs = wire.step(action), batch.step(action)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            assert np.array_equal(a, b)
        assert np.array_equal(ours[4]["sim_time"], theirs[4]["sim_time"])
        ended = ours[2] | ours[3]
        ends += int(ended.sum())
        if mode is AutoresetMode.SAME_STEP and ended.any():
            assert np.array_equal(ours[4]["_final_obs"], ended)
            for i in np.flatnonzero(ended):
                assert np.array_equal(ours[4]["final_obs"][i], theirs[4]["final_obs"][i])
        if mode is AutoresetMode.DISABLED and ended.any():
            for env in (wire, batch):
                env.reset(options={"reset_mask": ended})
    assert ends >= 2


def test_a_reset_by_itself_and_one_by_hand_tell_the_same_episodes(serving: Make, made: list[Any]) -> None:
    options: Any = {"n_substeps": 3, "reset_noise": 0.1, "max_episode_steps": 3}
    same, by_hand = (
        URLabBatchEnv(serving("arm"), 2, autoreset_mode=mode, **options)
        for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
    )
    made += [same, by_hand]
    assert np.array_equal(same.reset(seed=5)[0], by_hand.reset(seed=5)[0])
    for step, action in enumerate(actions_of(same, 8), start=1):
        seen, _, _, truncated, infos = same.step(action)
        last, _, _, ended, _ = by_hand.step(action)
        assert truncated.tolist() == ended.tolist() == [step % 3 == 0] * 2
        if not ended.any():
            assert np.array_equal(seen, last)
            continue
        assert np.array_equal(np.stack(infos["final_obs"]), last), "the last observation of the episode that ended"
        assert np.array_equal(seen, by_hand.reset(options={"reset_mask": ended})[0]), "the first one of the next"
        assert not np.array_equal(seen, last)
    alone, _ = by_hand.reset(options={"reset_mask": np.array([True, False])})
    assert np.array_equal(alone[1], last[1]), "the other goes on where it was"
    assert not np.array_equal(alone[0], last[0])


def test_environment_i_equals_a_single_one_with_its_seed(servers: list[str], made: list[Any]) -> None:
    env = URLabVectorEnv(servers, reset_noise=0.1, n_substeps=2)
    made.append(env)
    observations, _ = env.reset(seed=4)
    actions = actions_of(env, 5)
    for action in actions:
        observations, *_ = env.step(action)
    single = gymnasium.make("urlab/Arm-v0", n_substeps=2, reset_noise=0.1)
    made.append(single)
    alone, _ = single.reset(seed=5)
    for action in actions:
        alone, *_ = single.step(action[1])
    assert np.array_equal(observations[1], alone)


def test_a_killed_server_is_reported_by_index_and_replaced_while_the_others_go_on(
    servers: list[str], made: list[Any]
) -> None:
    env = URLabVectorEnv(["sim://arm", servers[1]], reset_noise=0.1)
    made.append(env)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    env.step(action)
    os.kill(first_server(env), getattr(signal, "SIGKILL", signal.SIGTERM))  # which on Windows ends it at once
    observations, _, terminated, truncated, infos = env.step(action)
    assert truncated.tolist() == [True, False]
    assert not terminated.any()
    assert isinstance(infos["error"][0], urlab_client.URLabConnectionError)
    assert infos["error"][0].__notes__[-1] == "environment 0 at sim://arm"
    assert infos["_error"].tolist() == [True, False]
    assert infos["step_count"][1] == 2
    assert np.isfinite(observations).all()
    *_, truncated, infos = env.step(action)
    assert not truncated.any()
    assert "error" not in infos
    assert infos["restarts"].tolist() == [1, 0]
    assert infos["step_count"].tolist() == [0, 3]
    *_, infos = env.step(action)
    assert infos["step_count"].tolist() == [1, 4]


def test_a_slow_environment_counts_as_failed_and_holds_up_nobody_for_longer(made: list[Any]) -> None:
    faults = Faults()
    with (
        SimulatedServer("arm", play=True, faults=faults) as slow,
        SimulatedServer("arm", play=True) as quick,
    ):
        addresses = [f"{server.address}:{server.step_port}" for server in (quick, slow)]
        everywhere: Any = {
            "reward_fn": lambda before, action, after, info: np.ones(2),
            "termination_fn": lambda after, info: np.ones(2, dtype=bool),
        }
        env = URLabVectorEnv(addresses, step_timeout=3.0, **everywhere)
        made.append(env)
        env.reset(seed=0)
        faults.add(Drop("step", times=1))
        action = np.zeros(env.action_space.shape)
        _, rewards, terminated, truncated, infos = env.step(action)
        assert (rewards.tolist(), terminated.tolist()) == ([1.0, 0.0], [True, False]), "what failed earned nothing"
        assert truncated.tolist() == [False, True]
        assert "environment 1 did not answer within 3 s" in str(infos["error"][1])
        *_, truncated, infos = env.step(action)
        assert not truncated.any()
        assert infos["restarts"].tolist() == [0, 1]


@pytest.mark.parametrize("by_hand", [True, False])
def test_an_episode_that_could_not_begin_begins_with_the_next_step(by_hand: bool, made: list[Any]) -> None:
    faults = Faults()
    with SimulatedServer("arm", play=True, faults=faults) as one, SimulatedServer("arm", play=True) as two:
        addresses = [f"{server.address}:{server.step_port}" for server in (one, two)]
        env = URLabVectorEnv(addresses, max_episode_steps=1)
        made.append(env)
        env.reset(seed=0)
        action = np.zeros(env.action_space.shape)
        env.step(action)
        faults.add(Cut("reset", times=1))
        infos = env.reset()[1] if by_hand else env.step(action)[-1]
        assert infos["_error"].tolist() == [True, False]
        *_, infos = env.step(action)
        assert "error" not in infos, "it was reset, not stepped"
        assert infos["restarts"].tolist() == [1, 0]
        assert infos["step_count"].tolist() == [0, 1]


def test_a_refusal_is_raised_and_costs_no_server(made: list[Any]) -> None:
    faults = Faults()
    with SimulatedServer("arm", play=True) as well, SimulatedServer("arm", play=True, faults=faults) as refusing:
        addresses = [f"{server.address}:{server.step_port}" for server in (well, refusing)]
        env = URLabVectorEnv(addresses, max_episode_steps=1)
        made.append(env)
        action = np.zeros(env.action_space.shape)
        with pytest.raises(urlab_client.UnknownKeyframe, match="Known: 'home'") as caught:
            env.reset(options={"keyframe": "away"})
        assert caught.value.__notes__[-1].startswith("environment 0 at")
        env.reset(options={"keyframe": "home"})
        faults.add(Refuse("reset", code="unknown_keyframe", times=1))
        with pytest.raises(urlab_client.UnknownKeyframe, match="unknown_keyframe") as caught:
            env.reset()
        assert caught.value.__notes__[-1].startswith("environment 1 at")
        *_, infos = env.step(action)  # what was refused is reset again
        assert (infos["step_count"].tolist(), infos["restarts"].tolist()) == ([1, 0], [0, 0])
        faults.add(Refuse("step", code="bad_value", times=1))
        *_, truncated, infos = env.step(action)
        assert (truncated.tolist(), infos["_error"].tolist()) == ([False, True], [False, True])
        assert isinstance(infos["error"][1], BadValue)
        observations, *_, infos = env.step(action)
        assert "error" not in infos
        assert infos["restarts"].tolist() == [0, 0]
        assert observations[1, 7] == 0.04, "the keyframe of the reset before"


def test_an_environment_that_takes_long_to_come_back_holds_up_nobody(
    servers: list[str], made: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    env = URLabVectorEnv(servers, step_timeout=2.0)
    made.append(env)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape)
    ready, opened = threading.Event(), env._sessions[0].open

    async def slowly() -> None:
        await asyncio.to_thread(ready.wait)
        await opened()

    monkeypatch.setattr(env._sessions[0], "open", slowly)
    env._portal.call(env._sessions[0].episode.client.close)
    *_, infos = env.step(action)
    assert isinstance(infos["error"][0], urlab_client.ClientClosed)
    for count in (2, 3):
        *_, truncated, infos = env.step(action)
        assert truncated.tolist() == [True, False]
        assert "environment 0 is still starting" in str(infos["error"][0])
        assert infos["step_count"][1] == count
    ready.set()
    for _ in attempts("the environment did not come back"):
        *_, infos = env.step(action)
        if "error" not in infos:
            break
    assert infos["restarts"].tolist() == [1, 0]


def test_no_more_servers_start_at_once_than_there_are_processors(
    made: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    starting, most = 0, 0
    launch = LaunchedTransport._launch

    async def counted(self: Any, op: Any) -> Any:
        nonlocal starting, most
        starting += 1
        most = max(most, starting)
        try:
            return await launch(self, op)
        finally:
            starting -= 1

    monkeypatch.setattr(LaunchedTransport, "_launch", counted)
    monkeypatch.setattr("urlab_client.integrations.gym.vector.processor_count", lambda: 1)
    env = URLabVectorEnv("sim://ball", 2, start_timeout=120.0)
    made.append(env)
    assert most == 1
    assert env.reset()[0].shape[0] == 2


@pytest.mark.parametrize("n", [pytest.param(16, marks=pytest.mark.long), pytest.param(64, marks=pytest.mark.matrix)])
def test_many_servers_come_up(made: list[Any], n: int) -> None:
    env = URLabVectorEnv("sim://quadruped", n)
    made.append(env)
    env.reset(seed=0)
    *_, infos = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    assert infos["step_count"].tolist() == [1] * n


def test_physics_steps_are_counted_in_a_batch_as_by_servers(made: list[Any]) -> None:
    counts: list[list[int]] = []
    for kind in (URLabVectorEnv, URLabBatchEnv):
        env = kind("sim://quadruped", 1, n_substeps=3)
        made.append(env)
        env.reset(seed=0)
        still = np.zeros(env.action_space.shape, dtype=np.float32)  # type: ignore[arg-type]
        counts += [[int(env.step(still)[4]["step_count"][0]) for _ in range(3)]]
    assert counts == [[3, 6, 9]] * 2


def test_a_session_that_cannot_start_is_named(servers: list[str]) -> None:
    with pytest.raises(urlab_client.URLabError, match="Environment 1 at sim://no-such-robot"):
        URLabVectorEnv([servers[0], "sim://no-such-robot"])


def test_environments_with_other_spaces_are_refused(servers: list[str], serving: Make) -> None:
    with pytest.raises(ValueError, match=r"environment 1 .* has different spaces"):
        URLabVectorEnv([servers[0], serving("ball")])


@pytest.mark.parametrize(
    ("arguments", "options", "reason"),
    [
        (("sim://arm",), {}, "needs num_envs"),
        (("sim://arm", "2"), {}, "num_envs takes an integer, got '2'"),
        (("tcp://127.0.0.1", 2), {}, "list one address per environment"),
        ((["sim://arm"], 2), {}, "1 addresses"),
        (([],), {}, "0 addresses"),
        ((["sim://arm"],), {"step_timeout": 0.0}, "above 0"),
        ((["sim://arm"],), {"start_timeout": 0.0}, "above 0"),
    ],
)
def test_wrong_arguments_start_nothing(arguments: Any, options: Any, reason: str) -> None:
    with pytest.raises((ValueError, TypeError), match=reason):
        URLabVectorEnv(*arguments, **options)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.long
def test_older_releases_of_mujoco_step_a_batch_with_the_same_results(
    made: list[Any], monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    options: Any = {"n_substeps": 2, "reset_noise": 0.1, "max_episode_steps": 4}
    newest = URLabBatchEnv("sim://quadruped?controller=quadruped=pd,kp=60,kv=2", 3, **options)
    monkeypatch.setattr("urlab_client.integrations.gym.batch.batch_class", lambda: None)
    older = URLabBatchEnv("sim://quadruped?controller=quadruped=pd,kp=60,kv=2", 3, n_threads=threads, **options)
    made += [newest, older]
    assert np.array_equal(newest.reset(seed=3)[0], older.reset(seed=3)[0])
    for action in actions_of(newest, 10):
        for ours, theirs in zip(newest.step(action)[:4], older.step(action)[:4], strict=True):
            assert np.array_equal(ours, theirs)


def test_resets_refuse_masks_and_seeds_that_do_not_fit(serving: Make, made: list[Any]) -> None:
    env = URLabBatchEnv(serving("arm"), 3)
    made.append(env)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((3, 7)))
    for mask in ([True], np.zeros(3, dtype=bool), np.ones(3)):
        with pytest.raises(ValueError, match="3 booleans"):
            env.reset(options={"reset_mask": np.asarray(mask)})
    with pytest.raises(ValueError, match="2 seeds for 3"):
        env.reset(seed=[1, 2])
    env.reset()
    for actions in (np.zeros(7), np.zeros((2, 7)), np.zeros((4, 7))):
        with pytest.raises(ValueError, match="first axis must be 3 long"):
            env.step(actions)
    with pytest.raises(urlab_client.UnknownKeyframe, match="arm_home"):
        env.reset(options={"keyframe": "away"})
    observations, _ = env.reset(options={"keyframe": "home"})
    assert observations[:, 7].tolist() == [0.04] * 3


@pytest.mark.parametrize(
    ("robot", "config"),
    [("quadruped", ControllerConfig(kp=60.0, kv=2.0)), ("arm", ControllerConfig(ControllerKind.PASSTHROUGH))],
)
def test_controllers_act_in_a_batch_as_on_a_server(
    robot: str, config: ControllerConfig, serving: Make, made: list[Any]
) -> None:
    address = serving(robot, controllers={robot: config})
    batch = URLabBatchEnv(address, 3, n_substeps=4)
    wire = URLabVectorEnv([address], n_substeps=4)
    made += [wire, batch]
    expected, ours = wire.reset(seed=0)[0], batch.reset(seed=0)[0]
    for n in range(20):
        action = 0.4 * np.sin(0.3 * n + np.arange(wire.action_space.shape[1]))
        expected = wire.step(action[None])[0]
        ours = batch.step(np.stack([0 * action, action, -action]))[0]
        assert np.array_equal(ours[1], expected[0])
    assert not np.array_equal(ours[0], ours[1])


@pytest.mark.parametrize("task_id", ["urlab/Quadruped-v0", pytest.param("urlab/Arm-v0", marks=pytest.mark.long)])
def test_a_tasks_rewards_are_the_same_from_servers_and_batch(task_id: str, made: list[Any]) -> None:
    wire = gymnasium.make_vec(task_id, num_envs=1)
    batch = gymnasium.make_vec(task_id, num_envs=1, backend="batch")
    made += [wire, batch]
    wire.reset(seed=0)
    batch.reset(seed=0)
    for action in actions_of(wire, 3):
        assert np.array_equal(wire.step(action)[1], batch.step(action)[1])


@pytest.mark.opengl
@pytest.mark.long
def test_servers_and_batch_render_each_environment(made: list[Any]) -> None:
    with serving_two() as servers:  # in no fixed mode: pictures of a reset are taken in puppet mode
        compare_pictures(servers, made)


def compare_pictures(servers: list[str], made: list[Any]) -> None:
    options: Any = {"render_mode": "rgb_array", "render_camera": "arm/overview", "keyframe": "home", "reset_noise": 0.3}
    wire, batch = URLabVectorEnv(servers, **options), URLabBatchEnv("sim://arm", 2, **options)
    made += [wire, batch]
    with pytest.raises(gymnasium.error.ResetNeeded):
        wire.render()
    for env in (wire, batch):
        observations, _ = env.reset(seed=1)
        assert observations[:, 7].tolist() == [0.04] * 2, "the keyframe of the constructor"
        first = env.render()
        env.step(actions_of(env, 1)[0])
        second = env.render()
        assert [picture.shape for picture in (*first, *second)] == [(480, 640, 3)] * 4
        assert len({picture.tobytes() for picture in first}) == 2
        assert all(np.ptp(picture) > 100 for picture in first)
    assert all(np.array_equal(*pictures) for pictures in zip(wire.render(), batch.render(), strict=True))
    for env in (URLabVectorEnv, URLabBatchEnv):
        with pytest.raises(ValueError, match="render_mode"):
            env("sim://arm", 1, render_mode="human")
