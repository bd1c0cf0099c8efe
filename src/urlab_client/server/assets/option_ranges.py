"""Which numbers of `mjOption` make sense, and how many iterations a client may ask for.

For the sandbox, the compiler of scenes and `set_sim_options`. MuJoCo checks none of them: a timestep of 0 stops time,
one that is not a number spoils the state for good, and a solver with billions of iterations does not come back.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Final

from urlab_client.server.limits import Limits

__all__ = ["option_problem", "options_problem"]

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
_ITERATIONS: Final = (
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
    "sdf_iterations",
    "sdf_initpoints",
)


def option_problem(name: str, value: Any, limits: Limits) -> str:
    """Return what is wrong with the value of an option, or nothing; options without a range may have any.

    Args:
        name: As in `mjOption`.
        value: A number, or three.
        limits: For the iterations.
    """
    if name in _POSITIVE and not 0.0 < value < math.inf:
        return f"{name} must be a positive number, not {value}"
    if name in _NOT_NEGATIVE and not 0.0 <= value < math.inf:
        return f"{name} must not be negative, and be finite: {value} is not possible"
    if name in _VECTORS and not all(map(math.isfinite, value)):
        return f"{name} must be three finite numbers, not {', '.join(map(str, value))}"
    if name in _ITERATIONS and not 0 <= value <= limits.solver_iterations:
        return f"{name} must be from 0 to the limit solver_iterations, {limits.solver_iterations}, not {value}"
    return ""


def options_problem(option: Any, limits: Limits) -> str:
    """Return what is wrong with a model's `mjOption`, or nothing."""
    return next(filter(None, (option_problem(name, getattr(option, name), limits) for name in _all_ranges())), "")


def _all_ranges() -> Iterable[str]:
    return (*_POSITIVE, *_NOT_NEGATIVE, *_VECTORS, *_ITERATIONS)
