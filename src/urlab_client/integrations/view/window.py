"""A view in MuJoCo's own window."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any, overload

from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.errors import URLabError
from urlab_client.integrations._feed.samples import CameraPicture
from urlab_client.integrations._feed.scene import FollowedScene, Simulation
from urlab_client.integrations.view.view import AsyncView, Moment, View, ViewOptions, make_view
from urlab_client.sync.client import URLabClient

if TYPE_CHECKING:
    import mujoco


def missing_for_window() -> str:
    """Return why no window can be opened here; empty if it can."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "there is no display: neither DISPLAY nor WAYLAND_DISPLAY is set"
    if sys.platform == "darwin" and not os.environ.get("MJPYTHON_BIN"):
        return "on macOS windows belong to the main thread: run with mjpython, which comes with MuJoCo"
    return ""


class _Window:
    """Shows states in `mujoco.viewer`'s window, which is reopened for another scene."""

    def __init__(self) -> None:
        self._viewer: Any = None
        self._data: mujoco.MjData | None = None

    @property
    def address(self) -> str:
        """See `ViewBackend`."""
        return ""

    def open(self) -> None:
        """See `ViewBackend`."""
        missing = missing_for_window()
        if missing:
            raise URLabError(
                f"window_view: {missing}.", hint="Use rerun_view, foxglove_view or `urlab console`, or set a display."
            )

    def use(self, simulation: Simulation, scene: FollowedScene) -> None:
        """See `ViewBackend`."""
        import mujoco

        viewer: Any = import_module("mujoco.viewer")
        self.close()
        del scene
        self._data = mujoco.MjData(simulation.model)
        self._viewer = viewer.launch_passive(simulation.model, self._data, show_left_ui=False, show_right_ui=False)

    def show(self, moment: Moment) -> None:
        """See `ViewBackend`."""
        import mujoco

        if self._data is None or not self._viewer.is_running():
            return
        with self._viewer.lock():
            mujoco.mj_copyData(self._data, moment.simulation.model, moment.simulation.data)
            self._data.time = moment.ns / 1e9
        self._viewer.sync()

    def show_picture(self, picture: CameraPicture, ns: int) -> None:
        """See `ViewBackend`."""

    def idle(self) -> bool:
        """See `ViewBackend`."""
        return self._viewer is None or bool(self._viewer.is_running())

    def close(self) -> None:
        """See `ViewBackend`."""
        viewer, self._viewer = self._viewer, None
        if viewer is not None:
            viewer.close()


@overload
def window_view(client: AsyncClient, *, max_hz: float = ...) -> AsyncView: ...
@overload
def window_view(client: URLabClient, *, max_hz: float = ...) -> View: ...
def window_view(client: AsyncClient | URLabClient, *, max_hz: float = 60.0) -> AsyncView | View:
    """Show a client's simulation in MuJoCo's own window; a context manager of the client's flavour.

    The window does not control the simulation. When it is closed, `closed` is true and the client continues.

    Args:
        client: A client after `discover()`, during play, with its local model.
        max_hz: Maximum number of states shown per second of wall time.

    Raises:
        ValueError: `max_hz` is out of range.

    Entering the block raises `URLabError` if no window can be opened; the message says what is missing.
    """
    options = ViewOptions(cameras=(), camera_hz=1.0, max_hz=max_hz, contacts=True)
    return make_view(client, _Window(), options, "window_view")
