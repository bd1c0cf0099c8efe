"""Evaluates networks of `examples/train_walk.py`, on a batch and over the wire, and draws how they learned and walk.

    pip install -e '.[gym,onnx,mcap,demo]'
    python tools/walk_figures.py RUN...  # folders of trainings; the first gives examples/policies/walk.*
    python tools/walk_figures.py         # docs/images/walk.png, of these

Everything walks in the same episodes of `urlab/Walk-v0`, none of them seen in training, with friction, masses, damping,
strength and starts that vary. The trot that `urlab demo` shows takes strides that suit the command, and keeps its own
gains.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import matplotlib as mpl
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from urlab_client.aio import URLabClient
from urlab_client.cli.demo import Trot
from urlab_client.integrations.gym import States, URLabBatchEnv, URLabVectorEnv, Walk
from urlab_client.integrations.policy import OnnxNetwork, evaluate_in, load, run
from urlab_client.integrations.record import read_run, record
from urlab_client.randomise.declaration import MODEST

mpl.use("agg")
import matplotlib.pyplot as plt  # after the backend was chosen

__all__ = ["main"]

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "examples/policies/walk.onnx"
PICTURE = ROOT / "docs/images/walk.png"
SINE, COMMAND = 45, slice(47, 50)  # in an observation of the task: of the stride's phase, and of the command
COMMAND_SCALE = 3.0
TRACK_M = 0.155  # from the middle to a foot
THEIR_GAINS = Walk.scene_address.replace("kp=60,kv=2", f"kp={Trot.KP:g},kv={Trot.KD:g}")
ROUTE = {0.0: (0.0, 0.0, 0.0), 2.0: (0.4, 0.0, 0.0), 5.0: (0.8, 0.0, 0.0), 8.0: (0.4, 0.0, 0.5), 11.0: (-0.3, 0.0, 0.0)}
"""Commands by the second from which they hold: vx, vy (m/s), yaw rate (rad/s)."""
SECONDS = 14.0
FRAMES_HZ = 8.0

Floats = NDArray[np.float64]
Act = Callable[[Any], Floats]
"""One observation of the task, shape (50,), to an action, shape (12,)."""


class Noted(Walk):
    """Walking, with a note of each episode: its return, its mean velocity error in m/s, and whether the robot fell."""

    memory: ClassVar[Any] = {**Walk.memory, "error": ()}

    def __init__(self) -> None:
        self.episodes: list[tuple[float, float, bool]] = []
        self._errors: dict[int, float] = {}

    def update(self, states: States) -> None:
        """See `Task.update`."""
        super().update(states)
        wrong = states.memory["velocity"] - states.goal["command"]
        error = states.memory["error"]
        error += np.linalg.norm(wrong[:, :2], axis=1)
        self._errors.update(zip(states.index.tolist(), error.tolist(), strict=True))

    def ended(self, episode: Any) -> None:
        """See `Task.ended`."""
        self.episodes.append((episode.total, self._errors[episode.index] / episode.steps, episode.terminated))


def still(_: Any) -> Floats:
    """Return the action that stands."""
    return np.zeros(12)


def trot(observation: Any) -> Floats:
    """Return the action of the trot that `urlab demo` shows, with strides that suit the command."""
    phase = math.atan2(observation[SINE], observation[SINE + 1]) / (2.0 * math.pi)
    ahead, _, turn = observation[COMMAND] / COMMAND_SCALE
    strides = Trot.ON_GROUND / Trot.STRIDES_PER_S * (ahead + TRACK_M * turn * Trot.SIDES)
    lift = 1.0 if observation[COMMAND].any() else 0.0
    return Trot.angles(phase / Trot.STRIDES_PER_S, strides, lift) / np.tile([0.3, 0.6, 0.8], 4)


def evaluate(
    act: Act, address: str | list[str] = Walk.scene_address, *, servers: int = 0, episodes: int = 100, **options: Any
) -> dict[str, Any]:
    """Return how well something walks, on a batch, or on servers: several that are started, or those of a list."""
    task = Noted()
    common: dict[str, Any] = {"task": task, "randomise": MODEST, "autoreset_mode": AutoresetMode.DISABLED, **options}
    if isinstance(address, str) and not servers:
        env: Any = URLabBatchEnv(address, min(episodes, 100), n_threads=1, **common)
    else:
        env = URLabVectorEnv(address, servers or None, **common)
    try:
        found = evaluate_in(env, act, episodes=episodes)
    finally:
        env.close()
    total, error, fell = np.mean(task.episodes, axis=0).tolist()
    success = found.success_rate
    return {
        "episodes": episodes,
        "error": round(error, 3),
        "falls": round(fell * episodes),
        "return": round(total, 1),
        "success": None if success is None else round(success.value, 2),
    }


async def walk(network: Path, recording: Path) -> tuple[Floats, Floats]:
    """Walk the route on a server, recorded; return the times, and the forward velocity and yaw rate, shape (n, 2)."""
    policy, times, moved = load(network), list[float](), list[Any]()
    async with URLabClient(f"{Walk.scene_address}&camera-size=320x240", step_mode="direct") as client:
        await client.discover()
        robot = client.articulations["quadruped"]

        def steer(so_far: Any) -> None:
            times.append(so_far.sim_time)
            w, _, _, z = robot.root_quat_w
            heading = 2.0 * math.atan2(z, w)
            velocity = robot.qvel_array
            ahead = velocity[0] * math.cos(heading) + velocity[1] * math.sin(heading)
            moved.append([ahead, velocity[5]])
            policy.command = [values for start, values in ROUTE.items() if so_far.sim_time >= start][-1]

        policy.command = ROUTE[0.0]
        async with record(client, recording, cameras=["quadruped/side"], camera_hz=FRAMES_HZ, overwrite=True):
            await run(client, policy, seconds=SECONDS, on_action=steer)
    return np.array(times), np.array(moved)


async def draw(figures: dict[str, Any]) -> None:
    """Draw frames of a walk, how all trainings learned, and how the network follows its commands."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "walk.mcap"
        times, moved = await walk(SHIPPED, recording)
        frames = [frame.pixels for frame in read_run(recording).frames("quadruped/side")]
    figure: Any = plt.figure(figsize=(11, 4.8), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[1, 1.8])
    shown = (3.0, 4.25, 6.0, 7.125, 9.25, 12.0)
    for second, axes in zip(shown, above.subplots(1, len(shown)), strict=True):
        axes.imshow(frames[round(second * FRAMES_HZ)])
        axes.set_title(f"{second:.1f} s", fontsize=9)
        axes.axis("off")
    learning, following = below.subplots(1, 2)
    for curve in figures["curves"]:
        learning.plot([row["steps"] / 1e6 for row in curve], [row["reward"] for row in curve], color="C0", lw=0.8)
    learning.plot([], [], color="C0", lw=0.8, label=f"PPO while it explores, {len(figures['curves'])} seeds")
    for name, label, style in (("trot", "hand-written trot", "--"), ("zero", "zero output", ":")):
        mean = figures["evaluation"][name]["return"] / (Walk.max_episode_steps or 1)
        learning.axhline(mean, color="grey", ls=style, label=label)
    learning.set(xlabel="environment steps (millions)", ylabel="reward per action", title="learning")
    learning.legend(frameon=False, fontsize=8)
    padded = np.pad(moved, ((12, 12), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(column, np.full(25, 0.04), mode="valid") for column in padded.T], axis=1)  # a stride
    starts = [*ROUTE, SECONDS]
    for column, (index, name) in enumerate(((0, "forward (m/s)"), (2, "turning (rad/s)"))):
        following.plot(times, smooth[:, column], color=f"C{column}", label=name)
        for (begin, command), end in zip(ROUTE.items(), starts[1:], strict=True):
            following.plot([begin, end], [command[index]] * 2, color=f"C{column}", ls="--", lw=1)
    following.set(xlabel="s", title="following commands (dashed)")
    following.legend(frameon=False, fontsize=8)
    figure.savefig(PICTURE, dpi=110)


