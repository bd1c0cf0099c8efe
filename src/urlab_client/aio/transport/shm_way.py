"""Which ops can go over shared memory, as far as the op alone tells."""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

from urlab_client.protocol.base import Needs, Op
from urlab_client.protocol.messages.session import StateReply

__all__ = ["Way", "way_of"]

# Replies that grow with what happens in the scene, whatever size they had before.
_UNBOUNDED: Final = frozenset({"hello", "meta", "get_contacts", "list_keyframes", "replay_list_sessions"})
# Pieces are larger than slots, and one that was executed without an answer may not be sent again.
_UPLOADS: Final = frozenset({"upload_model_manifest", "upload_model_chunk", "upload_model_commit"})


class Way(NamedTuple):
    """What an op alone says about the way of its requests.

    Attributes:
        detour: Why they cannot go over shared memory, whatever its state; empty if they can.
        pictures: Whether they may ask for pictures, which do not fit.
        state: Whether replies hold the state, which is of about one size.
    """

    detour: str
    pictures: bool
    state: bool


@cache
def way_of(op: Op) -> Way:
    """Return what an op says about the way of its requests."""
    detour = ""
    if op.needs is Needs.EDITOR:
        detour = "editor op"
    elif op.ns == "scene":
        detour = "upload"  # its chunks and its reply outgrow a slot
    elif op.name in _UNBOUNDED:
        detour = "handshake" if op.needs is Needs.NOTHING else "reply may be too large"
    elif op.name in _UPLOADS:
        detour = "upload"
    return Way(detour, op.name == "step", issubclass(op.reply, StateReply))
