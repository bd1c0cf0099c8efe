"""Which client owns which robot of a play session, where robots have owners."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from urlab_client.protocol.messages.control import UNCLAIMED
from urlab_client.server.refusal import Refusal

__all__ = ["ControlClaims"]


@dataclass(slots=True)
class _Claim:
    owner: str
    ttl_s: float
    touched: float


class ControlClaims:
    """The owners of the robots, by key. Nobody owns any at first, and nobody may write then.

    Args:
        clock: Tells the time, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._claims: dict[str, _Claim] = {}

    def owner(self, key: str) -> str:
        """Return the owner of a robot, or `(unclaimed)`."""
        claim = self._claims.get(key)
        if claim is not None and 0 < claim.ttl_s < self._clock() - claim.touched:
            del self._claims[key]
            claim = None
        return UNCLAIMED if claim is None else claim.owner

    def claim(self, key: str, owner: str, ttl_s: float, *, force: bool) -> None:
        """Make `owner` the owner.

        Raises:
            Refusal: `control_claimed` by another.
        """
        holder = self.owner(key)
        if holder not in (UNCLAIMED, owner) and not force:
            raise Refusal("control_claimed", f"'{key}' belongs to '{holder}'", owner=holder)
        self._claims[key] = _Claim(owner, ttl_s, self._clock())

    def release(self, key: str, owner: str) -> None:
        """Make it nobody's.

        Raises:
            Refusal: `not_control_owner`.
        """
        self.check(key, owner)
        del self._claims[key]

    def check(self, key: str, owner: str) -> None:
        """Refuse a write by anybody but the owner; one by the owner keeps the claim alive.

        Raises:
            Refusal: `not_control_owner`.
        """
        holder = self.owner(key)
        if holder != owner:
            whose = "nobody's: claim it first" if holder == UNCLAIMED else f"that of '{holder}'"
            raise Refusal("not_control_owner", f"articulation '{key}' is {whose}", owner=holder)
        self._claims[key].touched = self._clock()

    def check_all(self, keys: Iterable[str], owner: str) -> None:
        """Refuse what concerns all robots while another client owns one of them.

        Raises:
            Refusal: `not_control_owner`.
        """
        for key in keys:
            holder = self.owner(key)
            if holder not in (UNCLAIMED, owner):
                raise Refusal("not_control_owner", f"articulation '{key}' is that of '{holder}'", owner=holder)
