"""Controllers as a line of text: `pd`, `pd,kp=100,kv=5`, `passthrough`.

The syntax is the same on the command line, in level files and in an MJCF's `<custom><text name="urlab_controller"
…/></custom>`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from urlab_client.enums import ControllerKind

CUSTOM_TEXT: Final = "urlab_controller"
"""Name of the custom text element that names a model's controller."""

_GAINS: Final = ("kp", "kv", "torque_limit")


class ControllerText(NamedTuple):
    """A controller's kind, and the gains that differ from its defaults."""

    kind: ControllerKind
    gains: dict[str, float]

    @classmethod
    def parse(cls, text: str) -> ControllerText:
        """Parse a line.

        Raises:
            ValueError: The kind or a gain is unknown, or a gain is not a number of at least 0.
        """
        kind, *gains = (part.strip() for part in text.split(","))
        if kind not in [*ControllerKind]:
            raise ValueError(f"{kind!r} is not a controller; the controllers are {', '.join(ControllerKind)}")
        if gains and kind != ControllerKind.PD:
            raise ValueError(f"{gains[0]!r}: a {kind} controller has no gains")
        return cls(ControllerKind(kind), dict(map(_gain, gains)))


def _gain(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    if name not in _GAINS:
        raise ValueError(f"{text!r} is not a gain; write {', '.join(f'{name}=N' for name in _GAINS)}")
    try:
        value = float(number)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise ValueError(f"{text!r}: {name} is a number from 0")
    return name, value
