"""The clients that own the robots of a play session, for dialects with control claims."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from urlab_client.protocol.messages.control import UNCLAIMED
from urlab_client.server.refusal import Refusal


@dataclass(slots=True)
class _Claim:
    owner: str
    ttl_s: float
    touched: float


class ControlClaims:
    """The owners of the robots, by key. Robots are unclaimed at first, and unclaimed robots accept no writes."""

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
        """Make `owner` the owner, unless another client is."""
        holder = self.owner(key)
        if holder not in (UNCLAIMED, owner) and not force:
            raise Refusal("control_claimed", f"'{key}' belongs to '{holder}'", owner=holder)
        self._claims[key] = _Claim(owner, ttl_s, self._clock())

    def release(self, key: str, owner: str) -> None:
        """Release the claim on a robot."""
        self.check(key, owner)
        del self._claims[key]

    def check(self, key: str, owner: str) -> None:
        """Refuse a write to a robot by anybody but its owner, and renew the claim."""
        holder = self.owner(key)
        if holder != owner:
            status = "is unclaimed: claim it first" if holder == UNCLAIMED else f"belongs to '{holder}'"
            raise Refusal("not_control_owner", f"articulation '{key}' {status}", owner=holder)
        self._claims[key].touched = self._clock()

    def check_all(self, keys: Iterable[str], owner: str) -> None:
        """Refuse a write to robots of which another client owns one."""
        for key in keys:
            holder = self.owner(key)
            if holder not in (UNCLAIMED, owner):
                raise Refusal("not_control_owner", f"articulation '{key}' belongs to '{holder}'", owner=holder)
