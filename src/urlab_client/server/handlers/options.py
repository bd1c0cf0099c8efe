"""Handler of `set_sim_options`."""

# ruff: noqa: D103 - what an op does stands once, on its request struct

from __future__ import annotations

from typing import cast

from urlab_client.protocol.messages.runtime import SetSimOptions, SetSimOptionsOk
from urlab_client.protocol.sim_options import check_sim_options
from urlab_client.protocol.types import SimOptions
from urlab_client.server.core import ServerCore
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need


@handles(SetSimOptions)
def set_sim_options(server: ServerCore, request: SetSimOptions) -> SetSimOptionsOk:
    running = server.play.running()
    options = need(request, request.options, "options")
    try:
        check_sim_options(options)
    except ValueError as error:
        # The plugin takes anything. Here a timestep of 0 or NaN would end the simulation of all clients.
        raise Refusal("bad_value", str(error)) from None
    with running.engine.lock:
        echo = running.options.apply(running.scene.model, running.scene.data, options)
    return SetSimOptionsOk(options=cast("SimOptions", echo))  # the same fields in the order of the wire
