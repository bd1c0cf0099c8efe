"""The names, parameters, defaults, fields and enums of the API reference are there, in both flavours."""

from __future__ import annotations

import ast
import inspect
import tomllib
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

import urlab_client
import urlab_client.aio
from urlab_client import enums
from urlab_client.aio.defaults import SESSION_LEVEL
from urlab_client.server import SimulatedServer
from urlab_client.types import StreamPolicy, StreamPolicyName

ROWS = tomllib.loads((Path(__file__).parent / "rows.toml").read_text(encoding="utf-8"))
FLAVOURS = {"aio": urlab_client.aio, "sync": urlab_client}
MEMBERS = [(owner["owner"], row) for title, owner in ROWS.items() if "rows" in owner for row in owner["rows"]]
REQUIRED = object()
UNSTATED = object()  # "…" in the reference: a default that it does not spell out


def class_of(flavour: Any, owner: str) -> type:
    """The class that a reference row speaks of; namespaces are named by the client's property."""
    if owner[0].isupper():
        return getattr(flavour, owner, None) or getattr(urlab_client, owner)
    client = flavour.URLabClient()
    namespace = getattr(client, owner)
    return type(namespace)


def parse(row: str) -> tuple[str, list[tuple[str, Any, bool]]]:
    """Member, and (parameter, default, keyword only) of a row."""
    name, _, rest = row.partition("(")
    parsed = ast.parse(f"def f({rest[:-1]}): pass").body[0]
    assert isinstance(parsed, ast.FunctionDef)
    args = parsed.args
    defaults = [REQUIRED] * (len(args.args) - len(args.defaults)) + [ast.literal_eval(d) for d in args.defaults]
    found = [(a.arg, d, False) for a, d in zip(args.args, defaults, strict=True)]
    for a, d in zip(args.kwonlyargs, args.kw_defaults, strict=True):
        found.append((a.arg, UNSTATED if d is None else ast.literal_eval(d), True))
    return name, found


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize(("owner", "row"), MEMBERS, ids=[f"{owner}.{row.split('(')[0]}" for owner, row in MEMBERS])
def test_member(flavour: str, owner: str, row: str) -> None:
    cls = class_of(FLAVOURS[flavour], owner)
    if "(" not in row:
        slots = {name for base in cls.__mro__ for name in getattr(base, "__slots__", ())}
        assert hasattr(cls, row) or row in slots or row in inspect.get_annotations(cls), f"{cls.__name__} lacks {row}"
        return
    name, wanted = parse(row)
    signature = inspect.signature(getattr(cls, name))
    parameters = {n: p for n, p in signature.parameters.items() if n != "self"}
    if "**" in row:
        assert any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        return
    positional = [n for n, p in parameters.items() if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert positional == [n for n, _, keyword in wanted if not keyword]
    for parameter, default, keyword in wanted:
        actual = parameters[parameter]
        assert (actual.kind is actual.KEYWORD_ONLY) == keyword, parameter
        if default is UNSTATED or owner == "URLabArticulation":
            continue
        assert (actual.default is inspect.Parameter.empty) == (default is REQUIRED), parameter
        stands_for = actual.default.value if actual.default is SESSION_LEVEL else actual.default
        assert default is REQUIRED or stands_for == default, parameter
    extra = [n for n in parameters if n not in {n for n, _, _ in wanted}]
    assert all(parameters[n].kind is inspect.Parameter.KEYWORD_ONLY for n in extra), extra


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_help_shows_defaults_as_values(flavour: str) -> None:
    client = FLAVOURS[flavour].URLabClient
    for cls in (client, FLAVOURS[flavour].URLabArticulation, type(client().runtime), SimulatedServer):
        for name, function in inspect.getmembers(cls, inspect.isfunction):
            for parameter in inspect.signature(function).parameters.values():
                assert "<" not in repr(parameter.default) or parameter.default is parameter.empty, (
                    f"{name}: {parameter}"
                )


NAMES = {
    enums.StepMode: enums.StepModeName,
    enums.ObservationLevel: enums.ObservationLevelName,
    enums.Transport: enums.TransportName,
    StreamPolicy: StreamPolicyName,
}


@pytest.mark.parametrize("enum", NAMES)
def test_the_names_that_type_checkers_allow_are_those_of_the_enum(enum: Any) -> None:
    assert get_args(NAMES[enum]) == tuple(enum)


@pytest.mark.parametrize("name", ROWS["fields"])
def test_typed_value(name: str) -> None:
    fields = {f.name: f for f in msgspec.structs.fields(getattr(urlab_client, name))}
    wanted = [field.partition("=") for field in ROWS["fields"][name]]
    assert list(fields)[: len(wanted)] == [field for field, _, _ in wanted]
    for field, equals, default in wanted:
        assert fields[field].required == (not equals), field
        assert not equals or fields[field].default == ast.literal_eval(default), field


@pytest.mark.parametrize("name", ROWS["enums"])
def test_enum(name: str) -> None:
    enum = getattr(enums, name)
    assert list(enum.__members__) == ROWS["enums"][name]
    assert all(isinstance(member, str) and member == member.value for member in enum)


def test_errors() -> None:
    error = urlab_client.URLabRPCError("unknown_op", "no such op", op="poke")
    assert (error.code, error.message, error.op) == ("unknown_op", "no such op", "poke")
    pie = urlab_client.URLabPIEError(code="timeout", message="log", state=enums.PIEState.TIMEOUT)
    assert isinstance(pie, urlab_client.URLabRPCError)
    assert (pie.state, pie.message) == (enums.PIEState.TIMEOUT, "log")
    assert issubclass(urlab_client.URLabVersionMismatch, urlab_client.URLabError)


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_the_signature_of_step_tells_its_level(flavour: str) -> None:
    signature = inspect.signature(FLAVOURS[flavour].URLabClient.step)
    assert repr(signature.parameters["observations"].default) == "'standard' or as chosen in discover()"
