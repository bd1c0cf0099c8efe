"""The options of the models in a scene: which apply, and which have no effect.

Merges options as `MjSpec.attach` does since MuJoCo 3.11.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, Literal, TypeAlias

import mujoco
import numpy as np

from urlab_client._mujoco import copy_options, option_names
from urlab_client.server.assets.actors import Actor
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.refusal import CompileFailed

OptionPolicy: TypeAlias = Literal["ignored", "first", "merged"]
"""Which `<option>` the scene gets: none, that of the first articulation, or all of them merged."""

_SMALLEST: Final = frozenset({"timestep", "tolerance", "ls_tolerance"}) | {
    f"{kind}_tolerance" for kind in ("noslip", "ccd", "sleep")
}
_LARGEST: Final = frozenset({"iterations", "sdf_initpoints"}) | {
    f"{kind}_iterations" for kind in ("ls", "noslip", "ccd", "sdf")
}
_UNITED: Final = frozenset({"disableflags", "enableflags", "disableactuator"})


def adopt_options(spec: mujoco.MjSpec, articulations: Iterable[tuple[Actor, Blueprint]], policy: OptionPolicy) -> None:
    """Apply the options of a scene's articulations to its spec.

    Raises:
        CompileFailed: Two of them differ in an option that cannot be merged, such as gravity or the integrator.
    """
    blueprints = list({blueprint.folder: blueprint for _, blueprint in articulations}.values())
    if policy == "first" and blueprints:
        copy_options(blueprints[0].spec.option, spec.option)
    if policy != "merged":
        return
    wanted: dict[str, tuple[str, Any]] = {}
    for blueprint in blueprints:
        for name in _authored(blueprint):
            value = getattr(blueprint.spec.option, name)
            first, before = wanted.get(name, (blueprint.stem, value))
            wanted[name] = first, _merged(name, (first, before), (blueprint.stem, value))
    for name, (_, value) in wanted.items():
        setattr(spec.option, name, value)


def _authored(blueprint: Blueprint) -> list[str]:
    own, default = blueprint.spec.option, mujoco.MjSpec().option
    return [name for name in option_names(own) if not np.array_equal(getattr(own, name), getattr(default, name))]


def _merged(name: str, one: tuple[str, Any], other: tuple[str, Any]) -> Any:
    (first, before), (second, value) = one, other
    if name in _SMALLEST:
        return min(before, value)
    if name in _LARGEST:
        return max(before, value)
    if name in _UNITED:
        return before | value
    if not np.array_equal(before, value):
        raise CompileFailed(
            f"options of the models conflict: {first} has {_option_text(name, before)}, "
            f"{second} has {_option_text(name, value)}. Give both the same, or start the server with "
            "--mjcf-options, which takes those of the first model"
        )
    return before


def ignored_options(
    spec: mujoco.MjSpec, articulations: Iterable[tuple[Actor, Blueprint]], policy: OptionPolicy
) -> list[str]:
    """Return a warning that names the models' options without effect, or none."""
    applied = mujoco.MjSpec()
    copy_options(spec.option, applied.option)
    if policy == "ignored":
        applied.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ignored: list[str] = []
    for blueprint in {blueprint.folder: blueprint for _, blueprint in articulations}.values():
        own = blueprint.spec.option
        names = [
            name
            for name in _authored(blueprint)
            if not np.array_equal(getattr(own, name), getattr(applied.option, name))
            and not (policy == "merged" and name in _UNITED)
        ]
        if names:
            ignored.append(f"{blueprint.stem}: {', '.join(_option_text(name, getattr(own, name)) for name in names)}")
    if not ignored:
        return []
    return [f"options of the models have no effect ({'; '.join(ignored)}): {_REASONS[policy]}"]


_REASONS: Final[dict[OptionPolicy, str]] = {
    "ignored": "the plugin's defaults apply; --mjcf-options (sim://MODEL?mjcf-options) takes the first model's",
    "first": "the first articulation's options apply",
    "merged": "of several models' options the smallest timestep and tolerances and the most iterations apply",
}


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
        return f"{name.removesuffix('flags')}d {' '.join(filter(None, names))}"  # the number of flags has no name
    if isinstance(value, np.ndarray):
        return f"{name} ({' '.join(f'{number:g}' for number in value.tolist())})"
    return f"{name} {value:g}"


def _constant(member: Any) -> str:
    return str(member.name).partition("_")[2]
