"""What pictures of a scene depend on besides its model, and how it is stored in the model.

A batch of copies draws a server's scene without the server: it has only the compiled model.
"""

from __future__ import annotations

from typing import Final, Literal, Self, TypeAlias

import msgspec
import mujoco
from msgspec import Struct

from urlab_client.randomise.variation import model_text

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
