"""What the modules declare fits together: every default is a value of its own type, and what grows is given by name."""

from __future__ import annotations

import dataclasses
import inspect
import logging
import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_origin

import msgspec
import numpy as np
import pytest

import urlab_client

HERE = Path(urlab_client.__file__).parent
PACKAGES = sorted(path.stem for path in HERE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists())
GROWING = ("protocol.messages", "events", "randomise.declaration", "integrations.policy.spec", "values.descriptions")


@cache
def modules(package: str) -> list[ModuleType]:
    """The modules of a package, as far as what they need is installed."""
    found: list[ModuleType] = []
    for path in sorted([*HERE.glob(f"{package}.py"), *(HERE / package).rglob("*.py")]):
        parts = [*path.relative_to(HERE).with_suffix("").parts]
        if {"__main__", "windows"} & {*parts}:
            continue
        try:
            found.append(import_module(".".join(["urlab_client", *parts]).removesuffix(".__init__")))
        except ImportError:
            continue
    return found


def classes(module: ModuleType) -> Iterator[type[Any]]:
    for value in vars(module).values():
        if isinstance(value, type) and value.__module__ == module.__name__:
            yield value


def struct_fields(cls: type[msgspec.Struct]) -> tuple[msgspec.structs.FieldInfo, ...]:
    try:
        return msgspec.structs.fields(cls)
    except NameError:  # of annotations that only type checkers read; nothing decodes such a struct
        return ()


def defaults(module: ModuleType) -> Iterator[tuple[str, Any, Any]]:
    """Where a module declares a default, its annotation, and the default."""
    functions = [value for value in vars(module).values() if getattr(value, "__module__", "") == module.__name__]
    for name, annotation in vars(module).get("__annotations__", {}).items():
        if name in vars(module):
            yield name, annotation, vars(module)[name]
    for cls in classes(module):
        for name, annotation in vars(cls).get("__annotations__", {}).items():
            if name in vars(cls) and (shared := re.fullmatch(r"ClassVar\[(.*)\]", str(annotation))):
                yield f"{cls.__name__}.{name}", shared[1], vars(cls)[name]
    for cls in classes(module):
        if issubclass(cls, msgspec.Struct):
            for field in struct_fields(cls):
                if field.default is not msgspec.NODEFAULT:
                    yield f"{cls.__name__}.{field.name}", field.type, field.default
        elif dataclasses.is_dataclass(cls):
            for item in dataclasses.fields(cls):
                if item.default is not dataclasses.MISSING:
                    yield f"{cls.__name__}.{item.name}", item.type, item.default
        functions += [getattr(value, "__func__", value) for value in vars(cls).values()]
    for function in filter(inspect.isfunction, functions):
        if function.__code__.co_filename != module.__file__:  # a dataclass's own
            continue
        for name, parameter in inspect.signature(function).parameters.items():
            if parameter.default is not parameter.empty:
                yield f"{function.__qualname__}({name})", parameter.annotation, parameter.default


def fits(value: Any, annotation: Any, module: ModuleType) -> bool:
    """Whether a value is of a type, as far as that is known when the program runs."""
    try:
        kind = eval(annotation, vars(module)) if isinstance(annotation, str) else annotation
        msgspec.convert(value, kind, dec_hook=lambda cls, given: given)
    except msgspec.ValidationError:
        return False
    except (NameError, TypeError):  # known to type checkers alone, or to no codec
        return value is not None or "None" in str(annotation)
    return True


@pytest.mark.parametrize("package", PACKAGES)
def test_every_default_is_a_value_of_its_own_type(package: str) -> None:
    wrong = [
        f"{module.__name__}: {where} = {value!r}, not {annotation}"
        for module in modules(package)
        for where, annotation, value in defaults(module)
        if not fits(value, annotation, module)
    ]
    assert wrong == []


@pytest.mark.parametrize("package", PACKAGES)
def test_every_constant_has_a_value(package: str) -> None:
    found = [
        (module.__name__, name) for module in modules(package) for name, value in vars(module).items() if value is None
    ]
    assert [where for where in found if where[1].isupper()] == []


@pytest.mark.parametrize("name", GROWING)
def test_what_gains_fields_is_made_by_their_names(name: str) -> None:
    """A field that is added anywhere changes no caller."""
    for module in modules(name.partition(".")[0]):
        if module.__name__.startswith(f"urlab_client.{name}"):
            structs = [cls for cls in classes(module) if issubclass(cls, msgspec.Struct)]
            kinds = {one.kind for cls in structs for one in inspect.signature(cls).parameters.values()}
            assert kinds <= {inspect.Parameter.KEYWORD_ONLY}, module.__name__


@pytest.mark.parametrize(
    ("package", "changeable"),
    [
        ("values", "PIEStartResult SimOptions URLabAsset"),
        ("randomise", ""),
        ("simulation", "Past"),
        ("integrations", "ArticulationMessage EntityMessage PolicyRun SampleClock SceneLayout"),
        ("server", "AnyTwist LoadLevelByName RotatedBox ServerCore Snapshots Twist Uploads"),
    ],
)
def test_values_that_are_handed_out_cannot_be_changed(package: str, changeable: str) -> None:
    def frozen(cls: type[Any]) -> bool:
        told: Any = getattr(cls, "__struct_config__", None) or getattr(cls, "__dataclass_params__", None)
        return told is None or told.frozen

    found = {cls.__name__ for module in modules(package) for cls in classes(module) if not frozen(cls)}
    assert {name for name in found if not name.startswith("_")} == {*changeable.split()}


def test_an_order_of_the_browser_that_says_nothing_asks_for_nothing() -> None:
    from urlab_client.console import messages

    fields = [
        field for cls in classes(messages) if issubclass(cls, msgspec.Struct) for field in msgspec.structs.fields(cls)
    ]
    numbers = {
        np.any(field.default) for field in fields if field.default is not msgspec.NODEFAULT and not field.required
    }
    assert numbers == {False}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_logger_is_one_of_ours(package: str) -> None:
    """So that a program sets the level of all of them by the logger `urlab_client`."""
    for module in modules(package):
        for value in vars(module).values():
            if isinstance(value, logging.Logger):
                assert value.name.startswith("urlab_client"), module.__name__


@pytest.mark.parametrize("package", PACKAGES)
def test_what_has_arrays_is_compared_by_identity(package: str) -> None:
    """NumPy compares arrays value by value, so that `==` of what has some would raise."""

    def has_arrays(annotation: Any) -> bool:
        return get_origin(annotation) is np.ndarray or any(map(has_arrays, get_args(annotation)))

    found = [
        cls.__name__
        for module in modules(package)
        for cls in classes(module)
        if issubclass(cls, msgspec.Struct)
        and cls.__struct_config__.eq
        and any(has_arrays(field.type) for field in struct_fields(cls))
    ]
    assert found == []
