"""The options of the models in a scene: which apply, and which have no effect."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import mujoco
import numpy as np

from urlab_client.server.assets.actors import Actor
from urlab_client.server.assets.blueprint import Blueprint

__all__ = ["copy_options", "ignored_options"]


@cache
def _option_names() -> tuple[str, ...]:
    return tuple(name for name in dir(mujoco.MjSpec().option) if not name.startswith("_"))


def copy_options(source: Any, target: Any) -> None:
    """Make the options of a spec those of another."""
    for name in _option_names():
        value = getattr(source, name)
        if isinstance(value, np.ndarray):
            getattr(target, name)[:] = value
        else:
            setattr(target, name, value)


def ignored_options(
    spec: mujoco.MjSpec, articulations: Iterable[tuple[Actor, Blueprint]], *, honoured: bool
) -> list[str]:
    """Return one warning that names the options of the models that will have no effect, or none."""
    default = mujoco.MjSpec().option
    applied = mujoco.MjSpec()
    copy_options(spec.option, applied.option)
    if not honoured:
        applied.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ignored: list[str] = []
    for blueprint in {blueprint.folder: blueprint for _, blueprint in articulations}.values():
        own = blueprint.spec.option
        names = [
            name
            for name in _option_names()
            if not np.array_equal(getattr(own, name), getattr(default, name))
            and not np.array_equal(getattr(own, name), getattr(applied.option, name))
        ]
        if names:
            ignored.append(f"{blueprint.stem}: {', '.join(_option_text(name, getattr(own, name)) for name in names)}")
    if not ignored:
        return []
    reason = (
        "the first articulation's options apply"
        if honoured
        else "the plugin's defaults apply; --mjcf-options (sim://MODEL?mjcf-options) takes the first model's"
    )
    return [f"options of the models have no effect ({'; '.join(ignored)}): {reason}"]


def _option_text(name: str, value: Any) -> str:
    enumerations = {
        "integrator": mujoco.mjtIntegrator,
        "cone": mujoco.mjtCone,
        "jacobian": mujoco.mjtJacobian,
        "solver": mujoco.mjtSolver,
    }
    flags = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}
    if name in enumerations:
        return f"{name} {_constant(enumerations[name](value))}"
    if name in flags:
        names = [_constant(bit).lower() for bit in flags[name].__members__.values() if int(bit) & int(value)]
        return f"{name.removesuffix('flags')}d {' '.join(names)}"
    if isinstance(value, np.ndarray):
        return f"{name} ({' '.join(f'{number:g}' for number in value.tolist())})"
    return f"{name} {value:g}"


def _constant(member: Any) -> str:
    return str(member.name).partition("_")[2]
