"""What steps the copies of a batch in place of `mujoco.batch`: Python threads, or MuJoCo Warp."""

from __future__ import annotations

import copy
import importlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client.errors import URLabError
from urlab_client.randomise.variation import field_of

Indices = NDArray[np.intp]

_STATE = ("qpos", "qvel", "act", "ctrl", "xfrc_applied")


class ThreadedBatch:
    """Substitute for `mujoco.batch` with MuJoCo releases that lack it.

    It uses one `MjData` per simulation and Python threads; `mj_step` releases the GIL. `mujoco.rollout` is no
    alternative: it does not return the warm start of the next step, so its results would differ from a server's.

    Args:
        model: The model, shared by all simulations until `expand`.
        nsim: Number of simulations.
        nthread: Threads that step; 0 for one per processor.
    """

    def __init__(self, model: mujoco.MjModel, nsim: int, nthread: int = 0) -> None:
        self._model = model
        self._data = [mujoco.MjData(model) for _ in range(nsim)]
        self._bound: dict[str, NDArray[Any]] = {}
        self._models = [model] * nsim
        self._expanded: dict[str, NDArray[Any]] = {}
        self._threads = max(1, min(nsim, nthread or os.cpu_count() or 1))
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="urlab-batch") if self._threads > 1 else None
        for data in self._data:
            mujoco.mj_forward(model, data)
        for name in _STATE:
            self.bind(name)

    def bind(self, name: str) -> NDArray[Any]:
        """Return an `MjData` field of all simulations, shape (nsim, …). Writes to parts of the state take effect."""
        if name not in self._bound:
            self._bound[name] = np.array([np.copy(getattr(data, name)) for data in self._data])
        return self._bound[name]

    def expand(self, name: str) -> NDArray[Any]:
        """Return a model field with a value for each simulation, shape (nsim, …). Writes to it take effect."""
        if name not in self._expanded:
            if self._models[0] is self._model:
                self._models = [copy.copy(self._model) for _ in self._models]
            self._expanded[name] = np.array([np.copy(field_of(model, name)) for model in self._models])
        return self._expanded[name]

    def set_const(self, ids: Indices) -> None:
        """Recompute the derived constants of the model, for some simulations."""
        for i in map(int, ids):
            model = self._varied(i)
            mujoco.mj_setConst(model, mujoco.MjData(model))
            for name, values in self._expanded.items():
                values[i] = field_of(model, name)

    def reset(self, ids: Indices, keyframe: int = -1) -> None:
        """Reset some simulations to the model's defaults or a keyframe, and run forward dynamics."""
        self._run(ids, partial(_reset, keyframe=keyframe), write=False)

    def forward(self, ids: Indices) -> None:
        """Run forward dynamics for some simulations."""
        self._run(ids, mujoco.mj_forward)

    def step(self, ids: Indices, nstep: int = 1) -> None:
        """Advance some simulations."""
        self._run(ids, lambda model, data: mujoco.mj_step(model, data, nstep))

    def _varied(self, i: int) -> mujoco.MjModel:
        """Return the model of a simulation, updated from the expanded fields."""
        model = self._models[i]
        for name, values in self._expanded.items():
            field_of(model, name)[...] = values[i]
        return model

    def _run(self, ids: Indices, act: Callable[[mujoco.MjModel, mujoco.MjData], object], *, write: bool = True) -> None:
        def some(part: Indices) -> None:
            for i in map(int, part):
                data = self._data[i]
                if write:
                    for name in _STATE:
                        getattr(data, name)[:] = self._bound[name][i]
                act(self._varied(i), data)
                for name, values in self._bound.items():
                    values[i] = getattr(data, name)

        if self._pool is None:
            some(ids)
        else:
            list(self._pool.map(some, np.array_split(ids, self._threads)))


_SENT: Final = (
    "qpos",
    "qvel",
    "act",
    "ctrl",
    "xfrc_applied",
    "mocap_pos",
    "mocap_quat",
    "time",
    "qacc_warmstart",
)
_TAKEN: Final = ("qpos", "qvel", "act", "time", "qacc_warmstart", "sensordata")


