"""The op declarations refuse at import what a reader or a tool would trip over later."""

from __future__ import annotations

import inspect
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec
import pytest

from urlab_client.errors import RPC_ERRORS, NoSession, URLabRPCError, rpc_error
from urlab_client.protocol.base import Needs, Op, Reply, Request, doc
from urlab_client.protocol.registry import ENVELOPE_ERRORS, OPS, dialect_ops, registry


class PokeOk(Reply, tag="poke_ok", kw_only=True):
    """Poked."""


class Poke(Request[PokeOk], tag="poke", kw_only=True):
    """Poke it."""

    where: Annotated[str, doc("Where.")]


class Poked(Reply, tag="poked", kw_only=True):
    """Wrongly named."""


class PokeAgain(Request[Poked], tag="poke_again", kw_only=True):
    """Poke it again."""


class Undocumented(Request[PokeOk], tag="undocumented", kw_only=True):
    pass


@pytest.mark.parametrize(
    ("ops", "complaint"),
    [
        ((Op(request=Poke), Op(request=Poke)), "'poke' is declared twice"),
        ((Op(request=PokeAgain),), "does not end in _ok"),
        ((Op(request=Undocumented),), "Undocumented: no docstring"),
        ((Op(request=Poke, errors=("no_such_code",)),), "undeclared error codes"),
        ((Op(request=Poke, undeclared=("depth",)),), "not required fields"),
    ],
)
def test_a_faulty_declaration_fails(ops: tuple[Op, ...], complaint: str) -> None:
    with pytest.raises(TypeError, match=complaint):
        registry(*ops)


def described(annotation: Any) -> bool:
    if get_origin(annotation) is Annotated:
        return any(isinstance(extra, msgspec.Meta) and extra.description for extra in get_args(annotation)[1:])
    return get_origin(annotation) in {Union, UnionType} and any(map(described, get_args(annotation)))


@pytest.mark.parametrize("name", OPS)
def test_every_field_is_given_by_its_name(name: str) -> None:
    """A field that is added anywhere changes no caller."""
    for struct in (OPS[name].request, OPS[name].reply):
        assert {one.kind for one in inspect.signature(struct).parameters.values()} <= {inspect.Parameter.KEYWORD_ONLY}


@pytest.mark.parametrize("name", OPS)
def test_every_field_is_described(name: str) -> None:
    """Not checked at import: reading all annotations would take a tenth of the time in which a server starts."""
    for struct in (OPS[name].request, OPS[name].reply):
        assert [field.name for field in msgspec.structs.fields(struct) if not described(field.type)] == []


def test_a_good_one_carries_everything() -> None:
    op = registry(Op(request=Poke, ns="arm"))["poke"]
    assert (op.method, op.required, op.declared_reply, op.reply, op.needs) == (
        "poke",
        ("where",),
        ("op:string",),
        PokeOk,
        Needs.EDITOR,
    )


def test_what_only_one_dialect_offers() -> None:
    alpha, beta = dialect_ops("alpha").keys(), dialect_ops("beta").keys()
    assert alpha | beta == OPS.keys()
    assert alpha - beta == {"destroy_actor"}
    assert beta - alpha == {
        "acquire_lease",
        "claim_control",
        "op_status",
        "release_control",
        "release_lease",
        "remove_actor",
        "set_camera_delay",
        "set_camera_streaming",
        "set_user_channels",
        "upload_model_manifest",
        "upload_model_chunk",
        "upload_model_commit",
    }


def test_ops_that_may_be_jobs() -> None:
    assert {op for op in OPS if OPS[op].job} == {
        "import_xml",
        "create_level",
        "load_level",
        "save_level",
        "spawn_actor",
        "spawn_grid",
        "spawn_light",
        "remove_actor",
        "duplicate_actor",
    }


def test_every_code_of_the_envelope_has_its_class() -> None:
    for code in ENVELOPE_ERRORS:
        assert type(rpc_error(code, "why")) is RPC_ERRORS[code]


def test_every_error_class_is_documented_and_pickles() -> None:
    import pickle

    for code, cls in RPC_ERRORS.items():
        assert cls.__doc__
        error = pickle.loads(pickle.dumps(rpc_error(code, "why", op="step")))
        assert (type(error), error.code, error.message, error.op) == (cls, code, "why", "step")
        assert str(error) == str(rpc_error(code, "why", op="step"))


def test_an_error_says_what_to_do_next_if_its_class_knows() -> None:
    off = rpc_error("no_active_manager", "no manager")
    assert off.hint == "Start a play session first: client.sim.start()."
    assert str(off).endswith(off.hint)
    assert NoSession("no session").hint == "Call discover() first.", "in place of what a session taken over says"
    assert rpc_error("unknown_actor", "no such actor").hint is None


def test_an_unlisted_code_is_a_plain_rpc_error() -> None:
    assert type(rpc_error("brand_new", "")) is URLabRPCError
