"""What varies, and by how much: as Python objects, TOML or JSON. Knows nothing of MuJoCo."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Literal, Self, get_args

import msgspec
from msgspec import Struct

from urlab_client.protocol.errors import URLabError

__all__ = [
    "MODEL_TEXT",
    "MODEST",
    "QUANTITIES",
    "CameraLatency",
    "Delay",
    "Field",
    "Noise",
    "Push",
    "Quantity",
    "Randomisation",
    "Range",
    "UnsupportedRandomisation",
    "Vary",
    "Vector",
    "steps_range",
]

MODEL_TEXT: Final = "urlab_randomise"
"""Name of the custom text element with which a server's compiled model tells what it varies, as JSON."""

Vector = tuple[float, float, float]
Bound = float | Vector
Range = tuple[Bound, Bound]
"""Lowest and highest value: numbers, or three numbers each for vectors, whose components are drawn separately."""

Steps = int | tuple[int, int]
"""A number of actions, or the lowest and highest one of a draw for each episode."""

Field = Literal["qpos", "qvel", "ctrl", "act", "sensors", "task"]

Quantity = Literal[
    "friction",
    "mass",
    "inertia",
    "centre_of_mass",
    "armature",
    "damping",
    "friction_loss",
    "stiffness",
    "kp",
    "kv",
    "strength",
    "gravity",
    "position",
    "base_position",
    "base_yaw",
    "light_position",
    "light_colour",
    "colour",
    "camera_position",
    "camera_rotation",
    "camera_fovy",
]

_VECTORS: Final = frozenset(
    {"centre_of_mass", "gravity", "base_position", "light_position", "camera_position", "camera_rotation", "colour"}
)
_SCALE_ONLY: Final = frozenset({"inertia", "kp", "kv", "strength"})
_ADD_ONLY: Final = frozenset({"camera_rotation"})
_NO_SCALE: Final = frozenset({"position", "base_position", "base_yaw", "light_position", "camera_position"})


def steps_range(steps: Steps) -> tuple[int, int]:
    """Return the lowest and highest of a number of actions."""
    return (steps, steps) if isinstance(steps, int) else steps


def _check_range(what: str, given: Range) -> None:
    lows, highs = (bound if isinstance(bound, tuple) else (bound,) for bound in given)
    if len(lows) != len(highs) or not all(
        math.isfinite(a) and math.isfinite(b) and a <= b for a, b in zip(lows, highs, strict=True)
    ):
        raise ValueError(f"{what} takes a lowest and a highest value, not {list(given)}")


class UnsupportedRandomisation(URLabError):
    """A server cannot vary what a `Randomisation` declares: its protocol has no op for it.

    Attributes:
        quantities: What it cannot vary, as `Vary.what`.
        address: The server.
    """

    def __init__(self, quantities: tuple[str, ...], address: str) -> None:
        self.quantities = quantities
        self.address = address
        super().__init__(
            f"The server at {address} does not vary its scene, and no op of its protocol changes "
            f"{', '.join(quantities)} during play.",
            hint=(
                "Over the wire, gravity, position, base_position, base_yaw, and kp and kv of PD controllers can vary. "
                "For the rest, use a sim:// address, or start the server with `urlab serve --randomise FILE`."
            ),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.quantities, self.address)


