"""Drives the environments with the learning libraries that users bring: Stable-Baselines3, RLlib, LeRobot and others.

    pip install stable-baselines3 rsl-rl-lib onnx onnxruntime 'ray[rllib]' mujoco-warp mujoco-mjx 'minari[create,hdf5]'
    python tools/check_learning.py            # or the names of some checks
    python tools/check_learning.py lerobot envhub --lerobot-python ENVIRONMENT/bin/python

The libraries are too large for the suite. The suite asserts what they need without them; this says whether they agree.
It prints a line for each check and exits with 1 when one failed.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import urlab_client.integrations.gym  # registers the environments  # noqa: F401
from urlab_client.integrations.record import read_run, record
from urlab_client.integrations.record.export import write_lerobot

__all__ = ["main"]

ARM = "urlab/Arm-v0"


def sb3_check_env() -> str:
    """Stable-Baselines3's own checker finds nothing to refuse."""
    check_env: Any = import_module("stable_baselines3.common.env_checker").check_env
    cases: list[dict[str, Any]] = [{}, {"space_mode": "dict"}, {"space_mode": "dict", "cameras": ["arm/wrist"]}]
    for options in cases:
        env: Any = gymnasium.make(ARM, **options)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # advice: normalised spaces, flat ones
            if options:
                env = gymnasium.wrappers.FlattenObservation(env)
            check_env(env, skip_render_check=True)
        env.close()
    return "flat, dict and camera observations"


def sb3_ppo() -> str:
    """`PPO("MlpPolicy", "urlab/Arm-v0")` learns for a moment, is saved, loaded and predicts the same."""
    ppo: Any = import_module("stable_baselines3").PPO
    model = ppo("MlpPolicy", ARM, n_steps=128, batch_size=64, n_epochs=2, seed=1, device="cpu")
    model.learn(256)
    observation = model.get_env().reset()
    action, _ = model.predict(observation, deterministic=True)
    model.get_env().close()
    if action.shape != (1, 7):
        raise AssertionError(action.shape)
    return "256 steps"


def sb3_batch() -> str:
    """PPO on a batch of 16 through `Sb3VecEnv`: it learns for a moment, and its ends carry the last observation."""
    sb3: Any = import_module("urlab_client.integrations.gym.sb3")
    ppo: Any = import_module("stable_baselines3").PPO
    modes: Any = import_module("gymnasium.vector").AutoresetMode
    batch = gymnasium.make_vec("urlab/Reach-v0", num_envs=16, backend="batch", autoreset_mode=modes.SAME_STEP)
    monitor: Any = import_module("stable_baselines3.common.vec_env").VecMonitor
    envs = monitor(sb3.Sb3VecEnv(batch))
    model = ppo("MlpPolicy", envs, n_steps=110, batch_size=440, n_epochs=2, seed=1, device="cpu")
    model.learn(16 * 110)
    lengths = {int(episode["l"]) for episode in model.ep_info_buffer}
    model.get_env().close()
    if lengths != {100}:
        raise AssertionError(f"episodes of {lengths} actions")
    return f"{model.num_timesteps} steps, {len(model.ep_info_buffer)} episodes of 100 actions"


def sb3_pictures() -> str:
    """PPO with a `CnnPolicy` learns from pictures alone: the example halves its distance from the ball."""
    example = Path(__file__).parents[1] / "examples/learn_by_sight.py"
    done = subprocess.run([sys.executable, example], capture_output=True, text=True, check=False)  # noqa: S603 - ours
    found = re.search(r"ball: (\S+) m before, (\S+) m after", done.stdout)
    if done.returncode or found is None:
        raise AssertionError(done.stderr)
    before, after = map(float, found.groups())
    if after > before / 2:
        raise AssertionError(done.stdout)
    return done.stdout.strip()


