"""Validation of `mjOption` values, for requests, replies and the server. No I/O.

MuJoCo checks none of them: a timestep of 0 stops time, and NaN spoils the state for good.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from msgspec.structs import replace

from urlab_client.values.types import SimOptions

_POSITIVE: Final = ("timestep", "impratio")
_NOT_NEGATIVE: Final = (
    "density",
    "viscosity",
    "tolerance",
    "ls_tolerance",
    "noslip_tolerance",
    "ccd_tolerance",
    "sleep_tolerance",
)
_VECTORS: Final = ("gravity", "wind", "magnetic")
ITERATIONS: Final = (
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
    "sdf_iterations",
    "sdf_initpoints",
)
"""Maximum numbers of a solver's iterations."""

RANGED_OPTIONS: Final = (*_POSITIVE, *_NOT_NEGATIVE, *_VECTORS, *ITERATIONS)
"""Options that are limited to a range."""

_FLOATS: Final = (*_POSITIVE, *_NOT_NEGATIVE, *_VECTORS)
_INT32: Final = np.iinfo(np.int32)


def option_problem(name: str, value: Any) -> str:
    """Return what is wrong with the value of an option, or an empty string.

    Args:
        name: As in `mjOption`.
        value: A number, or three.
    """
    if name in _POSITIVE and not 0.0 < value < math.inf:
        return f"{name} must be a positive number, not {value}"
    if name in _NOT_NEGATIVE and not 0.0 <= value < math.inf:
        return f"{name} must not be negative, and be finite: {value} is not possible"
    if name in _VECTORS and not all(map(math.isfinite, value)):
        return f"{name} must be three finite numbers, not {', '.join(map(str, value))}"
    if name in ITERATIONS and value < 0:
        return f"{name} must not be negative: {value} is not possible"
    return ""


def in_small_letters(options: SimOptions) -> SimOptions:
    """Return options with lower-case keywords, as in the reference and the alpha; the beta replies `RK4` and `CG`."""
    words = {name: getattr(options, name) for name in ("integrator", "cone", "solver")}
    return replace(options, **{name: word.lower() for name, word in words.items() if word is not None})


def check_sim_options(options: SimOptions) -> None:
    """Check that a simulation can continue with these options.

    Raises:
        ValueError: A value is out of its range; the message names the option, the value and the range.
    """
    for name in SimOptions.__struct_fields__:
        value = getattr(options, name)
        if value is None:
            continue
        if isinstance(value, int) and not _INT32.min <= value <= _INT32.max:
            raise ValueError(f"{name} must be an integer of 32 bits, not {value}")
        with np.errstate(over="ignore"):  # the server keeps numbers as float32, in which very large ones are infinite
            problem = option_problem(name, np.float32(value).tolist() if name in _FLOATS else value)
        if problem:
            raise ValueError(problem)