class _Declared(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of all parts."""


class Vary(_Declared, frozen=True, kw_only=True):
    """Something that has another value in each episode. Exactly one of `scale`, `add` and `set` is given.

    Attributes:
        what: The quantity.
        on: Elements that have it, `ARTICULATION/NAME` with `*` and `?`, or several of those; `*` for all.
        scale: Factors.
        add: Offsets, in the quantity's unit.
        set: Values, in the quantity's unit.
        distribution: `uniform`, or `log-uniform` for factors and values above 0.
        together: One draw for all elements, instead of one for each.
    """

    what: Quantity
    on: str | tuple[str, ...] = "*"
    scale: Range | None = None
    add: Range | None = None
    set: Range | None = None
    distribution: Literal["uniform", "log-uniform"] = "uniform"
    together: bool = False

    def __post_init__(self) -> None:
        given = [name for name in ("scale", "add", "set") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"{self.what} needs one of scale, add and set, not {' and '.join(given) or 'none'}")
        allowed = {
            **dict.fromkeys(_SCALE_ONLY, ("scale",)),
            **dict.fromkeys(_ADD_ONLY, ("add",)),
            **dict.fromkeys(_NO_SCALE, ("add", "set")),
        }.get(self.what, ("scale", "add", "set"))
        if self.by not in allowed:
            raise ValueError(f"{self.what} takes {' or '.join(allowed)}, not {self.by}")
        _check_range(f"{self.what}: {self.by}", self.range)
        low, _ = self.range
        if isinstance(low, tuple) and self.what not in _VECTORS and self.what != "light_colour":
            raise ValueError(f"{self.what} is a number: {self.by} takes a lowest and a highest number")
        lowest = min(low) if isinstance(low, tuple) else low
        if self.distribution == "log-uniform" and (lowest <= 0 or self.by == "add"):
            raise ValueError(f"{self.what}: log-uniform is for factors and values above 0")
        if self.by == "scale" and lowest < 0:
            raise ValueError(f"{self.what}: a factor is at least 0, not {lowest}")
        if self.what == "gravity" and self.on != "*":
            raise ValueError("gravity is that of the whole scene: leave `on` out")

    @property
    def by(self) -> Literal["scale", "add", "set"]:
        """Which of the three is given."""
        return "scale" if self.scale is not None else "add" if self.add is not None else "set"

    @property
    def range(self) -> Range:
        """The range that is given."""
        found = self.scale or self.add or self.set
        if found is None:
            raise ValueError(f"{self.what} has no range")
        return found

    @property
    def width(self) -> int:
        """How many numbers are drawn for an element: 3 for vectors, else 1. A vector is scaled by one factor."""
        low, _ = self.range
        return 3 if isinstance(low, tuple) or (self.what in _VECTORS and self.by != "scale") else 1

    @property
    def patterns(self) -> tuple[str, ...]:
        """The names in `on`."""
        return (self.on,) if isinstance(self.on, str) else self.on


class Push(_Declared, frozen=True, kw_only=True):
    """Pushes against a body, again and again. Environments apply them, on any server.

    Attributes:
        body: The body, `ARTICULATION/NAME`.
        force: Lowest and highest force along each axis of the world frame, N.
        every: Lowest and highest number of actions from the end of a push, or the start, to the next one.
        lasts: Actions that a push lasts.
    """

    body: str
    force: Range
    every: tuple[int, int]
    lasts: int = 1

    def __post_init__(self) -> None:
        _check_range("push: force", self.force)
        if not 0 <= self.every[0] <= self.every[1]:
            raise ValueError(f"push: every takes two numbers of actions, lowest first, not {list(self.every)}")
        if self.lasts < 1:
            raise ValueError(f"push: lasts must be at least 1 action, not {self.lasts}")


class Noise(_Declared, frozen=True, kw_only=True):
    """What is wrong with the numbers of an observed field. Rewards and ends are judged without it.

    Attributes:
        field: `qpos`, `qvel`, `ctrl`, `act` or `sensors`, or `task` for what a task adds.
        articulation: Key of the articulation, with `*` and `?`.
        std: Standard deviation of what is added to each number of each sample.
        uniform: Largest deviation of what is added, uniformly, to each number of each sample.
        bias: Largest deviation of what is added to each number for a whole episode.
    """

    field: Field
    articulation: str = "*"
    std: float = 0.0
    uniform: float = 0.0
    bias: float = 0.0

    def __post_init__(self) -> None:
        for name in ("std", "uniform", "bias"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"noise on {self.field}: {name} must be 0 or more, not {getattr(self, name)}")


class Delay(_Declared, frozen=True, kw_only=True):
    """What comes late, in actions. A range is drawn from for each episode.

    Attributes:
        observation: How many actions ago what is observed was so; cameras have a latency of their own.
        action: How many actions later an action has effect; set-points are zero until then.
        drop: Probability that an observation is lost, and the one before is seen again.
    """

    observation: Steps = 0
    action: Steps = 0
    drop: float = 0.0

    def __post_init__(self) -> None:
        for name in ("observation", "action"):
            low, high = steps_range(getattr(self, name))
            if not 0 <= low <= high:
                raise ValueError(f"delay: {name} must be 0 or more actions, lowest first, not {low} to {high}")
        if not 0 <= self.drop < 1:
            raise ValueError(f"delay: drop must be a probability below 1, not {self.drop}")


class CameraLatency(_Declared, frozen=True, kw_only=True):
    """How late pictures come, by the simulation's clock. For batches, and servers with the op `set_camera_delay`.

    Attributes:
        camera: The camera, `ARTICULATION/CAMERA` with `*` and `?`.
        delay_s: Latency, seconds.
        jitter_s: Largest deviation from that, seconds.
    """

    camera: str = "*"
    delay_s: float = 0.0
    jitter_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("delay_s", "jitter_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"camera: {name} must be 0 or more seconds, not {getattr(self, name)}")


class Randomisation(_Declared, frozen=True, kw_only=True):
    """What varies from episode to episode, and what is wrong with sensors and actuators.

    Attributes:
        vary: Quantities of the model and the start.
        push: Pushes.
        noise: Noise on observations.
        delay: What comes late.
        camera: Latency of cameras.
    """

    vary: tuple[Vary, ...] = ()
    push: tuple[Push, ...] = ()
    noise: tuple[Noise, ...] = ()
    delay: Delay = Delay()
    camera: tuple[CameraLatency, ...] = ()

    @property
    def disturbs_observations(self) -> bool:
        """Whether what is seen differs from what is."""
        return bool(self.noise) or steps_range(self.delay.observation)[1] > 0 or self.delay.drop > 0

    @property
    def delays_actions(self) -> bool:
        """Whether actions have effect later."""
        return steps_range(self.delay.action)[1] > 0

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a TOML file.

        Raises:
            OSError: It cannot be read.
            ValueError: It declares something that there is not; the message says where.
        """
        return cls._decoded(Path(path).read_bytes(), msgspec.toml.decode, str(Path(path)))

    @classmethod
    def from_json(cls, text: str | bytes) -> Self:
        """Read what `to_json` returned.

        Raises:
            ValueError: It declares something that there is not.
        """
        return cls._decoded(text, msgspec.json.decode, "randomisation")

    @classmethod
    def of(cls, given: str | os.PathLike[str] | Randomisation) -> Randomisation:
        """Return a declaration as given, from JSON (which begins with a brace), or from a TOML file.

        Raises:
            OSError: The file cannot be read.
            ValueError: It declares something that there is not.
        """
        if isinstance(given, Randomisation):
            return given
        text = os.fspath(given)
        return cls.from_json(text) if text.lstrip().startswith("{") else cls.load(text)

    def to_json(self) -> str:
        """Return the declaration as one line of JSON."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def _decoded(cls, text: str | bytes, decode: Callable[..., Any], source: str) -> Self:
        try:
            return decode(text, type=cls)
        except (msgspec.ValidationError, msgspec.DecodeError) as error:
            raise ValueError(f"{source}: {error}") from None


MODEST: Final = Randomisation(
    vary=(
        Vary(what="friction", scale=(0.7, 1.3)),
        Vary(what="mass", scale=(0.9, 1.1)),
        Vary(what="damping", scale=(0.8, 1.2)),
        Vary(what="strength", scale=(0.9, 1.1)),
        Vary(what="position", add=(-0.05, 0.05)),
    )
)
"""A little of what robots with actuated joints vary in, for whoever declares nothing of their own."""

QUANTITIES: Final[tuple[Quantity, ...]] = get_args(Quantity)
"""Everything that can vary."""