class WarpBatch:
    """Substitute for `mujoco.batch` on MuJoCo Warp, for NVIDIA GPUs. Needs the extra `warp`.

    MuJoCo itself resets, in this process and in float64. Warp only steps, in float32: the state of all copies is copied
    to the device before an action and back after it.

    Args:
        model: The model, shared by all simulations.
        nsim: Number of simulations.
        contacts: Largest number of contacts in one simulation at any time; 0 for MuJoCo Warp's own estimate.
        constraints: Largest number of constraint rows in one simulation at any time; 0 for MuJoCo Warp's own estimate.

    Raises:
        MissingExtra: MuJoCo Warp is not installed.
        URLabError: The model uses a feature that MuJoCo Warp lacks.
    """

    def __init__(self, model: mujoco.MjModel, nsim: int, contacts: int = 0, constraints: int = 0) -> None:
        need("mujoco_warp", extra="warp")
        self._warp: Any = importlib.import_module("mujoco_warp")
        self._model = model
        self._data = mujoco.MjData(model)
        mujoco.mj_forward(model, self._data)
        self._bound: dict[str, NDArray[Any]] = {}
        for name in (*_SENT, *_TAKEN):
            self.bind(name)
        self._bound = {name: np.repeat(values, nsim, axis=0) for name, values in self._bound.items()}
        try:
            self._device_model: Any = self._warp.put_model(model)
            self._device: Any = self._warp.put_data(
                model, self._data, nworld=nsim, nconmax=contacts or None, njmax=constraints or None
            )
        except NotImplementedError as error:
            raise URLabError(
                f"MuJoCo Warp cannot step this scene: {error}", hint="Omit `engine` to step it with MuJoCo itself."
            ) from error

    def bind(self, name: str) -> NDArray[Any]:
        """Return an `MjData` field of all simulations, shape (nsim, …). Writes to parts of the state take effect."""
        if name not in self._bound:
            if name not in {*_SENT, *_TAKEN}:
                raise ValueError(
                    f"{name} is not copied back from MuJoCo Warp; the fields are {', '.join((*_SENT, *_TAKEN))}"
                )
            self._bound[name] = np.array([np.copy(getattr(self._data, name))])
        return self._bound[name]

    def expand(self, name: str) -> NDArray[Any]:
        """Reject a model field with a value for each simulation."""
        raise ValueError(f"with engine='warp' all copies share one model: {name} cannot vary among them")

    def reset(self, ids: Indices, keyframe: int = -1) -> None:
        """Reset some simulations to the model's defaults or a keyframe, and run forward dynamics."""
        _reset(self._model, self._data, keyframe)
        for name, values in self._bound.items():
            values[ids] = getattr(self._data, name)

    def forward(self, ids: Indices) -> None:
        """Run forward dynamics for some simulations."""
        for i in map(int, ids):
            for name in _SENT:
                setattr(self._data, name, self._bound[name][i])
            mujoco.mj_forward(self._model, self._data)
            for name in _TAKEN:
                self._bound[name][i] = getattr(self._data, name)

    def step(self, ids: Indices, nstep: int = 1) -> None:
        """Advance some simulations; the others stay as they are.

        Raises:
            URLabError: A simulation has more contacts or constraints than the device's arrays can hold. No simulation
                advanced.
        """
        for name in _SENT:
            # Warp's arrays have MuJoCo's shapes with a leading axis. An empty array, such as a missing `act`, has no
            # memory to assign to.
            if self._bound[name].size:
                getattr(self._device, name).assign(self._bound[name].astype(np.float32))
        self._device.overflow.assign(np.zeros(len(self._bound["time"]), dtype=np.int32))
        for _ in range(nstep):
            self._warp.step(self._device_model, self._device)
        overflow = self._device.overflow.numpy()[ids]
        if overflow.any():
            raise URLabError(
                f"Copies {', '.join(map(str, ids[overflow != 0][:8]))} have more contacts or constraints than the "
                "arrays of MuJoCo Warp can hold.",
                hint="Pass larger engine_options={'contacts': …, 'constraints': …}.",
            )
        for name in _TAKEN:
            if self._bound[name].size:
                self._bound[name][ids] = getattr(self._device, name).numpy()[ids]


def _reset(model: mujoco.MjModel, data: mujoco.MjData, keyframe: int) -> None:
    if keyframe < 0:
        mujoco.mj_resetData(model, data)
    else:
        mujoco.mj_resetDataKeyframe(model, data, keyframe)
    mujoco.mj_forward(model, data)
