"""Substitute for `mujoco.batch` with MuJoCo releases that lack it.

It uses one `MjData` per simulation and Python threads; `mj_step` releases the GIL. `mujoco.rollout` is no alternative:
it does not return the warm start of the next step, so its results would differ from a server's.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.randomise.variation import field_of

Indices = NDArray[np.intp]

_STATE = ("qpos", "qvel", "act", "ctrl", "xfrc_applied")


class ThreadedBatch:
    """Many simulations of one model.

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

        def reset(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            if keyframe < 0:
                mujoco.mj_resetData(model, data)
            else:
                mujoco.mj_resetDataKeyframe(model, data, keyframe)
            mujoco.mj_forward(model, data)

        self._run(ids, reset, write=False)

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
