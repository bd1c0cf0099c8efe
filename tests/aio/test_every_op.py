"""Methods that follow from the registry: each sends its op with the arguments given and returns what the reply says."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec
import pytest
from samples import sample
from scripted import meta_ok
from waiting import DEADLINE_S

import urlab_client
from urlab_client.aio import URLabClient
from urlab_client.aio.namespaces import _ops
from urlab_client.protocol.base import Op
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.registry import OPS

GENERATED = [name for name, op in OPS.items() if op.generated]


def test_methods_are_generated_for_the_ops_that_say_so_and_no_others() -> None:
    classes = [cls for cls in vars(_ops).values() if isinstance(cls, type) and cls.__module__ == _ops.__name__]
    methods = [name for cls in classes for name, method in vars(cls).items() if asyncio.iscoroutinefunction(method)]
    assert sorted(methods) == sorted(str(OPS[name].method) for name in GENERATED)


def arguments(op: Op) -> tuple[dict[str, Any], dict[str, Any]]:
    """Keyword arguments for the method, and the wire fields they must become."""
    given: dict[str, Any] = {}
    expected: dict[str, Any] = {}
    for field in msgspec.structs.fields(op.request):
        if field.name in {"session_id", "control_owner"}:
            continue
        if field.name == "target_by":
            given["by_name"] = True
            expected["target_by"] = "actor_name"
            continue
        value = sample(field.type)
        given[field.name] = list(value) if isinstance(value, tuple) else value
        expected[field.encode_name] = list(value) if isinstance(value, tuple) else value
        if value == field.default:
            del expected[field.encode_name]
    return given, expected


def result(op: Op, reply: Any) -> Any:
    if op.returns is None:
        return None
    if isinstance(op.returns, str):
        return getattr(reply, op.returns)
    return op.returns(**{name: getattr(reply, name) for name in op.returns.__struct_fields__})


@pytest.mark.parametrize("name", GENERATED)
async def test_generated_method(scripted: Any, name: str) -> None:
    op = OPS[name]
    scripted.on("meta", meta_ok(op.dialects[0]))
    reply = sample(op.reply)
    scripted.on(name, encode_reply(sample(op.reply)))
    given, expected = arguments(op)
    async with URLabClient(f"tcp://127.0.0.1:{scripted.port}", local_model=False) as client:
        await client.discover()
        returned = await getattr(getattr(client, op.ns), op.method)(**given)
    seen = scripted.request(name)
    assert {k: v for k, v in seen.items() if k not in {"op", "session_id"}} == expected
    assert returned == result(op, reply)


@pytest.mark.parametrize("name", GENERATED)
def test_generated_method_of_the_facade(scripted: Any, name: str) -> None:
    op = OPS[name]
    scripted.on("meta", meta_ok(op.dialects[0]))
    scripted.on(name, encode_reply(sample(op.reply)))
    given, _ = arguments(op)
    with urlab_client.URLabClient(f"tcp://127.0.0.1:{scripted.port}", local_model=False) as client:
        client.discover()
        returned = getattr(getattr(client, op.ns), op.method)(**given)
    assert returned == result(op, sample(op.reply))


@pytest.mark.parametrize("name", GENERATED)
async def test_cancelled_and_timed_out_ops_leave_the_client_usable(scripted: Any, name: str) -> None:
    op = OPS[name]
    scripted.on("meta", meta_ok(op.dialects[0]))
    given, _ = arguments(op)
    scripted.on(name, None)
    async with URLabClient(f"tcp://127.0.0.1:{scripted.port}", local_model=False) as client:
        await client.discover()
        method = getattr(getattr(client, op.ns), op.method)
        with pytest.raises(urlab_client.URLabTimeoutError):
            await method(**given, timeout=0.01)
        call = asyncio.create_task(method(**given))
        await asyncio.to_thread(scripted.held.get, timeout=DEADLINE_S)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        scripted.on(name, encode_reply(sample(op.reply)))
        assert await method(**given) == result(op, sample(op.reply))
