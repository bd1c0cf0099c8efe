"""What `set_sim_options` remembers of a play session and does to `mjOption`.

For the handler, which holds the engine's lock. Unlike the plugin, which takes any number, it refuses those that stop
time, spoil the state or keep the solver busy for good: the server may have other users.
"""

from __future__ import annotations

import os
from typing import Any, Final

import mujoco
import numpy as np

from urlab_client._mujoco import option_choices, set_threads, thread_limit, write_options
from urlab_client.server.dialects import ALPHA, Dialect
from urlab_client.server.limits import Limits, option_problem
from urlab_client.server.refusal import Refusal
from urlab_client.simulation.controllers import float32
from urlab_client.values.types import SimOptions

_INTEGRATORS: Final = {"euler", "rk4", "implicit", "implicitfast"}  # the plugin's; a newer MuJoCo has others
CHOICES: Final = {
    option: {word: number for word, number in words.items() if option != "integrator" or word in _INTEGRATORS}
    for option, words in option_choices().items()
}
MJCF_SPELLING: Final = {"euler": "Euler", "rk4": "RK4", "pgs": "PGS", "cg": "CG", "newton": "Newton"}
SCALARS: Final = (
    "timestep",
    "density",
    "viscosity",
    "impratio",
    "tolerance",
    "noslip_tolerance",
    "ccd_tolerance",
    "sleep_tolerance",
)
SCALED: Final = ("gravity", "wind")
THREADS: Final = ("num_worker_threads", "max_worker_threads")
MASKS: Final = ("disableflags", "enableflags")
IN_ORDER: Final = tuple(name for name in SimOptions.__struct_fields__ if name not in (*THREADS, *MASKS))
"""The remembered options in the order in which a request's are looked at: an unknown name stops at its place."""

SLEEP: Final = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
NO_MULTICCD: Final = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)


class OptionOverrides:
    """The options set in one play session; all that were ever set are written again by every successful call.

    The raw masks are written once and not remembered. The plugin's two named switches move bits that mean something
    else in current MuJoCo releases, and clear them in every call; here they move the flags they are named after, and
    only once they have been used, so that raw masks stay as they were sent.
    """

    def __init__(self, model: mujoco.MjModel, limits: Limits, dialect: Dialect = ALPHA) -> None:
        self._limits = limits
        self._dialect = dialect
        self._kept: dict[str, Any] = {"integrator": int(model.opt.integrator), "sleep_tolerance": self._number(1e-4)}
        self._threads = 0

    def apply(self, model: mujoco.MjModel, data: mujoco.MjData, options: SimOptions) -> SimOptions:
        """Take over the options that are not None, write all remembered ones and return what is in force.

        Raises:
            Refusal: `bad_value`. For a number out of range nothing is changed. For an unknown integrator, cone or
                solver nothing is written, but options that come earlier in the order are remembered and take effect
                with the next successful call.
        """
        given = [(name, value) for name in IN_ORDER if (value := getattr(options, name)) is not None]
        for name, value in given:
            if name not in CHOICES and (problem := option_problem(name, self._stored(name, value), self._limits)):
                raise Refusal("bad_value", problem)
        for name, value in given:
            self._kept[name] = self._stored(name, value)
        masks = {name: mask for name in MASKS if (mask := getattr(options, name)) is not None}
        kept = {**self._kept}
        if not kept.get("enable_sleep"):
            del kept["sleep_tolerance"]
        write_options(model.opt, masks | kept)
        if options.num_worker_threads is not None:
            self._set_threads(data, options.num_worker_threads)
        return self._in_force(model)

    def _set_threads(self, data: mujoco.MjData, threads: int) -> None:
        threads = max(0, min(threads, thread_limit(_cores())))
        if threads != self._threads:
            set_threads(data, threads)
            self._threads = threads

    def _in_force(self, model: mujoco.MjModel) -> SimOptions:
        opt = model.opt
        computed: dict[str, Any] = {
            "num_worker_threads": self._threads,
            "max_worker_threads": thread_limit(_cores()),
            "enable_multiccd": not opt.disableflags & NO_MULTICCD,
            "enable_sleep": bool(opt.enableflags & SLEEP),
            **{name: self._choice(name, getattr(opt, name)) for name in CHOICES},
        }
        names = SimOptions.__struct_fields__
        return SimOptions(
            **{name: computed[name] if name in computed else _plain(getattr(opt, name)) for name in names}
        )

    def _stored(self, name: str, value: Any) -> Any:
        if name in CHOICES:
            found = CHOICES[name].get(value.casefold())
            if found is None:
                raise Refusal("bad_value", f"unknown {name} '{value}': use {', '.join(CHOICES[name])}")
            return found
        if name in SCALARS:
            return self._number(value)
        if name in SCALED:
            return [self._number(item * 100.0) / 100.0 for item in value] if self._dialect.options_float32 else value
        if name == "magnetic":
            return [self._number(item) for item in value]
        return value

    def _number(self, value: float) -> float:
        return float32(value) if self._dialect.options_float32 else value

    def _choice(self, name: str, number: int) -> str:
        """Return an option's name; a model of its own options may use one that the protocol has no name for."""
        text = next((text for text, item in CHOICES[name].items() if item == int(number)), str(int(number)))
        return text if self._dialect.options_float32 else MJCF_SPELLING.get(text, text)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _cores() -> int:
    return os.cpu_count() or 1
