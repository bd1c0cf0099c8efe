"""Editor ops that take long: their start, and the op that tells how far they are and hands over their reply."""

from __future__ import annotations

from typing import Annotated, Any, Final

from urlab_client.protocol.base import Needs, Op, Reply, Request, doc

__all__ = ["OPS", "OpStarted", "OpStatus", "OpStatusOk"]


class OpStarted(Reply, tag="op_started", kw_only=True):
    """The op has begun; `op_status` hands over its reply."""

    job_id: Annotated[str, doc("`job_` and a number, unique in the editor's process.")]
    state: Annotated[str, doc("`running`.")] = "running"


class OpStatusOk(Reply, tag="op_status_ok", kw_only=True, omit_defaults=True):
    """How far a job is. Its end is told once; after that the server does not know the job any more."""

    job_id: Annotated[str, doc("As requested.")]
    state: Annotated[str, doc("`running`, `done` or `failed`.")]
    progress: Annotated[str | None, doc("Text for people; the plugin sends none.")] = None
    result: Annotated[dict[str, Any] | None, doc("The op's reply, or its error, with its own `op`; at the end.")] = None


class OpStatus(Request[OpStatusOk], tag="op_status", kw_only=True):
    """Ask how far a job is."""

    job_id: Annotated[str, doc("From `op_started`.")]


OPS: Final = (
    # Not a read: the reply that tells the end exists once.
    Op(request=OpStatus, ns="scene", needs=Needs.EDITOR, errors=("bad_request", "unknown_job"), dialects=("beta",)),
)
