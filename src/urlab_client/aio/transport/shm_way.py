"""Which ops can use shared memory, judging by the op alone."""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

from urlab_client.protocol.base import Needs, Op
from urlab_client.protocol.messages.session import StateReply

# Ops whose replies grow with the scene, regardless of their earlier size.
_UNBOUNDED: Final = frozenset({"hello", "meta", "get_contacts", "list_keyframes", "replay_list_sessions"})
# Chunks are larger than slots, and a chunk that was executed without a reply must not be sent again.
_UPLOADS: Final = frozenset({"upload_model_manifest", "upload_model_chunk", "upload_model_commit"})


class Way(NamedTuple):
    """Properties of an op that determine the transport of its requests.

    Attributes:
        detour: Why its requests can never use shared memory; empty if they can.
        pictures: Whether its requests may ask for pictures, which do not fit.
        state: Whether its replies contain the state, whose size is nearly constant.
    """

    detour: str
    pictures: bool
    state: bool


@cache
def way_of(op: Op) -> Way:
    """Return the properties of an op that determine its transport."""
    detour = ""
    if op.needs is Needs.EDITOR:
        detour = "editor op"
    elif op.ns == "scene":
        detour = "upload"  # its chunks and its reply exceed a slot
    elif op.name in _UNBOUNDED:
        detour = "handshake" if op.needs is Needs.NOTHING else "reply may be too large"
    elif op.name in _UPLOADS:
        detour = "upload"
    return Way(detour, op.name == "step", issubclass(op.reply, StateReply))
