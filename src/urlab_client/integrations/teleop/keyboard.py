"""`KeyboardOperator`: keyboard control from a terminal, which reports key presses but not releases."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from urlab_client.integrations.teleop.session import TeleopCommand, TeleopView, Verdict

_HELD_S: Final = 0.12
"""Duration of the motion per key press: a little longer than the repeat interval of a held key."""

_FINE: Final = 0.2


class _Motion(NamedTuple):
    axis: int  # 0 to 2 linear, 3 to 5 angular
    sign: float


# Two keys for each axis: forwards and backwards.
_MOTIONS: Final[dict[str, _Motion]] = {
    key: _Motion(axis, sign)
    for axis, keys in enumerate(("ws", "ad", "rf", "cz", "bv", "qe"))
    for key, sign in zip(keys, (1.0, -1.0), strict=True)
}
_VERDICTS: Final[dict[str, Verdict]] = {
    "\r": "success",
    "\n": "success",
    "n": "failure",
    "\x7f": "discarded",
    "\b": "discarded",
    "\x03": "quit",
    "\x04": "quit",
}
_SPECIAL_KEY: Final = re.compile(r"\x1b[\[O](?P<modifiers>[0-9;]*)(?P<key>[A-Za-z~])")
"""What terminals send for arrows and other keys without a character; the modifiers of an arrow end with 2 for shift."""
_UNFINISHED: Final = re.compile(r"\x1b(?:[\[O][0-9;]*)?$")
_ARROWS: Final = {"A": "w", "B": "s", "D": "a", "C": "d"}

HELP: Final = (
    ("w s, a d, r f", "move along x, y, z; also the arrows for x and y; with shift slowly"),
    ("c z, b v, q e", "turn about x, y, z; with shift slowly"),
    ("space", "close or open the gripper"),
    ("enter, n", "end the episode as a success, as a failure"),
    ("backspace", "discard the episode"),
    ("ctrl-c", "end"),
)
"""Keys and their effects, world frame."""


class KeyboardOperator:
    """Operator that converts key presses to commands.

    Attributes:
        keys: Function that returns the characters received since the last call, or an empty string.
    """

    def __init__(self, keys: Callable[[], str], *, clock: Callable[[], float] = time.monotonic) -> None:
        """Make an operator.

        Args:
            keys: Function that returns the characters received since the last call.
            clock: Function that returns the time in seconds, for the duration of key presses.
        """
        self.keys = keys
        self._clock = clock
        self._until = np.full(6, -np.inf)
        self._speed = np.zeros(6)
        self._gripper = 0.0
        self._rest = ""

    def __call__(self, view: TeleopView, /) -> TeleopCommand:
        """See `Operator`."""
        del view
        pressed, now = self._rest + self.keys(), self._clock()
        pressed = _SPECIAL_KEY.sub(_spelled, pressed)
        unfinished = _UNFINISHED.search(pressed)
        self._rest = unfinished[0] if unfinished else ""
        for i, key in enumerate(pressed):
            if key in _VERDICTS:
                self._until[:] = -np.inf
                self._gripper = 0.0
                self._rest = pressed[i + 1 :]  # belongs to the next episode
                return TeleopCommand(verdict=_VERDICTS[key])
            if key == " ":
                self._gripper = 1.0 if self._gripper < 0 else -1.0
            motion = _MOTIONS.get(key.lower())
            if motion is not None:
                self._speed[motion.axis] = motion.sign * (_FINE if key.isupper() else 1.0)
                self._until[motion.axis] = now + _HELD_S
        speed = np.where(self._until > now, self._speed, 0.0).tolist()
        return TeleopCommand(
            linear=(speed[0], speed[1], speed[2]), angular=(speed[3], speed[4], speed[5]), gripper=self._gripper
        )


def _spelled(special: re.Match[str]) -> str:
    """Return the character that an arrow stands for; nothing for other keys."""
    key = _ARROWS.get(special["key"], "")
    return key.upper() if special["modifiers"].endswith(";2") else key
