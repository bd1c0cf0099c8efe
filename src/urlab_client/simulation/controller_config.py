"""Which controller an articulation gets, in a program or as a line of text. Needs no MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from urlab_client.enums import ControllerKind

CUSTOM_TEXT: Final = "urlab_controller"
"""Name of the custom text element that names a model's controller."""

GAINS: Final = ("kp", "kv", "torque_limit")


@dataclass(frozen=True, slots=True)
class ControllerConfig:
    """Controller the server's configuration attaches to an articulation.

    Attributes:
        kind: `pd` or `passthrough`.
        kp: Proportional gain every bound actuator starts with (N m/rad, N/m).
        kv: Derivative gain every bound actuator starts with (N m s/rad, N s/m).
        torque_limit: Bound on the magnitude of the output (N m, N); 0 means no output at all.
    """

    kind: ControllerKind = ControllerKind.PD
    kp: float = 100.0
    kv: float = 5.0
    torque_limit: float = 200.0

    def __post_init__(self) -> None:
        # A plain string, too, is the kind of its name; anything else is a ValueError here.
        object.__setattr__(self, "kind", ControllerKind(self.kind))

    @classmethod
    def parse(cls, text: str) -> ControllerConfig:
        """Parse a line of text: `pd`, `pd,kp=100,kv=5`, `passthrough`.

        The syntax is the same on the command line, in level files and in an MJCF's `<custom><text
        name="urlab_controller" …/></custom>`.

        Raises:
            ValueError: The kind or a gain is unknown, or a gain is not a number of at least 0.
        """
        kind, *gains = (part.strip() for part in text.split(","))
        if kind not in [*ControllerKind]:
            raise ValueError(f"{kind!r} is not a controller; the controllers are {', '.join(ControllerKind)}")
        if gains and kind != ControllerKind.PD:
            raise ValueError(f"{gains[0]!r}: a {kind} controller has no gains")
        return cls(ControllerKind(kind), **dict(map(_gain, gains)))


def _gain(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    if name not in GAINS:
        raise ValueError(f"{text!r} is not a gain; write {', '.join(f'{name}=N' for name in GAINS)}")
    try:
        value = float(number)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise ValueError(f"{text!r}: {name} is a number from 0")
    return name, value
