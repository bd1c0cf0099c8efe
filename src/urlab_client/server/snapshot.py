"""A picture of the viewport as it is set up on the server.

For `SimulatedServer.snapshot`; the wire has no op for it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from urlab_client.server.core import ServerCore
from urlab_client.server.handlers.viewport import look
from urlab_client.server.refusal import CompileFailed, Refusal
from urlab_client.server.render.viewport_picture import ViewportPicture
from urlab_client.server.rpc.dispatch import Dispatcher
from urlab_client.simulation.opengl import RenderingUnavailable, need_backend

LARGEST_PIXELS: Final = 16384
"""Longest side in pixels, the maximum of common drivers."""

IDLE_DEADLINE_S: Final = 10.0
"""Longest wait for the request in progress."""

_FRAMING_FOV: Final = 40.0


def take_snapshot(
    server: ServerCore, dispatcher: Dispatcher, size: tuple[int, int], *, frame_all: bool
) -> NDArray[np.uint8]:
    """Draw the viewport.

    Args:
        dispatcher: Dispatcher of its requests, which is paused while the state is read.
        size: Width and height, pixels.

    Returns:
        Red, green, blue and alpha from the top, shape (height, width, 4).

    Raises:
        RenderingUnavailable: The picture cannot be drawn.
    """
    need_backend()
    with dispatcher.standstill(IDLE_DEADLINE_S) as idle:
        if not idle:
            raise RenderingUnavailable(f"a request has been in progress for more than {IDLE_DEADLINE_S:g} s")
        view = look(server)
        picture = ViewportPicture(
            size=size,
            view=replace(view, fov=min(view.fov, _FRAMING_FOV)) if frame_all else view,
            fit=frame_all,
            mode=server.viewport.mode,
            primitives=server.drawings.take_frame(in_play=server.world.pie_running),
            overlay=server.drawings.overlay,
            selected=server.world.selected,
        )
        running = server.play.current
        try:
            if running is not None:
                with running.engine.lock:
                    job = running.cameras.capture_viewport(picture)
                renderer = running.cameras
            else:
                renderer = server.authored_renderer()
                job = renderer.capture_viewport(picture)
        except Refusal as refusal:
            raise RenderingUnavailable(f"the state cannot be read: {refusal.message}") from None
        except CompileFailed as error:
            raise RenderingUnavailable(f"the level does not compile: {error.message}") from None
    try:
        return renderer.paint(job)
    finally:
        if running is None:
            renderer.close()
