"""Batches that MuJoCo Warp steps, with a stand-in for it: MuJoCo itself. tools/check_learning.py has the library."""

from __future__ import annotations

import copy
import importlib.machinery
import sys
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from urlab_client import URLabClient, URLabError
from urlab_client.integrations.gym import URLabBatchEnv, Walk
from urlab_client.randomise import Noise, Randomisation, Vary
from urlab_client.server import ControllerConfig, SimulatedServer

FIELDS = ("qpos", "qvel", "act", "ctrl", "xfrc_applied", "time", "qacc_warmstart", "sensordata")


class Array:
    """One of Warp's arrays: 32 bits, on a device of its own."""

    def __init__(self, values: Any) -> None:
        self.values = np.array(values)

    def assign(self, values: Any) -> None:
        assert values.shape == self.values.shape
        assert values.dtype == self.values.dtype
        self.values = values.copy()

    def numpy(self) -> Any:
        return self.values.copy()


def put_model(model: Any) -> Any:
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICIT:
        raise NotImplementedError("INT_IMPLICIT is unsupported.")
    return copy.copy(model)


def put_data(model: Any, data: Any, *, nworld: int, nconmax: int | None, njmax: int | None) -> Any:
    arrays = {name: Array(np.float32([np.copy(getattr(data, name))] * nworld)) for name in FIELDS}
    return SimpleNamespace(**arrays, overflow=Array(np.zeros(nworld, dtype=np.int32)), most=nconmax or 1000)


def step(model: Any, device: Any) -> None:
    data = mujoco.MjData(model)
    for world in range(len(device.time.values)):
        for name in FIELDS[:-1]:
            setattr(data, name, np.float64(getattr(device, name).values[world]))
        mujoco.mj_step(model, data)
        device.overflow.values[world] |= 8 * (data.ncon > device.most)
        for name in FIELDS:
            getattr(device, name).values[world] = getattr(data, name)


@pytest.fixture(autouse=True)
def warp(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module: Any = ModuleType("mujoco_warp")
    module.__spec__ = importlib.machinery.ModuleSpec("mujoco_warp", None)
    module.put_model, module.put_data, module.step = put_model, put_data, step
    monkeypatch.setitem(sys.modules, "mujoco_warp", module)
    return module


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    pd = {"quadruped": ControllerConfig(kp=60.0, kv=2.0)}
    with SimulatedServer("quadruped", play=True, controllers=pd) as server:
        yield f"{server.address}:{server.step_port}"


def test_episodes_start_with_the_same_bits_and_go_on_alike(address: str) -> None:
    disturbed = Randomisation(
        vary=(Vary(what="position", on="*/*", add=(-0.1, 0.1)),), noise=(Noise(field="task", std=0.01),)
    )
    engines: list[Any] = ["warp", "mujoco"]
    warp, plain = (
        URLabBatchEnv(address, 3, task=Walk(), max_episode_steps=3, randomise=disturbed, engine=engine)
        for engine in engines
    )
    assert warp.observation_space == plain.observation_space
    assert warp.action_space == plain.action_space
    assert np.array_equal(warp.reset(seed=1)[0], plain.reset(seed=1)[0])
    for env in (warp, plain):
        env._batch.bind("qpos")[1, 3:7] = (
            0.0,
            1.0,
            0.0,
            0.0,
        )  # upside down: it begins another episode while the others go on
    action = 0.1 * plain.action_space.sample()
    ended = list[int]()
    for _ in range(6):
        ours, theirs = warp.step(action), plain.step(action)
        assert np.allclose(ours[0], theirs[0], rtol=1e-3, atol=2e-3)
        assert np.array_equal(ours[2] | ours[3], theirs[2] | theirs[3])
        fresh = ours[4]["step_count"] == 0
        assert np.array_equal(ours[0][fresh], theirs[0][fresh])
        assert np.array_equal(ours[4]["step_count"], theirs[4]["step_count"])
        assert np.allclose(ours[4]["sim_time"], theirs[4]["sim_time"], rtol=1e-5)
        ended.append(int((ours[2] | ours[3]).sum()))
    assert 0 < ended[0] < 3, "the copies are not in step with each other"


def test_what_warp_cannot_do_is_said_before_anything_is_stepped(address: str) -> None:
    heavy = Randomisation(vary=(Vary(what="mass", scale=(0.5, 2.0)),))
    with pytest.raises(ValueError, match=r"all copies share one model: body_\w+ cannot vary"):
        URLabBatchEnv(address, 2, engine="warp", randomise=heavy)
    with pytest.raises(ValueError, match="engine must be 'mujoco' or 'warp', not 'mjx'"):
        URLabBatchEnv(address, 2, engine="mjx")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="engine_options of 'mujoco' must not contain contacts"):
        URLabBatchEnv(address, 2, engine_options={"contacts": 3})
    with SimulatedServer("quadruped", play=True) as server, URLabClient(**server.client_options()) as client:
        client.discover()
        client.runtime.set_sim_options(integrator="implicit")
        with pytest.raises(URLabError, match="MuJoCo Warp cannot step this scene: INT_IMPLICIT is unsupported"):
            URLabBatchEnv(f"{server.address}:{server.step_port}", 2, engine="warp")


def test_contacts_that_there_is_no_room_for_are_an_error_not_a_gap(address: str) -> None:
    env = URLabBatchEnv(address, 2, task=Walk(), engine="warp", engine_options={"contacts": 1})
    env.reset(seed=1)
    time = env._batch.bind("time")
    kept = list[Any]()

    def fall() -> None:
        for _ in range(50):
            kept.append(time.copy())
            env.step(0 * env.action_space.sample())

    with pytest.raises(URLabError, match="Copies 0, 1 have more contacts"):
        fall()
    assert 0 <= time[0] - kept[-1][0] < 10 * env.model.opt.timestep, "the step that failed left the state as it was"
