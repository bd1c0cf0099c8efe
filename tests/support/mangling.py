"""Frames that no sane peer sends: golden frames of every kind, mutated."""

from __future__ import annotations

import copy
import os
import random
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
from samples import filled

from urlab_client.protocol.codec import encode_reply, encode_request
from urlab_client.protocol.messages.session import ErrorReply
from urlab_client.protocol.registry import OPS

FACTOR = int(os.environ.get("URLAB_FUZZ_FACTOR", "1"))
"""How many times longer than in CI to go on; 100 makes a million frames for the codec and 100 000 for a server."""

_ODD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 1e308, -1e308, 5e-324, 2**31, -(2**31), 2**63, "", "text", "\0", "../..", "é" * 50, [], {},
    [[]], [1.0], [0.0] * 3, [0.0] * 4, [1e200] * 7, [None, "a", {}], {"": {}}, {"bot": {"j": "nan"}},
    {"a": [1, {"b": None}]},
)  # fmt: skip

_EDGES = (
    b"\x00", b"\xff", b"\x7f", b"\x80", b"\xc0", b"\xc1", b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xcb\x7f\xf8\x00\x00\x00\x00\x00\x00",
    b"\xcb\x7f\xf0\x00\x00\x00\x00\x00\x00", b"\xcb\x7f\xef\xff\xff\xff\xff\xff\xff",
    b"\xd3\x80\x00\x00\x00\x00\x00\x00\x00",
    b"\xcf\xff\xff\xff\xff\xff\xff\xff\xff", b"\xed\xa0\x80", b"\x81\xa2op\xa4meta", b"null", b"1e999",
    b'{"op":', b"[[[[[[[[",
)  # fmt: skip


def golden_requests(session: str = "session") -> list[bytes]:
    """A request of every op, in both encodings."""
    return [
        encode_request(filled(op.request), session, json=json)  # type: ignore[arg-type]
        for op in OPS.values()
        for json in (False, True)
    ]


def golden_replies() -> list[bytes]:
    """A reply of every op, in both encodings, and an error."""
    kinds = [*(op.reply for op in OPS.values()), ErrorReply]
    return [encode_reply(filled(kind), json=json) for kind in kinds for json in (False, True)]


def strange(requests: Sequence[dict[str, Any]], seed: int, count: int) -> Iterator[bytes]:
    """Yield well-formed frames of requests some of whose values are not what they should be."""
    chance = random.Random(seed)
    for _ in range(count):
        request = copy.deepcopy(chance.choice(requests))
        for _ in range(chance.randrange(1, 4)):
            _replace(request, chance)
        yield msgspec.json.encode(request) if chance.random() < 0.3 else msgspec.msgpack.encode(request)


def _replace(request: dict[str, Any], chance: random.Random) -> None:
    place: Any = request
    keys = [key for key in request if key not in ("op", "session_id")]
    while keys:
        key = chance.choice(keys)
        inner = place[key]
        deeper = isinstance(inner, dict | list) and bool(inner) and chance.random() < 0.6
        if not deeper:
            place[key] = copy.deepcopy(chance.choice(_ODD))
            return
        place, keys = inner, list(inner) if isinstance(inner, dict) else list(range(len(inner)))


def mutated(golden: Sequence[bytes], seed: int, count: int) -> Iterator[bytes]:
    """Yield frames that differ from golden ones in a few places; the same ones for the same seed."""
    chance = random.Random(seed)
    for _ in range(count):
        frame = bytearray(chance.choice(golden))
        for _ in range(chance.choice((1, 1, 1, 2, 3, 8))):
            _mutate(frame, chance, golden)
        yield bytes(frame)


def _mutate(frame: bytearray, chance: random.Random, golden: Sequence[bytes]) -> None:
    at = chance.randrange(len(frame) + 1)
    match chance.randrange(7):
        case 0 if at < len(frame):
            frame[at] ^= 1 << chance.randrange(8)
        case 1 if at < len(frame):
            frame[at] = chance.randrange(256)
        case 2:
            del frame[at:]
        case 3:
            del frame[at : at + chance.randrange(1, 9)]
        case 4:
            edge = chance.choice(_EDGES)
            frame[at : at + chance.choice((0, len(edge)))] = edge
        case 5:
            part = frame[at : at + chance.randrange(1, 33)]
            frame[at:at] = part * chance.randrange(1, 5)
        case _:
            other = chance.choice(golden)
            frame[at:] = other[chance.randrange(len(other) + 1) :]
