"""Every robot that comes with Gymnasium, twice in one scene: physics through the server is MuJoCo's, bit for bit."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.aio.model.layout import articulation_layouts
from urlab_client.server import SimulatedServer

ASSETS = sorted((Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets").glob("*.xml"))
STEPS = 50


@pytest.mark.parametrize("model", ASSETS, ids=lambda path: path.stem)
def test_two_of_a_robot_move_as_mj_step_says(model: Path) -> None:
    with (
        SimulatedServer(model, model, play=True, mjcf_options=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        assert client.model is not None
        assert len(client.articulations) == 2
        layouts = articulation_layouts(client.model, {key: key for key in client.articulations})
        data = mujoco.MjData(client.model)
        client.reset()
        rng = np.random.default_rng(0)
        for _ in range(STEPS):
            for key, robot in client.articulations.items():
                robot.ctrl_array[:] = rng.uniform(-0.1, 0.1, robot.ctrl_array.shape).astype(np.float32)
                data.ctrl[layouts[key].ctrl_adr] = robot.ctrl_array
            mujoco.mj_step(client.model, data)
            client.step()
        assert client.step_count == STEPS
        for key, robot in client.articulations.items():
            assert np.array_equal(robot.qpos_array, data.qpos[layouts[key].qpos_adr])
            assert np.array_equal(robot.qvel_array, data.qvel[layouts[key].qvel_adr])
            assert len(robot.cameras) == client.model.ncam // 2
