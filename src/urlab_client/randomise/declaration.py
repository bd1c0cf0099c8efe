"""The declaration of variations, as Python objects, TOML or JSON. Independent of MuJoCo."""

from __future__ import annotations

import fnmatch
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final, Literal, Self, cast

import msgspec
from msgspec import Struct

from urlab_client.errors import URLabError

MODEL_TEXT: Final = "urlab_randomise"
"""Name of the custom text element of a server's compiled model that contains its declaration as JSON."""

Vector = tuple[float, float, float]
Bound = float | Vector
Range = tuple[Bound, Bound]
"""Lowest and highest value: numbers, or three numbers each for vectors, whose components are drawn separately."""

Steps = int | tuple[int, int]
"""A number of actions or physics steps, or a range from which one is drawn for each episode."""

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
    "velocity",
    "base_velocity",
    "base_spin",
    "light_position",
    "light_colour",
    "colour",
    "specular",
    "shininess",
    "reflectance",
    "camera_position",
    "camera_rotation",
    "camera_fovy",
]

_START: Final = ("position", "base_position", "base_yaw", "velocity", "base_velocity", "base_spin")
_VECTORS: Final = frozenset(
    {
        "centre_of_mass",
        "gravity",
        "base_position",
        "base_velocity",
        "base_spin",
        "light_position",
        "camera_position",
        "camera_rotation",
        "colour",
    }
)
_WAYS: Final[dict[str, tuple[str, ...]]] = {
    **dict.fromkeys(("inertia", "kp", "kv", "strength"), ("scale",)),
    **dict.fromkeys((*_START, "light_position", "camera_position"), ("add", "set")),
    "camera_rotation": ("add",),
}
"""How quantities can vary that cannot vary in all ways."""


def steps_range(steps: Steps) -> tuple[int, int]:
    """Return a number of actions as a range."""
    return (steps, steps) if isinstance(steps, int) else steps


def _plain(value: Any) -> Any:
    """Return numbers and arrays of NumPy as those of Python."""
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in cast("Sequence[Any]", value)]
    return value.tolist() if hasattr(value, "tolist") else value


def _check_range(what: str, given: Range) -> None:
    lows, highs = (bound if isinstance(bound, tuple) else (bound,) for bound in given)
    if len(lows) != len(highs) or not all(
        math.isfinite(a) and math.isfinite(b) and a <= b for a, b in zip(lows, highs, strict=True)
    ):
        raise ValueError(f"{what} takes a lowest and a highest value, not {list(given)}")


class UnsupportedRandomisation(URLabError):
    """A server cannot apply a `Randomisation`, because its protocol lacks an op.

    Attributes:
        quantities: Quantities that it cannot vary, as in `Vary.what`.
        address: Address of the server.
    """

    def __init__(self, quantities: tuple[str, ...], address: str) -> None:
        self.quantities = quantities
        self.address = address
        super().__init__(
            f"The server at {address} does not vary its scene, and no op of its protocol changes "
            f"{', '.join(quantities)} during play.",
            hint=(
                f"Over the wire, gravity, {', '.join(_START)}, and kp and kv of PD controllers can vary. "
                "For the rest, use a sim:// address, or start the server with `urlab serve --randomise FILE`."
            ),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.quantities, self.address)


