"""Handler of `set_sim_options`."""

# ruff: noqa: D103 - the request struct documents the op

from __future__ import annotations

from typing import cast

from urlab_client.protocol.messages.runtime import SetSimOptions, SetSimOptionsOk
from urlab_client.protocol.types import SimOptions
from urlab_client.server.core import ServerCore
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need


@handles(SetSimOptions)
def set_sim_options(server: ServerCore, request: SetSimOptions) -> SetSimOptionsOk:
    running = server.play.running()
    options = need(request, request.options, "options")
    with running.engine.lock:
        echo = running.options.apply(running.scene.model, running.scene.data, options)
    return SetSimOptionsOk(options=cast("SimOptions", echo))  # its fields, in the order of the wire
