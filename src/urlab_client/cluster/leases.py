"""Addresses of running editors, leased to one holder at a time."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any, Final

from urlab_client.errors import LeaseBusy, URLabError
from urlab_client.sync.client import URLabClient

_ray: Any = import_module("ray")  # Any: Ray's hints leave every remote call unknown
_REPLY_S: Final = 10.0
_POLL_S: Final = 0.1  # how often whoever waits for a free address asks
_SERVER_LEASE_S: Final = 30.0  # without a request


class LeaseLost(URLabError):
    """The lease expired, or the actor that manages the leases is gone."""


class Book:
    """The leases, by address, and their holders. Runs as an actor."""

    def __init__(self, addresses: Sequence[str], ttl: float) -> None:
        self._ttl = ttl
        self._leases: dict[str, tuple[str, float] | None] = dict.fromkeys(addresses)
        self._server_leases: dict[str, str] = {}

    def take(self, holder: str) -> str | None:
        """Lease a free address; None if there is none."""
        address = next((each for each, by in self.holders().items() if by is None), None)
        if address is not None:
            self._leases[address] = (holder, time.monotonic() + self._ttl)
        return address

    def renew(self, holder: str) -> bool:
        """Renew a lease; False if it has expired."""
        held = [address for address, by in self.holders().items() if by == holder]
        self._leases.update(dict.fromkeys(held, (holder, time.monotonic() + self._ttl)))
        return bool(held)

    def give_back(self, holder: str) -> None:
        """Release the lease of a holder; no effect if it has none."""
        self._leases.update({address: None for address, by in self.holders().items() if by == holder})

    def server_lease(self, address: str, acquired: str | None = None) -> str | None:
        """Return the latest lease that a holder acquired from the server itself, after noting a new one."""
        if acquired is not None:
            self._server_leases[address] = acquired
        return self._server_leases.get(address)

    def holders(self) -> dict[str, str | None]:
        """Return the holder of each address; None if it is free."""
        now = time.monotonic()
        return {address: lease[0] if lease and lease[1] > now else None for address, lease in self._leases.items()}


class Lease:
    """A leased address.

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
        """Renew the lease if a third of its time has passed. Call this often.

        Raises:
            LeaseLost: The lease expired, and another holder may use the address.
        """
        now = time.monotonic()
        if now - self._renewed < self._ttl / 3:
            return
        if not _ask(self._book.renew.remote(self._holder)):
            raise LeaseLost(f"The lease of {self.address} expired.", hint="Give the pool a longer ttl.")
        self._renewed = now

    @contextmanager
    def of_server(self, client: URLabClient) -> Generator[None]:
        """Hold the server's own lease, if it supports leases, so that clients outside the pool see that it is in use.

        Every step renews it, and it is released at the end. The lease of a killed holder is taken over together with
        the robots, because the pool has freed the address.

        Raises:
            LeaseBusy: A client outside the pool is using the server.
        """
        if not client.server.features.leases:
            yield
            return
        try:
            lease_id = client.farm.acquire_lease(self._holder, ttl_s=_SERVER_LEASE_S)
        except LeaseBusy as busy:
            if not busy.lease_id or busy.lease_id != _ask(self._book.server_lease.remote(self.address)):
                raise
            client.farm.release_lease(busy.lease_id)
            lease_id = client.farm.acquire_lease(self._holder, ttl_s=_SERVER_LEASE_S)
            for articulation in client.articulations.values():
                articulation.claim(force=True)
        try:
            _ask(self._book.server_lease.remote(self.address, lease_id))
            yield
        finally:
            with suppress(URLabError):  # if the server is gone, or after a long pause, so is the lease
                client.farm.release_lease(lease_id)


class LeasePool:
    """Addresses that workers lease, kept by an actor on the driver's node.

    May be shared by several runs and sent to tasks and actors. A lease that is neither renewed nor released, for
    example because its holder was killed, expires after `ttl`; `rollouts` releases the leases of dead workers earlier.
    The actor lives as long as the driver, or until `close()`.
    """

    def __init__(self, addresses: Sequence[str], *, name: str = "leased", ttl: float = 30.0) -> None:
        """Start the actor.

        Args:
            addresses: Addresses of servers in play with the same scene.
            name: Name of the pool in `Episode.scene`.
            ttl: Seconds after which a lease expires unless it is renewed.

        Raises:
            ValueError: There is no address, one occurs twice, or `ttl` is not above 0.
            URLabError: Ray is not initialised.
        """
        if not addresses or len(set(addresses)) != len(addresses):
            raise ValueError(f"addresses must contain at least one address and no duplicates, not {list(addresses)!r}")
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
        """Lease an address and release it at the end.

        Args:
            holder: A unique name.
            timeout: Seconds to wait for a free address.

        Raises:
            LeaseLost: No address was free in time, or the pool is gone.
        """
        deadline = time.monotonic() + timeout
        while (address := _ask(self._book.take.remote(holder))) is None:
            if time.monotonic() >= deadline:
                raise LeaseLost(f"No address of {self.name!r} was free within {timeout:g} s.")
            time.sleep(min(_POLL_S, timeout))
        try:
            yield Lease(self._book, holder, address, self._ttl)
        finally:
            with suppress(LeaseLost):  # if the pool is gone, so is the lease
                # Waits, because a process that exits immediately would not send it.
                _ask(self._book.give_back.remote(holder))

    def give_back(self, holder: str) -> None:
        """Release the lease of a holder, without waiting for it."""
        self._book.give_back.remote(holder)

    def holders(self) -> dict[str, str | None]:
        """Return the holder of each address; None if it is free.

        Raises:
            LeaseLost: The pool is gone.
        """
        return _ask(self._book.holders.remote())

    def close(self) -> None:
        """Stop the actor; leases can no longer be renewed."""
        _ray.kill(self._book)


def _ask(reply: Any) -> Any:
    try:
        return _ray.get(reply, timeout=_REPLY_S)
    except _ray.exceptions.RayError as error:
        raise LeaseLost(f"The lease pool does not answer: {type(error).__name__}.") from error
