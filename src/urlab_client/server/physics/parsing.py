"""Step modes and control sources as requests spell them."""

from __future__ import annotations

from urlab_client.protocol.dialects import ALPHA, Dialect
from urlab_client.protocol.enums import StepMode
from urlab_client.server.physics.controllers import ControlSource
from urlab_client.server.refusal import Refusal

__all__ = ["parse_control_source", "parse_mode"]


def parse_mode(text: str, dialect: Dialect = ALPHA) -> StepMode:
    """Return the step mode called `text`, in any case; `streaming` is another name of live, `auto` in newer dialects.

    Raises:
        Refusal: `bad_mode`.
    """
    name = text.casefold()
    try:
        mode = StepMode.LIVE if name == "streaming" else StepMode(name)
    except ValueError:
        raise Refusal("bad_mode", f"unknown step mode '{text}': use live, direct, puppet or auto") from None
    return StepMode.LIVE if mode is StepMode.AUTO and not dialect.auto_mode else mode


def parse_control_source(text: str) -> ControlSource:
    """Return the control source called `text`, in any case.

    Raises:
        Refusal: `bad_value`.
    """
    try:
        return ControlSource(text.casefold())
    except ValueError:
        raise Refusal("bad_value", f"unknown control source '{text}': use zmq or ui") from None
