"""Gymnasium environments against simulated servers: spaces, episodes, determinism, pictures, errors."""

from __future__ import annotations

import copy
import pickle
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.utils.env_checker import check_env

import urlab_client
from urlab_client.integrations.gym import TASKS, ResetNoise, SpaceMapping, URLabEnv
from urlab_client.server import SimulatedServer

MakeEnv = Callable[..., URLabEnv]


@pytest.fixture(scope="module")
def server() -> Iterator[SimulatedServer]:
    with SimulatedServer("quadruped", "arm", play=True, camera_size=(64, 48)) as server:
        yield server


@pytest.fixture
def make_env(server: SimulatedServer) -> Iterator[MakeEnv]:
    clients: list[urlab_client.URLabClient] = []

    def make(**options: Any) -> URLabEnv:
        client = urlab_client.URLabClient(**server.client_options(), step_mode=options.pop("step_mode", "direct"))
        clients.append(client)
        client.discover()
        return URLabEnv(client, **options)

    yield make
    for client in clients:
        client.close()


@contextmanager
def without_advice() -> Iterator[None]:
    """The checker advises normalised spaces; ours are in the robots' own units."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*(infinity|symmetric and normalized|render modes).*")
        yield


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"space_mode": "flat"}, id="flat"),
        pytest.param({"space_mode": "dict"}, id="dict"),
        pytest.param({"space_mode": "dict", "cameras": ["quadruped/side"]}, id="cameras", marks=pytest.mark.opengl),
    ],
)
def test_gymnasiums_checker_finds_nothing(make_env: MakeEnv, options: dict[str, Any]) -> None:
    with without_advice():
        check_env(make_env(n_substeps=2, reset_noise=0.05, **options), skip_close_check=True)


@pytest.mark.opengl
@pytest.mark.parametrize(
    "task_id",
    [pytest.param(task, marks=[pytest.mark.long] if number else []) for number, task in enumerate(sorted(TASKS))],
)
def test_a_registered_task_passes_the_checker_and_closes_its_server(
    task_id: str, serving: Callable[..., str], request: pytest.FixtureRequest
) -> None:
    # The checker makes the environment again and again, each time with a server; the other tasks' are programs.
    at = {} if request.node.get_closest_marker("long") else {"address": serving("arm", step_mode="auto")}
    env = gymnasium.make(task_id, render_mode="rgb_array", **at)
    with without_advice():
        check_env(env.unwrapped)
    env.close()
    with pytest.raises(urlab_client.ClientClosed):
        env.reset()


@pytest.mark.parametrize("task_id", sorted(TASKS))
def test_a_registered_tasks_specification_can_be_stored_and_made_again(task_id: str) -> None:
    spec = gymnasium.spec(task_id)
    stored = EnvSpec.from_json(spec.to_json())
    assert stored == spec
    assert callable(load_env_creator(str(stored.entry_point)))
    assert callable(load_env_creator(str(stored.vector_entry_point)))


def test_gymnasium_decides_how_long_the_episodes_of_a_registered_task_are(serving: Callable[..., str]) -> None:
    at = serving("arm")
    for given, steps in (({"address": at}, 100), ({"address": at, "max_episode_steps": 102}, 102)):
        with closing(gymnasium.make("urlab/Reach-v0", **given)) as env:
            env.reset(seed=0)
            ends = [env.step(np.zeros(7, dtype=np.float32))[2:4] for _ in range(steps)]
        assert ends[-1][1]
        assert not any(truncated for _, truncated in ends[:-1])


def test_a_reset_sets_the_set_points_to_zero(make_env: MakeEnv) -> None:
    env = make_env()
    env.reset(seed=0)
    env.step(env.action_space.high)
    env.reset(seed=0)
    for articulation in env.client.articulations.values():
        assert not articulation.ctrl_array.any()
    env.client.step()  # by somebody who does without actions
    for articulation in env.client.articulations.values():
        assert not articulation.last_applied_ctrl.any()


def test_flat_and_dict_hold_the_same_values_in_the_documented_order(make_env: MakeEnv) -> None:
    flat = make_env()
    a, _ = flat.reset(seed=0)
    nested = make_env(space_mode="dict")
    b, _ = nested.reset(seed=0)
    in_order = [b[key][field] for key in flat.mapping.keys for field in flat.mapping.fields]
    assert np.array_equal(a, np.concatenate(in_order))
    for key in flat.mapping.keys:
        for field in flat.mapping.fields:
            assert np.array_equal(flat.mapping.field(a, key, field), nested.mapping.field(b, key, field))
    client = nested.client
    for key in client.articulations:
        assert np.array_equal(b[key]["qpos"], client.articulations[key].qpos_array)
        readings = client.articulations[key].get_sensors().values()
        assert np.array_equal(b[key]["sensors"], np.concatenate(list(readings)))


def test_the_bounds_of_actions_are_the_actuators_ctrlranges(make_env: MakeEnv) -> None:
    env = make_env(space_mode="dict")
    for key, articulation in env.client.articulations.items():
        ranges = np.array([actuator.ctrlrange for actuator in articulation.actuators.values()], dtype=np.float32)
        box = env.action_space[key]  # type: ignore[index]  # a Dict
        assert np.array_equal(box.low, ranges[:, 0])
        assert np.array_equal(box.high, ranges[:, 1])


def test_the_same_seed_and_actions_give_the_same_rollout_bit_for_bit(make_env: MakeEnv) -> None:
    env = make_env(n_substeps=3, reset_noise=0.1)

    def rollout(seed: int) -> list[Any]:
        rng = np.random.default_rng(0)
        actions = rng.uniform(-1, 1, (20, *env.action_space.shape))
        return [env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)]

    first, again, other = rollout(7), rollout(7), rollout(8)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_an_action_lasts_for_its_substeps_and_info_tells_the_clocks(make_env: MakeEnv) -> None:
    env = make_env(n_substeps=5)
    env.reset(seed=1)
    *_, info = env.step(np.zeros(env.action_space.shape))
    timestep = env.client.model.opt.timestep  # type: ignore[union-attr]
    assert info["step_count"] == 5
    assert info["sim_time"] == pytest.approx(5 * timestep)
    assert set(env.articulations) == {"quadruped", "arm"}
    assert set(env.articulations) <= set(env.entities)


def test_what_an_environment_tells_can_be_copied_and_sent_to_another_process(make_env: MakeEnv) -> None:
    env = make_env()
    _, info = env.reset(seed=1)
    *_, stepped = env.step(np.zeros(env.action_space.shape))
    for told in (info, stepped):
        assert copy.deepcopy(told) == told
        assert pickle.loads(pickle.dumps(told)) == told


def test_rewards_terminations_and_truncation_come_from_the_users_functions(make_env: MakeEnv) -> None:
    seen: list[tuple[Any, ...]] = []

    def reward(before: Any, action: Any, after: Any, info: dict[str, Any]) -> float:
        seen.append((before, action, after))
        return info["step_count"]

    env = make_env(reward_fn=reward, termination_fn=lambda after, info: info["step_count"] >= 3, max_episode_steps=2)
    start, _ = env.reset(seed=0)
    action = np.zeros(env.action_space.shape)
    first = env.step(action)
    assert first[1:4] == (1.0, False, False)
    assert np.array_equal(seen[0][0], start)
    assert np.array_equal(seen[0][2], first[0])
    assert env.step(action)[1:4] == (2.0, False, True)
    assert env.step(action)[1:4] == (3.0, True, True)
    env.reward_fn, env.termination_fn = lambda *_: 7.0, None
    assert env.step(action)[1:4] == (7.0, False, True)


def test_a_reset_can_start_from_a_keyframe(make_env: MakeEnv) -> None:
    env = make_env(space_mode="dict")
    observation, _ = env.reset(options={"keyframe": "quadruped_home"})
    assert observation["quadruped"]["qpos"][2] == pytest.approx(0.3038)


@pytest.mark.opengl
def test_pictures_show_the_state_and_leave_physics_alone(make_env: MakeEnv) -> None:
    actions = [{"quadruped": np.zeros(12), "arm": np.full(7, 0.04)}] * 30

    def rollout(env: URLabEnv) -> list[Any]:
        return [env.reset(seed=2)[0], *(env.step(action)[0] for action in actions)]

    plain = rollout(make_env(space_mode="dict"))
    seeing = make_env(space_mode="dict", cameras=["quadruped/side"], render_mode="rgb_array", render_camera="arm/wrist")
    start, _ = seeing.reset(seed=2)
    assert start["cameras"]["quadruped/side"].shape == (48, 64, 3)
    assert seeing.observation_space.contains(start)
    first = seeing.render()
    assert first is not None
    assert first.shape == (48, 64, 3)
    assert first.std() > 0
    for ours, theirs in zip(rollout(seeing), plain, strict=True):
        for key in ("quadruped", "arm"):
            assert all(np.array_equal(ours[key][field], theirs[key][field]) for field in seeing.mapping.fields)
    last = seeing.render()
    assert last is not None
    assert not np.array_equal(first, last)


@pytest.mark.opengl
def test_pictures_of_depths_and_segmentations_are_rendered_as_colours() -> None:
    modes = {"arm/wrist": "depth", "arm/overview": "semantic"}
    with SimulatedServer("arm", play=True, camera_size=(16, 12), camera_modes=modes) as server:
        pictures: dict[str, Any] = {}
        frames: dict[str, Any] = {}
        for camera in modes:
            with urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client:
                client.discover()
                env = URLabEnv(
                    client, space_mode="dict", cameras=[camera], render_mode="rgb_array", render_camera=camera
                )
                frames[camera] = env.reset(seed=0)[0]["cameras"][camera]
                pictures[camera] = env.render()
    assert all((picture.shape, picture.dtype) == ((12, 16, 3), np.uint8) for picture in pictures.values())
    depth, grey = frames["arm/wrist"], pictures["arm/wrist"]
    assert grey[depth == depth.min()].min() == 255, "near is bright"
    assert grey[depth == depth.max()].max() == 0
    assert np.array_equal(grey[..., 0], grey[..., 2])
    assert np.array_equal(pictures["arm/overview"], frames["arm/overview"][..., 2::-1]), "these are blue first"


def test_each_observation_is_the_users_to_keep(make_env: MakeEnv) -> None:
    env = make_env()
    first, _ = env.reset(seed=0)
    kept = first.copy()
    env.step(np.ones(env.action_space.shape))
    assert np.array_equal(first, kept)


@pytest.mark.parametrize(
    ("action", "reason"),
    [
        (np.zeros(3), "last axis must be 19 long"),
        (np.full(19, np.nan), "NaN"),
        (1.0, "last axis"),
    ],
)
def test_an_action_that_does_not_fit_is_refused_before_anything_moves(
    make_env: MakeEnv, action: Any, reason: str
) -> None:
    env = make_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=reason):
        env.step(action)
    *_, info = env.step(np.zeros(19))
    assert info["step_count"] == 1


@pytest.mark.parametrize(
    ("options", "error", "reason"),
    [
        ({"observations": "full"}, ValueError, "'minimal' or 'standard'"),
        ({"observations": ["qpos", "heat"]}, ValueError, "qpos, qvel, ctrl"),
        ({"observations": []}, ValueError, "one or more"),
        ({"space_mode": "tree"}, ValueError, "'flat' or 'dict'"),
        ({"n_substeps": 0}, ValueError, "at least 1"),
        ({"reset_noise": -1.0}, ValueError, "0 or more"),
        ({"max_episode_steps": 0}, ValueError, "at least 1"),
        ({"render_mode": "human"}, ValueError, "rgb_array"),
        ({"cameras": ["quadruped/side"]}, ValueError, "space_mode='dict'"),
        ({"cameras": ["quadruped/tail"], "space_mode": "dict"}, KeyError, "tail"),
        ({"step_mode": "live"}, urlab_client.URLabError, "step_mode='direct'"),
    ],
)
def test_a_wrong_option_says_what_would_be_right(
    make_env: MakeEnv, options: dict[str, Any], error: type[Exception], reason: str
) -> None:
    with pytest.raises(error, match=reason):
        make_env(**options)


def test_stepping_or_drawing_before_a_reset_says_so(make_env: MakeEnv) -> None:
    env = make_env(render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(19))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    with pytest.warns(UserWarning, match="without a render mode"):
        assert make_env().render() is None
    with pytest.raises(ValueError, match="the only option is 'keyframe'"):
        env.reset(options={"key": "home"})


def test_a_client_before_discover_is_refused(server: SimulatedServer) -> None:
    with (
        urlab_client.URLabClient(**server.client_options()) as client,
        pytest.raises(urlab_client.URLabError, match="discover"),
    ):
        URLabEnv(client)


def test_a_mapping_takes_batches(make_env: MakeEnv) -> None:
    mapping: SpaceMapping = make_env().mapping
    found = mapping.set_points(np.arange(38.0).reshape(2, 19))
    assert np.array_equal(found["quadruped"], [np.arange(12.0), np.arange(19.0, 31.0)])
    assert found["arm"].shape == (2, 7)


def test_noise_at_a_reset_stays_within_the_joints_ranges_and_knows_metres_from_radians(make_env: MakeEnv) -> None:
    hinges = make_env(reset_noise=3.0)
    model, layout = hinges.client.model, hinges.mapping.layout("arm")
    assert model is not None
    ranges = {name: model.jnt_range[i] for name, i in layout.joints.items()}
    rest = {name: model.qpos0[model.jnt_qposadr[i]] for name, i in layout.joints.items()}
    slides = [name for name, i in layout.joints.items() if model.jnt_type[i] == 2]
    assert len(slides) == 2
    moved = set()
    for seed in range(5):
        hinges.reset(seed=seed)
        for name, position in hinges.articulations["arm"].get_qpos().items():
            low, high = ranges[name]
            assert low <= position <= high, name
            assert bool(position == rest[name]) == (name in slides)
    both = make_env(reset_noise=ResetNoise(hinge=0.1, slide=0.01))
    for seed in range(5):
        both.reset(seed=seed)
        positions = both.articulations["arm"].get_qpos()
        moved |= {name for name in slides if positions[name] != rest[name]}
        assert all(abs(positions[name] - rest[name]) <= (0.01 if name in slides else 0.1) for name in positions)
        assert all(ranges[name][0] <= positions[name] <= ranges[name][1] for name in slides)
    assert moved == set(slides)
    with pytest.raises(ValueError, match="reset_noise must be 0 or more, not -1 for slide"):
        ResetNoise(slide=-1)


@pytest.mark.opengl
def test_an_observed_picture_is_what_render_returns(make_env: MakeEnv) -> None:
    camera = "quadruped/side"
    env = make_env(space_mode="dict", cameras=[camera], render_mode="rgb_array", render_camera=camera)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert np.array_equal(observation["cameras"][camera], env.render())


def test_a_keyframe_of_the_constructor_is_where_episodes_start(make_env: MakeEnv) -> None:
    env = make_env(keyframe="arm_home")
    for options in (None, {"keyframe": "arm_home"}):
        env.reset(options=options)
        assert env.articulations["arm"].get_qpos()["left_finger"] == pytest.approx(0.04)


@pytest.mark.skipif(sys.platform != "linux", reason="/dev/shm is Linux's")
def test_a_server_of_its_own_is_stepped_over_shared_memory_if_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    def requests(**options: Any) -> tuple[int, dict[str, int]]:
        with closing(URLabEnv.connect("sim://arm", observations=["qpos"], **options)) as env:
            env.reset(seed=0)
            action = np.full(7, 0.1, dtype=np.float32)
            seen.append([env.step(action)[0] for _ in range(3)])
            stats = env.client.transport_stats
            return stats.over_shm, dict(stats.over_zmq)

    seen: list[Any] = []
    room = shutil.disk_usage("/")._replace(free=64 << 20)
    monkeypatch.setattr("shutil.disk_usage", lambda path: room)
    shared, _ = requests()
    assert shared >= 3
    assert requests(client_options={"transport": "zmq"})[0] == 0
    room = room._replace(free=(64 << 20) - 1)
    assert requests()[0] == 0
    assert all(np.array_equal(seen[0], other) for other in seen[1:])
