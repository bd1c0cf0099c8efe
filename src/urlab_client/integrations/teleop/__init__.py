"""Teleoperation: velocity control of a robot's hand from keys, a gamepad or a script, and recording of episodes.

Needs the extra `teleop`, and `gym` for tasks.
"""

from urlab_client.integrations.teleop.hand import HandControl
from urlab_client.integrations.teleop.keyboard import KeyboardOperator
from urlab_client.integrations.teleop.session import (
    Operator,
    TeleopCommand,
    TeleopTally,
    TeleopView,
    teleoperate,
    teleoperate_blocking,
)

__all__ = [
    "HandControl",
    "KeyboardOperator",
    "Operator",
    "TeleopCommand",
    "TeleopTally",
    "TeleopView",
    "teleoperate",
    "teleoperate_blocking",
]
