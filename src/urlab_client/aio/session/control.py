"""Claims: the right to write to a robot, on servers where each robot has one owner.

The session sends every request that writes to a robot through `Control.send`, which sends no claims to a server
without them.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import secrets
import socket
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final, TypeVar, cast

from urlab_client.aio.background import background_task
from urlab_client.aio.defaults import Timeout
from urlab_client.aio.transport.base import Deadlines
from urlab_client.errors import UNCLAIMED, ControlClaimed, NotControlOwner, URLabError
from urlab_client.protocol.base import ControlRequest, Reply
from urlab_client.protocol.messages.runtime import (
    ClaimControl,
    ClaimControlOk,
    ReleaseControl,
    ReleaseControlOk,
    SetControlSource,
    SetQpos,
    SetTwist,
)
from urlab_client.protocol.messages.session import Step

if TYPE_CHECKING:
    from urlab_client.aio.session.session import Session

log: logging.Logger = logging.getLogger("urlab_client.control")

R = TypeVar("R", bound=Reply)

CLAIM_S: Final = 30.0
"""Default seconds without a write after which a claim expires."""

_RELEASE_S: Final = 1.0
_RENEWALS: Final = 3  # per lifetime of a claim


@cache
def _owner_of(process: int) -> str:
    return f"{socket.gethostname()}/{process}/{secrets.token_hex(4)}"


def process_owner() -> str:
    """Return the owner name of this process: the same for all its clients, and across reconnects."""
    return _owner_of(os.getpid())


@dataclass(slots=True)
class _Claim:
    ttl: float
    until: float  # loop time


class Control:
    """The robots that one client owns.

    Attributes:
        resolve: Returns the key of an articulation for any of its names; None for an unknown name.
        owner: Owner name of this client's claims.
    """

    def __init__(self, session: Session, *, wanted: bool) -> None:
        self.resolve: Callable[[str], str | None] = lambda name: name
        self.owner: str = process_owner()
        self._session = session
        self._wanted = wanted
        self._held: dict[str, _Claim] = {}
        self._others: dict[str, str] = {}
        # Owner names that mean this client: a server that ignores `control_owner` uses the id of the current session.
        self._names = {self.owner}
        self._renewal: asyncio.Task[None] | None = None

    def owner_of(self, key: str) -> str | None:
        """Return the owner of a robot, or None if it has none or the owner is not known."""
        if key in self._held:
            return self.owner
        return self._others.get(key)

    async def send(self, request: ControlRequest[R], deadlines: Deadlines) -> R:
        """Send a request that writes to robots, and claim them first where necessary.

        Raises:
            NotControlOwner: Another client owns one of the robots; nothing was written.
        """
        if not self._session.features.claims:
            return await self._session.exchange_once(request, deadlines)
        request.control_owner = self.owner
        if isinstance(request, ClaimControl):
            return cast("R", await self._claim(request, deadlines))
        if isinstance(request, ReleaseControl):
            return cast("R", await self._release(request, deadlines))
        robots = self._robots(request)
        if self._wanted and robots:
            now = asyncio.get_running_loop().time()
            for key in robots:
                claim = self._held.get(key)
                if claim is None or claim.until < now:
                    await self._claim(self._claim_request(key), deadlines)
        try:
            reply = await self._session.exchange_once(request, deadlines)
        except NotControlOwner as refusal:
            if refusal.owner not in {UNCLAIMED, *self._names} or not self._wanted or not robots:
                raise self._refused(robots, refusal) from None
            # The claim expired, play was restarted, or the claim belonged to an earlier session. Nothing was written,
            # so the request may be sent again.
            for key in robots:
                await self._claim(self._claim_request(key), deadlines)
            try:
                reply = await self._session.exchange_once(request, deadlines)
            except NotControlOwner as second:
                raise self._refused(robots, second) from None
        self._note_write(robots)
        return reply

    async def release(self, key: str, *, timeout: Timeout) -> None:
        held = self._held.pop(key, None) is not None or _control_of(key) in self._session.unsettled
        if not held or not self._session.features.claims:
            return
        try:
            await self._session.call(ReleaseControl(articulation=key), timeout=timeout)
        except NotControlOwner as refusal:
            self._learn([key], refusal)  # another client took it, or the claim expired: it is released either way

    async def aclose(self, *, connected: bool) -> None:
        """Release all owned robots if the server still answers. Idempotent."""
        renewal, self._renewal = self._renewal, None
        if renewal is not None:
            renewal.cancel()
            await asyncio.wait((renewal,))
        held, self._held = list(self._held), {}
        for key in held if connected else ():
            try:
                await self._session.call(ReleaseControl(articulation=key, control_owner=self.owner), timeout=_RELEASE_S)
            except URLabError as error:  # best effort: the claims expire anyway
                log.debug("%s could not be released: %s", key, error)
                break

    def forget(self) -> None:
        self._held.clear()
        self._others.clear()

    def _robots(self, request: ControlRequest[Reply]) -> list[str]:
        match request:
            case Step(per_articulation=commands):
                return [
                    key
                    for key, command in (commands or {}).items()
                    if not (command.ctrl is None and command.ctrl_map is None and command.xfrc_applied is None)
                ]
            case SetTwist(articulation=name) | SetQpos(target=name):
                return self._known([name])
            case SetControlSource(articulation=str(name)):
                return self._known([name])
            case _:
                return []

    def _known(self, names: Iterable[str]) -> list[str]:
        return [key for name in names if (key := self.resolve(name)) is not None]

    def _claim_request(self, key: str) -> ClaimControl:
        claim = self._held.pop(key, None)
        ttl = CLAIM_S if claim is None else claim.ttl
        return ClaimControl(articulation=key, ttl_s=ttl, control_owner=self.owner)

    async def _claim(self, request: ClaimControl, deadlines: Deadlines) -> ClaimControlOk:
        key = self.resolve(request.articulation) or request.articulation
        session, what, ttl = self._session, _control_of(key), request.ttl_s
        try:
            with session.settling(what, lambda turn: turn.call(ClaimControl(articulation=key, ttl_s=ttl))):
                reply = await self._session.exchange_once(request, deadlines)
        except ControlClaimed as refusal:
            if request.force or refusal.owner not in self._names:
                raise self._refused([key], refusal) from None
            # The owner is this client in an earlier session, so forcing takes the robot from no other client.
            request.force = True
            reply = await self._session.exchange_once(request, deadlines)
        except BaseException:
            if what in session.unsettled:
                self._hold(key, ttl)  # most likely, so that `aclose` releases it
            raise
        session.features = session.features.with_claim(self.owner, reply)
        if reply.owner == session.session_id:
            self._names.add(reply.owner)
        self._hold(key, ttl)
        return reply

    async def _release(self, request: ReleaseControl, deadlines: Deadlines) -> ReleaseControlOk:
        key = self.resolve(request.articulation) or request.articulation
        self._held.pop(key, None)  # otherwise the claim would be renewed
        again = ReleaseControl(articulation=key)
        try:
            with self._session.settling(_control_of(key), lambda turn: turn.call(again)):
                return await self._session.exchange_once(request, deadlines)
        except NotControlOwner as refusal:
            raise self._refused([key], refusal) from None

    def _hold(self, key: str, ttl: float) -> None:
        now = asyncio.get_running_loop().time()
        self._held[key] = _Claim(ttl, now + ttl if ttl > 0 else math.inf)
        self._others.pop(key, None)
        if ttl > 0 and (self._renewal is None or self._renewal.done()):
            self._renewal = background_task("urlab-claims", self._renew(), tell=self._session.tell)

    def _note_write(self, robots: Iterable[str]) -> None:
        now = asyncio.get_running_loop().time()
        for key in robots:
            claim = self._held.get(key)
            if claim is not None and claim.ttl > 0:
                claim.until = now + claim.ttl

    def _refused(self, robots: Sequence[str], refusal: NotControlOwner) -> NotControlOwner:
        self._learn(robots, refusal)
        if refusal.owner == UNCLAIMED:
            refusal.hint = "Call articulation.claim() first, or create the client with claim_control=True."
        return refusal

    def _learn(self, robots: Sequence[str], refusal: NotControlOwner) -> None:
        """Note that this client does not own all of these robots; the server does not name the ones it does not own."""
        for key in robots:
            self._held.pop(key, None)
        if len(robots) == 1 and refusal.owner not in {"", UNCLAIMED}:
            self._others[robots[0]] = refusal.owner

    async def _renew(self) -> None:
        """Renew the claims of robots that have had no recent write, until no claim is left."""
        loop = asyncio.get_running_loop()
        while timed := {key: claim for key, claim in self._held.items() if claim.ttl > 0}:
            await asyncio.sleep(min(claim.ttl for claim in timed.values()) / _RENEWALS)
            for key, claim in timed.items():
                if self._held.get(key) is claim and claim.until - loop.time() < claim.ttl * (1 - 1 / _RENEWALS):
                    await self._renew_one(key, claim)

    async def _renew_one(self, key: str, claim: _Claim) -> None:
        request = ClaimControl(articulation=key, ttl_s=claim.ttl)
        try:
            await self._session.probe(request, timeout=claim.ttl / _RENEWALS)
        except NotControlOwner as refusal:
            log.warning("%s is now controlled by %s", key, refusal.owner)
        except URLabError as error:
            log.debug("the claim of %s could not be renewed: %s", key, error)


def _control_of(key: str) -> str:
    return f"control of {key!r}"