class _Declared(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base class of all parts of a declaration, which are checked and converted as if they were read from a file."""

    def __post_init__(self) -> None:
        for field in msgspec.structs.fields(self):
            try:
                plain = msgspec.to_builtins(_plain(getattr(self, field.name)))
                msgspec.structs.force_setattr(self, field.name, msgspec.convert(plain, field.type))
            except (msgspec.ValidationError, TypeError) as error:
                raise ValueError(f"{type(self).__name__.lower()}: {field.name}: {error}") from None


class Vary(_Declared, frozen=True, kw_only=True):
    """A quantity whose value varies between episodes. Give exactly one of `scale`, `add` and `set`.

    Attributes:
        what: The quantity.
        on: Elements, as `ARTICULATION/NAME` with wildcards `*` and `?`, or a list of these; `*` for all.
        scale: Factors.
        add: Offsets, in the unit of the quantity.
        set: Values, in the unit of the quantity.
        distribution: `uniform`, or `log-uniform` for factors and values above 0.
        together: Use one draw for all elements instead of one for each.
    """

    what: Quantity
    on: str | tuple[str, ...] = "*"
    scale: Range | None = None
    add: Range | None = None
    set: Range | None = None
    distribution: Literal["uniform", "log-uniform"] = "uniform"
    together: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [name for name in ("scale", "add", "set") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"{self.what} needs one of scale, add and set, not {' and '.join(given) or 'none'}")
        allowed = _WAYS.get(self.what, ("scale", "add", "set"))
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
            raise ValueError("gravity applies to the whole scene: omit `on`")

    @property
    def by(self) -> Literal["scale", "add", "set"]:
        """The one of `scale`, `add` and `set` that is given."""
        return "scale" if self.scale is not None else "add" if self.add is not None else "set"

    @property
    def range(self) -> Range:
        """The given range."""
        found = self.scale or self.add or self.set
        if found is None:
            raise ValueError(f"{self.what} has no range")
        return found

    @property
    def width(self) -> int:
        """Numbers drawn per element: 3 for vectors, otherwise 1. A vector is scaled by one factor."""
        low, _ = self.range
        return 3 if isinstance(low, tuple) or (self.what in _VECTORS and self.by != "scale") else 1

    @property
    def patterns(self) -> tuple[str, ...]:
        """The names in `on`."""
        return (self.on,) if isinstance(self.on, str) else self.on


class Push(_Declared, frozen=True, kw_only=True):
    """Repeated pushes against a body. Environments apply them, on any server.

    Attributes:
        body: The body, `ARTICULATION/NAME`.
        force: Lowest and highest force along each axis of the world frame, N.
        every: Lowest and highest number of actions from the end of a push, or the start, to the next one.
        lasts: Duration of a push in actions.
    """

    body: str
    force: Range
    every: tuple[int, int]
    lasts: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_range("push: force", self.force)
        if not 0 <= self.every[0] <= self.every[1]:
            raise ValueError(f"push: every takes two numbers of actions, lowest first, not {list(self.every)}")
        if self.lasts < 1:
            raise ValueError(f"push: lasts must be at least 1 action, not {self.lasts}")


class Noise(_Declared, frozen=True, kw_only=True):
    """Noise on an observed field. Rewards and terminations are computed without it.

    Attributes:
        field: `qpos`, `qvel`, `ctrl`, `act` or `sensors`, or `task` for the task's part of the observation.
        articulation: Key of the articulation, with wildcards `*` and `?`.
        std: Standard deviation of Gaussian noise on each number of each sample.
        uniform: Largest deviation of uniform noise on each number of each sample.
        bias: Largest deviation of an offset of each number, constant during an episode.
    """

    field: Field
    articulation: str = "*"
    std: float = 0.0
    uniform: float = 0.0
    bias: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("std", "uniform", "bias"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"noise on {self.field}: {name} must be 0 or more, not {getattr(self, name)}")


class Delay(_Declared, frozen=True, kw_only=True):
    """Delays in actions. From a range, one value is drawn for each episode.

    Attributes:
        observation: Age of observations in actions; cameras have a separate latency.
        action: Number of actions after which an action takes effect. Until then the set-points hold the keyframe.
        action_substeps: Physics steps of further delay of an action.
        drop: Probability that an observation is lost, so that the previous one is repeated.
    """

    observation: Steps = 0
    action: Steps = 0
    action_substeps: Steps = 0
    drop: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("observation", "action", "action_substeps"):
            low, high = steps_range(getattr(self, name))
            if not 0 <= low <= high:
                unit = "physics steps" if name == "action_substeps" else "actions"
                raise ValueError(f"delay: {name} must be 0 or more {unit}, lowest first, not {low} to {high}")
        if not 0 <= self.drop < 1:
            raise ValueError(f"delay: drop must be a probability below 1, not {self.drop}")


class CameraLatency(_Declared, frozen=True, kw_only=True):
    """Latency of cameras in simulation time. For batches, and servers with the op `set_camera_delay`.

    Attributes:
        camera: The camera, `ARTICULATION/CAMERA` with wildcards `*` and `?`.
        delay_s: Latency, seconds.
        jitter_s: Largest deviation from the latency, seconds.
    """

    camera: str = "*"
    delay_s: float = 0.0
    jitter_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("delay_s", "jitter_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"camera: {name} must be 0 or more seconds, not {getattr(self, name)}")


class Randomisation(_Declared, frozen=True, kw_only=True):
    """Variations between episodes, and imperfections of sensors and actuators.

    Attributes:
        vary: Quantities of the model and the initial state.
        push: Pushes.
        noise: Noise on observations.
        delay: Delays of observations and actions.
        camera: Latency of cameras.
    """

    vary: tuple[Vary, ...] = ()
    push: tuple[Push, ...] = ()
    noise: tuple[Noise, ...] = ()
    delay: Delay = Delay()
    camera: tuple[CameraLatency, ...] = ()

    @property
    def disturbs_observations(self) -> bool:
        """Whether observations differ from the true state."""
        return bool(self.noise) or steps_range(self.delay.observation)[1] > 0 or self.delay.drop > 0

    @property
    def delays_actions(self) -> bool:
        """Whether actions are delayed."""
        return any(steps_range(steps)[1] for steps in (self.delay.action, self.delay.action_substeps))

    def latencies(self, cameras: Iterable[str]) -> dict[str, CameraLatency]:
        """Return the latencies of the cameras that have one; the last entry that names a camera applies."""
        names = [*cameras]
        return {name: late for late in self.camera for name in names if fnmatch.fnmatchcase(name, late.camera)}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a TOML file.

        Raises:
            OSError: The file cannot be read.
            ValueError: The declaration is invalid; the message says where.
        """
        return cls._decoded(Path(path).read_bytes(), msgspec.toml.decode, str(Path(path)))

    @classmethod
    def from_json(cls, text: str | bytes) -> Self:
        """Parse the result of `to_json`.

        Raises:
            ValueError: The declaration is invalid.
        """
        return cls._decoded(text, msgspec.json.decode, "randomisation")

    @classmethod
    def of(cls, given: str | os.PathLike[str] | Randomisation) -> Randomisation:
        """Return a declaration given as object, as JSON (which begins with a brace), or as a TOML file.

        Raises:
            OSError: The file cannot be read.
            TypeError: It is none of these.
            ValueError: The declaration is invalid.
        """
        if isinstance(given, Randomisation):
            return given
        try:
            text = os.fsdecode(given)
        except TypeError:
            raise TypeError(f"a randomisation is a Randomisation, JSON or a TOML file, got {given!r:.80}") from None
        return cls.from_json(text) if text.lstrip().startswith("{") else cls.load(text)

    def to_json(self) -> str:
        """Return the declaration as one line of JSON."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def _decoded(cls, text: str | bytes, decode: Callable[..., Any], source: str) -> Self:
        try:
            return decode(text, type=cls)
        except (ValueError, RecursionError) as error:
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
"""A small default randomisation for robots with actuated joints."""
