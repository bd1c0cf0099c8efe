"""What pictures of a scene depend on besides its model, and how the model tells of it.

A batch of copies draws a server's scene without the server: what it knows of it is the compiled model.
"""

from __future__ import annotations

from typing import Final, Literal, Self, TypeAlias

import msgspec
import mujoco
from msgspec import Struct

from urlab_client.randomise.variation import model_text

__all__ = ["APPEARANCE_TEXT", "Appearance", "RenderQuality"]

APPEARANCE_TEXT: Final = "urlab_pictures"
"""Name of the custom text element with which a server's compiled model tells, as JSON, what is not the default."""

RenderQuality: TypeAlias = Literal["auto", "fast", "high"]
"""`fast` leaves out smooth edges, shadows, reflections and blending between mipmaps, and draws round shapes a little
coarser; `high` does not; `auto` is `fast` where the processor draws and `high` elsewhere."""


class Appearance(Struct, kw_only=True, frozen=True, omit_defaults=True):
    """What pictures of a scene depend on besides its model.

    Attributes:
        quality: How well to draw.
        classes: By actor name, the class or mesh that the colours of `semantic` and `instance` go by.
    """

    quality: RenderQuality = "auto"
    classes: dict[str, str] = {}

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Self:
        """Return what a compiled scene tells; the default where it tells nothing.

        Raises:
            ValueError: It tells something else.
        """
        text = model_text(model, APPEARANCE_TEXT)
        try:
            return cls() if text is None else msgspec.json.decode(text, type=cls)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"the scene's text {APPEARANCE_TEXT!r}: {error}") from None

    def texts(self) -> dict[str, str]:
        """Return the custom text elements that tell it; none for the default."""
        return {} if self == type(self)() else {APPEARANCE_TEXT: msgspec.json.encode(self).decode()}
