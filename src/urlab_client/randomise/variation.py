"""The numbers of an episode: drawn from its seed, and applied to a model and an initial state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.protocol.base import Floats
from urlab_client.randomise.declaration import MODEL_TEXT, Randomisation, Range, Vary
from urlab_client.randomise.quantities import DERIVED_FROM, QUANTITIES, START, Elements, Fields, elements_of, write
from urlab_client.values.names import NameMap

_NO_ROBOTS: Final[NameMap[str]] = NameMap()

MODEL_STREAM, NOISE_STREAM, PUSH_STREAM, DELAY_STREAM, DROP_STREAM = range(5)
"""What follows the episode's seed in the seeds of the random streams, by part of the declaration."""

_VISIBLE: Final = {
    "light_diffuse": (),
    "geom_rgba": (),
    "mat_specular": (),
    "mat_shininess": (),
    "mat_reflectance": (),
    "cam_fovy": (),
    "light_pos": ("light_pos0", "light_poscom0"),
    "cam_pos": ("cam_pos0", "cam_poscom0"),
    "cam_quat": ("cam_mat0",),
}
"""Fields that affect pictures, including those that `mj_setConst` computes from them."""


def stream(seed: int, *path: int) -> np.random.Generator:
    """Return the generator of one part of an episode, independent of the other parts."""
    return np.random.default_rng([seed, *path])


def draw_range(rng: np.random.Generator, given: Range, shape: tuple[int, ...], *, log: bool = False) -> Floats:
    """Return uniform numbers from a range; its bounds are numbers, or vectors along the last axis."""
    low, high = (np.asarray(bound, dtype=np.float64) for bound in given)
    if log:
        return np.exp(rng.uniform(np.log(low), np.log(high), shape))
    return rng.uniform(low, high, shape)


def declared_in(model: mujoco.MjModel) -> Randomisation | None:
    """Return the declaration in a compiled scene; None if there is none."""
    text = model_text(model, MODEL_TEXT)
    return None if text is None else Randomisation.from_json(text)


def model_text(model: mujoco.MjModel, name: str) -> bytes | None:
    """Return a custom text element of a compiled model; None if there is none."""
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, name)
    if found < 0:
        return None
    start, size = int(model.text_adr[found]), int(model.text_size[found])
    return bytes(model.text_data[start : start + size]).rstrip(b"\0")


