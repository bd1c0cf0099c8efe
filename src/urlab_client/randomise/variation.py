"""The numbers of an episode: drawn from its seed, and written into a model and a start."""

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
from urlab_client.randomise.quantities import DERIVED_FROM, FIELDS, START, Elements, Fields, elements_of, write

__all__ = ["EpisodeDraws", "Variation", "declared_in", "draw_range", "field_of", "model_text", "stream"]

MODEL_STREAM: Final = 0
"""First number of the streams of random numbers that `Vary` draws from; other parts have others."""

_VISIBLE: Final = {
    "light_diffuse": (),
    "geom_rgba": (),
    "cam_fovy": (),
    "light_pos": ("light_pos0", "light_poscom0"),
    "cam_pos": ("cam_pos0", "cam_poscom0"),
    "cam_quat": ("cam_mat0",),
}
"""Fields that pictures depend on, with what `mj_setConst` computes from them."""


def stream(seed: int, *path: int) -> np.random.Generator:
    """Return the generator of one part of an episode: what one part draws leaves the numbers of others alone."""
    return np.random.default_rng([seed, *path])


def draw_range(rng: np.random.Generator, given: Range, shape: tuple[int, ...], *, log: bool = False) -> Floats:
    """Return uniform numbers from a range; its bounds are numbers, or vectors along the last axis."""
    low, high = (np.asarray(bound, dtype=np.float64) for bound in given)
    if log:
        return np.exp(rng.uniform(np.log(low), np.log(high), shape))
    return rng.uniform(low, high, shape)


def declared_in(model: mujoco.MjModel) -> Randomisation | None:
    """Return what the server of a compiled scene varies, None for nothing."""
    text = model_text(model, MODEL_TEXT)
    return None if text is None else Randomisation.from_json(text)


def model_text(model: mujoco.MjModel, name: str) -> bytes | None:
    """Return a custom text element of a compiled model, None without it."""
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, name)
    if found < 0:
        return None
    start, size = int(model.text_adr[found]), int(model.text_size[found])
    return bytes(model.text_data[start : start + size]).rstrip(b"\0")


@dataclass(frozen=True, eq=False)
class EpisodeDraws:
    """What was drawn for one episode.

    Attributes:
        seed: The episode's seed.
        varied: What varied, in the order of the declaration: the entry, its elements, and the numbers that were drawn,
            shape (n elements, width).
    """

    seed: int
    varied: tuple[tuple[Vary, Elements, Floats], ...]

    def told(self) -> dict[str, Any]:
        """Return plain data: `seed`, and per entry of `varied` the quantity, what was done to it, and the numbers."""
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
    """How one compiled scene varies. The same declaration, model and seed give the same numbers everywhere.

    Attributes:
        declaration: What was declared.
        fields: Fields of the model that vary; options are called `opt.NAME`.
        derives: Whether constants follow from those fields, so that `mj_setConst` is due after a change.
    """

    def __init__(
        self, declaration: Randomisation, model: mujoco.MjModel, controlled: frozenset[int] = frozenset()
    ) -> None:
        """Look up what varies.

        Args:
            declaration: What to vary.
            model: The compiled scene, as it is without variation; a copy is kept of what varies.
            controlled: Actuators that a controller with gains drives.

        Raises:
            ValueError: A name fits no element.
        """
        self.declaration = declaration
        self._model = model
        self._elements = [elements_of(vary, model, controlled) for vary in declaration.vary]
        model_entries = [vary for vary in declaration.vary if vary.what not in START]
        self.fields: tuple[str, ...] = tuple(sorted({name for vary in model_entries for name in FIELDS[vary.what]}))
        self.derives: bool = not DERIVED_FROM.isdisjoint(self.fields)
        self._nominal = {name: np.array(field_of(model, name)) for name in self.fields}

    @property
    def visible_fields(self) -> tuple[str, ...]:
        """Varied fields of the model that pictures depend on, and what is computed from them."""
        return tuple(name for field, derived in _VISIBLE.items() if field in self.fields for name in (field, *derived))

    def draw(self, seed: int) -> EpisodeDraws:
        """Return the numbers of the episode with a seed."""
        varied: list[tuple[Vary, Elements, Floats]] = []
        for i, (vary, elements) in enumerate(zip(self.declaration.vary, self._elements, strict=True)):
            count = 1 if vary.together else len(elements.ids)
            rng = stream(seed, MODEL_STREAM, i)
            drawn = draw_range(rng, vary.range, (count, vary.width), log=vary.distribution == "log-uniform")
            varied.append((vary, elements, np.broadcast_to(drawn, (len(elements.ids), vary.width))))
        return EpisodeDraws(seed, tuple(varied))

    def write(self, draws: EpisodeDraws, fields: Fields) -> None:
        """Write the model of an episode: the fields as they are without variation, and the draws on top.

        Args:
            draws: Of this variation.
            fields: Returns the arrays of the model to write, by the names in `fields`.
        """
        self.restore(fields)
        for vary, elements, drawn in draws.varied:
            if vary.what not in START:
                write(vary, elements, drawn, self._model, fields)

    def restore(self, fields: Fields) -> None:
        """Write the fields as they are without variation."""
        for name, values in self._nominal.items():
            fields(name)[...] = values

    def start(self, draws: EpisodeDraws, qpos: Floats) -> None:
        """Vary where an episode starts, in place. Joints stay within their ranges.

        Args:
            draws: Of this variation.
            qpos: Positions of the whole scene, shape (nq,), after a reset.
        """
        model = self._model
        for vary, elements, drawn in draws.varied:
            address = model.jnt_qposadr[elements.ids] if vary.what in START else np.zeros(0, dtype=np.intp)
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

    def gain_factors(self, draws: EpisodeDraws, actuators: NDArray[np.intp]) -> Mapping[str, NDArray[np.float32]]:
        """Return by what the gains `kp` and `kv` of controllers of actuators are multiplied, shape (n actuators,)."""
        factors = {name: np.ones(len(actuators), dtype=np.float32) for name in self.varied_gains}
        for vary, elements, drawn in draws.varied:
            if vary.what in factors:
                of = dict(zip(elements.ids.tolist(), drawn[:, 0].tolist(), strict=True))
                factors[vary.what] *= np.array([of.get(int(i), 1.0) for i in actuators], dtype=np.float32)
        return factors

    @cached_property
    def varied_gains(self) -> tuple[str, ...]:
        """Gains that vary, `kp` and `kv`."""
        return tuple(sorted({vary.what for vary in self.declaration.vary if vary.what in ("kp", "kv")}))


def field_of(model: mujoco.MjModel, name: str) -> NDArray[Any]:
    """Return a field of a model, to be written in place; options are called `opt.NAME`."""
    return getattr(model.opt, name.removeprefix("opt.")) if name.startswith("opt.") else getattr(model, name)


def _turn(quaternion: Floats, yaw: float, *, afresh: bool) -> None:
    """Turn an orientation about the world's z axis, or put it upright with that yaw; (w, x, y, z), in place."""
    turn = np.array([np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)])
    if afresh:
        quaternion[:] = turn
        return
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, turn, np.array(quaternion))
    quaternion[:] = result
