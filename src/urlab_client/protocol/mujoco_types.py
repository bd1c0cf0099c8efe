"""MuJoCo's model, data and options, as type checkers are to see them. MuJoCo ships no types.

Whoever has stubs for MuJoCo, such as `mujoco-stubs`, gets their classes, so that `client.model` goes wherever they ask
for a model. All others get the fields and their types. At run time these are MuJoCo's own classes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__all__ = ["MjData", "MjModel", "MjOption"]

MYPY: bool = False  # mypy takes a variable of this name as true

# To type checkers MuJoCo's package has no such names, unless there are stubs.
# isort: off
if not TYPE_CHECKING:
    from mujoco import MjData, MjModel, MjOption
elif MYPY:  # the first import of a name counts
    from mujoco import *  # noqa: F403
    from urlab_client.protocol.mujoco_fields import MjData, MjModel, MjOption  # type: ignore[assignment]
else:  # the last one counts
    from urlab_client.protocol.mujoco_fields import MjData, MjModel, MjOption
    from mujoco import *  # noqa: F403