def export() -> str:
    """Models of Stable-Baselines3 become files that act like them: the export itself compares them in episodes."""
    sb3: Any = import_module("urlab_client.integrations.gym.sb3")
    library, wrappers = import_module("stable_baselines3"), import_module("stable_baselines3.common.vec_env")
    policy: Any = import_module("urlab_client.integrations.policy")
    made: list[str] = []

    def train(name: str, wrap: Callable[[Any], Any], task: str, steps: int, **options: Any) -> None:
        modes: Any = import_module("gymnasium.vector").AutoresetMode
        batch = gymnasium.make_vec(task, num_envs=4, backend="batch", autoreset_mode=modes.SAME_STEP)
        envs = wrap(batch)
        model = getattr(library, name)(
            "MlpPolicy", envs, seed=1, device="cpu", **copy.deepcopy(options)
        )  # it adds some
        model.learn(steps)
        with tempfile.TemporaryDirectory() as folder:
            spec = policy.export_policy(model, task, Path(folder) / "policy.onnx")
        made.append(f"{name} {task} (history {spec.history})" if spec.history > 1 else f"{name} {task}")
        envs.close()

    def stacked(batch: Any) -> Any:
        return wrappers.VecFrameStack(wrappers.VecNormalize(sb3.Sb3VecEnv(batch)), 3)

    def rescaled(batch: Any) -> Any:
        return import_module("gymnasium.wrappers.vector").RescaleAction(batch, np.float32(-1.0), np.float32(1.0))

    small: dict[str, Any] = {"learning_starts": 10, "policy_kwargs": {"net_arch": [32, 32]}}
    train("PPO", stacked, "urlab/Walk-v0", 256, n_steps=32)
    train("PPO", lambda batch: sb3.Sb3VecEnv(rescaled(batch)), "urlab/Reach-v0", 256, n_steps=32)
    train("A2C", sb3.Sb3VecEnv, "urlab/Quadruped-v0", 60, use_sde=True, policy_kwargs={"squash_output": True})
    train("SAC", lambda batch: wrappers.VecNormalize(sb3.Sb3VecEnv(batch)), "urlab/Push-v0", 60, **small)
    train("TD3", sb3.Sb3VecEnv, "urlab/Arm-v0", 60, **small)
    return ", ".join(made)


def rsl_rl() -> str:
    """RSL-RL's runner trains on a batch of 16, with staggered ends and rescaled actions, and becomes a file."""
    adapter: Any = import_module("urlab_client.integrations.gym.rsl_rl")
    policy: Any = import_module("urlab_client.integrations.policy")
    modes: Any = import_module("gymnasium.vector").AutoresetMode
    batch = gymnasium.make_vec("urlab/Reach-v0", num_envs=16, backend="batch", autoreset_mode=modes.SAME_STEP)
    rescaled = gymnasium.wrappers.vector.RescaleAction(batch, np.float32(-1.0), np.float32(1.0))
    envs = adapter.RslRlVecEnv(rescaled)
    layers: dict[str, Any] = {"class_name": "MLPModel", "hidden_dims": [64, 64], "obs_normalization": True}
    gaussian = {"class_name": "HeteroscedasticGaussianDistribution", "init_std": 0.3}
    settings: dict[str, Any] = {
        "num_steps_per_env": 50,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "algorithm": {"class_name": "PPO", "gamma": 0.97},
        "actor": {**layers, "distribution_cfg": gaussian},
        "critic": {**layers},
    }
    with contextlib.redirect_stdout(io.StringIO()):
        runner = import_module("rsl_rl.runners").OnPolicyRunner(envs, settings, device="cpu")
        runner.learn(4, init_at_random_ep_len=True)
    lengths = envs.episode_length_buf.tolist()
    if len(set(lengths)) == 1 or not max(lengths) < envs.max_episode_length:
        raise AssertionError(f"the episodes' ends are not staggered: {lengths}")
    with tempfile.TemporaryDirectory() as folder:
        policy.export_policy(runner, "urlab/Reach-v0", Path(folder) / "reach.onnx")
        network = policy.OnnxNetwork(Path(folder) / "reach.onnx")
    seen, space = envs.get_observations(), batch.single_action_space
    acted = runner.get_inference_policy(device="cpu")(seen).detach().numpy()
    expected = np.clip(rescaled.actions(acted)[0], space.low, space.high)
    if not np.allclose(network(seen["policy"][0].numpy()), expected, atol=1e-4):
        raise AssertionError("the file gives other actions than training")
    envs.close()
    return f"{runner.current_learning_iteration + 1} iterations of {16 * 50} steps, exported"


