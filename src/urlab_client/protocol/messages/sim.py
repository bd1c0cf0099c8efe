"""Ops of `client.sim`: the life cycle of a play session."""

from __future__ import annotations

from typing import Annotated, Final

from urlab_client.enums import PIEState
from urlab_client.protocol.base import EDITOR_TIMEOUT_S, Effect, Op, Reply, Request, doc
from urlab_client.protocol.messages.session import HelloOk


class BeginPieOk(Reply, tag="begin_pie_ok", kw_only=True, omit_defaults=True):
    """Result of the start."""

    state: Annotated[PIEState, doc("`ready`, `compile_failed` or `timeout`.")]
    compile_error: Annotated[str, doc("MuJoCo's message if the model was rejected, otherwise empty.")]
    handshake_payload: Annotated[HelloOk | None, doc("The handshake of the new play world, if ready.")] = None


class BeginPie(Request[BeginPieOk], tag="begin_pie", kw_only=True):
    """Start Play-In-Editor and wait until the model is compiled."""

    level_path: Annotated[str | None, doc("Level to open first, a full `/Game/` path.")] = None
    timeout_s: Annotated[float, doc("Seconds to wait for the compile.")] = 30.0


class StopPieOk(Reply, tag="stop_pie_ok", kw_only=True):
    """The end of play was requested; the plugin may still be ending it."""


class StopPie(Request[StopPieOk], tag="stop_pie", kw_only=True):
    """End the play session. Succeeds if there is none."""


class PieStatusOk(Reply, tag="pie_status_ok", kw_only=True, omit_defaults=True):
    """State of Play-In-Editor."""

    state: Annotated[PIEState, doc("`off`, `compiling`, `compile_failed` or `ready`.")]
    compile_error: Annotated[str, doc("MuJoCo's message after a failed compile, otherwise empty.")]
    sim_time: Annotated[float | None, doc("`mjData.time`, seconds, if the simulation exists.")] = None


class PieStatus(Request[PieStatusOk], tag="pie_status", kw_only=True):
    """Read the state of Play-In-Editor."""


OPS: Final = (
    # The server may need 10 s to reach its game thread, in addition to the request's own timeout_s.
    Op(
        request=BeginPie,
        ns="sim",
        method="start",
        timeout=45.0,
        errors=("load_level_failed",),
        declares=("op:string", "state:string", "compile_error:string", "handshake_payload:object?"),
    ),
    Op(request=StopPie, ns="sim", method="stop", timeout=EDITOR_TIMEOUT_S, errors=("timeout",)),
    Op(request=PieStatus, ns="sim", method="status", effect=Effect.READ, timeout=EDITOR_TIMEOUT_S),
)
