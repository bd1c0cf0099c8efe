"""Which values the options of a simulation can have. For the client, in what it sends and in what it is told, and for
the simulated server. No I/O.
"""

from __future__ import annotations

from typing import Final, cast

from urlab_client.protocol.types import SimOptions

__all__ = ["check_sim_options"]

# They travel, and the server keeps them, as float32.
_FLOAT32_MAX: Final = 3.4028234663852886e38
_FLOAT32_MIN: Final = 1.1754943508222875e-38
_INT32_MAX: Final = 2**31 - 1

_ABOVE_ZERO: Final = ("timestep", "impratio")
_NOT_BELOW_ZERO: Final = (
    "density",
    "viscosity",
    "tolerance",
    "noslip_tolerance",
    "ccd_tolerance",
    "sleep_tolerance",
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
)


def check_sim_options(options: SimOptions) -> None:
    """Refuse values with which a simulation cannot go on: its time would stand still or stop being a number.

    Raises:
        ValueError: Names the option, its value and the values it can have.
    """
    for name in SimOptions.__struct_fields__:
        value: object = getattr(options, name)
        numbers = cast("tuple[object, ...]", value) if isinstance(value, tuple) else (value,)
        for number in numbers:
            if isinstance(number, float) and not abs(number) <= _FLOAT32_MAX:
                raise ValueError(f"{name} takes finite numbers, got {value}")
            if isinstance(number, int) and not isinstance(number, bool) and abs(number) > _INT32_MAX:
                raise ValueError(f"{name} takes integers of 32 bits, got {value}")
    for name in _ABOVE_ZERO:
        positive: float | None = getattr(options, name)
        if positive is not None and positive < _FLOAT32_MIN:
            raise ValueError(f"{name} must be above 0, got {positive:g}")
    for name in _NOT_BELOW_ZERO:
        positive = getattr(options, name)
        if positive is not None and positive < 0:
            raise ValueError(f"{name} must not be below 0, got {positive:g}")
