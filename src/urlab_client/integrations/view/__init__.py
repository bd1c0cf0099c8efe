"""Live views of a simulation in Rerun, in Foxglove, and in MuJoCo's own window.

Rerun requires the extra `rerun`, Foxglove the extra `foxglove`, and the window a display. All coordinates are in the
MuJoCo world frame: metres, right-handed, z up.
"""

from urlab_client.integrations.view.foxglove_view import foxglove_view
from urlab_client.integrations.view.rerun_view import rerun_view
from urlab_client.integrations.view.view import AsyncView, View, ViewStats, window_view

__all__ = ["AsyncView", "View", "ViewStats", "foxglove_view", "rerun_view", "window_view"]
