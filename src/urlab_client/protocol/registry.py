"""`OPS`: the only list of ops. Namespaces, façade, server dispatch, documentation tables and tests derive from it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

from urlab_client import errors
from urlab_client.protocol.base import DialectName, Op
from urlab_client.protocol.messages import (
    cameras,
    debug,
    farm,
    jobs,
    outliner,
    recording,
    runtime,
    scene,
    session,
    sim,
    uploads,
    viewport,
)

ENVELOPE_ERRORS = (
    "not_ready",
    "wrong_transport",
    "bad_request",
    "missing_op",
    "session_expired",
    "unknown_op",
    "missing_field",
    "no_active_manager",
    "shutting_down",
)
"""Error codes of every op, in the order in which a server checks."""


def registry(*ops: Op) -> Mapping[str, Op]:
    """Index `ops` by name and check the declarations, so that mistakes fail at import."""
    index: dict[str, Op] = {}
    methods: set[tuple[str, str]] = set()
    for op in ops:
        _check(op)
        if op.name in index or (op.ns, op.method) in methods:
            raise TypeError(f"op {op.name!r} is declared twice")
        methods.add((op.ns, op.method))
        index[op.name] = op
    return MappingProxyType(index)


def _check(op: Op) -> None:
    if not op.reply_name.endswith("_ok"):
        raise TypeError(f"{op.name}: the reply's tag {op.reply_name!r} does not end in _ok")
    for struct in (op.request, op.reply):
        if "__doc__" not in struct.__dict__ or not struct.__doc__:
            raise TypeError(f"{struct.__name__}: no docstring")
    unknown = [code for code in op.errors if code not in errors.RPC_ERRORS]
    if unknown:
        raise TypeError(f"{op.name}: undeclared error codes {unknown}")
    wrong = [name for name in op.undeclared if name not in op.required]
    if wrong:
        raise TypeError(f"{op.name}: {wrong} are not required fields")


OPS: Mapping[str, Op] = registry(
    *session.OPS,
    *runtime.OPS,
    *recording.OPS,
    *scene.OPS,
    *sim.OPS,
    *outliner.OPS,
    *debug.OPS,
    *viewport.OPS,
    *cameras.OPS,
    *jobs.OPS,
    *uploads.OPS,
    *farm.OPS,
)


@cache
def dialect_ops(dialect: DialectName) -> Mapping[str, Op]:
    """Return the ops of a dialect by name."""
    return MappingProxyType({name: op for name, op in OPS.items() if dialect in op.dialects})
