"""Addresses of running editors, leased to one holder at a time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any, Final

from urlab_client.protocol.errors import LeaseBusy, URLabError
from urlab_client.sync.client import URLabClient

__all__ = ["Lease", "LeaseLost", "LeasePool"]

_ray: Any = import_module("ray")  # Any: Ray's hints leave every remote call unknown
_REPLY_S: Final = 10.0
_SERVER_LEASE_S: Final = 30.0  # without a request


class LeaseLost(URLabError):
    """The lease ran out, or the actor that keeps the leases is gone."""


class Book:
    """Who holds what until when. Runs as an asynchronous actor, so its methods never run in parallel."""

    def __init__(self, addresses: Sequence[str], ttl: float) -> None:
        self._ttl = ttl
        self._holders: dict[str, tuple[str, float] | None] = dict.fromkeys(addresses)
        self._waiting: set[str] = set()
        self._server_leases: dict[str, str] = {}
        self._changed = asyncio.Condition()

    async def take(self, holder: str, timeout: float) -> str | None:
        """Lease a free address, waiting for one; None after `timeout` seconds or when the holder was given up."""
        deadline = time.monotonic() + timeout
        self._waiting.add(holder)
        try:
            async with self._changed:
                while holder in self._waiting:
                    self._expire()
                    for address, lease in self._holders.items():
                        if lease is None:
                            self._holders[address] = (holder, time.monotonic() + self._ttl)
                            return address
                    ends = min([deadline, *(lease[1] for lease in self._holders.values() if lease)])
                    if time.monotonic() >= deadline:
                        return None
                    try:
                        await asyncio.wait_for(self._changed.wait(), max(ends - time.monotonic(), 0.0))
                    except TimeoutError:
                        continue  # a lease ran out, or the time did
                return None
        finally:
            self._waiting.discard(holder)

    async def renew(self, holder: str) -> bool:
        """Prolong a lease; False when it ran out."""
        self._expire()
        for address, lease in self._holders.items():
            if lease is not None and lease[0] == holder:
                self._holders[address] = (holder, time.monotonic() + self._ttl)
                return True
        return False

    async def give_back(self, holder: str) -> None:
        """Free what a holder has, and stop it from waiting; nothing when it has nothing."""
        async with self._changed:
            self._waiting.discard(holder)
            for address, lease in self._holders.items():
                if lease is not None and lease[0] == holder:
                    self._holders[address] = None
            self._changed.notify_all()

    async def note_server_lease(self, address: str, lease_id: str) -> None:
        """Remember the lease that a holder took of the server itself."""
        self._server_leases[address] = lease_id

    async def server_lease(self, address: str) -> str | None:
        """Return the latest lease that a holder took of the server itself."""
        return self._server_leases.get(address)

    async def holders(self) -> dict[str, str | None]:
        """Return the holder of each address, None where it is free."""
        self._expire()
        return {address: lease and lease[0] for address, lease in self._holders.items()}

    def _expire(self) -> None:
        now = time.monotonic()
        for address, lease in self._holders.items():
            if lease is not None and lease[1] <= now:
                self._holders[address] = None


class Lease:
    """An address for the time being.

    Attributes:
        address: The address.
    """

    def __init__(self, book: Any, holder: str, address: str, ttl: float) -> None:
        self.address = address
        self._book = book
        self._holder = holder
        self._ttl = ttl
        self._renewed = time.monotonic()

    def keep(self) -> None:
        """Prolong the lease when a third of its time is over; to be called often.

        Raises:
            LeaseLost: It ran out, so that somebody else may use the address.
        """
        now = time.monotonic()
        if now - self._renewed < self._ttl / 3:
            return
        if not _ask(self._book.renew.remote(self._holder), _REPLY_S):
            raise LeaseLost(f"The lease of {self.address} ran out.", hint="Give the pool a longer ttl.")
        self._renewed = now

    @contextmanager
    def of_server(self, client: URLabClient) -> Generator[None]:
        """Hold the server's own lease, where it has one, so that clients outside the pool see that it is in use.

        Every step prolongs it, and it is given back at the end. One that was left by a holder who was killed is taken
        over, and the robots with it: the pool says that nobody has the address any more.

        Raises:
            LeaseBusy: Somebody outside the pool uses the server.
        """
        if not client.server.features.leases:
            yield
            return
        try:
            lease_id = client.farm.acquire_lease(self._holder, ttl_s=_SERVER_LEASE_S)
        except LeaseBusy as busy:
            if not busy.lease_id or busy.lease_id != _ask(self._book.server_lease.remote(self.address), _REPLY_S):
                raise
            client.farm.release_lease(busy.lease_id)
            lease_id = client.farm.acquire_lease(self._holder, ttl_s=_SERVER_LEASE_S)
            for articulation in client.articulations.values():
                articulation.claim(force=True)
        try:
            _ask(self._book.note_server_lease.remote(self.address, lease_id), _REPLY_S)
            yield
        finally:
            with suppress(URLabError):  # with the server, or after a long pause, the lease is gone too
                client.farm.release_lease(lease_id)


class LeasePool:
    """Addresses that workers lease, kept by an actor on the driver's node.

    May be shared by several runs and sent to tasks and actors. A lease that is neither prolonged nor given back, as
    when its holder was killed, is free again after `ttl`; `rollouts` gives back earlier for workers that it saw die.
    The actor lives as long as the driver, or until `close()`.
    """

    def __init__(self, addresses: Sequence[str], *, name: str = "leased", ttl: float = 30.0) -> None:
        """Start the actor.

        Args:
            addresses: Servers in play that all have the same scene.
            name: What `Episode.scene` says for them.
            ttl: Seconds after which a lease ends that is not prolonged.

        Raises:
            ValueError: No address, one twice, or a `ttl` that is not above 0.
            URLabError: Ray is not initialised.
        """
        if not addresses or len(set(addresses)) != len(addresses):
            raise ValueError(f"addresses must be one or more, each once, not {list(addresses)!r}")
        if not ttl > 0:
            raise ValueError(f"ttl must be above 0 seconds, not {ttl}")
        if not _ray.is_initialized():
            raise URLabError("Ray is not initialised.", hint="Call ray.init() first.")
        self.name = name
        self.size: int = len(addresses)
        self._ttl = ttl
        here = import_module("ray.util.scheduling_strategies").NodeAffinitySchedulingStrategy(
            _ray.get_runtime_context().get_node_id(), soft=False
        )
        self._book: Any = (
            _ray.remote(Book).options(num_cpus=0, scheduling_strategy=here).remote(list(addresses), float(ttl))
        )

    @contextmanager
    def lease(self, holder: str, *, timeout: float = 60.0) -> Generator[Lease]:
        """Lease an address and give it back at the end.

        Args:
            holder: A name that nobody else uses.
            timeout: Seconds to wait for a free address.

        Raises:
            LeaseLost: None was free in time, or the pool is gone.
        """
        address = _ask(self._book.take.remote(holder, timeout), timeout + _REPLY_S)
        if address is None:
            raise LeaseLost(f"No address of {self.name!r} was free within {timeout:g} s.")
        try:
            yield Lease(self._book, holder, address, self._ttl)
        finally:
            with suppress(LeaseLost):  # with the pool, the lease is gone too
                # Waits, because a process that ends at once would not have sent it.
                _ask(self._book.give_back.remote(holder), _REPLY_S)

    def give_back(self, holder: str) -> None:
        """Free what a holder has leased, without waiting for it."""
        self._book.give_back.remote(holder)

    def holders(self) -> dict[str, str | None]:
        """Return the holder of each address, None where it is free.

        Raises:
            LeaseLost: The pool is gone.
        """
        return _ask(self._book.holders.remote(), _REPLY_S)

    def close(self) -> None:
        """End the actor; leases cannot be prolonged any more."""
        _ray.kill(self._book)


def _ask(reply: Any, timeout: float) -> Any:
    try:
        return _ray.get(reply, timeout=timeout)
    except _ray.exceptions.RayError as error:
        raise LeaseLost(f"The lease pool does not answer: {type(error).__name__}.") from error
