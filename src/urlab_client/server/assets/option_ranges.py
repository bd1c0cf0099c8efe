"""How many iterations a client may ask for, besides which numbers of `mjOption` make sense.

For the sandbox, the compiler of scenes and `set_sim_options`. MuJoCo checks none of them, and a solver with billions of
iterations does not come back.
"""

from __future__ import annotations

from typing import Any

from urlab_client.protocol import sim_options
from urlab_client.server.limits import Limits

__all__ = ["option_problem", "options_problem"]


def option_problem(name: str, value: Any, limits: Limits) -> str:
    """Return what is wrong with the value of an option, or nothing; options without a range may have any.

    Args:
        name: As in `mjOption`.
        value: A number, or three.
        limits: For the iterations.
    """
    if name in sim_options.ITERATIONS and not 0 <= value <= limits.solver_iterations:
        return f"{name} must be from 0 to the limit solver_iterations, {limits.solver_iterations}, not {value}"
    return sim_options.option_problem(name, value)


def options_problem(option: Any, limits: Limits) -> str:
    """Return what is wrong with a model's `mjOption`, or nothing."""
    problems = (option_problem(name, getattr(option, name), limits) for name in sim_options.RANGED_OPTIONS)
    return next(filter(None, problems), "")