def assess(runs: Sequence[Path], servers: int, episodes: int) -> None:
    """Evaluate trainings and what they are to beat; copy the first network, and write the figures beside it."""
    found = {"zero": evaluate(still, episodes=episodes), "trot": evaluate(trot, THEIR_GAINS, episodes=episodes)}
    print(json.dumps(found), flush=True)
    trained: list[dict[str, Any]] = []
    for folder in runs:
        trained.append(evaluate(OnnxNetwork(folder / "walk.onnx"), episodes=episodes))
        print(folder, json.dumps(trained[-1]), flush=True)
    for suffix in (".onnx", ".toml"):
        shutil.copyfile((runs[0] / "walk.onnx").with_suffix(suffix), SHIPPED.with_suffix(suffix))
    for dialect in ("alpha", "beta"):
        address = f"{Walk.scene_address}&dialect={dialect}"
        found[dialect] = evaluate(OnnxNetwork(SHIPPED), address, servers=servers, episodes=episodes)
        print(dialect, json.dumps(found[dialect]), flush=True)
    records = [json.loads((folder / "walk.json").read_text()) for folder in runs]
    curves = [
        [{name: row[name] for name in ("steps", "minutes", "reward")} for row in each["curve"]] for each in records
    ]
    figures = {"options": records[0]["options"], "evaluation": found, "seeds": trained, "curves": curves}
    SHIPPED.with_suffix(".json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def main(argv: Sequence[str] | None = None) -> int:
    """Evaluate or draw; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path, metavar="DIR", help="folders that train_walk.py wrote")
    parser.add_argument("--episodes", type=int, default=100, help="of each (default: %(default)s)")
    parser.add_argument("--servers", type=int, default=4, help="for the episodes over the wire (default: %(default)s)")
    arguments = parser.parse_args(argv)
    if arguments.runs:
        assess(arguments.runs, arguments.servers, arguments.episodes)
    else:
        asyncio.run(draw(json.loads(SHIPPED.with_suffix(".json").read_text())))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
