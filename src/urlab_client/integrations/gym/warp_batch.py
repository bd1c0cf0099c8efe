"""Substitute for `mujoco.batch` on MuJoCo Warp, for NVIDIA GPUs. Needs the extra `warp`.

MuJoCo itself resets, in this process and in float64. Warp only steps, in float32: the state of all copies is copied to
the device before an action and back after it.
"""

from __future__ import annotations

import importlib
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client.errors import URLabError

Indices = NDArray[np.intp]

_STATE: Final = (
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
    """Many simulations of one model.

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
        for name in (*_STATE, *_TAKEN):
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
        """Return an `MjData` field of all simulations, shape (nsim, …). Writes to parts of the state take effect.

        Raises:
            ValueError: The field is not copied back from the device.
        """
        if name not in self._bound:
            if name not in {*_STATE, *_TAKEN}:
                raise ValueError(
                    f"{name} is not copied back from MuJoCo Warp; the fields are {', '.join((*_STATE, *_TAKEN))}"
                )
            self._bound[name] = np.array([np.copy(getattr(self._data, name))])
        return self._bound[name]

    def expand(self, name: str) -> NDArray[Any]:
        """Reject a model field with a value for each simulation.

        Raises:
            ValueError: Always.
        """
        raise ValueError(f"with engine='warp' all copies share one model: {name} cannot vary among them")

    def reset(self, ids: Indices, keyframe: int = -1) -> None:
        """Reset some simulations to the model's defaults or a keyframe, and run forward dynamics."""
        if keyframe < 0:
            mujoco.mj_resetData(self._model, self._data)
        else:
            mujoco.mj_resetDataKeyframe(self._model, self._data, keyframe)
        mujoco.mj_forward(self._model, self._data)
        for name, values in self._bound.items():
            values[ids] = getattr(self._data, name)

    def forward(self, ids: Indices) -> None:
        """Run forward dynamics for some simulations."""
        for i in map(int, ids):
            for name in _STATE:
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
        for name in _STATE:
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