def single_file() -> str:
    """The PPO of the examples, which needs PyTorch alone, runs for a moment and writes a file that can be evaluated."""
    example = Path(__file__).parents[1] / "examples/ppo.py"
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(  # noqa: S603 - ours
            [sys.executable, example, "--steps=9600"], cwd=folder, capture_output=True, text=True, check=True
        )
        command = [sys.executable, "-m", "urlab_client", "evaluate", "reach.toml", "--episodes=10", "--json"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)  # noqa: S603 - ours
    return f"exported; mean return of 10 episodes {json.loads(done.stdout)['mean_return']['value']:.1f}"


def walk() -> str:
    """The example's PPO walks better after fifteen updates than after one."""
    example = Path(__file__).parents[1] / "examples/train_walk.py"
    with tempfile.TemporaryDirectory() as folder:
        options = ["--steps", "48000", "--threads", "1", "--report", "0", "--episodes", "4", "-o", folder]
        subprocess.run([sys.executable, example, *options], check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - ours
        curve = json.loads((Path(folder) / "walk.json").read_text())["curve"]
    first, *_, last = (row["reward"] for row in curve)
    if last < first + 0.05:
        raise AssertionError(f"a reward of {first} became {last}")
    return f"a reward per action of {first} became {last}"


def warp() -> str:
    """MuJoCo Warp steps a batch: the same spaces, resets with the same bits, steps as near as float32 allows."""
    worst = 0.0
    for name in ("urlab/Reach-v0", "urlab/Walk-v0"):
        ours, plain = (
            gymnasium.make_vec(name, num_envs=3, backend="batch", max_episode_steps=5, engine=engine)
            for engine in ("warp", "mujoco")
        )
        if (ours.observation_space, ours.action_space) != (plain.observation_space, plain.action_space):
            raise AssertionError("other spaces")
        if not np.array_equal(ours.reset(seed=1)[0], plain.reset(seed=1)[0]):
            raise AssertionError("the resets differ")
        action = 0.2 * plain.action_space.sample()
        for step in range(7):
            seen, expected = ours.step(action), plain.step(action)
            error = float(np.abs(seen[0] - expected[0]).max())
            if error > (0.0 if step == 5 else 1e-2):
                raise AssertionError(f"{name}: step {step} differs by {error}")
            worst = max(worst, error)
        ours.close()
        plain.close()
    return f"two tasks, 3 copies: resets equal, 6 steps within {worst:.0e}, on {_warp_device()}"


def _warp_device() -> str:
    return str(import_module("warp").get_device())


def mjx() -> str:
    """MJX takes the scene of a batch, and the positions of its resets, and steps them as MuJoCo does."""
    jax: Any = import_module("jax")
    library: Any = import_module("mujoco.mjx")
    batch: Any = gymnasium.make_vec("urlab/Quadruped-v0", num_envs=2, backend="batch", n_substeps=1)
    observation, _ = batch.reset(seed=1)
    model = library.put_model(batch.unwrapped.model)
    qpos = observation[:, : batch.unwrapped.model.nq].astype(np.float32)

    @jax.jit
    @jax.vmap
    def stepped(positions: Any) -> Any:
        return library.step(model, library.make_data(model).replace(qpos=positions)).qpos

    expected, *_ = batch.step(0 * batch.action_space.sample())
    error = float(np.abs(np.asarray(stepped(qpos)) - expected[:, : qpos.shape[1]]).max())
    batch.close()
    if error > 1e-4:
        raise AssertionError(f"a step differs by {error}")
    return f"two copies, a step within {error:.0e}, on {jax.devices()[0].platform}"


def minari() -> str:
    """Minari collects what was driven, and loads it again: numbers, and pictures under LeRobot's names."""
    library: Any = import_module("minari")
    envhub: Any = import_module("urlab_client.integrations.gym.envhub")
    rng = np.random.default_rng(1)
    frames = 0
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        pictures: dict[str, Any] = {"space_mode": "dict", "observations": ["qpos"], "cameras": ["arm/wrist"]}
        for number, options in enumerate(({}, pictures)):
            env = gymnasium.make("urlab/Reach-v0", max_episode_steps=20, **options)
            if options:
                env = envhub.ForLeRobot(env, description="reach")
            collector = library.DataCollector(env, record_infos=True, jpeg_encoding=False)  # pictures without loss
            driven: list[tuple[list[Any], list[Any], list[Any]]] = []
            told: list[list[bool]] = []
            for seed in range(2):
                first, info = collector.reset(seed=seed)
                seen: list[Any] = [first]
                actions, rewards, over = [], [], False
                told.append([info["success"]])
                while not over:
                    actions.append(rng.uniform(-0.3, 0.3, 7).astype(np.float32))
                    observation, reward, terminated, truncated, info = collector.step(actions[-1])
                    told[-1].append(info["success"])
                    seen.append(observation)
                    rewards.append(reward)
                    over = terminated or truncated
                driven.append((seen, actions, rewards))
            name = f"urlab/reach-v{number}"
            collector.create_dataset(name, algorithm_name="random", code_permalink="-", author="-", author_email="-")
            collector.close()
            loaded = library.load_dataset(name)
            for episode, (seen, actions, rewards), successes in zip(
                loaded.iterate_episodes(), driven, told, strict=True
            ):
                found = episode.observations
                pairs = [(found, seen), (episode.actions, actions), (episode.rewards, rewards)]
                pairs.append((episode.infos["success"], successes))
                if options:
                    pairs[0] = (found["agent_pos"], [each["agent_pos"] for each in seen])
                    looked = [each["pixels"]["arm.wrist"] for each in seen]
                    pairs.append((found["pixels"]["arm.wrist"], looked))
                for ours, theirs in pairs:
                    if not np.array_equal(ours, np.array(theirs)):
                        raise AssertionError("the dataset differs from what was driven")
                frames += len(rewards)
    return f"{frames} steps of 4 episodes equal what was driven"


def gym_async() -> str:
    """`AsyncVectorEnv` runs two environments in processes of its own, and each equals a single one."""
    envs = gymnasium.make_vec(ARM, num_envs=2, vectorization_mode="async")
    single = gymnasium.make(ARM)
    rng = np.random.default_rng(0)
    observations, infos = envs.reset(seed=3)
    alone, _ = single.reset(seed=4)
    for _ in range(5):
        action = rng.uniform(-0.5, 0.5, envs.action_space.shape).astype(np.float32)
        observations, *_, infos = envs.step(action)
        alone, *_ = single.step(action[1])
    if not np.array_equal(observations[1], alone):
        raise AssertionError("environment 1 differs from a single one with its seed")
    envs.close()
    single.close()
    return f"two processes, sim_time {infos['sim_time'].tolist()}"


def rllib() -> str:
    """RLlib's PPO updates from what two remote runners sample, and its network runs as a policy of `rollouts`."""
    example = Path(__file__).parents[1] / "examples/rllib_reach.py"
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(  # noqa: S603 - ours
            [sys.executable, example, "--iterations", "3"], cwd=folder, capture_output=True, text=True, check=False
        )
    if done.returncode:
        raise AssertionError(done.stderr)
    return done.stdout.strip().splitlines()[-1]


def lerobot(python: str) -> str:
    """LeRobot reads back what was driven: each observation with the action taken at it, its picture and its reward."""
    rng = np.random.default_rng(1)
    driven: list[tuple[int, Any, Any, Any, float, bool]] = []
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        env = gymnasium.make(
            ARM, space_mode="dict", observations=["qpos", "sensors"], cameras=["arm/overview"], n_substeps=10
        )
        client = env.unwrapped.client
        with record(client, work / "run.mcap", cameras=["arm/overview"], camera_hz=50, image_format="png"):
            for episode, steps in enumerate((30, 20)):
                seen, _ = env.reset(seed=episode)
                for step in range(steps):
                    action = {"arm": rng.uniform(-0.3, 0.3, 7).astype(np.float32)}
                    after, reward, *_ = env.step(action)
                    # The second episode is broken off, and no other follows.
                    done = (episode, step) == (0, steps - 1)
                    before = seen["arm"]["qpos"], action["arm"], seen["cameras"]["arm/overview"]
                    driven.append((episode, *before, float(reward), done))
                    seen = after
        env.close()
        run = read_run(work / "run.mcap")
        for video in (True, False):
            folder = work / ("video" if video else "images")
            written = write_lerobot(run, folder, python=python, task="wave", video=video)
            if written != len(driven):
                raise AssertionError(f"{written} frames of {len(driven)} actions")
            subprocess.run([python, "-c", READ_BACK, str(folder), str(work / "back.npz")], check=True)  # noqa: S603
            with np.load(work / "back.npz") as back:
                about = json.loads(str(back["about"]))
                if about["fps"] != 50 or about["robot_type"] != "arm" or set(about["tasks"]) != {"wave"}:
                    raise AssertionError(about)
                for name, column in (("episode", 0), ("state", 1), ("action", 2), ("reward", 4), ("done", 5)):
                    if not np.array_equal(back[name], np.array([row[column] for row in driven], back[name].dtype)):
                        raise AssertionError(f"{name} differs from what was driven")
                pictures = np.array([row[3][..., :3] for row in driven])
                error = np.abs(back["pictures"].astype(int) - pictures).mean(axis=(1, 2, 3))
                if error.max() > (4.0 if video else 0.0):
                    raise AssertionError(f"pictures differ by {error.max():.1f} of 255")
    return f"{len(driven)} frames of 2 episodes equal what was driven, with LeRobot {about['version']}"


def envhub(python: str) -> str:
    """LeRobot loads the example's `env.py` as one from its hub; its evaluation rolls policies out, one with success."""
    file = Path(__file__).parents[1] / "examples/envhub/env.py"
    done = subprocess.run([python, "-c", ROLL_OUT, str(file)], capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise AssertionError(done.stderr)
    return done.stdout.strip().splitlines()[-1]


ROLL_OUT = """
import sys
import mujoco
import numpy as np
import torch
from lerobot import __version__
from lerobot.envs.utils import _call_make_env, _import_hub_module, _normalize_hub_result
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.scripts.lerobot_eval import rollout
from urlab_client.integrations.gym.envhub import vector_env

class Still(PreTrainedPolicy):
    config_class, name = object, "still"
    def __init__(self): torch.nn.Module.__init__(self); self.seen = None
    def reset(self): pass
    def select_action(self, batch): self.seen = batch; return torch.zeros(len(batch["observation.state"]), 7)
    get_optim_params = forward = predict_action_chunk = None

Still.__abstractmethods__ = frozenset()

class Reaching(Still):
    \"\"\"Moves the set-points by the Jacobian of the hand, until that is at the target.\"\"\"
    def __init__(self, envs): super().__init__(); self.envs = envs
    def reset(self): self.set_points = None
    def select_action(self, batch):
        if self.set_points is None: self.set_points = batch["observation.state"].numpy()[:, :7].astype(float)
        for own, env, seen in zip(self.set_points, self.envs, batch["observation.environment_state"].numpy()):
            task, client = env.unwrapped.task, env.unwrapped.client
            jacobian = np.zeros((3, client.model.nv))
            site = task.scene.mapping.id("site", "arm/grip")
            mujoco.mj_jacSite(client.model, client.data, jacobian, None, site)
            jacobian = jacobian[:, :6]
            damped = jacobian @ jacobian.T + 1e-3 * np.eye(3)
            own[:6] += 0.2 * jacobian.T @ np.linalg.solve(damped, seen[3:])
        return torch.tensor(self.set_points, dtype=torch.float32)

if __name__ == "__main__":
    module = _import_hub_module(sys.argv[1], "urlab/push")
    same = lambda x: x
    returns = []
    for asynchronous in (False, True):
        ((suite, tasks),) = _normalize_hub_result(_call_make_env(module, 2, asynchronous, None)).items()
        policy = Still()
        found = rollout(tasks[0], policy, same, same, same, same, seeds=[1, 2])
        tasks[0].close()
        assert found["action"].shape == (2, 150, 7), found["action"].shape
        assert not found["success"].any()
        assert policy.seen["observation.state"].shape == (2, 8)
        assert policy.seen["observation.images.arm.overview"].shape == (2, 3, 72, 96)
        assert policy.seen["task"] == ["push the block to the mark"] * 2
        returns.append(found["reward"].sum(1))
    assert torch.equal(*returns), returns
    envs = vector_env("urlab/Reach-v0", 2, description="hold the hand at the mark", observations=["qpos"])
    found = rollout(envs, Reaching(envs.envs), same, same, same, same, seeds=[1, 2])
    envs.close()
    assert not found["success"][:, 0].any()
    assert found["success"][:, -1].all()
    print(f"two episodes of 150 actions, twice, the same with processes, and two successes, with LeRobot {__version__}")
"""

READ_BACK = """
import json, sys
import numpy as np
from lerobot import __version__
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("local/x", root=sys.argv[1])
rows = [data[i] for i in range(len(data))]
np.savez(
    sys.argv[2],
    episode=np.array([int(row["episode_index"]) for row in rows]),
    state=np.array([row["observation.state"].numpy() for row in rows]),
    action=np.array([row["action"].numpy() for row in rows]),
    reward=np.array([row["next.reward"].item() for row in rows], np.float32),
    done=np.array([row["next.done"].item() for row in rows]),
    pictures=np.array(
        [
            np.rint(row["observation.images.arm.overview"].numpy() * 255).transpose(1, 2, 0).astype(np.uint8)
            for row in rows
        ]
    ),
    about=json.dumps(
        {
            "fps": data.fps,
            "robot_type": data.meta.robot_type,
            "tasks": [row["task"] for row in rows],
            "version": __version__,
        }
    ),
)
"""

CHECKS: dict[str, tuple[str, Callable[[], str]]] = {
    "sb3-check-env": ("stable-baselines3", sb3_check_env),
    "sb3-ppo": ("stable-baselines3", sb3_ppo),
    "sb3-batch": ("stable-baselines3", sb3_batch),
    "sb3-pictures": ("stable-baselines3", sb3_pictures),
    "export": ("stable-baselines3", export),
    "rsl-rl": ("rsl-rl-lib", rsl_rl),
    "single-file": ("torch", single_file),
    "gym-async": ("gymnasium", gym_async),
    "walk": ("torch", walk),
    "warp": ("mujoco-warp", warp),
    "mjx": ("mujoco-mjx", mjx),
    "minari": ("minari", minari),
    "rllib": ("ray", rllib),
}

WITH_LEROBOT: dict[str, Callable[[str], str]] = {"lerobot": lerobot, "envhub": envhub}
"""Checks that call an interpreter which has LeRobot; `envhub` needs this package there, too."""


def main() -> int:
    """Run the checks; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "checks", nargs="*", choices=[[], *WITH_LEROBOT, *CHECKS], help="all without LeRobot by default"
    )
    parser.add_argument("--lerobot-python", metavar="PATH", help="an interpreter that has LeRobot 0.6")
    arguments = parser.parse_args()
    if wanted := WITH_LEROBOT.keys() & set(arguments.checks):
        if arguments.lerobot_python is None:
            parser.error(f"{', '.join(sorted(wanted))}: give --lerobot-python")
        for name in wanted:
            CHECKS[name] = ("urlab-client", partial(WITH_LEROBOT[name], arguments.lerobot_python))
    failed = 0
    for name in arguments.checks or list(CHECKS):
        package, check = CHECKS[name]
        started = time.perf_counter()
        try:
            said = check()
        except Exception:  # noqa: BLE001  # whatever a library makes of it is what is to be seen
            traceback.print_exc()
            said, failed = "FAILED", failed + 1
        print(f"{name:14} {package} {version(package):10} {time.perf_counter() - started:5.1f} s  {said}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