@dataclass(frozen=True, eq=False)
class EpisodeDraws:
    """The draws of one episode.

    Attributes:
        seed: The episode's seed.
        varied: In the order of the declaration: the entry, its elements, and the drawn numbers, shape
            (n elements, width).
    """

    seed: int
    varied: tuple[tuple[Vary, Elements, Floats], ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain data: `seed`, and for each entry of `varied` the quantity, the operation and the numbers."""
        return {
            "seed": self.seed,
            "varied": [
                {
                    "what": vary.what,
                    "by": vary.by,
                    "drawn": {
                        name: row[0] if len(row) == 1 else row
                        for name, row in zip(elements.names, drawn.tolist(), strict=True)
                    },
                }
                for vary, elements, drawn in self.varied
            ],
        }


class Variation:
    """Applies a declaration to one compiled scene. The same declaration, model and seed give the same numbers
    everywhere.

    Attributes:
        declaration: The declaration.
        fields: Fields of the model that vary; options are called `opt.NAME`.
        derives: Whether constants depend on these fields, so that `mj_setConst` is required after a change.
    """

    def __init__(
        self,
        declaration: Randomisation,
        model: mujoco.MjModel,
        controlled: frozenset[int] = frozenset(),
        prefixes: NameMap[str] = _NO_ROBOTS,
    ) -> None:
        """Find the elements that vary.

        Args:
            declaration: The declaration.
            model: The compiled scene without variation; the varying fields are copied.
            controlled: Actuators that a controller with gains drives.
            prefixes: Prefix of the compiled element names of each articulation, by key, with its aliases.

        Raises:
            ValueError: A name matches no element.
        """
        self.declaration = declaration
        self._model = model
        self._elements = [elements_of(vary, model, controlled, prefixes) for vary in declaration.vary]
        self.fields: tuple[str, ...] = tuple(
            sorted({name for vary in declaration.vary for name in QUANTITIES[vary.what][1]})
        )
        self.derives: bool = not DERIVED_FROM.isdisjoint(self.fields)
        self._nominal = {name: np.array(field_of(model, name)) for name in self.fields}

    @property
    def visible_fields(self) -> tuple[str, ...]:
        """Varying fields of the model that affect pictures, and fields computed from them."""
        return tuple(name for field, derived in _VISIBLE.items() if field in self.fields for name in (field, *derived))

    def draw(self, seed: int) -> EpisodeDraws:
        """Return the draws for a seed."""
        varied: list[tuple[Vary, Elements, Floats]] = []
        for i, (vary, elements) in enumerate(zip(self.declaration.vary, self._elements, strict=True)):
            count = 1 if vary.together else len(elements.ids)
            rng = stream(seed, MODEL_STREAM, i)
            drawn = draw_range(rng, vary.range, (count, vary.width), log=vary.distribution == "log-uniform")
            varied.append((vary, elements, np.broadcast_to(drawn, (len(elements.ids), vary.width))))
        return EpisodeDraws(seed, tuple(varied))

    def write(self, draws: EpisodeDraws, fields: Fields) -> None:
        """Write the model of an episode: the original fields with the draws applied."""
        self.restore(fields)
        for vary, elements, drawn in draws.varied:
            if vary.what not in START:
                write(vary, elements, drawn, self._model, fields)

    def restore(self, fields: Fields) -> None:
        """Restore the original fields."""
        for name, values in self._nominal.items():
            fields(name)[...] = values

    def start(self, draws: EpisodeDraws, qpos: Floats, qvel: Floats) -> None:
        """Vary positions, shape (nq,), and velocities, shape (nv,), of the whole scene after a reset, in place.

        Joints stay in their ranges.
        """
        model = self._model
        for vary, elements, drawn in draws.varied:
            if vary.what not in START:
                continue
            address, dof = model.jnt_qposadr[elements.ids], model.jnt_dofadr[elements.ids, None]
            if vary.what == "position":
                wanted = drawn[:, 0] if vary.by == "set" else qpos[address] + drawn[:, 0]
                limited = model.jnt_limited[elements.ids].astype(bool)
                low, high = model.jnt_range[elements.ids].T
                qpos[address] = np.where(limited, np.clip(wanted, low, high), wanted)
            elif vary.what == "base_position":
                where = address[:, None] + np.arange(3)
                qpos[where] = drawn if vary.by == "set" else qpos[where] + drawn
            elif vary.what == "base_yaw":
                for at, yaw in zip(address, drawn[:, 0], strict=True):
                    _turn(qpos[at + 3 : at + 7], float(yaw), afresh=vary.by == "set")
            else:
                where = dof + {"velocity": [0], "base_velocity": [0, 1, 2], "base_spin": [3, 4, 5]}[vary.what]
                qvel[where] = drawn if vary.by == "set" else qvel[where] + drawn

    def gain_factors(self, draws: EpisodeDraws, actuators: NDArray[np.intp]) -> Mapping[str, NDArray[np.float32]]:
        """Return the factors of the gains `kp` and `kv` of controllers, shape (n actuators,)."""
        factors = {name: np.ones(len(actuators), dtype=np.float32) for name in self.varied_gains}
        for vary, elements, drawn in draws.varied:
            if vary.what in factors:
                of = dict(zip(elements.ids.tolist(), drawn[:, 0].tolist(), strict=True))
                factors[vary.what] *= np.array([of.get(int(i), 1.0) for i in actuators], dtype=np.float32)
        return factors

    @cached_property
    def varied_gains(self) -> tuple[str, ...]:
        """The gains that vary, of `kp` and `kv`."""
        return tuple(sorted({vary.what for vary in self.declaration.vary if vary.what in ("kp", "kv")}))


def field_of(model: mujoco.MjModel, name: str) -> NDArray[Any]:
    """Return a field of a model, to be written in place; options are called `opt.NAME`."""
    return getattr(model.opt, name.removeprefix("opt.")) if name.startswith("opt.") else getattr(model, name)


def _turn(quaternion: Floats, yaw: float, *, afresh: bool) -> None:
    """Rotate an orientation about the world's z axis, or make it upright with that yaw; (w, x, y, z), in place."""
    turn = np.array([np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)])
    if afresh:
        quaternion[:] = turn
        return
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, turn, np.array(quaternion))
    quaternion[:] = result
