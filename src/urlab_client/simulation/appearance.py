"""What pictures of a scene depend on besides its model, and how it is stored in the model.

A batch of copies draws a server's scene without the server: it has only the compiled model.
"""

from __future__ import annotations

import colorsys
import zlib
from collections.abc import Mapping
from functools import cached_property
from typing import Final, Literal, Self, TypeAlias

import msgspec
import mujoco
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client.enums import CameraMode
from urlab_client.randomise.variation import model_text

Bytes = NDArray[np.uint8]

APPEARANCE_TEXT: Final = "urlab_pictures"
"""Name of the custom text element of a compiled model that holds, as JSON, what differs from the default."""

RenderQuality: TypeAlias = Literal["auto", "fast", "high"]
"""`fast` leaves out smooth edges, shadows, reflections and blending between mipmaps, and draws round shapes a little
coarser; `high` has all of these; `auto` is `fast` with software rendering and `high` otherwise."""


class Appearance(Struct, kw_only=True, frozen=True, omit_defaults=True):
    """What pictures of a scene depend on besides its model.

    Attributes:
        quality: How well to draw.
        classes: Class or mesh by actor name; it determines the colours of `semantic` and `instance`.
    """

    quality: RenderQuality = "auto"
    classes: dict[str, str] = {}

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Self:
        """Read the appearance from a compiled scene; the default if it contains none.

        Raises:
            ValueError: The text is not an appearance.
        """
        text = model_text(model, APPEARANCE_TEXT)
        try:
            return cls() if text is None else msgspec.json.decode(text, type=cls)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"the scene's text {APPEARANCE_TEXT!r}: {error}") from None

    def texts(self) -> dict[str, str]:
        """Return the custom text elements that store it; none for the default."""
        return {} if self == type(self)() else {APPEARANCE_TEXT: msgspec.json.encode(self).decode()}


class Tints:
    """The actors of the geoms, and their colours in the segmentation modes, as blue, green, red.

    The colours are reproducible. The group of an articulation is the CRC-32 of its class name, that of a prop the
    CRC-32 of its mesh file's stem or its shape. A tint's seed is 1 + (group) for `semantic` and 1 + ((group *
    2654435761 mod 2^32) xor body id) for `instance`, with 31 bits kept of what is in the outer brackets. With h(base)
    the radical inverse of the seed, hue is h(7), saturation 0.5 + 0.5 h(3) and value 0.6 + 0.4 h(5). Tints are flat;
    the background is black.
    """

    def __init__(self, model: mujoco.MjModel, classes: Mapping[str, str], bodies: Mapping[int, str]) -> None:
        """Prepare for a model.

        Args:
            model: The compiled scene.
            classes: Class or mesh by actor name; it determines the colour.
            bodies: Actor name of the articulation by body id; other bodies are identified by their names.
        """
        self._model = model
        self._classes = classes
        self._bodies = bodies
        self._found: dict[CameraMode, Bytes] = {}

    def of(self, mode: CameraMode) -> Bytes:
        """Return the colours, shape (ngeom, 3); geoms without an actor are black."""
        if mode not in self._found:
            self._found[mode] = self._compute(mode)
        return self._found[mode]

    def owned_by(self, actor: str) -> NDArray[np.bool_]:
        """Return which geoms belong to an actor, by its name; shape (ngeom,)."""
        return np.array([owner == actor for owner in self._owners], np.bool_)

    @cached_property
    def _owners(self) -> list[str]:
        """Name of the actor that a geom belongs to; empty for none."""
        model = self._model
        return [
            self._bodies.get(body)
            or (self._owner(model.body(body).name) if body else "")
            or self._owner(model.geom(geom).name)
            for geom, body in enumerate(model.geom_bodyid.tolist())
        ]

    def _compute(self, mode: CameraMode) -> Bytes:
        model = self._model
        colors = np.zeros((model.ngeom, 3), np.uint8)
        for geom, (owner, body) in enumerate(zip(self._owners, model.geom_bodyid.tolist(), strict=True)):
            if owner:
                group = zlib.crc32(self._classes.get(owner, owner).encode())
                red, green, blue = tint(group, body if mode is CameraMode.INSTANCE else None)
                colors[geom] = blue, green, red
        return colors

    def _owner(self, name: str) -> str:
        """Return the actor whose name a compiled name begins with; the longest, if several do."""
        return max(
            (actor for actor in self._classes if name.startswith(f"{actor}_") or name == actor), key=len, default=""
        )


def tint(group: int, body: int | None) -> tuple[int, int, int]:
    """Return red, green, blue of a group, for `semantic`, or of one of its bodies, for `instance`.

    Args:
        group: 32-bit hash of the group's name.
        body: Body id; None for the whole group.
    """
    mixed = group if body is None else group * 2654435761 % 2**32 ^ body
    seed = (mixed & 0x7FFFFFFF) + 1
    hue, saturation, value = _inverse(seed, 7), 0.5 + 0.5 * _inverse(seed, 3), 0.6 + 0.4 * _inverse(seed, 5)
    red, green, blue = (round(255.0 * channel) for channel in colorsys.hsv_to_rgb(hue, saturation, value))
    return red, green, blue


def _inverse(seed: int, base: int) -> float:
    """Return the radical inverse: the seed's digits mirrored at the point."""
    result, share = 0.0, 1.0
    while seed > 0:
        share /= base
        seed, digit = divmod(seed, base)
        result += digit * share
    return result
