"""Editor ops that run as jobs: the reply that announces a job, and the op that returns its progress and result."""

from __future__ import annotations

from typing import Annotated, Any, Final

from urlab_client.protocol.base import Needs, Op, Reply, Request, doc


class OpStarted(Reply, tag="op_started", kw_only=True):
    """The op has started; `op_status` returns its reply."""

    job_id: Annotated[str, doc("`job_` and a number, unique in the editor's process.")]
    state: Annotated[str, doc("`running`.")] = "running"


class OpStatusOk(Reply, tag="op_status_ok", kw_only=True, omit_defaults=True):
    """Progress of a job. The server reports its end once, and no longer knows the job after that."""

    job_id: Annotated[str, doc("As requested.")]
    state: Annotated[str, doc("`running`, `done` or `failed`.")]
    progress: Annotated[str | None, doc("Human-readable text; the plugin sends none.")] = None
    result: Annotated[dict[str, Any] | None, doc("At the end, the op's reply or error, with its own `op`.")] = None


class OpStatus(Request[OpStatusOk], tag="op_status", kw_only=True):
    """Query the progress of a job."""

    job_id: Annotated[str, doc("From `op_started`.")]


OPS: Final = (
    # Not a read: the server sends the reply that reports the end only once.
    Op(request=OpStatus, ns="scene", needs=Needs.EDITOR, errors=("bad_request", "unknown_job"), dialects=("beta",)),
)
