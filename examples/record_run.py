"""Record a run of the arm with pictures and contacts, read it back, and make a video and a plot from it."""

from pathlib import Path

import numpy as np

from urlab_client import URLabClient
from urlab_client.cli import main as urlab
from urlab_client.integrations.record import export, read_run, record

path = Path("run.mcap")
with URLabClient("sim://arm", step_mode="direct") as client:
    client.discover()
    arm = client.articulations["arm"]
    with record(client, path, cameras=["arm/overview"], camera_hz=10, contacts=True, overwrite=True) as recorder:
        for _ in range(1000):
            phase = 2 * np.pi * client.sim_time
            arm.set_ctrl({"shoulder_pan": 0.6 * np.sin(phase), "shoulder_lift": 0.3 * np.cos(phase / 2), "elbow": 0.5})
            client.step()
    last = arm.qpos_array
print(f"{recorder.stats.states} states, {recorder.stats.frames} pictures, {recorder.stats.dropped_states} dropped")

run = read_run(path)
table = run.table()
print("read back bit for bit:", np.array_equal(table.columns["arm/qpos"].values[-1], last))
print(f"run.mp4 contains {export.write_mp4(run, Path('run.mp4'), 'arm/overview')} pictures")
urlab(["info", str(path)])
urlab(["plot", str(path), "--joints", "shoulder_*", "elbow", "-o", "run.png"])
