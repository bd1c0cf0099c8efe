"""The local copy of the simulation: the compiled model from the handshake and data that follow the server's replies.

For the client's own use. MuJoCo is imported only when a model is loaded.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from urlab_client._mujoco import (
    forget_last_document,
    model_names,
    option_choices,
    saved_model,
    without_newer_attributes,
    write_options,
)
from urlab_client.aio.arguments import first_not_finite
from urlab_client.errors import ProtocolError, URLabError, URLabVersionMismatch
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.session import HelloOk, Perturbation
from urlab_client.values.names import NameMap
from urlab_client.values.types import SimOptions

if TYPE_CHECKING:
    import mujoco

log: logging.Logger = logging.getLogger("urlab_client.mirror")

T = TypeVar("T")

_HEADER_BYTES = 20  # five 32-bit integers
_THREADS = ("num_worker_threads", "max_worker_threads")


def require_local(part: T | None, what: str, *, op: str | None = None, otherwise: str = "") -> T:
    """Return a client's local model, its data, or what follows from them.

    Args:
        part: What the client has, or None.
        what: What needs it, the subject of the error.
        op: The op that does.
        otherwise: What to do instead, continuing the hint.

    Raises:
        URLabError: The client has no local model.
    """
    if part is None:
        raise URLabError(
            f"{what} needs the local model, which this client does not have.",
            op=op,
            hint=f"Create the client with local_model=True and call discover() during play{otherwise}.",
        )
    return part


@cache
def _mjb_header() -> bytes:
    """Return the header of every model saved by this MuJoCo: magic, number size, layout and version."""
    import mujoco

    return saved_model(mujoco.MjModel.from_xml_string("<mujoco/>"))[:_HEADER_BYTES]


def mirror_options(opt: mujoco.MjOption, options: SimOptions) -> None:
    """Write the options that are not None to a model's `mjOption`, all or none.

    Raises:
        ValueError: An integrator, cone or solver is unknown.
    """
    given = {name: getattr(options, name) for name in SimOptions.__struct_fields__ if name not in _THREADS}
    values = {name: value for name, value in given.items() if value is not None}
    for name, known in option_choices().items():
        if name in values:
            word = values[name].lower()
            # The wire carries the number of one without a name.
            values[name] = known.get(word, next((number for number in known.values() if str(number) == word), None))
            if values[name] is None:
                raise ValueError(f"{name} is {given[name]!r}; MuJoCo knows {', '.join(known)}")
    write_options(opt, values)


def _from_binary(mjb: bytes) -> mujoco.MjModel:
    import mujoco

    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": mjb})


def _compiled(xml: str, assets: Mapping[str, bytes], *, trusted: bool) -> mujoco.MjModel:
    import mujoco

    if trusted:
        model = mujoco.MjModel.from_xml_string(xml, dict(assets))
        forget_last_document()
        return model
    from urlab_client.aio.model.compilation import compile_confined  # rarely needed

    try:
        return _from_binary(compile_confined(xml, assets))
    except ValueError as error:
        raise ValueError(
            f"{error}. The server is neither on this machine nor known by its key, so its model may use only limited "
            "resources and files: trust_server=True lifts the limits, local_model=False loads no model"
        ) from None


class Loaded(NamedTuple):
    """A loaded model, and whether this client compiled it from XML."""

    model: mujoco.MjModel
    data: mujoco.MjData
    approximate: bool


class Mirror:
    """Local model and data, guarded by a reentrant lock.

    Attributes:
        lock: Held while data change. Hold it to read several consistent values from another thread.
        model: The compiled model, or None without one.
        data: State that mirrors the server's, or None without a model.
        prefixes: What the compiled names of each articulation's elements begin with, by key.
        stale: True if positions or velocities changed, so that derived quantities must be computed before use.
        approximate: True if this client compiled the model from XML because the server runs another MuJoCo build
            or is not trusted with binary models.
    """

    def __init__(self) -> None:
        self.lock: threading.RLock = threading.RLock()
        self.model: mujoco.MjModel | None = None
        self.data: mujoco.MjData | None = None
        self.prefixes: NameMap[str] = NameMap(kind="articulation")
        self.approximate: bool = False
        self.stale: bool = False
        self._dragged: int | None = None

    @staticmethod
    def check_version(hello: HelloOk) -> URLabVersionMismatch | None:
        """Return the error to raise if this MuJoCo cannot load the server's compiled model, otherwise None.

        Development builds with different models share version numbers, so this also compares the model's header.
        """
        import mujoco

        client = mujoco.mj_versionString()
        same = hello.mujoco_version == client and hello.mujoco_version_int == mujoco.mj_version()
        if same and hello.mjb is not None:
            same = hello.mjb[:_HEADER_BYTES] == _mjb_header()
        return None if same else URLabVersionMismatch(hello.mujoco_version, client)

    @classmethod
    def load(cls, hello: HelloOk, *, trusted: bool) -> Loaded | None:
        """Load the model from the handshake; None if it has none. Blocks and changes no state: run in a thread."""
        import mujoco

        mismatch = cls.check_version(hello)
        try:
            binary = mismatch is None and hello.mjb is not None
            if binary and hello.mjb is not None:
                model = _from_binary(hello.mjb)
            elif hello.mjcf_compiled is not None:
                model, left_out = without_newer_attributes(
                    hello.mjcf_compiled,
                    hello.vfs_assets or {},
                    lambda xml, assets: _compiled(xml, assets, trusted=trusted),
                )
                if left_out:
                    log.warning(
                        "The server's MuJoCo %s writes attributes that MuJoCo %s does not support; the local model "
                        "omits them: %s.",
                        hello.mujoco_version,
                        mujoco.mj_versionString(),
                        ", ".join(left_out),
                    )
            else:
                return None
        except (ValueError, mujoco.FatalError) as error:
            hint = None
            if mismatch is not None:
                hint = (
                    f"The server has MuJoCo {mismatch.server_version}, this process {mismatch.client_version}: the "
                    f"model may need what that lacks. Install mujoco=={mismatch.server_version}, or pass "
                    "local_model=False to work without a local model."
                )
            raise ProtocolError(
                f"hello: the server's model cannot be loaded: {error}", op="hello", hint=hint
            ) from error
        if not 0 < model.opt.timestep < math.inf:
            raise ProtocolError(f"hello: the timestep of the server's model is {model.opt.timestep}.", op="hello")
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return Loaded(model, data, not binary)

    def use(self, loaded: Loaded | None, *, keep: bool = False) -> None:
        """Switch to a loaded model, or to none. Call under the lock.

        `keep` keeps the state; `holds` must have been true.
        """
        if keep and loaded is not None and self.model is not None and self.data is not None:
            import mujoco

            kept = mujoco.mjtState.mjSTATE_INTEGRATION
            state = np.empty(mujoco.mj_stateSize(self.model, kept))
            mujoco.mj_getState(self.model, self.data, state, kept)
            mujoco.mj_setState(loaded.model, loaded.data, state, kept)
        self.model, self.data, self.approximate = (None, None, False) if loaded is None else loaded
        self.stale = keep
        self._dragged = None

    def holds(self, loaded: Loaded | None) -> bool:
        """Return whether a loaded model has the same elements as the present one, so that its state fits."""
        if loaded is None or self.model is None:
            return loaded is None and self.model is None
        import mujoco

        before, after = self.model, loaded.model
        whole = mujoco.mjtState.mjSTATE_INTEGRATION
        return (
            before.names == after.names
            and np.array_equal(before.qpos0, after.qpos0)
            and mujoco.mj_stateSize(before, whole) == mujoco.mj_stateSize(after, whole)
        )

    def reset(self, keyframe: str | None) -> None:
        """Reset the data as the server does, because replies carry only part of the state. Call under the lock."""
        if self.model is None or self.data is None:
            return
        import mujoco

        key = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_KEY, keyframe) if keyframe else -1
        if key >= 0:
            mujoco.mj_resetDataKeyframe(self.model, self.data, key)
        else:
            mujoco.mj_resetData(self.model, self.data)

    def perturb(self, perturbation: Perturbation | None) -> None:
        """Apply a mouse drag to the next local step and remove the previous one. Call under the lock."""
        if self.data is None:
            return
        if self._dragged is not None:
            self.data.xfrc_applied[self._dragged] = 0.0
        self._dragged = None
        if perturbation is not None:
            self._dragged = perturbation.body_id
            self.data.xfrc_applied[self._dragged] = perturbation.xfrc

    def check_finite(self) -> None:
        """Raise `ValueError` if the data of a push are NaN or infinite. Before the local step, under the lock."""
        model, data = self.model, self.data
        if model is None or data is None:
            return
        if not math.isfinite(data.time):
            raise ValueError(f"step: data.time is {data.time}. Nothing was sent.")
        for what, array in (("qpos", data.qpos), ("qvel", data.qvel), ("ctrl", data.ctrl)):
            i = first_not_finite(array)
            if i is not None:
                owner = f" of {_owner(model, what, i)}" if what != "ctrl" else ""
                raise ValueError(f"step: data.{what}[{i}]{owner} is {array[i]}. Nothing was sent.")

    def current_data(self) -> mujoco.MjData | None:
        """Return the data with body poses and velocities of the current state, or None without a model."""
        if self.stale:
            with self.lock:
                self.derived()
        return self.data

    def derived(self) -> tuple[mujoco.MjModel, mujoco.MjData] | None:
        """Return model and data with body poses and velocities of the current state. Call under the lock."""
        if self.model is None or self.data is None:
            return None
        if self.stale:
            import mujoco

            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_camlight(self.model, self.data)
            mujoco.mj_comVel(self.model, self.data)
            self.stale = False
        return self.model, self.data

    def body_velocity(self, body_id: int) -> Floats | None:
        """Return (angular, linear) velocity of a body's frame origin, shape (6,), rad/s and m/s, world axes."""
        with self.lock:
            pair = self.derived()
            if pair is None:
                return None
            import mujoco

            velocity = np.zeros(6)
            mujoco.mj_objectVelocity(*pair, mujoco.mjtObj.mjOBJ_XBODY, body_id, velocity, 0)
            return velocity


def _owner(model: mujoco.MjModel, what: str, i: int) -> str:
    """Return the joint that a position or velocity belongs to."""
    starts = model.jnt_qposadr if what == "qpos" else model.jnt_dofadr
    joint = int(np.searchsorted(starts, i, side="right")) - 1
    return f"joint {model_names(model, 'joint')[joint]!r}"
