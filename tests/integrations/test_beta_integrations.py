"""Environments, batches, recordings and fixtures come to the same on either dialect.

The beta's robot is called `quadruped` as the alpha's is, but its names in the model begin otherwise, as in the plugin:
with `quadruped_C_0_`. Its `<option>` reaches the scene of itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import urlab_client
from urlab_client.integrations.gym import URLabBatchEnv, URLabEnv, URLabVectorEnv
from urlab_client.integrations.record import read_run, record
from urlab_client.server import ControllerConfig, SimulatedServer

BETA: dict[str, Any] = {"dialect": "beta", "actor_names": "plugin"}


@pytest.fixture(scope="module")
def servers() -> Iterator[list[SimulatedServer]]:
    common: dict[str, Any] = {"play": True, "camera_size": (64, 48), "mjcf_options": True}
    with SimulatedServer("quadruped", **common) as alpha, SimulatedServer("quadruped", **common, **BETA) as beta:
        yield [alpha, beta]


@pytest.fixture
def clients(servers: list[SimulatedServer]) -> Iterator[list[urlab_client.URLabClient]]:
    made = [urlab_client.URLabClient(**server.client_options(), step_mode="direct") for server in servers]
    for client in made:
        client.discover()
    yield made
    for client in made:
        client.close()


@pytest.mark.opengl
def test_an_environment(clients: list[urlab_client.URLabClient]) -> None:
    alpha, beta = (
        URLabEnv(client, space_mode="dict", cameras=["quadruped/side"], n_substeps=5, reset_noise=0.05)
        for client in clients
    )
    assert alpha.observation_space == beta.observation_space
    assert alpha.action_space == beta.action_space
    alpha.action_space.seed(4)
    for keyframe in (None, "quadruped_home"):
        for env in (alpha, beta):
            env.reset(seed=3, options={"keyframe": keyframe})
        for _ in range(3):
            action = alpha.action_space.sample()
            ours, theirs = alpha.step(action)[0], beta.step(action)[0]
            for field, values in ours["quadruped"].items():
                assert np.array_equal(values, theirs["quadruped"][field]), field
            assert np.array_equal(ours["cameras"]["quadruped/side"], theirs["cameras"]["quadruped/side"])


def test_a_batch_and_a_server() -> None:
    pd = {"arm": ControllerConfig(kp=60, kv=2)}
    with SimulatedServer("arm", play=True, controllers=pd, **BETA) as server:
        address = f"{server.address}:{server.step_port}"
        batch, wire = URLabBatchEnv(address, 2, n_substeps=4), URLabVectorEnv([address], n_substeps=4)
        try:
            wire.reset(options={"keyframe": "arm_home"})
            batch.reset(options={"keyframe": "arm_home"})
            for n in range(5):
                action = 0.4 * np.sin(0.3 * n + np.arange(wire.action_space.shape[1]))
                expected = wire.step(action[None])[0]
                assert np.array_equal(batch.step(np.stack([-action, action]))[0][1], expected[0])
        finally:
            wire.close()
            batch.close()


@pytest.mark.opengl
def test_a_recording(clients: list[urlab_client.URLabClient], tmp_path: Path) -> None:
    runs = []
    for name, client in zip(("alpha", "beta"), clients, strict=True):
        path = tmp_path / f"{name}.mcap"
        with record(client, path, cameras=["quadruped/side"], camera_hz=100.0, contacts=True):
            client.reset("quadruped_home")
            client.articulations["quadruped"].ctrl_array[:] = 0.125
            for _ in range(10):
                client.step()
        runs.append(read_run(path))
    alpha, beta = runs
    assert list(alpha.summary().topics) == list(beta.summary().topics)
    ours, theirs = alpha.table().flat(), beta.table().flat()
    assert ours.keys() == theirs.keys()
    for name in ours.keys() - {"wall_ns"}:
        assert np.array_equal(ours[name], theirs[name]), name
    for one, other in zip(alpha.frames("quadruped/side"), beta.frames("quadruped/side"), strict=True):
        assert one.time == other.time
        assert np.array_equal(one.pixels, other.pixels)


@pytest.mark.urlab("arm", step_mode="direct", **BETA)
def test_the_fixtures(urlab_client: Any, urlab_server: SimulatedServer) -> None:
    arm = urlab_client.articulations["arm"]
    arm.ctrl_array[:] = 0.1
    urlab_client.step()
    assert urlab_client.server.generation == "beta"
    assert arm.last_applied_ctrl.tolist() == [0.1] * len(arm.ctrl_array)
