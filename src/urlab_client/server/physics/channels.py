"""User channels: values that a level declares for its robots and its scene, and clients write and read."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from typing import Any, Final, cast

SCENE: Final = "scene"
"""Stands for the robot's name in channels of the scene."""


def channel_problem(name: str, value: object) -> str | None:
    """Return what is wrong with a declared channel, `ROBOT/CHANNEL` or `scene/CHANNEL`, or None."""
    owner, slash, channel = name.partition("/")
    if not (owner and slash and channel):
        return f"'{name}' does not say ROBOT/CHANNEL or scene/CHANNEL"
    if _kind(value) is None:
        return f"'{name}' cannot begin with {value!r}: it takes a bool, number, text, list of numbers, or pos and quat"
    return None


class UserChannels:
    """The channels of one play session. From any thread.

    Args:
        declared: First value by `ROBOT/CHANNEL` or `scene/CHANNEL`; its kind is the channel's.
    """

    def __init__(self, declared: Mapping[str, Any]) -> None:
        self._lock = threading.Lock()
        self._values: dict[tuple[str, str], Any] = {}
        for name, value in declared.items():
            owner, _, channel = name.partition("/")
            self._values[owner, channel] = value

    @property
    def declared(self) -> bool:
        """Whether there is any."""
        return bool(self._values)

    def write(self, owner: str, channel: str, value: object) -> str | None:
        """Set a channel and return why not, in the wire's words, or None."""
        if value is None:
            return "unsupported_value"
        kind = _kind(value)
        if kind is None:
            return "unsupported_object" if isinstance(value, dict) else "unsupported_value"
        with self._lock:
            if _kind(self._values.get((owner, channel))) != kind:
                return "undeclared_or_kind_mismatch"
            self._values[owner, channel] = value
        return None

    def of(self, owner: str) -> dict[str, Any] | None:
        """Return the channels of a robot or of the scene by name; None without any."""
        if not self._values:
            return None
        with self._lock:
            return {channel: value for (whose, channel), value in self._values.items() if whose == owner} or None


def _kind(value: object) -> str | None:
    match value:
        case bool():
            return "bool"
        case int() | float():
            return "number" if math.isfinite(value) else None
        case str():
            return "text"
        case list():
            items = cast("list[object]", value)
            numbers = all(isinstance(item, (int, float)) and not isinstance(item, bool) for item in items)
            return "numbers" if numbers else None
        case dict():
            keys = cast("dict[str, object]", value).keys()
            return "pose" if keys == {"pos", "quat"} else None
        case _:
            return None
