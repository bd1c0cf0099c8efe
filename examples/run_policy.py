"""The trained quadruped walks, turns and side-steps on command. Plots frames of the walk, its path and the training."""

import asyncio
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from urlab_client.aio import URLabClient
from urlab_client.integrations.policy import PolicyRun, load, run
from urlab_client.integrations.record import read_run, record

NETWORK = Path(__file__).parent / "policies/quadruped.onnx"
COMMANDS = {  # start time in seconds: vx, vy (m/s), yaw rate (rad/s)
    0.0: (0.5, 0.0, 0.0),
    4.0: (0.4, 0.0, 0.5),
    8.0: (0.3, 0.15, 0.0),
}


async def walk(recording: Path) -> tuple[PolicyRun, np.ndarray]:
    """Walk for twelve seconds; return the result and the path of the base."""
    policy = load(NETWORK)
    way = []
    async with URLabClient("sim://quadruped?controller=quadruped=pd&camera-size=320x240", step_mode="direct") as client:
        await client.discover()
        robot = client.articulations["quadruped"]

        def steer(so_far: PolicyRun) -> None:
            way.append(robot.root_pos_w[:2].copy())
            policy.command = [values for start, values in COMMANDS.items() if so_far.sim_time >= start][-1]

        policy.command = COMMANDS[0.0]
        async with record(client, recording, cameras=["quadruped/side"], camera_hz=0.5, overwrite=True):
            found = await run(client, policy, seconds=12.0, on_action=steer)
    return found, np.array(way)


found, way = asyncio.run(walk(Path("walk.mcap")))
print(f"{found.forward:.2f} m forward in {found.sim_time:.1f} s, {found.falls} falls, mean reward {found.reward:.2f}")

frames = [frame.pixels for frame in read_run("walk.mcap").frames("quadruped/side")][:6]
learned = json.loads(NETWORK.with_suffix(".json").read_text())
figure = plt.figure(figsize=(11, 4.6), layout="constrained")
above, below = figure.subfigures(2, 1, height_ratios=[1, 1.8])
for second, frame, axes in zip(range(0, 12, 2), frames, above.subplots(1, len(frames)), strict=True):
    axes.imshow(frame)
    axes.set_title(f"{second} s", fontsize=9)
    axes.axis("off")
path, curve = below.subplots(1, 2)
path.plot(*way.T)
for start in COMMANDS:
    point = way[int(start * 50)]
    path.plot(*point, "o", color="C1")
    path.annotate(f"{start:.0f} s", point, xytext=(6, -12), textcoords="offset points")
path.set(xlabel="x (m)", ylabel="y (m)", title="path of the base", aspect="equal", adjustable="datalim")
curve.plot([row["iteration"] for row in learned["curve"]], [row["reward"] for row in learned["curve"]], label="trained")
for name, style in (("zero", "--"), ("random", ":")):
    curve.axhline(np.mean([row["reward"] for row in learned["evaluation"][name]]), color="grey", ls=style, label=name)
curve.set(xlabel="iteration", ylabel="mean reward", title="learning")
curve.legend()
figure.savefig("policy.png", dpi=110)
